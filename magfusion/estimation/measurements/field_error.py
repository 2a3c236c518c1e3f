"""Field error by iron, constant in place, as considered parameters.

A relative error of correlation exp(-d / length) is, over the positions of a log, a sum of a few
modes (Karhunen and Loeve), each of unit variance in amplitude.  An estimate that weights epochs
by the white part of their errors keeps their relative information.  The effect of the amplitudes is
added to its covariance (a consider covariance), so that a hundred epochs at one position do not
count as a hundred independent measurements of it.
"""

import numpy as np

from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.measurements.model_error import cells
from magfusion.model.noise import model_error, sensor_positions
from magfusion.model.parameters import BeaconParameter, Block, placed
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, ComplexArray

SHARE = 0.97  # of the variance, contained in the modes; the rest is in the white part
COLUMNS = 288  # of all beacons
MATRIX = 9  # elements
AT_ONCE = 5e8  # bytes of their Jacobian, in a long log
MOST_CELLS = 1000


class FieldError(BeaconParameter):
    """Amplitudes of the modes of one beacon's error: by mode, row and column of a matrix.

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
    """

    group = kind = "field_error"

    def __init__(
        self, time: Array, modes: Array, relative: Array, sensor_from_world: Array
    ) -> None:
        self._time, self._modes = time, modes
        self._relative, self._sensor_from_world = relative, sensor_from_world

    @property
    def columns(self) -> int:
        """Number of amplitudes."""
        return int(MATRIX * self._modes.shape[2])

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        """Return the columns of the owner's phasors."""
        time = view.calibration.reference_time + view.elapsed
        at = np.searchsorted(self._time, time - SAME_TIME), view.sensor
        turn, size = self._sensor_from_world[at], self._relative[at] / np.sqrt(3.0)
        field_world = np.einsum("nak,nta->ntk", turn, view.phasor)
        bent = np.einsum("nt,nm,naj,ntk->ntamjk", size, self._modes[at], turn, field_world)
        return bent.reshape(*view.phasor.shape, -1)


def field_errors(site: Site, time: Array, poses: Trajectory) -> tuple[Block, ...]:
    """Return the errors of the beacons' fields at some epochs, to be considered.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Of the fields (s).
    poses : Trajectory
        Poses at these times.
    """
    length, channels = site.model_error_length, len(site.channels)
    if length <= 0.0 or not len(time):
        return ()
    place = sensor_positions(site, poses)
    sensors = site.platform.magnetometers
    relative = model_error(site, place) + np.zeros((len(time), channels))
    relative = relative.reshape(len(time), len(sensors), -1)
    maximum = min(COLUMNS, int(AT_ONCE / (48.0 * channels * len(time))))
    maximum //= MATRIX * len(site.beacons)
    modes = modes_in_place(place.reshape(-1, 3), length, max(maximum, 1))
    modes = modes.reshape(len(time), len(sensors), -1)
    sensor_from_world = np.stack(
        [np.swapaxes(poses.world_from_body @ s.body_from_sensor, 1, 2) for s in sensors], axis=1
    )
    out, start = [], 0
    for beacon in site.beacons:
        own = relative[..., start : start + len(beacon.tones)]
        start += len(beacon.tones)
        if np.any(own > 0.0):
            error = FieldError(time, modes, own, sensor_from_world)
            out.append(Block(error, beacon.name, slice(0), np.ones(error.columns)))
    return placed(out)


def modes_in_place(position_world: Array, length: float, maximum: int) -> Array:
    """Return the modes of an error of correlation exp(-d / length) at positions, shape (n, m).

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        (m)
    length : float
        (m)
    maximum : int
        Maximum number of modes.
    """
    size, (owner, members, centre) = 1.0, cells(position_world, length)
    while len(centre) > MOST_CELLS:
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
