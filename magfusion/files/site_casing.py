"""Keys of the steel tube around a magnetometer."""

from typing import Annotated, Any

from pydantic import Field

from magfusion.files.site_values import between
from magfusion.files.yaml_files import StrictModel
from magfusion.model.physics.casing import Casing
from magfusion.units import DEGREE

_STEEL = ("wall_sigma", "permeability_sigma", "conductivity_sigma")
_Share = Annotated[float, between(0.0, 1.0)]
_AboveZero = Annotated[float, Field(gt=0.0)]


class CasingEntry(StrictModel):
    """`magfusion.model.physics.casing.Casing`."""

    radius_m: Annotated[_AboveZero, between(1e-3, 10.0)]
    wall_m: Annotated[_AboveZero, between(1e-4, 1.0)]
    permeability: Annotated[float, between(1.0, 1e6)] = Casing.permeability
    conductivity_s_m: Annotated[_AboveZero, between(1.0, 1e9)] = Casing.conductivity
    log_gain_sigma: Annotated[_AboveZero, between(1e-6, 10.0)] = Casing.log_gain_sigma
    phase_sigma_deg: Annotated[_AboveZero, between(1e-6, 360.0)] = Casing.phase_sigma / DEGREE
    wall_sigma: _Share = Casing.wall_sigma
    permeability_sigma: _Share = Casing.permeability_sigma
    conductivity_sigma: _Share = Casing.conductivity_sigma

    def casing(self) -> Casing:
        """Return the casing of the entry."""
        return Casing(
            self.radius_m,
            self.wall_m,
            self.permeability,
            self.conductivity_s_m,
            self.log_gain_sigma,
            self.phase_sigma_deg * DEGREE,
            self.wall_sigma,
            self.permeability_sigma,
            self.conductivity_sigma,
        )


def casing_entry(casing: Casing | None) -> dict[str, Any]:
    """Return its entry of a site's file."""
    if casing is None:
        return {}
    return {
        "casing": {
            "radius_m": float(casing.radius),
            "wall_m": float(casing.wall),
            "permeability": float(casing.permeability),
            "conductivity_s_m": float(casing.conductivity),
            "log_gain_sigma": float(casing.log_gain_sigma),
            "phase_sigma_deg": float(f"{casing.phase_sigma / DEGREE:.15g}"),
            **{name: float(s) for name, s in zip(_STEEL, casing.steel_sigma, strict=True) if s},
        }
    }
