"""Inertial data between field epochs: cut, averaged and preintegrated."""

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from scipy.ndimage import uniform_filter1d

from magfusion.model.platform_motion import HeldModel
from magfusion.model.quaternion import cross
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import interpolated
from magfusion.units import Array, BoolArray, IntArray

# Possible motion in a gap of the IMU: that of a person or a vehicle.
BRIDGE_GYRO_NOISE = 1.0  # rad/s/sqrt(Hz)
BRIDGE_ACCEL_NOISE = 3.0  # m/s^2/sqrt(Hz)
RATE_SPAN = 0.08  # s; motion is slower, noise is not
MIN_HELD_RATE = 1e-4  # rad/s, and that per root s, about a fixed axis: no motion, but regular
MIN_STEP = 1e-9  # s; the rounding of a time stamp, and no step
GAP_SAMPLES = 5.0  # a gap is this many times the usual sampling interval
# s; a bias that walks by `white noise / MAX_WHITE` adds a third of the noise's variance to an
# attitude or a velocity after this time. A slower one would tie states to the last digit.
MAX_WHITE = 300.0


@dataclass(frozen=True, eq=False)
class Increments:
    """Mean rate and specific force over short steps, cut at the epochs."""

    gyro_body: Array  # (steps, 3) (rad/s)
    accel_body: Array  # (steps, 3) (m/s^2)
    dt: Array  # (steps,) (s)
    first: IntArray  # (epochs,), first step after each epoch
    gap_bridged: BoolArray  # (epochs - 1,), intervals in which the stream has a gap


def cut_at_epochs(
    imu: ImuSamples, time_offset: float, epochs: Array, usual: float | None = None
) -> Increments:
    """Cut the inertial stream into steps that never straddle an epoch.

    `time_offset`: added to its stamps to bring them to the log's clock (s). `epochs` (n,) (s);
    outside the stream its end values are extended. `usual`: sampling interval (s); the median by
    default, which a part inside a gap does not have.
    """
    time = imu.time + time_offset
    known = float(np.median(np.diff(time))) if usual is None else usual
    edges, gap = _gaps(time, epochs, known)
    if len(epochs) == 2 and not gap.any() and (time[1:] > time[:-1]).all():
        return _one_interval(imu, time, epochs)
        # One long step would tie the position to the velocity: its noise would be singular.
    stamps = _filled(time, edges, np.flatnonzero(gap), epochs, known)
    inside = (stamps > epochs[0]) & (stamps < epochs[-1])
    grid = np.sort(np.concatenate([stamps[inside], epochs]))
    new = np.empty(len(grid), dtype=bool)
    new[0] = True
    np.not_equal(grid[1:], grid[:-1], out=new[1:])
    grid = grid[new]
    mean = step_means(grid, interpolated(grid, time, _curvature_corrected(imu)))
    first = np.searchsorted(grid, epochs)
    gap_bridged = np.zeros(len(epochs) - 1, dtype=bool)
    if gap.any():
        silent = np.flatnonzero(in_gap(time, grid, known))
        gap_bridged[np.searchsorted(first, silent, side="right") - 1] = True
    return Increments(
        mean[:, :3].copy(), mean[:, 3:].copy(), grid[1:] - grid[:-1], first, gap_bridged
    )


def _one_interval(imu: ImuSamples, time: Array, epochs: Array) -> Increments:
    """Return the steps between two epochs as online, without resampling."""
    rows = slice(time.searchsorted(epochs[0], side="right"), time.searchsorted(epochs[1]))
    both = _curvature_corrected(imu)
    begin, end = interpolated(epochs, time, both)
    both = np.concatenate([begin[None], both[rows], end[None]])
    grid = np.concatenate([epochs[:1], time[rows], epochs[1:]])
    mean = step_means(grid, both)
    return Increments(
        mean[:, :3].copy(),
        mean[:, 3:].copy(),
        grid[1:] - grid[:-1],
        np.array([0, len(mean)]),
        np.zeros(1, dtype=bool),
    )


def _curvature_corrected(imu: ImuSamples) -> Array:
    """Return rate and specific force, shape (n, 6), so that trapezoids integrate cubics.

    A trapezoid exceeds the integral by a twelfth of the mean second difference at its samples.
    """
    both = np.concatenate([imu.gyro_body, imu.accel_body], axis=1)
    if len(both) < 3:
        return both
    step = np.maximum(np.diff(imu.time), MIN_STEP)[:, None]
    before, after = step[:-1], step[1:]
    # The smaller step squared: a gap, or a stamp that is early, does not enlarge it.
    curved = np.diff(np.diff(both, axis=0) / step, axis=0) / (6.0 * (before + after))
    curved *= np.minimum(before, after) ** 2
    both[1:-1] -= curved
    both[0] -= curved[0]
    both[-1] -= curved[-1]
    return both


def step_means(grid: Array, both: Array) -> Array:
    """Return the rate and specific force of steps, with second-order coning and sculling.

    Constant over a step, they turn and accelerate the body as those that change linearly.
    `grid` (n,) (s). `both` (n, 6): rate (rad/s) and specific force (m/s^2) at these times, body
    axes. Returns (n - 1, 6).
    """
    before, after = both[:-1].T, both[1:].T
    mean = 0.5 * (before + after)
    twelfth = (grid[1:] - grid[:-1]) / 12.0
    mean[:3] += twelfth * cross(before[:3], after[:3])
    mean[3:] += twelfth * (cross(before[:3], after[3:]) - cross(after[:3], before[3:]))
    return np.asarray(mean.T)


def _gaps(time: Array, reach: Array, usual: float) -> tuple[Array, BoolArray]:
    """Return the stamps with the ends of ``reach`` added, and which steps between them are gaps."""
    edges = np.concatenate([[min(time[0], reach[0])], time, [max(time[-1], reach[-1])]])
    return edges, edges[1:] - edges[:-1] > GAP_SAMPLES * usual


def in_gap(time: Array, grid: Array, usual: float) -> BoolArray:
    """Return which steps of the grid are in a gap of the stream, however short the step is."""
    edges, gap = _gaps(time, grid, usual)
    return np.asarray(gap[np.searchsorted(edges[1:-1], grid[:-1], side="right")])


def _filled(time: Array, edges: Array, gaps: IntArray, epochs: Array, usual: float) -> Array:
    """Return the stamps with others that fill gaps of the stream, within the epochs."""
    if not len(gaps):
        return time
    filled = [time]
    for k in gaps:
        begin, end = max(edges[k], epochs[0]), min(edges[k + 1], epochs[-1])
        if end > begin:
            filled.append(np.linspace(begin, end, int((end - begin) / usual) + 2)[1:-1])
    return np.concatenate(filled)


def bias_walks(imu: ImuModel) -> tuple[float, float]:
    """Return the walks of both biases, gyro first, as large as regular factors need.

    Returns (rad/s/sqrt(s), m/s^2/sqrt(s)).
    """
    return (
        max(imu.gyro_bias_walk, imu.gyro_noise / MAX_WHITE),
        max(imu.accel_bias_walk, imu.accel_noise / MAX_WHITE),
    )


def across_held(cov: Array, imu: ImuModel) -> Array:
    """Return the covariance of a gyro's bias, (3, 3), without that about the fixed axis."""
    if not isinstance(imu, HeldModel):
        return cov
    axis = np.array(imu.held_axis)
    across = np.eye(3) - np.outer(axis, axis)
    return np.asarray(across @ cov @ across + MIN_HELD_RATE**2 * np.outer(axis, axis))


@lru_cache(maxsize=8)
def preintegration_parameters(
    imu: ImuModel, gravity: float, *, bridge: bool
) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's noise of an inertial stream; ``bridge`` for a stretch without samples."""
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
    gyro = max(imu.gyro_noise, BRIDGE_GYRO_NOISE) if bridge else imu.gyro_noise
    accel = max(imu.accel_noise, BRIDGE_ACCEL_NOISE) if bridge else imu.accel_noise
    parameters.setGyroscopeCovariance(gyro**2 * np.eye(3))
    parameters.setAccelerometerCovariance(accel**2 * np.eye(3))
    parameters.setIntegrationCovariance(1e-12 * np.eye(3))
    gyro_walk, accel_walk = bias_walks(imu)
    parameters.setBiasOmegaCovariance(across_held(gyro_walk**2 * np.eye(3), imu))
    parameters.setBiasAccCovariance(accel_walk**2 * np.eye(3))
    return parameters


def preintegrate(
    increments: Increments, imu: ImuModel, gravity: float, accel_bias: Array, gyro_bias: Array
) -> list[gtsam.PreintegratedCombinedMeasurementsG]:
    """Preintegrate every interval between two epochs on the Galilean group.

    GTSAM's default class is first-order on the rotation vector and breaks at one full turn.
    `gravity` (m/s^2). `accel_bias`, `gyro_bias` (epochs, 3): at which to linearise (m/s^2, rad/s).
    Returned one for each interval.
    """
    usual = preintegration_parameters(imu, gravity, bridge=False)
    wide = preintegration_parameters(imu, gravity, bridge=True)
    gyro, accel, dt = increments.gyro_body, increments.accel_body, increments.dt.tolist()
    out = []
    for i, (lo, hi) in enumerate(
        zip(increments.first[:-1].tolist(), increments.first[1:].tolist(), strict=True)
    ):
        bias = gtsam.imuBias.ConstantBias(accel_bias[i], gyro_bias[i])
        measurement = gtsam.PreintegratedCombinedMeasurementsG(
            wide if increments.gap_bridged[i] else usual, bias
        )
        steps = accel[lo:hi], gyro[lo:hi], dt[lo:hi]
        # A loop in Python over the samples takes longer.
        deque(map(measurement.integrateMeasurement, *steps), maxlen=0)
        out.append(measurement)
    return out


def low_passed(imu: ImuSamples) -> ImuSamples:
    """Return the stream averaged over `RATE_SPAN`, to differentiate measurements by the rate.

    White noise in a derivative would appear as information on the time offset.
    """
    size = 2 * low_pass_reach(_usual(imu)) + 1
    gyro, accel = (
        uniform_filter1d(stream, size, axis=0, mode="nearest")
        for stream in (imu.gyro_body, imu.accel_body)
    )
    return ImuSamples(imu.time, gyro, accel)


def low_passed_rate_at(imu: ImuSamples, time_offset: float, wanted: Array) -> Array:
    """Return the rates of `inertial_at`, shape (m, 3) (rad/s)."""
    return _low_passed_at(imu, imu.gyro_body, time_offset, wanted)


def inertial_at(imu: ImuSamples, time_offset: float, wanted: Array) -> Array:
    """Return `low_passed` samples at some times, without averaging the whole stream.

    `time_offset` (s). `wanted` (m,) (s); outside the stream its end values are extended. Returns
    (m, 6): rate and specific force (rad/s, m/s^2).
    """
    both = np.hstack([imu.gyro_body, imu.accel_body])
    return _low_passed_at(imu, both, time_offset, wanted)


def _low_passed_at(imu: ImuSamples, rows: Array, time_offset: float, wanted: Array) -> Array:
    last, reach = len(imu) - 1, low_pass_reach(_usual(imu))
    before = np.clip(np.searchsorted(imu.time, wanted - time_offset) - 1, 0, max(last - 1, 0))
    after = np.minimum(before + 1, last)
    ends = np.zeros((2, len(wanted), rows.shape[1]))
    for k in range(-reach, reach + 1):
        ends += rows[np.clip(np.stack([before, after]) + k, 0, last)]
    span = np.maximum(imu.time[after] - imu.time[before], np.finfo(float).tiny)
    share = np.clip((wanted - time_offset - imu.time[before]) / span, 0.0, 1.0)[:, None]
    return np.asarray(((1.0 - share) * ends[0] + share * ends[1]) / (2 * reach + 1))


def low_pass_reach(usual: float) -> int:
    """Return the half width, in samples ``usual`` apart (s), of the average of `low_passed`."""
    return int(0.5 * RATE_SPAN / usual)


def _usual(imu: ImuSamples) -> float:
    return float(np.median(np.diff(imu.time)))
