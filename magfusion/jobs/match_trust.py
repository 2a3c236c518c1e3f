"""Trust in attitudes from the static field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Unverified, Verdict
from magfusion.papers.p001_magnetometer.matching import Matches
from magfusion.units import DEGREE, NANOTESLA, Array

if TYPE_CHECKING:
    from magfusion.jobs.attitude_database import Steady

MAX_UNDETERMINED = 0.05  # share of epochs that may be undetermined
OTHER_SIZE = 0.3  # of the Earth's field, by which it contradicts the site
EXPLAINED = 1.5  # residual by what is declared, as of whitened residuals
# Remaining degrees of freedom of a field vector for each number of estimated angles.
_DIMENSIONS = {"roll": 2, "roll-pitch": 1, "roll-pitch-yaw": 2}
_NAMES = ("roll", "pitch", "yaw")


def judge_matches(
    matches: Matches,
    angles: tuple[int, ...],
    field_world: Array | None,
    selected: Steady,
    site: Site,
    log: Log,
) -> tuple[Matches, Trust]:
    """Return matches with sigmas consistent with their residuals, and findings.

    `angles`: estimated angles, of roll, pitch and yaw. `field_world` (3,): the field assumed as
    exact (T); None with a database, which rejects unmatched fields by itself.
    """
    findings = [*_undetermined(matches), *recorded(log, site, BRIDGED_CODES)]
    unverified = []
    if field_world is not None:
        size, strength = float(np.linalg.norm(field_world)), site.earth.strength_sigma
        findings += _other_size(selected, size)
        rms = _residual(matches, angles)
        ratio = rms / selected.sigma
        if ratio > EXPLAINED:
            matches = replace(matches, sigma=ratio * matches.sigma)
        declared = float(
            np.linalg.norm([selected.sigma, _sensor_sigma(site, size), strength * size])
        )
        if rms > EXPLAINED * declared:
            findings.append(
                Finding(
                    "earth_field",
                    f"The matched field differs from the measured one by {rms / NANOTESLA:.3g} nT"
                    " (rms), declared for noise, calibration and the building's iron:"
                    f" {declared / NANOTESLA:.3g} nT. Calibrate the magnetometer, or check the"
                    " Earth field and the given angles. The sigmas are enlarged.",
                    weight=rms / declared,
                )
            )
        rotated = float(np.hypot(site.earth.declination_sigma, strength)) / DEGREE
        declination = site.earth.declination_sigma / DEGREE
        messages = f"{100.0 * strength:.2g} %, {declination:.2g} deg"
        unverified.append(Unverified("earth.field", messages, 0.0, rotated))
    given = [name for k, name in enumerate(_NAMES) if k not in angles]
    unverified += [Unverified(f"given.{name}", "0 deg", 0.0, 0.0) for name in given]
    return matches, Trust(tuple(findings), tuple(unverified))


def _residual(matches: Matches, angles: tuple[int, ...]) -> float:
    """Return the root mean square residual of a component (T)."""
    remaining = _DIMENSIONS["-".join(_NAMES[k] for k in angles)]
    own = matches.residual[:, 0][matches.determined[:, 0]]
    return float(np.sqrt(np.mean(own**2) / remaining)) if len(own) else 0.0


def _sensor_sigma(site: Site, size: float) -> float:
    """Return the declared uncertainty of the magnetometer's calibration, per component (T)."""
    sigma = site.platform.magnetometer.sigma
    matrix = float(np.sqrt(np.mean(np.sum(sigma.matrix**2, axis=1)))) * size
    return float(np.hypot(matrix, np.sqrt(np.mean(sigma.offset**2))))


def _undetermined(matches: Matches) -> Iterator[Finding]:
    count, missing = len(matches.determined), int(np.sum(~matches.determined[:, 0]))
    if missing > MAX_UNDETERMINED * count:
        yield Finding(
            "geometry",
            f"{missing} of {count} epochs have no attitude: the field is nearly parallel to the"
            " requested axes, is not in the database, or the platform moves. They are marked in"
            " attitude.parquet (determined); add gravity at rest (--gravity), or beacons.",
            weight=missing / count / MAX_UNDETERMINED,
        )
    both = int(np.sum(matches.ambiguous))
    if both:
        yield Finding(
            "ambiguous",
            f"In {both} of {count} epochs the field has two attitudes: the first is on the side of"
            " a level body, the second on the other.",
            Verdict.TRUSTWORTHY,
        )


def _other_size(selected: Steady, size: float) -> Iterator[Finding]:
    measured = float(np.median(np.linalg.norm(selected.field_body, axis=1)))
    off = max(measured / size, size / measured) - 1.0
    if off > OTHER_SIZE:
        yield Finding(
            "earth_field",
            f"The static field is {1e6 * measured:.3g} uT, but the site's Earth field is"
            f" {1e6 * size:.3g} uT: check the unit of magnetometer.parquet, the sensor's"
            " calibration, and the Earth field in the site.",
            Verdict.FAILED,
            off / OTHER_SIZE,
        )
