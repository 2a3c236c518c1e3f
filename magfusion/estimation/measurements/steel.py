"""Distortion of the beacons' fields by steel near the path, as amplitudes of physical modes.

Steel at a place c is magnetised by the field of each beacon there, and adds the field of a dipole
``G(r - c) A B(c)``.  The polarisability A of a voxel is a symmetric tensor that all beacons share;
a smaller moment of each tone's own represents long bodies, which conduct flux from elsewhere.
All are independent, with a variance proportional to the volume, and are seen on the path through
their strongest modes.  Each is free of curl and divergence, as the field of steel is.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.model.field import predict
from magfusion.model.noise import sensor_positions
from magfusion.model.parameters import Block, Parameter, placed
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import AnyArray, Array, ComplexArray

SHARED, OWN = 160, 12  # modes of all beacons together, and of each tone
UNIT = 0.01  # relative distortion by a sigma of all modes, rms over path and beacons
COARSEST, FINEST = 2.0, 0.5  # m; edges of voxels
CLEAR = 0.4  # m; no steel nearer to path or beacon
MARGIN = 2.5  # m; of the voxels around path and beacons
PLACES = 60  # on the path, at which modes are determined
MAX_EPOCHS = 4000
ROOT = np.sqrt(0.5)
# A symmetric tensor of unit norm for each of its six components.
TENSORS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
    TENSORS[_k, _i, _j] = TENSORS[_k, _j, _i] = 1.0 if _i == _j else ROOT


class Voxels(NamedTuple):
    """Places of possible steel.

    Parameters
    ----------
    centre_world : ndarray, shape (v, 3)
        (m)
    edge : ndarray, shape (v,)
        (m)
    """

    centre_world: Array
    edge: Array


class SteelModes(Parameter):
    """Amplitudes of the modes: first those shared by all beacons, then those of each tone.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Of the epochs (s).
    fields : mapping of str to ndarray, shape (n, tones, 3, modes)
        Added to each beacon's field by a unit of each, world axes (T).
    sources : mapping of str to ndarray, shape (n, tones, 3)
        The beacons' fields of the same drive phase, world axes (T).
    sensor_from_world : ndarray, shape (n, 3, 3)
    voxels : Voxels
    polarisability : ndarray, shape (v, tones, 3, modes)
        Moment of each voxel by a unit of each, over the field of the tone there.
    shared : int
        Number of shared modes.
    """

    group = kind = "steel"
    owner = "site"

    def __init__(
        self,
        time: Array,
        fields: Mapping[str, AnyArray],
        sources: Mapping[str, AnyArray],
        sensor_from_world: Array,
        voxels: Voxels,
        polarisability: AnyArray,
        shared: int,
    ) -> None:
        self._time, self._fields, self._sources = time, fields, sources
        self._sensor_from_world, self.voxels = sensor_from_world, voxels
        self.polarisability, self.shared = polarisability, shared

    @property
    def columns(self) -> int:
        """Number of amplitudes."""
        return int(self.polarisability.shape[-1])

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray:
        """Return the columns of a beacon's phasors."""
        time, name = view.calibration.reference_time + view.elapsed, view.beacon.name
        at = np.searchsorted(self._time, time - SAME_TIME)
        turn, source = self._sensor_from_world[at], self._sources[name][at]
        # The drive's phase and gain are those of the field that is measured.
        in_world = np.einsum("nak,nta->ntk", turn, view.phasor)
        drive = np.sum(source.conj() * in_world, axis=2) / np.sum(np.abs(source) ** 2, axis=2)
        added = turn[:, None] @ self._fields[name][at]
        return np.asarray(drive[..., None, None] * added)


def steel_modes(site: Site, time: Array, poses: Trajectory) -> tuple[Block, ...]:
    """Return the block of steel's amplitudes for a log; none for what it does not model.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Of the fields (s).
    poses : Trajectory
        Poses at these times.
    """
    if site.platform.further or not site.beacons or not 1 < len(time) <= MAX_EPOCHS:
        return ()
    sensor, place = site.platform.magnetometer, sensor_positions(site, poses)[:, 0]
    voxels = voxels_around(np.concatenate([place, [b.position_world for b in site.beacons]]))
    at_path, at_voxels = (beacon_fields(site, point) for point in (place, voxels.centre_world))
    root = voxels.edge[:, None, None, None] ** 1.5
    moment = np.einsum("kij,vtj->vtik", TENSORS, at_voxels) * root
    moments = [_modes(place, at_path, voxels, moment, SHARED)]
    shared, strength = moments[0].shape[-1], np.linalg.norm(at_voxels, axis=2)
    for tone in range(at_path.shape[1]):
        own = strength[:, [tone], None, None] * np.eye(3) * root
        some = _modes(place, at_path[:, [tone]], voxels, own, OWN)
        every = np.zeros((*at_voxels.shape, some.shape[-1]), dtype=some.dtype)
        every[:, [tone]] = some
        moments.append(every)
    dipoles = np.concatenate(moments, axis=-1)
    added = _fields(place, voxels, dipoles)
    fields, sources, start = {}, {}, 0
    for beacon in site.beacons:
        tones = slice(start, start + len(beacon.tones))
        fields[beacon.name], sources[beacon.name] = added[:, tones], at_path[:, tones]
        start = tones.stop
    turn = np.swapaxes(poses.world_from_body @ sensor.body_from_sensor, 1, 2)
    polarisability = dipoles / strength[..., None, None]
    modes = SteelModes(time, fields, sources, turn, voxels, polarisability, shared)
    return placed([Block(modes, modes.owner, slice(0), np.full(modes.columns, UNIT))])


def voxels_around(point_world: Array) -> Voxels:
    """Return an octree of voxels around points, finer near to them, and clear of them."""
    low, high = point_world.min(axis=0) - MARGIN, point_world.max(axis=0) + MARGIN
    count = np.ceil((high - low) / COARSEST).astype(int)
    grid = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 3)
    centre, edge, out = low + (grid + 0.5) * COARSEST, COARSEST, []
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    while len(centre):
        away = cKDTree(point_world).query(centre)[0]
        divided = (edge > away) & (edge > FINEST)
        kept = ~divided & (away > CLEAR)
        out.append((centre[kept], np.full(np.sum(kept), edge)))
        centre = (centre[divided][:, None] + edge * corners).reshape(-1, 3)
        edge *= 0.5
    return Voxels(np.concatenate([c for c, _ in out]), np.concatenate([e for _, e in out]))


def beacon_fields(site: Site, point_world: Array) -> AnyArray:
    """Return the field of every tone at points, world axes (T), shape (n, tones, 3).

    Real where the coils of each beacon are in phase.
    """
    sensor, along = site.platform.magnetometer, np.eye(3)
    point = replace(
        sensor, position_body=np.zeros(3), matrix=along, body_from_sensor=along, coil_kappa=0.0
    )
    point = replace(point, coil_centres_sensor=None, casing=None)
    turn = np.broadcast_to(along, (len(point_world), 3, 3))
    fields = [predict(beacon, point, turn, point_world) for beacon in site.beacons]
    every = np.concatenate(fields, axis=1)
    return every if np.any(every.imag) else every.real


def _dipole_tensors(point_world: Array, centre_world: Array) -> Array:
    """Return the field over mu0 of unit moments, shape (n, v, 3, 3) (1/m^3)."""
    offset = point_world[:, None] - centre_world
    distance = np.linalg.norm(offset, axis=2)[..., None]
    along = offset / distance
    square = 3.0 * along[..., :, None] * along[..., None, :] - np.eye(3)
    return np.asarray(square / (4.0 * np.pi * distance[..., None] ** 3))


def _fields(place: Array, voxels: Voxels, moment: AnyArray) -> AnyArray:
    """Return the field of moments (v, tones, 3, k) over mu0 at places, (n, tones, 3, k)."""
    source = np.swapaxes(moment, 1, 2).reshape(-1, moment.shape[1] * moment.shape[3])
    parts = []
    for some in np.array_split(place, max(len(place) // PLACES, 1)):
        tensors = np.swapaxes(_dipole_tensors(some, voxels.centre_world), 1, 2)
        field = tensors.reshape(3 * len(some), -1) @ source
        parts.append(field.reshape(len(some), 3, moment.shape[1], moment.shape[3]))
    return np.swapaxes(np.concatenate(parts), 1, 2)


def _modes(
    place: Array, at_path: AnyArray, voxels: Voxels, moment: AnyArray, count: int
) -> AnyArray:
    """Return the moments of the strongest modes of relative distortion, (v, tones, 3, modes).

    Parameters
    ----------
    moment : ndarray, shape (v, tones, 3, k)
        Of each voxel, by a sigma of each of its k independent amplitudes.
    """
    rows = np.unique(np.linspace(0, len(place) - 1, min(len(place), PLACES)).astype(int))
    tensors = _dipole_tensors(place[rows], voxels.centre_world)
    size = np.linalg.norm(at_path[rows], axis=2)[..., None]
    relative = np.stack(
        [tensors @ moment[:, tone] / size[:, [tone], None] for tone in range(moment.shape[1])],
        axis=1,
    )
    unit = float(np.sqrt(np.sum(np.abs(relative) ** 2) / size.size))
    flat = np.moveaxis(relative, 3, 2).reshape(3 * size.size, -1)
    flat = np.concatenate([flat.real, flat.imag]) if np.iscomplexobj(flat) else flat
    value, vector = np.linalg.eigh(flat @ flat.T)
    kept = np.flatnonzero(value > 1e-9 * value[-1])[::-1][:count]
    amplitude = flat.T @ (vector[:, kept] / np.sqrt(value[kept]))
    amplitude = amplitude.reshape(len(voxels.edge), 1, moment.shape[3], -1)
    return np.asarray(moment @ amplitude / unit)
