"""Magnetometer, or triad of receive coils, on the platform, with its calibration uncertainty."""

from dataclasses import dataclass

from magfusion.model.physics.casing import Casing
from magfusion.model.response import AxisResponses, FrequencyResponse, ResponseSigma
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import SensorTemperatureModel
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class MagnetometerSigma:
    """Prior standard deviations of the magnetometer's calibration; zero means known.

    Parameters
    ----------
    matrix : ndarray, shape (3, 3)
    offset : ndarray, shape (3,)
        (T)
    rotation_sensor : ndarray, shape (3,)
        Of the mounting, sensor axes (rad).
    position_body : ndarray, shape (3,)
        Of the lever arm, body axes (m).
    clock_offset : float
        (s)
    """

    matrix: Array
    offset: Array
    rotation_sensor: Array
    position_body: Array
    clock_offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Magnetometer:
    """``measured = matrix @ field_sensor + offset`` at ``position_body`` on the platform.

    Parameters
    ----------
    position_body : ndarray, shape (3,)
        Lever arm (m).
    body_from_sensor : ndarray, shape (3, 3)
        Mounting rotation.
    noise_density : float
        One-sided white noise (T/sqrt(Hz)).
    matrix : ndarray, shape (3, 3)
    offset : ndarray, shape (3,)
        (T)
    coil_centres_sensor : ndarray, shape (3, 3), optional
        Magnetic centre of each axis's own coil (m), row by row; None where all three are at
        ``position_body``.
    offset_walk : float
        Standard deviation that the offset gains in an hour (T).
    coil_kappa : float
        Finite size of each axis's coil (m^2, `magfusion.model.receive_coils`); zero for a point.
    temperature_model : SensorTemperatureModel, optional
        Temperature dependence of matrix and offset.
    response : FrequencyResponse or AxisResponses, optional
        Response to alternating fields; None if equal to that of steady fields.
    response_sigma : ResponseSigma, optional
        Prior of the responses of y and z relative to x; None if known.
    axes : str
        Names of its axes.
    casing : Casing, optional
        Steel tube around it.
    name : str
        Identifies it in data and reports where there are several.
    clock_offset : float
        A sample stamped t was taken at t + clock_offset on the log's clock (s).
    clock_rate : float
        Of a single magnetometer: a sample stamped t was taken at t (1 + clock_rate) on the clock
        of the drives.
    clock_rate_sigma : float
        Prior standard deviation of ``clock_rate``.
    field_range : float
        Largest value of each axis in size (T); by default a hundred times a fluxgate's.
    ac_coupled : bool
        Whether it measures alternating fields alone: no steady field, and nothing of it.
    """

    __repr__ = short_repr

    position_body: Array
    body_from_sensor: Array
    noise_density: float
    matrix: Array
    offset: Array
    sigma: MagnetometerSigma
    coil_centres_sensor: Array | None = None
    offset_walk: float = 2e-8
    coil_kappa: float = 0.0
    temperature_model: SensorTemperatureModel | None = None
    response: FrequencyResponse | AxisResponses | None = None
    response_sigma: ResponseSigma | None = None
    axes: str = "xyz"
    casing: Casing | None = None
    name: str = "magnetometer"
    clock_offset: float = 0.0
    clock_rate: float = 0.0
    clock_rate_sigma: float = 0.0
    field_range: float = 0.1
    ac_coupled: bool = False

    @property
    def lacking(self) -> tuple[int, ...]:
        """Indices of the missing axes."""
        return tuple(k for k, axis in enumerate("xyz") if axis not in self.axes)
