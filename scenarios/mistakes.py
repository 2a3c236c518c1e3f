"""Common mistakes, and how they are reported: verdict, cause, error, claim.

Each mistake of `mistake_list` is made on three logs of 40 s from the package's own simulator:
moving with an exact survey, moving with a rough one, and at rest.  `smooth` and both online
estimators run as jobs, so that exit codes and ``report.json`` are judged.  A row is *silent* where
the verdict is trustworthy, the mean NEES is above 20, and the parameter is not listed as
unverified.  The log's truth has a part in this table only.
With ``--remedies`` the first reason's remedy is followed wherever it is given as keys of the site's
file, and the estimator runs again: the remedy works where that result is trustworthy and right.

The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

import argparse
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from mistake_case import LOGS, Mistake, good_case
from mistake_list import GOOD, MISTAKES
from mistake_remedy import follow_remedy

from magfusion.errors import EstimationError, InputError
from magfusion.simulation.monte_carlo import run_many

ESTIMATORS = ("smooth", "smoother", "ekf")
SILENT_NEES = 20.0
SLOW = 3.0


@dataclass(frozen=True)
class Config:
    """Which part of the table is made."""

    mistakes: tuple[str, ...] = tuple(MISTAKES)
    logs: tuple[str, ...] = LOGS
    estimators: tuple[str, ...] = ESTIMATORS
    seed: int = 11
    remedies: bool = False


@dataclass(frozen=True)
class Row:
    """What one estimator makes of one mistake on one log."""

    mistake: str
    log: str
    estimator: str
    exit: int  # as of the command; 3 is a traceback
    verdict: str
    codes: tuple[str, ...]
    text: str
    unverified: tuple[str, ...]
    error_m: float | None
    error_deg: float | None
    claimed_m: float | None
    claimed_deg: float | None
    nees: float | None
    seconds: float
    remedy: str = ""  # followed, it "works" or "fails"

    @property
    def known(self) -> Mistake:
        """The mistake that was made."""
        return MISTAKES.get(self.mistake, GOOD)

    @property
    def listed(self) -> bool:
        """Whether the parameter is among the unverified."""
        part = self.known.parameter
        return bool(part) and any(part in name for name in self.unverified)

    @property
    def silent(self) -> bool:
        """Whether a wrong result passes as a right one, without a finding."""
        wrong = self.nees is not None and self.nees > SILENT_NEES
        reported = self.listed or self.known.unknowable
        return self.verdict == "trustworthy" and wrong and not reported

    @property
    def diagnosable(self) -> bool:
        """Whether a cause is to be named: there is one to name, and it leaves a trace."""
        known = self.known
        seen = self.log not in known.unseen and self.exit != 2  # which says what it refuses
        return bool(known.codes) and seen and not self.harmless

    @property
    def harmless(self) -> bool:
        """Whether the result is trusted, rightly: its error is within what it claims."""
        wrong = self.nees is not None and self.nees > SILENT_NEES
        return self.verdict == "trustworthy" and not wrong

    @property
    def right(self) -> bool:
        """Whether the right cause comes first."""
        return bool(self.codes) and self.codes[0] in self.known.codes


@dataclass(frozen=True)
class Task:
    """One mistake on one log, by some estimators."""

    mistake: str
    log: str
    estimators: tuple[str, ...]
    seed: int
    remedies: bool = False


def run(config: Config, scale: Scale | None = None) -> list[Row]:
    """Return the rows of the table, those of the good log first."""
    names = ("good", *(name for name in config.mistakes if name != "good"))
    settings = config.estimators, config.seed, config.remedies
    tasks = [Task(name, log, *settings) for log in config.logs for name in names]
    result = run_many(judge, tasks, seed=config.seed, **(scale or {}))
    return [row for rows in result for row in rows]


def judge(task: Task, _rng: np.random.Generator) -> list[Row]:
    """Make a mistake, and return the estimators' results."""
    from magfusion.files.log import write_log
    from magfusion.files.site import save_site

    known = MISTAKES.get(task.mistake, GOOD)
    rows = []
    with tempfile.TemporaryDirectory(prefix="mistakes_") as name:
        directory = Path(name)
        try:
            case = known.change(good_case(task.log, task.seed))
            write_log(case.log, directory / "log")
            save_site(case.site, directory / "log" / "site.yaml")
        except InputError as error:  # not even a file can hold it
            return [_row(task, e, 2, {}, str(error), 0.0) for e in task.estimators]
        for estimator in task.estimators:
            log, output = directory / "log", directory / estimator
            row = _estimated(task, estimator, log, output)
            rows.append(replace(row, remedy=_followed(task, row, log, output)))
    return rows


def _followed(task: Task, row: Row, log: Path, output: Path) -> str:
    """Return what the first reason's remedy gives; nothing where there is none to follow."""
    report = output / "report.json"
    reasons = json.loads(report.read_text())["reasons"] if report.is_file() else []
    if not task.remedies or not reasons or "remedy" not in reasons[0]:
        return ""
    site = output.with_suffix(".yaml")
    follow_remedy(log / "site.yaml", reasons[0]["remedy"], site)
    again = _estimated(task, row.estimator, log, output.with_suffix(".again"), site)
    right = again.nees is not None and again.nees <= SILENT_NEES
    return "works" if again.verdict == "trustworthy" and right else "fails"


def _estimated(
    task: Task, estimator: str, log: Path, output: Path, site: Path | None = None
) -> Row:
    began, code, findings = time.process_time(), 0, ""
    try:
        _run_job(estimator, log, output, site)
    except InputError as error:
        code, findings = 2, str(error)
    except EstimationError as error:
        code, findings = 1, str(error)
    except Exception:
        code, findings = 3, traceback.format_exc()
    spent = time.process_time() - began
    place = output / "report.json"
    report = json.loads(place.read_text()) if place.is_file() else {}
    return _row(task, estimator, code, report, findings, spent)


def _run_job(estimator: str, log: Path, output: Path, site: Path | None) -> None:
    if estimator == "smooth":
        from magfusion.jobs import smooth

        smooth.run(smooth.SmoothSettings(log=log, site=site), output)
        return
    from magfusion.jobs.navigate import run_navigate
    from magfusion.jobs.navigate_settings import NavigateSettings

    settings = NavigateSettings(log=log, site=site, estimator=estimator)
    run_navigate(settings, output)


def _row(task: Task, estimator: str, code: int, report: dict, findings: str, seconds: float) -> Row:
    reasons = report.get("reasons", [])
    # Exit 1 and 2 give no result, whatever else there is.
    usual = {0: "trustworthy", 1: "failed", 2: "refused", 3: "traceback"}[code]
    return Row(
        task.mistake,
        task.log,
        estimator,
        code,
        report.get("verdict", usual) if code < 2 else usual,
        tuple(reason["code"] for reason in reasons),
        reasons[0]["text"] if reasons else findings,
        tuple(one["parameter"] for one in report.get("unverified", [])),
        report.get("ate_m"),
        report.get("attitude_rmse_deg"),
        report.get("position_sigma_median_m"),
        report.get("attitude_sigma_median_deg"),
        report.get("nees_mean"),
        seconds,
    )


@dataclass(frozen=True)
class Summary:
    """What the table comes to; rows of the good logs apart."""

    rows: int
    silent: tuple[str, ...]
    diagnosable: int
    right_first: float
    tracebacks: tuple[str, ...]
    slow: tuple[str, ...]
    false_alarms: tuple[str, ...]
    remedies: int
    failing_remedies: tuple[str, ...]
    wrong_cause: tuple[str, ...]


def summed(rows: Sequence[Row]) -> Summary:
    """Return the summary of a table."""
    wrong = [row for row in rows if row.mistake != "good"]
    requested = [row for row in wrong if row.diagnosable]
    right = sum(row.right for row in requested)
    ratio = slowness(rows)
    return Summary(
        rows=len(wrong),
        silent=tuple(_named(row) for row in wrong if row.silent),
        diagnosable=len(requested),
        right_first=right / max(len(requested), 1),
        tracebacks=tuple(_named(row) for row in rows if row.exit == 3),
        slow=tuple(_named(row) for row, r in zip(rows, ratio, strict=True) if r > SLOW),
        false_alarms=tuple(
            _named(r) for r in rows if r.mistake == "good" and r.verdict != "trustworthy"
        ),
        remedies=sum(bool(row.remedy) for row in wrong),
        failing_remedies=tuple(_named(row) for row in wrong if row.remedy == "fails"),
        wrong_cause=tuple(
            f"{_named(r)}: {', '.join(r.codes[:1])}" for r in requested if not r.right
        ),
    )


def slowness(rows: Sequence[Row]) -> list[float]:
    """Return the processor time of each row relative to that of the good log of its sensors."""
    good = {(r.mistake, r.log, r.estimator): r.seconds for r in rows}

    def of_good(row: Row) -> float:
        key = row.log, row.estimator
        aided = good.get(("aiding_as_declared", *key)) if row.known.group == "aiding" else None
        return good["good", *key] if aided is None else aided

    return [row.seconds / of_good(row) for row in rows]


def _named(row: Row) -> str:
    return f"{row.mistake} ({row.log}, {row.estimator})"


def table(rows: Sequence[Row], texts: bool = False) -> str:
    """Return the table that a reader sees, and its summary."""
    lines = [
        f"{'mistake':26}{'log':8}{'by':10}{'verdict':13}{'exit':>4}  {'first reason':22}"
        f"{'error cm':>9}{'deg':>8}{'claims':>8}{'deg':>7}{'NEES':>9}{'time':>6}"
    ]
    for row, ratio in zip(rows, slowness(rows), strict=True):
        marks = [
            word
            for word, there in (
                ("SILENT", row.silent),
                ("right", row.right),
                ("other cause", row.diagnosable and not row.right and not row.silent),
                ("listed", row.listed),
                (f"remedy {row.remedy}", row.remedy),
            )
            if there
        ]
        lines.append(
            f"{row.mistake:26}{row.log:8}{row.estimator:10}{row.verdict:13}{row.exit:>4}"
            f"  {row.codes[0] if row.codes else '-':22}{_number(row.error_m, 100.0):>9}"
            f"{_number(row.error_deg):>8}{_number(row.claimed_m, 100.0):>8}"
            f"{_number(row.claimed_deg):>7}{_number(row.nees):>9}{ratio:>6.2f}  {', '.join(marks)}"
        )
        if texts and row.text:
            lines.append(f"    {row.text}")
    result = summed(rows)
    lines += [
        f"{result.rows} rows with a mistake; silent: {len(result.silent)}",
        f"right cause first in {100 * result.right_first:.0f} % of {result.diagnosable}"
        " diagnosable",
        f"{result.remedies} remedies followed; failing: {len(result.failing_remedies)}",
    ]
    for name in ("silent", "tracebacks", "slow", "false_alarms", "failing_remedies"):
        listed = getattr(result, name)
        lines.append(f"{name}: {len(listed)}" + "".join(f"\n    {one}" for one in listed))
    return "\n".join(lines)


def _number(value: float | None, scale: float = 1.0) -> str:
    return "-" if value is None else f"{scale * value:.3g}"


def _chosen(text: str | None, known: Sequence[str]) -> tuple[str, ...]:
    """Return those of some names that a comma-separated text gives, all of them by default."""
    if text is None:
        return tuple(known)
    chosen = tuple(part.strip() for part in text.split(",") if part.strip())
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise SystemExit(f"{', '.join(unknown)}: not known; choose from {', '.join(known)}")
    return chosen


def _parser() -> argparse.ArgumentParser:
    parser = scenario_parser(__doc__, Config.seed, output=None, parallel=True)
    parser.add_argument("--mistakes", help="some of them, or groups, separated by commas")
    parser.add_argument("--logs", help=f"of {','.join(LOGS)}")
    parser.add_argument("--estimators", help=f"of {','.join(ESTIMATORS)}")
    parser.add_argument("--texts", action="store_true", help="the first reason in full, too")
    parser.add_argument("--remedies", action="store_true", help="follow them, and run again")
    parser.add_argument("--list", action="store_true", help="print the mistakes, and end")
    return parser


def main() -> None:
    """Print the table and one JSON line."""
    given = _parser().parse_args()
    if given.list:
        sys.stdout.write("\n".join(f"{m.group:6} {m.name}" for m in MISTAKES.values()) + "\n")
        return
    groups = sorted({m.group for m in MISTAKES.values()})
    chosen = set(_chosen(given.mistakes, [*MISTAKES, *groups]))
    config = Config(
        mistakes=tuple(m.name for m in MISTAKES.values() if {m.name, m.group} & chosen),
        logs=_chosen(given.logs, LOGS),
        estimators=_chosen(given.estimators, ESTIMATORS),
        seed=given.seed,
        remedies=given.remedies,
    )
    rows = run(config, chosen_scale(given))
    figures = [asdict(row) | {"silent": row.silent, "right": row.right} for row in rows]
    conclude(table(rows, given.texts), {"rows": figures, "summary": summed(rows)})


if __name__ == "__main__":
    main()
