"""Text and tables of figures, for the screen and for a page."""

import math

from magfusion.results.axes import AXES, ROWS
from magfusion.results.figures import ErrorColumn, Figure, Figures, Section, Value, number

# Codes of reasons with the same content as the note of a figure.
_REPORTED_BY = {"residual_rms_{beacon}": {"field_residuals"}, "ambiguous": {"ambiguous"}}


def notes(figures: Figures) -> list[str]:
    """Return the warnings of figures, apart from those in the verdict."""
    out = []
    codes = {str(one["code"]) for one in findings(figures, "reasons")}
    for figure in figures.all:
        out += sentences(figure) if figure.section is Section.NOTES else []
        out += (
            [figure.note]
            if figure.note and codes.isdisjoint(_REPORTED_BY.get(figure.name, ()))
            else []
        )
    messages = [one["text"] for key in ("reasons", "remarks") for one in findings(figures, key)]
    return [note for note in out if not any(str(text) in note for text in messages)]


def findings(figures: Figures, key: str) -> list[dict[str, str | float]]:
    """Return the entries of a report under a key: reasons, remarks, or unverified parameters."""
    result = figures.get(key, [])
    assert isinstance(result, list)
    return [one for one in result if isinstance(one, dict)]


def sentences(figure: Figure) -> list[str]:
    """Return the sentences of a figure: its value, or made from its label and value."""
    if isinstance(figure.value, list):
        lead = f"{figure.label}: " if figure.label else ""
        return [f"{lead}{sentence}" for sentence in figure.value]
    return [f"{number_text(figure.value)} {figure.title}"]


def labelled(figure: Figure) -> str:
    """Return the title of a figure, with its unit."""
    return f"{figure.title} ({figure.unit})" if figure.unit else figure.title


def column_rows(figures: list[Figure], corner: str) -> list[list[str]]:
    """Return a table of figures by their labels and columns, its head first."""
    used = {figure.column for figure in figures}
    columns = [column for column in ErrorColumn if column in used]
    rows: dict[str, dict[str, str]] = {}
    for figure in figures:
        rows.setdefault(labelled(figure), {})[figure.column] = number_text(figure.value)
    cells = [[label, *(row.get(c, "") for c in columns)] for label, row in rows.items()]
    return [[corner, *columns], *cells]


def axis_rows(figures: Figures) -> list[list[str]]:
    """Return the table of errors and sigmas by axis, its head first; empty without them."""
    own = figures.of(Section.AXES)
    if not own:
        return []
    lengths = [number(figure.value) for figure in own if figure.unit == "m"]
    scale, unit = (1e3, "mm") if max(lengths, default=0.0) < 1.0 else (1.0, "m")
    known = {figure.name: number(figure.value) for figure in own}
    labels = {row: f.label for f in own for row in ROWS if f.name.startswith(f"{row}_x_")}
    columns = [["rms", *labels.values()]]
    for of, factor, shown in (("m", scale, unit), ("deg", 1.0, "°")):
        axes = [axis for axis, own_unit in AXES if own_unit == of]
        values = {a: [known.get(f"{row}_{a}_{of}") for row in labels] for a in axes}
        sizes = [factor * abs(v) for column in values.values() for v in column if v]
        decimals = _common_decimals(sizes)
        for axis, column in values.items():
            cells = [
                "" if v is None else f"{factor * v:.{decimals}f}" if v else "0" for v in column
            ]
            columns.append([f"{axis.replace('_', ' ')} {shown}", *cells])
    return [list(row) for row in zip(*columns, strict=True)]


def _common_decimals(sizes: list[float]) -> int:
    """Return two digits of the smallest, as far as the largest has five at most."""
    if not sizes:
        return 0
    fine, coarse = (math.floor(math.log10(end(sizes))) for end in (min, max))
    return max(0, min(1 - fine, 4 - coarse))


# Columns of the table of logs on the screen, and their titles.
_OF_LOGS = {
    "log": "log",
    "verdict": "verdict",
    "code": "first reason",
    "epochs": "epochs",
    "position_sigma_m": "sigma (m)",
    "attitude_sigma_deg": "(deg)",
    "aligned_ate_m": "aligned (m)",
    "alone_aligned_ate_m": "alone",
    "nees_mean": "NEES",
}


def log_rows(figure: Figure) -> list[list[str]]:
    """Return the table of several logs, its head first."""
    value = figure.value if isinstance(figure.value, list) else []
    rows = [row for row in value if isinstance(row, dict)]
    known = [key for key in _OF_LOGS if any(row.get(key) not in (None, "") for row in rows)]
    cells = [[number_text(row.get(key)) for key in known] for row in rows]
    return [[_OF_LOGS[key] for key in known], *cells]


def summary_rows(figures: list[Figure]) -> list[tuple[str, str]]:
    """Return one line per figure, and one per figure of several beacons."""
    rows: list[tuple[str, str]] = []
    lists: dict[str, list[str]] = {}
    for figure in figures:
        if figure.beacon is None:
            known = f"{number_text(figure.value)} {figure.unit}".rstrip()
            rows.append((figure.title, "none" if figure.value is None else known))
        else:
            value = f"{figure.beacon} {number_text(figure.value)}"
            lists.setdefault(labelled(figure), []).append(value)
    return rows + [(label, ", ".join(values)) for label, values in lists.items()]


def number_text(value: Value, digits: int = 3) -> str:
    """Return a value as text."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(str(one) for one in value)
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def as_sure(value: float, sigma: float) -> str:
    """Return a number to the second digit of its sigma."""
    if not sigma > 0.0:
        return number_text(value)
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:+.{decimals}f}"
