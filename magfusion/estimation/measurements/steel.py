"""Distortion of the beacons' fields by steel near the path, as amplitudes of physical modes.

Steel at a place c is magnetised by the field of each beacon there, and adds the field of a dipole
``G(r - c) A B(c)``.  The polarisability A of a voxel is a symmetric tensor that all beacons share;
a smaller moment of each tone's own represents long bodies, which conduct flux from elsewhere.
All are independent, with a variance proportional to the volume, and are seen on the path through
their strongest modes.  Each is free of curl and divergence, as the field of steel is.

A running estimate does not know its path before: its modes are those of a site's region, fewer, of
voxels that the path may enter, where their field is softened.  The site alone determines them.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.model.detection_range import are_many
from magfusion.model.field import predict
from magfusion.model.noise import sensor_positions, sensors_at
from magfusion.model.once import once_a_site
from magfusion.model.parameters import Block, Calibration, Parameter, placed
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
MAX_MOMENTS = 5e7  # numbers, .4 GB; the path of a wrong estimate may span kilometres
REGION_SHARED, REGION_OWN = 40, 3  # the same of a region
REGION_EDGE, MAX_VOXELS = 1.0, 600  # m; coarser voxels where there would be more
REGION_MARGIN = 1.0  # m; of places around beacons in a plane, and of voxels
REGION_ROWS, MIN_PLACES = 160, 10  # places times tones, at which its modes are determined
SOFTENING = 0.5  # of the edge
LOW_DISCREPANCY = np.array([0.8191725, 0.6710436, 0.5497005])  # of an additive recurrence
ROOT = np.sqrt(0.5)
# A symmetric tensor of unit norm for each of its six components.
TENSORS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
    TENSORS[_k, _i, _j] = TENSORS[_k, _j, _i] = 1.0 if _i == _j else ROOT


class Voxels(NamedTuple):
    """Places of possible steel."""

    centre_world: Array  # (v, 3) (m)
    edge: Array  # (v,) (m)


class SteelBasis(NamedTuple):
    """Modes of steel at any place: first those shared by all beacons, then those of each tone."""

    voxels: Voxels
    # (v, tones, 3, modes), moment of each voxel by a unit of each, times mu0 (T m^3)
    moment: AnyArray
    polarisability: AnyArray  # (v, tones, 3, modes), the same over the field of the tone there
    # (v, 6, shared), polarisability of each voxel by a unit of each shared mode, over the root of
    # its volume, by component of `TENSORS`
    tensor: Array
    # distance below which the field of a voxel is no more that of a dipole, over its edge
    softening: float

    @property
    def shared(self) -> int:
        """Number of shared modes."""
        return int(self.tensor.shape[-1])

    @property
    def unit(self) -> float:
        """Norm of each column of ``tensor``; they are orthogonal."""
        return float(np.linalg.norm(self.tensor[..., 0]))

    def fields(self, place_world: Array) -> AnyArray:
        """Return the field of a unit of each at places, world axes (T), (n, tones, 3, modes)."""
        moment, softening = self.moment, self.softening * self.voxels.edge
        source = np.swapaxes(moment, 1, 2).reshape(-1, moment.shape[1] * moment.shape[3])
        parts = []
        for some in np.array_split(place_world, max(len(place_world) // PLACES, 1)):
            tensors = _dipole_tensors(some, self.voxels.centre_world, softening)
            field = np.swapaxes(tensors, 1, 2).reshape(3 * len(some), -1) @ source
            parts.append(field.reshape(len(some), 3, moment.shape[1], moment.shape[3]))
        return np.swapaxes(np.concatenate(parts), 1, 2)

    def phasors(
        self, calibration: Calibration, time: Array, world_from_body: Array, position_world: Array
    ) -> ComplexArray:
        """Return the phasors of a unit of each, sensor axes (T), (n, channels, 3, modes)."""
        site = calibration.site
        place = sensors_at(site, world_from_body, position_world)[:, 0]
        turn = np.swapaxes(world_from_body @ site.platform.magnetometer.body_from_sensor, 1, 2)
        drive = calibration.gain_at(time) * np.exp(1j * calibration.drive_phase(time))
        return np.asarray(drive[..., None, None] * (turn[:, None] @ self.fields(place)))


class SteelModes(Parameter):
    """Amplitudes of the modes of a basis.

    `time` (n,): of epochs (s). `fields` (n, tones, 3, modes) each: added to each beacon's field by
    a unit of each, world axes (T); of none, without a column. `sources` (n, tones, 3) each: the
    beacons' fields of the same drive phase, world axes (T). `sensor_from_world` (n, 3, 3).
    """

    group = kind = "steel"
    owner = "site"

    def __init__(
        self,
        basis: SteelBasis,
        time: Array,
        fields: Mapping[str, AnyArray],
        sources: Mapping[str, AnyArray],
        sensor_from_world: Array,
    ) -> None:
        self.basis, self._time, self._fields, self._sources = basis, time, fields, sources
        self._sensor_from_world = sensor_from_world

    @property
    def columns(self) -> int:
        """Number of amplitudes."""
        return int(self.basis.moment.shape[-1])

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return the columns of a beacon's phasors."""
        if not self._fields:
            return None
        time, name = view.calibration.reference_time + view.elapsed, view.beacon.name
        at = np.searchsorted(self._time, time - SAME_TIME)
        turn, source = self._sensor_from_world[at], self._sources[name][at]
        # The drive's phase and gain are those of the field that is measured.
        in_world = np.einsum("nak,nta->ntk", turn, view.phasor)
        drive = np.sum(source.conj() * in_world, axis=2) / np.sum(np.abs(source) ** 2, axis=2)
        added = turn[:, None] @ self._fields[name][at]
        return np.asarray(drive[..., None, None] * added)


def steel_modes(
    site: Site,
    time: Array,
    poses: Trajectory,
    count: tuple[int, int] = (SHARED, OWN),
    places: int = PLACES,
) -> tuple[Block, ...]:
    """Return the block of steel's amplitudes for a log; none for what it does not model.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Of the fields (s).
    poses : Trajectory
        Poses at these times.
    count : tuple of int
        Number of modes of all beacons together, and of each tone.
    places : int
        On the path, at which they are determined.
    """
    if site.platform.further or not site.beacons or not 1 < len(time) <= MAX_EPOCHS:
        return ()
    place = sensor_positions(site, poses)[:, 0]
    channels = len(site.channels)
    limit = MAX_MOMENTS / (3 * channels * (count[0] + count[1] * channels))
    voxels = voxels_around(np.concatenate([place, [b.position_world for b in site.beacons]]), limit)
    if voxels is None:
        return ()
    rows = np.unique(np.linspace(0, len(place) - 1, min(len(place), places)).astype(int))
    basis = _basis(site, place[rows], voxels, count, 0.0)
    return along_path(basis, site, time, poses)


def along_path(basis: SteelBasis, site: Site, time: Array, poses: Trajectory) -> tuple[Block, ...]:
    """Return the block of the amplitudes of a basis for a log, as `steel_modes`."""
    place = sensor_positions(site, poses)[:, 0]
    added, at_path = basis.fields(place), beacon_fields(site, place)
    fields, sources, start = {}, {}, 0
    for beacon in site.beacons:
        tones = slice(start, start + len(beacon.tones))
        fields[beacon.name], sources[beacon.name] = added[:, tones], at_path[:, tones]
        start = tones.stop
    from_body = site.platform.magnetometer.body_from_sensor
    turn = np.swapaxes(poses.world_from_body @ from_body, 1, 2)
    return _block(SteelModes(basis, time, fields, sources, turn))


def region_modes(site: Site) -> tuple[Block, ...]:
    """Return the block of the amplitudes of a site's region, without columns of its own.

    They are equal whenever they are determined, up to rounding; none for what it does not model.
    """
    basis = _region_basis(site)
    return () if basis is None else without_columns(basis)


def without_columns(basis: SteelBasis) -> tuple[Block, ...]:
    """Return the block of the amplitudes of a basis, without columns of its own."""
    return _block(SteelModes(basis, np.zeros(0), {}, {}, np.zeros(0)))


def _block(modes: SteelModes) -> tuple[Block, ...]:
    return placed([Block(modes, modes.owner, slice(0), np.full(modes.columns, UNIT))])


@once_a_site
def _region_basis(site: Site) -> SteelBasis | None:
    beacon = np.array([b.position_world for b in site.beacons])
    if site.platform.further or len(beacon) < 2 or are_many(site):
        return None
    if not np.all(np.isfinite(beacon)):
        return None
    low, high = beacon.min(axis=0), beacon.max(axis=0)
    half = np.maximum(0.5 * (high - low), REGION_MARGIN)
    low, high = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    if site.region is not None and (box := site.region.box_world) is not None:
        low, high = (np.where(np.isfinite(b), b, e) for b, e in zip(box, (low, high), strict=True))
    count = max(REGION_ROWS // len(site.channels), MIN_PLACES)
    place = low + (high - low) * (np.arange(1, count + 1)[:, None] * LOW_DISCREPANCY % 1.0)
    place = place[cKDTree(beacon).query(place)[0] > CLEAR]
    low, high, edge = low - REGION_MARGIN, high + REGION_MARGIN, REGION_EDGE
    edge = max(edge, float(np.prod(high - low) / MAX_VOXELS) ** (1.0 / 3.0))
    centre = _grid(low, high, edge)
    centre = centre[cKDTree(beacon).query(centre)[0] > SOFTENING * edge]
    if not len(place) or not len(centre):
        return None
    voxels = Voxels(centre, np.full(len(centre), edge))
    basis = _basis(site, place, voxels, (REGION_SHARED, REGION_OWN), SOFTENING)
    # An eigenvector's sign is arbitrary, and a checkpoint may be resumed elsewhere.
    moment = basis.moment.real.reshape(-1, basis.moment.shape[-1])
    sign = np.where(np.cos(np.arange(len(moment))) @ moment < 0.0, -1.0, 1.0)
    return basis._replace(
        moment=sign * basis.moment,
        polarisability=sign * basis.polarisability,
        tensor=sign[: basis.shared] * basis.tensor,
    )


def _basis(
    site: Site, place: Array, voxels: Voxels, count: tuple[int, int], softening: float
) -> SteelBasis:
    """Return the strongest modes at places: of all beacons together, and of each tone."""
    at_place, at_voxels = (beacon_fields(site, point) for point in (place, voxels.centre_world))
    tensors = _dipole_tensors(place, voxels.centre_world, softening * voxels.edge)
    moment, root = unit_moments(voxels, at_voxels), voxels.edge[:, None, None, None] ** 1.5
    tensor = _modes(tensors, at_place, moment, count[0])
    moments, strength = [moment @ tensor[:, None]], np.linalg.norm(at_voxels, axis=2)
    for tone in range(at_place.shape[1]):
        own = strength[:, [tone], None, None] * np.eye(3) * root
        some = own @ _modes(tensors, at_place[:, [tone]], own, count[1])[:, None]
        every = np.zeros((*at_voxels.shape, some.shape[-1]), dtype=some.dtype)
        every[:, [tone]] = some
        moments.append(every)
    dipoles = np.concatenate(moments, axis=-1)
    return SteelBasis(voxels, dipoles, dipoles / strength[..., None, None], tensor, softening)


def unit_moments(voxels: Voxels, at_voxels: AnyArray) -> AnyArray:
    """Return the moments by a unit of each component of the tensors, (v, tones, 3, 6) (T m^3).

    `at_voxels` (v, tones, 3): the beacons' fields there (T).
    """
    root = voxels.edge[:, None, None, None] ** 1.5
    return np.asarray(np.einsum("kij,vtj->vtik", TENSORS, at_voxels) * root)


def voxels_around(point_world: Array, limit: float) -> Voxels | None:
    """Return an octree of voxels around points, finer near to them, and clear of them.

    None if there would be more voxels than a limit.
    """
    low, high = point_world.min(axis=0) - MARGIN, point_world.max(axis=0) + MARGIN
    if not np.prod((high - low) / COARSEST) <= limit:
        return None
    centre, edge, out = _grid(low, high, COARSEST), COARSEST, []
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    while len(centre):
        away = cKDTree(point_world).query(centre)[0]
        divided = (edge > away) & (edge > FINEST)
        kept = ~divided & (away > CLEAR)
        out.append((centre[kept], np.full(np.sum(kept), edge)))
        centre = (centre[divided][:, None] + edge * corners).reshape(-1, 3)
        edge *= 0.5
    voxels = Voxels(np.concatenate([c for c, _ in out]), np.concatenate([e for _, e in out]))
    return voxels if len(voxels.edge) <= limit else None


def _grid(low: Array, high: Array, edge: float) -> Array:
    """Return the centres of equal voxels that fill a box, shape (v, 3) (m)."""
    count = np.ceil((high - low) / edge).astype(int)
    grid = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(low + (grid + 0.5) * edge)


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


def _dipole_tensors(point_world: Array, centre_world: Array, softening: Array) -> Array:
    """Return the field over mu0 of unit moments, shape (n, v, 3, 3) (1/m^3).

    Softened, it has no curl; divergence is near the voxel only, within the softening (m).
    """
    offset = point_world[:, None] - centre_world
    square = np.sum(offset**2, axis=2) + softening**2
    tensor = 3.0 * offset[..., :, None] * offset[..., None, :] - square[..., None, None] * np.eye(3)
    return np.asarray(tensor / (4.0 * np.pi * square**2.5)[..., None, None])


def _modes(tensors: Array, at_place: AnyArray, moment: AnyArray, count: int) -> Array:
    """Return the amplitudes of each voxel in the strongest modes of distortion, (v, k, modes).

    `tensors` (n, v, 3, 3): field of a unit moment of each voxel at places.
    `at_place` (n, tones, 3): the beacons' fields there. `moment` (v, tones, 3, k): of each voxel,
    by a sigma of each of its k independent amplitudes.
    """
    size = np.linalg.norm(at_place, axis=2)[..., None]
    (count_places, tones), (voxels, _, _, columns) = at_place.shape[:2], moment.shape
    parts = (np.real, np.imag) if np.iscomplexobj(moment) else (np.real,)
    # The largest array of a running estimate, of which there are no copies.
    relative = np.empty((len(parts), count_places, tones, 3, voxels, columns))
    for tone in range(tones):
        own = np.swapaxes(tensors @ moment[:, tone] / size[:, [tone], None], 1, 2)
        for k, part in enumerate(parts):
            relative[k, :, tone] = part(own)
    flat = relative.reshape(-1, voxels * columns)
    unit = float(np.linalg.norm(flat) / np.sqrt(size.size))
    last = len(flat) - 1
    value, vector = eigh(flat @ flat.T, subset_by_index=(max(last + 1 - count, 0), last))
    kept = np.flatnonzero(value > 1e-9 * value[-1])[::-1]
    amplitude = flat.T @ (vector[:, kept] / np.sqrt(value[kept]))
    return np.asarray(amplitude.reshape(len(moment), moment.shape[3], -1) / unit)
