"""A log: a directory of tables and a header."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.aiding_tables import read_aiding, write_aiding
from magfusion.files.atomic import whole_directory
from magfusion.files.audio import AudioEntry, lost_finding, read_audio
from magfusion.files.drive_columns import read_drive, read_rotation
from magfusion.files.fields import read_fields, write_fields
from magfusion.files.inertial_tables import (
    read_if_there,
    read_imu,
    read_waveform,
    write_imu,
    write_waveform,
)
from magfusion.files.log_header import HEADER, has_header, is_log, read_header
from magfusion.files.marks_table import read_marks, write_marks
from magfusion.files.named_samples import names_magnetometers, read_waveforms, write_waveforms
from magfusion.files.readings_table import (
    DEGC,
    DEPTH,
    read_depths,
    read_temperatures,
    write_readings,
)
from magfusion.files.table import Span, find_table
from magfusion.files.trajectory_table import read_trajectory, write_trajectory
from magfusion.files.yaml_files import write_yaml
from magfusion.model.aiding import QUANTITIES
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding

_NOTHING: tuple[Finding, ...] = ()
STREAMS = (
    *("imu", "magnetometer", "fields", "truth", "temperature", "marks", "reference", "depth"),
    *QUANTITIES,
)


def _tables(path: Path, audio: AudioEntry | None) -> dict[str, Path | None]:
    """Return the table of each stream; refuse a log without any of the field."""
    tables = {stem: find_table(path, stem) for stem in STREAMS}
    if tables["magnetometer"] is None and tables["fields"] is None and audio is None:
        raise InputError(
            f"{path}: holds no magnetometer.parquet and no fields.parquet (nor .csv); add one."
        )
    return tables


def read_log(
    path: Path, start: float | None = None, end: float | None = None, site: Site | None = None
) -> Log:
    """Read and check a log, or the part of it with start <= time < end.

    Raises InputError where a file is missing, cannot be read or holds what no instrument gives, or
    where the span holds no inertial samples or no field.

    Parameters
    ----------
    path : Path
        A directory with a table per stream, Parquet or CSV, and ``log.yaml``; see `read_header`.
    start, end : float, optional
        Seconds since the log's epoch. Rows outside are neither decoded nor checked.
    site : Site, optional
        Of an audio recording only the bands of its tones are read.

    Returns
    -------
    Log
        Streams without a row in the span are None; without a table of inertial samples there are
        none.
    """
    if not path.is_dir():
        result = "is a file" if path.exists() else "there is no such directory"
        raise InputError(f"{path}: {result}; give the path of a log's directory.")
    if not is_log(path):
        raise InputError(
            f"{path}: holds no {HEADER}, nor a table magnetometer or fields with the columns of a"
            " log; give the path of a log's directory."
        )
    header = read_header(path)
    tables = _tables(path, header.audio)
    span = Span(header.epoch_ns, start, end)
    imu, of_imu = ImuSamples.empty(), _NOTHING
    if tables["imu"] is not None:
        imu, of_imu = read_imu(tables["imu"], span)
    waveforms, waveform, of_waveform = dict[str, Waveform](), None, _NOTHING
    if header.audio is not None:
        waveform = read_audio(path, header.audio, span, site)
    elif names_magnetometers(tables["magnetometer"]):
        waveforms, of_waveform = read_waveforms(tables["magnetometer"], span)
    else:
        waveform, of_waveform = read_waveform(tables["magnetometer"], span)
    marks = read_marks(tables["magnetometer"], tables["marks"], span)
    if waveform is not None and marks is not None:
        waveform = replace(waveform, marks=marks)
    if marks is not None:
        waveforms = {name: replace(wave, marks=marks) for name, wave in waveforms.items()}
    of_truth: list[Finding] = []
    read_truth = partial(_read_truth, findings=of_truth)
    truth = read_if_there(tables["truth"], read_truth, span)
    log = Log(
        name=header.name,
        epoch_ns=header.epoch_ns,
        source=header.source,
        imu=imu,
        waveform=waveform,
        fields=read_if_there(tables["fields"], read_fields, span),
        truth=truth,
        findings=(*of_imu, *of_waveform, *of_truth, *lost_finding(header.audio)),
        temperatures=read_temperatures(tables["temperature"], header.epoch_ns),
        drive=read_drive(tables["magnetometer"], span),
        reference=read_waveform(tables["reference"], span)[0],
        rotation=read_rotation(tables["magnetometer"], span),
        depths=read_depths(tables["depth"], header.epoch_ns),
        waveforms=waveforms,
        aiding=read_aiding({kind: tables[kind] for kind in QUANTITIES}, span),
    )
    if log.waveform is None and log.fields is None and not log.waveforms:
        raise InputError(f"{path}: holds no field {span}; choose a span that the log covers.")
    # Arrow keeps what the columns were decoded into: as much as the log again.
    pa.default_memory_pool().release_unused()
    return log


def write_log(log: Log, path: Path, audio: AudioEntry | None = None) -> None:
    """Write a log as a directory of Parquet files; a log that is there is replaced.

    Files of other names that lie in the former log are kept. `audio`: of the recording that has its
    samples. Raises InputError where something that is no log is at ``path``, or nothing can be
    written there.
    """
    with whole_directory(path, replaces=has_header) as unfinished:
        if path.is_dir():
            _keep_others(path, unfinished)
        header = {"magfusion_log": 1, "name": log.name, "epoch_ns": log.epoch_ns}
        header |= {"source": log.source}
        header |= {} if audio is None else {"audio": audio.model_dump()}
        write_yaml(header, unfinished / HEADER)
        if log.inertial and len(log.imu):
            write_imu(log.imu, unfinished / "imu.parquet", log.epoch_ns)
        _write_samples(log, unfinished)
        if log.fields is not None:
            write_fields(log.fields, unfinished / "fields.parquet", log.epoch_ns)
        if log.truth is not None:
            write_trajectory(log.truth, unfinished / "truth.parquet", log.epoch_ns)
        if log.reference is not None:
            write_waveform(log.reference, unfinished / "reference.parquet", log.epoch_ns)
        if log.temperatures is not None and log.temperatures.readings:
            place = unfinished / "temperature.parquet"
            write_readings(log.temperatures.readings, place, log.epoch_ns, DEGC)
        if log.depths is not None and log.depths.readings:
            place = unfinished / "depth.parquet"
            write_readings(log.depths.readings, place, log.epoch_ns, DEPTH)
        write_aiding(log.aiding, unfinished, log.epoch_ns)


def _write_samples(log: Log, directory: Path) -> None:
    table, several = directory / "magnetometer.parquet", list(log.waveforms.values())
    if several:
        write_waveforms(log.waveforms, table, log.epoch_ns)
    wave = several[0] if several else log.waveform
    if log.waveform is not None:
        write_waveform(log.waveform, table, log.epoch_ns, log.drive, log.rotation)
    if wave is not None and wave.marks is not None:
        write_marks(wave.marks, directory / "marks.parquet", log.epoch_ns)


def _keep_others(former: Path, directory: Path) -> None:
    ours = {HEADER, *(f"{stem}{s}" for stem in STREAMS for s in (".parquet", ".csv"))}
    for entry in former.iterdir():
        if entry.is_dir():
            shutil.copytree(entry, directory / entry.name)
        elif entry.name not in ours:
            shutil.copy2(entry, directory / entry.name)


def _read_truth(path: Path, span: Span, findings: list[Finding]) -> Trajectory:
    return read_trajectory(path, span.epoch_ns, span.start, span.end, findings=findings)
