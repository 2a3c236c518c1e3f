"""Disturbances of the beacons' field in a real room: iron, day and night noise, and slow drift."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.errors import InputError
from magfusion.model.physics.disturbance import induced_field, sphere_polarizability
from magfusion.simulation.atmosphere import Atmosphere
from magfusion.simulation.layers import Layers
from magfusion.simulation.pipe import STEEL_CONDUCTIVITY, STEEL_PERMEABILITY, Steel
from magfusion.simulation.steel import SteelStructure
from magfusion.units import DAY, AnyArray, Array, ComplexArray

NOISIEST_TIME = 14.0 * 3600.0  # s of a day
CLEARANCE = 0.5  # m from the surface of drawn iron to where the body moves, and to every beacon
REACH = 0.5  # m beyond that clearance within which iron is drawn where nothing is said
_ATTEMPTS = 200  # to place one sphere
_FEATURES = 512
_POINTS = 4096  # of which that many features are held at once


@dataclass(frozen=True, eq=False)
class Spheres:
    """Permeable or conducting spheres, with an induced field at every tone."""

    position_world: Array  # (n, 3) (m)
    radius: Array  # (n,) (m)
    permeability: Array  # (n,), relative
    conductivity: Array  # (n,) (S/m)

    def __len__(self) -> int:
        return len(self.radius)

    def secondary_world(
        self, primary_world: ComplexArray, frequencies_hz: Array, point_world: Array
    ) -> ComplexArray:
        """Return the phasors that the spheres add at points.

        `primary_world` (spheres, tones, 3): at the spheres' centres (T). `frequencies_hz` (tones,),
        `point_world` (n, 3) (m). Returns (n, tones, 3) (T). Raises InputError if a point lies
        inside a sphere.
        """
        for k, (place, radius) in enumerate(zip(self.position_world, self.radius, strict=True)):
            square = np.sum((point_world - place) ** 2, axis=1)
            if np.any(square < radius**2):
                raise InputError(
                    f"spheres: the magnetometer passes through sphere {k} of radius {radius:g} m at"
                    f" {np.round(place, 3).tolist()}; move the sphere"
                )
        polarizability = sphere_polarizability(
            self.radius[:, None],
            self.permeability[:, None],
            self.conductivity[:, None],
            2.0 * np.pi * frequencies_hz,
        )
        return induced_field(point_world, self.position_world, polarizability, primary_world)


def draw_spheres(
    rng: np.random.Generator,
    count: int,
    box_world: Array,
    beacons_world: Array,
    radius_range: tuple[float, float] = (0.1, 0.3),
    permeability: float = STEEL_PERMEABILITY,
    conductivity: float = STEEL_CONDUCTIVITY,
    reach: float = REACH,
) -> Spheres:
    """Return spheres around a box, none near it, near a beacon or in another.

    The surface of each is at least `CLEARANCE` from the box and from every beacon's centre; its
    centre is drawn uniformly from the box enlarged by its radius, `CLEARANCE` and ``reach`` on all
    sides. `box_world` (2, 3): lower and upper corner (m) of the body's range.
    `beacons_world` (beacons, 3) (m). `radius_range`: radii are drawn uniformly between these (m).
    `permeability`, `conductivity`: of all spheres (relative; S/m). `reach` (m). Raises InputError
    if so many do not fit.
    """
    radius = rng.uniform(*radius_range, count)
    position_world = np.zeros((count, 3))
    for k in range(count):
        grown = radius[k] + CLEARANCE + reach
        drawn = rng.uniform(box_world[0] - grown, box_world[1] + grown, (_ATTEMPTS, 3))
        to_box = np.linalg.norm(drawn - np.clip(drawn, box_world[0], box_world[1]), axis=1)
        free_parameters = _farther(
            drawn, beacons_world, np.full(len(beacons_world), radius[k] + CLEARANCE)
        )
        free_parameters &= _farther(drawn, position_world[:k], radius[k] + radius[:k])
        fits = np.flatnonzero(free_parameters & (to_box > radius[k] + CLEARANCE))
        if len(fits) == 0:
            raise InputError(
                f"iron: found {count} spheres, but only {k} fit around the range of the body; give"
                " fewer, or a larger box"
            )
        position_world[k] = drawn[fits[0]]
    return Spheres(
        position_world, radius, np.full(count, permeability), np.full(count, conductivity)
    )


def _farther(point: Array, others: Array, least: Array) -> np.ndarray:
    """Return which points are farther from all others than the minimum distance of each."""
    between = np.linalg.norm(point[:, None] - others, axis=-1)
    return (between > least).all(axis=1)


@dataclass(frozen=True, eq=False)
class SmoothField:
    """Gaussian random functions of position (or time), with a Gaussian covariance.

    Sums of waves with random vectors and amplitudes (random Fourier features): for any two places
    at distance d the covariance is ``rms^2 exp(-d^2 / (2 length^2))`` in the mean over draws.
    """

    wave: Array  # (features, dimension), wave vectors (rad per unit)
    # cosine, sine: (features, functions), amplitudes
    cosine: Array
    sine: Array

    def __call__(self, place: Array) -> Array:
        """Return the functions' values, shape (n, functions), at places (n, dimension)."""
        angle = place @ self.wave.T
        return np.cos(angle) @ self.cosine + np.sin(angle) @ self.sine


def draw_smooth(
    rng: np.random.Generator, rms: float, length: float, functions: int, dimension: int = 3
) -> SmoothField:
    """Return independent random functions.

    `rms`: of each function's value at a place, over draws. `length`: of correlation, in the unit of
    the places.
    """
    wave = rng.standard_normal((_FEATURES, dimension)) / length
    amplitude = rng.standard_normal((2, _FEATURES, functions)) * rms / np.sqrt(_FEATURES)
    return SmoothField(wave, amplitude[0], amplitude[1])


@dataclass(frozen=True, eq=False)
class Bending:
    """A smooth random 3 x 3 matrix per beacon and position, added to unity."""

    # of place (m), world axes; nine functions a beacon, the matrix's rows one after the other
    matrix: SmoothField

    def bent_world(self, beacon: int, phasors_world: ComplexArray, point_world: Array) -> AnyArray:
        """Return the phasors (n, tones, 3) of a beacon, by its number, at points (n, 3)."""
        own = slice(9 * beacon, 9 * beacon + 9)
        one = SmoothField(self.matrix.wave, self.matrix.cosine[:, own], self.matrix.sine[:, own])
        bent = np.array(phasors_world)
        for first in range(0, len(point_world), _POINTS):
            few = slice(first, first + _POINTS)
            matrix = one(point_world[few]).reshape(-1, 3, 3)
            bent[few] += np.einsum("nij,ntj->nti", matrix, phasors_world[few])
        return bent


def draw_bending(rng: np.random.Generator, rms: float, length: float, beacons: int) -> Bending:
    """Return a random bending.

    `rms`: deviation relative to the field's magnitude. `length`: correlation length (m).
    """
    return Bending(draw_smooth(rng, rms / np.sqrt(3.0), length, 9 * beacons))


@dataclass(frozen=True)
class DayNight:
    """White ambient noise, weak at night and strong by day, along a cosine."""

    # night, day: minimum and maximum one-sided density (T/sqrt(Hz))
    night: float
    day: float
    noisiest_time: float = 0.0  # time of the maximum, seconds since the log's epoch; once a day

    def density(self, time: Array) -> Array:
        """Return the one-sided density (T/sqrt(Hz)) at the times, shape (n,)."""
        share = 0.5 + 0.5 * np.cos(2.0 * np.pi * (time - self.noisiest_time) / DAY)
        return self.night + (self.day - self.night) * share


def office_noise(epoch_ns: int) -> DayNight:
    """Return 2 nT rms of 200 samples a second at night and 4 nT at two in the afternoon (UTC).

    Paper 004 has 3 nT.
    """
    midnight = epoch_ns / 1e9 % DAY
    return DayNight(2e-10, 4e-10, (NOISIEST_TIME - midnight) % DAY)


@dataclass(frozen=True)
class FieldDrift:
    """Slow, smooth, random change of the field at rest."""

    rms: float  # of each world component (T)
    time: float  # of correlation (s)


@dataclass(frozen=True, eq=False)
class Ambient:
    """Disturbances other than beacons, Earth and mains; None where absent."""

    spheres: Spheres | None = None
    bending: Bending | None = None
    day_night: DayNight | None = None
    drift: FieldDrift | None = None
    layers: Layers | None = None
    atmosphere: Atmosphere | None = None
    rails: Steel | SteelStructure | None = None

    def background_world(self, time: Array, rate_hz: float, rng: np.random.Generator) -> Array:
        """Return noise and drift at the samples of an instrument.

        `time` (n,) (s). Returns (n, 3) (T).
        """
        field_world = np.zeros((len(time), 3))
        if self.day_night is not None:
            sigma = self.day_night.density(time) * np.sqrt(rate_hz / 2.0)
            field_world += sigma[:, None] * rng.standard_normal(field_world.shape)
        if self.drift is not None:
            field_world += _drift_world(self.drift, time, rng)
        if self.atmosphere is not None:
            field_world += self.atmosphere.field_world(time)
        return field_world


def _drift_world(drift: FieldDrift, time: Array, rng: np.random.Generator) -> Array:
    """Return the drift at times (n,), by a cubic spline through fifty knots a correlation time."""
    smooth = draw_smooth(rng, drift.rms, drift.time, 3, dimension=1)
    span = float(time[-1] - time[0])
    knots = np.linspace(time[0], time[-1], 4 + int(np.ceil(50.0 * span / drift.time)))
    if len(knots) >= len(time):
        return smooth(time[:, None])
    return CubicSpline(knots, smooth(knots[:, None]))(time)
