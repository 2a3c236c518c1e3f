"""Isolated false samples of a stream, as they arrive: the test of `false_rows` with two samples."""

import numpy as np

from magfusion.estimation.data_checks.inertial_noise import BLOCK
from magfusion.estimation.data_checks.resolution import step_of_axes
from magfusion.estimation.data_checks.samples import (
    CERTAIN_SPIKE,
    MAX_PASSES,
    SPIKE,
    InstrumentStream,
    are_few,
    is_predictable,
)
from magfusion.model.site import Site
from magfusion.receiver.false_samples import deviations, false_runs
from magfusion.units import Array, BoolArray

REACH = 2  # samples after one that its test needs, and as many before
MIN_SAMPLES = 32  # of which the scatter is known to a quarter
MAX_WAIT = 0.5  # s; for these, at the beginning
HISTORY = 3 * BLOCK  # samples, as in a log
UNPREDICTED = 0.5  # of a spike's size: below, the samples before predict one well enough
PREDICTOR = np.array([-1.0, 4.0, -6.0, 4.0])  # the cubic through four even samples, one ahead


class SpikeFilter:
    """Leaves isolated false samples out of a stream.

    A sample that those before it predict passes at once; another waits for the next two, and one
    that may begin a run of false samples for the end of that.
    `instruments`: of three columns each, as in `InstrumentStream`. `patient`: whether the first
    samples wait until they can be tested. `left_out`: false samples so far.
    """

    def __init__(self, instruments: tuple[str, ...], site: Site, *, patient: bool = True) -> None:
        self._instruments, self._site, self.left_out = instruments, site, 0
        self._patient, width = patient, 3 * len(instruments)
        self._time, self._rows = np.empty(0), np.empty((0, width))  # passed
        self._waiting = self._time, self._rows
        self._scatter, self._quantum = np.full(width, np.inf), np.full(width, np.inf)
        self._step, self._threshold = 0.0, CERTAIN_SPIKE
        self._measured, self._fresh = False, 0
        self._seen, self._doubtful = 0, 0

    def push(self, time: Array, rows: Array) -> tuple[Array, Array]:
        """Add samples: stamps (k,) (s), values (k, columns); return those that pass.

        Late ones pass as they are.
        """
        newest = np.concatenate([self._time[-1:], self._waiting[0][-1:], [-np.inf]]).max()
        ahead = np.diff(np.maximum.accumulate(np.append(newest, time))) > 0.0
        waiting = np.append(self._waiting[0], time[ahead])
        self._waiting = waiting, np.concatenate([self._waiting[1], rows[ahead]])
        enough = self._measured or not self._patient or len(waiting) >= MIN_SAMPLES
        if not enough and len(waiting) and waiting[-1] - waiting[0] < MAX_WAIT:
            return time[~ahead], rows[~ahead]
        passed = self._pass(final=False)
        return np.append(time[~ahead], passed[0]), np.concatenate([rows[~ahead], passed[1]])

    def end(self) -> tuple[Array, Array]:
        """Return the samples that wait, at the end of the stream."""
        return self._pass(final=True)

    def _pass(self, *, final: bool) -> tuple[Array, Array]:
        """Test the samples that wait, and return those that are decided."""
        if not self._measured and len(self._waiting[0]) >= MIN_SAMPLES:
            self._measure(*self._waiting)
        before = min(len(self._time), len(PREDICTOR))
        time = np.append(self._time[len(self._time) - before :], self._waiting[0])
        rows = np.concatenate([self._rows[len(self._rows) - before :], self._waiting[1]])
        decided = len(time)
        if len(time) > len(PREDICTOR) and self._unpredicted(rows).any():
            time, rows, open_row = self._without_false(time, rows, before, final=final)
            decided = len(time)
            if not final:
                late = np.flatnonzero(self._unpredicted(rows)[-REACH:])
                decided -= REACH - int(late[0]) if len(late) else 0
                decided = max(before, min(decided, open_row))
        self._waiting = time[decided:], rows[decided:]
        passed = time[before:decided], rows[before:decided]
        self._keep(*passed)
        return passed

    def _without_false(
        self, time: Array, rows: Array, before: int, *, final: bool
    ) -> tuple[Array, Array, int]:
        """Return the samples that pass, and the first that may begin a run of false ones.

        `before`: how many of the first passed earlier.
        """
        open_row = len(time)
        for _ in range(MAX_PASSES):
            false = deviations(time, rows, self._step).size(self._scatter) > self._threshold
            if not final:
                false[-REACH:] = False
            least = np.broadcast_to(CERTAIN_SPIKE * self._scatter, rows.shape)
            several, open_row = false_runs(time, rows, self._step, least)
            false[several] = True
            false[:before] = False
            self.left_out += int(np.sum(false))
            time, rows = time[~false], rows[~false]
            if not false.any() or len(time) <= len(PREDICTOR):
                break
        return time, rows, open_row

    def _unpredicted(self, rows: Array) -> BoolArray:
        """Return which samples differ from what those before them predict, shape (n,)."""
        count = len(PREDICTOR)
        result = np.zeros(len(rows), dtype=bool)
        off = rows[count:].copy()
        for k, weight in enumerate(PREDICTOR):
            off -= weight * rows[k : k + len(off)]
        large = UNPREDICTED * self._threshold * self._scatter
        result[count:] = (np.abs(off) > large).any(axis=1)
        return result

    def _keep(self, time: Array, rows: Array) -> None:
        """Store samples that passed, and measure the scatter once a block."""
        self._time = np.append(self._time, time)[-HISTORY:]
        self._rows = np.concatenate([self._rows, rows])[-HISTORY:]
        self._seen, self._fresh = self._seen + len(time), self._fresh + len(time)
        if self._fresh >= (BLOCK if self._measured else MIN_SAMPLES):
            self._measure(self._time, self._rows)

    def _measure(self, time: Array, rows: Array) -> None:
        """Measure the scatter of samples (n,), at least `MIN_SAMPLES`."""
        self._step = float(np.median(np.diff(time)))
        own = deviations(time, rows, self._step)
        blocks = np.array_split(own.residual, max(1, len(rows) // BLOCK))
        usual = np.max([np.median(block, axis=0) for block in blocks], axis=0) / 0.6745
        steps = step_of_axes(rows)
        self._quantum = np.minimum(self._quantum, np.where(steps > 0.0, steps, np.inf))
        self._scatter = np.maximum(usual, self._quantum)  # of a constant axis nothing is known
        for k, name in enumerate(self._instruments):
            columns = slice(3 * k, 3 * k + 3)
            if not is_predictable(InstrumentStream(name, time, rows[:, columns], ""), self._site):
                self._scatter[columns] = np.inf
        fresh = own.size(self._scatter)[len(rows) - min(self._fresh, len(rows)) :]
        self._doubtful += int(np.sum(fresh > SPIKE))
        few = are_few(self.left_out + self._doubtful, self._seen)
        self._threshold = CERTAIN_SPIKE if few else SPIKE
        self._measured, self._fresh = True, 0
