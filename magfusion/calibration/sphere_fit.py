"""The sphere fit: matrix and offset of a magnetometer by the magnitude of a constant field."""

from dataclasses import dataclass

import numpy as np

from magfusion.calibration.magnetometer import MagnetometerFit, field_from_measured
from magfusion.calibration.magnetometer_graph import MagnetometerPrior
from magfusion.calibration.magnetometer_start import places
from magfusion.calibration.static_field import StaticField
from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import NormalEquations, minimise, normal_equations
from magfusion.model.site import Magnetometer
from magfusion.units import DEGREE, Array, IntArray

MIN_READINGS = 20  # readings
NEW = 1.0 * DEGREE  # of the field: what turned less since the last reading is no further one
FIRST_SIGMA = 1e-3  # of the field, before the scatter is known
KNOWN_SIZE = 1e-6  # of the field's size, where it was declared
MIN_CHI_SQUARE_GAIN = 1e-4  # of a chi square, which another step would gain


@dataclass(frozen=True, eq=False)
class Sphere:
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

        Raises EstimationError where no start converges.
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


def sphere_fits(
    readings: StaticField, known: Magnetometer, prior: MagnetometerPrior
) -> list[MagnetometerFit]:
    """Return the fits by the magnitude alone; none where the readings are too few.

    Raises EstimationError where no start converges.
    """
    readings = distinct_fields(readings, known)
    if len(readings) < MIN_READINGS:
        return []
    size = float(np.linalg.norm(prior.field_world))
    problem = sphere_problem(readings, prior, size, FIRST_SIGMA * size, prior.size_sigma)
    result = problem.minima(sphere_starts(readings, prior, size))
    return [fit_of(state, cov) for state, cov, _ in result]


def distinct_fields(readings: StaticField, known: Magnetometer) -> StaticField:
    """Return readings between which the field rotates; repeated readings at rest add nothing."""
    field = field_from_measured(readings.measured_sensor, known.matrix, np.zeros(3))
    reach = NEW * 0.5 * float(np.max(np.ptp(field, axis=0)))
    kept = [0]
    for k in range(1, len(field)):
        if np.linalg.norm(field[k] - field[kept[-1]]) > reach:
            kept.append(k)
    rows = np.array(kept)
    return StaticField(
        readings.time[rows],
        readings.window[rows],
        readings.measured_sensor[rows],
        readings.accel_body[rows],
    )


def sphere_starts(
    readings: StaticField, prior: MagnetometerPrior, size: float
) -> list[MagnetometerFit]:
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
    gain = float(np.median(np.linalg.norm(field - centre, axis=1))) / size
    begun = [(gain, centre)]  # of any scale, where the readings surround the centre
    begun += [(1.0, centre + far * least) for far in places(field - centre, least, size)]
    return [
        MagnetometerFit(scale * prior.matrix, prior.offset + prior.matrix @ at, np.zeros((12, 12)))
        for scale, at in begun
    ]


def sphere_problem(
    readings: StaticField, prior: MagnetometerPrior, size: float, sigma: float, size_sigma: float
) -> Sphere:
    """Return the least squares of some readings, with the prior; the sigma of a reading in T."""
    declared = np.concatenate([prior.matrix.ravel(), prior.offset, [1.0]])
    root = np.zeros((13, 13))
    root[:12, :12] = np.linalg.inv(np.linalg.cholesky(prior.cov))
    root[12, 12] = 1.0 / max(size_sigma, KNOWN_SIZE)
    return Sphere(readings.measured_sensor, size, sigma, declared, root)


def fit_of(state: Array, cov: Array) -> MagnetometerFit:
    """Return a state (13,) and its covariance as a fit."""
    return MagnetometerFit(state[:9].reshape(3, 3), state[9:12], cov[:12, :12])
