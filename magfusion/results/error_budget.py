"""Error budget of a position: which source of error contributes how much of its variance.

The covariance of the best estimate is a homogeneous function of degree one of the variances of all
sources, so that its derivatives by these add up to it (Euler).  Each derivative is the variance
that a source contributes with the gain of the estimate (P. S. Maybeck, Stochastic Models,
Estimation and Control 1, 1979, section 6.8).  All are recomputed by `coverage`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.model.site import Beacon, BeaconSigma, MagnetometerSigma, Site
from magfusion.results.coverage import coverage
from magfusion.units import Array, IntArray

STEP = 0.01  # of a variance, for its derivative
NEGLIGIBLE = 1e-4  # of a sigma: weights need some noise
DOMINANT = 0.5  # share of the variance, from which a source limits alone
MIN_BEACONS = 3  # in range; with fewer the geometry limits
ELONGATED = 3.0  # worst over median sigma, from which the geometry limits


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Variance of the position by source, at some points."""

    position_world: Array  # (n, 3) (m)
    sigma: Array  # (n,), position sigma with all sources (m)
    sources: tuple[str, ...]  # with any contribution
    variance: Array  # (n, sources), contribution of each (m^2); they add up to ``sigma**2``
    without: Array  # (n, sources), position sigma if a source vanished (m)

    @property
    def share(self) -> Array:
        """Share of each source in the variance, shape (n, sources)."""
        return self.variance / self.sigma[:, None] ** 2


def _of_magnetometers(site: Site, factor: float, *names: str) -> Site:
    def scaled(sigma: MagnetometerSigma) -> MagnetometerSigma:
        return replace(sigma, **{name: factor * getattr(sigma, name) for name in names})

    every = (replace(m, sigma=scaled(m.sigma)) for m in site.platform.magnetometers)
    return replace(site, platform=site.platform.with_magnetometers(tuple(every)))


def _of_beacons(site: Site, factor: float, name: str) -> Site:
    def scaled(sigma: BeaconSigma) -> BeaconSigma:
        return replace(sigma, **{name: factor * getattr(sigma, name)})

    return replace(site, beacons=tuple(replace(b, sigma=scaled(b.sigma)) for b in site.beacons))


def _noise(site: Site, factor: float) -> Site:
    factor = max(factor, NEGLIGIBLE)
    every = (
        replace(m, noise_density=factor * m.noise_density) for m in site.platform.magnetometers
    )
    return replace(site, platform=site.platform.with_magnetometers(tuple(every)))


def _model_error(site: Site, factor: float) -> Site:
    def scaled(beacon: Beacon) -> Beacon:
        own = beacon.model_error
        return beacon if own is None else replace(beacon, model_error=factor * own)

    beacons = tuple(map(scaled, site.beacons))
    return replace(site, model_error=factor * site.model_error, beacons=beacons)


def _ground(site: Site, factor: float) -> Site:
    return replace(site, log_conductivity_sigma=factor * site.log_conductivity_sigma)


SOURCES: dict[str, Callable[[Site, float], Site]] = {
    "noise": _noise,
    "model error": _model_error,
    "beacon positions": lambda site, f: _of_beacons(site, f, "position_world"),
    "beacon axes": lambda site, f: _of_beacons(site, f, "rotation_beacon"),
    "beacon moments": lambda site, f: _of_beacons(site, f, "log_moment"),
    "magnetometer": lambda site, f: _of_magnetometers(site, f, "matrix", "rotation_sensor"),
    "lever arm": lambda site, f: _of_magnetometers(site, f, "position_body"),
    "ground": _ground,
}
"""Name of each source, and the site with its sigmas multiplied by a factor."""

REMEDIES = {
    "noise": "a larger moment, more beacons, or a longer --window",
    "model error": "less iron near the beacons, a field map, or more beacons",
    "beacon positions": "a better survey of the beacons' positions",
    "beacon axes": "a better survey of the beacons' axes",
    "beacon moments": "measured currents, or calibrate beacon",
    "magnetometer": "calibrate magnetometer",
    "lever arm": "a measured position of the magnetometer on the platform",
    "ground": "a measured conductivity",
}
"""What reduces each source."""


def error_budget(site: Site, position_world: Array, window: float) -> ErrorBudget:
    """Return the variance by source at some points.

    `position_world` (n, 3): where the position is determined (m). `window`: averaging time of the
    tones (s).
    """

    def sigma(source: str, factor: float) -> Array:
        return coverage(SOURCES[source](site, factor), position_world, window).position_sigma

    whole = coverage(site, position_world, window).position_sigma
    low, high = np.sqrt(1.0 - STEP), np.sqrt(1.0 + STEP)
    every = np.column_stack(
        [(sigma(one, high) ** 2 - sigma(one, low) ** 2) / (2.0 * STEP) for one in SOURCES]
    )
    own = np.flatnonzero(np.any(every > 1e-6 * whole[:, None] ** 2, axis=0))
    names = tuple(SOURCES)
    sources = tuple(names[k] for k in own)
    without = np.column_stack([sigma(one, 0.0) for one in sources])
    return ErrorBudget(position_world, whole, sources, np.maximum(every[:, own], 0.0), without)


def limiting(budget: ErrorBudget, row: int, beacons: IntArray) -> str:
    """Return what limits the position at a point, and the remedy, as a sentence.

    `row`: of the point. `beacons` (n,): number of beacons detected at each point.
    """
    share = budget.share[row]
    order = np.argsort(-share)
    first = budget.sources[order[0]]
    x, y, z = budget.position_world[row]
    where = f"At ({x:.3g}, {y:.3g}, {z:.3g}) m, where the position is least certain,"
    if beacons[row] < MIN_BEACONS or budget.sigma[row] > ELONGATED * np.median(budget.sigma):
        return (
            f"{where} the geometry limits: {beacons[row]} beacons are in range, and {first} has"
            f" {100.0 * share[order[0]]:.0f} % of the variance. Place a beacon near it."
        )
    listed = [f"{budget.sources[k]} {100.0 * share[k]:.0f} %" for k in order[:3]]
    what = first if share[order[0]] >= DOMINANT else f"{first} and {budget.sources[order[1]]}"
    remedy = REMEDIES[first]
    shares = f"{', '.join(listed)} of the variance"
    return f"{where} it is limited by {what} ({shares}): {remedy} helps most."
