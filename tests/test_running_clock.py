"""Stamps of batches, of bursts and rounded ones in a pipe: the samples are counted as in logs."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from spoiled_log import burst_stamps, host_stamps
from test_data_cleaning import walked
from test_spike_filter import navigated, rms, undisturbed

from magfusion.jobs.replay import run_replay
from magfusion.receiver.running_clock import ENOUGH, MAX_WAIT, RunningClock
from magfusion.receiver.sampling_clock import sampling_clock
from magfusion.units import Array

COUNT = 6000
STEP = 0.005  # s


def timed(stamps: Array, size: int = 7) -> tuple[Array, RunningClock, float]:
    """Return times of samples that come several at a time (s), and the longest wait (s)."""
    clock, rows = RunningClock(), np.random.default_rng(0).standard_normal((len(stamps), 3))
    times, values, wait = [], [], 0.0
    for k in range(0, len(stamps), size):
        time, own = clock.push(stamps[k : k + size], rows[k : k + size])
        times.append(time)
        values.append(own)
        sent, passed = min(k + size, len(stamps)), sum(len(t) for t in times)
        if passed < sent:
            wait = max(wait, float(stamps[sent - 1] - stamps[passed]))
    time, own = clock.end()
    np.testing.assert_array_equal(np.concatenate([*values, own]), rows)
    result = np.append(np.concatenate(times), time)
    assert np.all(np.diff(result) > 0.0)
    return result, clock, wait


def in_batches(time: Array, size: int = 8) -> Array:
    """Return the stamps of samples that a driver reads together."""
    row = np.arange(len(time))
    return time[np.minimum(row // size * size + size - 1, len(time) - 1)]


@pytest.mark.parametrize("size", [1, 8, 10])
def test_batches_with_one_stamp_are_spread_evenly(size: int) -> None:
    selected = STEP * np.arange(COUNT)
    time, clock, wait = timed(in_batches(selected), size)
    np.testing.assert_allclose(time, selected, rtol=0, atol=1e-9)
    assert clock.stamping == "counted"
    assert wait <= ENOUGH * STEP


def test_a_pause_of_batches_begins_a_clock_again() -> None:
    selected = STEP * np.arange(COUNT)
    selected[2400:] += 5.0013
    time, _, _ = timed(in_batches(selected))
    np.testing.assert_allclose(time, selected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_bursts_are_counted_as_in_a_log(seed: int) -> None:
    stamps = burst_stamps(COUNT, 99.0, np.random.default_rng(seed))
    whole = sampling_clock(stamps)
    assert whole is not None
    time, clock, wait = timed(stamps)
    off = time - whole.time
    assert 1.0 / clock.step == pytest.approx(99.0, rel=1e-3)
    assert wait <= MAX_WAIT + 0.1  # s, and a burst
    # The past is a minute at most: as certain as a log of that length, of stamps 31 ms off.
    assert np.std(off[:1000]) < 0.015  # s
    assert np.std(off[2000:]) < 0.005  # s


@pytest.mark.parametrize("gap", [0.0, 0.5])  # s
@pytest.mark.parametrize(
    ("rate_hz", "size", "lateness"),
    [(160.0, None, (0.05, 0.07)), (400.0, None, (0.024, 0.026)), (200.0, 4, (0.0, 3e-3))],
)
def test_bursts_of_samples_not_much_closer_than_usual_are_counted(
    rate_hz: float, size: int | None, lateness: tuple[float, float], gap: float
) -> None:
    rng = np.random.default_rng(5)
    inner = (1e-3, 1.3e-3) if size else (8e-4, 1.5e-3)
    stamps = host_stamps(COUNT, rate_hz, rng, inner, lateness, size)
    stamps = stamps[(stamps < 8.0) | (stamps >= 8.0 + gap)]
    whole = sampling_clock(stamps)
    assert whole is not None
    time, clock, _ = timed(stamps)
    assert clock.stamping == "counted"
    assert 1.0 / clock.step == pytest.approx(rate_hz, rel=2e-3)
    # Lateness is of a burst; a gap begins a clock again.
    assert np.std((time - whole.time)[-2000:]) < 0.01  # s


@pytest.mark.parametrize("rate_hz", [99.0, 150.0, 300.0, 400.0, 700.0])
@pytest.mark.parametrize("cut", [np.rint, np.floor])
def test_rounded_stamps_are_counted(rate_hz: float, cut: Callable[[Array], Array]) -> None:
    selected = np.arange(COUNT) / rate_hz
    time, clock, wait = timed(1e-3 * cut(1e3 * selected))
    assert clock.stamping == "rounded"
    assert np.std(time - selected) < 2e-5  # s; of the stamps 3e-4
    assert wait <= MAX_WAIT + 0.1  # s


@pytest.mark.parametrize("rate_hz", [130.0, 300.0, 400.0])
@pytest.mark.parametrize("jitter", [2e-4, 5e-4])
def test_rounded_stamps_of_a_host_that_jitters_and_loses_samples(
    rate_hz: float, jitter: float
) -> None:
    """A delayed sample is no loss, and a loss shifts the ticks of all that follow."""
    rng = np.random.default_rng(2)
    selected = (np.arange(COUNT) / rate_hz * (1.0 + 2e-5))[rng.random(COUNT) > 0.01]
    delayed = selected + np.abs(jitter * rng.standard_normal(len(selected)))
    stamps = np.maximum.accumulate(1e-3 * np.floor(1e3 * delayed))
    time, clock, _ = timed(stamps)
    assert clock.stamping == "rounded"
    off = (time - selected)[ENOUGH:]
    off = np.abs(off - np.median(off))  # s; of the stamps up to 2e-3
    near = off < 0.5 / rate_hz
    assert np.mean(near) > 0.998  # a delay by a step looks like a loss
    assert np.sqrt(np.mean(off[near] ** 2)) < 1e-4
    distinct = np.append(True, np.diff(stamps) > 0.0)
    whole = sampling_clock(stamps[distinct])
    assert whole is not None
    assert np.std(time[distinct][ENOUGH:] - whole.time[ENOUGH:]) < 2e-4  # s


@pytest.mark.parametrize("rate_hz", [250.25, 333.0])
@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_rounded_stamps_that_look_even_at_first_are_counted(rate_hz: float, lost: float) -> None:
    """Of 333 Hz in milliseconds, the first 166 steps are of 3 ms."""
    rng = np.random.default_rng(3)
    selected = (np.arange(COUNT) / rate_hz)[rng.random(COUNT) >= lost]
    time, clock, _ = timed(np.round(selected, 3))
    assert clock.stamping == "rounded"
    assert np.std((time - selected)[1000:]) < 1e-4  # s; of the stamps 2.9e-4


@pytest.mark.parametrize("rate_hz", [400.0, 600.0])
def test_pairs_of_losses_among_rounded_stamps_are_two(rate_hz: float) -> None:
    """A sample between two losses is not delayed, where many samples are lost."""
    rng = np.random.default_rng(3)
    selected = (np.arange(COUNT) / rate_hz)[rng.random(COUNT) >= 0.1]
    time, _, _ = timed(np.round(selected, 3))
    assert np.std((time - selected)[ENOUGH:]) < 1e-4  # s; of the stamps 2.9e-4


@pytest.mark.parametrize("kind", ["even", "lost", "jitter"])
def test_other_stamps_stay(kind: str) -> None:
    rng = np.random.default_rng(1)
    stamps = STEP * np.arange(COUNT)
    if kind == "lost":
        stamps = stamps[rng.random(COUNT) > 0.05]
    if kind == "jitter":
        stamps += 2e-4 * rng.standard_normal(COUNT)
    time, _, wait = timed(stamps)
    np.testing.assert_array_equal(time, stamps)
    assert wait <= (ENOUGH if kind == "lost" else 40) * 1.06 * STEP


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["batches", "rounded"])
def test_a_pipe_is_as_accurate_with_stamps_of_batches(kind: str, tmp_path: Path) -> None:
    log = walked()
    assert log.waveform is not None
    stamps = [
        in_batches(t) if kind == "batches" else 1e-3 * np.floor(1e3 * t)
        for t in (log.imu.time, log.waveform.time)
    ]
    sink = io.BytesIO()
    run_replay(log, sink, "json", realtime=False)
    given, place = (
        [json.loads(line) for line in sink.getvalue().splitlines()],
        {"imu": 0, "magnetometer": 0},
    )
    for record in given:
        for (name, own), stamp in zip(((n, record.get(n)) for n in place), stamps, strict=True):
            if own is not None:
                first = place[name]
                place[name] += len(own["time"])
                own["time"] = stamp[first : place[name]].tolist()
    lines = b"".join(json.dumps(one).encode() + b"\n" for one in given)
    expected, result = undisturbed("ekf"), navigated(lines, "ekf", tmp_path)
    assert result[2].count("an even clock of") == (
        2 if kind == "batches" else result[2].count("\n")
    )
    # Milliseconds that are rounded down make the magnetometer's stamps a quarter of one early.
    moved = 2.5e-4 * 1.0 if kind == "rounded" else 0.0  # m, at 1 m/s
    for own, whole, more in zip(result[:2], expected[:2], (moved, 0.0), strict=True):
        assert rms(own) < 1.2 * rms(whole) + more
