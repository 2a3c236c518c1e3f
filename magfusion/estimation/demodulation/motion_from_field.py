"""Motion in a gap of the IMU, from single samples of the magnetometer.

A window of the lock-in is long compared with a fast turn: without the gyro the Earth field leaks
into every tone.  But each sample contains the Earth field, whose direction gives two angles at
once, and the tones, which give the third and the position.  A filter over the samples, from the
last known state, and back again (Rauch, Tung and Striebel), tracks a turn of several radians a
second.
Where gyro samples exist, before and after a gap, the filter uses their rates: a short gap is as
good as interpolated.  The estimate replaces inertial samples as the shape of the motion only, with
the noise of a gap.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import MOTION, State
from magfusion.model.field import observe_earth
from magfusion.model.parameters import Calibration, linearize_channels
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

TURN_NOISE = 20.0  # rad/s^2/sqrt(Hz); of a hand that turns as fast as it can
PUSH_NOISE = 10.0  # m/s^2/sqrt(Hz); likewise
FASTEST_TURN = 5.0  # rad/s; one sigma of the initial rate
STEADY_ERROR = 3e-4  # of the static field: vibration, which no path follows
FIELD_ERROR = 1e-2  # of the beacons' fields: iron, and the calibration
FIRST_STEADY = 1e-6  # T; error of the static field in the first sample
GYRO_ERROR = 0.05  # rad/s; of a rate between two samples of a gyro: vibration
WORST_MISFIT = 5.0  # mean squared innovation, in units of its expectation
MIN_SAMPLES = 8  # samples
TURN, PLACE, SPEED, RATE, STEADY = (slice(3 * k, 3 * k + 3) for k in range(5))


@dataclass(frozen=True, eq=False)
class _Motion:
    world_from_body: Array
    position_world: Array
    velocity_world: Array
    rate_body: Array
    static_world: Array
    cov: Array  # (15, 15): rotation and position in body axes, as of a pose

    def moved(self, step: Array, cov: Array) -> "_Motion":
        turn = Rotation.from_rotvec(step[TURN]).as_matrix()
        return _Motion(
            self.world_from_body @ turn,
            self.position_world + self.world_from_body @ step[PLACE],
            self.velocity_world + step[SPEED],
            self.rate_body + step[RATE],
            self.static_world + step[STEADY],
            cov,
        )

    def step_to(self, other: "_Motion") -> Array:
        """Return the step from this motion to another: the inverse of `moved`."""
        back = self.world_from_body.T
        return np.concatenate(
            [
                Rotation.from_matrix(back @ other.world_from_body).as_rotvec(),
                back @ (other.position_world - self.position_world),
                other.velocity_world - self.velocity_world,
                other.rate_body - self.rate_body,
                other.static_world - self.static_world,
            ]
        )

    def after(self, elapsed: float) -> tuple["_Motion", Array]:
        """Return the motion after an interval, and the transition."""
        turn = Rotation.from_rotvec(elapsed * self.rate_body).as_matrix()
        by = np.eye(MOTION)
        by[TURN, TURN] = by[PLACE, PLACE] = turn.T
        by[TURN, RATE] = elapsed * np.eye(3)
        later = self.world_from_body @ turn
        by[PLACE, SPEED] = elapsed * later.T
        noise = np.zeros(MOTION)
        noise[RATE], noise[SPEED] = TURN_NOISE**2 * elapsed, PUSH_NOISE**2 * elapsed
        moved = replace(
            self,
            world_from_body=later,
            position_world=self.position_world + elapsed * self.velocity_world,
            cov=by @ self.cov @ by.T + np.diag(noise),
        )
        return moved, by


@dataclass(frozen=True, eq=False)
class FieldMotion:
    """Motion of the platform from the field."""

    # equivalent IMU samples, at the times of the magnetometer's samples on the log's clock, with
    # the biases of the initial state
    imu: ImuSamples
    path: Trajectory  # poses and velocities at the same times


def motion_from_field(
    state: State, waveform: Waveform, imu: ImuSamples | None = None, longest_step: float = 0.0
) -> FieldMotion | None:
    """Return the motion of the platform from magnetometer samples; None where undetermined.

    Parameters
    ----------
    state : State
        At or before the first sample.
    waveform : Waveform
        Following samples.
    imu : ImuSamples, optional
        Available samples of the same interval, on the log's clock.
    longest_step : float
        Between two inertial samples (s); a longer one is a gap.
    """
    time, calibration = waveform.time, state.calibration
    if len(time) < MIN_SAMPLES:
        return None
    motion, before, misfit = _begin(state, waveform), state.time, []
    result: list[_Motion] = []
    predictions: list[tuple[_Motion, Array]] = []
    rates = _rates_at(time, imu, longest_step) - state.gyro_bias_body
    for now, measured, rate in zip(time.tolist(), waveform.measured_sensor, rates, strict=True):
        predictions.append(motion.after(now - before))
        motion, square = _updated(predictions[-1][0], calibration, now, measured)
        if np.isfinite(rate[0]):
            motion = _turning(motion, rate)
        result.append(motion)
        misfit.append(square)
        before = now
    if not np.mean(misfit[len(misfit) // 2 :]) < WORST_MISFIT:
        return None
    for k in range(len(result) - 2, -1, -1):
        ahead, by = predictions[k + 1]
        gain = np.linalg.solve(ahead.cov, by @ result[k].cov).T
        result[k] = result[k].moved(gain @ ahead.step_to(result[k + 1]), result[k].cov)
    velocity = np.stack([one.velocity_world for one in result])
    force = np.gradient(velocity, time, axis=0) + np.array([0.0, 0.0, calibration.site.gravity])
    rotated = np.stack([one.world_from_body for one in result])
    rate = np.stack([one.rate_body for one in result])
    accel = (np.swapaxes(rotated, 1, 2) @ force[..., None])[..., 0]
    place = np.stack([one.position_world for one in result])
    return FieldMotion(
        ImuSamples(time, rate + state.gyro_bias_body, accel + state.accel_bias_body),
        Trajectory(time, rotated, place, velocity),
    )


def _rates_at(time: Array, imu: ImuSamples | None, longest_step: float) -> Array:
    """Return the gyro's rates at some times, shape (n, 3); NaN in gaps (rad/s)."""
    if imu is None or len(imu) == 0:
        return np.full((len(time), 3), np.nan)
    step = np.concatenate([[np.inf], np.diff(imu.time), [np.inf]])
    span = step[np.searchsorted(imu.time, time)]
    rates = np.stack([np.interp(time, imu.time, axis) for axis in imu.gyro_body.T], axis=1)
    return np.asarray(np.where(span[:, None] <= longest_step, rates, np.nan))


def _turning(motion: _Motion, rate: Array) -> _Motion:
    """Return a motion with a measured rate (rad/s)."""
    spread = motion.cov[RATE, RATE] + GYRO_ERROR**2 * np.eye(3)
    gain = np.linalg.solve(spread, motion.cov[RATE]).T
    remaining = np.eye(MOTION)
    remaining[:, RATE] -= gain
    cov = remaining @ motion.cov @ remaining.T + GYRO_ERROR**2 * gain @ gain.T
    return motion.moved(gain @ (rate - motion.rate_body), cov)


def _begin(state: State, waveform: Waveform) -> _Motion:
    sensor = state.calibration.site.platform.magnetometer
    value, _, _ = _predicted(
        state.calibration, state.time, state.world_from_body, state.position_world
    )
    tones = np.zeros(3) if waveform.time[0] - state.time > 0.0 else value
    field = np.linalg.solve(sensor.matrix, waveform.measured_sensor[0] - tones - sensor.offset)
    cov = np.zeros((MOTION, MOTION))
    cov[:9, :9] = state.cov[:9, :9]
    cov[RATE, RATE] = FASTEST_TURN**2 * np.eye(3)
    cov[STEADY, STEADY] = FIRST_STEADY**2 * np.eye(3)
    return _Motion(
        state.world_from_body,
        state.position_world,
        state.velocity_world,
        np.zeros(3),
        state.world_from_body @ sensor.body_from_sensor @ field,
        cov,
    )


def _predicted(
    calibration: Calibration, time: float, world_from_body: Array, position_world: Array
) -> tuple[Array, Array, float]:
    """Return the beacons' field in a sample, its derivative by the pose, and its size (T)."""
    at = np.array([time])
    value, by_pose, _ = linearize_channels(
        calibration, (), at, world_from_body[None], position_world[None]
    )
    frequencies = calibration.site.tone_frequencies_hz
    angle = 2.0 * np.pi * frequencies * time
    carrier = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    parts = value[0].reshape(-1, 2, 3), by_pose[0].reshape(-1, 2, 3, 6)
    size = float(np.sqrt(np.sum(value**2)))
    field, by_field = (np.einsum("ck,ck...->...", carrier, part) for part in parts)
    return np.asarray(field), np.asarray(by_field), size


def _updated(
    motion: _Motion, calibration: Calibration, time: float, measured: Array
) -> tuple[_Motion, float]:
    sensor = calibration.site.platform.magnetometer
    pose = motion.world_from_body, motion.position_world
    tones, by_pose, size = _predicted(calibration, time, *pose)
    static = observe_earth(sensor, motion.world_from_body, motion.static_world)
    by = np.zeros((3, MOTION))
    by[:, :6] = by_pose
    by[:, TURN] += static.platform_rotation
    by[:, STEADY] = static.earth_world
    error = measured - tones - static.measured_sensor
    sigma = np.hypot(STEADY_ERROR * np.linalg.norm(motion.static_world), FIELD_ERROR * size)
    across = by @ motion.cov
    spread = across @ by.T + sigma**2 * np.eye(3)
    gain = np.linalg.solve(spread, across).T
    square = float(error @ np.linalg.solve(spread, error)) / 3.0
    remaining = np.eye(MOTION) - gain @ by
    cov = remaining @ motion.cov @ remaining.T + sigma**2 * gain @ gain.T
    return motion.moved(gain @ error, cov), square
