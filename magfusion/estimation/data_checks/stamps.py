"""Checks of the streams' time stamps: rates, gaps, lost samples, jitter and overlap."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.model.aiding import AidingSamples, AidingSensor
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import LISTED, Finding, Verdict
from magfusion.receiver.sampling_clock import lossy_step, sampling_clock
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array, IntArray

GAP = 0.5  # s; too long for the estimators to treat as lost samples
GAP_STEPS = 8.0  # samples, where the stream is slower than that
MAX_LOST_SHARE = 0.01  # share of the samples from which it is reported
JITTER = 0.05  # of a step
LATTICE = 0.15  # of a step: stamps scatter less about a lattice, on which missing ones are counted
BLOCK = 64  # samples over which a clock is assumed even
MIN_COVERAGE = 0.9  # share of the longer stream that the shorter one covers
ROUNDING = 1e-6  # of a step
MAX_CLOCKED = 100_000  # samples of which the clock is found; those beyond are counted by it
MIN_LOST_SHARE = 1e-3  # that is no error of its rate
# Of aiding sensors: beyond it the position by an IMU alone is off by decimetres.
MAX_SILENCE = 5.0  # s
MAX_SILENCE_STEPS = 20.0  # medians between two samples, where the sensor is slower than that
MIN_SAMPLES = 20  # of which the usual step is known


class Timing(NamedTuple):
    """Stamps of one stream."""

    stream: str
    rate_hz: float  # of the even clock, or by the median step where there is none
    # begin, end: first and last stamp (s)
    begin: float
    end: float
    jitter: float  # of the stamps about an even clock, root mean square (s)
    lost_share: float  # share of the samples that are missing outside the gaps
    gap_begin: Array  # (gaps,) (s)
    gap_end: Array  # (gaps,) (s)
    # to which the stamps are rounded (s), where that explains the jitter; otherwise zero
    resolution: float = 0.0


def timing(stream: str, time: Array, bundled: bool = True, exact: bool = False) -> Timing | None:
    """Return the timing of a stream from its stamps (s); None of fewer than three.

    `bundled`: as in `sampling_clock`. `exact`: whether fields fit the stamps better than a clock:
    then steps of one and two resolutions are of lost samples.
    """
    if len(time) < 3:
        return None
    clock = sampling_clock(time[:MAX_CLOCKED], bundled)
    if exact and clock is not None and clock.resolution > 0.5 * clock.step:
        clock = None
    step = np.diff(time)
    usual = lossy_step(time) or float(np.median(step)) if clock is None else clock.step
    gap = np.flatnonzero(step > max(GAP, GAP_STEPS * usual))
    jitter, missing = _uneven(time, step, gap, usual)
    if clock is not None:
        jitter, missing = clock.scatter, float(clock.lost_count)
    if clock is not None and len(time) > MAX_CLOCKED:
        inside = np.delete(step, gap)
        missing = float(np.sum(inside)) / usual - len(inside)
        missing = missing if missing > MIN_LOST_SHARE * len(time) else 0.0
    return Timing(
        stream=stream,
        rate_hz=1.0 / usual,
        begin=float(time[0]),
        end=float(time[-1]),
        jitter=jitter,
        lost_share=missing / (len(time) + missing),
        gap_begin=time[gap],
        gap_end=time[gap + 1],
        resolution=0.0 if clock is None else clock.resolution,
    )


def _uneven(time: Array, step: Array, gap: IntArray, usual: float) -> tuple[float, float]:
    """Return jitter (s) and number of missing samples of stamps that no even clock explains."""
    inside = np.delete(step, gap)
    turns = np.rint(inside / usual)
    off = inside - usual * turns
    if len(inside) and np.sqrt(np.mean(off**2)) < LATTICE * usual:
        missing = float(np.sum(np.maximum(turns - 1.0, 0.0)))
        jitter = float(np.sqrt(np.mean(off**2) / 2.0))
        jitter = jitter if jitter > ROUNDING * usual else 0.0
    else:
        jitter = _unevenness(time, step, gap)
        missing = max(0.0, float(np.sum(inside)) / usual - len(inside))
    return jitter, missing


def _unevenness(time: Array, step: Array, gap: IntArray) -> float:
    """Return the scatter of stamps about straight lines through short blocks (s)."""
    within = np.zeros(len(time))
    within[gap + 1] = step[gap]
    even = time - np.cumsum(within)
    count = len(even) // BLOCK
    if count == 0:
        return float(np.std(step) / np.sqrt(2.0))
    block = even[: count * BLOCK].reshape(count, BLOCK)
    number = np.arange(BLOCK) - 0.5 * (BLOCK - 1)
    centred = block - np.mean(block, axis=1, keepdims=True)
    slope = centred @ number / np.sum(number**2)
    residual = centred - slope[:, None] * number
    return float(np.sqrt(np.median(np.sum(residual**2, axis=1)) / (BLOCK - 2)))


def timings(log: Log, site: Site | None = None) -> tuple[Timing, ...]:
    """Return the timing of the raw streams of a log."""
    bundled = site is None or not has_schedule(site)
    result = [timing("imu", log.imu.time, bundled)] if log.inertial else []
    if log.waveform is not None:
        clock = log.clocks.get("magnetometer")  # kept stamps have a smaller residual
        exact = clock is not None and not clock.replaced
        result.append(timing("magnetometer", log.waveform.time, bundled, exact))
    return tuple(one for one in result if one is not None)


def uneven_stamps(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the defects of a log's time stamps."""
    result = timings(log, site)
    paused = any(f.code == "repeated_samples" for f in log.findings)
    for one in result:
        explained = {"samples_lost"} if paused and one.stream == "magnetometer" else set()
        clock = log.clocks.get(one.stream)
        findings = _of_one(one, clock is not None and not clock.replaced)
        yield from (f for f in findings if f.code not in explained)
    for stream, clock in log.clocks.items():
        if clock.replaced and clock.resolution:
            yield _rounded(stream, clock.resolution, clock.step)
        elif clock.replaced:
            yield Finding(
                "jitter",
                f"{stream}: the stamps jitter by {1e3 * clock.scatter:.2g} ms (rms) about an even"
                f" clock of {1.0 / clock.step:.4g} Hz, which replaces them: they are times of"
                " arrival, not of measurement. Stamp the samples in the sensor.",
                Verdict.TRUSTWORTHY,
                clock.scatter / clock.step / JITTER,
            )
    if len(result) == 2:
        yield from _overlap_findings(*result)


def _of_one(one: Timing, kept: bool = False) -> Iterator[Finding]:
    usual, span = 1.0 / one.rate_hz, max(one.end - one.begin, 1e-9)
    if len(one.gap_begin):
        length = one.gap_end - one.gap_begin
        longest = np.sort(np.argsort(-length)[:LISTED])
        places = ", ".join(
            f"{one.gap_begin[k]:.2f} to {one.gap_end[k]:.2f} s ({length[k]:.2f} s)" for k in longest
        )
        more = f" and {len(length) - LISTED} more" if len(length) > LISTED else ""
        yield Finding(
            "gap",
            f"{one.stream}: no samples from {places}{more}: {float(np.sum(length)):.1f} s of"
            f" {span:.0f} s are missing. The recorder or its link stalled; only the other streams"
            " bridge the gap.",
            weight=1.0 + float(np.max(length)),
        )
    if one.lost_share > MAX_LOST_SHARE:
        yield Finding(
            "samples_lost",
            f"{one.stream}: {100.0 * one.lost_share:.1f} % of the samples are missing, one or a"
            f" few at a time: link or recorder are too slow for {one.rate_hz:.4g} Hz. Record with"
            " a larger buffer or at a lower rate.",
            weight=one.lost_share / MAX_LOST_SHARE,
        )
    if one.jitter > JITTER * usual and one.resolution:
        yield _rounded(one.stream, one.resolution, usual, kept)
    elif one.jitter > JITTER * usual:
        yield Finding(
            "jitter",
            f"{one.stream}: the stamps jitter by {1e3 * one.jitter:.2g} ms (rms) about an even"
            f" clock of {one.rate_hz:.4g} Hz, {100.0 * one.jitter / usual:.0f} % of a step:"
            " probably they are times of arrival, not of measurement. Stamp the samples in the"
            " sensor.",
            weight=one.jitter / (JITTER * usual),
        )


def _rounded(stream: str, resolution: float, step: float, kept: bool = False) -> Finding:
    use = "keep them: the fields fit them better than" if kept else "use"
    clock = f"an even clock of {1.0 / step:.4g} Hz" + ("" if kept else " instead")
    return Finding(
        "stamp_resolution",
        f"{stream}: the stamps are {'multiples of' if kept else 'rounded to'}"
        f" {1e3 * resolution:.4g} ms. The estimators {use} {clock}."
        " Stamp the samples in nanoseconds.",
        Verdict.TRUSTWORTHY,
        resolution / step,
    )


def _overlap_findings(imu: Timing, field: Timing) -> Iterator[Finding]:
    common = min(imu.end, field.end) - max(imu.begin, field.begin)
    longest = max(imu.end - imu.begin, field.end - field.begin)
    if common < MIN_COVERAGE * longest:
        yield Finding(
            "streams_apart",
            f"imu runs from {imu.begin:.1f} to {imu.end:.1f} s and magnetometer from"
            f" {field.begin:.1f} to {field.end:.1f} s: they overlap by {max(common, 0.0):.1f} s."
            " One was started late, or their clocks differ. Stamp both with one clock.",
            weight=longest / max(common, 0.1 * longest),
        )


def silent_aiding(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield a remark for each aiding sensor without samples for long, or at all."""
    if site is None or not site.aiding:
        return
    begin, end = _span(log)
    for sensor in site.aiding:
        samples = log.aiding.get(sensor.name)
        if samples is None or not len(samples):
            yield _remark(
                f"{sensor.name} of the site's aiding has no samples from {begin:.1f} to {end:.1f} s"
                f" and is not used. Check the table or topic ({sensor.quantity}) and the name of"
                " the sensor in it."
            )
        else:
            yield from _gaps(sensor, samples, begin, end, 1e-9 * log.epoch_ns)


def _gaps(
    sensor: AidingSensor, samples: AidingSamples, begin: float, end: float, epoch: float
) -> Iterator[Finding]:
    """Yield a remark on the parts without samples of a sensor that has some; `epoch` (s)."""
    time = samples.time + float(sensor.time_offset)
    inside = time[(time >= begin) & (time <= end)]
    if not len(inside):
        stamps = epoch + float(time[0])  # in seconds, if they are nanoseconds
        units = {"seconds": 1e9, "milliseconds": 1e6, "microseconds": 1e3}
        likely = (u for u, size in units.items() if begin <= size * stamps - epoch <= end)
        unit = next((f" They are {one}: write nanoseconds." for one in likely), "")
        yield _remark(
            f"The samples of {sensor.name}, from {time[0]:.1f} to {time[-1]:.1f} s, are outside the"
            f" log ({begin:.1f} to {end:.1f} s) and not used. Check the clock of its stamps, or"
            f" correct time_offset_s.{unit}"
        )
    elif sensor.quantity != "mark" and len(inside) >= MIN_SAMPLES:
        edges = np.concatenate([[begin], inside, [end]])
        longest = max(MAX_SILENCE, MAX_SILENCE_STEPS * float(np.median(np.diff(inside))))
        first = np.flatnonzero(np.diff(edges) > longest)
        parts = [f"{edges[i]:.1f} to {edges[i + 1]:.1f} s" for i in first[:LISTED]]
        if parts:
            more = f" and {len(first) - LISTED} more times" if len(first) > LISTED else ""
            yield _remark(f"{sensor.name} has no samples from {', '.join(parts)}{more}.")


def _span(log: Log) -> tuple[float, float]:
    """Return the first and last time of the inertial samples and fields (s)."""
    streams: list[Array] = [log.imu.time, *(wave.time for wave in log.waveforms.values())]
    streams += [stream.time for stream in (log.waveform, log.fields) if stream is not None]
    ends = [(float(time[0]), float(time[-1])) for time in streams if len(time)]
    return min(first for first, _ in ends), max(last for _, last in ends)


def _remark(sentence: str) -> Finding:
    return Finding("aiding_silent", sentence, Verdict.TRUSTWORTHY)
