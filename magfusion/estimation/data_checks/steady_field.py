"""Whether the steady field, by the poses, is the Earth's as the site declares it.

One test for a state online and for a smoothed log.  What turns the field about the vertical alone
is a heading: the axes of the beacons' survey are not those of the declared field, and then places
are turned with them, about the origin of the world.
"""

from typing import NamedTuple

import numpy as np

from magfusion.model.once import once_a_site
from magfusion.model.perturbation import skew
from magfusion.model.physics.earth import AMBIENT_SHARE
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import DEGREE, Array

DOUBT = 5.0  # sigmas; of some fifty tests that are made for hours
EXPLAINED = 0.2  # share of what is left that a turn about the vertical may leave


class OffEarth(NamedTuple):
    """A steady field that is not the Earth's.

    Parameters
    ----------
    score : float
        Sigmas off.
    turn : float
        What attitudes may be off by (rad).
    of_survey : bool
        Whether a turn about the vertical explains it, and places may be turned, too.
    """

    finding: Finding
    score: float
    turn: float
    of_survey: bool

    def shift(self, position_world: Array) -> float:
        """Return what a place (m) may be off by (m)."""
        if not self.of_survey:
            return 0.0
        return 2.0 * np.sin(0.5 * self.turn) * float(np.linalg.norm(position_world[:2]))


def off_earth(site: Site, left_world: Array, rotation_cov_world: Array) -> OffEarth | None:
    """Judge what the mean steady field leaves beside the declared one.

    Parameters
    ----------
    left_world : ndarray, shape (3,)
        Measured less declared, at the estimated attitudes (T).
    rotation_cov_world : ndarray, shape (3, 3)
        Of those attitudes, world axes (rad^2).

    Returns
    -------
    OffEarth, optional
        None where it agrees, or none is declared.
    """
    earth = site.earth_field_world
    if earth is None:
        return None
    by_turn = skew(earth)
    cov = _declared_cov(site) + by_turn @ rotation_cov_world @ by_turn.T
    score = float(np.sqrt(left_world @ np.linalg.solve(cov, left_world)))
    if score < DOUBT:
        return None
    off, size = float(np.linalg.norm(left_world)), float(np.linalg.norm(earth))
    heading, rest = _heading(earth, earth + left_world)
    said = (
        f"The steady field differs from the declared Earth field by {1e6 * off:.2g} uT of"
        f" {1e6 * size:.2g} uT at the estimated attitude"
    )
    of_survey = rest < EXPLAINED * off
    if of_survey:
        text = (
            f"{said}, as if turned by {heading / DEGREE:+.0f} deg about the vertical: the axes of"
            " the beacons' survey are not those of earth_field_t (a north of another kind, east"
            " for north), a heading of the magnetometer's mounting, or iron that turns the field."
        )
    else:
        text = (
            f"{said}: axes or scale of the magnetometer, iron on the platform, or a wrong Earth"
            " field in the site."
        )
    turn = abs(heading) if of_survey else off / size
    return OffEarth(Finding("earth_field", text, weight=score / DOUBT), score, turn, of_survey)


@once_a_site
def _declared_cov(site: Site) -> Array:
    """Return the covariance of the steady field that the site declares, world axes (T^2)."""
    earth = site.earth_field_world
    assert earth is not None
    size, horizontal = float(np.linalg.norm(earth)), float(np.hypot(earth[0], earth[1]))
    east = np.array([-earth[1], earth[0], 0.0]) / max(horizontal, 1e-12)
    across = (site.earth.declination_sigma * horizontal) ** 2 * np.outer(east, east)
    return np.asarray(_usual(site, size) * np.eye(3) + across)


def _usual(site: Site, size: float) -> float:
    """Return the variance of each component that the site declares (T^2)."""
    sensor = site.platform.magnetometer.sigma
    usual = (site.earth.strength_sigma**2 + AMBIENT_SHARE**2) * size**2
    usual += float(np.max(sensor.matrix)) ** 2 * size**2 + float(np.max(sensor.offset)) ** 2
    return usual + (float(np.max(sensor.rotation_sensor)) * size) ** 2


def _heading(earth: Array, field: Array) -> tuple[float, float]:
    """Return the turn about the vertical between two fields (rad), and what it leaves (T)."""
    turn = float(np.arctan2(field[1], field[0]) - np.arctan2(earth[1], earth[0]))
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    cosine, sine = np.cos(turn), np.sin(turn)
    turned = np.array(
        [cosine * earth[0] - sine * earth[1], sine * earth[0] + cosine * earth[1], earth[2]]
    )
    return turn, float(np.linalg.norm(field - turned))
