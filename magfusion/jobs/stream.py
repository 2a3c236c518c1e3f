"""Navigation in a pipe: records in, a state out at every epoch; and a log as such records."""

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.fusion.online import Navigator, NavigatorSettings, restored
from magfusion.fusion.state import ACCEL_BIAS, GYRO_BIAS, POSITION, ROTATION, VELOCITY, State
from magfusion.jobs.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from magfusion.jobs.replay import Replay, paced
from magfusion.records.samples import Log
from magfusion.records.stream_record import (
    Format,
    Numbered,
    field_samples,
    fields_content,
    imu_content,
    json_line,
    magnetometer_content,
    read_records,
    write_record,
)
from magfusion.report import AMBIGUOUS_CHI_SQUARE
from magfusion.site import Site
from magfusion.site_file import load_site
from magfusion.units import Array
from magfusion.view_live import open_live_view

_PLACE = {"json": "line", "msgpack": "record"}
WAITING = 1.0  # s; before the first state, as often a sign of life


@dataclass(frozen=True)
class StreamSettings:
    """How a stream is navigated.

    Parameters
    ----------
    navigator : NavigatorSettings
    form : {"json", "msgpack"}
        Of the records.
    keep_going : bool
        Count and pass over what is no record.
    live : bool
        Show the states in the viewer.
    checkpoint : Path, optional
        Where to leave what is needed to go on.
    every : float
        Between checkpoints (s of the stream).
    resume : bool
        Go on from the checkpoint, if there is one, with what comes now.
    """

    navigator: NavigatorSettings = field(default_factory=NavigatorSettings)
    form: Format = "json"
    keep_going: bool = False
    live: bool = False
    checkpoint: Path | None = None
    every: float = 30.0
    resume: bool = False


def run_stream(
    site_path: Path, settings: StreamSettings, source: BinaryIO, sink: BinaryIO, told: TextIO
) -> int:
    """Navigate by the records of a stream; write one line of JSON for each state.

    Parameters
    ----------
    site_path : Path
    settings : StreamSettings
    source, sink : file
        Binary; each line is written out at once.
    told : file
        Where records that are passed over are told of.

    Returns
    -------
    int
        How many were passed over.

    Raises
    ------
    InputError
        Where the site cannot be read, or a record is none and ``keep_going`` is not set.
    """
    site = load_site(site_path)
    digest = hashlib.sha256(site_path.read_bytes() + repr(settings.navigator).encode())
    key, place = digest.hexdigest(), settings.checkpoint
    found = read_checkpoint(place, key) if settings.resume and place is not None else None
    navigator = Navigator(site, settings.navigator) if found is None else restored(found.navigator)
    view = open_live_view(site) if settings.live else None
    refused, saved, reached = 0, -np.inf, -np.inf
    for numbered in read_records(source, settings.form):
        try:
            newest = _take_in(navigator, site, numbered)
        except InputError as error:
            sentence = f"standard input, {_PLACE[settings.form]} {numbered.number}: {error}"
            if not settings.keep_going:
                raise InputError(sentence) from error
            refused += 1
            told.write(f"magfusion: {sentence} (passed over)\n")
            continue
        for state in navigator.take():
            sink.write(json_line(state_content(navigator, state)))
            if view is not None:
                view.show(state, navigator.distortion)
        navigator.take_lagged()
        if not navigator.started and newest >= reached + WAITING:
            sink.write(json_line({"time": newest, "started": False, "ambiguous": None}))
            reached = newest
        sink.flush()
        if place is not None and newest >= saved + settings.every:
            write_checkpoint(Checkpoint(key, numbered.number, 0, navigator.checkpoint()), place)
            saved = newest
    if refused:
        told.write(f"magfusion: {refused} records were passed over\n")
    return refused


def _take_in(navigator: Navigator, site: Site, numbered: Numbered) -> float:
    """Give a record to the navigator; return the newest time in it (s)."""
    if numbered.record is None:
        raise InputError(numbered.refusal)
    record, newest = numbered.record, -np.inf
    if record.imu is not None:
        navigator.add_imu(record.imu.time, record.imu.gyro, record.imu.accel)
        newest = max(newest, _last(record.imu.time))
    if record.magnetometer is not None:
        navigator.add_magnetometer(record.magnetometer.time, record.magnetometer.field)
        newest = max(newest, _last(record.magnetometer.time))
    if record.fields is not None:
        navigator.add_fields(field_samples(record.fields, site.channels))
        newest = max(newest, record.fields.time)
    return newest


def _last(time: Array) -> float:
    return float(np.max(time, initial=-np.inf))


def state_content(navigator: Navigator, state: State) -> dict[str, Any]:
    """Return a state as it is written: SI units, sigmas of position and velocity in world axes."""
    world_from_body, cov = state.world_from_body, state.cov
    rival = navigator.rival_chi_square
    position_cov = world_from_body @ cov[POSITION, POSITION] @ world_from_body.T
    quaternion = Rotation.from_matrix(world_from_body).as_quat(scalar_first=True)
    return {
        "time": state.time,
        "started": True,
        "ambiguous": rival is not None and rival < AMBIGUOUS_CHI_SQUARE,
        "position": state.position_world.tolist(),
        "quaternion": quaternion.tolist(),
        "velocity": state.velocity_world.tolist(),
        "gyro_bias": state.gyro_bias_body.tolist(),
        "accel_bias": state.accel_bias_body.tolist(),
        "sigma": {
            "position": _sigma(position_cov),
            "rotation_body": _sigma(cov[ROTATION, ROTATION]),
            "velocity": _sigma(cov[VELOCITY, VELOCITY]),
            "gyro_bias": _sigma(cov[GYRO_BIAS, GYRO_BIAS]),
            "accel_bias": _sigma(cov[ACCEL_BIAS, ACCEL_BIAS]),
        },
        "distortion": dict(navigator.distortion),
    }


def _sigma(cov: Array) -> list[float]:
    return [float(s) for s in np.sqrt(np.diagonal(cov))]


def run_replay(log: Log, sink: BinaryIO, form: Format, realtime: bool) -> None:
    """Write a log as the records of a stream, in the order of their arrival."""
    replay = Replay(log)
    for _, piece in paced(replay, 0, realtime):
        if len(piece.imu):
            write_record(imu_content(piece.imu), sink, form)
        if piece.waveform is not None and len(piece.waveform):
            write_record(magnetometer_content(piece.waveform), sink, form)
        for samples in piece.fields:
            write_record(fields_content(samples), sink, form)
        if realtime:
            sink.flush()
    sink.flush()


@contextmanager
def until_closed() -> Iterator[None]:
    """End in peace where the reader of the output has gone."""
    try:
        yield
    except BrokenPipeError:
        # Python would complain once more when it flushes at its end.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
