"""Uniform sampling clock of a stream whose time stamps scatter about it.

A host stamps samples when they arrive, not when they were measured, several at a time, or by a
coarse clock.  The uniform sampler is recovered: each sample is assigned a tick, lost samples skip
theirs, and the clock is a smooth curve of stamps over ticks.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_lsq_spline

from magfusion.receiver.bursts import MAX_PAUSE, spread_bursts
from magfusion.units import NANOSECOND, Array, ComplexArray, IntArray

EVEN = 0.01  # of a step; stamps that scatter less are a clock's own
MAX_SCATTER = 0.45  # of a step, root mean square; beyond, ticks are not separable
PIECE = 200  # samples assigned to ticks at once
KEPT = 150  # of them: those at the end may belong to another tick
MAX_LOST = 40  # ticks in a piece, unless more are seen to be; a longer silence is a gap
GAP = 10.0  # steps
LOSS = 8.0  # log-likelihood ratio that a lost sample costs, where few are lost
COSTLY_LOST_SHARE = 0.05  # of the samples; beyond, a loss costs what this share of losses does
MEMORY = 2000  # samples that predict the next ticks
MAX_PIECES = 40  # used for the median step
SEARCHED = 0.08  # of the median and of the mean step, either way
MAX_LOST_SHARE = 0.2  # by which the mean step may be longer
MAX_DELAY = 32  # steps, by which a host delivers late
LARGE_JITTER = 0.45  # of a step, standard deviation of steps from which a tick may be mistaken
OWN_JITTER = 0.7  # correlation of neighbours below which samples are late each by itself; sorting
# stamps that scatter by a step correlates them by about a half
ACCUMULATED = 1.2  # times the scatter within a piece, that losses leave in a longer one
KNOT = 10.0  # s; a clock's rate changes more slowly
MIN_SAMPLES = 50  # samples
SHORT = 0.1  # share of the steps; the shortest kind has more
LATTICE = 0.1  # of a step, root mean square; of steps at random it is 0.29
STRICT = 0.98  # share of equal periods
MILLISECONDS = (1e-3, 2.0**-10)  # s, in which most coarse clocks count
ROUNDED = 0.05  # of a step, by which the mean of rounded stamps differs from their median
MAX_ROUNDING_STEPS = 1.2  # resolutions; rounding is half of one, cutting off one
MAX_STEPS = 10_000  # of which a common divisor is looked for
ROUNDING_RMS = 0.29  # resolutions, 1/sqrt(12)
# Of a step; beyond, a loss and a rounded stamp look alike, and of even stamps with losses the step
# itself divides all.
MAX_ROUNDING_SHARE = 0.12
MAX_ROUNDING = 0.6  # of the divisor; rms of rounding is 1/sqrt(12) of it, of cutting off 1/sqrt(3)


class SamplingClock(NamedTuple):
    """Uniform clock of a stream."""

    time: Array  # (n,), sampling times (s)
    step: float  # between two ticks (s)
    scatter: float  # root mean square of stamps about the clock (s)
    lost_count: int  # ticks without a sample, except in gaps
    # to which the stamps are rounded (s), where that explains their scatter; otherwise zero
    resolution: float = 0.0


def sampling_clock(stamps: Array, bundled: bool = True) -> SamplingClock | None:
    """Return the uniform clock of scattered stamps; None if there is none or they scatter little.

    `stamps` (n,): strictly increasing (s). `bundled`: whether a bus may deliver several samples at
    a time.
    """
    separate, size = spread_bursts(stamps) if bundled else None, stamp_resolution(stamps)
    if separate is not None:
        clock: SamplingClock | None = _counted_clock(stamps, separate)
    else:
        clock = _jittery_clock(stamps) or _scattered_clock(stamps, ROUNDING_RMS * size)
    if clock is None:
        return None
    return clock._replace(resolution=size if clock.scatter < MAX_ROUNDING * size else 0.0)


def _counted_clock(stamps: Array, separate: Array) -> SamplingClock:
    """Return the clock of samples that arrive in bursts: without losses, they are counted."""
    steps = np.diff(separate)
    step = float(np.mean(steps[steps < MAX_PAUSE]))
    breaks = np.flatnonzero(steps >= MAX_PAUSE) + 1
    parts = np.split(separate, breaks)
    time = np.concatenate([smooth_clock(np.arange(len(part)), part) for part in parts])
    # A lost sample shifts the later ones by a step.
    if np.any(np.diff(time) <= 0.0) or np.max(np.abs(time - separate)) > MAX_DELAY * step:
        time = separate
    steps = np.diff(time)
    step = float(np.mean(steps[steps < MAX_PAUSE]))
    return SamplingClock(time, step, float(np.sqrt(np.mean((time - stamps) ** 2))), 0)


def stamp_resolution(stamps: Array) -> float:
    """Return the common divisor of the steps (s), by which two of them differ; zero if none."""
    if len(stamps) < 2:
        return 0.0
    exact = 4.0 * max(NANOSECOND, float(np.spacing(np.max(np.abs(stamps)))))
    steps = np.sort(np.diff(stamps[:MAX_STEPS]))
    change = np.diff(steps, prepend=0.0)
    separate = change[change > exact]
    while len(separate) and (least := float(np.min(separate))) > 10.0 * exact:
        size = float(steps[-1] / np.round(steps[-1] / least))
        if np.all(np.abs(steps - size * np.round(steps / size)) <= 2.0 * exact):
            return round(size, 9)
        separate = np.abs(separate - least * np.round(separate / least))  # Euclid's algorithm
        separate = separate[separate > exact]
    return 0.0


def _scattered_clock(stamps: Array, rounding: float) -> SamplingClock | None:
    """Return the clock of stamps with a scatter due to rounding (s, root mean square)."""
    if len(stamps) < PIECE:
        return None
    lossy = lossy_step(stamps)
    counted = None if lossy else _counted_step(stamps)
    median = lossy or float(np.median(np.diff(stamps)))
    # Rounded steps are equal for a while, if they are nearly a whole number of resolutions.
    rounded = EVEN * median < rounding < MAX_ROUNDING_SHARE * median
    if counted is None and not rounded and is_even(stamps, median):
        return None
    step = counted or _usual_step(stamps, median)
    if not rounded and is_even(stamps, step):
        return None
    whole = np.diff(stamps) / step
    breaks = np.flatnonzero(whole > GAP) + 1
    floor = max(EVEN * step, rounding if rounded else 0.0)
    parts = [_of_stretch(part, step, floor) for part in np.split(stamps, breaks)]
    off = np.concatenate([p.time for p in parts]) - stamps
    scatter = float(np.sqrt(np.mean(off**2)))
    if not EVEN * step < scatter < MAX_SCATTER * step:
        return None
    time = np.concatenate([p.time for p in parts])
    if np.any(np.diff(time) <= 0.0):
        return None
    return SamplingClock(time, step, scatter, sum(p.lost_count for p in parts))


def is_even(stamps: Array, step: float) -> bool:
    """Return whether stamps are whole steps apart, and stay so where none is lost."""
    whole = np.diff(stamps) / step
    if not np.sqrt(np.mean((whole - np.round(whole)) ** 2)) < EVEN:
        return False
    count = len(stamps) // PIECE
    complete = np.all(np.round(whole[: count * PIECE - 1]) == 1.0) if count else False
    return not complete or bool(np.sqrt(np.mean(_off_lines(stamps) ** 2)) < EVEN * step)


def _off_lines(stamps: Array) -> Array:
    """Return the deviations of stamps from a straight line in each piece, shape (`PIECE`, m)."""
    count = len(stamps) // PIECE
    pieces = stamps[: count * PIECE].reshape(count, PIECE).T
    pieces = pieces - pieces[0]
    lines = np.polyfit(np.arange(PIECE), pieces, 1)
    return np.asarray(pieces - np.outer(np.arange(PIECE), lines[0]) - lines[1])


def _counted_step(stamps: Array) -> float | None:
    """Return the mean step (s) where it is not the median and the samples come as evenly.

    Rounded stamps stay within a step of a straight line, those of lost samples leave it.
    """
    steps = np.diff(stamps)
    median = float(np.median(steps))
    mean = float(np.mean(steps[steps <= GAP * median]))
    if abs(mean - median) < ROUNDED * median:
        return None
    off = _off_lines(stamps)
    rounding = min(stamp_resolution(stamps) or median, median)  # a loss is a whole step
    return mean if np.max(np.abs(off)) < MAX_ROUNDING_STEPS * rounding else None


def _jittery_clock(stamps: Array) -> SamplingClock | None:
    """Return the clock of stamps that scatter so much that single steps show no losses.

    None where there are losses: a loss shifts all later samples, jitter each by itself.
    """
    if len(stamps) < PIECE or lossy_step(stamps):
        return None
    steps, off = np.diff(stamps), _off_lines(stamps)
    if np.std(steps) < LARGE_JITTER * np.mean(steps):
        return None
    if np.sum(off[1:] * off[:-1]) > OWN_JITTER * np.sum(off**2):
        return None
    clock = _counted_clock(stamps, stamps)
    return clock if clock.scatter < ACCUMULATED * np.std(off) else None


def lossy_step(stamps: Array) -> float | None:
    """Return the step (s) of an even clock that misses many samples; None if stamps show none.

    The steps are whole multiples of the shortest kind. So are those of rounded stamps, where the
    resolution is the shortest step (700 Hz in milliseconds).
    """
    steps = np.diff(stamps)
    if not len(steps) or np.min(steps) <= 0.0:
        return None
    steps = steps[steps <= GAP * np.median(steps)]
    short = float(np.quantile(steps, SHORT, method="lower"))
    step = float(np.median(steps[steps < 1.5 * short]))
    whole = np.rint(steps / step)
    share, off = float(np.mean(whole)) - 1.0, steps / step - whole
    if share < ROUNDED or np.std(off) > LATTICE or abs(np.mean(off)) > EVEN * (1.0 + share):
        return None
    return None if _may_be_rounded(whole, step, stamp_resolution(stamps)) else step


def _may_be_rounded(whole: Array, step: float, resolution: float) -> bool:
    """Return whether steps, whole multiples of the shortest (s), may be of rounded stamps.

    Clocks count milliseconds, or other decimal or binary fractions of a second. Rounding to those
    makes steps of one and two; in a strict period they are rather of a sensor that loses samples.
    """
    if abs(resolution - step) > EVEN * step:
        return False
    if min(abs(resolution - unit) for unit in MILLISECONDS) < EVEN * resolution:
        return True
    if np.max(whole) > 2.0:
        return False
    powers = np.log10(resolution), np.log2(resolution)
    if min(abs(power - np.rint(power)) for power in powers) > 1e-5:
        return False
    period = np.diff(np.flatnonzero(whole == 2.0))
    return bool(np.mean(period == np.median(period)) < STRICT)


def _usual_step(stamps: Array, median: float) -> float:
    """Return the time between two ticks (s): the period that fits the stamps of each piece best.

    By the length of the mean phasor (Rayleigh's test), which is insensitive to lost samples.  The
    median step is not that of rounded stamps, and the mean not that where samples are lost.
    `median`: of the steps without losses (s).
    """
    steps = np.diff(stamps)
    mean = float(np.mean(steps[steps <= GAP * median]))
    count = len(stamps) // PIECE
    pieces = stamps[: count * PIECE].reshape(count, PIECE)[:MAX_PIECES]
    near = np.linspace(-SEARCHED, SEARCHED, 161)
    losing = np.linspace(-MAX_LOST_SHARE, SEARCHED, 281)
    tried = np.concatenate([median * (1.0 + near), mean * (1.0 + losing)])
    for width in (0.1 * SEARCHED, 0.01 * SEARCHED, 0.0):
        kept = [float(np.sum(np.abs(_phasor(pieces, step)) ** 2)) for step in tried]
        usual = float(tried[int(np.argmax(kept))])
        tried = usual * (1.0 + np.linspace(-width, width, 161))
    return usual


def _phasor(stamps: Array, step: float) -> ComplexArray:
    """Return the mean phasor of each row's stamps for a period."""
    return np.asarray(np.mean(np.exp(2j * np.pi * (stamps - stamps[..., :1]) / step), axis=-1))


def _of_stretch(stamps: Array, step: float, least_scatter: float) -> SamplingClock:
    tick = _ticks(stamps, step, least_scatter)
    time = smooth_clock(tick, stamps)
    lost_epochs = int(tick[-1] - tick[0] + 1 - len(tick))
    return SamplingClock(time, step, 0.0, lost_epochs)


def _ticks(stamps: Array, step: float, least_scatter: float) -> IntArray:
    """Return the tick of each sample, counted from the first, piece by piece."""
    tick = np.zeros(len(stamps), dtype=np.int64)
    begin = 0
    while begin < len(stamps):
        own = stamps[begin : begin + PIECE]
        first = max(0, begin - MEMORY)
        if begin - first >= 2 * MIN_SAMPLES:
            slope, start = np.polyfit(tick[first:begin] - tick[begin - 1], stamps[first:begin], 1)
        else:
            slope, start = step, _phase(own, step) - step
        previous = int(tick[begin - 1]) if begin else -1
        scatter = max(_scatter(own, slope), least_scatter)
        slip = lost_ticks((own - start) / slope - np.arange(1, len(own) + 1), scatter / slope)
        kept = len(own) if begin + PIECE >= len(stamps) else KEPT
        tick[begin : begin + kept] = previous + 1 + np.arange(kept) + slip[:kept]
        begin += kept
    return tick - tick[0]


def _phase(stamps: Array, step: float) -> float:
    """Return when the tick of a piece's first sample is (s)."""
    return float(stamps[0] + step * np.angle(_phasor(stamps[:MIN_SAMPLES], step)) / (2.0 * np.pi))


def _scatter(stamps: Array, step: float) -> float:
    """Return the scatter of stamps about a uniform clock (s), ignoring lost samples."""
    separate = np.diff(stamps) / step
    separate = step * (separate - np.maximum(np.round(separate), 1.0))
    return float(np.median(np.abs(separate)) / 0.6745 / np.sqrt(2.0))


def lost_ticks(late: Array, sigma: float) -> IntArray:
    """Return the most probable number of ticks lost before each sample of a piece.

    Dynamic programming over the number of lost ticks, which never decreases. `late` (n,): delay of
    each sample relative to no loss, in ticks. `sigma`: scatter of the stamps, in ticks.
    """
    if np.max(np.abs(late)) < 0.5:
        return np.zeros(len(late), dtype=np.int64)
    lost_epochs = np.arange(max(MAX_LOST, int(np.max(late)) + 2) + 1)
    loss = -np.log(COSTLY_LOST_SHARE) if late[-1] > COSTLY_LOST_SHARE * len(late) else LOSS
    cost = np.where(lost_epochs == 0, 0.0, loss)
    came = np.zeros((len(late), len(lost_epochs)), dtype=np.int64)
    for k, own in enumerate(late):
        best = np.minimum.accumulate(cost)
        at = np.maximum.accumulate(np.where(cost == best, lost_epochs, 0))
        fewer = np.concatenate([[np.inf], best[:-1]]) + loss
        jump = fewer < cost
        came[k] = np.where(jump, np.concatenate([[0], at[:-1]]), lost_epochs)
        cost = np.where(jump, fewer, cost) + 0.5 * np.minimum((own - lost_epochs) / sigma, 5.0) ** 2
    slip = np.empty(len(late), dtype=np.int64)
    state = int(np.argmin(cost))
    for k in range(len(late) - 1, -1, -1):
        slip[k] = state
        state = int(came[k, state])
    return slip


def smooth_clock(tick: IntArray, stamps: Array) -> Array:
    """Return the time of each tick (s): a piecewise linear fit with as few knots as needed.

    A knot without support in the data (Schwarz's criterion) would pass the scatter of the stamps
    to the clock, and with it to the phases of all beacons.
    """
    if len(stamps) < MIN_SAMPLES:
        return stamps
    span = float(stamps[-1] - stamps[0])
    maximum = max(min(int(span / KNOT), len(stamps) // MIN_SAMPLES), 1)
    lines, sigma, least = maximum, 0.0, np.inf
    best = stamps
    while lines >= 1:
        result, off = _bent_lines(tick, stamps, lines)
        sigma = sigma or max(float(np.median(np.abs(off))) / 0.6745, 1e-12)
        square = np.minimum(np.abs(off) / sigma, 3.0) ** 2
        cost = float(np.sum(square)) + (lines + 1) * np.log(len(stamps))
        if cost < least:
            best, least = result, cost
        lines //= 2
    return best


def _bent_lines(tick: IntArray, stamps: Array, lines: int) -> tuple[Array, Array]:
    """Return so many connected straight lines at the ticks (s), and the residual of stamps (s)."""
    inner = np.linspace(tick[0], tick[-1], lines + 1)[1:-1]
    ends = (float(tick[0]), float(tick[-1]))
    knots = np.concatenate([[ends[0]] * 2, inner, [ends[1]] * 2])
    at, weight, result = tick.astype(float), np.ones(len(stamps)), stamps
    for _ in range(4):
        # By QR the time is that of samples times knots.
        spline = make_lsq_spline(at, stamps, knots, k=1, w=weight, method="norm-eq")
        result = np.asarray(spline(at))
        off = np.abs(stamps - result)
        sigma = np.median(off) / 0.6745
        weight = 1.0 / np.maximum(1.0, off / max(3.0 * sigma, 1e-12))
    return result, stamps - result
