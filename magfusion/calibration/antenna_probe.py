"""Calibration of one antenna on a bench: a probe measures the field of each coil driven alone.

Any points and probe axes are supported: the four of paper 000 about each coil, the two on its
axis that the paper lacks, or a grid.  Parameters that they do not determine keep their prior.  A
receiving antenna is driven as a small transmitting one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.calibration.antenna import CONVERGED, ITERATIONS
from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import NormalEquations, minimise, normal_equations
from magfusion.model.coil_field import alone, coil_fields
from magfusion.model.physics.finite_size import coil_coupling
from magfusion.model.probe import ProbeReadings
from magfusion.model.site import Beacon
from magfusion.units import Array, IntArray

FOLDS = 6  # parts of the points, each predicted by a fit of the others
MOMENTS, CENTRES, SIZES = slice(0, 9), slice(9, 18), slice(18, None)  # of one antenna's vector


@dataclass(frozen=True, eq=False)
class ProbeFit:
    """An antenna calibrated with a probe."""

    # (k,), moments (9), centres (9), and sizes (three, or one of all) where they are modelled
    vector: Array
    cov: Array  # (k, k)
    chi2: float  # squared whitened residuals, those of the prior included
    dof: int  # readings; every parameter has its prior, which cancels it


Predict = Callable[[Array, ProbeReadings], Array]  # what a probe reads of an antenna's vector (T)


def read_of_term(vector: Array, readings: ProbeReadings) -> Array:
    """Return a probe's readings of dipoles with the first-order size term, shape (n,) (T)."""
    return _term(vector, readings)[0]


def read_of_beacon(beacon: Beacon, put: Callable[[Beacon, Array], Beacon]) -> Predict:
    """Return a probe's readings of a site's beacon coils.

    `put`: returns the beacon with the coils of an antenna's vector.
    """

    def predicted(vector: Array, readings: ProbeReadings) -> Array:
        fields = coil_fields(alone(put(beacon, vector)), readings.position)
        own = fields[np.arange(len(readings)), readings.coil]
        return np.asarray(np.sum(own * readings.axis, axis=1))

    return predicted


def _term(vector: Array, readings: ProbeReadings) -> tuple[Array, Array, Array, Array]:
    """Return readings (n,), their derivative by the vector (n, k), by place and by axis (n, 3)."""
    moments, centres = vector[MOMENTS].reshape(3, 3), vector[CENTRES].reshape(3, 3)
    sizes, coil = vector[SIZES], readings.coil
    own = np.zeros_like(coil) if len(sizes) == 1 else coil
    seen = coil_coupling(
        readings.position - centres[coil],
        moments[coil],
        readings.axis,
        sizes[own] if len(sizes) else None,
    )
    by_vector = np.zeros((len(readings), len(vector)))
    rows = np.arange(len(readings))
    for axis in range(3):
        by_vector[rows, 3 * coil + axis] = seen.by_moment[:, axis]
        by_vector[rows, 9 + 3 * coil + axis] = -seen.by_offset[:, axis]
    if len(sizes):
        by_vector[rows, 18 + own] = seen.by_kappa_moment
    return seen.value, by_vector, seen.by_offset, seen.by_sensitivity


def bench_sigma(
    vector: Array, readings: ProbeReadings, position_sigma: float, tilt_sigma: float
) -> Array:
    """Return the standard deviation of readings (n,) by noise and by the bench (T).

    `position_sigma`, `tilt_sigma`: of each axis of the probe's place (m), and of its axis about
    each of two (rad).
    """
    _, _, by_place, by_axis = _term(vector, readings)
    across = by_axis - np.sum(by_axis * readings.axis, axis=1)[:, None] * readings.axis
    square = readings.sigma**2 + position_sigma**2 * np.sum(by_place**2, axis=1)
    return np.sqrt(square + tilt_sigma**2 * np.sum(across**2, axis=1))


def fit_by_probe(
    readings: ProbeReadings, start: Array, sigma: Array, predict: Predict = read_of_term
) -> ProbeFit:
    """Fit an antenna to readings whose sigmas are those of `bench_sigma`.

    `start` (k,): mean of the prior. `sigma` (k,): of the prior. Raises EstimationError where it
    does not converge.
    """

    def normal(_: IntArray, scaled: Array) -> NormalEquations:
        vector = start + scaled[0] * sigma
        error = (predict(vector, readings) - readings.reading) / readings.sigma
        jacobian = _term(vector, readings)[1] / readings.sigma[:, None] * sigma
        seen = normal_equations(error[None], jacobian[None])
        return NormalEquations(
            seen.cost + np.sum(scaled**2, axis=-1),
            seen.gradient + scaled,
            seen.information + np.eye(len(sigma)),
        )

    result = minimise(
        normal, np.zeros((1, len(sigma))), max_iterations=ITERATIONS, absolute=CONVERGED**2
    )
    if not result.converged[0]:
        raise EstimationError(
            f"the probe's readings do not converge in {ITERATIONS} steps: places, axes or signs"
            " disagree with the coils by far more than the prior allows"
        )
    cov = np.linalg.inv(result.information[0]) * np.outer(sigma, sigma)
    return ProbeFit(start + result.state[0] * sigma, cov, float(result.cost[0]), len(readings))


def in_units_of_sensitivity(readings: ProbeReadings, vector: Array) -> ProbeReadings:
    """Return the readings of a driven receiver, with coil moments equal to its sensitivities.

    The drive current is unknown and not needed: a common factor is removed.
    """
    unit = read_of_term(vector, readings)
    factor = float(readings.reading @ unit) / float(unit @ unit)
    return replace(readings, reading=readings.reading / factor, sigma=readings.sigma / abs(factor))


def left_out_errors(
    readings: ProbeReadings, start: Array, sigma: Array, predict: Predict = read_of_term
) -> tuple[Array, Array]:
    """Return leave-one-point-out errors relative to the field there, of the start and of fits.

    All readings at a point are left out together.
    """
    where = np.column_stack([readings.coil, np.round(readings.position, 6)])
    point = np.unique(where, axis=0, return_inverse=True)[1].ravel()
    fold = point % FOLDS
    size = np.sqrt(np.bincount(point, readings.reading**2))[point]
    before = (predict(start, readings) - readings.reading) / size
    after = np.empty(len(readings))
    for k in np.unique(fold):
        own = fold == k
        fit = fit_by_probe(readings.rows(~own), start, sigma, predict)
        after[own] = (predict(fit.vector, readings.rows(own)) - readings.reading[own]) / size[own]
    return before, after
