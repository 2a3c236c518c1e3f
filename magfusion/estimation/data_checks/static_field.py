"""Consistency of the static field with the declared Earth field, at estimated poses.

One test for a running state and for a smoothed log.  A rotation about the vertical only is a
heading error: the axes of the beacons' survey differ from those of the declared field, and
positions are rotated with them about the world's origin.
"""

from typing import NamedTuple

import numpy as np

from magfusion.model.once import once_a_site
from magfusion.model.perturbation import skew
from magfusion.model.physics.earth import AMBIENT_SHARE
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import DEGREE, Array

DOUBT = 5.0  # sigmas; for some fifty tests repeated for hours
EXPLAINED = 0.2  # share of the residual that may remain after a rotation about the vertical


class OffEarth(NamedTuple):
    """A static field that is not the Earth's."""

    finding: Finding
    score: float  # deviation in sigmas
    turn: float  # possible attitude error (rad)
    # whether a rotation about the vertical explains it, so that positions may be rotated, too
    of_survey: bool

    def shift(self, position_world: Array) -> float:
        """Return the possible position error at a position (m) (m)."""
        if not self.of_survey:
            return 0.0
        return 2.0 * np.sin(0.5 * self.turn) * float(np.linalg.norm(position_world[:2]))


def off_earth(site: Site, left_world: Array, rotation_cov_world: Array) -> OffEarth | None:
    """Test the mean static field against the declared Earth field.

    `left_world` (3,): measured less declared, at the estimated attitudes (T).
    `rotation_cov_world` (3, 3): of those attitudes, world axes (rad^2). Returns None where it
    agrees, or none is declared.
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
    findings = (
        f"The static field differs from the declared Earth field by {1e6 * off:.2g} uT of"
        f" {1e6 * size:.2g} uT at the estimated attitude"
    )
    of_survey = rest < EXPLAINED * off
    if of_survey:
        text = (
            f"{findings}, as if rotated by {heading / DEGREE:+.0f} deg about the vertical. Check"
            " the axes of earth_field_t and of the beacons' survey (true, grid or magnetic north,"
            " east for north), the magnetometer's mounting (heading), and iron near it."
        )
    else:
        text = (
            f"{findings}. Check the magnetometer's axes and scale, iron on the platform, and"
            " earth_field_t."
        )
    turn = abs(heading) if of_survey else off / size
    return OffEarth(Finding("earth_field", text, weight=score / DOUBT), score, turn, of_survey)


@once_a_site
def _declared_cov(site: Site) -> Array:
    """Return the covariance of the static field that the site declares, world axes (T^2)."""
    earth = site.earth_field_world
    assert earth is not None
    size, horizontal = float(np.linalg.norm(earth)), float(np.hypot(earth[0], earth[1]))
    east = np.array([-earth[1], earth[0], 0.0]) / max(horizontal, 1e-12)
    across = (site.earth.declination_sigma * horizontal) ** 2 * np.outer(east, east)
    return np.asarray(_usual(site, size) * np.eye(3) + across)


def _usual(site: Site, size: float) -> float:
    """Return the declared variance of each component (T^2)."""
    sensor = site.platform.magnetometer.sigma
    usual = (site.earth.strength_sigma**2 + AMBIENT_SHARE**2) * size**2
    usual += float(np.max(sensor.matrix)) ** 2 * size**2 + float(np.max(sensor.offset)) ** 2
    return usual + (float(np.max(sensor.rotation_sensor)) * size) ** 2


def _heading(earth: Array, field: Array) -> tuple[float, float]:
    """Return the rotation about the vertical between two fields (rad), and the residual (T)."""
    turn = float(np.arctan2(field[1], field[0]) - np.arctan2(earth[1], earth[0]))
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    cosine, sine = np.cos(turn), np.sin(turn)
    rotated = np.array(
        [cosine * earth[0] - sine * earth[1], sine * earth[0] + cosine * earth[1], earth[2]]
    )
    return turn, float(np.linalg.norm(field - rotated))
