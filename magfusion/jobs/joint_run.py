"""Several logs of one site: each alone, then rounds to a common calibration, then a final pass.

The results of a log alone are stored in the output under a key; the rounds resume from them.  The
driver holds sums over the logs, and passes names of files.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.batch.calendar import Calendar
from magfusion.estimation.batch.change_between_logs import FoundChange
from magfusion.estimation.batch.joint import SharedCalibration
from magfusion.estimation.integrity.logs_agree import LogAgreement
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.files.atomic import real
from magfusion.files.checkpoint import run_key
from magfusion.files.kept import digest_of_files
from magfusion.files.site_changes import changed_keys
from magfusion.jobs.inputs import Job, read_job, read_site
from magfusion.jobs.joint_calendar import ChangeReport, check_dates, describe_change
from magfusion.jobs.joint_driver import MAX_ROUNDS, Driver
from magfusion.jobs.joint_tasks import Alone, LastTask, LogTask, SiteFiles, alone, last, shared_of
from magfusion.jobs.written import KEPT, SITE_FILES
from magfusion.model.progress import Report
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Trust, Verdict
from magfusion.results.provenance import versions
from magfusion.simulation.monte_carlo import worker_pool
from magfusion.units import Rate

UNSETTLED = 0.1  # sigmas that the last round may have moved it by


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint solution of several logs of one site.

    Parameters
    ----------
    known : SharedCalibration
        Of the parameters of all logs.
    months : list of dict
        Parameters by month.
    excess : float
        Factor on its variances, as the logs contradict each other.
    noise : tuple of tuple of Tuned
        For each platform, estimated from each log alone.
    table : list of dict
        A row for each given log.
    """

    known: SharedCalibration
    calendar: Calendar
    changes: list[ChangeReport]
    months: list[dict[str, Any]]
    excess: float
    noise: tuple[tuple[Tuned, ...], ...]
    table: list[dict[str, Any]]
    trust: Trust
    rounds: int


def tasks_of(jobs: Sequence[Job], smoother: SmootherSettings, output: Path) -> list[LogTask]:
    """Return the tasks of some logs, after checking that they are different logs of one site."""
    for job in jobs:
        if not job.log_path.exists():
            read_job(job)  # which says so
    site, platforms = _one_site(jobs, smoother)
    names, seen = _names([job.log_path for job in jobs]), dict[str, Path]()
    tasks = []
    for job, name, platform in zip(jobs, names, platforms, strict=True):
        content = digest_of_files([job.log_path], without=frozenset(SITE_FILES))
        if content in seen:
            raise InputError(
                f"{job.log_path}: is the same log as {seen[content]} and would count twice; give"
                " each log once"
            )
        seen[content] = job.log_path
        made_by = content, site[platform], job.start, job.end, job.topics, smoother, versions()
        key = run_key("smooth", *made_by)
        place = real(output) / KEPT
        own = replace(job, output=place / name)
        tasks.append(LogTask(name, own, smoother, place / f"{name}.npz", key, platform))
    return tasks


def _one_site(jobs: Sequence[Job], smoother: SmootherSettings) -> tuple[list[str], list[int]]:
    """Return the digest of the site with each platform, and the platform of each log."""
    digests: dict[str, Path] = {}
    first, platforms = read_site(jobs[0]), []
    for job in jobs:
        path, site = job.declared_path, read_site(job)
        digest = run_key("site", site)  # with its maps, whatever their files are named
        if digest not in digests:
            other = [k for k in changed_keys(first, site) if k.split(".")[0] != "platform"]
            if other:
                raise InputError(
                    f"{path}: {other[0]} differs from {jobs[0].declared_path}; logs that refine one"
                    " site share its file but for the platform: give it with --site SITE.yaml"
                )
            digests[digest] = path
        platforms.append([*digests].index(digest))
    shared = shared_of(read_site(jobs[0]), smoother)
    if smoother.coupling == "loose" or not shared.blocks:
        raise InputError(
            f"{jobs[0].declared_path}: the logs estimate no shared calibration, so that there is"
            " nothing to refine together; declare the uncertainty of the survey, keep --coupling"
            " tight and --estimate as they are, or smooth each log on its own"
        )
    return [*digests], platforms


def site_files(tasks: Sequence[LogTask]) -> SiteFiles:
    """Return the files of the site with each platform."""
    of_platform = {task.platform: task.job for task in reversed(tasks)}
    return SiteFiles(tuple(of_platform[i] for i in sorted(of_platform)), tasks[0].smoother)


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
    by_date: bool = False,
    report: Report,
) -> Joint:
    """Refine one site with all logs together.

    `writes`: whether the trajectory of each log is written, to its job's output. `by_date`: whether
    changes between the logs are searched, and what changed has new parameters. Raises InputError
    where a log cannot be used, or the cluster not be reached. Raises EstimationError where no log
    remains.
    """
    files = site_files(tasks)
    with worker_pool(len(tasks), cluster=cluster, workers=workers) as hands:
        first = hands.run(alone, tasks, report=_staged(report, "smoothing each log alone"))
        used = [
            (one.time, task)
            for task, one in zip(tasks, first, strict=True)
            if one.facts["verdict"] != Verdict.FAILED
        ]
        if not used:
            raise EstimationError(
                f"none of the {len(tasks)} logs can be used: {tasks[0].name}:"
                f" {first[0].facts['reason']}"
            )
        driver = Driver(hands, [task for _, task in used], files, report)
        changes: list[FoundChange] = []
        if by_date:
            check_dates([time for time, _ in used], [task.name for _, task in used])
            driver, changes = driver.with_changes()
        sums = driver.first_sums()
        before = driver.agreement(sums)
        sums, moved = driver.repeated(sums)
        known = sums.known
        # Given the prior of the others, a robust loss soon rejects contradicting measurements.
        agreed = before if any(before.of_log) else driver.agreement(sums)
        given = [
            LastTask(one, agreed.excess, findings, writes, rate, risk)
            for one, findings in zip(driver.last_tasks(sums), agreed.of_log, strict=True)
        ]
        rows = hands.run(last, given, report=_staged(report, "each log in the joint solution"))
        months = driver.months(sums) if by_date else []
    of_used = {t.name: row for t, row in zip(driver.tasks, rows, strict=True)}
    far = {t.name: float(s) for t, s in zip(driver.tasks, agreed.sigmas, strict=True)}
    table = [
        _row(task, one.facts, of_used.get(task.name), far.get(task.name))
        for task, one in zip(tasks, first, strict=True)
    ]
    trust = trust_of_all(table, agreed, _undetected(read_site(files.jobs[0]), first), moved)
    noise = tuple(
        tuple(
            tuned
            for task, one in zip(tasks, first, strict=True)
            if task.platform == platform
            for tuned in one.noise
        )
        for platform in range(len(files.jobs))
    )
    reports = [describe_change(one, driver.calendar, known) for one in changes]
    trust |= Trust(tuple(one.finding for one in reports))
    return Joint(
        known, driver.calendar, reports, months, agreed.excess, noise, table, trust, sums.rounds
    )


def _staged(report: Report, stage: str) -> Report:
    return lambda _stage, done, total: report(stage, done, total)


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
    undetected : list of str
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
            f"The logs did not converge to one calibration: the last of {MAX_ROUNDS} rounds still"
            f" moved it by {moved:.2g} sigma. Omit the log that is farthest from the others."
        )
        result.append(Finding("not_converged", text))
    return Trust(tuple(result))
