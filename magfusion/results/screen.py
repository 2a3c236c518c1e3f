"""What a user sees of a job's figures: the errors first, then what was found, then warnings."""

import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from magfusion.results.figures import Column, Estimate, Figure, Figures, Section, Value

# Codes of reasons that say what the note of a figure would say again.
_SAID = {"residual_rms_{beacon}": {"field_residuals"}, "ambiguous": {"ambiguous"}}
_STYLES = {"trustworthy": "bold green", "doubtful": "bold yellow", "failed": "bold red"}


def show(figures: Figures, output: Path | None, console: Console | None = None) -> None:
    """Print the figures of a job for a reader; ``report.json`` has them all.

    Parameters
    ----------
    output : Path, optional
        Where the results are.
    console : Console, optional
        The standard output where there is none.
    """
    console = Console(highlight=False, emoji=False) if console is None else console
    name = " of ".join(str(figure.value) for figure in figures.of(Section.TITLE))
    console.print(name, style="bold", soft_wrap=True, markup=False)
    _show_verdict(figures, console)
    tables = (
        _table(figures.of(Section.ERRORS), ""),
        _summary(figures.of(Section.SUMMARY)),
        _calibration([f for f in figures.all if isinstance(f, Estimate)]),
        _table(figures.of(Section.TRANSFER), "other part of the log"),
    )
    for table in tables:
        if table.row_count:
            console.print(table, markup=False)
    for figure in figures.of(Section.DIRECTIONS):
        for sentence in _sentences(figure):
            console.print(sentence, soft_wrap=True, markup=False)
    for sentence in notes(figures):
        console.print(f"note: {sentence}", style="yellow", soft_wrap=True, markup=False)
    for figure in figures.all:
        settled = _sentences(figure) if figure.section is Section.REMARKS else []
        for sentence in [*settled, *filter(None, [figure.remark])]:
            console.print(sentence, soft_wrap=True, markup=False)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True, markup=False)


def _show_verdict(figures: Figures, console: Console) -> None:
    """Print the verdict with its reasons, and what nothing has checked."""
    if "verdict" not in figures:
        return
    verdict = figures["verdict"]
    console.print(f"{verdict}".upper(), style=_STYLES[str(verdict)], soft_wrap=True, markup=False)
    for key, lead in (("reasons", ""), ("remarks", "noticed: ")):
        for one in _findings(figures, key):
            console.print(f"  {lead}{one['text']}", soft_wrap=True, markup=False)
    names = [str(one["parameter"]) for one in _findings(figures, "unverified")]
    if names:
        sentence = f"held, and not checked by these data: {', '.join(names)}"
        console.print(f"  {sentence}", soft_wrap=True, markup=False)


def notes(figures: Figures) -> list[str]:
    """Return in words what a reader of the figures must not overlook, beside the verdict."""
    out = []
    codes = {str(one["code"]) for one in _findings(figures, "reasons")}
    for figure in figures.all:
        out += _sentences(figure) if figure.section is Section.NOTES else []
        out += [figure.note] if figure.note and codes.isdisjoint(_SAID.get(figure.name, ())) else []
    said = [one["text"] for key in ("reasons", "remarks") for one in _findings(figures, key)]
    return [note for note in out if not any(str(text) in note for text in said)]


def _findings(figures: Figures, key: str) -> list[dict[str, str | float]]:
    found = figures.get(key, [])
    assert isinstance(found, list)
    return [one for one in found if isinstance(one, dict)]


def _sentences(figure: Figure) -> list[str]:
    """Return the sentences that are a figure's value, or that its label and value make."""
    if isinstance(figure.value, list):
        lead = f"{figure.label}: " if figure.label else ""
        return [f"{lead}{sentence}" for sentence in figure.value]
    return [f"{_number(figure.value)} {figure.title}"]


def _labelled(figure: Figure) -> str:
    return f"{figure.title} ({figure.unit})" if figure.unit else figure.title


def _table(figures: list[Figure], corner: str) -> Table:
    """Return a table of figures by their labels and columns."""
    used = {figure.column for figure in figures}
    columns = [column for column in Column if column in used]
    rows: dict[str, dict[str, str]] = {}
    for figure in figures:
        rows.setdefault(_labelled(figure), {})[figure.column] = _number(figure.value)
    table = Table(corner, *columns, box=None)
    for label, row in rows.items():
        table.add_row(label, *(row.get(column, "") for column in columns))
    return table


def _summary(figures: list[Figure]) -> Table:
    """Return one line for each figure, and one for what several beacons have each."""
    table = Table(box=None, show_header=False)
    lists: dict[str, list[str]] = {}
    for figure in figures:
        if figure.beacon is None:
            known = f"{_number(figure.value)} {figure.unit}".rstrip()
            table.add_row(figure.title, "none" if figure.value is None else known)
        else:
            value = f"{figure.beacon} {_number(figure.value)}"
            lists.setdefault(_labelled(figure), []).append(value)
    for label, values in lists.items():
        table.add_row(label, ", ".join(values))
    return table


def _calibration(estimates: list[Estimate]) -> Table:
    """Return one row for each vector of estimated parameters."""
    table = Table("calibration", "change", "sigma (largest)", "prior", "determined", box=None)
    table.columns[0].no_wrap = True
    groups: dict[str, list[Estimate]] = {}
    for estimate in estimates:
        groups.setdefault(_labelled(estimate), []).append(estimate)
    for label, group in groups.items():
        known = [estimate.determined for estimate in group]
        verdict = "yes" if all(known) else "partly" if any(known) else "no"
        change = " ".join(_as_sure(e.change, e.sigma) for e in group)
        prior = " ".join(dict.fromkeys(_number(e.prior_sigma, 2) for e in group))
        table.add_row(label, change, _number(max(e.sigma for e in group), 2), prior, verdict)
    return table


def _number(value: Value, digits: int = 3) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(str(one) for one in value)
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def _as_sure(value: float, sigma: float) -> str:
    """Write a number to the second digit of its sigma."""
    if not sigma > 0.0:
        return _number(value)
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:+.{decimals}f}"
