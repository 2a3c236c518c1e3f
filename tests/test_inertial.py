"""Between the epochs: preintegration and the IMU's shape against the simulator's exact motion."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.demodulation.motion_shape import motion_at
from magfusion.estimation.graph.preintegration import (
    cut_at_epochs,
    low_passed,
    low_passed_rate_at,
    preintegrate,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import Rests, SimulatedMotion, turning_motion

GRAVITY = 9.81
DURATION = 40.0  # s
BOX_WORLD = np.array([[1.2, 1.2, 0.6], [4.8, 3.8, 1.6]])
SILENT = ImuModel(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
MEMS = ImuModel(3e-4, 3e-3, 1e-5, 1e-4, 5e-3, 0.05)
GYRO_BIAS = np.array([0.01, -0.02, 0.03])
ACCEL_BIAS = np.array([0.1, 0.2, -0.3])


def moving(seed: int, rate_rms: float = 1.5, interval: float = 1.0) -> SimulatedMotion:
    rests = Rests(start=0.0, move=DURATION, pause=0.0)
    rng = np.random.default_rng(seed)
    return turning_motion(
        rng, DURATION, BOX_WORLD, rate_rms=rate_rms, rests=rests, interval=interval
    )


def recorded(
    motion: SimulatedMotion, time_offset: float = 0.0, rate_hz: float = 200.0
) -> ImuSamples:
    rng = np.random.default_rng(0)
    return simulate_imu(motion, SILENT, GRAVITY, rate_hz, DURATION, rng, time_offset).samples


def biased(imu: ImuSamples) -> ImuSamples:
    return ImuSamples(imu.time, imu.gyro_body + GYRO_BIAS, imu.accel_body + ACCEL_BIAS)


def with_biases(states: Trajectory, gyro: np.ndarray, accel: np.ndarray) -> Trajectory:
    shape = (len(states), 3)
    return replace(
        states,
        gyro_bias_body=np.broadcast_to(gyro, shape).copy(),
        accel_bias_body=np.broadcast_to(accel, shape).copy(),
    )


def prediction_errors(
    motion: SimulatedMotion, imu: ImuSamples, time_offset: float, epochs: np.ndarray
) -> np.ndarray:
    """Largest error of attitude (rad), position (m) and velocity (m/s) over the intervals."""
    increments = cut_at_epochs(imu, time_offset, epochs)
    bias = (
        np.broadcast_to(ACCEL_BIAS, (len(epochs), 3)),
        np.broadcast_to(GYRO_BIAS, (len(epochs), 3)),
    )
    measured = preintegrate(increments, MEMS, GRAVITY, *bias)
    true = motion.trajectory(epochs)
    assert true.velocity_world is not None
    constant = gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS)
    errors = []
    for i, measurement in enumerate(measured):
        turn = gtsam.Rot3(true.world_from_body[i])
        state = gtsam.NavState(turn, true.position_world[i], true.velocity_world[i])
        result = measurement.predict(state, constant)
        rotated = result.attitude().matrix().T @ true.world_from_body[i + 1]
        errors.append(
            [
                Rotation.from_matrix(rotated).magnitude(),
                np.linalg.norm(result.position() - true.position_world[i + 1]),
                np.linalg.norm(result.velocity() - true.velocity_world[i + 1]),
            ]
        )
    return np.max(errors, axis=0)


@pytest.mark.parametrize(
    ("interval", "rad", "metre", "metre_per_s"),
    [
        (0.2, 2e-5, 3e-5, 2e-4),
        (1.0, 1e-4, 4e-4, 7e-4),
        (10.0, 3e-4, 3e-2, 1e-2),  # the walk of the gyro's noise is 1e-3 rad by then
    ],
)
def test_preintegration_follows_the_exact_motion(
    interval: float, rad: float, metre: float, metre_per_s: float
) -> None:
    motion = moving(1)
    epochs = np.arange(2.0033, 38.0, interval)  # never on a sample
    errors = prediction_errors(motion, biased(recorded(motion)), 0.0, epochs)
    assert np.all(errors < [rad, metre, metre_per_s]), errors


def test_fast_turns_at_100_hz_are_integrated_to_below_the_noise_of_the_imu() -> None:
    interval = 0.2  # s
    motion = moving(7, rate_rms=5.0, interval=0.12)  # shaken by hand: the axis changes at 8 Hz
    errors = [
        prediction_errors(
            motion, biased(recorded(motion, rate_hz=rate)), 0.0, np.arange(2.0033, 38.0, interval)
        )
        for rate in (100.0, 200.0)
    ]
    noise = np.sqrt(interval) * np.array(
        [MEMS.gyro_noise, interval / np.sqrt(3.0) * MEMS.accel_noise, MEMS.accel_noise]
    )
    assert np.all(errors[0] < noise), errors[0] / noise
    # A trapezoid is of second order: half the step leaves a quarter of the error.
    assert np.all(errors[1][[0, 2]] < errors[0][[0, 2]] / 6.0), errors


def test_preintegration_survives_more_than_one_turn() -> None:
    motion = moving(2)
    epochs = np.array([3.0, 33.0])
    rotated = np.trapezoid(np.linalg.norm(motion.rate_body(np.arange(3.0, 33.0, 0.01)), axis=1))
    assert 0.01 * rotated > 4.0 * np.pi  # rad; two turns
    attitude = prediction_errors(motion, biased(recorded(motion)), 0.0, epochs)[0]
    assert attitude < 5e-4  # rad


def test_the_time_offset_is_added_to_the_imus_stamps() -> None:
    motion = moving(3)
    imu, epochs = biased(recorded(motion, time_offset=0.02)), np.arange(2.0, 38.0, 1.0)
    right = prediction_errors(motion, imu, 0.02, epochs)
    ignored = prediction_errors(motion, imu, 0.0, epochs)
    wrong_sign = prediction_errors(motion, imu, -0.02, epochs)
    assert right[0] < 1e-4  # rad
    assert ignored[0] > 1e-2  # rad
    assert wrong_sign[0] > 1.5 * ignored[0]


def test_steps_never_straddle_an_epoch_and_fill_every_interval() -> None:
    imu = recorded(moving(4))
    epochs = np.sort(np.random.default_rng(4).uniform(1.0, 39.0, 30))
    increments = cut_at_epochs(imu, 0.003, epochs)
    edges = epochs[0] + np.concatenate([[0.0], np.cumsum(increments.dt)])
    assert np.allclose(edges[increments.first], epochs, rtol=0.0, atol=1e-9)  # s
    assert np.all(increments.dt > 0.0)
    assert np.max(increments.dt) < 0.005 + 1e-9  # s; the sampling interval
    assert not np.any(increments.gap_bridged)


@pytest.mark.parametrize("ends", [(5.0011, 9.9993), (5.0, 10.0), (-0.4, 2.0), (38.0, 40.3)])
def test_one_interval_is_cut_as_one_among_several(ends: tuple[float, float]) -> None:
    imu = recorded(moving(4))
    # An epoch at a sample's stamp cuts nothing.
    stamp = imu.time[np.searchsorted(imu.time, np.mean(ends))]
    alone = cut_at_epochs(imu, 0.0, np.array(ends), 0.005)
    among = cut_at_epochs(imu, 0.0, np.array([ends[0], stamp, ends[1]]), 0.005)
    np.testing.assert_array_equal(alone.dt, among.dt)
    np.testing.assert_array_equal(alone.gyro_body, among.gyro_body)
    np.testing.assert_array_equal(alone.accel_body, among.accel_body)
    assert alone.first[-1] == among.first[-1]
    assert alone.gap_bridged[0] == among.gap_bridged.any()


def without(imu: ImuSamples, start: float, end: float) -> ImuSamples:
    kept = (imu.time <= start) | (imu.time >= end)
    return ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept])


@pytest.mark.parametrize("end", [10.35, 10.62, 11.01], ids=["one", "three", "five"])
def test_intervals_that_touch_a_gap_are_bridged_with_a_wide_covariance(end: float) -> None:
    epochs = np.arange(9.0, 12.0, 0.2)
    # Both ends of the gap lie less than a gap's length from an epoch.
    imu = without(recorded(moving(5)), 10.19, end)
    increments = cut_at_epochs(imu, 0.0, epochs)
    touched = (epochs[1:] > 10.19 + 1e-6) & (epochs[:-1] < end - 1e-6)
    assert np.array_equal(increments.gap_bridged, touched)
    zero = np.zeros((len(epochs), 3))
    measured = preintegrate(increments, MEMS, GRAVITY, zero, zero)
    sigma = np.sqrt([np.diagonal(m.preintMeasCov())[:9] for m in measured])
    assert np.min(sigma[touched, :3]) > 0.3  # rad; a person turns while the IMU is silent
    assert np.min(sigma[touched, 6:9]) > 0.01  # m, or m/s
    assert np.max(sigma[~touched, :3]) < 1e-3  # rad


def test_epochs_beyond_the_stream_are_bridged() -> None:
    imu = without(without(recorded(moving(5)), -1.0, 10.0), 12.0, 50.0)
    increments = cut_at_epochs(imu, 0.0, np.arange(9.5, 12.6, 0.2))
    assert np.array_equal(np.flatnonzero(increments.gap_bridged), [0, 1, 2, 12, 13, 14])


def states_of(motion: SimulatedMotion, step: float = 0.2) -> Trajectory:
    return with_biases(motion.trajectory(np.arange(2.0, 38.0, step)), GYRO_BIAS, ACCEL_BIAS)


def test_the_motion_passes_exactly_through_the_states() -> None:
    motion = moving(6)
    rng = np.random.default_rng(6)
    states = states_of(motion)
    nudge = Rotation.from_rotvec(rng.normal(0.0, 0.01, (len(states), 3))).as_matrix()
    assert states.velocity_world is not None
    states = replace(
        states,
        world_from_body=states.world_from_body @ nudge,
        position_world=states.position_world + rng.normal(0.0, 0.01, (len(states), 3)),
        velocity_world=states.velocity_world + rng.normal(0.0, 0.01, (len(states), 3)),
    )
    result = motion_at(states, biased(recorded(motion)), 0.0, GRAVITY, states.time)
    assert result.velocity_world is not None
    assert np.allclose(result.position_world, states.position_world, rtol=0.0, atol=1e-9)  # m
    assert np.allclose(result.velocity_world, states.velocity_world, rtol=0.0, atol=1e-9)  # m/s
    assert np.allclose(result.world_from_body, states.world_from_body, rtol=0.0, atol=1e-9)


def motion_errors(result: Trajectory, motion: SimulatedMotion) -> np.ndarray:
    true = motion.trajectory(result.time)
    assert result.velocity_world is not None
    assert true.velocity_world is not None
    turn = np.swapaxes(result.world_from_body, 1, 2) @ true.world_from_body
    return np.array(
        [
            np.max(Rotation.from_matrix(turn).magnitude()),
            np.max(np.linalg.norm(result.position_world - true.position_world, axis=1)),
            np.max(np.linalg.norm(result.velocity_world - true.velocity_world, axis=1)),
        ]
    )


@pytest.mark.parametrize(("step", "allowed"), [(0.2, 1.0), (1.0, 5.0)])
def test_between_the_states_the_motion_is_the_true_one(step: float, allowed: float) -> None:
    motion = moving(7)
    wanted = np.arange(2.0, 36.9, 0.00123)
    imu = biased(recorded(motion, time_offset=0.004))
    result = motion_at(states_of(motion, step), imu, 0.004, GRAVITY, wanted)
    errors = motion_errors(result, motion)
    assert np.all(errors < allowed * np.array([5e-5, 3e-5, 5e-4])), errors  # rad, m, m/s
    shifted = motion_at(states_of(motion, step), imu, -0.004, GRAVITY, wanted)
    # At 1.4 rad/s and up, eight milliseconds show.
    assert motion_errors(shifted, motion)[0] > 20.0 * errors[0]


def test_a_wrong_bias_bends_the_motion_little_between_the_states() -> None:
    motion = moving(8)
    states = with_biases(motion.trajectory(np.arange(2.0, 38.0, 0.2)), np.zeros(3), np.zeros(3))
    result = motion_at(
        states, biased(recorded(motion)), 0.0, GRAVITY, np.arange(2.0, 37.7, 0.00123)
    )
    errors = motion_errors(result, motion)
    assert errors[0] < 1e-3  # rad
    assert errors[1] < 1e-3  # m


def test_beyond_the_states_the_imu_carries_the_motion_on() -> None:
    motion = moving(9)
    states = with_biases(motion.trajectory(np.arange(10.0, 12.0, 0.2)), GYRO_BIAS, ACCEL_BIAS)
    imu = biased(recorded(motion))
    before = motion_at(states, imu, 0.0, GRAVITY, np.arange(9.5, 10.0, 0.01))
    after = motion_at(states, imu, 0.0, GRAVITY, np.arange(11.85, 12.3, 0.01))
    for result in (before, after):
        assert np.all(motion_errors(result, motion) < [1e-3, 2e-3, 5e-3])  # rad, m, m/s


def test_states_without_biases_are_refused() -> None:
    motion = moving(9)
    with pytest.raises(ValueError, match="velocity and biases"):
        motion_at(
            motion.trajectory(np.arange(3.0)), recorded(motion), 0.0, GRAVITY, np.array([1.0])
        )


@pytest.mark.parametrize("offset", [0.0, 0.0137])
def test_the_low_passed_rate_at_some_times_is_that_of_the_whole_stream(offset: float) -> None:
    imu = recorded(moving(6))
    rng = np.random.default_rng(6)
    imu = replace(imu, gyro_body=imu.gyro_body + rng.normal(0.0, 0.1, imu.gyro_body.shape))
    ends = np.array([-1.0, 0.0, 0.001, DURATION - 0.001, DURATION + 1.0])
    wanted = np.sort(np.concatenate([ends, rng.uniform(0.0, DURATION, 500), imu.time[::97]]))
    slow = low_passed(imu)
    expected = [np.interp(wanted, slow.time + offset, axis) for axis in slow.gyro_body.T]
    result = low_passed_rate_at(imu, offset, wanted)
    assert np.allclose(result, np.stack(expected, axis=1), rtol=0.0, atol=1e-10)
