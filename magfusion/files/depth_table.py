"""The table of depths of a log: how far along its hole a magnet is, and the magnetometer."""

from pathlib import Path

import numpy as np

from magfusion.files.table import TIME, Layout, Span, read_table, write_table
from magfusion.model.rotor import Depths

PART, DEPTH = "part", "depth_m"
DEEPEST = 2e4  # m
_LAYOUT = Layout(numbers=(DEPTH,), texts=(PART,), repeats=True)


def read_depths(path: Path | None, epoch_ns: int) -> Depths | None:
    """Read all depths: also those before and after the part of a log that is used.

    Raises
    ------
    InputError
        As `read_table`; or where one is no depth, or a part has two at one time.
    """
    if path is None:
        return None
    table = read_table(path, _LAYOUT, Span(epoch_ns))
    depth = table.numbers((DEPTH,))[:, 0]
    remedy = f"write measured depth in metres, from {-DEEPEST:g} to {DEEPEST:g}"
    table.refuse(np.abs(depth) > DEEPEST, DEPTH, depth, remedy)
    names, which = table.texts(PART)
    readings = {}
    for k, name in enumerate(names):
        own = np.flatnonzero(which == k)
        twice = np.zeros(len(table), dtype=bool)
        twice[own[1:]] = np.diff(table.time[own]) == 0.0
        remedy = f"the time of another depth of {name}: remove one of the two"
        table.refuse(twice, TIME, table.time_ns, remedy)
        readings[name] = np.stack([table.time[own], depth[own]])
    return Depths(readings)


def write_depths(depths: Depths, path: Path, epoch_ns: int) -> None:
    """Write depths as Parquet, sorted by time."""
    parts = [(name, *course) for name, course in depths.readings.items()]
    time = np.concatenate([when for _, when, _ in parts])
    order = np.argsort(time, kind="stable")
    names = np.concatenate([np.full(len(when), name) for name, when, _ in parts])
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[order])}
    depth = np.concatenate([value for _, _, value in parts])
    write_table(columns | {PART: names[order].tolist(), DEPTH: depth[order]}, path)
