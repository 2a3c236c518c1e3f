"""Findings on the calibration of a magnetometer, against its prior and the declared field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magfusion.calibration.magnetometer import field_from_measured, refined
from magfusion.errors import EstimationError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.data_checks.gyro_field_consistency import left_handed_field
from magfusion.estimation.data_checks.samples import clipped_samples
from magfusion.estimation.snapshot.priors import Contradiction, contradiction, trust_of
from magfusion.model.samples import Log
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import ParameterEstimate
from magfusion.units import NANOTESLA, Array

if TYPE_CHECKING:
    from magfusion.calibration.magnetometer_log import LogCalibration

SCALE = 0.3  # of the matrix, by which it contradicts the site, however wide its sigmas
SCALE_SIGMAS, MIN_SCALE = 5.0, 0.01  # of the declared sigma; and what is never an error
FIRST = 1e3  # weight of what is the cause of other findings
LOOSE = 0.02  # of the field; an offset that is no more certain than that is not determined
USELESS = 0.06  # and here nothing is gained by it: three degrees of heading
MIN_FIELD, MAX_FIELD = 1.5e-5, 1e-4  # T; the Earth's field, with what steel does to it
_AXES = "xyz"


def calibrated_field(calibration: LogCalibration, magnetometer: Magnetometer) -> Array:
    """Return the field of the readings by a magnetometer, shape (n, 3) (T)."""
    measured = calibration.readings.measured_sensor
    return field_from_measured(measured, magnetometer.matrix, magnetometer.offset)


def estimates_of(calibration: LogCalibration, declared: Magnetometer) -> list[ParameterEstimate]:
    """Return the twelve estimated parameters, with those declared in a site."""
    fit, prior = calibration.graph.fit, calibration.prior
    names = [f"magnetometer.matrix_{row}{column}" for row in _AXES for column in _AXES]
    names += [f"magnetometer.offset_nt_{axis}" for axis in _AXES]
    vectors = [("magnetometer.matrix", "", 1.0)] * 9
    vectors += [("magnetometer.offset", "nT", NANOTESLA)] * 3
    change = np.concatenate([(fit.matrix - declared.matrix).ravel(), fit.offset - declared.offset])
    former = np.concatenate([declared.matrix.ravel(), declared.offset])
    variances = np.diagonal(fit.cov), np.diagonal(prior.cov)
    loose = np.full(12, np.inf)
    loose[9:] = LOOSE * float(np.linalg.norm(prior.field_world))
    rows = zip(names, vectors, change, *variances, former, loose, strict=True)
    return [
        ParameterEstimate(
            name,
            float(moved / scale),
            unit,
            label=label,
            sigma=float(np.sqrt(variance) / scale),
            prior_sigma=float(np.sqrt(before) / scale),
            is_open=bool(variance > limit**2),
            declared=float(value / scale),
        )
        for name, (label, unit, scale), moved, variance, before, value, limit in rows
    ]


def calibrated(log: Log, site: Site, *, positions: bool = False) -> tuple[LogCalibration, Trust]:
    """Return the calibration from a log's waveform, and findings on it."""
    from magfusion.calibration.magnetometer_log import calibrate_log
    from magfusion.calibration.magnetometer_size import calibrate_alone

    assert log.waveform is not None
    try:
        if log.inertial:
            result = calibrate_log(log.waveform, log.imu, site, at_stops=positions)
        else:
            result = calibrate_alone(log.waveform, site)
    except EstimationError as failure:
        cause = next(_failure_causes(log, site), None)
        if cause is None:
            raise
        raise EstimationError(cause.text.rstrip(".")) from failure
    return judge_calibration(result, site, log)


def _failure_causes(log: Log, site: Site) -> Iterator[Finding]:
    """Yield what spoils the readings of a calibration that finds no solution."""
    yield from (one for one in clipped_samples(log, site) if one.text.startswith("magnetometer"))
    left_handed = left_handed_field(log, site) if log.inertial else None
    if left_handed is not None:
        yield left_handed


def judge_calibration(
    calibration: LogCalibration, site: Site, log: Log
) -> tuple[LogCalibration, Trust]:
    """Return a calibration with sigmas consistent with its tests, and their findings."""
    declared, prior, fit = site.platform.magnetometer, calibration.prior, calibration.graph.fit
    estimates = estimates_of(calibration, declared)
    change = np.concatenate([(fit.matrix - declared.matrix).ravel(), fit.offset - declared.offset])
    own = contradiction(
        [one.key for one in estimates],
        change,
        prior.cov - fit.cov,
        prior.cov,
        "Declare larger sigmas if the sensor was not calibrated before; else check its mounting.",
    )
    trust, excess = trust_of(own, _declared_difference(calibration))
    honest = replace(fit, cov=excess * fit.cov)
    calibration = replace(
        calibration,
        graph=replace(calibration.graph, fit=honest),
        magnetometer=refined(declared, honest),
    )
    platform = replace(site.platform, magnetometer=calibration.magnetometer)
    streams = recorded(log, replace(site, platform=platform), BRIDGED_CODES)
    return calibration, trust | Trust(
        (*_doubts(calibration, site, log), *_remarks(calibration, log), *streams)
    )


def _declared_difference(calibration: LogCalibration) -> Contradiction:
    """Return whether the other estimated parameters contradict the site."""
    graph, prior = calibration.graph, calibration.prior
    names = ["earth.dip", *(f"imu.{k}_bias_{axis}" for k in ("accel", "gyro") for axis in _AXES)]
    change = np.concatenate([[graph.dip_change], graph.accel_bias_body, graph.gyro_bias_body])
    sigma = np.repeat([prior.dip_sigma, prior.accel_bias_sigma, prior.gyro_bias_sigma], [1, 3, 3])
    cov = np.diag(sigma**2)
    remedy = (
        "Check the Earth field and the mounting in the site, and that the specific force includes"
        " gravity; rotate more slowly, away from iron."
    )
    return contradiction(names, change, cov, cov, remedy, "The other estimated parameters")


def _doubts(calibration: LogCalibration, site: Site, log: Log) -> Iterator[Finding]:
    yield from _of_another_scale(calibration, site, log)
    if calibration.rival is not None:
        own, other = (_microtesla(b) for b in (calibration.magnetometer.offset, calibration.rival))
        yield Finding(
            "ambiguous",
            f"Two offsets fit the readings, {own} and {other} uT, mirror images of each other: the"
            " sensor was rotated about one axis only. Rotate it about a second axis.",
            Verdict.FAILED,
        )
    yield from _of_another_size(calibration, site)
    sigma = float(np.max(calibration.magnetometer.sigma.offset))
    size = float(np.linalg.norm(calibration.prior.field_world))
    if sigma > LOOSE * size:
        yield Finding(
            "few_data",
            f"The offset sigma is {1e6 * sigma:.2g} uT, {100.0 * sigma / size:.2g} % of the field:"
            " it is not determined. Rotate the sensor further, about all its axes.",
            Verdict.FAILED if sigma > USELESS * size else Verdict.DOUBTFUL,
            weight=sigma / (LOOSE * size),
        )
    disturbed = calibration.field_sigma / float(np.linalg.norm(calibration.prior.field_world))
    if disturbed > site.earth.strength_sigma:
        yield Finding(
            "earth_field",
            f"The magnitude of the calibrated field scatters by {100.0 * disturbed:.2g} %, but the"
            f" site declares a disturbance of {100.0 * site.earth.strength_sigma:.2g} %"
            " (world.earth.strength_sigma). Rotate the sensor in one place, away from iron.",
            weight=disturbed / site.earth.strength_sigma,
        )


def _microtesla(offset: Array) -> str:
    return "[" + ", ".join(f"{1e6 * axis:.1f}" for axis in offset) + "]"


def _of_another_scale(calibration: LogCalibration, site: Site, log: Log) -> Iterator[Finding]:
    """Yield a finding if only another scale of the sensor matches the declared field.

    It precedes findings of the calibration against its prior, of which it is the cause.
    """
    declared = site.platform.magnetometer.matrix
    ratio = float(np.cbrt(np.linalg.det(calibration.graph.fit.matrix) / np.linalg.det(declared)))
    sigma = float(np.sqrt(np.mean(np.diagonal(calibration.prior.cov)[[0, 4, 8]]) / 3.0))
    far = abs(ratio - 1.0) / min(SCALE, SCALE_SIGMAS * max(sigma, MIN_SCALE))
    if far < 1.0:
        return
    text = (
        f"The estimated scale of the magnetometer is {ratio:.3g} times the declared one: the"
        " readings have another unit, or the site's Earth field has another magnitude."
    )
    if ratio < 0.0 and log.inertial and (reversed_axes := left_handed_field(log, site)):
        text = reversed_axes.text
    elif ratio < 0.0:
        text = "The signs of all axes of the magnetometer are reversed. Correct the driver."
    elif site.earth_field_world is not None and abs(ratio - 1.0) < 1.0:
        size = 1e6 * float(np.linalg.norm(site.earth_field_world))
        text = (
            f"With the declared calibration the readings are of a field of {ratio * size:.3g} uT,"
            f" but the site declares {size:.3g} uT: steel is near, the field is of another place,"
            " or the readings have another unit. Calibrate away from steel, or declare the local"
            " field (earth_field_t)."
        )
    yield Finding("earth_field", text, Verdict.FAILED, FIRST + far)


def _of_another_size(calibration: LogCalibration, site: Site) -> Iterator[Finding]:
    """Yield findings if the magnitude of the calibrated field is not as declared, or impossible."""
    size = float(
        np.mean(np.linalg.norm(calibrated_field(calibration, calibration.magnetometer), axis=1))
    )
    remedy = (
        " A hard iron remains that this motion does not separate from the field: rotate the sensor"
        " about all its axes, and declare a larger sigma of its offset"
    )
    if site.earth_field_world is None:
        if not MIN_FIELD < size < MAX_FIELD:
            yield Finding(
                "earth_field",
                f"The calibrated field is {1e6 * size:.3g} uT, outside the Earth's 22 to 67."
                f"{remedy}; or give the local field (earth_field_t).",
                Verdict.FAILED,
                size / MAX_FIELD,
            )
        return
    declared = float(np.linalg.norm(site.earth_field_world))
    off = abs(size / declared - 1.0)
    if off > site.earth.strength_sigma:
        yield Finding(
            "earth_field",
            f"The calibrated field is {1e6 * size:.3g} uT, but the site declares"
            f" {1e6 * declared:.3g} (within {100.0 * site.earth.strength_sigma:.2g} %).{remedy}.",
            Verdict.FAILED if off > SCALE else Verdict.DOUBTFUL,
            off / site.earth.strength_sigma,
        )


def _remarks(calibration: LogCalibration, log: Log) -> Iterator[Finding]:
    for sentence in calibration.missing:
        text = f"{sentence[0].upper()}{sentence[1:]}."
        yield Finding("few_data", text, Verdict.TRUSTWORTHY)
    if not log.inertial:
        text = (
            "The log has no IMU: the field's magnitude does not determine the rotation of the"
            " sensor, which stays as declared. Record an IMU as well to estimate it."
        )
        yield Finding("few_data", text, Verdict.TRUSTWORTHY)
    if not calibration.scale_known:
        yield Finding(
            "few_data",
            "The site has no Earth field: the scale of the matrix is as declared, and only ratios,"
            " angles and offset are estimated; give earth_field_t or a location.",
            Verdict.TRUSTWORTHY,
        )
    if calibration.shape_kept:
        yield Finding(
            "transfer",
            "The declared shape and offset fit each half of the log as well as the calibration of"
            " the other half: they are kept, and only the sensor's rotation is estimated.",
            Verdict.TRUSTWORTHY,
        )
