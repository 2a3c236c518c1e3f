"""Keys of temperature: how moments, matrix and offset change with it."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magfusion.files.site_values import array, between, tesla
from magfusion.files.yaml_files import StrictModel
from magfusion.model.temperature import MomentTemperatureModel, SensorTemperatureModel
from magfusion.units import Array

COLDEST, HOTTEST = -273.15, 1000.0  # degrees Celsius
MAX_SHARE = 0.1  # of a moment, or of a matrix, in one kelvin
MAX_OFFSET = 1e-4  # T/K

_Celsius = Annotated[float, between(COLDEST, HOTTEST)]


class MomentTemperatureEntry(StrictModel):
    """`magfusion.model.temperature.MomentTemperatureModel`."""

    log_moment_per_k: Annotated[float, between(-MAX_SHARE, MAX_SHARE)]
    reference_degc: _Celsius = MomentTemperatureModel.reference_degc

    def temperature_model(self) -> MomentTemperatureModel:
        """Return the model of the entry."""
        return MomentTemperatureModel(self.log_moment_per_k, self.reference_degc)


class SensorTemperatureEntry(StrictModel):
    """`magfusion.model.temperature.SensorTemperatureModel`."""

    matrix_per_k: Annotated[Array, array(3, 3, largest=MAX_SHARE)] = Field(
        default_factory=lambda: np.zeros((3, 3))
    )
    offset_t_per_k: Annotated[Array, array(3), tesla(MAX_OFFSET, "T/K")] = Field(
        default_factory=lambda: np.zeros(3)
    )
    reference_degc: _Celsius = SensorTemperatureModel.reference_degc

    def temperature_model(self) -> SensorTemperatureModel:
        """Return the model of the entry."""
        return SensorTemperatureModel(self.matrix_per_k, self.offset_t_per_k, self.reference_degc)


def temperature_entry(
    temperature_model: MomentTemperatureModel | SensorTemperatureModel | None,
) -> dict[str, Any]:
    """Return its entry of a site's file."""
    if temperature_model is None:
        return {}
    reference = {"reference_degc": float(temperature_model.reference_degc)}
    if isinstance(temperature_model, MomentTemperatureModel):
        return {
            "warming": {"log_moment_per_k": float(temperature_model.log_moment_per_k)} | reference
        }
    matrix, offset = (
        temperature_model.matrix_per_k.tolist(),
        temperature_model.offset_per_k.tolist(),
    )
    return {"warming": {"matrix_per_k": matrix, "offset_t_per_k": offset} | reference}
