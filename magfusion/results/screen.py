"""Screen output of a job's figures: errors first, then estimates, then warnings."""

from itertools import chain
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table

from magfusion.model.trust import Verdict
from magfusion.results.brief import is_brief, lines, next_step, remark_texts, table
from magfusion.results.figures import Figure, Figures, ParameterEstimate, Section
from magfusion.results.shown import (
    as_sure,
    axis_rows,
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

_STYLES = {
    Verdict.TRUSTWORTHY: "bold green",
    Verdict.DOUBTFUL: "bold yellow",
    Verdict.FAILED: "bold red",
}


def show(
    figures: Figures,
    output: Path | None,
    console: Console | None = None,
    level: Literal["quiet", "brief", "verbose"] = "brief",
) -> None:
    """Print the figures of a job for a reader; ``report.json`` has all of them.

    `output`: directory of the results. `console`: by default the standard output. `level`: the
    verdict in one line; what a decision requires; or all.
    """
    console = Console(highlight=False, emoji=False) if console is None else console
    name = " of ".join(str(figure.value) for figure in figures.of(Section.TITLE))
    if level == "quiet":
        verdict = f": {figures['verdict']}" if "verdict" in figures else ""
        console.print(f"{name}{verdict}", soft_wrap=True, markup=False)
        return
    console.print(name, style="bold", soft_wrap=True, markup=False)
    brief = level == "brief" and is_brief(figures)
    _show_verdict(figures, console, brief=brief)
    if brief:
        _show_brief(figures, console)
    else:
        _show_all(figures, console)
    if brief or figures.get("job") == "simulate":
        _show_next(figures, output, console)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True, markup=False)


def _show_next(figures: Figures, output: Path | None, console: Console) -> None:
    step = next_step(figures, output)
    if step:
        console.print(f"next: {step}", soft_wrap=True, markup=False)


def _show_brief(figures: Figures, console: Console) -> None:
    """Print what a decision requires."""
    columns = _with_head(table(figures))
    if columns.row_count:
        for column in columns.columns[1:]:
            column.justify = "right"
        columns.columns[0].no_wrap = True
        console.print(columns, markup=False)
    rows = lines(figures)
    width = max((len(label) for label, _ in rows), default=0)
    for label, text in rows:
        console.print(f" {label:<{width}}  {text}", soft_wrap=True, markup=False)
    for sentence in [] if figures.get("job") == "drift" else notes(figures):
        console.print(f"note: {sentence}", style="yellow", soft_wrap=True, markup=False)


def _show_all(figures: Figures, console: Console) -> None:
    """Print all figures but those only of the report."""
    parts = (
        _with_head(axis_rows(figures)),
        *(_with_head(log_rows(figure)) for figure in figures.of(Section.LOGS)),
        _table(figures.of(Section.ERRORS), ""),
        _summary(figures.of(Section.SUMMARY)),
        _calibration([f for f in figures.all if isinstance(f, ParameterEstimate)]),
        _table(figures.of(Section.TRANSFER), "other part of the log"),
    )
    for part in parts:
        if part.row_count:
            console.print(part, markup=False)
    for sentence in chain.from_iterable(map(sentences, figures.of(Section.DIRECTIONS))):
        console.print(sentence, soft_wrap=True, markup=False)
    for sentence in notes(figures):
        console.print(f"note: {sentence}", style="yellow", soft_wrap=True, markup=False)
    for figure in figures.all:
        converged = sentences(figure) if figure.section is Section.REMARKS else []
        for sentence in [*converged, *filter(None, [figure.remark])]:
            console.print(sentence, soft_wrap=True, markup=False)


def _show_verdict(figures: Figures, console: Console, *, brief: bool) -> None:
    """Print the verdict with its reasons, and unverified parameters."""
    if "verdict" not in figures:
        return
    verdict = figures["verdict"]
    console.print(
        f"{verdict}".upper(), style=_STYLES[look_of(str(verdict))], soft_wrap=True, markup=False
    )
    for one in findings(figures, "reasons"):
        console.print(f"  {one['text']}", soft_wrap=True, markup=False)
    for text in remark_texts(figures, routine=not brief):
        console.print(f"  remark: {text}", soft_wrap=True, markup=False)
    if brief:
        return
    names = [str(one["parameter"]) for one in findings(figures, "unverified")]
    if names:
        sentence = f"not observable in this log, fixed: {', '.join(names)}"
        console.print(f"  {sentence}", soft_wrap=True, markup=False)


def _table(figures: list[Figure], corner: str) -> Table:
    """Return a table of figures by their labels and columns."""
    return _with_head(column_rows(figures, corner))


def _with_head(table_rows: list[list[str]]) -> Table:
    """Return a table whose first row is its head."""
    head, *rows = table_rows or [[]]
    table = Table(*head, box=None)
    for row in rows:
        table.add_row(*row)
    return table


def _summary(figures: list[Figure]) -> Table:
    """Return one line per figure, and one per figure of several beacons."""
    table = Table(box=None, show_header=False)
    for row in summary_rows(figures):
        table.add_row(*row)
    return table


def _calibration(estimates: list[ParameterEstimate]) -> Table:
    """Return one row for each vector of estimated parameters."""
    table = Table("calibration", "change", "sigma (largest)", "prior", "determined", box=None)
    table.columns[0].no_wrap = True
    groups: dict[str, list[ParameterEstimate]] = {}
    for estimate in estimates:
        groups.setdefault(labelled(estimate), []).append(estimate)
    for label, group in groups.items():
        known = [estimate.determined for estimate in group]
        verdict = "yes" if all(known) else "partly" if any(known) else "no"
        change = " ".join(as_sure(e.change, e.sigma) for e in group)
        prior = " ".join(dict.fromkeys(number_text(e.prior_sigma, 2) for e in group))
        table.add_row(label, change, number_text(max(e.sigma for e in group), 2), prior, verdict)
    return table
