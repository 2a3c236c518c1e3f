"""Whether calibrated antennas are to be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from magfusion.calibration.antenna import AntennaFit
    from magfusion.results.figures import Estimate

WORSE = 1.5  # errors at poses left out, by those of the declared antenna


def judged(
    fit: AntennaFit,
    estimates: list[Estimate],
    open_directions: Sequence[str],
    before: tuple[Array, Array],
    after: tuple[Array, Array],
) -> tuple[AntennaFit, Trust]:
    """Return a fit with a covariance that its witnesses allow, and what they say.

    Parameters
    ----------
    open_directions : sequence of str
        What the poses do not determine, in words.
    before, after : (ndarray, ndarray)
        Errors of attitude (rad) and position (m) of each pose by the declared antenna, and by one
        that was fitted without the pose.
    """
    from magfusion.estimation.integrity.priors import contradiction, trust_of, unexplained

    fitted = unexplained(
        "the couplings",
        float(fit.chi2),
        fit.dof,
        "Check the survey's poses, their sigmas (--pose-rotation-deg, --pose-position-m) and metal"
        " near the antennas.",
    )
    prior = np.diag([one.prior_sigma**2 for one in estimates])
    moved = contradiction(
        [one.key for one in estimates],
        np.array([one.change for one in estimates]),
        prior - fit.cov / fitted.excess,
        prior,
        "Check moments, wiring and frames of the tracker in the site.",
    )
    findings = []
    for what, worse, better, size, unit in (
        ("attitude", after[0], before[0], DEGREE, "deg"),
        ("position", after[1], before[1], 1e-3, "mm"),
    ):
        ratio = _rms(worse) / _rms(better)
        if ratio > WORSE:
            text = (
                f"At poses that an antenna was not fitted to, its {what} errs by"
                f" {_rms(worse) / size:.2g} {unit}, and the declared one by"
                f" {_rms(better) / size:.2g}: survey more poses, or keep the declared antenna."
            )
            findings.append(Finding("transfer", text, weight=ratio))
    if open_directions:
        text = (
            f"These poses do not determine {', '.join(open_directions)}: the declared values"
            " and wide sigmas are kept there."
        )
        findings.append(Finding("geometry", text, Verdict.TRUSTWORTHY))
    trust, excess = trust_of(fitted, moved)
    return replace(fit, cov=excess * fit.cov), trust | Trust(tuple(findings))


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))
