"""Samples as they go through a pipe: one record each, in JSON lines or MessagePack."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, BinaryIO, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, PlainValidator, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from magfusion.errors import InputError
from magfusion.files.drive_columns import beacon_of
from magfusion.files.marks_table import is_slot, slots_of
from magfusion.files.site_temperature import COLDEST, HOTTEST
from magfusion.files.table import LARGEST_NUMBER, LARGEST_TIME_NS
from magfusion.files.yaml_files import StrictModel, sentence
from magfusion.model.aiding import AidingSamples, Quantity, components
from magfusion.model.drive import DriveSamples
from magfusion.model.marks import UNKNOWN_SLOT
from magfusion.model.samples import FieldSamples
from magfusion.units import AnyArray, Array, ComplexArray, IntArray

Format = Literal["json", "msgpack"]
_CHUNK = 1 << 16  # bytes
LARGEST_RECORD = 1 << 24  # bytes; minutes of samples
# MessagePack reserves what a list announces before it reads it.
LONGEST_LIST = 1 << 17
MAX_TIME_S = 1e-9 * LARGEST_TIME_NS  # s


def _numbers(value: object, what: str, *, missing: bool = False) -> Array:
    """Return finite numbers as an array; NumPy alone would take text and truth values too.

    Parameters
    ----------
    missing : bool
        Whether null and NaN are taken, for a sample that is not there.
    """
    try:
        result = np.asarray(value)
    except ValueError:
        result = np.empty(0, dtype=object)
    if missing and result.dtype.kind == "O":
        result = _with_nulls(result)
    sound = (
        np.abs(result) < LARGEST_NUMBER if result.dtype.kind in "iuf" else np.zeros(1, dtype=bool)
    )
    if missing and result.dtype.kind == "f":
        sound |= np.isnan(result)
    if not np.all(sound):
        raise PydanticCustomError("numbers", "it should be {what}, finite", {"what": what})
    return np.asarray(result, dtype=float)


def _with_nulls(result: NDArray[np.object_]) -> NDArray[np.generic]:
    """Return numbers with NaN for null; as it is where it holds anything else."""
    kinds = {type(one) for one in result.ravel()}
    return result.astype(float) if kinds <= {int, float, type(None)} and result.size else result


def _times(value: object) -> Array:
    result = np.atleast_1d(_numbers(value, "a time in seconds, or a list of them"))
    if result.ndim != 1 or not np.all(np.abs(result) <= MAX_TIME_S):
        raise PydanticCustomError("times", "it should be a time in seconds, or a list of them")
    return result


def _vectors(value: object) -> Array:
    result = np.atleast_2d(_numbers(value, "three numbers, or a list of such", missing=True))
    if result.ndim != 2 or result.shape[1] != 3:
        raise PydanticCustomError("vectors", "it should be three numbers, or a list of such")
    return result


def _numbers_of_tones(value: object) -> Array:
    return _numbers(value, "for each time three numbers a tone", missing=True)


def _series(value: object) -> Array:
    what = "a number, or a list of them"
    result = np.atleast_1d(_numbers(value, what, missing=True))
    if result.ndim != 1:
        raise PydanticCustomError("series", "it should be {what}", {"what": what})
    return result


def _series_or_vectors(value: object) -> Array:
    """Return numbers with one or several columns, (k, columns)."""
    nested = isinstance(value, list) and any(isinstance(row, list) for row in value)
    if not nested:
        return _series(value)[:, None]
    result = _numbers(value, "numbers, or rows of equally many", missing=True)
    if result.ndim != 2:
        raise PydanticCustomError("vectors", "it should be numbers, or rows of equally many")
    return result


def _slots(value: object) -> IntArray:
    """Return slots with samples; null and NaN mean unknown."""
    result = _series(value)
    if not np.all(is_slot(result)):
        what = "for each sample null, -1 where no coil is driven, or the number of a slot"
        raise PydanticCustomError("slots", "it should be {what}", {"what": what})
    return slots_of(result)


def _phasor(value: object) -> ComplexArray:
    """Return the phasors of a beacon's tones, (tones, 3); a tone that is null is missing."""
    what = "for each tone null or [[re_x, re_y, re_z], [im_x, im_y, im_z]]"
    if not isinstance(value, list):
        raise PydanticCustomError("phasor", "it should be {what}", {"what": what})
    out = np.full((len(value), 3), np.nan, dtype=complex)
    for i, tone in enumerate(value):
        if tone is None:
            continue
        result = _numbers(tone, what, missing=True)
        if result.shape != (2, 3):
            raise PydanticCustomError("phasor", "it should be {what}", {"what": what})
        out[i] = result[0] + 1j * result[1]
    return out


def _amplitudes(value: object) -> ComplexArray:
    """Return the amplitudes of a beacon's tones, (tones, 3), in the first column."""
    result = _series(value)
    if np.any(result < 0.0):
        text = "an amplitude has no sign; it should not be below zero, or be a phasor"
        raise PydanticCustomError("amplitudes", text)
    out = np.full((len(result), 3), np.nan, dtype=complex)
    out[:, 0] = result
    return out


def _covariance(value: object) -> Array:
    what = "a list of symmetric, positive 3 x 3 matrices (T^2), one for each tone"
    result = _numbers(value, what)
    if result.ndim != 3 or result.shape[1:] != (3, 3) or np.any(np.linalg.eigvalsh(result) <= 0.0):
        raise PydanticCustomError("covariance", "it should be {what}", {"what": what})
    return result


class _Arrays(StrictModel):
    model_config = ConfigDict(arbitrary_types_allowed=True)


class ImuRecord(_Arrays):
    """Inertial samples: stamps (k,), rates and specific forces (k, 3); NaN where missing."""

    time: Annotated[Array, PlainValidator(_times)]
    gyro: Annotated[Array, PlainValidator(_vectors)]
    accel: Annotated[Array, PlainValidator(_vectors)]

    @model_validator(mode="after")
    def _check_lengths(self) -> "ImuRecord":
        _check_lengths(self.time, gyro=self.gyro, accel=self.accel)
        return self


class MagnetometerRecord(_Arrays):
    """Raw samples of the magnetometer: stamps (k,), fields (k, 3) (T); NaN where missing.

    ``slot`` is that of the coil that is driven: -1 where none is, null where unknown;
    ``magnetometer`` the name of the one of several that took them.
    """

    time: Annotated[Array, PlainValidator(_times)]
    field: Annotated[Array, PlainValidator(_vectors)]
    slot: Annotated[IntArray, PlainValidator(_slots)] | None = None
    magnetometer: str | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> "MagnetometerRecord":
        _check_lengths(self.time, field=self.field)
        if self.slot is not None:
            _check_lengths(self.time, slot=self.slot)
        return self


class ReferenceRecord(_Arrays):
    """Samples of a reference sensor, by its own clock: stamps (k,), fields (k, 3) (T)."""

    time: Annotated[Array, PlainValidator(_times)]
    field: Annotated[Array, PlainValidator(_vectors)]

    @model_validator(mode="after")
    def _check_lengths(self) -> "ReferenceRecord":
        _check_lengths(self.time, field=self.field)
        return self


class BasebandRecord(_Arrays):
    """Complex amplitudes of tones: stamps (k,), frequencies (tones,), parts (k, tones, 3) (T).

    The field of a tone at a stamp is the real part of ``(re + j im) exp(j 2 pi hz time)``.
    """

    time: Annotated[Array, PlainValidator(_times)]
    hz: Annotated[Array, PlainValidator(_series)]
    re: Annotated[Array, PlainValidator(_numbers_of_tones)]
    im: Annotated[Array, PlainValidator(_numbers_of_tones)]

    @model_validator(mode="after")
    def _check_lengths(self) -> "BasebandRecord":
        _check_lengths(self.time, re=self.re, im=self.im)
        shape = (len(self.time), len(self.hz), 3)
        if self.re.shape != shape or self.im.shape != shape:
            text = "re and im should have three numbers for each tone at each time"
            raise PydanticCustomError("tones", text)
        return self


class FieldsRecord(_Arrays):
    """Phasors of one window, or amplitudes of one axis; of every detected beacon, its tones.

    ``sigma`` (T) is the standard deviation of each component's real and imaginary part;
    ``covariance`` takes its place where the axes differ; ``magnetometer`` is the name of the one of
    several that measured them.
    """

    time: float = Field(ge=-MAX_TIME_S, le=MAX_TIME_S)
    window: float = Field(ge=1e-6, le=3600.0)
    phasors: dict[str, Annotated[ComplexArray, PlainValidator(_phasor)]] | None = None
    amplitudes: dict[str, Annotated[ComplexArray, PlainValidator(_amplitudes)]] | None = None
    sigma: float | None = Field(default=None, ge=1e-30, le=1.0)
    covariance: dict[str, Annotated[Array, PlainValidator(_covariance)]] | None = None
    magnetometer: str | None = None

    @model_validator(mode="after")
    def _one_noise(self) -> "FieldsRecord":
        if (self.sigma is None) == (self.covariance is None):
            raise PydanticCustomError("noise", "it should have either sigma or covariance")
        if (self.phasors is None) == (self.amplitudes is None):
            raise PydanticCustomError("kind", "it should have either phasors or amplitudes")
        for name, phasor in self.measured.items():
            cov = None if self.covariance is None else self.covariance.get(name)
            if self.covariance is not None and (cov is None or len(cov) != len(phasor)):
                given = {"name": name}
                raise PydanticCustomError("noise", "covariance lacks a tone of {name}", given)
        return self

    @property
    def measured(self) -> dict[str, ComplexArray]:
        """Of each beacon the numbers of its tones, (tones, 3)."""
        return self.phasors or self.amplitudes or {}


class TemperatureRecord(StrictModel):
    """Temperatures (degrees Celsius) of beacons, or of the ``magnetometer``, from a time on."""

    time: float = Field(ge=-MAX_TIME_S, le=MAX_TIME_S)
    degc: dict[str, Annotated[float, Field(ge=COLDEST, le=HOTTEST)]]


class DriveRecord(_Arrays):
    """Currents of coils: stamps (k,), and of each column, named as in a log's table, (k,) (A)."""

    time: Annotated[Array, PlainValidator(_times)]
    current: dict[
        Annotated[str, Field(pattern=r"^drive(_.+)?$")], Annotated[Array, PlainValidator(_series)]
    ] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_lengths(self) -> "DriveRecord":
        _check_lengths(self.time, **self.current)
        return self


class MarksRecord(_Arrays):
    """Bursts of coils: when each starts and ends (k,), and its slot; -1 where none is driven."""

    start: Annotated[Array, PlainValidator(_times)]
    end: Annotated[Array, PlainValidator(_times)]
    slot: Annotated[IntArray, PlainValidator(_slots)]

    @model_validator(mode="after")
    def _check_lengths(self) -> "MarksRecord":
        _check_lengths(self.start, end=self.end, slot=self.slot)
        if np.any(self.slot == UNKNOWN_SLOT):
            raise PydanticCustomError("slots", "each mark should have a slot")
        return self


class AidingRecord(_Arrays):
    """Samples of one aiding sensor: stamps (k,), and values (k,), (k, 3) or (k, 7), or marks (k,).

    Values are in m/s, m, Pa, rad or s; null where an axis is not measured.
    """

    time: Annotated[Array, PlainValidator(_times)]
    value: Annotated[Array, PlainValidator(_series_or_vectors)] | None = None
    mark: list[str] | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> "AidingRecord":
        if (self.value is None) == (self.mark is None):
            raise PydanticCustomError("aiding", "it should have either value or mark")
        given = {"mark": np.array(self.mark)} if self.value is None else {"value": self.value}
        _check_lengths(self.time, **given)
        return self


class Record(StrictModel):
    """One line of the stream; it may hold several kinds of samples."""

    imu: ImuRecord | None = None
    magnetometer: MagnetometerRecord | None = None
    fields: FieldsRecord | None = None
    temperature: TemperatureRecord | None = None
    drive: DriveRecord | None = None
    marks: MarksRecord | None = None
    reference: ReferenceRecord | None = None
    aiding: dict[str, AidingRecord] | None = None
    baseband: BasebandRecord | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> "Record":
        if all(getattr(self, kind) is None for kind in type(self).model_fields):
            kinds = ", ".join(type(self).model_fields)
            raise PydanticCustomError("empty", "it should hold {kinds}", {"kinds": kinds})
        return self


def _check_lengths(time: Array, **rows: AnyArray) -> None:
    for name, values in rows.items():
        if len(values) != len(time):
            given = {"name": name, "rows": len(values), "times": len(time)}
            text = "{name} has {rows} rows for {times} times; they should be as many"
            raise PydanticCustomError("lengths", text, given)


def field_samples(entry: FieldsRecord, channels: tuple[tuple[str, int], ...]) -> FieldSamples:
    """Return the phasors in the order of the site's channels; those not detected are NaN.

    Raises
    ------
    InputError
        Where a beacon or a tone is unknown to the site.
    """
    phasor = np.full((len(channels), 3), np.nan, dtype=complex)
    cov = np.full((len(channels), 3, 3), np.nan)
    for name, tones in entry.measured.items():
        for tone, value in enumerate(tones):
            if (name, tone) not in channels:
                known = ", ".join(f"{b} tone {t}" for b, t in channels)
                raise InputError(f"holds beacon {name} tone {tone}; the site knows {known}")
            row = channels.index((name, tone))
            phasor[row] = value
            if np.any(np.isfinite(value)):
                cov[row] = _noise(entry, name, tone)
    return FieldSamples(
        time=np.array([entry.time]),
        window=np.array([entry.window]),
        channels=channels,
        phasor_sensor=phasor[None],
        phasor_cov=cov[None],
        axes="xyz" if entry.amplitudes is None else "x",
        signed=entry.amplitudes is None,
    )


def _noise(entry: FieldsRecord, name: str, tone: int) -> Array:
    if entry.covariance is not None:
        return np.asarray(entry.covariance[name][tone])
    assert entry.sigma is not None
    return entry.sigma**2 * np.eye(3)


@dataclass(frozen=True, eq=False)
class NumberedRecord:
    """A record with its place in the stream, or the sentence with the reason why it is none.

    Parameters
    ----------
    source, unit : str
        What is read, and what ``number`` counts.
    """

    number: int
    record: Record | None
    refusal: str = ""
    source: str = "standard input"
    unit: str = "line"

    def located(self, reason: object) -> str:
        """Return a sentence on it with its place."""
        return f"{self.source}, {self.unit} {self.number}: {reason}"


def read_records(stream: BinaryIO, form: Format) -> Iterator[NumberedRecord]:
    """Yield the records of a stream as they come; blank lines are passed over.

    Raises
    ------
    InputError
        Where MessagePack is none, or a record of it too large: it is unknown where the next begins.
    """
    return _json_records(stream) if form == "json" else _msgpack_records(stream)


def _json_records(stream: BinaryIO) -> Iterator[NumberedRecord]:
    number = 0
    while line := stream.readline(LARGEST_RECORD + 1):
        number += 1
        if len(line) > LARGEST_RECORD:
            while line and not line.endswith(b"\n"):
                line = stream.readline(_CHUNK)
            yield NumberedRecord(number, None, _TOO_LARGE)
        elif line.strip():
            yield checked_record(number, partial(Record.model_validate_json, line))


_TOO_LARGE = f"is larger than {LARGEST_RECORD >> 20} MiB; write fewer samples in a record."


def _msgpack_records(stream: BinaryIO) -> Iterator[NumberedRecord]:
    number, fed, whole = 0, 0, 0  # records; bytes received, and those of whole records
    unpacker = msgpack.Unpacker(
        max_buffer_size=LARGEST_RECORD + _CHUNK,
        max_str_len=LARGEST_RECORD,
        max_bin_len=LARGEST_RECORD,
        max_array_len=LONGEST_LIST,
        max_map_len=LONGEST_LIST,
    )
    # As much as has come: read() would wait for all of a chunk.
    while chunk := stream.read1(_CHUNK):  # type: ignore[attr-defined]
        try:
            unpacker.feed(chunk)
            fed += len(chunk)
            for content in unpacker:
                number, whole = number + 1, unpacker.tell()
                read = partial(Record.model_validate, content)
                yield replace(checked_record(number, read), unit="record")
        except msgpack.BufferFull as error:
            raise InputError(f"{_RECORD} {number + 1}: {_TOO_LARGE}") from error
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
            reason = str(error) or type(error).__name__
            raise InputError(
                f"{_RECORD} {number + 1}: is no MessagePack ({reason}); write whole records"
            ) from error
    if fed > whole:
        raise InputError(
            f"{_RECORD} {number + 1}: breaks off after {fed - whole} bytes; write whole records"
        )


_RECORD = "standard input, record"


def checked_record(number: int, read: Callable[[], Record]) -> NumberedRecord:
    """Return a record with its number, or the reason why it is none."""
    try:
        return NumberedRecord(number, read())
    except ValidationError as error:
        return NumberedRecord(number, None, sentence(error, Record, "record"))


def json_line(content: dict[str, Any]) -> bytes:
    """Return plain values as one line of JSON."""
    return json.dumps(content, allow_nan=False).encode() + b"\n"


def aiding_samples(entry: AidingRecord, quantity: Quantity) -> AidingSamples:
    """Return the samples of a record of a sensor of some quantity, without those that are missing.

    Raises
    ------
    InputError
        If they are of another.
    """
    if quantity == "mark" and entry.mark is not None:
        return AidingSamples(
            quantity, entry.time, np.zeros((len(entry.time), 0)), tuple(entry.mark)
        )
    columns = components(quantity)
    if quantity == "mark" or entry.value is None or entry.value.shape[1] != columns:
        wanted = "mark" if quantity == "mark" else f"value with {columns} numbers a sample"
        raise InputError(f"a sensor of {quantity} needs {wanted}")
    there = np.isfinite(entry.value)
    kept = there.any(axis=1) if quantity == "velocity" else there.all(axis=1)
    return AidingSamples(quantity, entry.time[kept], entry.value[kept])


def drive_samples(entry: DriveRecord) -> DriveSamples:
    """Return the currents of a record, without times at which one is missing."""
    kept = np.all([np.isfinite(values) for values in entry.current.values()], axis=0)
    own = {beacon_of(name): values[kept] for name, values in entry.current.items()}
    return DriveSamples(entry.time[kept], own)
