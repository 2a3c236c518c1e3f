"""Records of samples as they go through a pipe, checked."""

from typing import Annotated, Self

import numpy as np
from pydantic import ConfigDict, Field, PlainValidator, model_validator
from pydantic_core import PydanticCustomError

from magfusion.files.record_values import (
    MAX_TIME_S,
    numbers_of_tones,
    series,
    series_or_vectors,
    slots,
    times,
    tone_amplitudes,
    tone_covariances,
    tone_phasors,
    vectors,
)
from magfusion.files.site_temperature import COLDEST, HOTTEST
from magfusion.files.yaml_files import StrictModel
from magfusion.model.marks import UNKNOWN_SLOT
from magfusion.units import AnyArray, Array, ComplexArray, IntArray


class _Rows(StrictModel):
    """Columns of equally many rows, the first of which are times."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        (_, first), *others = self.columns().items()
        for name, values in others:
            if len(values) != len(first):
                given = {"name": name, "rows": len(values), "times": len(first)}
                text = "{name} has {rows} rows for {times} times; they should be as many"
                raise PydanticCustomError("lengths", text, given)
        return self

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns that there are, by name."""
        return {name: column for name, column in self if isinstance(column, np.ndarray)}


class ImuRecord(_Rows):
    """Inertial samples: stamps (k,), rates and specific forces (k, 3); NaN where missing."""

    time: Annotated[Array, PlainValidator(times)]
    gyro: Annotated[Array, PlainValidator(vectors)]
    accel: Annotated[Array, PlainValidator(vectors)]


class MagnetometerRecord(_Rows):
    """Raw samples of the magnetometer: stamps (k,), fields (k, 3) (T); NaN where missing.

    ``slot`` is that of the coil that is driven: -1 where none is, null where unknown;
    ``magnetometer`` the name of the one of several that took them.
    """

    time: Annotated[Array, PlainValidator(times)]
    field: Annotated[Array, PlainValidator(vectors)]
    slot: Annotated[IntArray, PlainValidator(slots)] | None = None
    magnetometer: str | None = None


class ReferenceRecord(_Rows):
    """Samples of a reference sensor, by its own clock: stamps (k,), fields (k, 3) (T)."""

    time: Annotated[Array, PlainValidator(times)]
    field: Annotated[Array, PlainValidator(vectors)]


class BasebandRecord(_Rows):
    """Complex amplitudes of tones: stamps (k,), frequencies (tones,), parts (k, tones, 3) (T).

    The field of a tone at a stamp is the real part of ``(re + j im) exp(j 2 pi hz time)``.
    """

    time: Annotated[Array, PlainValidator(times)]
    hz: Annotated[Array, PlainValidator(series)]
    re: Annotated[Array, PlainValidator(numbers_of_tones)]
    im: Annotated[Array, PlainValidator(numbers_of_tones)]

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns that there are, by name."""
        return {"time": self.time, "re": self.re, "im": self.im}

    @model_validator(mode="after")
    def _three_a_tone(self) -> Self:
        shape = (len(self.time), len(self.hz), 3)
        if self.re.shape != shape or self.im.shape != shape:
            text = "re and im should have three numbers for each tone at each time"
            raise PydanticCustomError("tones", text)
        return self


class FieldsRecord(StrictModel):
    """Phasors of one window, or amplitudes of one axis; of every detected beacon, its tones.

    ``sigma`` (T) is the standard deviation of each component's real and imaginary part;
    ``covariance`` takes its place where the axes differ; ``magnetometer`` is the name of the one of
    several that measured them.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    time: float = Field(ge=-MAX_TIME_S, le=MAX_TIME_S)
    window: float = Field(ge=1e-6, le=3600.0)
    phasors: dict[str, Annotated[ComplexArray, PlainValidator(tone_phasors)]] | None = None
    amplitudes: dict[str, Annotated[ComplexArray, PlainValidator(tone_amplitudes)]] | None = None
    sigma: float | None = Field(default=None, ge=1e-30, le=1.0)
    covariance: dict[str, Annotated[Array, PlainValidator(tone_covariances)]] | None = None
    magnetometer: str | None = None

    @model_validator(mode="after")
    def _one_noise(self) -> Self:
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


class DriveRecord(_Rows):
    """Currents of coils: stamps (k,), and of each column, named as in a log's table, (k,) (A)."""

    time: Annotated[Array, PlainValidator(times)]
    current: dict[
        Annotated[str, Field(pattern=r"^drive(_.+)?$")], Annotated[Array, PlainValidator(series)]
    ] = Field(min_length=1)

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns that there are, by name."""
        return {"time": self.time, **self.current}


class MarksRecord(_Rows):
    """Bursts of coils: when each starts and ends (k,), and its slot; -1 where none is driven."""

    start: Annotated[Array, PlainValidator(times)]
    end: Annotated[Array, PlainValidator(times)]
    slot: Annotated[IntArray, PlainValidator(slots)]

    @model_validator(mode="after")
    def _known_slots(self) -> Self:
        if np.any(self.slot == UNKNOWN_SLOT):
            raise PydanticCustomError("slots", "each mark should have a slot")
        return self


class AidingRecord(_Rows):
    """Samples of one aiding sensor: stamps (k,), and values (k,), (k, 3) or (k, 7), or marks (k,).

    Values are in m/s, m, Pa, rad or s; null where an axis is not measured.
    """

    time: Annotated[Array, PlainValidator(times)]
    value: Annotated[Array, PlainValidator(series_or_vectors)] | None = None
    mark: list[str] | None = None

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns that there are, by name."""
        return super().columns() | ({} if self.mark is None else {"mark": np.array(self.mark)})

    @model_validator(mode="after")
    def _value_or_mark(self) -> Self:
        if (self.value is None) == (self.mark is None):
            raise PydanticCustomError("aiding", "it should have either value or mark")
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
    def _not_empty(self) -> Self:
        if all(getattr(self, kind) is None for kind in type(self).model_fields):
            kinds = ", ".join(type(self).model_fields)
            raise PydanticCustomError("empty", "it should hold {kinds}", {"kinds": kinds})
        return self
