"""Repeated samples: pauses of a multiplexer, and instruments that are read too fast.

While a multiplexer reads another channel, the last value is repeated, which is no measurement.  An
instrument that is read faster than it measures repeats its values, too, but never gives two new
ones in a row where it repeats one twice; one at rest between two steps goes on by one step.
"""

from collections.abc import Iterator

import numpy as np

from magfusion.estimation.data_checks.resolution import ONE_STEP, is_coarse
from magfusion.estimation.data_checks.samples import (
    CHANCE,
    InstrumentStream,
    Runs,
    all_frozen,
    runs,
    streams,
)
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray, IntArray

MAX_REPEATED_SHARE = 0.05  # share of repeated samples from which it is reported
OFTEN = 0.4  # share from which the values are late by more than a step
MIN_REPEATS, MAX_LEAST = 2, 8  # in a row; in a stream, where more are needed none waits
# Samples that differ from the one before: the chance of a repetition is known, and enough so.
MIN_CHANGES, MAX_CHANGES = 32, 4096
CONSECUTIVE = 0.25  # share of them that follow another, at least
MAX_WAIT = 0.5  # s; a longer pause in a stream is a freeze


class Repetition:
    """How often an instrument repeats its values by chance, axis by axis."""

    def __init__(self) -> None:
        self._changes, self._consecutive, self._step = 0, 0, np.inf
        self._equal, self._changed, self._longest = np.zeros(1), False, 0

    def add(self, rows: Array) -> BoolArray:
        """Count samples (n + 1, axes); return which of them repeat the one before, shape (n,)."""
        same = rows[1:] == rows[:-1]
        changed = ~same.all(axis=1)
        if self._changes > MAX_CHANGES:
            return np.asarray(~changed)
        self._consecutive += int(np.sum(changed & np.append(self._changed, changed[:-1])))
        self._changes, self._changed = self._changes + int(np.sum(changed)), bool(changed[-1])
        self._equal = self._equal + np.sum(same[changed], axis=0)
        size = np.abs(np.diff(rows, axis=0))
        self._step = min(self._step, float(np.min(size, where=size > 0.0, initial=np.inf)))
        return np.asarray(~changed)

    def pauses(self, rows: Array, repeated: BoolArray, *, final: bool) -> Runs:
        """Return the pauses among samples (n + 1, axes), of which (n,) are repeated.

        `final`: whether one may last until the end, if another was as long.
        """
        stretches = runs(repeated)
        after = np.minimum(stretches.last + 1, len(rows) - 1)
        jump = np.max(np.abs(rows[after] - rows[stretches.last]), axis=1, initial=0.0)
        length = stretches.last - stretches.first
        own = (length >= self.least) & (jump > ONE_STEP * self._step)
        self._longest = int(np.max(length[own], initial=self._longest))
        own |= final & (stretches.last == len(repeated)) & (length <= self._longest)
        return Runs(stretches.first[own], stretches.last[own])

    @property
    def least(self) -> float:
        """Repetitions in a row that are no chance."""
        if self._changes < MIN_CHANGES or self._consecutive < CONSECUTIVE * self._changes:
            return np.inf
        chance = float(np.prod((self._equal + 1.0) / (self._changes + 1.0)))
        return max(MIN_REPEATS, float(np.log(CHANCE) / np.log(chance)))


def pause_rows(stream: InstrumentStream) -> IntArray:
    """Return the repeated samples in the pauses of a stream; a freeze is none."""
    counted = Repetition()
    repeated, still = counted.add(stream.value), all_frozen(stream)
    for first, last in zip(still.first, still.last, strict=True):
        repeated[first:last] = False
    result = counted.pauses(stream.value, repeated, final=True)
    rows = [np.arange(a, b) + 1 for a, b in zip(result.first, result.last, strict=True)]
    return np.concatenate([np.zeros(0, dtype=np.int64), *rows])


def repeated_samples(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the instruments that are read faster than they measure."""
    for stream in streams(log):
        same, still = stream.value[1:] == stream.value[:-1], all_frozen(stream)
        for first, last in zip(still.first, still.last, strict=True):
            same[first:last] = False
        if stream.name == "magnetometer" and len(paused := pause_rows(stream)):
            same[paused - 1] = False
            yield Finding(
                "repeated_samples",
                f"{stream.name}: {len(paused)} samples ({100.0 * len(paused) / len(same):.2g} %)"
                " repeat the last one, as while a multiplexer reads another channel.",
                Verdict.TRUSTWORTHY,
            )
        share = float(np.mean(np.all(same, axis=1)))
        # Coarse steps repeat by chance, independently per axis.
        by_chance = float(np.prod(np.mean(same, axis=0))) if same.shape[1] > 1 else 0.0
        fixed = (share - by_chance) / (1.0 - by_chance) if by_chance < 1.0 else 1.0
        if fixed < MAX_REPEATED_SHARE or share > 0.98 or is_coarse(stream.value):
            continue
        rate_hz = 1.0 / float(np.median(np.diff(stream.time)))
        own = (1.0 - share) * rate_hz
        timed = stream.name == "magnetometer" and site is not None and len(site.beacons) > 0
        yield Finding(
            "repeated_samples",
            f"{stream.name}: {100.0 * share:.0f} % of the samples repeat their predecessor: it is"
            f" read at {rate_hz:.4g} Hz and measures at about {own:.3g} Hz, so that values are late"
            " by up to a step. Read it when a new measurement is ready.",
            Verdict.DOUBTFUL if timed or share > OFTEN else Verdict.TRUSTWORTHY,
            100.0 + share / MAX_REPEATED_SHARE,
        )


class PauseFilter:
    """Leaves the pauses of a stream out; repeated samples wait for the end of theirs.

    `patient`: whether the first samples wait until the chance of a repetition is known. `left_out`:
    repeated samples so far.
    """

    def __init__(self, *, patient: bool = True) -> None:
        self.left_out, self._counted = 0, Repetition()
        self._time, self._rows = np.empty(0), np.empty((0, 3))  # that wait
        self._before = np.full((1, 3), np.nan)
        self._begins, self._frozen = patient, False

    def push(self, time: Array, rows: Array, *, final: bool = False) -> tuple[Array, Array]:
        """Add samples: stamps (k,) (s), values (k, 3); return those that pass, in the end all."""
        time, rows = np.append(self._time, time), np.concatenate([self._rows, rows])
        every = np.concatenate([self._before, rows])
        repeated = (every[1:] == every[:-1]).all(axis=1)
        if len(time) and self._begins:
            few = np.sum(~repeated) <= MIN_CHANGES
            self._begins = bool(few and time[-1] - time[0] < MAX_WAIT and not final)
        decided = 0 if self._begins else len(time)
        if decided:
            self._counted.add(every)
        if decided and repeated[-1] and not final and self._counted.least <= MAX_LEAST:
            first = int(runs(repeated).first[-1])
            self._frozen = time[-1] - time[first] > MAX_WAIT or (self._frozen and first == 0)
            decided = len(time) if self._frozen else first
        kept = np.ones(decided, dtype=bool)
        if decided:
            every = every[: decided + 1]
            result = self._counted.pauses(every, repeated[:decided], final=final)
            for first, last in zip(result.first, result.last, strict=True):
                kept[first:last] = False
            self._before = rows[decided - 1 : decided]
        self.left_out += int(np.sum(~kept))
        self._time, self._rows = time[decided:], rows[decided:]
        return time[:decided][kept], rows[:decided][kept]
