"""The calendar of several logs: changes between them, and their parameters by month."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.calendar import Calendar, LogBlocks
from magfusion.estimation.batch.change_between_logs import (
    FoundChange,
    PeriodTest,
    find_changes,
    period_tests,
)
from magfusion.estimation.batch.joint import LogInformation, SharedCalibration
from magfusion.estimation.data_checks.statistics import log_p_chi_square, sigmas
from magfusion.jobs.joint_kept import load_information
from magfusion.jobs.joint_tasks import SiteFiles
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    LOG_MOMENT,
    Block,
    dimension,
)
from magfusion.model.trust import Finding
from magfusion.units import DEGREE, Array

MIN_UNIX_S = 946_684_800.0  # s, Unix: 2000-01-01; a log's epoch before it is no date
EXCHANGED_SIGMAS = 5.0  # of the moments, beyond which a beacon was exchanged rather than moved


@dataclass(frozen=True)
class CalendarTask:
    """Files of the logs' information, to be searched for changes, or compared by month.

    `at` (s,): linearisation point, from the declared calibration; the mean of the logs by default.
    """

    files: SiteFiles
    paths: tuple[Path, ...]
    at: Array | None = None


class _Files(NamedTuple):
    """Files of the logs' information, in the order of their times."""

    paths: list[Path]
    logs: list[LogBlocks]

    def load(self, i: int) -> LogInformation:
        """Return the information of a log."""
        return load_information(self.paths[i]).information


def _in_order(paths: Sequence[Path]) -> _Files:
    logs = [load_information(path).blocks for path in paths]
    known = [(log, path) for log, path in zip(logs, paths, strict=True) if log is not None]
    known.sort(key=lambda pair: pair[0].time)
    return _Files([path for _, path in known], [log for log, _ in known])


def mean_step(calendar: Calendar, paths: Sequence[Path]) -> Array:
    """Return the mean step of the logs to the parameters of all, from the declared."""
    total = np.zeros(dimension(calendar.shared.blocks))
    count = np.zeros(len(total))
    for path in paths:
        stored = load_information(path)
        assert stored.blocks is not None
        columns, _ = calendar.columns(stored.blocks)
        total[columns] += stored.information.step
        count[columns] += 1.0
    return total / np.maximum(count, 1.0)


def search_changes(given: CalendarTask, _rng: np.random.Generator) -> list[FoundChange]:
    """Return the changes that the logs show."""
    files = _in_order(given.paths)
    calendar = given.files.calendar()
    return find_changes(calendar, files.logs, files.load, lambda c: mean_step(c, files.paths))


def by_month(given: CalendarTask, _rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return the table of owners and months."""
    files, calendar = _in_order(given.paths), given.files.calendar()
    at = mean_step(calendar, files.paths) if given.at is None else given.at
    months = [int(_date(log.time).astype("datetime64[M]").astype(int)) for log in files.logs]
    tests = period_tests(calendar, files.logs, files.load, at, months)
    blocks: dict[str, list[Block]] = {}
    for block in calendar.shared.blocks:
        blocks.setdefault(block.owner, []).append(block)
    return [
        _month_row(str(np.datetime64(month, "M")), one, blocks[one.owner])
        for month in sorted(tests)
        for one in tests[month]
    ]


def _month_row(month: str, one: PeriodTest, blocks: list[Block]) -> dict[str, Any]:
    row: dict[str, Any] = {
        "month": month,
        "owner": one.owner,
        "logs": one.logs,
        "chi_square": one.chi_square,
        "freedom": one.freedom,
        "difference_sigma": float(sigmas(log_p_chi_square(one.chi_square, one.freedom))),
    }
    start = 0
    for block in blocks:
        rows = slice(start, start + len(block.sigma))
        start = rows.stop
        for parameter, key, unit in _REPORTED:
            if block.parameter == parameter:
                difference = one.difference[rows] / unit
                row[key] = _norm(difference) if len(difference) == 3 else float(difference.mean())
                row[f"{key}_sigma"] = _norm(one.sigma[rows] / unit)
    return row


_REPORTED = (
    (BEACON_POSITION, "position_m", 1.0),
    (BEACON_ROTATION, "rotation_deg", DEGREE),
    (LOG_MOMENT, "log_moment", 1.0),
)


def _norm(values: Array) -> float:
    return float(np.sqrt(np.sum(values**2)))


def _date(time: float) -> np.datetime64:
    return np.datetime64(int(time), "s")


def check_dates(times: Sequence[float], names: Sequence[str]) -> None:
    """Raise an error for a log without a date."""
    for time, name in zip(times, names, strict=True):
        if time < MIN_UNIX_S:
            raise InputError(
                f"log {name}: its time {_date(time)} is no date, as --calendar needs; set epoch_ns"
                " in its log.yaml, ns since 1970"
            )


class ChangeReport(NamedTuple):
    """A change of a beacon or a platform between logs.

    Parameters
    ----------
    cause : {"moved", "exchanged", "changed"}
    row : dict
        For ``report.json``.
    """

    cause: str
    row: dict[str, Any]

    @property
    def finding(self) -> Finding:
        """The finding."""
        row = self.row
        amounts = ", ".join(
            f"{row[key]:.3g}{unit}"
            for key, unit in (("moved_m", " m"), ("rotated_deg", "°"), ("log_moment", " ln moment"))
            if key in row
        )
        text = (
            f"{row['owner']} was {self.cause} between {row['after'][:10]} and {row['before'][:10]}"
            f" ({amounts}; chi square {row['chi_square']:.3g} on {row['freedom']}). Its parameters"
            " are estimated separately before and after."
        )
        return Finding("site_changed", text, weight=row["chi_square"])


def describe_change(
    detected: FoundChange, calendar: Calendar, known: SharedCalibration
) -> ChangeReport:
    """Return the cause and the size of a change.

    `known`: of the parameters of all logs.
    """
    change, blocks = detected.change, calendar.shared.blocks
    row: dict[str, Any] = {
        "owner": detected.test.owner,
        "after": str(_date(detected.between[0])),
        "before": str(_date(detected.between[1])),
        "chi_square": detected.test.chi_square,
        "freedom": detected.test.freedom,
    }
    by_name = {(b.parameter, b.owner): b.columns for b in blocks}
    cause, honest = "changed", known.honest
    for parameter, key, unit in _CHANGED:
        new, old = (by_name.get((parameter, owner)) for owner in (change.name, detected.test.owner))
        if new is None or old is None:
            continue
        step = known.step[new] - known.step[old]
        cov = honest[new, new] + honest[old, old] - honest[new, old] - honest[old, new]
        row[key] = (_norm(step) if len(step) == 3 else float(step.mean())) / unit
        square = float(step @ np.linalg.solve(cov, step))
        row[f"{key}_sigma"] = float(sigmas(log_p_chi_square(square, len(step))))
        if change.platform < 0 and cause == "changed":
            cause = "moved"
        if parameter == LOG_MOMENT and row[f"{key}_sigma"] > EXCHANGED_SIGMAS:
            cause = "exchanged"
    return ChangeReport(cause, {"cause": cause, **row})


_CHANGED = (
    (BEACON_POSITION, "moved_m", 1.0),
    (BEACON_ROTATION, "rotated_deg", DEGREE),
    (LOG_MOMENT, "log_moment", 1.0),
)
