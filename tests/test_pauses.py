"""Samples that a multiplexer repeats are left out; what an instrument repeats itself is not."""

import io
from dataclasses import replace

import numpy as np
import pytest
from test_coarse_magnetometer import recorded, weak_site

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.data_quality import recorded as findings_of
from magfusion.estimation.data_checks.pauses import MAX_WAIT, PauseFilter, pause_rows
from magfusion.estimation.data_checks.samples import streams
from magfusion.jobs.stream_samples import StreamSamples
from magfusion.model.samples import Log
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array, BoolArray

PATTERNS = ((20, 4), (40, 12), (400, 120))  # samples: period, and repeated at its end


def repeated_in(count: int, period: int, length: int) -> BoolArray:
    return np.arange(count) % period >= period - length


def paused(log: Log, period: int, length: int) -> Log:
    """Return a log whose magnetometer repeats a value at the end of each period."""
    assert log.waveform is not None
    row = np.arange(len(log.waveform))
    row[repeated_in(len(row), period, length)] = -1
    value = log.waveform.measured_sensor[np.maximum.accumulate(row)]
    return replace(log, waveform=replace(log.waveform, measured_sensor=value))


def walked(step: float | None = None) -> Log:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=10.0, quantisation=step)
    return simulate_log(demo_site(), config, np.random.default_rng(4)).log


def passed(filter_: PauseFilter, time: Array, rows: Array, size: int) -> Array:
    """Return the stamps of the samples that pass a filter in pieces."""
    own = [
        filter_.push(time[k : k + size], rows[k : k + size])[0] for k in range(0, len(time), size)
    ]
    return np.concatenate([*own, filter_.push(time[:0], rows[:0], final=True)[0]])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("step", [None, 5e-9])
def test_repeated_samples_are_left_out_and_counted(
    pattern: tuple[int, int], step: float | None
) -> None:
    site, whole = demo_site(), walked(step)
    log = paused(whole, *pattern)
    assert log.waveform is not None
    again = repeated_in(len(log.waveform), *pattern)
    cleaned = clean_log(log, site)
    assert cleaned.waveform is not None
    np.testing.assert_array_equal(cleaned.waveform.time, log.waveform.time[~again])
    (noted,) = [f for f in findings_of(cleaned, site, beacons=True) if "magnetometer" in f.text]
    assert noted.code == "repeated_samples"
    assert f"{np.sum(again)} samples" in noted.text
    assert noted.verdict is Verdict.TRUSTWORTHY
    assert clean_log(whole, site).findings == ()


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [1, 7, 64])
def test_a_stream_loses_the_same_samples(pattern: tuple[int, int], size: int) -> None:
    wave = paused(walked(), *pattern).waveform
    assert wave is not None
    again, own = repeated_in(len(wave), *pattern), PauseFilter()
    time = passed(own, wave.time, wave.measured_sensor, size)
    np.testing.assert_array_equal(time, wave.time[~again])
    assert own.left_out == np.sum(again)


def test_a_stream_reports_them() -> None:
    wave, samples = paused(walked(), 20, 4).waveform, StreamSamples(demo_site())
    assert wave is not None
    samples.tested("magnetometer", wave.time, wave.measured_sensor)
    list(samples.end())
    messages = io.StringIO()
    samples.report(messages)
    assert f"{len(wave) // 5} samples repeat the last one" in messages.getvalue()


@pytest.mark.parametrize("faster", [1.3, 2.3, 4.0])
def test_an_instrument_read_too_fast_keeps_its_samples(faster: float) -> None:
    """Its values are late, all of them; which is the first of each is no better known."""
    log = walked()
    assert log.waveform is not None
    row = np.floor(np.arange(len(log.waveform)) / faster).astype(int)
    value = log.waveform.measured_sensor[row]
    log = replace(log, waveform=replace(log.waveform, measured_sensor=value))
    assert log.waveform is not None
    assert len(pause_rows(streams(log)[-1])) == 0
    assert len(passed(PauseFilter(), log.waveform.time, value, 16)) == len(value)


@pytest.mark.parametrize("motion", ["walk", "turn", "static"])
@pytest.mark.parametrize("step", [0.15e-6, 0.6e-6])
def test_a_coarse_magnetometer_at_rest_keeps_its_samples(motion: str, step: float) -> None:
    log = recorded(motion, step)
    assert log.waveform is not None
    kept = clean_log(log, weak_site()).waveform
    assert kept is not None
    assert len(kept) > 0.999 * len(log.waveform)
    time = passed(PauseFilter(), log.waveform.time, log.waveform.measured_sensor, 16)
    assert len(time) > 0.999 * len(log.waveform)


def test_a_frozen_stream_does_not_wait_for_its_end() -> None:
    wave, own = walked().waveform, PauseFilter()
    assert wave is not None
    value = wave.measured_sensor.copy()
    value[2000:] = value[2000]
    for k in range(len(wave)):
        own.push(wave.time[k : k + 1], value[k : k + 1])
        waiting = own._time
        assert len(waiting) < 2 or waiting[-1] - waiting[0] <= MAX_WAIT
    assert own.left_out == 0


@pytest.mark.slow
@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_paused_log_gives_the_motion(pattern: tuple[int, int]) -> None:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0)
    simulated = simulate_log(demo_site(), config, np.random.default_rng(4))
    result = smooth(paused(simulated.log, *pattern), demo_site())
    truth = simulated.motion.trajectory(result.states.time).position_world
    error = np.linalg.norm(result.states.position_world - truth, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.01  # m
