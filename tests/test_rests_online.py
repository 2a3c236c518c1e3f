"""Rests as they last: sharpened stretch by stretch, in constant memory, with a reference or not."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from far_and_weak import (
    FAR_AWAY,
    FREQUENCIES_HZ,
    LATE,
    RATE,
    RATE_HZ,
    STORMS,
    errors_in_sigmas,
    far_site,
    monitored_log,
)

from magfusion.errors import InputError
from magfusion.estimation.rests.reference_noise_cancellation import JudgedTone
from magfusion.estimation.rests.rest_stream import FIRST, LATER, RestNavigator
from magfusion.estimation.rests.running_stationary_mean import RunningMean
from magfusion.estimation.rests.stationary_integration import IntegratedRests, Rest, integrate_rests
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.files.stream import read_records
from magfusion.jobs.navigate_rests import How, replayed, run_rests_stream
from magfusion.jobs.replay import run_replay
from magfusion.model.samples import FieldSamples, Waveform
from magfusion.model.trust import Risk
from magfusion.receiver.integration import Integrated
from magfusion.receiver.reference_clock import ReferenceClock, lag_in
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests
from magfusion.units import Array, ComplexArray

CHANNELS, FREEDOM = 4, 20


def stretch(site_channels: tuple[tuple[str, int], ...], rng: np.random.Generator) -> Rest:
    """Return a stretch of unit noise alone, with covariances that as many readings tell."""
    others = rng.standard_normal((CHANNELS, FREEDOM, 3))
    cov = np.einsum("cki,ckj->cij", others, others) / (FREEDOM - 4.0)
    drawn = rng.standard_normal((2, CHANNELS, 3))
    phasor: ComplexArray = drawn[0] + 1j * drawn[1]
    fields = FieldSamples(np.zeros(1), np.full(1, 100.0), site_channels, phasor[None], cov[None])
    tones = [
        JudgedTone(
            Integrated(phasor[c], cov[c], FREEDOM, 0.0, 1.0), np.nan, detects=False, hidden=0.0
        )
        for c in range(CHANNELS)
    ]
    return Rest(fields, np.ones(CHANNELS), tones, None)


def test_stretches_add_up_with_a_true_covariance_and_no_more_false_alarms() -> None:
    site, rng, square, alarms, requested = far_site(), np.random.default_rng(5), [], 0, 0.05
    runs, looks = 150, 8
    for _ in range(runs):
        running, strong = RunningMean.begun(0.0, CHANNELS), np.zeros(CHANNELS, dtype=bool)
        for k in range(looks):
            one = stretch(site.channels, rng)
            running = running.with_stretch(one, site, 100.0 * (k + 1), 1e9, requested)
            strong |= running.chance(site) < requested
        alarms += int(np.sum(strong))
        result = running.fields(site, 1e9)
        error, cov = result.phasor_sensor[0], result.phasor_cov[0]
        solved = np.linalg.solve(cov, error[..., None])[..., 0]
        square.append(np.real(np.sum(np.conj(error) * solved, axis=1)))
    count = runs * CHANNELS
    assert abs(float(np.mean(square)) - 6.0) < 4.0 * np.sqrt(12.0 / count) + 0.3
    # All looks of a rest together: at most what was asked, and not much less than a third of it.
    assert 0.2 * requested < alarms / count < requested + 4.0 * np.sqrt(requested / count)


def test_what_is_older_weighs_less_where_phases_wander() -> None:
    site, rng = far_site(), np.random.default_rng(6)
    steady, wandering = RunningMean.begun(0.0, CHANNELS), RunningMean.begun(0.0, CHANNELS)
    for k in range(20):
        one = stretch(site.channels, rng)
        steady = steady.with_stretch(one, site, 100.0 * (k + 1), 1e9, 0.01)
        wandering = wandering.with_stretch(one, site, 100.0 * (k + 1), 400.0, 0.01)
    share = np.trace(wandering.information, axis1=1, axis2=2) / np.trace(
        steady.information, axis1=1, axis2=2
    )
    assert np.all((share > 0.1) & (share < 0.35))  # four of twenty


def test_the_clock_of_a_reference_is_followed() -> None:
    built = monitored_log(far_site(), 300.0, 1, FAR_AWAY, STORMS, -0.4, 3e-5)
    wave, reference, clock = built.log.waveform, built.log.reference, ReferenceClock()
    assert wave is not None
    assert reference is not None
    for begin in (0.0, 100.0, 200.0):
        rows = slice(*np.searchsorted(wave.time, [begin, begin + 100.0]))
        near = slice(*np.searchsorted(reference.time, [begin - 10.0, begin + 110.0]))
        seen = lag_in(wave.rows(rows), reference.rows(near), np.array(FREQUENCIES_HZ))
        assert seen is not None
        clock = clock.updated(*seen)
    line = clock.line
    assert line is not None
    at = np.array([0.0, 300.0])
    np.testing.assert_allclose(line.of(at) - at, -0.4 + 3e-5 * at, atol=1e-3)


@pytest.mark.slow
def test_a_rest_in_stretches_is_what_it_is_at_once_and_a_reference_that_fails_is_said() -> None:
    built = monitored_log(far_site(), 300.0, 4, FAR_AWAY, STORMS, LATE, RATE)
    site, reference = built.true_site, built.log.reference
    assert reference is not None
    navigator = RestNavigator(site)
    states = replayed(built.log, navigator)
    # Memory: a stretch and what is waited for, however long it rests.
    assert navigator.kept < (LATER + 30.0) * (2.0 * RATE_HZ + 25.0)
    whole = integrate_rests(built.log, site).fields
    last = states[-1].samples
    assert last is not None
    assert [state.duration for state in states[:2]] == [FIRST, FIRST + LATER]
    ratio = sigma(last) / sigma(whole)
    assert np.all((ratio > 0.5) & (ratio < 2.0))
    assert np.nanmin(states[-1].gain) > 4.0
    assert np.mean(square_of(last, built)) < 6.0 + 4.0 * np.sqrt(12.0 / 4.0)
    there = reference.time < 150.0
    cut = Waveform(reference.time[there], reference.measured_sensor[there])
    failing = replayed(replace(built.log, reference=cut), RestNavigator(site))
    codes = [{f.code for f in state.trust.findings} for state in failing]
    assert "reference_unused" not in codes[0]
    assert "reference_unused" in codes[-1]
    assert failing[-1].samples is not None
    assert np.mean(square_of(failing[-1].samples, built)) < 6.0 + 4.0 * np.sqrt(12.0 / 4.0)


def sigma(samples: FieldSamples) -> Array:
    return np.asarray(np.sqrt(np.trace(samples.phasor_cov[0], axis1=1, axis2=2)))


def square_of(samples: FieldSamples, simulation: SimulatedLog) -> Array:
    none = np.zeros((1, CHANNELS))
    return errors_in_sigmas(IntegratedRests(samples, none, none == 0.0, {}), simulation)


@pytest.mark.slow
def test_rests_go_through_log_and_pipe(tmp_path: Path, refuse: Refuse) -> None:
    site = far_site(2e4)
    config = SimulationConfig(
        box_world=np.array([[-20.0, -20.0, -3.0], [20.0, 20.0, 3.0]]),
        duration=160.0,
        rests=Rests(start=60.0, move=10.0, pause=60.0),
        imu_rate_hz=50.0,
        magnetometer_rate_hz=RATE_HZ,
        perturb=False,
    )
    built = simulate_log(site, config, np.random.default_rng(4))
    write_log(built.log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("navigate", tmp_path / "log", "--at-rest", "-o", tmp_path / "run")
    reported = json.loads((tmp_path / "run" / "report.json").read_text())
    assert reported["rests"] >= 2
    assert reported["nees_mean"] < 6.0 + 4.0 * np.sqrt(12.0 / 2.0)
    source, sink, messages = io.BytesIO(), io.BytesIO(), io.StringIO()
    other = Waveform(np.arange(0.0, 100.0, 0.1), np.zeros((1000, 3)))
    run_replay(replace(built.log, reference=other), source, "json", realtime=False)
    assert b'"reference"' in source.getvalue()
    source.seek(0)
    how = How(None, 1e-3, Risk())
    assert run_rests_stream(site, how, read_records(source, "json"), False, sink, messages) == 0
    lines = [json.loads(line) for line in sink.getvalue().splitlines()]
    standing = [line["standing"] for line in lines]
    assert standing[0]
    assert False in standing
    assert True in standing[standing.index(False) :]
    truth = built.log.truth
    assert truth is not None
    for line in lines:
        if line["standing"] and line["position"] is not None:
            there = truth.position_world[np.searchsorted(truth.time, line["time"]) - 1]
            away = np.abs(np.array(line["position"]) - there)
            assert np.all(away < 5.0 * np.array(line["sigma"]["position"]))
    findings = refuse("navigate", tmp_path / "log", "--at-rest", "--rate", "imu", "-o", "x")
    assert "--rate is for navigation in motion" in findings


@pytest.mark.parametrize(
    ("record", "reported"),
    [
        ({"reference": {"time": [0.0, 1.0], "field": [[0, 0, 0]]}}, "field has 1 rows for 2"),
        ({"reference": {"time": [0.0], "field": [[0, 0]]}}, "three numbers"),
        (
            {"fields": {"time": 1.0, "window": 0.4, "sigma": 1e-9, "phasors": {}}},
            "omit fields",
        ),
    ],
)
def test_a_record_that_cannot_be_is_refused(record: dict[str, object], reported: str) -> None:
    source = io.BytesIO(json.dumps(record).encode() + b"\n")
    how = How(None, 1e-3, Risk())
    records = read_records(source, "json")
    with pytest.raises(InputError, match=reported):
        run_rests_stream(far_site(), how, records, False, io.BytesIO(), io.StringIO())
