"""A result as one page for reviewers of a measurement: ``report.html``.

The page is one file without network access: pictures are embedded, there is no script, and all
content from a user's file (a beacon's name, a path) is escaped.
"""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from magfusion.results.brief import table
from magfusion.results.figures import Figures, ParameterEstimate, Section, Value
from magfusion.results.page_motion import (
    MotionPage,
    error_section,
    excluded_rows,
    path_section,
    residual_section,
)
from magfusion.results.page_style import STYLE
from magfusion.results.provenance import Run, current_run, input_files, versions
from magfusion.results.shown import (
    as_sure,
    column_rows,
    findings,
    labelled,
    log_rows,
    notes,
    number_text,
    sentences,
    summary_rows,
)
from magfusion.results.verdict import look_of

PAGE = "report.html"
MAX_BYTES = 4_500_000  # bytes, of which a mail takes one
FAR = 3.0  # sigmas; a change beyond is marked
_MEANING = {
    "trustworthy": "The data are consistent; the reported accuracy is valid.",
    "doubtful": "Use with care, for these reasons; the reported accuracy of a pose is enlarged to"
    " cover them.",
    "failed": "Do not use: the content below is for diagnosis only.",
    "stable": "No drift within the resolution of the run, and errors within their covariance.",
    "inconclusive": "The run is too short, or its worlds are too few, for an answer.",
    "unstable": "It drifts, or its errors exceed their covariance.",
    "reached": "The protection level is within the limit at every point.",
    "not reached": "The protection level exceeds the limit at some points.",
    "pass": "Every beacon is as declared, within what the measurements detect.",
    "not proven": "No beacon contradicts its declaration; some need more measurements.",
}
NO_JUDGE = "This job has no verdict."
_CAPTIONS = {
    "allan": "Allan deviation of each axis",
    "antenna": "Antennas: residuals and estimates",
    "attitude": "Estimated angles over time, and their errors against the truth, if any",
    "attitudes": "Attitudes in the database",
    "beacon": "Beacons: residuals of the survey",
    "calibration": "Observability of the calibration: posterior sigma over prior sigma",
    "check": "Spectrum, signal to noise, gravity and static field",
    "coverage": "Where the installation can navigate",
    "design": "Protection levels before and after",
    "error_budget": "Error budget: share of each source in the variance of the position",
    "drift": "Errors and their sigmas over the days",
    "field_map": "Deviation of the beacons' fields from their model",
    "magnetometer": "Magnetometer: field before and after",
    "motion": "Next stops of the platform, and the parameters they determine",
    "range": "Position of the magnet's well, down the hole and by depth",
    "stability": "Stability of the estimates",
    "survey": "Points of the survey",
}


def write_page(directory: Path, figures: Figures, motion: MotionPage | None = None) -> None:
    """Write ``report.html`` with the pictures (``.png``) in the directory.

    `motion`: the estimated motion, if any.
    """
    blocks = _head(figures)
    if motion is not None:
        blocks += [
            _section("Path", path_section(motion)),
            _section(*error_section(motion)),
            _section("Residuals by beacon", residual_section(motion)),
        ]
    blocks.append(_section("Calibration, before and after", _calibration(figures)))
    after = [
        _section("Rejected or omitted data", _refused(figures, motion)),
        _section("Notes", _list(_notes(figures))),
        _section("Command, inputs and versions", _how(current_run())),
        _section("All figures of report.json", _all(figures)),
    ]
    room = MAX_BYTES - sum(len(block.encode()) for block in (*blocks, *after, STYLE))
    blocks.append(_section("Pictures", _pictures(directory, room)))
    text = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\';'
        " img-src data:; style-src 'unsafe-inline'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(_title(figures))}</title><style>{STYLE}</style></head>\n"
        '<body class="page">\n' + "\n".join(filter(None, [*blocks, *after])) + "\n</body></html>\n"
    )
    (directory / PAGE).write_text(text, encoding="utf-8", errors="replace")


def head_in_notebook(figures: Figures, unjudged: str = NO_JUDGE) -> str:
    """Return the head of the page as a part of another page, with its style in its own scope.

    `unjudged`: shown where there is no verdict.
    """
    parts = "\n".join(filter(None, _head(figures, unjudged)))
    # The rules of a style sheet nested in a class apply to elements inside it.
    style = f"<style>.magfusion{{{STYLE}}}</style>"
    return f'<div class="magfusion">{style}<div class="page">\n{parts}\n</div></div>'


def _head(figures: Figures, unjudged: str = NO_JUDGE) -> list[str]:
    """Return title, verdict and main figures, without empty sections."""
    return [
        f"<h1>magfusion {escape(_name(figures))}</h1>",
        _verdict(figures, unjudged),
        _section("Fixed, not observable in this log", _unverified(figures)),
        _section("Logs", "".join(_table(log_rows(f)) for f in figures.of(Section.LOGS))),
        _section("Main figures", _main(figures)),
    ]


def _name(figures: Figures) -> str:
    return " of ".join(str(figure.value) for figure in figures.of(Section.TITLE))


def _title(figures: Figures) -> str:
    name = _name(figures)
    return f"{figures['verdict']}: {name}" if "verdict" in figures else name


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{escape(heading)}</h2>\n{content}</section>" if content else ""


def _verdict(figures: Figures, unjudged: str) -> str:
    if "verdict" not in figures:
        messages = f"<strong>NO VERDICT</strong><p>{escape(unjudged)}</p>"
        return f'<div class="verdict none">{messages}</div>'
    verdict = str(figures["verdict"])
    reasons = [_finding(one) for one in findings(figures, "reasons")]
    reasons += [f"Noticed: {_finding(one)}" for one in findings(figures, "remarks")]
    listed = "".join(f"<li>{reason}</li>" for reason in reasons)
    return (
        f'<div class="verdict {look_of(verdict)}"><strong>{escape(verdict.upper())}</strong>'
        f"<p>{_MEANING.get(verdict, '')}</p>{f'<ul>{listed}</ul>' if listed else ''}</div>"
    )


def _finding(one: dict[str, str | float]) -> str:
    return f"{escape(str(one['text']))} <code>{escape(str(one['code']))}</code>"


def _unverified(figures: Figures) -> str:
    rows = [
        [
            str(one["parameter"]),
            number_text(one["sigma"]),
            number_text(1e3 * float(one["position_m"])),
            number_text(one["rotation_deg"]),
        ]
        for one in findings(figures, "unverified")
    ]
    if not rows:
        return ""
    messages = (
        "<p>These parameters are fixed at their declared values. If one of them were wrong by its"
        " declared sigma, the data would not show it, and the pose would be wrong by:</p>"
    )
    head = ["parameter", "declared sigma", "position (mm)", "attitude (deg)"]
    return messages + _table([head, *rows])


def _main(figures: Figures) -> str:
    errors = column_rows(figures.of(Section.ERRORS), "")
    transfer = column_rows(figures.of(Section.TRANSFER), "other part of the log")
    parts = (table(figures), errors, transfer)
    tables = [_table(rows) for rows in parts if len(rows) > 1]
    summary = [list(row) for row in summary_rows(figures.of(Section.SUMMARY))]
    content = "".join([*tables, _table([[], *summary]) if summary else ""])
    return f'<div class="charts">{content}</div>' if content else ""


def _calibration(figures: Figures) -> str:
    """Return the estimate of each parameter before and after, starting at its declared value."""
    estimates = [f for f in figures.all if isinstance(f, ParameterEstimate)]
    if not estimates:
        return ""
    head = ["parameter", "before", "after", "change in sigmas", "determined"]
    rows: list[list[str]] = []
    far: set[int] = set()
    for one in estimates:
        known = one.prior_sigma > 0.0
        before = _value(one, 0.0, one.prior_sigma) if known else "not known"
        change = one.change / one.prior_sigma if one.prior_sigma else None
        if change is not None and abs(change) > FAR:
            far.add(len(rows))
        after = _value(one, one.change, one.sigma)
        reported = "" if change is None else f"{change:+.2f}"
        rows.append([one.key, before, after, reported, "yes" if one.determined else "no"])
    findings = (
        "<p>Each with one sigma; Δ is relative to the declared value. The change is in sigmas of"
        f" the declared value, and marked beyond {FAR:g}. Parameters that these data do not"
        " determine keep their uncertainty.</p>"
    )
    return findings + _table([head, *rows], far)


def _value(one: ParameterEstimate, change: float, sigma: float) -> str:
    """Return a parameter after a change and its sigma, to the second digit of the smaller one."""
    smaller = min(filter(None, (one.sigma, one.prior_sigma)), default=0.0)
    if one.declared is None:
        value = f"Δ {as_sure(change, smaller) if change else 0}"
    else:
        value = as_sure(one.declared + change, smaller).removeprefix("+")
    # A narrow page breaks no line between a value and its sigma.
    return f"{value} ± {number_text(sigma, 2)}".replace(" ", "\N{NO-BREAK SPACE}")


def _refused(figures: Figures, motion: MotionPage | None) -> str:
    rows = [[labelled(f), number_text(f.value)] for f in figures.all if f.refused and f.value]
    rows += [[what, str(n)] for what, n in ([] if motion is None else excluded_rows(motion))]
    if rows:
        return _table([["data and reason", "count"], *rows])
    return "<p>Nothing.</p>" if any(f.refused for f in figures.all) else ""


def _notes(figures: Figures) -> list[str]:
    findings = list(notes(figures))
    for figure in figures.all:
        if figure.section in (Section.REMARKS, Section.DIRECTIONS):
            findings += sentences(figure)
        findings += [figure.remark] if figure.remark else []
    return findings


def _pictures(directory: Path, room: int) -> str:
    parts = []
    for path in sorted(directory.glob("*.png")):
        caption = escape(_CAPTIONS.get(path.stem, path.stem))
        size = 4 * path.stat().st_size // 3 + 200
        if size > room:
            parts.append(f"<p>{caption}: see {escape(path.name)}, in the same directory.</p>")
            continue
        room -= size
        data = base64.b64encode(path.read_bytes()).decode()
        parts.append(
            f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return "".join(parts)


def _how(run: Run | None) -> str:
    if run is None:
        return _table([[], ["called", "from Python"], ["version", versions()]])
    facts = [
        ["command", run.command],
        ["version", versions()],
        ["started", f"{run.started:%Y-%m-%d %H:%M:%S} UTC"],
        ["duration", f"{run.elapsed:.3g} s"],
    ]
    files = [[name, f"{size:,}", digest] for name, size, digest in input_files(run)]
    options = [
        [name, "" if value is None else str(value), "given" if name in run.given else "default"]
        for name, value in run.options.items()
    ]
    return (
        _table([[], *facts])
        + (_table([["input file", "bytes", "SHA-256"], *files]) if files else "")
        + _folded("Options", _table([["option", "value", ""], *options]))
    )


def _all(figures: Figures) -> str:
    rows = [[key, _plain(value)] for key, value in figures.items()]
    return _folded(f"{len(rows)} figures", _table([["key", "value"], *rows]))


def _plain(value: Value) -> str:
    if isinstance(value, list):
        return "; ".join(
            ", ".join(f"{k}: {v}" for k, v in one.items()) if isinstance(one, dict) else str(one)
            for one in value
        )
    return "" if value is None else str(value)


def _folded(heading: str, content: str) -> str:
    return f"<details><summary>{escape(heading)}</summary>{content}</details>"


def _list(items: Iterable[str]) -> str:
    listed = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f"<ul>{listed}</ul>" if listed else ""


def _table(rows: Sequence[Sequence[str]], marked: Iterable[int] = ()) -> str:
    """Return a table, its head first (empty for none), with some rows marked."""
    head, *body = rows
    marked = set(marked)
    parts = ["<tr>", *(f"<th>{escape(cell)}</th>" for cell in head), "</tr>"] if head else []
    for k, row in enumerate(body):
        parts.append('<tr class="far">' if k in marked else "<tr>")
        parts += [f"<td>{escape(cell)}</td>" for cell in row]
        parts.append("</tr>")
    return f'<div class="wide"><table>{"".join(parts)}</table></div>'
