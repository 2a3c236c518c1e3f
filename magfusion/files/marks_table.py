"""When which coil was driven: a slot with each sample, or a table of bursts.

With samples, -1 means that no coil is driven, and a missing slot that none is known: the current
settles.  In a table of bursts times that no row covers are unknown.
"""

from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.drive_columns import column_names
from magfusion.files.table import (
    MAX_TIME_NS,
    TIME,
    Span,
    Table,
    TableLayout,
    read_table,
    write_table,
)
from magfusion.model.marks import SILENT, UNKNOWN_SLOT, Marks, marks_of_column
from magfusion.units import Array, BoolArray, IntArray

SLOT, END = "slot", "end_ns"
MAX_SLOT = 10_000
_SLOT_LAYOUT = TableLayout(numbers=(SLOT,), repeats=True, strays=True)
_BURSTS = TableLayout(numbers=(), integers=(TIME, END, SLOT), repeats=True)
_REMEDY = f"write the number of a coil's slot, or {SILENT} where none is driven"


def read_marks(magnetometer: Path | None, bursts: Path | None, span: Span) -> Marks | None:
    """Read the bursts of a log, in either form; None where there are none."""
    others = magnetometer is not None and SLOT in column_names(magnetometer)
    if bursts is not None and others:
        raise InputError(
            f"{bursts}: marks the bursts that the column {SLOT} of {magnetometer} marks, too; keep"
            " one of them."
        )
    if bursts is not None:
        return _read_bursts(bursts, span)
    return _read_column(magnetometer, span) if magnetometer is not None and others else None


def slots_of(values: Array) -> IntArray:
    """Return the slots of numbers with samples, NaN where unknown."""
    return np.where(np.isnan(values), UNKNOWN_SLOT, values).astype(np.int64)


def is_slot(values: Array) -> BoolArray:
    """Return which numbers are slots, or missing."""
    whole = (np.round(values) == values) & (values >= SILENT) & (values <= MAX_SLOT)
    return np.asarray(whole | np.isnan(values))


def _read_column(path: Path, span: Span) -> Marks:
    table = read_table(path, _SLOT_LAYOUT, span)
    values = table.numbers((SLOT,), nan=True)[:, 0]
    table.refuse(~is_slot(values), SLOT, values, _REMEDY)
    once = np.diff(table.time, prepend=-np.inf) > 0.0
    return marks_of_column(table.time[once], slots_of(values[once]))


def _read_bursts(path: Path, span: Span) -> Marks:
    table = read_table(path, _BURSTS, Span(span.epoch_ns))
    end_ns, slot = table.integers(END), table.integers(SLOT)
    table.refuse(np.abs(end_ns) > MAX_TIME_NS, END, end_ns, "write nanoseconds")
    table.refuse(end_ns <= table.time_ns, END, end_ns, f"write a time after the row's {TIME}")
    table.refuse((slot < SILENT) | (slot > MAX_SLOT), SLOT, slot, _REMEDY)
    _refuse_overlap(table, end_ns)
    begin, beyond = span.bounds_ns
    inside = (table.time_ns >= begin) & (end_ns <= beyond)
    return Marks(table.time, span.seconds(end_ns), slot).rows(inside)


def _refuse_overlap(table: Table, end_ns: IntArray) -> None:
    before = np.append(-MAX_TIME_NS, end_ns)[:-1]
    remedy = "before the burst of the row above has ended: end that earlier, or begin this later"
    table.refuse(table.time_ns < before, TIME, table.time_ns, remedy)


def write_marks(marks: Marks, path: Path, epoch_ns: int) -> None:
    """Write bursts as Parquet."""
    span = Span(epoch_ns)
    columns: dict[str, object] = {TIME: span.stamps(marks.begin), END: span.stamps(marks.end)}
    write_table(columns | {SLOT: marks.slot}, path)
