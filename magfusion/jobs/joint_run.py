"""Several logs of one site: each alone, then rounds to a common calibration, then a final pass.

The results of a log alone are stored in the output under a key; the rounds resume from them.  The
driver holds sums over the logs, and passes names of files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.batch.joint import (
    Shared,
    SharedCalibration,
    apart_in_sigmas,
    known_by,
)
from magfusion.estimation.integrity.logs_agree import Deviation, LogAgreement, agreement
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.files.atomic import real
from magfusion.files.checkpoint import run_key
from magfusion.files.kept import digest_of_files
from magfusion.jobs.inputs import Job, read_job, read_site
from magfusion.jobs.joint_tasks import (
    Alone,
    LastTask,
    LogTask,
    RoundTask,
    SumTask,
    added,
    alone,
    from_others,
    last,
    one_round,
    shared_of,
    shared_site,
    sum_of,
)
from magfusion.jobs.written import KEPT
from magfusion.model.progress import Report
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Trust, Verdict
from magfusion.results.provenance import versions
from magfusion.simulation.monte_carlo import WorkerPool, worker_pool
from magfusion.units import Array, Rate

CONVERGED_STEP = 1e-6  # sigmas; a step of the shared calibration that ends the rounds
MOST_ROUNDS = 20
LARGE = 0.5  # sigmas; rounds that move it by more, and by more each time, are held back
SMALLEST_SHARE = 0.25
UNSETTLED = 0.1  # sigmas that the last round may have moved it by
_SITE_FILES = ("site.yaml", "site_field_map.parquet", "site_correlation.parquet")


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint solution of several logs of one site.

    Parameters
    ----------
    known : SharedCalibration
        Of the shared calibration.
    excess : float
        Factor on its variances, as the logs contradict each other.
    noise : tuple of Tuned
        Estimated from each log alone.
    table : list of dict
        A row for each given log.
    """

    shared: Shared
    known: SharedCalibration
    excess: float
    noise: tuple[Tuned, ...]
    table: list[dict[str, Any]]
    trust: Trust
    rounds: int


def tasks_of(jobs: Sequence[Job], smoother: SmootherSettings, output: Path) -> list[LogTask]:
    """Return the tasks of some logs, after checking that they are different logs of one site.

    Raises
    ------
    InputError
    """
    for job in jobs:
        if not job.log_path.exists():
            read_job(job)  # which says so
    site = _one_site(jobs, smoother)
    names, seen = _names([job.log_path for job in jobs]), dict[str, Path]()
    tasks = []
    for job, name in zip(jobs, names, strict=True):
        content = digest_of_files([job.log_path], without=frozenset(_SITE_FILES))
        if content in seen:
            raise InputError(
                f"{job.log_path}: is the same log as {seen[content]} and would count twice; give"
                " each log once"
            )
        seen[content] = job.log_path
        made_by = content, site, job.start, job.end, job.topics, smoother, versions()
        key = run_key("smooth", *made_by)
        place = real(output) / KEPT
        own = replace(job, output=place / name)
        tasks.append(LogTask(name, own, smoother, place / f"{name}.npz", key))
    return tasks


def _one_site(jobs: Sequence[Job], smoother: SmootherSettings) -> str:
    """Return the digest of the one site of several logs."""
    result = {}
    for job in jobs:
        path = job.declared_path
        read_site(job)
        others = [path.with_name(name) for name in _SITE_FILES[1:]]
        result[digest_of_files([path, *others])] = path
    if len(result) > 1:
        first, other = list(result.values())[:2]
        raise InputError(
            f"{other}: differs from {first}; logs that refine one site share its file: give it with"
            " --site SITE.yaml"
        )
    shared = shared_of(read_site(jobs[0]), smoother)
    if smoother.coupling == "loose" or not shared.blocks:
        raise InputError(
            f"{jobs[0].declared_path}: the logs estimate no shared calibration, so that there is"
            " nothing to refine together; declare the uncertainty of the survey, keep --coupling"
            " tight and --estimate as they are, or smooth each log on its own"
        )
    return next(iter(result))


def _names(paths: list[Path]) -> list[str]:
    """Return a name for each log: its own, with parent directories where it is not unique."""
    parts = [real(path).with_suffix("").parts[1:] for path in paths]
    maximum = max(len(p) for p in parts)
    for count in range(1, maximum + 1):
        names = ["_".join(p[-count:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{name}_{i + 1}" for i, name in enumerate(names)]


def refine(
    tasks: list[LogTask],
    *,
    cluster: str | None,
    workers: int | None,
    writes: bool,
    rate: Rate = "field",
    risk: Risk | None = None,
    report: Report,
) -> Joint:
    """Refine one site with all logs together.

    Parameters
    ----------
    writes : bool
        Whether the trajectory of each log is written, to its job's output.

    Raises
    ------
    InputError
        Where a log cannot be used, or the cluster not be reached.
    EstimationError
        Where no log remains.
    """
    site, shared = shared_site(read_site(tasks[0].job), tasks[0].smoother)
    with worker_pool(len(tasks), cluster=cluster, workers=workers) as hands:
        first = hands.run(alone, tasks, report=_staged(report, "smoothing each log alone"))
        used, steps = [], []
        for task, one in zip(tasks, first, strict=True):
            if one.step is not None and one.facts["verdict"] != Verdict.FAILED:
                used.append(task)
                steps.append(one.step)
        if not used:
            raise EstimationError(
                f"none of the {len(tasks)} logs can be used: {tasks[0].name}:"
                f" {first[0].facts['reason']}"
            )
        driver = Driver(hands, used, shared, report)
        sums = driver.sums(0, np.mean(steps, axis=0))
        before = driver.agreement(sums)
        sums, moved = driver.repeated(sums)
        known = sums.known
        # Given the prior of the others, a robust loss soon rejects contradicting measurements.
        agreed = before if any(before.of_log) else driver.agreement(sums)
        given = [
            LastTask(one, agreed.excess, findings, writes, rate, risk)
            for one, findings in zip(driver.tasks_given(sums), agreed.of_log, strict=True)
        ]
        rows = hands.run(last, given, report=_staged(report, "each log in the joint solution"))
    of_used = {t.name: row for t, row in zip(used, rows, strict=True)}
    far = {t.name: float(s) for t, s in zip(used, agreed.sigmas, strict=True)}
    table = [
        _row(task, one.facts, of_used.get(task.name), far.get(task.name))
        for task, one in zip(tasks, first, strict=True)
    ]
    trust = trust_of_all(table, agreed, _undetected(site, first), moved)
    noise = tuple(tuned for one in first for tuned in one.noise if one.step is not None)
    return Joint(shared, known, agreed.excess, noise, table, trust, sums.rounds)


def _staged(report: Report, stage: str) -> Report:
    return lambda _stage, done, total: report(stage, done, total)


class Sums(NamedTuple):
    """What the logs know after some rounds, in groups.

    Parameters
    ----------
    rounds : int
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
    """Rounds over the files of the logs, without a log in memory.

    Parameters
    ----------
    tasks : list of LogTask
    """

    hands: WorkerPool
    tasks: list[LogTask]
    shared: Shared
    report: Report

    def sums(self, rounds: int, at: Array, pool: Sequence[int] | None = None) -> Sums:
        """Return what the logs of a pool, or all, know; the workers add each group."""
        pool = range(len(self.tasks)) if pool is None else pool
        paths = [self.tasks[i].information(rounds) for i in pool]
        size = math.isqrt(len(paths) - 1) + 1  # as many groups as logs in each
        groups = [paths[i : i + size] for i in range(0, len(paths), size)]
        files = [self.tasks[0].kept.parent / "sums" / f"{i}.npz" for i in range(len(groups))]
        one = self.tasks[0]
        given = [SumTask(one, tuple(g), at, f) for g, f in zip(groups, files, strict=True)]
        sums = self.hands.run(sum_of, given)
        return Sums(rounds, known_by(self.shared, added(self.shared, sums, at), at), groups, sums)

    def tasks_given(self, sums: Sums, share: float = 1.0) -> list[RoundTask]:
        """Return the tasks of all logs."""
        at, rounds = sums.known.step, sums.rounds
        return [
            RoundTask(task, rounds, sums.others(task.information(rounds)), at, share)
            for task in self.tasks
        ]

    def agreement(self, sums: Sums) -> LogAgreement:
        """Return the consistency of the logs after some rounds."""

        def deviations(pool: list[int]) -> list[Deviation]:
            at, rounds = sums.known.step, sums.rounds
            of_pool = self.sums(rounds, at, pool)
            of_log = [(self.tasks[i], self.tasks[i].information(rounds)) for i in pool]
            given = [RoundTask(task, rounds, of_pool.others(own), at) for task, own in of_log]
            return self.hands.run(from_others, given)

        return agreement(self.shared, [task.name for task in self.tasks], deviations)

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
        while moved >= CONVERGED_STEP and sums.rounds < MOST_ROUNDS:
            self.report("refining together", sums.rounds, MOST_ROUNDS)
            self.hands.run(one_round, self.tasks_given(sums, share))
            known = sums.known
            self._discard(sums.rounds)
            sums = self.sums(sums.rounds + 1, known.step)
            after = sums.known
            before, moved = moved, apart_in_sigmas(after.step, known.step, after.cov) / share
            if moved > before and moved > LARGE and sums.rounds > 1:
                share = max(0.5 * share, SMALLEST_SHARE)
        return sums, moved

    def _discard(self, rounds: int) -> None:
        """Remove the files of a round that is superseded."""
        for task in self.tasks:
            if rounds:
                task.state(rounds).unlink(missing_ok=True)
            task.information(rounds).unlink(missing_ok=True)


def _undetected(site: Site, first: Sequence[Alone]) -> list[str]:
    detected = {name for one in first for name in one.facts.get("heard", ())}
    return [beacon.name for beacon in site.beacons if beacon.name not in detected]


def _row(
    task: LogTask, before: dict[str, Any], after: dict[str, Any] | None, far: float | None
) -> dict[str, Any]:
    """Return the row of a log: in the joint solution, and as smoothed alone."""
    row: dict[str, Any] = {"log": task.name, "path": str(task.job.log_path), "used": "yes"}
    if after is None:
        return row | {"used": "no", **{k: before[k] for k in ("verdict", "code", "reason")}}
    row |= after
    row["from_others_sigma"] = far
    kept = ("verdict", "position_sigma_m", "attitude_sigma_deg", "aligned_ate_m", "ate_m")
    return row | {f"alone_{key}": before[key] for key in kept if key in before}


def trust_of_all(
    table: list[dict[str, Any]], agreed: LogAgreement, undetected: list[str], moved: float
) -> Trust:
    """Return the joint verdict: consistency between the logs, then the findings of each.

    Parameters
    ----------
    table : list of dict
        A row for each log.
    `undetected` : list of str
        Beacons that are detected in no log.
    moved : float
        Change of the shared calibration in the last round, in sigmas.
    """
    result = [finding for findings in agreed.of_log for finding in findings]
    contradicted = {finding.text for finding in result}
    for row in table:
        if row["used"] == "no":
            text = f"Log {row['log']} is not used, as it failed alone: {row['reason']}"
            result.append(Finding("log_left_out", text, weight=100.0))
        elif row["code"] and row["reason"] not in contradicted:
            text = f"Log {row['log']}: {row['reason']}"
            verdict = Verdict.DOUBTFUL  # of all; each log has its own
            result.append(Finding(row["code"], text, verdict))
    for name in undetected:
        text = (
            f"Beacon {name} is not detected in any log; its entry is unchanged. Check that the logs"
            " are of this site."
        )
        result.append(Finding("silent_beacon", text, weight=50.0))
    if not moved < UNSETTLED:
        text = (
            f"The logs did not converge to one calibration: the last of {MOST_ROUNDS} rounds still"
            f" moved it by {moved:.2g} sigma. Omit the log that is farthest from the others."
        )
        result.append(Finding("not_converged", text))
    return Trust(tuple(result))
