"""Attitude from the gyro against products taken step by step, closed forms and true motion."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model import strapdown
from magfusion.model.quaternion import of_matrices
from magfusion.model.samples import ImuSamples
from magfusion.model.site import MotionModel
from magfusion.model.strapdown import (
    attitude_at,
    attitude_from_gyro,
    attitude_from_gyro_at,
    resting,
)
from magfusion.receiver.turn import Turn, body_turn_of
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests, turning_motion


def stream(seed, count=300):
    """Return irregular times (s) and unrelated rates of some rad/s."""
    rng = np.random.default_rng(seed)
    return 7.0 + np.cumsum(rng.uniform(2e-3, 2e-2, count)), rng.normal(0.0, 2.0, (count, 3))


def largest_angle(result, expected):
    return np.max((result.inv() * expected).magnitude())


def tumbling(seed=1, duration=20.0):
    rests = Rests(start=0.0, move=duration, pause=0.0)
    return turning_motion(
        np.random.default_rng(seed), duration, DEMO_BOX_WORLD, rate_rms=1.5, rests=rests
    )


@pytest.mark.parametrize("count", [1, 2, 3, 8, 300])
def test_the_attitude_is_the_product_of_the_increments_taken_one_by_one(count):
    time, gyro = stream(1, count)
    result = attitude_from_gyro(time, gyro)
    pose = gtsam.Rot3()
    expected = [pose.matrix()]
    for k in range(count - 1):
        turn = attitude_from_gyro(time[k : k + 2], gyro[k : k + 2])[1].as_rotvec()
        pose = pose.compose(gtsam.Rot3.Expmap(turn))
        expected.append(pose.matrix())
    assert len(result) == count
    assert largest_angle(result, Rotation.from_matrix(expected)) < 1e-12  # rad


def test_a_constant_rate_turns_by_its_product_with_time():
    time, _ = stream(2)
    rate = np.array([0.3, -1.2, 2.0])
    result = attitude_from_gyro(time, np.broadcast_to(rate, (len(time), 3)))
    expected = Rotation.from_rotvec((time - time[0])[:, None] * rate)
    assert largest_angle(result, expected) < 1e-12  # rad


def test_the_attitude_of_a_body_that_tumbles_is_its_true_one_to_second_order():
    motion = tumbling()
    errors = []
    for rate_hz in (50.0, 100.0, 200.0):
        time = np.arange(0.0, 20.0, 1.0 / rate_hz)
        truth = motion.world_from_body(time)
        result = attitude_from_gyro(time, motion.rate_body(time))
        errors.append(largest_angle(truth[0] * result, truth))
    # The mean of two rates leaves what is curved between them.
    assert errors[2] < 1e-4  # rad in 20 s at 200 Hz
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5


def test_a_rate_that_turns_its_direction_is_seen_beyond_its_mean():
    step, fine = 0.02, 2000
    ends = np.array([[2.0, 0.0, 1.0], [0.0, 3.0, 1.0]])
    share = (np.arange(fine) + 0.5)[:, None] / fine
    rates = (1.0 - share) * ends[0] + share * ends[1]
    expected = Rotation.identity()
    for rate in rates:
        expected = expected * Rotation.from_rotvec(rate * step / fine)
    result = attitude_from_gyro(np.array([0.0, step]), ends)[1]
    without = Rotation.from_rotvec(ends.mean(axis=0) * step)
    assert largest_angle(result, expected) < 1e-2 * largest_angle(without, expected)


def test_the_attitude_between_samples_lies_on_the_true_motion():
    motion = tumbling(2)
    time = np.arange(0.0, 20.0, 0.005)
    wanted = np.random.default_rng(3).uniform(0.0, time[-1], 500)
    gyro = motion.rate_body(time)
    result = attitude_at(motion.world_from_body(time), time, gyro, wanted)
    assert largest_angle(result, motion.world_from_body(wanted)) < 2e-5  # rad


def test_on_a_sample_the_attitude_is_that_of_the_sample():
    time, gyro = stream(4, 20)
    attitude = Rotation.random(20, random_state=5)
    result = attitude_at(attitude, time, gyro, time[::-1])
    assert largest_angle(result, attitude[::-1]) < 1e-14


def test_just_before_a_sample_the_attitude_meets_it():
    time, gyro = stream(6, 50)
    attitude = attitude_from_gyro(time, gyro)
    result = attitude_at(attitude, time, gyro, time[1:] - 1e-9)
    # Coning is left out between samples: rates of 3 rad/s that change wholly in 20 ms.
    assert largest_angle(result, attitude[1:]) < 2e-3
    smooth = np.stack([np.cos(time), np.sin(time), 0.5 * np.ones_like(time)], axis=1)
    attitude = attitude_from_gyro(time, smooth)
    result = attitude_at(attitude, time, smooth, time[1:] - 1e-9)
    assert largest_angle(result, attitude[1:]) < 2e-6


def test_beyond_the_stream_the_end_rates_are_held():
    time, gyro = stream(7, 10)
    attitude = attitude_from_gyro(time, gyro)
    wanted = np.array([time[0] - 0.1, time[-1] + 0.2])
    result = attitude_at(attitude, time, gyro, wanted)
    expected = [
        attitude[0] * Rotation.from_rotvec(-0.1 * gyro[0]),
        attitude[-1] * Rotation.from_rotvec(0.2 * gyro[-1]),
    ]
    assert largest_angle(result, Rotation.concatenate(expected)) < 1e-12


@pytest.mark.parametrize("count", [1, 2, 3, 64, 65, 300])
@pytest.mark.parametrize("chunk", [1, 7, 64, 65_536])
def test_at_some_times_only_the_attitude_is_that_of_the_whole_chain(monkeypatch, count, chunk):
    monkeypatch.setattr(strapdown, "CHUNK", chunk)
    time, gyro = stream(8, count)
    rng = np.random.default_rng(9)
    between = rng.uniform(time[0], time[-1], 20)
    wanted = np.concatenate([between, time, [time[0] - 0.1, time[-1] + 0.2], time[-1:]])
    result = attitude_from_gyro_at(time, gyro, wanted)
    expected = attitude_at(attitude_from_gyro(time, gyro), time, gyro, wanted)
    assert largest_angle(result, expected) < 1e-13  # rad


@pytest.mark.parametrize("kind", ["walk", "turn"])
def test_a_body_rests_where_it_is_simulated_at_rest_and_nowhere_in_motion(kind):
    rests = Rests(start=5.0, move=10.0, pause=4.0)
    config = SimulationConfig(DEMO_BOX_WORLD, 60.0, kind, rests=rests)
    run = simulate_log(demo_site(), config, np.random.default_rng(8))
    imu, motion = run.log.imu, run.motion
    result = resting(imu.time, imu.gyro_body, imu.accel_body, motion=MotionModel())
    speed = np.linalg.norm(motion.velocity_world(imu.time), axis=1)
    rate = np.linalg.norm(motion.rate_body(imu.time), axis=1)
    still = (speed == 0.0) & (rate == 0.0)
    quiet_all_around = np.convolve(still, np.ones(201), mode="same") == 201  # 1 s at 200 Hz
    assert quiet_all_around.sum() > 1500
    assert np.all(result[quiet_all_around])
    # Ramps begin as softly as a quintic: a body slower than this is as good as at rest.
    assert not np.any(result[(speed > 0.2) & (rate > 0.1)])
    assert np.sum((speed > 0.2) & (rate > 0.1)) > 4000


def still_stream(seconds=4.0, rate_hz=100.0):
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    gyro = np.broadcast_to([0.02, -0.01, 0.03], (len(time), 3)).copy()  # a bias is no motion
    accel = np.broadcast_to([0.3, -0.2, 9.8], (len(time), 3)).copy()
    return time, gyro, accel


def test_the_ends_of_a_stream_are_not_known_to_rest():
    time, gyro, accel = still_stream()
    result = resting(time, gyro, accel, motion=MotionModel())
    inside = (time >= 0.5) & (time <= time[-1] - 0.5)
    assert np.array_equal(result, inside)


@pytest.mark.parametrize("which", ["gyro", "accel"])
def test_a_knock_spoils_the_rest_around_it_and_no_more(which):
    time, gyro, accel = still_stream()
    {"gyro": gyro, "accel": accel}[which][200] += 5.0  # at 2 s
    result = resting(time, gyro, accel, motion=MotionModel())
    assert not np.any(result[np.abs(time - 2.0) < 0.49])
    assert np.all(result[(np.abs(time - 2.0) > 0.51) & (time >= 0.5) & (time <= time[-1] - 0.5)])


def test_a_steady_turn_under_gravity_is_no_rest():
    time, gyro, accel = still_stream()
    gyro[:] = [1.0, 0.0, 0.0]
    accel[:] = 9.8 * np.stack([np.zeros_like(time), np.sin(time), np.cos(time)], axis=1)
    assert not np.any(resting(time, gyro, accel, motion=MotionModel()))


@pytest.mark.parametrize("chunk", [1, 130, 1999])
def test_a_stream_rests_in_pieces_where_it_rests_as_a_whole(monkeypatch, chunk):
    rng = np.random.default_rng(10)
    time = np.cumsum(rng.uniform(8e-3, 12e-3, 2000))
    scale = np.where((time > 5.0) & (time < 12.0), 0.5, 2.0)[:, None]
    gyro = 0.01 * scale * rng.standard_normal((2000, 3))
    accel = 0.08 * scale * rng.standard_normal((2000, 3)) + [0.0, 0.0, 9.81]
    whole = resting(time, gyro, accel, motion=MotionModel())
    assert 500 < np.sum(whole) < 800
    monkeypatch.setattr(strapdown, "CHUNK", chunk)
    assert np.array_equal(resting(time, gyro, accel, motion=MotionModel()), whole)


def test_what_is_rest_is_for_the_sites_motion_model_to_say():
    """A drill that stands and runs shakes more than a hand that moves."""
    rng, time = np.random.default_rng(9), np.arange(0.0, 10.0, 0.005)
    gyro, accel = rng.normal(0.0, [0.1], (len(time), 3)), rng.normal(0.0, 0.8, (len(time), 3))
    drill = MotionModel(rest_gyro=0.4, rest_accel=3.0, rest_span=2.0)
    assert not np.any(resting(time, gyro, accel, motion=MotionModel()))
    still = resting(time, gyro, accel, motion=drill)
    assert np.all(still[(time > 1.01) & (time < 8.98)])
    assert not np.any(still[time < 0.99])  # the span is the model's


def test_quaternions_of_matrices_are_those_of_any_turn() -> None:
    rng = np.random.default_rng(3)
    half_turns = np.concatenate([np.eye(3), rng.normal(size=(50, 3))])
    half_turns *= np.pi / np.linalg.norm(half_turns, axis=1, keepdims=True)
    vectors = np.concatenate([np.zeros((1, 3)), rng.normal(0.0, 2.0, (500, 3)), half_turns])
    turns = Rotation.from_rotvec(vectors)
    result = of_matrices(turns.as_matrix())
    np.testing.assert_allclose(np.linalg.norm(result, axis=0), 1.0, rtol=1e-15)
    assert largest_angle(Rotation.from_quat(result.T, scalar_first=True), turns) < 1e-14


def test_a_field_is_turned_back_by_the_inverse_of_what_turned_it() -> None:
    time, gyro = stream(4)
    rng = np.random.default_rng(5)
    matrix = np.eye(3) + 0.1 * rng.normal(size=(3, 3))  # scales and skew: no rotation
    turn = Turn(body_turn_of(ImuSamples(time, gyro, np.zeros_like(gyro))), matrix)
    wanted = np.linspace(time[0], time[-1], 40)
    there, back = turn.both(wanted)
    np.testing.assert_allclose(there, turn(wanted), atol=1e-15)
    np.testing.assert_allclose(back, turn.back(wanted), atol=1e-15)
    np.testing.assert_allclose(back, np.linalg.inv(turn(wanted)), atol=1e-14)
