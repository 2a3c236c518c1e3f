"""Number of epochs that share a model error, within the correlation length of the iron's field.

Iron is constant in place, so that its error does not average over epochs at one position, nor over
visits to it.  An error of correlation exp(-d / length) leaves N epochs the information of N / A
independent ones, where A is the sum of an epoch's correlations with all; each is weighted so.

Online only the epochs in the estimator's memory count.  With an IMU those are all.  With a motion
prior, at steady state an epoch has a gain of sqrt(2) w times its step, where
w^4 = q^2 / (R step), of white acceleration of density q and errors of variance R (P. R. Kalata,
IEEE Transactions on Aerospace and Electronic Systems 20, 1984, for small steps).  For an error
shared by A epochs the covariance is correct if errors of variance A R have a gain of 1 / A.
"""

import numpy as np

from magfusion.estimation.graph.state import State
from magfusion.model.noise import model_error
from magfusion.model.site import Site
from magfusion.units import Array, IntArray

MAX_REST = 20.0  # s; online, no more is shared: the state has moved on
CELLS = 4.0  # per length, in which epochs are counted together
CHUNK = 1_000_000  # pairs at a time


def epochs_sharing_error(position_world: Array, length: float) -> Array:
    """Return how many epochs of a log share the model error of each, shape (n,).

    `position_world` (n, 3) (m). `length`: correlation length (m).
    """
    count = len(position_world)
    if length <= 0.0:
        return np.ones(count)
    _, members, centre = cells(position_world, length)
    shared, step = np.empty(count), max(1, CHUNK // len(centre))
    for lo in range(0, count, step):
        separate = position_world[lo : lo + step, None] - centre
        shared[lo : lo + step] = np.exp(-np.linalg.norm(separate, axis=2) / length) @ members
    return np.maximum(shared, 1.0)


def cells(position_world: Array, length: float) -> tuple[IntArray, IntArray, Array]:
    """Return the spatial cell of each position, the number in each, and their centres.

    `position_world` (n, 3) (m). `length`: correlation length (m). Returns `owner` (n,);
    `members` (cells,); `centre` (cells, 3).
    """
    cell = np.floor(position_world * (CELLS / length)).astype(np.int64)
    _, owner, members = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    owner = owner.ravel()
    total = np.stack([np.bincount(owner, weights=axis) for axis in position_world.T], axis=1)
    return owner, members, total / members[:, None]


def epochs_sharing_error_online(speed: float, step: float, length: float) -> float:
    """Return the approximate number of epochs that share a model error, at a steady speed.

    `speed` (m/s). `step`: time between epochs (s). `length`: correlation length (m).
    """
    if length <= 0.0:
        return 1.0
    moved = max(speed * step / length, 2.0 * step / MAX_REST)
    return float(1.0 / np.tanh(0.5 * moved))


def epochs_sharing_error_at(state: State, step: float) -> float:
    """Return the number of epochs in the estimator's memory that share a model error.

    `state`: predicted at the epoch. `step`: time between epochs (s).
    """
    site, speed = state.calibration.site, float(np.linalg.norm(state.velocity_world))
    shared = epochs_sharing_error_online(speed, step, site.model_error_length)
    if site.platform.replaced is None or shared == 1.0 or step <= 0.0:
        return shared
    return min(shared, held_by_prior(site, state.position_world, step))


def held_by_prior(site: Site, position_world: Array, step: float) -> float:
    """Return the number of epochs in the memory of a motion prior, at least one.

    `site`: from `magfusion.model.without_imu.on_motion_prior`. `position_world` (3,) (m). `step`:
    time between epochs (s).
    """
    separate = np.array([beacon.position_world for beacon in site.beacons]) - position_world
    relative = float(np.max(model_error(site)))
    # A relative field error rotates it by at most as many radians, and shifts by that share.
    turn, shift = relative, relative * float(np.max(np.linalg.norm(separate, axis=1)))
    imu = site.platform.imu
    pairs = ((turn, imu.gyro_bias_walk), (shift, imu.accel_noise))
    fixed = [np.cbrt((error / density) ** 2 / (4.0 * step**3)) for error, density in pairs]
    return float(max(1.0, *fixed))
