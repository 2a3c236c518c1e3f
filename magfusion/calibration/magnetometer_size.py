"""Magnetometer calibration without an IMU, from the rotation-invariant magnitude of the field.

The magnitude does not determine the rotation between the readings' ellipsoid and the sphere: the
mounting's part of the matrix stays as declared.  Too little rotation leaves parameters at their
declared sigmas; readings in one plane do not determine on which side of it the offset is.
"""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.calibration.magnetometer import (
    MagnetometerFit,
    field_from_measured,
    prior_cov,
    refined,
)
from magfusion.calibration.magnetometer_graph import GraphFit, MagnetometerPrior
from magfusion.calibration.magnetometer_log import LINEARITY, LogCalibration
from magfusion.calibration.magnetometer_start import DISTINCT_CHI_SQUARE, UNLIKELY, mirrored, places
from magfusion.calibration.steady_field import SteadyField, steady_alone
from magfusion.errors import EstimationError, InputError
from magfusion.estimation.solve.batched import NormalEquations, minimise, normal_equations
from magfusion.model.samples import Waveform
from magfusion.model.site import Magnetometer, Site
from magfusion.units import DEGREE, Array, IntArray

MIN_READINGS = 20  # readings
NEW = 1.0 * DEGREE  # of the field: what turned less since the last reading is no further one
NARROW = 3.0 * DEGREE  # RMS in the second direction; less is turning about no axis
FIRST_SIGMA = 1e-3  # of the field, before the scatter is known
HOMOGENEOUS = 1e-3  # of the field; what steel changes it by over the length of an arm
WIDE_SIZE = 10.0  # of the field's size, where nobody declared it
MAX_ITERATIONS = 3
KNOWN_SIZE = 1e-6  # of the field's size, where it was declared
MIN_CHI_SQUARE_GAIN = 1e-4  # of a chi square, which another step would gain


@dataclass(frozen=True, eq=False)
class _Sphere:
    """Least squares of the field's magnitude; the state is matrix, offset and magnitude scale."""

    measured: Array
    size: float
    sigma: float
    declared: Array
    root: Array

    def rows(self, state: Array) -> tuple[Array, Array]:
        """Return whitened errors (k, n), and their derivatives (k, n, 13), at states (k, 13)."""
        matrix, offset = state[:, :9].reshape(-1, 3, 3), state[:, 9:12]
        inverse = np.linalg.inv(matrix)
        field = (self.measured - offset[:, None]) @ np.swapaxes(inverse, 1, 2)
        size = np.linalg.norm(field, axis=2)
        back = field / size[..., None] @ inverse
        by_matrix = -(back[..., :, None] * field[..., None, :]).reshape(*size.shape, 9)
        by_size = np.full((*size.shape, 1), -self.size)
        jacobian = np.concatenate([by_matrix, -back, by_size], axis=2)
        return (size - state[:, 12:] * self.size) / self.sigma, jacobian / self.sigma

    def normal(self, _: IntArray, state: Array) -> NormalEquations:
        """Return the normal equations at states (k, 13), priors included."""
        step = (state - self.declared) @ self.root.T
        prior = normal_equations(step, np.broadcast_to(self.root, (len(state), 13, 13)))
        reported = normal_equations(*self.rows(state))
        return NormalEquations(*(one + other for one, other in zip(reported, prior, strict=True)))

    def minima(self, begun: list[MagnetometerFit]) -> list[tuple[Array, Array, float]]:
        """Return state, covariance (13, 13) and cost of the converged minima.

        Raises
        ------
        EstimationError
            Where no start converges.
        """
        start = np.array([[*one.matrix.ravel(), *one.offset, 1.0] for one in begun])
        result = minimise(self.normal, start, absolute=MIN_CHI_SQUARE_GAIN)
        if not np.any(result.converged):
            raise EstimationError(
                "the field's magnitude does not determine the calibration; rotate the sensor about"
                " all axes"
            )
        rows = np.flatnonzero(result.converged)
        unit = np.linalg.inv(self.root)
        out = []
        for k in rows:
            scaled = unit.T @ result.information[k] @ unit
            cov = unit @ np.linalg.inv(scaled) @ unit.T
            out.append((result.state[k], cov, float(result.cost[k])))
        return out


def calibrate_alone(waveform: Waveform, site: Site) -> LogCalibration:
    """Calibrate a rotated magnetometer from the magnitude of the field alone.

    Parameters
    ----------
    waveform : Waveform
    site : Site
        Its sigmas of the magnetometer are the prior, its Earth field sets the scale.

    Raises
    ------
    InputError
        Where it is rotated too little.
    EstimationError
        Where the calibration has no solution.
    """
    known = site.platform.magnetometer
    readings = _at_distinct_fields(steady_alone(waveform, site), known)
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
    sigma, begun = FIRST_SIGMA * size, _begun(readings, prior, size)
    for _ in range(MAX_ITERATIONS):
        problem = _problem(readings, prior, size, sigma, size_sigma)
        result = problem.minima(begun)
        state, cov, cost = min(result, key=lambda one: one[2])
        error = sigma * problem.rows(state[None])[0][0]
        scatter = float(np.sqrt(np.sum(error**2) / max(len(error) - 9, 1)))
        begun = [_fit(one[0], one[1]) for one in result]
        sigma = max(scatter, HOMOGENEOUS * state[12] * size, LINEARITY * size)
    fit = _fit(state, cov)
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


def _at_distinct_fields(readings: SteadyField, known: Magnetometer) -> SteadyField:
    """Return readings between which the field rotates; repeated readings at rest add nothing."""
    field = field_from_measured(readings.measured_sensor, known.matrix, np.zeros(3))
    reach = NEW * 0.5 * float(np.max(np.ptp(field, axis=0)))
    kept = [0]
    for k in range(1, len(field)):
        if np.linalg.norm(field[k] - field[kept[-1]]) > reach:
            kept.append(k)
    rows = np.array(kept)
    return SteadyField(
        readings.time[rows],
        readings.window[rows],
        readings.measured_sensor[rows],
        readings.accel_body[rows],
    )


def _refuse_little(readings: SteadyField, known: Magnetometer, site: Site) -> None:
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


def _begun(readings: SteadyField, prior: MagnetometerPrior, size: float) -> list[MagnetometerFit]:
    """Return initial estimates: the centre of the sphere, on both sides where that is ambiguous."""
    inverse = np.linalg.inv(prior.matrix)
    field = (readings.measured_sensor - prior.offset) @ inverse.T
    middle = np.mean(field, axis=0)
    rows = 2.0 * (field - middle)
    length = np.sum(field**2, axis=1)
    noise = (0.1 * size**2) ** 2
    reported = np.linalg.inv(inverse @ prior.cov[9:, 9:] @ inverse.T)
    square = rows.T @ rows / noise + reported
    centre = np.linalg.solve(square, rows.T @ (length - np.mean(length)) / noise)
    least = np.linalg.eigh(square)[1][:, 0]
    return [
        MagnetometerFit(
            prior.matrix, prior.offset + prior.matrix @ (centre + far * least), np.zeros((12, 12))
        )
        for far in places(field - centre, least, size)
    ]


def _problem(
    readings: SteadyField, prior: MagnetometerPrior, size: float, sigma: float, size_sigma: float
) -> _Sphere:
    declared = np.concatenate([prior.matrix.ravel(), prior.offset, [1.0]])
    root = np.zeros((13, 13))
    root[:12, :12] = np.linalg.inv(np.linalg.cholesky(prior.cov))
    root[12, 12] = 1.0 / max(size_sigma, KNOWN_SIZE)
    return _Sphere(readings.measured_sensor, size, sigma, declared, root)


def _fit(state: Array, cov: Array) -> MagnetometerFit:
    return MagnetometerFit(state[:9].reshape(3, 3), state[9:12], cov[:12, :12])


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
