"""Permanent magnet on a rotating shaft: two coils in quadrature, harmonics and steady part."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Harmonic:
    """Part of the moment at a multiple of the shaft's angle, or steady along the shaft."""

    order: int  # multiple of the angle: ``moment_beacon * cos(order * angle + phase)``
    moment_beacon: Array  # (3,), peak (A m^2)
    phase: float = 0.0  # (rad)


@dataclass(frozen=True, eq=False)
class Rotor:
    """Mounting of a magnet on its shaft, and rotation of the shaft.

    ``m(angle) = moment cos(tilt) (zero cos(angle) + (axis x zero) sin(angle)) + moment sin(tilt)
    axis``, and harmonics.  The part along the axis is steady and appears in no tone.
    """

    moment: float  # (A m^2)
    # (3,), unit vector of rotation by the right-hand rule; for a magnet in a well down the hole
    axis_beacon: Array
    # (3,), unit vector perpendicular to the axis, along the moment at angle zero
    zero_beacon: Array
    tilt: float = 0.0  # of the moment out of the plane perpendicular to the axis (rad)
    harmonics: tuple[Harmonic, ...] = ()
    # of the ellipticity of the moment, each of two numbers, relative to the moment: from an angle
    # error of two periods a turn, as by a joint or iron around the magnet
    ellipse_sigma: float = 0.005
    # of the speed about the declared frequency, where the angle is not measured
    speed_sigma_hz: float = 0.1
    speed_walk_hz_rts: float = 0.01  # random walk of the speed, gained in one second, one sigma
    length: float = 0.0  # of the magnets along the shaft (m)

    @property
    def turning_moments(self) -> Array:
        """Moments of the two equivalent coils in quadrature (A m^2), shape (2, 3)."""
        across = np.stack([self.zero_beacon, np.cross(self.axis_beacon, self.zero_beacon)])
        return np.asarray(self.moment * np.cos(self.tilt) * across)


@dataclass(frozen=True, eq=False)
class RotorAngles:
    """Shaft angles from encoders, recorded with the magnetometer."""

    time: Array  # (n,), seconds since the log's epoch, strictly increasing
    # (n,) each, of each rotor, by its beacon's name (rad), wrapped or unwrapped
    angle: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Depths:
    """Measured depth along its hole of a part: a beacon, or the magnetometer."""

    # (2, n) each, times, increasing (s), and measured depths (m); linear in between, constant
    # beyond
    readings: Mapping[str, Array]

    def at(self, part: str, time: Array) -> Array | None:
        """Return the depths of a part at times (m); None without readings."""
        known = self.readings.get(part)
        return None if known is None else np.interp(time, known[0], known[1])
