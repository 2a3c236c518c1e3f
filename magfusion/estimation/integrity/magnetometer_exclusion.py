"""Exclusion of one of several magnetometers that is not as declared.

A wrong mounting, position or scale changes the trajectory. The faulty one is that without which the
solution fits far better to itself, to the inertial samples and to gravity.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.data_checks.magnetometers import without_magnetometer
from magfusion.estimation.demodulation.beacon_selection import select_detected
from magfusion.estimation.integrity.smoothed_separation import separate_smoothed
from magfusion.estimation.posterior.separation import SLACK
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk

MIN_MISFIT_RATIO = 2.0  # ratio of two misfits, from which one of them is reported

Solve = Callable[[Log, Site], Smoothed]


class Agreed(NamedTuple):
    """A log, its site and its solution without a magnetometer that contradicts the others."""

    log: Log
    site: Site
    result: Smoothed
    findings: tuple[Finding, ...]


def agreed(
    result: Smoothed, log: Log, site: Site, solve: Solve, plain: Solve, risk: Risk | None = None
) -> Agreed:
    """Return a solution without magnetometers that contradict the others.

    `solve`: returns the solution of a log and its site. `plain`: the same with noise and model
    error as declared, so that misfits are comparable.
    """
    risk = Risk() if risk is None else risk
    findings: list[Finding] = []
    while site.platform.further:
        estimate = separate_smoothed(result, by_magnetometer=True)
        worst = 0.0 if estimate is None else float(np.max(estimate.excess(risk, SLACK)))
        if worst <= 1.0:
            break
        sensors = site.platform.magnetometers
        misfits = []
        for which in range(len(sensors)):
            part = without_magnetometer(log, site, which)
            misfits.append(_misfit(plain, *part))
        order = np.argsort(misfits)
        names = ", ".join(sensor.name for sensor in sensors)
        if not misfits[order[1]] > MIN_MISFIT_RATIO * misfits[order[0]]:
            findings.append(_undecided(names, worst))
            break
        which = int(order[0])
        log, site = select_detected(*without_magnetometer(log, site, which))
        result = solve(log, site)
        findings.append(_excluded(sensors[which].name, names, worst))
    return Agreed(log, site, result, tuple(findings))


def agreed_smoothed(
    result: Smoothed, log: Log, site: Site, settings: SmootherSettings, risk: Risk | None = None
) -> Agreed:
    """Return the smoothed log without magnetometers that contradict the others."""
    if not site.platform.further:
        return Agreed(log, site, result, ())
    plain = replace(settings, tune=False)
    return agreed(
        result,
        log,
        site,
        lambda log, site: smooth(log, site, settings),
        lambda log, site: smooth(log, site, plain),
        risk,
    )


def _misfit(plain: Solve, log: Log, site: Site) -> float:
    """Return the misfit of a solution per number; infinite without a solution."""
    try:
        result = plain(log, site)
    except RuntimeError:  # GTSAM's for a singular system, or an EstimationError
        return np.inf
    return float(2.0 * result.cost / np.sum(np.isfinite(result.residual)))


def _excluded(name: str, names: str, worst: float) -> Finding:
    text = (
        f"Magnetometer {name} contradicts the others: with and without it the trajectory differs by"
        f" {worst:.3g} times what noise and survey explain, and without it all fits. It is not"
        f" used. Check its body_from_sensor, matrix, response and clock_offset_s (of {names})."
    )
    return Finding("magnetometer_excluded", text, weight=worst)


def _undecided(names: str, worst: float) -> Finding:
    text = (
        f"The magnetometers {names} contradict each other: the trajectory without one of them"
        f" differs by {worst:.3g} times what noise and survey explain; each fits equally well."
        " Check body_from_sensor, matrix, response and clock_offset_s of each, or add a third."
    )
    return Finding("magnetometers_contradict", text, weight=worst)
