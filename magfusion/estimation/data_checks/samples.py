"""Checks of single samples: frozen, clipped and false ones.

Instruments quantize, so that consecutive samples may be equal; the log itself shows how often.
A magnetometer that is read faster than it measures repeats values without being saturated.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.inertial_noise import BLOCK
from magfusion.estimation.data_checks.resolution import (
    is_scheduled,
    reached_in_steps,
    step_of_axes,
    within_a_step,
)
from magfusion.files.plausible import declared_range, reaches
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.false_samples import MAX_RUN, deviations, false_runs
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array, BoolArray, IntArray

CHANCE = 1e-7  # probability of a false alarm per stream
MIN_FREEZE, DOUBTFUL_FREEZE = 0.15, 0.25  # s; below the latter one epoch is missed
DEAD = 0.5  # share of the log from which a frozen axis is a dead one
WHOLE = 0.99  # of the log, of which nothing remains to use
ALWAYS = 0.98  # share of the samples
PILE = 5.0  # an extreme value this many times as frequent as its neighbours is a limit
MIN_WRAPS = 2
AT_END = 0.9  # of the largest value
SLOW = 0.1  # of it; steps of an axis that follows the field or the motion
MIN_AT_LIMIT, MIN_RUN = 12, 3  # samples at a limit, and of them in a row, at least once
SPIKE, CERTAIN_SPIKE = 15.0, 50.0  # times the local scatter; the latter is no knock's
MAX_PASSES = 8
MIN_SPIKES, SPIKE_SHARE = 5, 2e-4  # fewer may be knocks
SMOOTH_TONE = 0.15  # cycles a sample; above, neighbours do not predict a sample
AXES = "xyz"


class InstrumentStream(NamedTuple):
    """The axes of one instrument."""

    name: str
    time: Array  # (n,) (s)
    value: Array  # (n, axes), in the unit divided by the scale
    unit: str
    scale: float = 1.0
    axes: str = AXES  # names of its axes


def streams(log: Log) -> tuple[InstrumentStream, ...]:
    """Return the raw streams of a log."""
    result = []
    if log.inertial:
        imu = log.imu if log.recorded_imu is None else log.recorded_imu
        result.append(InstrumentStream("gyroscope", log.imu.time, imu.gyro_body, "rad/s"))
        result.append(InstrumentStream("accelerometer", log.imu.time, imu.accel_body, "m/s^2"))
    if log.waveform is not None:
        wave = log.waveform
        own = [AXES.index(axis) for axis in wave.axes]
        value = wave.measured_sensor[:, own] if len(own) < len(AXES) else wave.measured_sensor
        result.append(InstrumentStream("magnetometer", wave.time, value, "uT", 1e6, wave.axes))
    return tuple(one for one in result if len(one.time) > 2)


@dataclass(frozen=True, eq=False)
class Runs:
    """Stretches of samples ``first`` to ``last``, exclusive, each shape (n,)."""

    first: IntArray
    last: IntArray

    def __len__(self) -> int:
        return len(self.first)


def runs(flag: BoolArray) -> Runs:
    """Return the runs of set flags (n,)."""
    edge = np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8))
    return Runs(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1))


def frozen(stream: InstrumentStream, axes: tuple[int, ...]) -> Runs:
    """Return the stretches in which axes are equal for longer than chance and steps allow."""
    same = np.all(stream.value[1:, axes] == stream.value[:-1, axes], axis=1)
    count = len(same)
    edges = np.linspace(0, count, max(1, count // BLOCK) + 1).astype(np.int64)
    shares = np.add.reduceat(same, edges[:-1], dtype=np.float64) / np.diff(edges)
    # A freeze must not raise the usual rate.
    usual = float(np.quantile(shares, 0.4))
    by_chance = np.log(CHANCE / count) / np.log(min(max(usual, 1e-3), 0.97))
    step = float(np.median(np.diff(stream.time)))
    least = max(by_chance, MIN_FREEZE / step, 6.0)
    result = runs(same)
    long = result.last - result.first >= least
    first, last = result.first[long], result.last[long]
    kept = ~(within_a_step(stream.value, axes, first, last) | is_scheduled(first, last))
    return Runs(first[kept], last[kept])


def frozen_samples(log: Log, _site: Site | None) -> Iterator[Finding]:
    """Yield the axes that are constant for longer than an instrument can be."""
    for stream in streams(log):
        whole = all_frozen(stream)
        if len(whole):
            yield _freeze(stream, "all axes", whole)
            continue
        for axis in range(len(stream.axes)):
            alone = frozen(stream, (axis,))
            if len(alone) and not _at_limit(stream, axis, alone):
                yield _freeze(stream, f"axis {stream.axes[axis]}", alone)


def all_frozen(stream: InstrumentStream) -> Runs:
    """Return the stretches in which all axes are frozen."""
    return frozen(stream, tuple(range(len(stream.axes))))


def _at_limit(stream: InstrumentStream, axis: int, result: Runs) -> bool:
    """Return whether an axis is constant only at its limits."""
    value = stream.value[:, axis]
    low, high = float(np.min(value)), float(np.max(value))
    at = value[result.first]
    if low == high:  # always: if no other axis exceeds it
        return bool(high != 0.0 and abs(high) == np.max(np.abs(stream.value)))
    return bool(np.all((at == low) | (at == high)))


def _freeze(stream: InstrumentStream, where: str, result: Runs) -> Finding:
    begin, end = stream.time[result.first], stream.time[result.last]
    length, span = end - begin, float(stream.time[-1] - stream.time[0])
    share = float(np.sum(length)) / span
    longest = int(np.argmax(length))
    at = stream.value[result.first[longest]] * stream.scale
    value = f" at {at[stream.axes.index(where[-1])]:.4g} {stream.unit}" if where[-2] == " " else ""
    more = f" and {len(result) - 1} times more" if len(result) > 1 else ""
    dead = share > DEAD
    verdict = Verdict.FAILED if dead else Verdict.DOUBTFUL
    if not dead and length[longest] < DOUBTFUL_FREEZE:
        verdict = Verdict.TRUSTWORTHY
    hung = "frozen_magnetometer" if stream.name == "magnetometer" else "frozen_imu"
    code = "stuck_axis" if dead or where != "all axes" else hung
    cause = "it is dead or not connected" if dead else "the sensor or its driver hung"
    remedy = "Exclude that part by --start and --end, or repair the sensor."
    if share > WHOLE:
        remedy = "Repair the sensor or its connection, and record again."
    return Finding(
        code,
        f"{stream.name}: {where} frozen{value} from {begin[longest]:.2f} to"
        f" {end[longest]:.2f} s{more}, {100.0 * share:.0f} % of the log: {cause}. {remedy}",
        verdict,
        3e3 + share,
    )


def frozen_rows(stream: InstrumentStream) -> IntArray:
    """Return the repeated samples of a frozen stream: all of a stretch but its first.

    Empty for a stream that is frozen most of the time: it cannot be bridged.
    """
    result = all_frozen(stream)
    rows = [np.arange(a + 1, b + 1) for a, b in zip(result.first, result.last, strict=True)]
    hung = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    return hung if len(hung) < DEAD * len(stream.time) else hung[:0]


def clipped_samples(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the axes that reach the limit of their instrument's range."""
    for stream in streams(log):
        yield from _clipped_axes(stream, site)


def _clipped_axes(stream: InstrumentStream, site: Site | None) -> Iterator[Finding]:
    value, still = stream.value, all_frozen(stream)
    if len(still):
        kept = np.ones(len(stream.time), dtype=bool)
        for first, last in zip(still.first, still.last, strict=True):
            kept[first : last + 1] = False
        value = value[kept]
    if len(value) < MIN_AT_LIMIT:
        return
    largest = float(np.max(np.abs(value)))
    declared = np.inf if site is None else declared_range(stream.name, site.platform)
    for axis, sign in product(range(len(stream.axes)), (-1.0, 1.0)):
        own = sign * value[:, axis]
        count, limit = int(np.sum((own > 0.0) & reaches(own, declared))), float(np.max(own))
        if not count:
            count, limit = clipped(own, largest)
            if count == 0 or reached_in_steps(value, axis, sign * limit):
                continue
        share = count / len(stream.time)
        first_at = stream.time[np.argmax(stream.value[:, axis] == sign * limit)]
        yield Finding(
            "saturated",
            f"{stream.name}: axis {stream.axes[axis]} is saturated at"
            f" {sign * limit * stream.scale:+.4g} {stream.unit} in {count} samples"
            f" ({100.0 * share:.2g} %), first at {first_at:.2f} s. Select a larger range, or"
            " avoid the motion or field that exceeds it.",
            weight=500.0 + 100.0 * share,
        )


def wrapped_samples(log: Log, _site: Site | None) -> Iterator[Finding]:
    """Yield the axes whose converter overflows from one end of its range to the other."""
    for stream in streams(log):
        for axis in range(len(stream.axes)):
            value = stream.value[:, axis]
            at = wraps(value)
            if len(at) < MIN_WRAPS:
                continue
            limit = float(np.max(np.abs(value)))
            yield Finding(
                "saturated",
                f"{stream.name}: axis {stream.axes[axis]} jumps from one end of its range to the"
                f" other, +-{limit * stream.scale:.4g} {stream.unit}, {len(at)} times, first at"
                f" {stream.time[at[0]]:.2f} s: its converter overflows. Select a larger range, or"
                " avoid the motion or field that exceeds it.",
                weight=600.0,
            )


def wraps(value: Array) -> IntArray:
    """Return the samples (n,) from which an axis jumps across its range; none where it is fast."""
    limit = float(np.max(np.abs(value), initial=0.0))
    step, at_end = np.abs(np.diff(value)), np.abs(value) > AT_END * limit
    across = (step > 2.0 * AT_END * limit) & at_end[:-1] & at_end[1:]
    if not np.any(across) or np.quantile(step[~across], 0.99) > SLOW * limit:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(across)


def clipped(value: Array, largest: float = np.inf) -> tuple[int, float]:
    """Return the number of samples (n,) at an upper limit, and the limit; zero without one.

    Samples reach a limit far more often than the values just below it, and over twice in a row.
    `largest`: of all axes: an axis that nearly always has this value is at its limit, too.
    """
    limit = float(np.max(value))
    at = value == limit
    count = int(np.sum(at))
    if count < MIN_AT_LIMIT or (count > ALWAYS * len(value) and limit < largest):
        return 0, limit
    highest = min(8 * count, len(value))
    below = np.unique(np.partition(value, -highest)[-highest:])
    # An axis always at its limit has no values below it.
    nearby = max((int(np.sum(value == one)) for one in below[-4:-1]), default=0)
    if len(below) < 3 and count < ALWAYS * len(value):
        return 0, limit
    result = runs(at)
    longest = int(np.max(result.last - result.first))
    separate = (value[1:] == value[:-1])[~at[1:]]
    fixed = float(np.mean(separate)) if len(separate) else 0.0
    by_chance = np.log(CHANCE) / np.log(min(max(fixed, 1e-3), 0.97))
    pile = count > PILE * nearby
    return (count if pile and longest >= max(MIN_RUN, 0.5 * by_chance) else 0), limit


def _spikes(stream: InstrumentStream) -> tuple[IntArray, BoolArray]:
    """Return the isolated false samples, and which of them are certain.

    They are off the curve through their neighbours, which agree with each other; a knock moves
    several samples.
    """
    time, x = stream.time, stream.value
    if len(x) < 2 * BLOCK:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
    own = deviations(time, x, float(np.median(np.diff(time))))
    size = own.size(np.maximum(_scatter(own.residual), step_of_axes(x)))
    rows = np.flatnonzero(size > SPIKE)
    return rows, size[rows] > CERTAIN_SPIKE


def _scatter(off: Array) -> Array:
    """Return the local scatter of deviations (n, 3), over three blocks about each sample."""
    count = len(off) // BLOCK
    usual = np.median(off[: count * BLOCK].reshape(count, BLOCK, -1), axis=1) / 0.6745
    padded = np.concatenate([usual[:1], usual, usual[-1:]])
    widest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    block = np.minimum(np.arange(len(off)) // BLOCK, count - 1)
    return np.asarray(widest[block])


def false_rows(stream: InstrumentStream, site: Site | None) -> IntArray:
    """Return the isolated false samples of a stream; of a few, those that are no knocks."""
    if not is_predictable(stream, site):
        return np.zeros(0, dtype=np.int64)
    rows, certain = _spikes(stream)
    result = rows[certain] if are_few(len(rows), len(stream.value)) else rows
    for _ in range(MAX_PASSES):  # what one sample hides is seen without it
        kept = np.delete(np.arange(len(stream.time)), result)
        one = stream._replace(time=stream.time[kept], value=stream.value[kept])
        rows, certain = _spikes(one)
        reach = [np.searchsorted(result, kept[rows] + k) for k in (-MAX_RUN, MAX_RUN)]
        certain |= reach[0] < reach[1]  # near another
        more = kept[np.union1d(rows[certain], _false_runs(one))]
        if not len(more):
            break
        result = np.union1d(result, more)
    return result


def _false_runs(stream: InstrumentStream) -> IntArray:
    """Return the runs of false samples in a stream."""
    time, x = stream.time, stream.value
    if len(x) < 2 * BLOCK:
        return np.zeros(0, dtype=np.int64)
    step = float(np.median(np.diff(time)))
    scatter = np.maximum(_scatter(deviations(time, x, step).residual), step_of_axes(x))
    return false_runs(time, x, step, CERTAIN_SPIKE * scatter)[0]


def are_few(spikes: int, samples: int) -> bool:
    """Return whether so many spikes among so many samples may be knocks."""
    return spikes < max(MIN_SPIKES, SPIKE_SHARE * samples)


def is_predictable(stream: InstrumentStream, site: Site | None) -> bool:
    """Return whether neighbours predict a sample: clipping makes corners, and so do fast tones."""
    if next(_clipped_axes(stream, site), None) is not None:
        return False
    return stream.name != "magnetometer" or site is None or _smooth_between(stream, site)


def _smooth_between(stream: InstrumentStream, site: Site) -> bool:
    """Return whether the field of the declared drives is smooth from sample to sample."""
    if has_schedule(site):
        return False
    step = float(np.median(np.diff(stream.time)))
    return all(np.max(b.tone_frequencies_hz) * step < SMOOTH_TONE for b in site.beacons)


def false_samples(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the instruments with isolated false samples."""
    for stream in streams(log):
        rows = false_rows(stream, site)
        if len(rows) == 0:
            continue
        x = stream.value
        good = np.delete(np.arange(len(x)), rows)
        place = np.searchsorted(good, rows)
        before, after = good[np.maximum(place - 1, 0)], good[np.minimum(place, len(good) - 1)]
        off = np.abs(x[rows] - 0.5 * (x[before] + x[after])) * stream.scale
        yield Finding(
            "false_samples" if stream.name == "magnetometer" else "imu_spikes",
            f"{stream.name}: {len(rows)} isolated samples ({1e3 * len(rows) / len(x):.2g} per"
            f" thousand) are off their neighbours by {np.median(np.max(off, axis=1)):.3g}"
            f" {stream.unit} (median), first at {stream.time[rows[0]]:.3f} s: probably bit errors"
            " between sensor and recorder. Check the cable and the bus speed.",
            weight=300.0 + 1e3 * len(rows) / len(x),
        )
