"""What a site's file may hold of a beacon: its coils or its rotor, its slots, its accuracy."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticKnownError

from magfusion.files.site_rotor import RotorEntry
from magfusion.files.site_temperature import MomentTemperatureEntry
from magfusion.files.site_values import (
    HIGHEST_FREQUENCY,
    LOWEST_FREQUENCY,
    MAX_ANGLE,
    MAX_DISTANCE,
    MAX_MOMENT,
    MIN_MOMENT,
    AboveZero,
    Position,
    PositionSigma,
    Positive,
    RotationSigma,
    Share,
    a_direction,
    a_moment,
    array,
    at_least_one,
    between,
    coil_sigma,
    plain_name,
    refusal,
    refusal_at,
    zeros,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.physics.winding import Winding, WoundCoil, wound_coil
from magfusion.model.site import Beacon, Coil
from magfusion.units import DEGREE, Array

_Length = Annotated[AboveZero, between(1e-5, 1e3)]
_Count = Annotated[int, Field(ge=1, le=100_000)]
_Frequency = Annotated[AboveZero, between(LOWEST_FREQUENCY, HIGHEST_FREQUENCY)]
_Angle = Annotated[float, between(-MAX_ANGLE, MAX_ANGLE)]


class WindingEntry(StrictModel):
    """`magfusion.model.physics.winding.Winding`, and the direction of its axis."""

    axis: Annotated[Array, array(3), AfterValidator(a_direction)]
    current_a: Annotated[AboveZero, between(1e-12, 1e6)]
    layers: _Count
    rows: _Count
    inner_radius_m: _Length
    wire_m: _Length
    pitch_m: _Length | None = None

    @model_validator(mode="after")
    def _check_turns_fit(self) -> Self:
        if self.pitch_m is not None and self.pitch_m < self.wire_m:
            remedy = "give at least wire_m, or remove it: turns lie next to each other"
            raise refusal_at(("pitch_m",), self.pitch_m, remedy)
        return self

    def coil(self) -> "WoundCoil":
        """Return the equivalent coil."""
        pitch = self.wire_m if self.pitch_m is None else self.pitch_m
        size = (self.inner_radius_m, self.wire_m, pitch)
        return wound_coil(Winding(self.current_a, self.layers, self.rows, *size))


class CoilEntry(StrictModel):
    """One coil in beacon axes; its size, offset, own frequency and slot are optional."""

    moment_a_m2: Annotated[Array, array(3), AfterValidator(a_moment)] | None = None
    winding: WindingEntry | None = None
    phase_deg: _Angle = 0.0
    centre_m: Position = Field(default_factory=zeros)
    radius_m: _Length | None = None
    length_m: _Length | None = None
    frequency_hz: _Frequency | None = None
    slot: Annotated[int, Field(ge=0)] | None = None
    current_a: Annotated[AboveZero, between(1e-12, 1e6)] | None = None

    @model_validator(mode="after")
    def _moment_or_winding(self) -> Self:
        if self.winding is None:
            if self.moment_a_m2 is None:
                detail = InitErrorDetails(type="missing", loc=("moment_a_m2",), input=None)
                raise ValidationError.from_exception_data("site", [detail])
            return self
        for key in ("moment_a_m2", "radius_m", "length_m", "current_a"):
            if getattr(self, key) is not None:
                remedy = "remove it or winding, of which it follows"
                raise refusal_at((key,), np.asarray(getattr(self, key)).tolist(), remedy)
        moment = self.winding.coil().moment
        if not MIN_MOMENT <= moment <= MAX_MOMENT:
            remedy = (
                f"these turns have {moment:.3g} A m^2, and a beacon from {MIN_MOMENT:g} to"
                f" {MAX_MOMENT:g}; give current and lengths in A and m"
            )
            raise refusal_at(("winding",), self.winding.model_dump(), remedy)
        return self

    def coil(self) -> Coil:
        """Return the coil; of windings the equivalent one."""
        moment, radius, length = self.moment_a_m2, self.radius_m, self.length_m
        current = self.current_a
        if moment is None:
            assert self.winding is not None
            size, radius, length = self.winding.coil()
            moment = size * self.winding.axis / np.linalg.norm(self.winding.axis)
            current = self.winding.current_a
        return Coil(
            moment_beacon=moment,
            phase=self.phase_deg * DEGREE,
            centre_beacon=self.centre_m,
            radius=radius,
            length=length,
            frequency_hz=self.frequency_hz,
            slot=self.slot,
            current=current,
        )


MARKED = "marked"
MAX_SLOTS = 1000


class SlotsEntry(StrictModel):
    """When the coils of a beacon are driven, one after the other."""

    duration_s: Annotated[AboveZero, between(1e-4, 3600.0)]
    count: Annotated[int, Field(ge=1, le=MAX_SLOTS)]
    start_s: Annotated[float, between(-1e10, 1e10)] = 0.0


class BeaconSigmaEntry(StrictModel):
    """Priors of a beacon's calibration; an absent one is zero, which means known."""

    position_m: PositionSigma = Field(default_factory=zeros)
    rotation_deg: RotationSigma = Field(default_factory=zeros)
    log_moment: Annotated[Array, PlainValidator(coil_sigma)] = Field(
        default_factory=lambda: np.zeros(())
    )


def _slots(value: object) -> object:
    """Take a schedule, or the word for bursts that the log marks."""
    if value == MARKED:
        return MARKED
    if not isinstance(value, dict):
        raise refusal(f"write {{duration_s, count}}, or {MARKED} where the log has the times")
    return SlotsEntry.model_validate(value)


def _direct_current_only_in_slots(value: float, info: ValidationInfo) -> float:
    if value < 0.0 or (value == 0.0 and info.data.get("slots") is None):
        raise PydanticKnownError("greater_than", {"gt": 0})
    if value != 0.0 and not LOWEST_FREQUENCY <= value <= HIGHEST_FREQUENCY:
        raise refusal(f"give it in Hz, from {LOWEST_FREQUENCY:g} to {HIGHEST_FREQUENCY:g}")
    return value


class BeaconEntry(StrictModel):
    """One beacon with its coils."""

    name: Annotated[str, Field(min_length=1), AfterValidator(plain_name)]
    position_m: Annotated[Array | None, array(3, largest=MAX_DISTANCE, unit="m")] = None
    rpy_deg: Annotated[Array | None, array(3, largest=MAX_ANGLE, unit="degrees")] = None
    unknown: Literal["pose", "position", "attitude"] | None = None
    slots: Annotated[SlotsEntry | Literal["marked"], PlainValidator(_slots)] | None = None
    frequency_hz: Annotated[float, AfterValidator(_direct_current_only_in_slots)]
    coils: Annotated[list[CoilEntry], at_least_one("coil")] | None = None
    rotor: RotorEntry | None = None
    synchronised: bool = True
    model_error: Share | None = None
    noise_factor: Positive = Beacon.noise_factor
    hemisphere: Annotated[Array, array(3), AfterValidator(a_direction)] | None = None
    warming: MomentTemperatureEntry | None = None
    sigma: BeaconSigmaEntry = Field(default_factory=BeaconSigmaEntry)

    @model_validator(mode="after")
    def _surveyed_or_unknown(self) -> Self:
        for key, part in (("position_m", "position"), ("rpy_deg", "attitude")):
            value, unknown = getattr(self, key), self.unknown in ("pose", part)
            if value is None and not unknown:
                detail = InitErrorDetails(type="missing", loc=(key,), input=None)
                raise ValidationError.from_exception_data("site", [detail])
            if value is not None and unknown:
                remedy = f"remove it or unknown: {self.unknown}, which means that it is not known"
                raise refusal_at((key,), value.tolist(), remedy)
        return self

    @model_validator(mode="after")
    def _coils_or_a_rotor(self) -> Self:
        if self.coils is None and self.rotor is None:
            detail = InitErrorDetails(type="missing", loc=("coils",), input=None)
            raise ValidationError.from_exception_data("site", [detail])
        if self.rotor is not None and (self.coils is not None or self.slots is not None):
            key = "slots" if self.coils is None else "coils"
            raise refusal_at((key,), "given", "remove it or rotor, which is a source of its own")
        return self

    @property
    def tones_hz(self) -> list[float]:
        """Frequencies that it sends."""
        if self.rotor is not None:
            orders = [1, *(h.order for h in self.rotor.harmonics)]
            return [order * self.frequency_hz for order in orders]
        return [c.frequency_hz or self.frequency_hz for c in self.coils or []]

    @property
    def coil_count(self) -> int:
        """Its coils, or those equivalent to its rotor."""
        if self.rotor is not None:
            return 2 + len(self.rotor.harmonics)
        return len(self.coils or [])

    @model_validator(mode="after")
    def _coils_fit_the_slots(self) -> Self:
        if self.slots is None:
            return self
        if not isinstance(self.slots, SlotsEntry):
            return self._coils_are_marked()
        for i, coil in enumerate(self.coils or []):
            if coil.slot is None or coil.slot >= self.slots.count:
                remedy = f"give one of the beacon's {self.slots.count} slots, counted from 0"
                raise refusal_at(("coils", i, "slot"), coil.slot, remedy)
        if not self.synchronised and not self._slots_are_unique():
            remedy = (
                "write true, which counts slots on the log's clock; for slots to be found in the"
                " stream drive the coils with a carrier and leave one slot silent"
            )
            raise refusal_at(("synchronised",), False, remedy)
        return self

    def _coils_are_marked(self) -> Self:
        """See that marks name every coil, and that they leave the sign of pulses no doubt."""
        for i, coil in enumerate(self.coils or []):
            if coil.slot is None or coil.slot >= MAX_SLOTS:
                raise refusal_at(("coils", i, "slot"), coil.slot, "give the number in the marks")
            if not self.synchronised and not (coil.frequency_hz or self.frequency_hz):
                remedy = "write true: marks give the times of a pulse, and its sign is its coil's"
                raise refusal_at(("synchronised",), False, remedy)
        return self

    def _slots_are_unique(self) -> bool:
        """Return whether a stream determines the begin of a cycle."""
        assert isinstance(self.slots, SlotsEntry)
        driven = {coil.slot for coil in self.coils or []}
        count = self.slots.count
        rotated = (
            {(slot + k) % count for slot in driven if slot is not None} for k in range(1, count)
        )
        coils = self.coils or []
        carrier = all((coil.frequency_hz or self.frequency_hz) > 0.0 for coil in coils)
        return carrier and len(driven) < count and all(other != driven for other in rotated)

    @model_validator(mode="after")
    def _one_sigma_per_coil(self) -> Self:
        result, coils = self.sigma.log_moment, self.coil_count
        if result.ndim and len(result) != coils:
            remedy = f"give one number or a list of {coils}, one per coil"
            raise refusal_at(("sigma", "log_moment"), result.tolist(), remedy)
        return self
