"""What a site's file says of temperature: how moments, matrix and offset change with it."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magfusion.files.site_values import array, between, tesla
from magfusion.files.yaml_files import StrictModel
from magfusion.model.temperature import SensorWarming, Warming
from magfusion.units import Array

COLDEST, HOTTEST = -273.15, 1000.0  # degrees Celsius
LARGEST_SHARE = 0.1  # of a moment, or of a matrix, in one kelvin
LARGEST_OFFSET = 1e-4  # T/K

_Celsius = Annotated[float, between(COLDEST, HOTTEST)]


class WarmingEntry(StrictModel):
    """`magfusion.model.temperature.Warming`."""

    log_moment_per_k: Annotated[float, between(-LARGEST_SHARE, LARGEST_SHARE)]
    reference_degc: _Celsius = Warming.reference_degc

    def warming(self) -> Warming:
        """Return what the entry says."""
        return Warming(self.log_moment_per_k, self.reference_degc)


class SensorWarmingEntry(StrictModel):
    """`magfusion.model.temperature.SensorWarming`."""

    matrix_per_k: Annotated[Array, array(3, 3, largest=LARGEST_SHARE)] = Field(
        default_factory=lambda: np.zeros((3, 3))
    )
    offset_t_per_k: Annotated[Array, array(3), tesla(LARGEST_OFFSET, "T/K")] = Field(
        default_factory=lambda: np.zeros(3)
    )
    reference_degc: _Celsius = SensorWarming.reference_degc

    def warming(self) -> SensorWarming:
        """Return what the entry says."""
        return SensorWarming(self.matrix_per_k, self.offset_t_per_k, self.reference_degc)


def warming_entry(warming: Warming | SensorWarming | None) -> dict[str, Any]:
    """Return what a site's file says of it."""
    if warming is None:
        return {}
    reference = {"reference_degc": float(warming.reference_degc)}
    if isinstance(warming, Warming):
        return {"warming": {"log_moment_per_k": float(warming.log_moment_per_k)} | reference}
    matrix, offset = warming.matrix_per_k.tolist(), warming.offset_per_k.tolist()
    return {"warming": {"matrix_per_k": matrix, "offset_t_per_k": offset} | reference}
