"""The table of temperatures of a log: a row for each reading, whatever part it is of."""

from pathlib import Path

import numpy as np

from magfusion.files.site_warming import COLDEST, HOTTEST
from magfusion.files.table import TIME, Layout, Span, read_table, write_table
from magfusion.model.temperature import Temperatures

PART, DEGC = "part", "temperature_degc"
_LAYOUT = Layout(numbers=(DEGC,), texts=(PART,), repeats=True)


def read_temperatures(path: Path | None, epoch_ns: int) -> Temperatures | None:
    """Read all readings: also those before and after the part of a log that is used.

    Raises
    ------
    InputError
        As `read_table`; or where a temperature is none in degrees Celsius, or a part has two at
        one time.
    """
    if path is None:
        return None
    table = read_table(path, _LAYOUT, Span(epoch_ns))
    degc = table.numbers((DEGC,))[:, 0]
    remedy = f"write degrees Celsius, from {COLDEST:g} to {HOTTEST:g}"
    table.refuse((degc < COLDEST) | (degc > HOTTEST), DEGC, degc, remedy)
    names, which = table.texts(PART)
    readings = {}
    for k, name in enumerate(names):
        own = np.flatnonzero(which == k)
        twice = np.zeros(len(table), dtype=bool)
        twice[own[1:]] = np.diff(table.time[own]) == 0.0
        remedy = f"the time of another reading of {name}: remove one of the two"
        table.refuse(twice, TIME, table.time_ns, remedy)
        readings[name] = np.stack([table.time[own], degc[own]])
    return Temperatures(readings)


def write_temperatures(temperatures: Temperatures, path: Path, epoch_ns: int) -> None:
    """Write readings as Parquet, sorted by time."""
    parts = [(name, *course) for name, course in temperatures.readings.items()]
    time = np.concatenate([when for _, when, _ in parts])
    order = np.argsort(time, kind="stable")
    names = np.concatenate([np.full(len(when), name) for name, when, _ in parts])
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[order])}
    degc = np.concatenate([value for _, _, value in parts])
    write_table(columns | {PART: names[order].tolist(), DEGC: degc[order]}, path)
