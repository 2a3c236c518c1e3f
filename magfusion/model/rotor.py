"""A permanent magnet that turns with a shaft: two coils in quadrature, and what it does beside."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Harmonic:
    """A part of the moment that turns several times as fast, or along the shaft, not at all.

    Parameters
    ----------
    order : int
        Turns in one of the shaft: ``moment_beacon * cos(order * angle + phase)``.
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
    """How a magnet is on its shaft, and how that turns.

    ``m(angle) = moment cos(tilt) (zero cos(angle) + (axis x zero) sin(angle)) + moment sin(tilt)
    axis``, and harmonics.  The part along the axis is steady, and no tone shows it.

    Parameters
    ----------
    moment : float
        (A m^2)
    axis_beacon : ndarray, shape (3,)
        Unit vector about which it turns by the right hand; of a magnet in a well down the hole.
    zero_beacon : ndarray, shape (3,)
        Unit vector across the axis, of the moment at angle zero.
    tilt : float
        Of the moment out of the plane across the axis (rad).
    ellipse_sigma : float
        Of how far the moment's circle is from one, each of two numbers, as a share of the moment:
        by an angle that errs twice a turn, as a joint or iron about the magnet make it.
    speed_sigma_hz : float
        Of the speed about the declared frequency, where nobody measures the angle.
    speed_walk_hz_rts : float
        What it gains in a second, one sigma, likewise.
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
        """Moments of the two coils in quadrature that stand for it (A m^2), shape (2, 3)."""
        across = np.stack([self.zero_beacon, np.cross(self.axis_beacon, self.zero_beacon)])
        return np.asarray(self.moment * np.cos(self.tilt) * across)


@dataclass(frozen=True, eq=False)
class RotorAngles:
    """Angles of shafts as encoders have them, beside the samples of the magnetometer.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    angle : mapping of str to ndarray, shape (n,)
        Of each rotor, by its beacon's name (rad), with or without whole turns.
    """

    time: Array
    angle: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Depths:
    """How far along its hole a part is: that of a beacon, or the magnetometer's.

    Parameters
    ----------
    readings : mapping of str to ndarray, shape (2, n)
        Times, increasing (s), and measured depths (m); linear in between, held beyond.
    """

    readings: Mapping[str, Array]

    def at(self, part: str, time: Array) -> Array | None:
        """Return the depths of a part at times (m); None where it has none."""
        known = self.readings.get(part)
        return None if known is None else np.interp(time, known[0], known[1])
