"""What is wrong with single samples of a recording is left out, counted and said."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.samples import clipped_samples
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log


@pytest.mark.slow
def test_false_inertial_samples_are_left_out_and_counted() -> None:
    site, rng = demo_site(), np.random.default_rng(6)
    log = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=20.0), rng).log
    assert clean_log(log, site) is log
    rows = rng.choice(np.arange(10, len(log.imu) - 10), 12, replace=False)
    gyro = log.imu.gyro_body.copy()
    gyro[rows] += rng.choice([-4.0, 4.0], (12, 3))  # rad/s
    corrupted = replace(log, imu=replace(log.imu, gyro_body=gyro))
    good = clean_log(corrupted, site)
    assert len(log.imu) - len(good.imu) >= 11
    assert not np.isin(log.imu.time[rows], good.imu.time).any()
    (finding,) = good.findings
    assert finding.code == "imu_spikes"
    assert finding.verdict is Verdict.TRUSTWORTHY
    errors = trajectory_errors(smooth(corrupted, site).states, log.truth)
    whole = trajectory_errors(smooth(log, site).states, log.truth)
    assert errors.attitude_rmse_deg < 1.2 * whole.attitude_rmse_deg + 0.01  # deg
    assert errors.ate < 1.2 * whole.ate + 0.0005  # m


def test_a_false_magnetometer_sample_is_a_missing_one() -> None:
    site, rng = demo_site(), np.random.default_rng(7)
    log = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=12.0), rng).log
    assert log.waveform is not None
    field = log.waveform.measured_sensor.copy()
    rows = np.arange(100, len(field) - 100, 400)
    field[rows, 1] += 3e-4  # T
    corrupted = replace(log, waveform=replace(log.waveform, measured_sensor=field))
    good = clean_log(corrupted, site)
    assert good.waveform is not None
    np.testing.assert_array_equal(good.waveform.time, np.delete(log.waveform.time, rows))
    assert [finding.code for finding in good.findings] == ["false_samples"]


def test_an_imu_that_hung_is_one_that_fell_silent() -> None:
    site, rng = demo_site(coil_radius=None), np.random.default_rng(8)
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=8.0, magnetometer_rate_hz=200.0)
    log = simulate_log(site, plan, rng).log
    hung = slice(700, 1000)  # 1.5 s
    gyro, accel = log.imu.gyro_body.copy(), log.imu.accel_body.copy()
    gyro[hung], accel[hung] = gyro[700], accel[700]
    corrupted = replace(log, imu=replace(log.imu, gyro_body=gyro, accel_body=accel))
    good = clean_log(corrupted, site)
    np.testing.assert_array_equal(good.imu.time, np.delete(log.imu.time, np.arange(701, 1000)))
    assert {finding.code for finding in good.findings} == {"frozen_imu"}
    assert all(finding.verdict is Verdict.TRUSTWORTHY for finding in good.findings)
    result = smooth(corrupted, site, SmootherSettings(tune=False))
    errors = trajectory_errors(result.states, log.truth)
    inside = (errors.time > log.imu.time[700]) & (errors.time < log.imu.time[1000])
    assert errors.nees is not None
    assert np.sum(inside) >= 7  # windows
    assert np.max(np.linalg.norm(errors.position_world[inside], axis=1)) < 0.1  # m
    assert np.mean(errors.nees[inside]) < 12.0


@cache
def walked() -> Log:
    site, rng = demo_site(coil_radius=None), np.random.default_rng(9)
    return simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=12.0), rng).log


STREAMS = ["gyro", "accel", "field"]


def with_spikes(log: Log, stream: str, rows: list[int], size: float, axis: int = 0) -> Log:
    """Return a log of which an axis is off in some rows, in the stream's unit."""
    wave = log.waveform
    assert wave is not None
    gyro, accel, field = (
        values.copy() for values in (log.imu.gyro_body, log.imu.accel_body, wave.measured_sensor)
    )
    {"gyro": gyro, "accel": accel, "field": field}[stream][rows, axis] += size
    imu = replace(log.imu, gyro_body=gyro, accel_body=accel)
    return replace(log, imu=imu, waveform=replace(wave, measured_sensor=field))


def missing_rows(log: Log, good: Log, stream: str) -> list[int]:
    assert log.waveform is not None
    assert good.waveform is not None
    if stream == "field":
        time, kept = log.waveform.time, good.waveform.time
    else:
        time, kept = log.imu.time, good.imu.time
    nearest = np.min(np.abs(time[:, None] - kept), axis=1)
    return np.flatnonzero(nearest > 1e-4).tolist()


@pytest.mark.parametrize("size", [6.0, -35.0, 1e4, 1e19])
@pytest.mark.parametrize("rows", [[700], [2, 2397], [2, 300, 650], list(range(40, 1000, 120))])
@pytest.mark.parametrize("stream", STREAMS)
def test_few_false_samples_are_left_out_as_many_are(
    stream: str, rows: list[int], size: float
) -> None:
    log, site = walked(), demo_site(coil_radius=None)
    good = clean_log(with_spikes(log, stream, rows, size, axis=1), site)
    assert missing_rows(log, good, stream) == rows
    (finding,) = good.findings
    assert f" {len(rows)} isolated samples" in finding.text
    assert finding.verdict is Verdict.TRUSTWORTHY


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("row", [0, 1, -2, -1])
def test_a_false_sample_at_an_end_is_left_out(stream: str, row: int) -> None:
    log, site = walked(), demo_site(coil_radius=None)
    good = clean_log(with_spikes(log, stream, [row], 35.0), site)
    count = 4800 if stream == "field" else 2400
    assert missing_rows(log, good, stream) == [row % count]
    assert [f.code for f in good.findings] == [
        "false_samples" if stream == "field" else "imu_spikes"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("stream", ["gyro", "accel"])
def test_one_false_inertial_sample_does_not_move_the_trajectory(stream: str) -> None:
    log, site = walked(), demo_site(coil_radius=None)
    whole = trajectory_errors(smooth(log, site).states, log.truth)
    corrupted = smooth(with_spikes(log, stream, [900], 35.0), site)
    assert trajectory_errors(corrupted.states, log.truth).ate < 1.2 * whole.ate + 2e-4  # m


def test_of_two_false_samples_two_apart_both_are_left_out() -> None:
    log, site = walked(), demo_site(coil_radius=None)
    good = clean_log(with_spikes(log, "gyro", [900, 902], 35.0), site)
    kept = np.delete(log.imu.time, [900, 902])
    np.testing.assert_array_equal(good.imu.time, kept)


def test_fast_motion_and_knocks_lose_nothing() -> None:
    log, site = walked(), demo_site(coil_radius=None)
    time, gyro, accel = log.imu.time, log.imu.gyro_body.copy(), log.imu.accel_body.copy()
    # 14 rad/s are 800 deg/s, in bursts of a second.
    shaken = 14.0 * np.sin(2.0 * np.pi * 6.0 * time) * np.sin(0.5 * np.pi * time).clip(0.0) ** 2
    gyro[:, 2] += shaken
    accel[:, 0] += 0.05 * shaken**2  # of a lever arm
    knock = 60.0 * np.exp(-np.arange(8) / 2.0) * np.cos(1.5 * np.arange(8))  # m/s^2
    accel[500:508, 2] += knock
    fast = replace(log, imu=replace(log.imu, gyro_body=gyro, accel_body=accel))
    assert clean_log(fast, site) is fast


def test_an_instrument_of_coarse_steps_loses_nothing() -> None:
    log, site = walked(), demo_site(coil_radius=None)
    rng, gyro = np.random.default_rng(3), np.zeros_like(log.imu.gyro_body)
    gyro[rng.choice(len(gyro), 40, replace=False), 1] = 0.02  # rad/s; one step, now and then
    accel = np.round(log.imu.accel_body, 1)
    coarse = replace(log, imu=replace(log.imu, gyro_body=gyro, accel_body=accel))
    assert not clean_log(coarse, site).findings


def test_false_samples_beside_lost_ones_are_left_out() -> None:
    log, site = walked(), demo_site(coil_radius=None)
    wave = log.waveform
    assert wave is not None
    rng = np.random.default_rng(5)
    kept = np.sort(rng.choice(len(wave), int(0.95 * len(wave)), replace=False))
    lost = replace(log, waveform=wave.rows(kept))
    assert not [f for f in clean_log(lost, site).findings if f.code == "false_samples"]
    good = clean_log(with_spikes(lost, "field", [900], 1e-3), site)
    assert missing_rows(lost, good, "field") == [900]


def test_a_log_without_an_imu_loses_its_false_samples_too() -> None:
    site = demo_site(coil_radius=None)
    log = replace(walked(), imu=ImuSamples.empty(), inertial=False)
    good = clean_log(with_spikes(log, "field", [700], 5.0), site)
    assert missing_rows(log, good, "field") == [700]


@pytest.mark.parametrize("name", ["imu", "magnetometer"])
def test_a_number_that_no_instrument_gives_is_a_missing_sample(name: str, tmp_path: Path) -> None:
    log, site = walked(), demo_site(coil_radius=None)
    rows = [300, 301, 302, 900]
    if name == "imu":
        rate = with_spikes(log, "gyro", rows[:2], 1e12)
        impossible = with_spikes(rate, "accel", rows[2:], -1e19, axis=2)
    else:
        impossible = with_spikes(log, "field", rows, 1e19)
    write_log(impossible, tmp_path / "log")
    read = open_log(tmp_path / "log")
    stream = "field" if name == "magnetometer" else "gyro"
    assert missing_rows(log, read, stream) == rows
    (finding,) = read.findings
    assert finding.code == "missing_samples"
    assert "4 samples are larger than any instrument measures" in finding.text
    assert not clean_log(read, site).findings[1:]


RANGES = {"gyro": 6.0, "accel": 30.0, "field": 2e-4}  # rad/s, m/s^2, T: of the walk, and no more


def _ranged(site: Site) -> Site:
    imu = replace(site.platform.imu, gyro_range=RANGES["gyro"], accel_range=RANGES["accel"])
    sensor = replace(site.platform.magnetometer, field_range=RANGES["field"])
    return replace(site, platform=replace(site.platform, imu=imu, magnetometer=sensor))


@pytest.mark.parametrize("stream", RANGES)
def test_a_sample_beyond_the_declared_range_is_a_missing_one(stream: str) -> None:
    """Seven in a row too, which no test of single samples sees; one at the range is clipped."""
    log, site = walked(), demo_site(coil_radius=None)
    rows, beyond = [*range(400, 407), 900], 1.5 * RANGES[stream]
    corrupted = _set(log, stream, rows, -beyond)
    ranged = clean_log(corrupted, _ranged(site))
    assert missing_rows(log, ranged, stream) == rows
    (finding,) = ranged.findings
    assert (finding.code, finding.verdict) == ("missing_samples", Verdict.TRUSTWORTHY)
    assert "8 samples are beyond the range" in finding.text
    clipped = clean_log(_set(log, stream, rows[:7], RANGES[stream]), _ranged(site))
    assert missing_rows(log, clipped, stream) == []
    (finding,) = clipped_samples(clipped, _ranged(site))
    assert (finding.code, finding.verdict) == ("saturated", Verdict.DOUBTFUL)
    assert "in 7 samples" in finding.text
    assert not [*clipped_samples(clean_log(log, _ranged(site)), _ranged(site))]


def test_a_range_that_most_samples_exceed_is_refused_by_its_key() -> None:
    log, site = walked(), demo_site(coil_radius=None)
    imu = replace(site.platform.imu, accel_range=2.0)  # m/s^2, of a weight of 9.8
    with pytest.raises(InputError, match=r"range of 2 in platform\.imu\.accel_range_m_s2, of "):
        clean_log(log, replace(site, platform=replace(site.platform, imu=imu)))


def _set(log: Log, stream: str, rows: list[int], value: float) -> Log:
    """Return a log whose samples have a value on an axis."""
    if stream == "field":
        assert log.waveform is not None
        field = log.waveform.measured_sensor.copy()
        field[rows, 1] = value
        return replace(log, waveform=replace(log.waveform, measured_sensor=field))
    own = getattr(log.imu, f"{stream}_body").copy()
    own[rows, 1] = value
    return replace(log, imu=replace(log.imu, **{f"{stream}_body": own}))


def test_numbers_of_a_wrong_unit_are_refused_and_not_left_out(tmp_path: Path) -> None:
    log = walked()
    assert log.waveform is not None
    nanotesla = replace(log.waveform, measured_sensor=1e9 * log.waveform.measured_sensor)
    write_log(replace(log, waveform=nanotesla), tmp_path / "log")
    with pytest.raises(InputError, match="another unit"):
        open_log(tmp_path / "log")


@pytest.mark.parametrize("size", [6.0, -35.0, 1e4, 1e19])
@pytest.mark.parametrize(
    "rows",
    [
        [900, 901],
        [900, 901, 902],
        list(range(900, 908)),
        [900, 902, 904],
        [300, 301, 310, 700, 701, 702],
    ],
)
@pytest.mark.parametrize("stream", STREAMS)
def test_false_samples_in_a_row_are_left_out(stream: str, rows: list[int], size: float) -> None:
    log, site = walked(), demo_site(coil_radius=None)
    good = clean_log(with_spikes(log, stream, rows, size, axis=2), site)
    assert missing_rows(log, good, stream) == rows
    (finding,) = good.findings
    assert f" {len(rows)} isolated samples" in finding.text
