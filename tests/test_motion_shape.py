"""The waveform along a motion, and its derivatives in closed form, against differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.demodulation.motion_shape import MotionShape, motion_at
from magfusion.estimation.graph.preintegration import low_passed
from magfusion.model.field import observe_earth
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.quaternion import inverse, matrices, of_vectors, product, rotate
from magfusion.model.site import ImuModel, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.waveform import MotionChange, carriers, predicted_waveform
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import turning_motion

EARTH_WORLD = np.array([1e-6, 2.1e-5, -4.4e-5])
BOX_WORLD = np.array([[1.2, 1.2, 0.6], [4.8, 3.8, 1.6]])
SILENT = ImuModel(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
KINDS = ("dipoles", "loops", "axes apart")


@pytest.fixture(scope="module")
def motion() -> Trajectory:
    rng = np.random.default_rng(3)
    moving = turning_motion(rng, 8.0, BOX_WORLD)
    return moving.trajectory(np.arange(1.0, 7.0, 0.0035))


def of_kind(kind: str) -> Site:
    site = demo_site()
    if kind == "loops":
        sized = (
            replace(b, coils=tuple(replace(c, radius=0.1) for c in b.coils)) for b in site.beacons
        )
        return replace(site, beacons=tuple(sized))
    if kind == "axes apart":
        centres = np.array([[0.01, 0.0, 0.0], [0.0, -0.02, 0.0], [0.0, 0.0, 0.03]])
        sensor = replace(site.platform.magnetometer, coil_centres_sensor=centres)
        return replace(site, platform=replace(site.platform, magnetometer=sensor))
    return site


def moved(motion: Trajectory, change: MotionChange, step: float) -> Trajectory:
    turn = Rotation.from_rotvec(step * change.rotation_world).as_matrix()
    position = motion.position_world + step * change.position_world
    return replace(motion, world_from_body=turn @ motion.world_from_body, position_world=position)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_are_phasors_on_their_carriers_with_the_earth_field(kind, motion) -> None:
    calibration = initial_calibration(of_kind(kind), 2.0)
    rng = np.random.default_rng(0)
    calibration = replace(
        calibration,
        phase=rng.normal(size=len(calibration.phase)),
        drift=1e-5 * rng.normal(size=len(calibration.drift)),
        log_gain=0.1 * rng.normal(size=len(calibration.log_gain)),
    )
    site = calibration.site
    frequencies = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    carrier = carriers(frequencies, motion.time)
    pose = motion.world_from_body, motion.position_world
    phasor = predict_channels(calibration, motion.time, *pose)
    beacons = np.einsum("ncx,nc->nx", phasor, carrier).real
    earth = observe_earth(site.platform.magnetometer, motion.world_from_body, EARTH_WORLD)
    result, by = predicted_waveform(motion, calibration, EARTH_WORLD, carrier)
    expected = beacons + earth.measured_sensor
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-13 * np.max(np.abs(expected)))
    assert not np.any(by)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_change_with_the_motion_as_their_difference(kind, motion) -> None:
    calibration = initial_calibration(of_kind(kind), 2.0)
    frequencies = np.concatenate([b.tone_frequencies_hz for b in calibration.site.beacons])
    carrier, rng = carriers(frequencies, motion.time), np.random.default_rng(1)
    change = MotionChange(*rng.normal(size=(2, len(motion.time), 3)))
    _, by = predicted_waveform(motion, calibration, EARTH_WORLD, carrier, change)
    step = 1e-5
    ahead, behind = (
        predicted_waveform(moved(motion, change, s), calibration, EARTH_WORLD, carrier)[0]
        for s in (step, -step)
    )
    expected = (ahead - behind) / (2.0 * step)
    np.testing.assert_allclose(by, expected, rtol=0, atol=1e-7 * np.max(np.abs(expected)))


def test_a_motion_changes_with_the_clock_as_its_difference() -> None:
    rng = np.random.default_rng(5)
    moving, site = turning_motion(rng, 20.0, BOX_WORLD), demo_site()
    imu = simulate_imu(moving, SILENT, site.gravity, 400.0, 20.0, rng, 0.0, None).samples
    states = moving.trajectory(np.arange(1.0, 19.0, 0.25))
    zero = np.zeros((len(states.time), 3))
    states = replace(states, gyro_bias_body=zero, accel_bias_body=zero)
    wanted = np.arange(2.0, 18.0, 0.0113)
    shape = MotionShape.of(states, imu, 0.0, site.gravity)
    now, (turn, push) = shape.changing_at(wanted)
    same = motion_at(states, imu, 0.0, site.gravity, wanted)
    assert np.array_equal(now.world_from_body, same.world_from_body)
    np.testing.assert_allclose(now.position_world, same.position_world, rtol=0, atol=1e-12)  # m
    step, slow = 1e-3, low_passed(imu)
    ahead, behind = (motion_at(states, slow, s, site.gravity, wanted) for s in (step, -step))
    back = np.swapaxes(behind.world_from_body, 1, 2)
    turned_by = Rotation.from_matrix(ahead.world_from_body @ back).as_rotvec() / (2.0 * step)
    pushed_by = (ahead.position_world - behind.position_world) / (2.0 * step)
    assert rms(turn - turned_by) < 1e-3 * rms(turned_by)
    # The body's specific force is averaged in one, what it gained in the other.
    assert rms(push - pushed_by) < 1e-4 * rms(ahead.velocity_world)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_quaternions_turn_as_scipy_s_rotations_do() -> None:
    rng = np.random.default_rng(2)
    a, b, vector = rng.normal(size=(3, 50, 3))
    a[0] = 0.0
    one, two = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    p, q = of_vectors(a.T), of_vectors(b.T)
    for result, expected in (
        (matrices(product(p, q)), (one * two).as_matrix()),
        (matrices(inverse(p)), one.inv().as_matrix()),
        (rotate(p, vector.T).T, one.apply(vector)),
    ):
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-14 * np.max(np.abs(vector)))
