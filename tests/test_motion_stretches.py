"""A motion taken stretch by stretch is the motion taken at once."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.demodulation import motion_stretches
from magfusion.estimation.demodulation.motion_compensation import TakenOff, taken_off
from magfusion.model import path_field
from magfusion.model.parameters import Calibration, initial_calibration
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import turning_motion

BOX_WORLD = np.array([[1.2, 1.2, 0.6], [4.8, 3.8, 1.6]])
NOISY = ImuModel(1e-3, 1e-2, 1e-5, 1e-4, 1e-2, 1e-3)
Case = tuple[Waveform, Trajectory, ImuSamples, Calibration]


@pytest.fixture(scope="module")
def case() -> Case:
    """Return a log of a minute, its states uneven, with a gap of the IMU in it."""
    rng, site = np.random.default_rng(5), demo_site()
    moving = turning_motion(rng, 60.0, BOX_WORLD)
    imu = simulate_imu(moving, NOISY, site.gravity, 200.0, 60.0, rng, 0.0, None).samples
    kept = (imu.time < 31.0) | (imu.time > 31.7)
    imu = ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept])
    at = np.arange(0.5, 59.0, 0.25)
    states = moving.trajectory(at[(at < 40.0) | (at > 43.0)])
    bias = np.cumsum(rng.normal(scale=1e-3, size=(2, len(states), 3)), axis=1)
    states = replace(states, gyro_bias_body=bias[0], accel_bias_body=bias[1])
    time = np.arange(0.0, 59.9, 0.005) + 0.0013
    samples = Waveform(time, rng.normal(scale=1e-7, size=(len(time), 3)))
    return samples, states, imu, initial_calibration(site, 30.0)


def predicted(case: Case, length: int, patch: pytest.MonkeyPatch) -> TakenOff:
    samples, states, imu, calibration = case
    patch.setattr(motion_stretches, "STRETCH", length)
    wanted = np.arange(0.3, 59.7, 0.03)
    return taken_off(samples, states, imu, calibration, 3e-3, 0.4, wanted)


@pytest.mark.parametrize("length", [401, 1777, 5000, 11999])
def test_stretches_of_any_length_give_the_same(
    case: Case, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path_field, "MIN_POINTS", 1 << 20)  # nodes lie where a stretch begins
    whole = predicted(case, 1 << 20, monkeypatch)
    result = predicted(case, length, monkeypatch)
    assert whole.wanted is not None
    assert result.wanted is not None
    pairs = [(result.unexplained_sensor, whole.unexplained_sensor)]
    pairs.append((result.change_sensor, whole.change_sensor))
    pairs += [(vars(result.wanted)[k], v) for k, v in vars(whole.wanted).items() if v is not None]
    for own, expected in pairs:
        np.testing.assert_allclose(own, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_through_nodes_the_samples_are_the_same_to_a_hundred_thousandth(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, states, imu, calibration = case
    calibration = replace(calibration, site=replace(calibration.site, earth_field_world=None))
    result = taken_off(samples, states, imu, calibration, 3e-3, 0.4)
    monkeypatch.setattr(path_field, "MIN_POINTS", 1 << 20)
    exact = taken_off(samples, states, imu, calibration, 3e-3, 0.4)
    field = np.linalg.norm(samples.measured_sensor - exact.unexplained_sensor, axis=1)
    separate = np.linalg.norm(result.unexplained_sensor - exact.unexplained_sensor, axis=1)
    assert 0.0 < np.max(separate) < 1e-5 * np.max(field)
    assert np.sqrt(np.mean(separate**2)) < 1e-6 * np.sqrt(np.mean(field**2))
    change = np.sqrt(np.mean(exact.change_sensor**2))
    assert np.sqrt(np.mean((result.change_sensor - exact.change_sensor) ** 2)) < 1e-3 * change


def test_a_stretch_asks_for_the_samples_about_it_alone(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, states, imu, _ = case
    monkeypatch.setattr(motion_stretches, "STRETCH", 2000)
    parts = list(motion_stretches.stretches(samples.time, states, imu, 3e-3, 9.81))
    assert sum(part.last - part.first for part in parts) == len(samples)
    assert max(len(part.shape.time) for part in parts) < 2000 + 1000  # the gap of the states
