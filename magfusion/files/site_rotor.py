"""Keys of a magnet on a shaft."""

from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from magfusion.files.site_values import (
    MAX_ANGLE,
    MAX_MOMENT,
    MIN_MOMENT,
    a_direction,
    a_moment,
    array,
    between,
    refusal_at,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.rotor import Harmonic, Rotor
from magfusion.units import DEGREE, Array

SQUARE = 1e-3  # cosine; beyond it two directions are not across each other
_Speed = Annotated[float, Field(gt=0.0, le=100.0)]


class HarmonicEntry(StrictModel):
    """`magfusion.model.rotor.Harmonic`."""

    order: Annotated[int, Field(ge=2, le=50)]
    moment_a_m2: Annotated[Array, array(3), AfterValidator(a_moment)]
    phase_deg: Annotated[float, between(-MAX_ANGLE, MAX_ANGLE)] = 0.0


class RotorEntry(StrictModel):
    """`magfusion.model.rotor.Rotor`."""

    moment_a_m2: Annotated[float, between(MIN_MOMENT, MAX_MOMENT)]
    axis: Annotated[Array, array(3), AfterValidator(a_direction)] = Field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0])
    )
    zero: Annotated[Array, array(3), AfterValidator(a_direction)] = Field(
        default_factory=lambda: np.array([0.0, 0.0, 1.0])
    )
    tilt_deg: Annotated[float, between(-45.0, 45.0)] = 0.0
    harmonics: list[HarmonicEntry] = Field(default_factory=list)
    ellipse_sigma: Annotated[float, Field(ge=0.0, le=1.0)] = Rotor.ellipse_sigma
    speed_sigma_hz: _Speed = Rotor.speed_sigma_hz
    speed_walk_hz_rts: _Speed = Rotor.speed_walk_hz_rts
    length_m: Annotated[float, between(0.0, 10.0)] = Rotor.length

    @model_validator(mode="after")
    def _zero_across_the_axis(self) -> Self:
        cosine = self.axis @ self.zero / np.linalg.norm(self.axis) / np.linalg.norm(self.zero)
        if abs(cosine) > SQUARE:
            remedy = "give a direction across the axis, in which the moment points at angle zero"
            raise refusal_at(("zero",), self.zero.tolist(), remedy)
        return self

    def rotor(self) -> Rotor:
        """Return the rotor of the entry."""
        axis = self.axis / np.linalg.norm(self.axis)
        zero = self.zero - (self.zero @ axis) * axis
        return Rotor(
            moment=self.moment_a_m2,
            axis_beacon=axis,
            zero_beacon=zero / np.linalg.norm(zero),
            tilt=self.tilt_deg * DEGREE,
            harmonics=tuple(
                Harmonic(h.order, h.moment_a_m2, h.phase_deg * DEGREE) for h in self.harmonics
            ),
            ellipse_sigma=self.ellipse_sigma,
            speed_sigma_hz=self.speed_sigma_hz,
            speed_walk_hz_rts=self.speed_walk_hz_rts,
            length=self.length_m,
        )


def rotor_entry(rotor: Rotor, log_scale: float) -> dict[str, Any]:
    """Return its entry of a site's file; the moment grew by a factor since it was declared."""
    factor = float(np.exp(log_scale))
    entry: dict[str, Any] = {
        "moment_a_m2": factor * rotor.moment,
        "axis": rotor.axis_beacon.tolist(),
        "zero": rotor.zero_beacon.tolist(),
        "ellipse_sigma": float(rotor.ellipse_sigma),
        "speed_sigma_hz": float(rotor.speed_sigma_hz),
        "speed_walk_hz_rts": float(rotor.speed_walk_hz_rts),
    }
    if rotor.length:
        entry["length_m"] = float(rotor.length)
    if rotor.tilt:
        entry["tilt_deg"] = float(rotor.tilt / DEGREE)
    if rotor.harmonics:
        entry["harmonics"] = [
            {
                "order": h.order,
                "moment_a_m2": (factor * h.moment_beacon).tolist(),
                "phase_deg": float(h.phase / DEGREE),
            }
            for h in rotor.harmonics
        ]
    return {"rotor": entry}
