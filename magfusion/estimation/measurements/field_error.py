"""Field error by iron, constant in place, as considered parameters.

A relative error of correlation exp(-d / length) is, over the positions of a log, a sum of a few
modes (Karhunen and Loeve), each of unit variance in amplitude.  An estimate that weights epochs
by the white part of their errors keeps their relative information.  The effect of the amplitudes is
added to its covariance (a consider covariance), so that a hundred epochs at one position do not
count as a hundred independent measurements of it.

Only the product of the error's matrix and the field is measured: of the modes of all elements,
the combinations that bend the fields of the log most are considered, one set for each component of
the error.  Those with less variance than an error that is independent at each epoch are part of
the white noise.
"""

import numpy as np

from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.measurements.model_error import cells
from magfusion.model.field import predict
from magfusion.model.noise import model_error, sensor_positions
from magfusion.model.parameters import BeaconParameter, Block, placed
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, ComplexArray

SHARE = 0.97  # of the variance, contained in the modes; the rest is in the white part
COLUMNS = 576  # of all beacons
SPATIAL = 48  # modes of place, of which combinations are selected
EPOCHS = 1000  # by which they are selected
AXES = 3
AT_ONCE = 5e8  # bytes of their Jacobian, in a long log
MAX_CELLS = 1000


class FieldError(BeaconParameter):
    """Amplitudes of one beacon's error: by component of it in world axes, and combination of modes.

    Iron responds to a field linearly, so that it adds a position-dependent matrix times the
    beacon's field, equal for all its tones and in phase with each.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Of the epochs affected (s).
    modes : ndarray, shape (n, magnetometers, m)
        With unit variance in total.
    relative : ndarray, shape (n, magnetometers, tones)
        Magnitude of the error, relative to the field.
    sensor_from_world : ndarray, shape (n, magnetometers, 3, 3)
    combine : ndarray, shape (m, 3, k)
        Orthonormal combinations of mode and component of the field, world axes.
    """

    group = kind = "field_error"

    def __init__(
        self, time: Array, modes: Array, relative: Array, sensor_from_world: Array, combine: Array
    ) -> None:
        self._time, self._modes, self._combine = time, modes, combine
        self._relative, self._sensor_from_world = relative, sensor_from_world

    @property
    def columns(self) -> int:
        """Number of amplitudes."""
        return AXES * self._combine.shape[2]

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        """Return the columns of the owner's phasors."""
        time = view.calibration.reference_time + view.elapsed
        at = np.searchsorted(self._time, time - SAME_TIME), view.sensor
        turn, size = self._sensor_from_world[at], self._relative[at] / np.sqrt(AXES)
        field_world = np.einsum("nak,nta->ntk", turn, view.phasor)
        along = np.tensordot(self._modes[at], self._combine, 1)  # (n, 3, k)
        bent = np.einsum("nt,nak,ntj,njc->ntakc", size, turn, field_world, along, optimize=True)
        return bent.reshape(*view.phasor.shape, -1)


def field_errors(site: Site, time: Array, poses: Trajectory) -> tuple[Block, ...]:
    """Return the errors of the beacons' fields at some epochs, to be considered.

    `time` (n,): of the fields (s). `poses`: poses at these times.
    """
    length, channels = site.model_error_length, len(site.channels)
    if length <= 0.0 or not len(time):
        return ()
    place = sensor_positions(site, poses)
    sensors = site.platform.magnetometers
    relative = model_error(site, place) + np.zeros((len(time), channels))
    relative = relative.reshape(len(time), len(sensors), -1)
    maximum = min(COLUMNS, int(AT_ONCE / (48.0 * channels * len(time))))
    maximum = max(maximum // (AXES * len(site.beacons)), 1)
    modes = modes_in_place(place.reshape(-1, 3), length, SPATIAL)
    modes = modes.reshape(len(time), len(sensors), -1)
    sensor_from_world = np.stack(
        [np.swapaxes(poses.world_from_body @ s.body_from_sensor, 1, 2) for s in sensors], axis=1
    )
    step = 1 + len(time) // EPOCHS
    out, start, some = [], 0, slice(None, None, step)
    rotation, position = poses.world_from_body[some], poses.position_world[some]
    for beacon in site.beacons:
        own = relative[..., start : start + len(beacon.tones)]
        start += len(beacon.tones)
        if not np.any(own > 0.0):
            continue
        field = np.stack([predict(beacon, s, rotation, position) for s in sensors], axis=1)
        field_world = np.einsum("nsak,nsta->nstk", sensor_from_world[some], field)
        combine = largest_combinations(np.sqrt(step) * modes[some], field_world, maximum)
        error = FieldError(time, modes, own, sensor_from_world, combine)
        out.append(Block(error, beacon.name, slice(0), np.ones(error.columns)))
    return placed(out)


def largest_combinations(modes: Array, field_world: ComplexArray, maximum: int) -> Array:
    """Return the combinations of modes and components of a field that bend it most, (m, 3, k).

    All whose variance is larger than that of an independent error at each epoch, at least one.
    `modes` (n, magnetometers, m), `field_world` (n, magnetometers, tones, 3) (T). `maximum`:
    maximum number k.
    """
    power = 0.5 * np.sum(np.abs(field_world) ** 2, axis=-1, keepdims=True)
    unit = field_world / np.sqrt(np.maximum(power, np.finfo(float).tiny))
    parts = np.stack([unit.real, unit.imag], axis=-2)
    bent = np.einsum("nsm,nstqj->nstqmj", modes, parts)
    flat = bent.reshape(-1, modes.shape[2] * AXES)
    value, vector = np.linalg.eigh(flat.T @ flat)
    kept = max(1, min(maximum, int(np.sum(value > 1.0))))
    return np.asarray(vector[:, ::-1][:, :kept].reshape(-1, AXES, kept))


def modes_in_place(position_world: Array, length: float, maximum: int) -> Array:
    """Return the modes of an error of correlation exp(-d / length) at positions, shape (n, m).

    `position_world` (n, 3) (m), `length` (m). `maximum`: maximum number of modes.
    """
    size, (owner, members, centre) = 1.0, cells(position_world, length)
    while len(centre) > MAX_CELLS:
        size *= 2.0
        owner, members, centre = cells(position_world, size * length)
    separate = np.linalg.norm(centre[:, None] - centre, axis=2)
    weight = np.sqrt(members)
    value, vector = np.linalg.eigh(weight[:, None] * np.exp(-separate / length) * weight)
    value, vector = value[::-1], vector[:, ::-1]
    enough = int(np.searchsorted(np.cumsum(value), SHARE * np.sum(value))) + 1
    kept = min(enough, maximum)
    shape = vector[:, :kept] * np.sqrt(np.maximum(value[:kept], 0.0)) / weight[:, None]
    return np.asarray(shape[owner])
