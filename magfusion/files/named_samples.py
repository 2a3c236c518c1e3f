"""The samples of several magnetometers in one table, with a column of their names."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.drive_columns import column_names, drive_columns, rotor_columns
from magfusion.files.inertial_tables import FIELD, measured_rows
from magfusion.files.marks_table import SLOT
from magfusion.files.plausible import check_field
from magfusion.files.stray_stamps import stray_finding
from magfusion.files.table import TIME, Span, TableLayout, read_table, write_table
from magfusion.model.samples import Waveform
from magfusion.model.trust import Finding
from magfusion.units import IntArray

MAGNETOMETER = "magnetometer"
_LAYOUT = TableLayout(numbers=FIELD, texts=(MAGNETOMETER,), repeats=True, strays=True)


def names_magnetometers(path: Path | None) -> bool:
    """Return whether a table of samples has the magnetometer of each."""
    return path is not None and MAGNETOMETER in column_names(path)


def read_waveforms(
    path: Path | None, span: Span
) -> tuple[dict[str, Waveform], tuple[Finding, ...]]:
    """Read and check the samples of several magnetometers, by name, each by its own stamps.

    Each as from `magfusion.files.inertial_tables.read_waveform`; those without a row within the
    span are omitted.
    """
    assert path is not None
    others = [n for n in column_names(path) if n == SLOT]
    others = [*others, *drive_columns(path), *rotor_columns(path)]
    if others:
        raise InputError(
            f"{path}: {', '.join(others)}: with the samples of several magnetometers nothing else"
            " is recorded yet; give bursts in marks.parquet, and leave the rest out."
        )
    table = read_table(path, _LAYOUT, span)
    names, of = table.texts(MAGNETOMETER)
    result: dict[str, Waveform] = {}
    findings = [*stray_finding(MAGNETOMETER, [stamp for _, stamp in table.stray])]
    for k, name in enumerate(names):
        own = np.flatnonzero(of == k)
        if not len(own):
            continue
        place = Path(f"{path}, {MAGNETOMETER} {name}")
        mine = replace(
            table,
            path=place,
            data=table.data.take(pa.array(own)),
            time_ns=table.time_ns[own],
            time=table.time[own],
            first_row=0,
            stray=(),
        )
        time, values, lost_epochs = measured_rows(mine, FIELD, f"{MAGNETOMETER} {name}")
        check_field(np.linalg.norm(values, axis=1), str(place))
        result[name] = Waveform(time, values)
        findings += lost_epochs
    return result, tuple(findings)


def write_waveforms(waveforms: Mapping[str, Waveform], path: Path, epoch_ns: int) -> None:
    """Write the samples of several magnetometers as Parquet, sorted by their stamps."""
    stamps = np.concatenate([Span(epoch_ns).stamps(wave.time) for wave in waveforms.values()])
    order: IntArray = np.argsort(stamps, kind="stable")
    values = np.concatenate([wave.measured_sensor for wave in waveforms.values()])[order]
    of = np.repeat(np.arange(len(waveforms)), [len(wave) for wave in waveforms.values()])[order]
    columns: dict[str, object] = {TIME: stamps[order]}
    columns[MAGNETOMETER] = pa.array(list(waveforms), pa.string()).take(pa.array(of))
    columns |= dict(zip(FIELD, values.T, strict=True))
    write_table(columns, path)
