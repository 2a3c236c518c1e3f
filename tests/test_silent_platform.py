"""A platform whose streams are all silent for minutes or a day: it starts again by itself."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from online_log import OnlineLog, epoch, online_log

from magfusion.estimation.graph.state import ACCEL_BIAS, GYRO_BIAS, MOTION
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.simulation.log import EPOCH_NS

BEFORE, END, STEP = 25.0, 45.0, 0.25  # s
MINUTES, DAY = 150.0, 86400.0  # s
SPREAD = 0.03  # of the moments


@pytest.fixture(scope="module")
def log() -> OnlineLog:
    return online_log(3, END, every=STEP)


def declared(log: OnlineLog) -> Site:
    """Return the site with moments that are wrong as its sigma has it."""
    rng, beacons = np.random.default_rng(7), []
    for beacon in log.site.beacons:
        share = np.exp(SPREAD * rng.standard_normal(len(beacon.coils)))
        pairs = zip(beacon.coils, share, strict=True)
        coils = tuple(replace(c, moment_beacon=c.moment_beacon * by) for c, by in pairs)
        sigma = replace(beacon.sigma, log_moment=np.full(len(coils), SPREAD))
        beacons.append(replace(beacon, coils=coils, sigma=sigma))
    return replace(log.site, beacons=tuple(beacons))


def walked(
    log: OnlineLog, navigator: Navigator, begin: float, end: float, later: float
) -> tuple[Navigator, list[JudgedState]]:
    states: list[JudgedState] = []
    arrival = log.fields.time + log.fields.window / 2.0
    for now in np.arange(begin, end, STEP):
        if navigator.is_after_silence(now + later):
            navigator = navigator.restarted()
        own = (log.imu.time >= now) & (log.imu.time < now + STEP)
        time = log.imu.time[own] + later
        navigator.add_imu(time, log.imu.gyro_body[own], log.imu.accel_body[own])
        for k in np.flatnonzero((arrival >= now) & (arrival < now + STEP)).tolist():
            one = epoch(log.fields, k)
            navigator.add_fields(replace(one, time=one.time + later))
        states += navigator.take()
    return navigator, states


def sigmas(state: JudgedState) -> np.ndarray:
    return np.sqrt(np.diagonal(state.cov))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", pytest.param("smoother", marks=pytest.mark.slow)])
@pytest.mark.parametrize("silence", [MINUTES, DAY])
def test_it_starts_again_with_the_biases_and_calibration_of_before(
    log: OnlineLog, estimator: str, silence: float
) -> None:
    settings = NavigatorSettings(estimator)
    site = declared(log)
    navigator, before = walked(log, Navigator(site, settings), 0.0, BEFORE, 0.0)
    navigator, after = walked(log, navigator, BEFORE, END, silence)
    assert navigator.counts["started again"] == 1
    first, last = after[0], before[-1]
    assert first.time - silence < BEFORE + 10.0
    assert first.reset_counter == after[-1].reset_counter == last.reset_counter + 1
    assert all(state.verdict is Verdict.TRUSTWORTHY for state in after)
    _, alone = walked(log, Navigator(site, settings), BEFORE, END, silence)
    imu = site.platform.imu
    walks = np.sqrt(silence) * np.array([imu.gyro_bias_walk, imu.accel_bias_walk, 0.0])
    for part, walk in zip((GYRO_BIAS, ACCEL_BIAS, slice(MOTION, None)), walks, strict=True):
        own = sigmas(alone[0])[part]
        known = np.hypot(sigmas(last)[part], walk)
        # Moments have a walk of their own; estimates are correlated with other parameters.
        assert np.all(sigmas(first)[part] < 1.05 * own)
        assert np.all(sigmas(first)[part] < 1.3 * known) or silence == DAY
    errors = log.errors([replace(state, time=state.time - silence) for state in after])
    assert errors.ate < 0.01  # m
    assert errors.nees is not None
    assert 1.0 < np.mean(errors.nees) < 14.0


@pytest.mark.slow
def test_what_was_known_is_forgotten_where_instruments_are_exchanged(log: OnlineLog) -> None:
    """A gyro with another bias contradicts the earlier one: the data decide."""
    navigator, before = walked(log, Navigator(log.site, NavigatorSettings("ekf")), 0.0, 15.0, 0.0)
    other = np.array([0.02, -0.015, 0.01])  # rad/s
    imu = replace(log.imu, gyro_body=log.imu.gyro_body + other)
    _, after = walked(replace(log, imu=imu), navigator, 15.0, 25.0, MINUTES)
    change = after[-1].gyro_bias_body - before[-1].gyro_bias_body - other
    assert np.all(np.abs(change) < 5.0 * (sigmas(after[-1]) + sigmas(before[-1]))[GYRO_BIAS])


@pytest.mark.slow
def test_a_checkpoint_in_the_silence_keeps_what_was_known(log: OnlineLog) -> None:
    site, settings = declared(log), NavigatorSettings("ekf")
    navigator, _ = walked(log, Navigator(site, settings), 0.0, 15.0, 0.0)
    again = navigator.restarted()
    twin = restored(site, settings, again.checkpoint())
    (_, expected), (_, result) = (walked(log, n, 15.0, 22.0, MINUTES) for n in (again, twin))
    assert expected
    for one, other in zip(result, expected, strict=True):
        np.testing.assert_allclose(one.position_world, other.position_world, atol=1e-9)  # m


@pytest.mark.slow
def test_a_log_with_a_pause_of_minutes_is_navigated(log: OnlineLog, tmp_path: Path) -> None:
    def paused(time: np.ndarray) -> np.ndarray:
        return np.where(time < BEFORE, time, time + MINUTES)

    imu = ImuSamples(paused(log.imu.time), log.imu.gyro_body, log.imu.accel_body)
    fields: FieldSamples = replace(log.fields, time=paused(log.fields.time))
    write_log(Log("paused", EPOCH_NS, "test", imu, fields=fields), tmp_path / "log")
    save_site(log.site, tmp_path / "log" / "site.yaml")
    run_command("navigate", tmp_path / "log", "--estimator", "ekf", "-o", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    assert report["counted_started_again"] == 1
    assert report["duration_s"] > MINUTES
