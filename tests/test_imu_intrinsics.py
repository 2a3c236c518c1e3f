"""IMU errors and a magnetometer's clock that a site declares are taken off the samples."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_problem import small_log

from magfusion.estimation.online.navigator import Navigator
from magfusion.files.site import load_site, save_site
from magfusion.files.site_changes import changed_keys
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.without_imu import as_recorded, logged

SMALL = small_log(5, epochs=30)
INTRINSICS = ImuIntrinsics(
    np.array([[1.02, 0.01, 0.0], [-0.01, 0.99, 0.0], [0.0, 0.02, 1.01]]),
    np.diag([1.01, 0.98, 1.0]),
    np.array([[1e-3, 0.0, 0.0], [0.0, 2e-3, 0.0], [5e-4, 0.0, 0.0]]),
)


def distorted(imu: ImuSamples, by: ImuIntrinsics) -> ImuSamples:
    gyro = imu.gyro_body @ by.gyro_matrix.T + imu.accel_body @ by.gyro_g_sensitivity.T
    return ImuSamples(imu.time, gyro, imu.accel_body @ by.accel_matrix.T)


def declaring(site: Site, by: ImuIntrinsics | None) -> Site:
    return replace(site, platform=replace(site.platform, imu_intrinsics=by))


def on_rate(site: Site, rate: float) -> Site:
    sensor = replace(site.platform.magnetometer, clock_rate=rate)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


@given(st.integers(0, 1000))
def test_declared_errors_are_taken_off(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = ImuSamples(np.arange(5.0), rng.standard_normal((5, 3)), rng.standard_normal((5, 3)))
    measured = distorted(true, INTRINSICS)
    gyro, accel = INTRINSICS.corrected(measured.gyro_body, measured.accel_body)
    np.testing.assert_allclose(gyro, true.gyro_body, atol=1e-12)
    np.testing.assert_allclose(accel, true.accel_body, atol=1e-12)


def test_a_log_is_corrected_once_and_again_by_another_site() -> None:
    site = declaring(SMALL.site, INTRINSICS)
    recorded = replace(SMALL.log, imu=distorted(SMALL.log.imu, INTRINSICS))
    once, _ = logged(recorded, site)
    np.testing.assert_allclose(once.imu.gyro_body, SMALL.log.imu.gyro_body, atol=1e-12)
    twice, _ = logged(once, site)
    np.testing.assert_array_equal(twice.imu.gyro_body, once.imu.gyro_body)
    back, _ = logged(once, SMALL.site)
    np.testing.assert_array_equal(back.imu.gyro_body, recorded.imu.gyro_body)
    np.testing.assert_array_equal(as_recorded(once).imu.accel_body, recorded.imu.accel_body)


def test_stamps_of_a_single_magnetometer_are_moved_once_and_back() -> None:
    wave = Waveform(np.linspace(0.0, 100.0, 11), np.zeros((11, 3)))
    log = Log("late", 0, "simulated", SMALL.log.imu, wave)
    sensor = replace(SMALL.site.platform.magnetometer, clock_offset=-0.05, clock_rate=1e-4)
    site = replace(SMALL.site, platform=replace(SMALL.site.platform, magnetometer=sensor))
    once, _ = logged(log, site)
    twice, _ = logged(once, site)
    assert once.waveform is not None
    assert twice.waveform is not None
    expected = 1.0001 * wave.time - 0.05
    np.testing.assert_allclose(once.waveform.time, expected, rtol=1e-12)
    np.testing.assert_array_equal(twice.waveform.time, once.waveform.time)
    np.testing.assert_allclose(site.platform.on_drive_clock(wave.time), expected, rtol=1e-12)
    recorded = as_recorded(once).waveform
    assert recorded is not None
    np.testing.assert_allclose(recorded.time, wave.time, rtol=0.0, atol=1e-9)


def test_a_clock_that_is_fast_is_slowed_once() -> None:
    time = np.linspace(0.0, 100.0, 11)
    wave = Waveform(1.0002 * time, np.zeros((11, 3)))  # stamps run 200 ppm fast
    log = Log("fast", 0, "simulated", SMALL.log.imu, wave)
    site = on_rate(SMALL.site, 1.0 / 1.0002 - 1.0)
    once, _ = logged(log, site)
    assert once.waveform is not None
    np.testing.assert_allclose(once.waveform.time, time, atol=1e-12)
    twice, _ = logged(once, site)
    assert twice.waveform is not None
    np.testing.assert_array_equal(twice.waveform.time, once.waveform.time)
    recorded = as_recorded(once).waveform
    assert recorded is not None
    np.testing.assert_allclose(recorded.time, wave.time, atol=1e-12)


def test_the_file_keeps_them_and_names_what_changed(tmp_path: Path) -> None:
    site = on_rate(declaring(SMALL.site, INTRINSICS), 2.4e-4)
    save_site(site, tmp_path / "site.yaml")
    read = load_site(tmp_path / "site.yaml")
    known = read.platform.imu_intrinsics
    assert known is not None
    for name, value in vars(INTRINSICS).items():
        np.testing.assert_array_equal(getattr(known, name), value)
    assert read.platform.magnetometer.clock_rate == 2.4e-4
    changed = changed_keys(SMALL.site, site)
    assert set(changed) == {
        "platform.imu_intrinsics.gyro_matrix",
        "platform.imu_intrinsics.accel_matrix",
        "platform.imu_intrinsics.gyro_g_sensitivity",
        "platform.magnetometer.clock_rate_ppm",
    }
    assert changed["platform.magnetometer.clock_rate_ppm"] == pytest.approx(240.0, rel=1e-12)


def test_a_navigator_takes_them_off_what_arrives() -> None:
    site, imu = declaring(SMALL.site, INTRINSICS), SMALL.log.imu
    measured = distorted(imu, INTRINSICS)
    corrected, plain = Navigator(site), Navigator(SMALL.site)
    corrected.propagate_imu(measured.time, measured.gyro_body, measured.accel_body)
    plain.propagate_imu(imu.time, imu.gyro_body, imu.accel_body)
    buffers = (navigator._loop.arrived.imu.buffer for navigator in (corrected, plain))
    for one, other in zip(*(buffer.rows() for buffer in buffers), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
