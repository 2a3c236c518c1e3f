"""A magnetometer of another gain than declared, turned slowly or fast."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BPoly, BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.jobs.magnetometer_trust import calibrated
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Magnetometer, MagnetometerSigma, Site
from magfusion.model.trust import Trust, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import Rests, SimulatedMotion, turning_motion

RECORDING = Path(__file__).parents[1].parent / "shared" / "recordings" / "magnetometer_gain_0.8"
OFFSET = np.array([20e-6, -12e-6, 8e-6])  # T
SECONDS, RATE_HZ, NOISE = 50.0, 100.0, 1e-7  # s, Hz, T


def declared() -> Site:
    """Return a site without beacons whose sensor is of gain one, its sigmas left out."""
    site, none = demo_site(coil_radius=None), np.zeros(3)
    sigma = MagnetometerSigma(np.zeros((3, 3)), none, none, none)
    sensor = replace(
        site.platform.magnetometer, matrix=np.eye(3), offset=none, position_body=none, sigma=sigma
    )
    return replace(site, beacons=(), platform=replace(site.platform, magnetometer=sensor))


def swung(speed: float) -> SimulatedMotion:
    """Return a sensor that is swung by hand, so that its z axis never points down."""
    knots = np.arange(0.0, SECONDS + 1.0, 0.1)
    angle = 2.0 * np.pi * speed * np.outer(knots, [0.05, 1.0 / 15.0, 7.0 / 60.0])
    attitude = Rotation.from_euler("zyx", np.sin(angle) * [2.4, 1.15, 1.15])
    still = BSpline(np.array([0.0, 1.0]), np.zeros((1, 3)), 0)
    even = BPoly(np.ones((1, 1)), np.array([0.0, SECONDS + 1.0]))
    return SimulatedMotion(still, RotationSpline(knots, attitude), even)


def by_hand(speed: float) -> SimulatedMotion:
    """Return a sensor that is turned about all axes."""
    rests = Rests(0.5, 1e3, 0.0)
    return turning_motion(
        np.random.default_rng(7), SECONDS, DEMO_BOX_WORLD, 0.1, 0.8 * speed, rests
    )


@cache
def turned(gain: float, speed: float = 1.0, how: Callable[[float], SimulatedMotion] = swung) -> Log:
    """Return a log of a sensor in the Earth's field, turned at 40 deg/s times the speed."""
    site, rng, motion = declared(), np.random.default_rng(7), how(speed)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 200.0, SECONDS, rng).samples
    time = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    sensor = site.platform.magnetometer
    field_body = motion.world_from_body(time).inv().apply(site.earth_field_world)
    field = gain * field_body @ sensor.body_from_sensor + OFFSET
    wave = Waveform(time, field + NOISE * rng.standard_normal(field.shape))
    return Log("turned", 0, "test", imu, wave)


def checked(log: Log, site: Site) -> tuple[Magnetometer, Trust]:
    result, trust = calibrated(log, site)
    return result.magnetometer, trust


@pytest.mark.parametrize("how", [swung, by_hand])
@pytest.mark.parametrize("speed", [0.4, 1.0, 2.0])
@pytest.mark.parametrize("gain", [0.8, 1.0, 1.25])
def test_gain_and_offset_are_found_from_slow_and_fast_turns(
    gain: float, speed: float, how: Callable[[float], SimulatedMotion]
) -> None:
    sensor, trust = checked(turned(gain, speed, how), declared())
    assert trust.verdict is Verdict.TRUSTWORTHY
    np.testing.assert_allclose(sensor.matrix, gain * np.eye(3), atol=0.005, rtol=0)  # 0.3 deg
    np.testing.assert_allclose(sensor.offset, OFFSET, atol=1e-7, rtol=0)  # T


@pytest.mark.parametrize(("gain", "share"), [(0.5, 1.0), (1.0, 1.48), (1.0, 0.52)])
def test_a_field_of_another_size_is_the_reason_and_not_the_rotation(
    gain: float, share: float
) -> None:
    site = declared()
    assert site.earth_field_world is not None
    other = replace(site, earth_field_world=share * site.earth_field_world)
    sensor, trust = checked(turned(gain), other)
    assert trust.verdict is Verdict.FAILED
    assert "the readings are of a field of" in trust.ordered[0].text
    np.testing.assert_allclose(sensor.offset, OFFSET, atol=1e-7, rtol=0)  # T


@pytest.mark.slow
def test_late_samples_are_the_reason_and_not_the_rotation() -> None:
    log = turned(0.8)
    assert log.waveform is not None
    late = replace(log.waveform, time=log.waveform.time + 0.062)
    _, trust = checked(replace(log, waveform=late), declared())
    assert trust.verdict is Verdict.FAILED
    assert re.search(r"stamped 0\.0[67] s too early", trust.ordered[0].text)


def test_without_an_imu_the_gain_is_found_too() -> None:
    log = replace(turned(0.5), imu=ImuSamples.empty(), inertial=False)
    sensor, _ = checked(log, declared())
    np.testing.assert_allclose(sensor.matrix, 0.5 * np.eye(3), atol=0.002, rtol=0)
    np.testing.assert_allclose(sensor.offset, OFFSET, atol=1e-7, rtol=0)  # T


@pytest.mark.slow
@pytest.mark.skipif(not RECORDING.is_dir(), reason="the recordings are not beside the repository")
def test_a_recorded_gain_is_found() -> None:
    site = load_site(RECORDING / "site.yaml", without=True)
    sensor, trust = checked(open_log(RECORDING), site)
    assert trust.verdict is Verdict.TRUSTWORTHY
    np.testing.assert_allclose(sensor.matrix, 0.8 * np.eye(3), atol=0.001, rtol=0)
    np.testing.assert_allclose(sensor.offset, OFFSET, atol=2e-8, rtol=0)  # T
