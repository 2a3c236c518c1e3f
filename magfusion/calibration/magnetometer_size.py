"""Magnetometer calibration without an IMU, from the rotation-invariant magnitude of the field.

The magnitude does not determine the rotation between the readings' ellipsoid and the sphere: the
mounting's part of the matrix stays as declared.  Too little rotation leaves parameters at their
declared sigmas; readings in one plane do not determine on which side of it the offset is.
"""

from dataclasses import replace

import numpy as np

from magfusion.calibration.magnetometer import (
    MagnetometerFit,
    field_from_measured,
    prior_cov,
    refined,
)
from magfusion.calibration.magnetometer_graph import GraphFit, MagnetometerPrior
from magfusion.calibration.magnetometer_log import LINEARITY, MAX_ITERATIONS, LogCalibration
from magfusion.calibration.magnetometer_start import DISTINCT_CHI_SQUARE, UNLIKELY, mirrored
from magfusion.calibration.sphere_fit import (
    FIRST_SIGMA,
    MIN_READINGS,
    distinct_fields,
    fit_of,
    sphere_problem,
    sphere_starts,
)
from magfusion.calibration.static_field import StaticField, static_alone
from magfusion.errors import InputError
from magfusion.model.samples import Waveform
from magfusion.model.site import Magnetometer, Site
from magfusion.units import DEGREE, Array

NARROW = 3.0 * DEGREE  # RMS in the second direction; less is turning about no axis
HOMOGENEOUS = 1e-3  # of the field; what steel changes it by over the length of an arm
WIDE_SIZE = 10.0  # of the field's size, where nobody declared it


def calibrate_alone(waveform: Waveform, site: Site) -> LogCalibration:
    """Calibrate a rotated magnetometer from the magnitude of the field alone.

    `site`: its sigmas of the magnetometer are the prior, its Earth field sets the scale. Raises
    InputError where it is rotated too little; EstimationError where the calibration has no
    solution.
    """
    known = site.platform.magnetometer
    readings = distinct_fields(static_alone(waveform, site), known)
    _refuse_little(readings, known, site)
    declared = field_from_measured(readings.measured_sensor, known.matrix, known.offset)
    field_world, size_sigma = site.earth_field_world, 0.0
    if field_world is None:
        field_world = np.array([0.0, 0.0, float(np.median(np.linalg.norm(declared, axis=1)))])
        size_sigma = WIDE_SIZE
    prior = MagnetometerPrior(
        body_from_sensor=known.body_from_sensor,
        matrix=known.matrix,
        offset=known.offset,
        cov=prior_cov(known),
        field_world=field_world,
    )
    size = float(np.linalg.norm(field_world))
    sigma, begun = FIRST_SIGMA * size, sphere_starts(readings, prior, size)
    for _ in range(MAX_ITERATIONS):
        problem = sphere_problem(readings, prior, size, sigma, size_sigma)
        result = problem.minima(begun)
        state, cov, cost = min(result, key=lambda one: one[2])
        error = sigma * problem.rows(state[None])[0][0]
        scatter = float(np.sqrt(np.sum(error**2) / max(len(error) - 9, 1)))
        begun = [fit_of(one[0], one[1]) for one in result]
        sigma = max(scatter, HOMOGENEOUS * state[12] * size, LINEARITY * size)
    fit = fit_of(state, cov)
    flat = mirrored(readings.measured_sensor, fit)
    rivals = [*begun, flat] if flat is not None else begun
    rival = _rival(problem.minima(rivals), fit, cost)
    graph = GraphFit(
        fit=fit,
        world_from_body=np.zeros((0, 3, 3)),
        dip_change=0.0,
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        field_residual=(error / sigma)[:, None],
        chi_square=cost,
        iterations=MAX_ITERATIONS,
    )
    return LogCalibration(
        magnetometer=refined(known, fit),
        graph=graph,
        prior=replace(prior, field_world=state[12] * field_world),
        readings=readings,
        field_sigma=scatter,
        missing=[],
        scale_known=site.earth_field_world is not None,
        spread_unseen=None,
        shape_kept=False,
        rival=rival,
    )


def _refuse_little(readings: StaticField, known: Magnetometer, site: Site) -> None:
    remedy = "rotate it slowly about all its axes for a minute, or record an IMU as well"
    if len(readings) < MIN_READINGS:
        raise InputError(
            f"magnetometer: the log gives {len(readings)} readings of different directions, and"
            f" {MIN_READINGS} are required; {remedy}"
        )
    field = field_from_measured(readings.measured_sensor, known.matrix, known.offset)
    size = np.linalg.norm(
        field if site.earth_field_world is None else site.earth_field_world, axis=-1
    )
    across = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(field.T))[1]), 0.0))
    if across < NARROW * float(np.median(size)):
        raise InputError(
            "magnetometer: too few orientations to calibrate on: the field stays along one line in"
            f" the sensor; {remedy}"
        )


def _rival(
    result: list[tuple[Array, Array, float]], fit: MagnetometerFit, cost: float
) -> Array | None:
    """Return another offset (T) that explains the readings nearly as well, if there is one."""
    for state, _, other in result:
        off = state[9:12] - fit.offset
        if (
            off @ np.linalg.solve(fit.cov[9:, 9:], off) > DISTINCT_CHI_SQUARE
            and other < cost + UNLIKELY
        ):
            return np.asarray(state[9:12])
    return None
