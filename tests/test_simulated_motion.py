"""Simulated motion and inertial samples against mechanics, GTSAM and their own statistics."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.interpolate import BPoly, BSpline
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.errors import InputError
from magfusion.model.site import ImuModel
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import BiasInstability, simulate_imu
from magfusion.simulation.motion import Rests, random_walk_motion, static_motion, turning_motion

GRAVITY = 9.81
SILENT = ImuModel(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def walk(seed=1, duration=60.0, **options):
    return random_walk_motion(np.random.default_rng(seed), duration, DEMO_BOX_WORLD, **options)


def turn(seed=1, duration=60.0, **options):
    return turning_motion(np.random.default_rng(seed), duration, DEMO_BOX_WORLD, **options)


def still(position=(3.0, 2.5, 1.0), rotvec=(0.1, -0.2, 0.7)):
    return static_motion(np.array(position), Rotation.from_rotvec(rotvec))


def chi2_bounds(degrees, miss=1e-4):
    return chi2.ppf([miss / 2.0, 1.0 - miss / 2.0], degrees)


def test_derivatives_above_the_degree_of_a_path_are_zero():
    """SciPy before 1.17 writes beyond its memory when it is asked for them."""
    time = np.linspace(0.0, 1.0, 1000)
    assert not np.any(still().velocity_world(time))
    assert not np.any(still().acceleration_world(time))
    rate = BPoly(np.ones((6, 1)), np.array([0.0, 1.0]))
    straight = replace(still(), position=BSpline([0.0, 0.0, 1.0, 1.0], np.eye(2, 3), 1), rate=rate)
    assert not np.any(straight.acceleration_world(time))
    np.testing.assert_allclose(straight.velocity_world(time), [[-1.0, 1.0, 0.0]] * 1000, atol=1e-12)


@pytest.mark.parametrize("motion", [walk(), turn()], ids=["walk", "turn"])
def test_velocity_acceleration_and_rate_are_the_derivatives_of_the_pose(motion):
    time, h = np.arange(0.5, 59.5, 0.0371), 1e-4
    before, here, after = (motion.position_world(time + k * h) for k in (-1, 0, 1))
    velocity = (after - before) / (2.0 * h)
    acceleration = (after - 2.0 * here + before) / h**2
    rotated = motion.world_from_body(time - h).inv() * motion.world_from_body(time + h)
    np.testing.assert_allclose(motion.velocity_world(time), velocity, atol=1e-7)  # m/s
    np.testing.assert_allclose(motion.acceleration_world(time), acceleration, atol=1e-5)  # m/s^2
    rate = rotated.as_rotvec() / (2.0 * h)
    np.testing.assert_allclose(motion.rate_body(time), rate, atol=1e-6)  # rad/s


@pytest.mark.parametrize("motion", [walk(), turn()], ids=["walk", "turn"])
def test_acceleration_and_rate_do_not_jump(motion):
    time = np.arange(0.0, 60.0, 1e-3)
    assert np.abs(np.diff(motion.acceleration_world(time), axis=0)).max() < 2e-2  # m/s^2 per ms
    assert np.abs(np.diff(motion.rate_body(time), axis=0)).max() < 2e-2  # rad/s per ms


@pytest.mark.parametrize("make", [walk, turn])
def test_the_body_rests_at_the_start_between_moves_and_beyond_the_ends(make):
    motion = make(rests=Rests(start=5.0, move=10.0, pause=4.0))
    resting = np.array([-3.0, 0.0, 4.99, 15.01, 18.99, 29.5, 70.0])
    moving = np.array([6.0, 10.0, 20.0, 27.0])
    assert not motion.velocity_world(resting).any()
    assert not motion.rate_body(resting).any()
    assert np.linalg.norm(motion.velocity_world(moving), axis=1).min() > 1e-3  # m/s
    assert np.linalg.norm(motion.rate_body(moving), axis=1).min() > 1e-3  # rad/s


def test_a_motion_without_rests_moves_from_its_first_second_to_its_last():
    motion = walk(rests=Rests(start=0.0, move=10.0, pause=0.0))
    speed = np.linalg.norm(motion.velocity_world(np.array([0.0, 1.0, 5.0, 55.0, 60.0])), axis=1)
    assert speed[[0, 4]].max() == 0.0
    assert speed[1:4].min() > 1e-3  # m/s


def test_a_walk_stays_in_its_box_at_about_its_speed_tilt_and_turning():
    motion = walk(duration=600.0, tilt_rms=0.1, heading_rate_rms=0.3)
    time = np.arange(0.0, 600.0, 0.02)
    position = motion.position_world(time)
    moving = motion.rate(time) > 0.999
    assert np.all((position >= DEMO_BOX_WORLD[0]) & (position <= DEMO_BOX_WORLD[1]))
    assert np.all(np.ptp(position, axis=0) > 0.6 * np.ptp(DEMO_BOX_WORLD, axis=0))
    speed = np.linalg.norm(motion.velocity_world(time[moving]), axis=1)
    assert speed.mean() == pytest.approx(0.5, rel=0.15)
    tilt = np.arccos(motion.world_from_body(time).as_matrix()[:, 2, 2])
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(0.1, rel=0.2)
    turning = np.sqrt(np.mean(motion.rate_body(time[moving])[:, 2] ** 2))
    assert turning == pytest.approx(0.3, rel=0.3)


def test_a_turning_motion_turns_as_much_about_every_axis():
    motion = turn(duration=600.0, rate_rms=0.6)
    rms = np.sqrt(np.mean(motion.rate_body(np.arange(0.0, 600.0, 0.02)) ** 2, axis=0))
    np.testing.assert_allclose(rms, np.full(3, 0.6 / np.sqrt(3.0)), rtol=0.25)


def test_a_trajectory_holds_what_the_motion_says():
    time = np.linspace(6.0, 9.0, 4)
    trajectory = walk().trajectory(time)
    np.testing.assert_array_equal(trajectory.position_world, walk().position_world(time))
    np.testing.assert_array_equal(trajectory.velocity_world, walk().velocity_world(time))


@pytest.mark.parametrize(
    ("options", "place"),
    [
        ({"duration": 0.0}, "duration"),
        ({"speed": 0.0}, "speed"),
        ({"rests": Rests(start=-1.0)}, "rests"),
    ],
)
def test_a_motion_that_cannot_be_is_refused_by_name(options, place):
    with pytest.raises(InputError, match=place):
        walk(**options)


def test_a_box_upside_down_is_refused():
    with pytest.raises(InputError, match="box"):
        random_walk_motion(np.random.default_rng(1), 10.0, DEMO_BOX_WORLD[::-1])


def test_at_rest_and_level_the_accelerometer_shows_gravity_upwards():
    level = still(rotvec=(0.0, 0.0, 0.4))
    imu = simulate_imu(level, SILENT, GRAVITY, 100.0, 1.0, np.random.default_rng(1)).samples
    np.testing.assert_allclose(imu.accel_body, np.tile([0.0, 0.0, GRAVITY], (100, 1)), atol=1e-12)
    assert not imu.gyro_body.any()


def test_pitching_the_nose_down_puts_gravity_behind():
    # A right-handed turn about y lowers the x axis: the support then pulls towards -x.
    pitched = still(rotvec=(0.0, 0.3, 0.0))
    force = pitched.specific_force_body(np.zeros(1), GRAVITY)[0]
    np.testing.assert_allclose(force, GRAVITY * np.array([-np.sin(0.3), 0.0, np.cos(0.3)]))


@pytest.mark.parametrize("motion", [walk(), turn()], ids=["walk", "turn"])
def test_gtsam_integrates_silent_samples_back_to_the_pose(motion):
    rate_hz, duration = 400.0, 40.0
    step = 1.0 / rate_hz
    # Taken at the middle of each interval, samples make a second-order quadrature.
    imu = simulate_imu(
        motion, SILENT, GRAVITY, rate_hz, duration, np.random.default_rng(1), 0.5 * step
    ).samples
    integrated = gtsam.PreintegratedImuMeasurementsG(
        gtsam.PreintegrationParams.MakeSharedU(GRAVITY), gtsam.imuBias.ConstantBias()
    )
    for force, rate in zip(imu.accel_body, imu.gyro_body, strict=True):
        integrated.integrateMeasurement(force, rate, step)
    start, end = motion.trajectory(np.array([0.0, duration])), np.array([duration])
    begin = gtsam.NavState(
        gtsam.Pose3(gtsam.Rot3(start.world_from_body[0]), start.position_world[0]),
        start.velocity_world[0],
    )
    final = integrated.predict(begin, gtsam.imuBias.ConstantBias())
    rotated = motion.world_from_body(end)[0].inv() * Rotation.from_matrix(final.attitude().matrix())
    assert rotated.magnitude() < 5e-6  # rad
    moved = motion.position_world(end)[0]
    np.testing.assert_allclose(final.position(), moved, atol=2e-3)  # m
    np.testing.assert_allclose(final.velocity(), motion.velocity_world(end)[0], atol=2e-4)  # m/s


def test_white_noise_has_the_declared_density():
    imu = replace(SILENT, gyro_noise=3e-4, accel_noise=4e-3)
    for rate_hz in (50.0, 800.0):
        samples = simulate_imu(
            still(), imu, GRAVITY, rate_hz, 20.0, np.random.default_rng(2)
        ).samples
        for values, density in ((samples.gyro_body, 3e-4), (samples.accel_body, 4e-3)):
            scaled = (values - values.mean(axis=0)) / (density * np.sqrt(rate_hz))
            low, high = chi2_bounds(scaled.size - 3)
            assert low < np.sum(scaled**2) < high


def test_biases_start_with_their_sigma_and_walk_with_their_density():
    imu = replace(
        SILENT,
        gyro_bias_sigma=5e-3,
        gyro_bias_walk=1e-5,
        accel_bias_sigma=0.05,
        accel_bias_walk=1e-3,
    )
    rng = np.random.default_rng(3)
    runs = [simulate_imu(still(), imu, GRAVITY, 50.0, 4.0, rng) for _ in range(300)]
    for name, sigma, walk_density in (
        ("gyro_bias_body", 5e-3, 1e-5),
        ("accel_bias_body", 0.05, 1e-3),
    ):
        bias = np.array([getattr(run, name) for run in runs])
        elapsed = (bias.shape[1] - 1) / 50.0
        low, high = chi2_bounds(3 * len(runs))
        assert low < np.sum((bias[:, 0] / sigma) ** 2) < high
        walked = (bias[:, -1] - bias[:, 0]) / (walk_density * np.sqrt(elapsed))
        assert low < np.sum(walked**2) < high


def test_samples_hold_exactly_the_biases_that_are_told():
    imu = replace(demo_site().platform.imu, gyro_noise=0.0, accel_noise=0.0)
    run = simulate_imu(walk(), imu, GRAVITY, 100.0, 20.0, np.random.default_rng(4))
    time = run.samples.time
    np.testing.assert_allclose(
        run.samples.gyro_body - walk().rate_body(time), run.gyro_bias_body, atol=1e-14
    )
    np.testing.assert_allclose(
        run.samples.accel_body - walk().specific_force_body(time, GRAVITY),
        run.accel_bias_body,
        atol=1e-13,
    )


def allan_deviation(values, count):
    """Overlapping Allan deviation of samples averaged over ``count``."""
    total = np.cumsum(np.vstack([np.zeros(3), values]), axis=0)
    means = (total[count:] - total[:-count]) / count
    return np.sqrt(0.5 * np.mean((means[count:] - means[:-count]) ** 2))


def test_bias_instability_peaks_in_the_allan_deviation_where_it_is_declared():
    floor = BiasInstability(gyro=2e-5, accel=3e-4, time=2.0)
    rng = np.random.default_rng(5)
    run = simulate_imu(still(), SILENT, GRAVITY, 20.0, 2e4, rng, instability=floor)
    for bias, height in ((run.gyro_bias_body, 2e-5), (run.accel_bias_body, 3e-4)):
        short, peak, long = (allan_deviation(bias, count) for count in (4, 40, 400))
        assert peak == pytest.approx(height, rel=0.03)
        assert max(short, long) < 0.8 * peak


def test_a_sample_stamped_t_is_taken_at_t_plus_the_offset():
    offset = 0.013
    imu = simulate_imu(
        turn(), SILENT, GRAVITY, 100.0, 20.0, np.random.default_rng(1), offset
    ).samples
    assert imu.time[0] == 0.0
    np.testing.assert_array_equal(imu.gyro_body, turn().rate_body(imu.time + offset))
