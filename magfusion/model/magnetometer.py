"""Magnetometer, or triad of receive coils, on the platform, with its calibration uncertainty."""

from dataclasses import dataclass

from magfusion.model.physics.casing import Casing
from magfusion.model.response import AxisResponses, FrequencyResponse, ResponseSigma
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import SensorTemperatureModel
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class MagnetometerSigma:
    """Prior standard deviations of the magnetometer's calibration; zero means known."""

    matrix: Array  # (3, 3)
    offset: Array  # (3,) (T)
    rotation_sensor: Array  # (3,), of the mounting, sensor axes (rad)
    position_body: Array  # (3,), of the lever arm, body axes (m)
    clock_offset: float = 0.0  # (s)


@dataclass(frozen=True, eq=False)
class Magnetometer:
    """``measured = matrix @ field_sensor + offset`` at ``position_body`` on the platform."""

    __repr__ = short_repr

    position_body: Array  # (3,), lever arm (m)
    body_from_sensor: Array  # (3, 3), mounting rotation
    noise_density: float  # one-sided white noise (T/sqrt(Hz))
    matrix: Array  # (3, 3)
    offset: Array  # (3,) (T)
    sigma: MagnetometerSigma
    # (3, 3), magnetic centre of each axis's own coil (m), row by row; None where all three are at
    # ``position_body``
    coil_centres_sensor: Array | None = None
    offset_walk: float = 2e-8  # standard deviation that the offset gains in an hour (T)
    # finite size of each axis's coil (m^2, `magfusion.model.receive_coils`); zero for a point
    coil_kappa: float = 0.0
    # temperature dependence of matrix and offset
    temperature_model: SensorTemperatureModel | None = None
    # response to alternating fields; None if equal to that of static fields
    response: FrequencyResponse | AxisResponses | None = None
    # prior of the responses of y and z relative to x; None if known
    response_sigma: ResponseSigma | None = None
    axes: str = "xyz"  # names of its axes
    casing: Casing | None = None  # steel tube around it
    name: str = "magnetometer"  # identifies it in data and reports where there are several
    # a sample stamped t was taken at t + clock_offset on the log's clock, which is that of the
    # first of several and of the drives (s)
    clock_offset: float = 0.0
    # of a single magnetometer: a sample stamped t was taken at t (1 + clock_rate) on the clock of
    # the drives
    clock_rate: float = 0.0
    clock_rate_sigma: float = 0.0  # prior standard deviation of ``clock_rate``
    # largest value of each axis in size (T); by default a hundred times a fluxgate's
    field_range: float = 0.1
    # whether it measures alternating fields alone: no static field, and nothing of it
    ac_coupled: bool = False

    @property
    def lacking(self) -> tuple[int, ...]:
        """Indices of the missing axes."""
        return tuple(k for k, axis in enumerate("xyz") if axis not in self.axes)
