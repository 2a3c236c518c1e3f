"""Rounds of several logs to a common calibration, over files: no log is in memory here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.estimation.batch.calendar import Calendar
from magfusion.estimation.batch.change_between_logs import FoundChange
from magfusion.estimation.batch.joint import SharedCalibration, apart_in_sigmas, known_by
from magfusion.estimation.integrity.logs_agree import Deviation, LogAgreement, agreement
from magfusion.jobs.joint_calendar import CalendarTask, by_month, mean_step, search_changes
from magfusion.jobs.joint_tasks import (
    LogTask,
    RoundTask,
    SiteFiles,
    SumTask,
    added,
    from_others,
    one_round,
    sum_of,
)
from magfusion.model.progress import Report
from magfusion.simulation.monte_carlo import WorkerPool
from magfusion.units import Array

CONVERGED_STEP = 1e-6  # sigmas; a step of the shared calibration that ends the rounds
MAX_ROUNDS = 20
LARGE = 0.5  # sigmas; rounds that move it by more, and by more each time, are held back
MIN_SHARE = 0.25


class Sums(NamedTuple):
    """What the logs know after some rounds, in groups.

    Parameters
    ----------
    known : SharedCalibration
        By all of them.
    groups : list of list of Path
        Of each log.
    sums : list of Path
        Of each group.
    """

    rounds: int
    known: SharedCalibration
    groups: list[list[Path]]
    sums: list[Path]

    def others(self, own: Path) -> tuple[Path, ...]:
        """Return the files of all other logs: of each in its group, and the other groups' sums."""
        which = next(i for i, group in enumerate(self.groups) if own in group)
        rest = [path for path in self.groups[which] if path != own]
        return *rest, *self.sums[:which], *self.sums[which + 1 :]


@dataclass(frozen=True, eq=False)
class Driver:
    """Rounds over the files of the logs, without a log in memory."""

    hands: WorkerPool
    tasks: list[LogTask]
    files: SiteFiles
    report: Report

    @cached_property
    def calendar(self) -> Calendar:
        """Parameters of all logs."""
        return self.files.calendar()

    def with_changes(self) -> tuple[Driver, list[FoundChange]]:
        """Return the driver with new parameters of all that changed, and the changes."""
        paths = tuple(task.information(0) for task in self.tasks)
        self.report("searching for changes", 0, 1)
        (changes,) = self.hands.run(search_changes, [CalendarTask(self.files, paths)])
        every = (*self.files.changes, *(one.change for one in changes))
        return replace(self, files=replace(self.files, changes=every)), changes

    def first_sums(self) -> Sums:
        """Return what the logs know alone, at their mean."""
        paths = [task.information(0) for task in self.tasks]
        return self.sums(0, mean_step(self.calendar, paths))

    def sums(self, rounds: int, at: Array, pool: Sequence[int] | None = None) -> Sums:
        """Return what the logs of a pool, or all, know; the workers add each group."""
        place = self.tasks[0].kept.parent / ("sums" if pool is None else "sums_of_pool")
        pool = range(len(self.tasks)) if pool is None else pool
        paths = [self.tasks[i].information(rounds) for i in pool]
        size = math.isqrt(len(paths) - 1) + 1  # as many groups as logs in each
        groups = [paths[i : i + size] for i in range(0, len(paths), size)]
        files = [place / f"{i}.npz" for i in range(len(groups))]
        given = [SumTask(self.files, tuple(g), at, f) for g, f in zip(groups, files, strict=True)]
        sums = self.hands.run(sum_of, given)
        known = known_by(self.calendar.shared, added(self.calendar, sums, at), at)
        return Sums(rounds, known, groups, sums)

    def last_tasks(self, sums: Sums) -> list[RoundTask]:
        """Return the tasks of the final pass: all logs, each with the others as its prior."""
        at, rounds = sums.known.step, sums.rounds
        return [
            RoundTask(self.files, task, rounds, sums.others(task.information(rounds)), at)
            for task in self.tasks
        ]

    def agreement(self, sums: Sums) -> LogAgreement:
        """Return the consistency of the logs after some rounds."""

        def deviations(pool: list[int]) -> list[Deviation]:
            at, rounds = sums.known.step, sums.rounds
            of_pool = self.sums(rounds, at, pool)
            of_log = [(self.tasks[i], self.tasks[i].information(rounds)) for i in pool]
            given = [
                RoundTask(self.files, task, rounds, of_pool.others(own), at) for task, own in of_log
            ]
            return self.hands.run(from_others, given)

        return agreement(self.calendar.shared, [task.name for task in self.tasks], deviations)

    def repeated(self, sums: Sums) -> tuple[Sums, float]:
        """Repeat until no log moves the shared calibration.

        Where a round moves it farther than the one before, as with contradicting logs, further
        updates are damped.

        Returns
        -------
        sums : Sums
        moved : float
            Change in the last round, in sigmas.
        """
        moved, share = np.inf, 1.0
        while moved >= CONVERGED_STEP and sums.rounds < MAX_ROUNDS:
            self.report("refining together", sums.rounds, MAX_ROUNDS)
            known, every = sums.known, tuple(sums.sums)
            given = [
                RoundTask(self.files, task, sums.rounds, every, known.step, share)
                for task in self.tasks
            ]
            self.hands.run(one_round, given)
            self._discard(sums.rounds)
            sums = self.sums(sums.rounds + 1, known.step)
            after = sums.known
            before, moved = moved, apart_in_sigmas(after.step, known.step, after.cov) / share
            if moved > before and moved > LARGE and sums.rounds > 1:
                share = max(0.5 * share, MIN_SHARE)
        return sums, moved

    def months(self, sums: Sums) -> list[dict[str, Any]]:
        """Return the table of parameters by month."""
        paths = tuple(task.information(sums.rounds) for task in self.tasks)
        (rows,) = self.hands.run(by_month, [CalendarTask(self.files, paths, sums.known.step)])
        return rows

    def _discard(self, rounds: int) -> None:
        """Remove the files of a round that is superseded."""
        for task in self.tasks:
            if rounds:
                task.state(rounds).unlink(missing_ok=True)
            task.information(rounds).unlink(missing_ok=True)
