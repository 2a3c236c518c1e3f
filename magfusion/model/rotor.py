"""Permanent magnet on a rotating shaft: two coils in quadrature, harmonics and steady part."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Harmonic:
    """Part of the moment at a multiple of the shaft's angle, or steady along the shaft.

    Parameters
    ----------
    order : int
        Multiple of the angle: ``moment_beacon * cos(order * angle + phase)``.
    moment_beacon : ndarray, shape (3,)
        Peak (A m^2).
    phase : float
        (rad)
    """

    order: int
    moment_beacon: Array
    phase: float = 0.0


@dataclass(frozen=True, eq=False)
class Rotor:
    """Mounting of a magnet on its shaft, and rotation of the shaft.

    ``m(angle) = moment cos(tilt) (zero cos(angle) + (axis x zero) sin(angle)) + moment sin(tilt)
    axis``, and harmonics.  The part along the axis is steady and appears in no tone.

    Parameters
    ----------
    moment : float
        (A m^2)
    axis_beacon : ndarray, shape (3,)
        Unit vector of rotation by the right-hand rule; for a magnet in a well down the hole.
    zero_beacon : ndarray, shape (3,)
        Unit vector perpendicular to the axis, along the moment at angle zero.
    tilt : float
        Of the moment out of the plane perpendicular to the axis (rad).
    ellipse_sigma : float
        Of the ellipticity of the moment, each of two numbers, relative to the moment: from an
        angle error of two periods a turn, as by a joint or iron around the magnet.
    speed_sigma_hz : float
        Of the speed about the declared frequency, where the angle is not measured.
    speed_walk_hz_rts : float
        Random walk of the speed, gained in one second, one sigma.
    length : float
        Of the magnets along the shaft (m).
    """

    moment: float
    axis_beacon: Array
    zero_beacon: Array
    tilt: float = 0.0
    harmonics: tuple[Harmonic, ...] = ()
    ellipse_sigma: float = 0.005
    speed_sigma_hz: float = 0.1
    speed_walk_hz_rts: float = 0.01
    length: float = 0.0

    @property
    def turning_moments(self) -> Array:
        """Moments of the two equivalent coils in quadrature (A m^2), shape (2, 3)."""
        across = np.stack([self.zero_beacon, np.cross(self.axis_beacon, self.zero_beacon)])
        return np.asarray(self.moment * np.cos(self.tilt) * across)


@dataclass(frozen=True, eq=False)
class RotorAngles:
    """Shaft angles from encoders, recorded with the magnetometer.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    angle : mapping of str to ndarray, shape (n,)
        Of each rotor, by its beacon's name (rad), wrapped or unwrapped.
    """

    time: Array
    angle: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Depths:
    """Measured depth along its hole of a part: a beacon, or the magnetometer.

    Parameters
    ----------
    readings : mapping of str to ndarray, shape (2, n)
        Times, increasing (s), and measured depths (m); linear in between, constant beyond.
    """

    readings: Mapping[str, Array]

    def at(self, part: str, time: Array) -> Array | None:
        """Return the depths of a part at times (m); None without readings."""
        known = self.readings.get(part)
        return None if known is None else np.interp(time, known[0], known[1])
