"""Tables of a log's aiding sensors: one of each quantity, with a row for each sample."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.files.readings_table import rows_by_name
from magfusion.files.table import TIME, Span, Table, TableLayout, read_table, write_table
from magfusion.files.trajectory_table import QUATERNION, unit_rotation
from magfusion.model.aiding import MAX_INTERVAL, AidingSamples, Quantity
from magfusion.units import DEGREE, Array

SENSOR, MARK = "sensor", "mark"
TRANSLATION = ("translation_x", "translation_y", "translation_z")
COLUMNS: dict[Quantity, tuple[str, ...]] = {
    "velocity": ("velocity_x", "velocity_y", "velocity_z"),
    "range": ("range",),
    "position": ("position_x", "position_y", "position_z"),
    "mark": (),
    "height": ("height",),
    "pressure": ("pressure",),
    "heading": ("heading_deg",),
    "relative_pose": ("interval_s", *TRANSLATION, *QUATERNION),
}
UNIT = {"heading": DEGREE}


def layout_of(quantity: Quantity) -> TableLayout:
    """Return the columns of a quantity's table; of a velocity, an axis may be missing."""
    columns = COLUMNS[quantity]
    return TableLayout(
        numbers=() if quantity == "velocity" else columns,
        texts=(MARK,) if quantity == "mark" else (),
        some=columns if quantity == "velocity" else (),
        repeats=True,
        optional_texts=(SENSOR,),
    )


def read_aiding(tables: Mapping[Quantity, Path | None], span: Span) -> dict[str, AidingSamples]:
    """Read the samples of every aiding sensor; one without a name has that of its quantity."""
    out: dict[str, AidingSamples] = {}
    for quantity, path in tables.items():
        if path is not None:
            out |= _read_quantity(quantity, read_table(path, layout_of(quantity), span))
    return out


def _read_quantity(quantity: Quantity, table: Table) -> dict[str, AidingSamples]:
    names: list[str] = [quantity]
    which = np.zeros(len(table), dtype=np.int64)
    if table.has((SENSOR,)):
        names, which = table.texts(SENSOR)
    marks, of_row = table.texts(MARK) if quantity == "mark" else ([], which)
    value, out = _values(quantity, table), dict[str, AidingSamples]()
    for name, own in rows_by_name(table, names, which, "sample"):
        exists = np.isfinite(value[own])
        is_measured = exists.any(axis=1) if quantity == "velocity" else exists.all(axis=1)
        there = own[is_measured]
        of_sample = tuple(marks[of_row[i]] for i in there) if quantity == "mark" else ()
        out[name] = AidingSamples(quantity, table.time[there], value[there], of_sample)
    return out


def _values(quantity: Quantity, table: Table) -> Array:
    value = np.full((len(table), len(COLUMNS[quantity])), np.nan)
    for i, name in enumerate(COLUMNS[quantity]):
        if table.has((name,)):
            # A time without a measurement, as of a range without an echo, has no number.
            value[:, i] = table.numbers((name,), nan=quantity != "relative_pose")[:, 0]
    if quantity == "relative_pose":
        remedy = f"more than 0 s; of more than {MAX_INTERVAL:g} s they are not used"
        table.refuse(value[:, 0] <= 0.0, "interval_s", value[:, 0], remedy)
        turn = unit_rotation(table).as_rotvec()
        return np.hstack([value[:, : -len(QUATERNION)], turn])
    if quantity == "range":
        table.refuse(
            value[:, 0] < 0.0, "range", value[:, 0], "write 0 m or more, or nan for no echo"
        )
    return value * UNIT.get(quantity, 1.0)


def write_aiding(aiding: Mapping[str, AidingSamples], directory: Path, epoch_ns: int) -> None:
    """Write samples as Parquet, one file of each quantity, sorted by time."""
    for quantity in dict.fromkeys(samples.quantity for samples in aiding.values()):
        own = {name: samples for name, samples in aiding.items() if samples.quantity == quantity}
        time = np.concatenate([samples.time for samples in own.values()])
        value = np.concatenate([samples.value for samples in own.values()]) / UNIT.get(
            quantity, 1.0
        )
        if quantity == "relative_pose":
            turn = Rotation.from_rotvec(value[:, 4:]).as_quat(scalar_first=True)
            value = np.hstack([value[:, :4], turn])
        order = np.argsort(time, kind="stable")
        names = np.repeat(list(own), [len(samples) for samples in own.values()])
        columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[order])}
        columns[SENSOR] = names[order].tolist()
        columns |= {name: value[order, i] for i, name in enumerate(COLUMNS[quantity])}
        if quantity == "mark":
            marks = np.array([mark for samples in own.values() for mark in samples.marks])
            columns[MARK] = marks[order].tolist()
        write_table(columns, directory / f"{quantity}.parquet")
