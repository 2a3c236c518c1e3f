"""Tables of readings, temperatures and depths: a row for each, whatever part it is of."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from magfusion.files.site_temperature import COLDEST, HOTTEST
from magfusion.files.table import TIME, Span, Table, TableLayout, read_table, write_table
from magfusion.model.rotor import Depths
from magfusion.model.temperature import Temperatures
from magfusion.units import Array, IntArray

PART, DEGC, DEPTH = "part", "temperature_degc", "depth_m"
DEEPEST = 2e4  # m


def read_temperatures(path: Path | None, epoch_ns: int) -> Temperatures | None:
    """Read all readings: also those before and after the part of a log that is used."""
    remedy = f"write degrees Celsius, from {COLDEST:g} to {HOTTEST:g}"
    readings = _read_readings(path, epoch_ns, DEGC, (COLDEST, HOTTEST), remedy, "reading")
    return None if readings is None else Temperatures(readings)


def read_depths(path: Path | None, epoch_ns: int) -> Depths | None:
    """Read how far along its hole a magnet is, and the magnetometer, as `read_temperatures`."""
    remedy = f"write measured depth in metres, from {-DEEPEST:g} to {DEEPEST:g}"
    readings = _read_readings(path, epoch_ns, DEPTH, (-DEEPEST, DEEPEST), remedy, "depth")
    return None if readings is None else Depths(readings)


def _read_readings(
    path: Path | None,
    epoch_ns: int,
    column: str,
    bounds: tuple[float, float],
    remedy: str,
    what: str,
) -> dict[str, Array] | None:
    """Return of each part times (s) and values, shape (2, n); ``what`` is one reading, in words."""
    if path is None:
        return None
    layout = TableLayout(numbers=(column,), texts=(PART,), repeats=True)
    table = read_table(path, layout, Span(epoch_ns))
    value = table.numbers((column,))[:, 0]
    table.refuse((value < bounds[0]) | (value > bounds[1]), column, value, remedy)
    each = rows_by_name(table, *table.texts(PART), what)
    return {name: np.stack([table.time[own], value[own]]) for name, own in each}


def rows_by_name(
    table: Table, names: Sequence[str], which: IntArray, what: str
) -> Iterator[tuple[str, IntArray]]:
    """Yield each name with its rows; refuse two of a name at one time.

    `which` (n,): index of each row's name. `what`: one row, in words.
    """
    for k, name in enumerate(names):
        own = np.flatnonzero(which == k)
        twice = np.zeros(len(table), dtype=bool)
        twice[own[1:]] = np.diff(table.time[own]) == 0.0
        again = f"the time of another {what} of {name}: remove one of the two"
        table.refuse(twice, TIME, table.time_ns, again)
        yield name, own


def write_readings(readings: Mapping[str, Array], path: Path, epoch_ns: int, column: str) -> None:
    """Write readings as Parquet, sorted by time."""
    parts = [(name, *course) for name, course in readings.items()]
    time = np.concatenate([when for _, when, _ in parts])
    order = np.argsort(time, kind="stable")
    names = np.concatenate([np.full(len(when), name) for name, when, _ in parts])
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[order])}
    values = np.concatenate([value for _, _, value in parts])
    write_table(columns | {PART: names[order].tolist(), column: values[order]}, path)
