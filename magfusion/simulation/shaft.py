"""True rotation of a magnet on a shaft: the moment itself, as a function of angle.

The two coils in quadrature of the rotor's estimation model are not used here.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.model.rotor import Rotor
from magfusion.units import Array, ComplexArray

POINTS, ORDERS = 64, 4  # of a turn, and of its angle, from steady on, beside the harmonics
NEGLIGIBLE = 1e-6  # of the moment
MIN_DRIFT_TIME = 1.0  # s


@dataclass(frozen=True, eq=False)
class Shaft:
    """True rotation of a magnet, in addition to what its site declares."""

    angle_start: float = 0.3  # (rad)
    drift_hz: float = 0.05  # root mean square of the speed about its mean
    drift_time: float = 20.0  # of correlation (s)
    slip: float = 0.0  # amplitude of the angle's error twice per turn, as of a bent joint (rad)
    slip_phase: float = 0.0  # (rad)
    whirl: float = 0.0  # angle of the shaft's axis in backward whirl (rad)
    length: float = 0.3  # of the stack of magnets along the shaft (m)
    encoder_sigma: float = 2e-3  # of a recorded angle (rad)


@dataclass(frozen=True)
class ShaftErrors:
    """Rotation errors of shafts in addition to the declared, and their record."""

    # root mean square of the speed about its mean; by default the rotor's ``speed_sigma_hz``
    drift_hz: float | None = None
    whirl: float = 0.0  # (rad)
    encoder: bool = True  # whether angles are recorded
    encoder_sigma: float = 2e-3  # (rad)


def draw_shaft(rotor: Rotor, errors: ShaftErrors, rng: np.random.Generator) -> Shaft:
    """Draw a rotation: an angle error twice per turn makes an ellipse of half its size."""
    rms = rotor.speed_sigma_hz if errors.drift_hz is None else errors.drift_hz
    first, second = 2.0 * rotor.ellipse_sigma * rng.standard_normal(2)
    return Shaft(
        angle_start=float(rng.uniform(0.0, 2.0 * np.pi)),
        drift_hz=rms,
        drift_time=max(2.0 * (rms / rotor.speed_walk_hz_rts) ** 2, MIN_DRIFT_TIME),
        slip=float(np.hypot(first, second)),
        slip_phase=float(np.arctan2(second, first)),
        whirl=errors.whirl,
        length=rotor.length,
        encoder_sigma=errors.encoder_sigma,
    )


def turned_moment(rotor: Rotor, shaft: Shaft, angle: Array) -> Array:
    """Return the moment at angles of the shaft, rotor axes, shape (n, 3) (A m^2)."""
    axis, zero = rotor.axis_beacon, rotor.zero_beacon
    across = np.cross(axis, zero)
    true = (angle + shaft.slip * np.sin(2.0 * angle + shaft.slip_phase))[:, None]
    moment = np.cos(rotor.tilt) * (zero * np.cos(true) + across * np.sin(true))
    moment = rotor.moment * (moment + np.sin(rotor.tilt) * axis)
    for one in rotor.harmonics:
        moment = moment + np.cos(one.order * true + one.phase) * one.moment_beacon
    # Backward whirl: the shaft leans by a small angle about a direction that rotates against it.
    lean = shaft.whirl * (zero * np.cos(angle)[:, None] - across * np.sin(angle)[:, None])
    size = np.linalg.norm(lean, axis=1, keepdims=True)
    if not shaft.whirl:
        return moment
    unit = lean / size
    crossed = np.cross(unit, moment)
    along = np.sum(unit * moment, axis=1, keepdims=True)
    return np.cos(size) * moment + np.sin(size) * crossed + (1.0 - np.cos(size)) * along * unit


def shaft_course(
    shaft: Shaft, frequency_hz: float, first: float, last: float, rng: np.random.Generator
) -> Callable[[Array], Array]:
    """Return the angle of a shaft whose speed drifts, without jumps (rad), by time (s)."""
    knots = np.arange(first, last + 2.0, 0.25)
    keep = np.exp(-0.25 / shaft.drift_time)
    kick = shaft.drift_hz * np.sqrt(1.0 - keep**2) * rng.standard_normal(len(knots))
    drift = np.empty(len(knots))
    drift[0] = shaft.drift_hz * rng.standard_normal()
    for k in range(1, len(knots)):
        drift[k] = keep * drift[k - 1] + kick[k]
    rotated = CubicSpline(knots, frequency_hz + drift).antiderivative()

    def angle(time: Array) -> Array:
        return np.asarray(shaft.angle_start + 2.0 * np.pi * (rotated(time) - rotated(first)))

    return angle


def shaft_angle(shaft: Shaft, frequency_hz: float, time: Array, rng: np.random.Generator) -> Array:
    """Return the angle of a shaft whose speed drifts at times (n,) (s), without jumps (rad)."""
    return shaft_course(shaft, frequency_hz, float(time[0]), float(time[-1]), rng)(time)


def moment_orders(rotor: Rotor, shaft: Shaft) -> dict[int, ComplexArray]:
    """Return the moment's phasor in each order of the angle, rotor axes, (3,) (A m^2)."""
    orders = max((ORDERS, *(one.order + 2 for one in rotor.harmonics)))
    points = max(POINTS, 4 * orders)
    angle = 2.0 * np.pi * np.arange(points) / points
    moment = turned_moment(rotor, shaft, angle)
    out = {}
    for order in range(orders):
        twice = 1.0 if order == 0 else 2.0
        part = twice * np.mean(moment * np.exp(-1j * order * angle)[:, None], axis=0)
        if np.linalg.norm(part) > NEGLIGIBLE * rotor.moment:
            out[order] = part
    return out
