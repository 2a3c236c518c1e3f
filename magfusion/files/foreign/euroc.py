"""EuRoC MAV folders (ASL format), as visual-inertial benchmarks are published.

Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016. Columns are known by
their place: the headers' wording differs between the data sets that share the format, and some
have none.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.foreign.arrays import array_source
from magfusion.files.foreign.columns import (
    EULER,
    QUATERNION,
    STREAMS,
    TIME,
    VELOCITY,
    Term,
    terms_by_place,
)
from magfusion.files.foreign.convert import converted_rows
from magfusion.files.foreign.guess import named_columns
from magfusion.files.foreign.guess_by_values import likely_time_unit
from magfusion.files.foreign.plan import ImportPlan, Terms, first_values
from magfusion.files.foreign.source import Source
from magfusion.files.foreign.text import text_source
from magfusion.files.foreign.units import NO_STAMP, Dimension, resolution_ns
from magfusion.files.inertial_tables import read_imu, read_waveform
from magfusion.files.stray_stamps import all_strays, counted_back
from magfusion.files.table import TIME as TIME_NS
from magfusion.files.table import Span, find_table
from magfusion.files.trajectory_table import read_trajectory
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict

_REMARK = Verdict.TRUSTWORTHY
_BIASES = {
    **{f"gyro_bias_{axis}": Dimension.RATE for axis in "xyz"},
    **{f"accel_bias_{axis}": Dimension.FORCE for axis in "xyz"},
}


class _StreamTable(NamedTuple):
    path: Path
    content: pa.Table
    findings: tuple[Finding, ...]


def is_euroc(path: Path) -> bool:
    """Return whether a directory is a EuRoC folder."""
    streams = path / "mav0"
    if not streams.is_dir():
        return False
    return (streams / "imu0" / "data.csv").is_file() or bool(_magnetometers(path))


def read_euroc(path: Path, start: float | None = None, end: float | None = None) -> Log:
    """Read a EuRoC folder: inertial samples, and magnetometer and ground truth where they are.

    The first inertial stamp is the log's epoch, or the magnetometer's where there is no IMU.
    `path`: the directory that holds ``mav0``. `start`, `end`: seconds since the first inertial
    sample. Raises InputError where a file cannot be read or holds what no instrument gives.
    """
    tables = {stream: _read(stream, table) for stream, table in euroc_tables(path).items()}
    first = next(iter(tables.values()))
    span = Span(_first_sample(first), start, end)
    imu, field = tables.get("imu"), tables.get("magnetometer")
    samples, of_imu = (
        (ImuSamples.empty(), ()) if imu is None else read_imu(imu.path, span, imu.content)
    )
    waveform, of_waveform = (
        (None, ()) if field is None else read_waveform(field.path, span, field.content)
    )
    findings = [finding for table in tables.values() for finding in table.findings]
    return Log(
        name=path.resolve().name,
        epoch_ns=span.epoch_ns,
        source="EuRoC folder",
        imu=samples,
        waveform=waveform,
        truth=_truth(tables.get("truth"), span, findings),
        findings=(*findings, *of_imu, *of_waveform),
    )


def read_euroc_poses(path: Path, epoch_ns: int, findings: list[Finding] | None) -> Trajectory:
    """Read a table of poses whose head names them as EuRoC's ground truth does.

    `findings` as of `read_trajectory`. Raises InputError where the head names no whole poses.
    """
    source = array_source(path) if path.suffix == ".parquet" else text_source(path)
    named = named_columns(source.columns, "truth")
    whole = TIME, "position_x", "position_y", "position_z", *QUATERNION
    if any(len(named[name]) != 1 for name in whole):
        names = ", ".join(column.name for column in source.columns)
        raise InputError(
            f"{path}: has no column {TIME_NS}, and its head ({names}) is not that of EuRoC; convert"
            f" it by magfusion import --truth {path}."
        )
    table = _read("truth", path)
    if findings is not None:
        findings += table.findings
    return read_trajectory(path, epoch_ns, content=table.content, findings=findings)


def euroc_tables(path: Path) -> dict[str, Path]:
    """Return the tables of a EuRoC folder by stream, the one that gives the epoch first.

    Raises InputError where there are several magnetometers, whatever their folders are called.
    """
    inertial, fields = path / "mav0" / "imu0" / "data.csv", _magnetometers(path)
    if len(fields) > 1:
        names = ", ".join(table.parent.name for table in fields)
        raise InputError(f"{path / 'mav0'}: holds several magnetometers: {names}; keep one.")
    truth = find_table(path / "mav0" / "state_groundtruth_estimate0", "data")
    return (
        ({"imu": inertial} if inertial.is_file() else {})
        | ({"magnetometer": fields[0]} if fields else {})
        | ({"truth": truth} if truth is not None else {})
    )


def euroc_terms(stream: str, source: Source) -> Terms:
    """Return the columns of a stream by their header, or by their places where it names them not.

    Units are those of the header, or else of EuRoC. Stamps are nanoseconds, but where only another
    unit makes a plausible rate. Raises InputError where columns are missing.
    """
    columns = {name: unit for name, unit in STREAMS[stream].items() if name not in EULER}
    columns |= _BIASES if stream == "truth" else {}
    terms = terms_by_place(columns, source.columns, "ns")
    if terms.keys() <= {TIME} or (stream == "imu" and len(terms) < len(columns)):
        missing = ", ".join(name for name in columns if name not in {*terms, *VELOCITY, *_BIASES})
        names = ", ".join(column.name for column in source.columns)
        raise InputError(
            f"{source.place}: columns {missing} are missing (found {names}); add what is missing."
        )
    named = {name: own for name, own in named_columns(source.columns, stream).items() if own}
    needed = [name for name in columns if name not in {*VELOCITY, *_BIASES}]
    places = {name: own[0].place for name, own in named.items() if len(own) == 1}
    if set(needed) <= set(places) and any(places[n] != terms[n][0].place for n in needed):
        terms = {
            name: (Term(places[name], named[name][0].unit or terms[name][0].unit),)
            for name in columns
            if name in places
        }
    for group in (VELOCITY, tuple(_BIASES)):
        if not set(group) <= set(terms):
            terms = {name: own for name, own in terms.items() if name not in group}
    if TIME in terms:
        (declared,) = terms[TIME]
        unit = likely_time_unit(first_values(source, declared.place, True), declared.unit.name)
        terms[TIME] = (Term(declared.place, unit),)
    return terms


def _magnetometers(path: Path) -> list[Path]:
    return [
        table
        for folder in sorted((path / "mav0").iterdir())
        if re.match(r"mag|compass|field|fluxgate", folder.name, re.I)
        and (table := find_table(folder, "data")) is not None
    ]


def _read(stream: str, path: Path) -> _StreamTable:
    """Return a table in the units of a log, with the remarks on its rows and stamps."""
    source = array_source(path) if path.suffix == ".parquet" else text_source(path)
    plan = ImportPlan(stream, source, euroc_terms(stream, source))
    names = [name for name in plan.terms if name != TIME]
    parts, left_out = [], 0
    for part, stamps, values in converted_rows(plan, names):
        time_ns = pa.array(stamps, mask=stamps == NO_STAMP)
        parts.append(pa.table({TIME_NS: time_ns, **dict(zip(names, values.T, strict=True))}))
        left_out += sum(part.left_out.values())
    findings = [_cut_rows(stream, left_out)] if left_out else []
    (term,) = plan.terms[TIME]
    return _StreamTable(
        path, pa.concat_tables(parts), (*findings, *_resolution(stream, source, term))
    )


def _cut_rows(stream: str, count: int) -> Finding:
    rows = "1 row does" if count == 1 else f"{count} rows do"
    text = f"{stream}: {rows} not have as many cells as the others, and {{}} left out."
    return Finding("missing_samples", text.format("is" if count == 1 else "are"), _REMARK)


def _resolution(stream: str, source: Source, term: Term) -> tuple[Finding, ...]:
    """Return the remark on stamps that are no integer nanoseconds."""
    size = resolution_ns(first_values(source, term.place, True), term.unit)
    if size <= 1.0:
        return ()
    shown = f"{size * 1e-3:.3g} us" if size < 1e6 else f"{size * 1e-6:.3g} ms"
    text = f"{stream}: stamps are read as {term.unit}; their resolution is {shown}."
    return (Finding("stamp_resolution", text, _REMARK),)


def _first_sample(table: _StreamTable) -> int:
    """Return the time of a table's first sample (ns), also where its stamp is stray."""
    stamps = table.content[TIME_NS].drop_null().to_numpy()
    if not len(stamps):
        return 0
    stray = all_strays(stamps)
    return counted_back(stamps[~stray], int(np.argmin(stray)))


def _truth(table: _StreamTable | None, span: Span, findings: list[Finding]) -> Trajectory | None:
    if table is None:
        return None
    truth = read_trajectory(
        table.path, span.epoch_ns, span.start, span.end, table.content, findings
    )
    return truth if len(truth) else None
