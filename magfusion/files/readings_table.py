"""A table of readings: a row for each, whatever part of the installation it is of."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magfusion.files.table import TIME, Span, TableLayout, read_table, write_table
from magfusion.units import Array

PART = "part"


def read_readings(
    path: Path, epoch_ns: int, column: str, bounds: tuple[float, float], remedy: str, what: str
) -> dict[str, Array]:
    """Read all readings: also those before and after the part of a log that is used.

    Parameters
    ----------
    column : str
        What was read.
    bounds : tuple of float
        Least and largest value; what is beyond is refused with the remedy.
    what : str
        One reading, in words.

    Returns
    -------
    dict
        Of each part times (s) and values, shape (2, n).

    Raises
    ------
    InputError
        As `read_table`; or where a value is out of bounds, or a part has two at one time.
    """
    layout = TableLayout(numbers=(column,), texts=(PART,), repeats=True)
    table = read_table(path, layout, Span(epoch_ns))
    value = table.numbers((column,))[:, 0]
    table.refuse((value < bounds[0]) | (value > bounds[1]), column, value, remedy)
    names, which = table.texts(PART)
    readings = {}
    for k, name in enumerate(names):
        own = np.flatnonzero(which == k)
        twice = np.zeros(len(table), dtype=bool)
        twice[own[1:]] = np.diff(table.time[own]) == 0.0
        again = f"the time of another {what} of {name}: remove one of the two"
        table.refuse(twice, TIME, table.time_ns, again)
        readings[name] = np.stack([table.time[own], value[own]])
    return readings


def write_readings(readings: Mapping[str, Array], path: Path, epoch_ns: int, column: str) -> None:
    """Write readings as Parquet, sorted by time."""
    parts = [(name, *course) for name, course in readings.items()]
    time = np.concatenate([when for _, when, _ in parts])
    order = np.argsort(time, kind="stable")
    names = np.concatenate([np.full(len(when), name) for name, when, _ in parts])
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[order])}
    values = np.concatenate([value for _, _, value in parts])
    write_table(columns | {PART: names[order].tolist(), column: values[order]}, path)
