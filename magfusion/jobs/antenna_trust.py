"""Trust in calibrated antennas."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magfusion.estimation.snapshot.priors import contradiction, trust_of, unexplained
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import ParameterEstimate
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from magfusion.calibration.antenna import AntennaFit
    from magfusion.calibration.antenna_tracking import PoseErrors
    from magfusion.jobs.antenna_fit import AntennaSolution

MAX_ERROR_RATIO = 2.0  # expected errors in any attitude, by those at surveyed poses
WORSE = 1.5  # errors at poses left out, by those of the declared antenna


def judge_fit(
    result: AntennaSolution,
    estimates: list[ParameterEstimate],
    errors: tuple[PoseErrors, PoseErrors] | None,
) -> tuple[AntennaFit, Trust]:
    """Return a fit with a covariance consistent with its tests, and their findings.

    `errors`: of fixes at surveyed poses with the declared antenna, and with one fitted without the
    pose; None without a survey.
    """
    fit = result.fit
    fitted = unexplained(
        "the couplings" if errors else "the probe's readings",
        float(fit.chi2),
        fit.dof,
        "Check the poses, their sigmas (--pose-rotation-deg, --pose-position-m,"
        " --probe-position-m, --probe-tilt-deg) and metal near the antennas.",
    )
    prior = np.diag([one.prior_sigma**2 for one in estimates])
    moved = contradiction(
        [one.key for one in estimates],
        np.array([one.change for one in estimates]),
        prior - (fit.cov / fitted.excess)[: len(prior), : len(prior)],
        prior,
        "Check moments, wiring and frames of the tracker in the site.",
    )
    findings = _transferred(*errors) if errors else []
    if result.observed is not None and result.observed.null_space:
        text = (
            f"These poses do not determine {', '.join(result.observed.null_space)}: the declared"
            " values and wide sigmas are kept."
        )
        findings.append(Finding("geometry", text, Verdict.TRUSTWORTHY))
    if errors and result.elsewhere is not None:
        findings += _in_other_attitudes(result.elsewhere, errors[1])
    if errors is None:
        findings += _of_probe(result, estimates)
    trust, excess = trust_of(fitted, moved)
    return replace(fit, cov=excess * fit.cov), trust | Trust(tuple(findings))


def _transferred(before: PoseErrors, after: PoseErrors) -> list[Finding]:
    """Return whether fixes are worse than with the declared antenna."""
    findings = []
    for k, (what, size, unit) in enumerate((("attitude", DEGREE, "deg"), ("position", 1e-3, "mm"))):
        ratio = float(after.rms[k] / before.rms[k])
        certain = after.rms[k] - before.rms[k] > 2.0 * float(
            np.hypot(after.rms_sigma[k], before.rms_sigma[k])
        )
        if ratio > WORSE and certain:
            text = (
                f"At poses not used in the fit, the {what} error of the antenna is"
                f" {after.rms[k] / size:.2g} {unit}, that of the declared one"
                f" {before.rms[k] / size:.2g}: survey more poses, or keep the declared antenna."
            )
            findings.append(Finding("transfer", text, weight=ratio))
    return findings


def _in_other_attitudes(elsewhere: Array, after: PoseErrors) -> list[Finding]:
    """Return whether fixes are predicted to be worse in attitudes that were not surveyed."""
    ratio = elsewhere / np.maximum(after.rms, 1e-12)
    if float(np.max(ratio)) <= MAX_ERROR_RATIO:
        return []
    (turn, place), (rotated, placed) = elsewhere, after.rms
    text = (
        f"The surveyed attitudes are too similar: predicted errors of fixes in other attitudes are"
        f" {turn / DEGREE:.2g} deg and {1e3 * place:.2g} mm, in the surveyed ones"
        f" {rotated / DEGREE:.2g} deg and {1e3 * placed:.2g} mm. Survey attitudes rotated about all"
        " axes."
    )
    return [Finding("transfer", text, weight=float(np.max(ratio)) / MAX_ERROR_RATIO)]


def _of_probe(result: AntennaSolution, estimates: list[ParameterEstimate]) -> list[Finding]:
    """Return what the probe's readings do not determine, and that no pose was tested."""
    own = tuple(f"{side}." for side in result.probed)
    open_ones = [e.key for e in estimates if e.key.startswith(own) and not e.determined]
    findings = []
    if open_ones:
        text = (
            f"The probe's readings do not determine {', '.join(open_ones)}: the declared values and"
            " wide sigmas are kept. Read the points on each coil's own axis too, or rotate the"
            " probe to its other axes."
        )
        findings.append(Finding("geometry", text, Verdict.TRUSTWORTHY))
    text = (
        "No pose was tested: the errors of fixes with these antennas are unknown. Give a survey of"
        f" some known poses with --probe ({', '.join(sorted(result.probed))} read)."
    )
    return [*findings, Finding("few_data", text, Verdict.TRUSTWORTHY)]
