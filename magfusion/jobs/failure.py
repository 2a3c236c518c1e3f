"""Report of a failed job, in place of its result."""

import json
from pathlib import Path

from magfusion.errors import UNOBSERVABLE, EstimationError, InputError
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures

# They report failures themselves, and their files allow a killed run to be resumed.
_OWN = ("navigate", "drift")
_SHOWN = {"job": Section.TITLE, "log": Section.TITLE} | dict.fromkeys(
    ("verdict", "reasons", "remarks", "unverified"), Section.VERDICT
)


def failed_figures(
    job: str, log: str, output: Path, error: EstimationError, written: bool
) -> Figures | None:
    """Return the figures of a job that raised, and write them to its output.

    `job`, `log`: as in the heading of a report. `written`: whether the job has written its report
    itself. Returns None where the report cannot be written.
    """
    if written:
        return _read(output / "report.json")
    if job in _OWN:
        return None
    from magfusion.jobs.result_directory import claim, found_in
    from magfusion.results.report import write_report

    trust = Trust((Finding("no_solution", f"{error}.", Verdict.FAILED),))
    figures = heading(job, log) | trust_figures(trust)
    kinds = ("smooth", "fix") if job in ("smooth", "fix", "demo") else (job,)
    try:
        with claim(output, *kinds) as whole:
            found_in(whole, trust)
            write_report(whole, figures)
    except (InputError, OSError):
        return None
    return figures


def _read(path: Path) -> Figures:
    reported = json.loads(path.read_text(encoding="utf-8"))
    return Figures(
        *(
            Figure(name, value, section=_SHOWN.get(name, Section.REPORT))
            for name, value in reported.items()
        )
    )


def reason_of(error: RuntimeError) -> str:
    """Return the reason of a failed estimate.

    Raises RuntimeError the same error, where the reason is unknown.
    """
    if isinstance(error, EstimationError):
        return str(error)
    if "Indeterminate" in str(error):
        return UNOBSERVABLE
    raise error
