"""What was recorded as records of a pipe; `magfusion.files.stream` reads them."""

from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import msgpack
import numpy as np
from pydantic_core import to_json

from magfusion.files.drive_columns import column_of
from magfusion.files.stream import Format
from magfusion.model.aiding import AidingSamples
from magfusion.model.drive import DriveSamples
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.units import Array, ComplexArray


def write_record(content: dict[str, Any], stream: BinaryIO, form: Format) -> None:
    """Write one record."""
    if form == "json":
        stream.write(
            to_json(content, inf_nan_mode="null") + b"\n"
        )  # nine times as fast as json.dumps
    else:
        stream.write(msgpack.packb(content))


def imu_content(samples: ImuSamples) -> dict[str, Any]:
    """Return inertial samples as a record."""
    gyro, accel = samples.gyro_body.tolist(), samples.accel_body.tolist()
    return {"imu": {"time": samples.time.tolist(), "gyro": gyro, "accel": accel}}


def magnetometer_content(waveform: Waveform, magnetometer: str | None = None) -> dict[str, Any]:
    """Return raw samples of the magnetometer, or of one of several by its name, as a record."""
    measured = waveform.measured_sensor.copy()
    measured[:, [axis not in waveform.axes for axis in "xyz"]] = np.nan
    field = [_or_none(row) for row in measured]
    named = {} if magnetometer is None else {"magnetometer": magnetometer}
    return {"magnetometer": {**named, "time": waveform.time.tolist(), "field": field}}


def baseband_content(time: Array, baseband: ComplexArray, tones_hz: Array) -> dict[str, Any]:
    """Return the complex amplitudes of tones (n, tones, 3) (T) as a record."""
    parts = {"re": baseband.real.tolist(), "im": baseband.imag.tolist()}
    return {"baseband": {"time": time.tolist(), "hz": tones_hz.tolist(), **parts}}


def reference_content(waveform: Waveform) -> dict[str, Any]:
    """Return samples of a reference sensor as a record."""
    field = [_or_none(row) for row in waveform.measured_sensor]
    return {"reference": {"time": waveform.time.tolist(), "field": field}}


def aiding_content(aiding: Iterable[tuple[str, AidingSamples]]) -> dict[str, Any]:
    """Return samples of aiding sensors, by name, as a record."""
    return {"aiding": {name: _aiding_entry(samples) for name, samples in aiding}}


def _aiding_entry(samples: AidingSamples) -> dict[str, Any]:
    time = samples.time.tolist()
    if samples.marks:
        return {"time": time, "mark": list(samples.marks)}
    rows = [_or_none(row) for row in samples.value]
    return {"time": time, "value": rows if samples.value.shape[1] > 1 else [row[0] for row in rows]}


def marks_content(marks: Marks) -> dict[str, Any]:
    """Return bursts as a record."""
    start, end = marks.begin.tolist(), marks.end.tolist()
    return {"marks": {"start": start, "end": end, "slot": marks.slot.tolist()}}


def _or_none(row: Array) -> list[float | None]:
    """Return numbers as JSON has them: None where one is missing."""
    return [value if np.isfinite(value) else None for value in row.tolist()]


def temperature_content(time: float, part: str, degc: float) -> dict[str, Any]:
    """Return a temperature as a record."""
    return {"temperature": {"time": time, "degc": {part: degc}}}


def drive_content(drive: DriveSamples) -> dict[str, Any]:
    """Return currents of coils as a record."""
    current = {column_of(name): values.tolist() for name, values in drive.current.items()}
    return {"drive": {"time": drive.time.tolist(), "current": current}}


def fields_contents(samples: FieldSamples) -> Iterator[dict[str, Any]]:
    """Yield the phasors of one window as records, one for each magnetometer that has any."""
    if not samples.magnetometers:
        yield fields_content(samples)
    for name in dict.fromkeys(samples.magnetometers):
        own = samples.of_magnetometer(name)
        if len(own):
            content = fields_content(own)
            content["fields"]["magnetometer"] = name
            yield content


def fields_content(samples: FieldSamples) -> dict[str, Any]:
    """Return the phasors or amplitudes of one window as a record, each with its covariance."""
    own = "xyz".index(samples.axes) if not samples.signed else 0
    phasors: dict[str, list[Any]] = {}
    covariance: dict[str, list[Any]] = {}
    tones: dict[str, dict[int, int]] = {}
    for row, (name, tone) in enumerate(samples.channels):
        tones.setdefault(name, {})[tone] = row
    valid = samples.valid[0]
    for name, rows in tones.items():
        if not any(valid[row] for row in rows.values()):
            continue
        phasors[name], covariance[name] = [], []
        for tone in range(max(rows) + 1):
            if tone in rows and valid[rows[tone]]:
                value = samples.phasor_sensor[0, rows[tone]]
                both = [_or_none(value.real), _or_none(value.imag)]
                phasors[name].append(both if samples.signed else float(abs(value[own])))
                covariance[name].append(samples.phasor_cov[0, rows[tone]].tolist())
            else:
                phasors[name].append(None)
                covariance[name].append(np.eye(3).tolist())
    time, window = float(samples.time[0]), float(samples.window[0])
    kind = "phasors" if samples.signed else "amplitudes"
    content = {"time": time, "window": window, kind: phasors, "covariance": covariance}
    return {"fields": content}
