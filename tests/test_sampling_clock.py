"""The even clock under stamps that scatter: ticks, lost samples, drift, and what is none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from spoiled_log import burst_stamps, host_stamps

from magfusion.estimation.data_checks.stamps import timing, uneven_stamps
from magfusion.model.batches import spread_batches
from magfusion.model.samples import ImuSamples, Log, StreamClock, Waveform
from magfusion.model.trust import Finding
from magfusion.receiver.bursts import spread_bursts
from magfusion.receiver.even_clocks import on_even_clocks
from magfusion.receiver.sampling_clock import sampling_clock
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

STEP = 0.0035  # s
COUNT = 6000


def _stamped(
    scatter: float, share_lost: float = 0.0, drift_ppm: float = 0.0, seed: int = 1
) -> tuple[Array, Array]:
    """Return when samples were taken and how a host stamped them (s)."""
    rng = np.random.default_rng(seed)
    tick = np.arange(COUNT)[rng.random(COUNT) >= share_lost]
    selected = STEP * tick * (1.0 + 1e-6 * drift_ppm * np.sin(0.2 * np.pi * tick / COUNT))
    stamps = selected + STEP * scatter * rng.standard_normal(len(selected))
    kept = np.concatenate([[True], np.diff(np.maximum.accumulate(stamps)) > 0.0])
    return selected[kept], stamps[kept]


@pytest.mark.parametrize(
    ("scatter", "share_lost", "drift_ppm"),
    [(0.05, 0.0, 0.0), (0.05, 0.1, 0.0), (0.1, 0.05, 50.0), (0.2, 0.01, 0.0), (0.25, 0.0, 100.0)],
)
def test_samples_get_their_ticks_back(scatter: float, share_lost: float, drift_ppm: float) -> None:
    selected, stamps = _stamped(scatter, share_lost, drift_ppm)
    clock = sampling_clock(stamps)
    assert clock is not None
    off = clock.time - selected
    assert np.mean(np.abs(off) > 0.5 * STEP) < 0.01  # given another tick
    assert np.median(np.abs(off)) < 0.1 * scatter * STEP + 1e-5  # s
    assert clock.scatter == pytest.approx(scatter * STEP, rel=0.1)
    assert np.all(np.diff(clock.time) > 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_scatter_of_stamps_does_not_bend_an_even_clock(seed: int) -> None:
    selected, stamps = _stamped(0.1, seed=seed)
    clock = sampling_clock(stamps)
    assert clock is not None
    assert np.ptp(np.diff(clock.time)) < 1e-12  # s
    rate = np.polyfit(selected, clock.time - selected, 1)[0]
    assert abs(rate) < 4.0 * np.sqrt(12.0 / len(selected)) * 0.1 * STEP / selected[-1]


def test_lost_samples_are_counted() -> None:
    _, stamps = _stamped(0.1, 0.05)
    clock = sampling_clock(stamps)
    assert clock is not None
    assert clock.lost_count == COUNT - len(stamps)


def test_a_clock_goes_on_behind_a_gap() -> None:
    selected, stamps = _stamped(0.1)
    kept = (selected < 8.0) | (selected > 11.0)
    clock = sampling_clock(stamps[kept])
    assert clock is not None
    assert np.max(np.abs(clock.time - selected[kept])) < 0.1 * STEP


@pytest.mark.parametrize("share_lost", [0.0, 0.2])
def test_even_stamps_stay(share_lost: float) -> None:
    selected, _ = _stamped(0.0, share_lost)
    assert sampling_clock(selected) is None


@pytest.mark.parametrize("share_lost", [0.002, 0.03])
@pytest.mark.parametrize("step", [0.002, 0.004, 0.005])
def test_even_stamps_that_miss_some_are_not_rounded(step: float, share_lost: float) -> None:
    """The largest common divisor of their steps is the step itself."""
    rng = np.random.default_rng(2)
    kept = np.arange(COUNT, dtype=float)[rng.random(COUNT) >= share_lost]
    assert sampling_clock(step * kept) is None


def test_stamps_without_a_clock_stay() -> None:
    rng = np.random.default_rng(2)
    assert sampling_clock(np.cumsum(rng.exponential(STEP, COUNT))) is None


@pytest.mark.parametrize("rate_hz", [99.0, 150.0, 210.0, 300.0, 400.0, 700.0])
@pytest.mark.parametrize("resolution", [1e-3, 1.0 / 1024.0])  # s
@pytest.mark.parametrize("cut", [np.rint, np.floor])
def test_rounded_stamps_count_their_samples(
    rate_hz: float, resolution: float, cut: Callable[[Array], Array]
) -> None:
    selected = np.arange(COUNT) / rate_hz
    stamps = resolution * cut(selected / resolution)
    clock, timed = sampling_clock(stamps), timing("magnetometer", stamps)
    assert clock is not None
    assert timed is not None
    assert clock.lost_count == 0
    assert clock.resolution == pytest.approx(resolution, rel=1e-5)
    assert timed.rate_hz == pytest.approx(rate_hz, rel=1e-4)
    assert timed.lost_share == 0.0
    off = clock.time - selected
    assert np.std(off) < 0.1 * resolution  # cutting off shifts all alike
    assert np.max(np.abs(off)) < 0.7 * resolution


def test_lost_samples_of_rounded_stamps_are_counted() -> None:
    rng = np.random.default_rng(1)
    selected = np.arange(COUNT)[rng.random(COUNT) >= 0.03] / 400.0
    timed = timing("magnetometer", 1e-3 * np.rint(1e3 * selected))
    assert timed is not None
    assert timed.rate_hz == pytest.approx(400.0, rel=1e-4)
    assert timed.lost_share == pytest.approx(0.03, abs=0.003)
    assert timed.resolution == 1e-3


@pytest.mark.parametrize("rate_hz", [99.7, 166.6, 199.3, 249.7, 333.0, 340.0])
@pytest.mark.parametrize("share_lost", [0.0, 0.03])
def test_rounded_stamps_of_almost_equal_steps_are_counted(
    rate_hz: float, share_lost: float
) -> None:
    """Steps of a sensor's own clock are a whole number of milliseconds for a second or more."""
    rng = np.random.default_rng(1)
    selected = np.arange(COUNT)[rng.random(COUNT) >= share_lost] / rate_hz
    clock = sampling_clock(1e-3 * np.rint(1e3 * selected))
    assert clock is not None
    assert clock.lost_count == COUNT - len(selected)
    assert clock.resolution == 1e-3
    assert np.std(clock.time - selected) < 3e-5  # s; of the stamps 3e-4


@pytest.mark.parametrize("seed", range(3))
def test_samples_that_a_host_delivers_in_bursts_are_counted(seed: int) -> None:
    stamps = burst_stamps(COUNT, 99.0, np.random.default_rng(seed))
    clock, timed = sampling_clock(stamps), timing("imu", stamps)
    assert clock is not None
    assert timed is not None
    assert timed.rate_hz == pytest.approx(99.0, rel=3e-3)  # 0.1 s late at either end, of 60 s
    assert timed.lost_share == 0.0
    assert np.ptp(np.diff(clock.time)) < 0.01 / 99.0  # s
    log = Log("bursts", 0, "", ImuSamples(stamps, np.ones((COUNT, 3)), np.ones((COUNT, 3))), None)
    assert {finding.code for finding in uneven_stamps(log, None)} == {"jitter"}


def _log() -> Log:
    return simulate_log(
        demo_site(), SimulationConfig(DEMO_BOX_WORLD, duration=12.0), np.random.default_rng(3)
    ).log


def _scattered(time: Array, seed: int) -> Array:
    step = float(np.median(np.diff(time)))
    stamps = time + 0.2 * step * np.random.default_rng(seed).standard_normal(len(time))
    return np.asarray(np.maximum.accumulate(stamps) + 1e-9 * np.arange(len(time)))


def test_the_tones_tell_a_host_that_stamps_late_from_a_sampler_that_samples_unevenly() -> None:
    site, log = demo_site(), _log()
    assert log.waveform is not None
    imu, waveform = log.imu, log.waveform
    late = replace(
        log,
        imu=ImuSamples(_scattered(imu.time, 1), imu.gyro_body, imu.accel_body),
        waveform=Waveform(_scattered(waveform.time, 2), waveform.measured_sensor),
    )
    cleaned = on_even_clocks(late, site)
    assert cleaned.waveform is not None
    assert {k: v.replaced for k, v in cleaned.clocks.items()} == {
        "imu": True,
        "magnetometer": True,
    }
    assert np.max(np.abs(cleaned.waveform.time - waveform.time)) < 2e-4  # s
    # The same stamps, and samples that were taken at them.
    at = _scattered(waveform.time, 2)
    values = [np.interp(at, waveform.time, axis) for axis in waveform.measured_sensor.T]
    uneven = replace(log, waveform=Waveform(at, np.stack(values, axis=1)))
    kept = on_even_clocks(uneven, site)
    assert kept.waveform is not None
    np.testing.assert_array_equal(kept.waveform.time, at)
    assert not kept.clocks["magnetometer"].replaced
    assert on_even_clocks(log, site) is log


@pytest.mark.parametrize("rate", [333.0, 400.0, 600.0])
def test_a_tenth_of_rounded_stamps_may_be_lost(rate: float) -> None:
    rng = np.random.default_rng(11)
    tick = np.flatnonzero(rng.random(8000) > 0.1)
    clock = sampling_clock(np.round(tick / rate, 3))
    assert clock is not None
    assert clock.lost_count == tick[-1] - tick[0] + 1 - len(tick)
    off = clock.time - tick / rate
    assert np.std(off) < 0.05e-3  # s; of stamps .29 ms, of a wrong step .5 to .9 ms


@pytest.mark.parametrize("size", [4, 8, 10])
def test_rounded_stamps_of_batches_are_counted(size: int) -> None:
    """Within a batch the steps are even; their error builds up over batches."""
    time = np.arange(4000) / 333.0
    last = np.append(np.arange(size - 1, len(time) - 1, size), len(time) - 1)
    stamps = np.repeat(np.round(time[last], 3), np.diff(last, prepend=-1))
    clock = sampling_clock(spread_batches(stamps, last))
    assert clock is not None
    off = clock.time[size:] - time[size:]
    assert np.max(np.abs(off - np.median(off))) < 0.05e-3  # s; of the stamps .5 ms


@pytest.mark.parametrize("scatter", [0.0, 1e-3, 0.06])  # of a step
@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
@pytest.mark.parametrize(
    ("period", "lost"), [(3, [2]), (4, [3]), (4, [2, 3]), (5, [3, 4]), (8, [7]), (10, [9])]
)
def test_periodic_losses_are_no_rounding(
    period: int, lost: list[int], rate_hz: float, scatter: float
) -> None:
    """The steps are whole multiples of the shortest, to which no clock rounds."""
    row = np.arange(COUNT)
    selected = row[~np.isin(row % period, lost)] / rate_hz
    stamps = selected + scatter / rate_hz * np.random.default_rng(4).standard_normal(len(selected))
    clock, timed = sampling_clock(stamps), timing("imu", stamps)
    assert timed is not None
    assert timed.rate_hz == pytest.approx(rate_hz, rel=1e-3)
    assert timed.lost_share == pytest.approx(len(lost) / period, abs=0.01)
    assert (clock is None) == (scatter < 0.01)
    if clock is not None:
        assert np.max(np.abs(clock.time - selected)) < 0.1 / rate_hz


@pytest.mark.parametrize(("rate_hz", "resolution"), [(800.0, 1e-3), (900.0, 1e-3), (61.0, 1e-2)])
def test_steps_of_one_and_two_milliseconds_are_of_rounded_stamps(
    rate_hz: float, resolution: float
) -> None:
    stamps = resolution * np.rint(np.arange(COUNT) / rate_hz / resolution)
    timed = timing("imu", stamps)
    assert timed is not None
    assert timed.rate_hz == pytest.approx(rate_hz, rel=1e-3)
    assert timed.lost_share == 0.0
    assert timed.resolution == pytest.approx(resolution)


def _kept_stamps(stamps: Array) -> list[Finding]:
    """Return what is reported of a magnetometer whose stamps fit its tones better than a clock."""
    wave = Waveform(stamps, np.ones((len(stamps), 3)))
    note = StreamClock(1e-3, 3e-4, 0, replaced=False, resolution=1e-3)
    log = Log("kept", 0, "", ImuSamples(stamps, wave.measured_sensor, wave.measured_sensor), wave)
    log = replace(log, clocks={"magnetometer": note})
    return [f for f in uneven_stamps(log, None) if f.text.startswith("magnetometer")]


def test_stamps_that_the_tones_confirm_are_not_reported_as_rounded() -> None:
    tick = np.arange(float(COUNT))
    own = _kept_stamps(1e-3 * tick[tick % 10 != 9])
    assert [finding.code for finding in own] == ["samples_lost"]
    assert "10.0 %" in own[0].text
    own = _kept_stamps(2.5e-3 * tick[np.isin(tick % 5, (0, 2))])
    assert [finding.code for finding in own] == ["stamp_resolution"]
    assert "The estimators keep them" in own[0].text


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("rate_hz", "size", "inner", "lateness"),
    [
        (160.0, None, (1e-3, 2e-3), (0.05, 0.07)),
        (99.0, None, (1e-3, 2e-3), (0.05, 0.07)),
        (400.0, None, (1e-3, 1.5e-3), (0.05, 0.07)),
        (400.0, None, (8e-4, 9e-4), (0.024, 0.026)),
        (500.0, 8, (8e-4, 8e-4), (0.0, 3e-3)),
        (400.0, 8, (1.2e-3, 1.2e-3), (0.0, 3e-3)),
        (200.0, 4, (1.2e-3, 1.2e-3), (0.0, 3e-3)),
        (100.0, 5, (2e-3, 2e-3), (0.0, 5e-3)),
    ],
)
def test_bursts_of_samples_that_are_not_much_closer_than_usual_are_counted(
    rate_hz: float,
    size: int | None,
    inner: tuple[float, float],
    lateness: tuple[float, float],
    seed: int,
) -> None:
    """The steps are of two kinds, and bursts hold as many samples as their distances require."""
    rng = np.random.default_rng(seed)
    stamps = host_stamps(4000, rate_hz, rng, inner, lateness, size)
    for lost in (0.0, 0.5):  # s, of a link that stalls
        cut = (stamps > 6.0) & (stamps < 6.0 + lost)
        clock, timed = sampling_clock(stamps[~cut]), timing("imu", stamps[~cut])
        assert clock is not None
        assert timed is not None
        assert timed.rate_hz == pytest.approx(rate_hz, rel=6e-3)
        assert (timed.lost_share, clock.lost_count) == (0.0, 0)
        off = clock.time - np.arange(len(stamps))[~cut] / rate_hz
        before = clock.time < 6.0
        assert np.std(off[before]) < 0.012  # s; each stall begins a clock again
        assert np.std(off[~before]) < 0.012


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("scatter", [0.0, 0.05, 0.2])  # of a step
def test_losses_and_pauses_are_no_bursts(scatter: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tick = np.arange(COUNT)
    even = STEP * tick + scatter * STEP * rng.uniform(-1.0, 1.0, COUNT)
    starts = rng.integers(0, COUNT, COUNT // 20)
    streams = [even, even[tick % 20 < 16], even[tick % 8 < 4]]
    streams += [even[~np.isin(tick, starts[:, None] + np.arange(size))] for size in (1, 3, 5)]
    # A multiplexer, and a recorder that stalls for a time without reading.
    streams += [even + pause * (tick // size) for size, pause in ((10, 0.03), (5, 0.02))]
    ends = np.cumsum(rng.integers(5, 20, COUNT // 10))
    stalls = rng.uniform(0.03, 0.09, len(ends) + 1)
    streams.append(even + np.cumsum(stalls)[np.searchsorted(ends, tick, side="right")])
    assert [spread_bursts(one) is not None for one in streams] == [False] * len(streams)
    assert [spread_bursts(one[:200]) is not None for one in streams] == [False] * len(streams)


@pytest.mark.parametrize("scatter", [0.4, 0.7, 1.0])
def test_jitter_of_a_step_is_no_loss(scatter: float) -> None:
    """A driver that stamps samples in order, up to some steps late: they are all there."""
    rng = np.random.default_rng(2)
    selected = STEP * np.arange(COUNT)
    stamps = np.sort(selected + STEP * scatter * rng.standard_normal(COUNT))
    clock = sampling_clock(stamps)
    assert clock is not None
    assert clock.lost_count == 0
    assert clock.step == pytest.approx(STEP, rel=1e-3)
    assert np.max(np.abs(clock.time - selected)) < 0.1 * STEP
    # Of those that lose samples, too, the count is no clock.
    part = stamps[rng.random(COUNT) > 0.02]
    lossy = sampling_clock(part)
    assert lossy is None or lossy.lost_count > 0


@pytest.mark.parametrize("scatter", [0.1, 0.25, 0.3])
def test_one_lost_sample_shows_in_jitter_of_a_third_of_a_step(scatter: float) -> None:
    rng = np.random.default_rng(2)
    tick = np.delete(np.arange(COUNT), 2000)
    stamps = np.sort(STEP * (tick + scatter * rng.standard_normal(len(tick))))
    clock = sampling_clock(stamps)
    assert clock is not None
    assert clock.lost_count == 1
    assert np.max(np.abs(clock.time - STEP * tick)) < 0.1 * STEP
