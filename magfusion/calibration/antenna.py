"""Calibration of a tracker's antennas: joint least squares over a survey of known poses.

Where the poses are themselves uncertain, see `magfusion.calibration.antenna_graph`; the procedure
of paper 000 is in `scenarios/tracker_bench.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import NormalEquations, minimise, normal_equations
from magfusion.model.antenna import (
    CENTRES,
    KAPPAS,
    MOMENTS,
    SENSITIVITIES,
    SENSOR_CENTRES,
    Antenna,
    Coupling,
    antenna_from_vector,
    observe_antenna,
)
from magfusion.units import Array, IntArray

ITERATIONS = 20
CONVERGED = 1e-4  # of a prior sigma

Observe = Callable[[Antenna, Array, Array], Coupling]  # as `observe_antenna`


@dataclass(frozen=True, eq=False)
class AntennaSurvey:
    """Couplings at poses of the sensor in beacon axes; leading axes are surveys."""

    beacon_from_sensor: Array  # (..., n, 3, 3)
    position_beacon: Array  # (..., n, 3) (m)
    coupling: Array  # (..., n, 3, 3), rows are receiving coils, columns transmitting ones (T)
    sigma: Array  # (..., n), standard deviation of each coupling of a pose (T)


@dataclass(frozen=True, eq=False)
class AntennaFit:
    """A calibrated antenna."""

    antenna: Antenna
    cov: Array  # (..., k, k), of `Antenna.vector`
    chi2: Array  # (...), squared whitened residuals, those of the priors included
    dof: int  # couplings; every parameter has its prior, which cancels it
    # beacon_from_sensor, position_beacon: the poses, refined where they were uncertain
    beacon_from_sensor: Array
    position_beacon: Array


def prior_sigma(
    antenna: Antenna,
    gain: float = 0.02,
    tilt: float = 0.01,
    centre: float = 2e-3,
    kappa: float = 1e-4,
) -> Array:
    """Return prior standard deviations of `Antenna.vector`, shape (k,).

    Parameters
    ----------
    antenna : Antenna
        One; its moments and sensitivities give the scale.
    gain : float
        Relative, along each coil's axis.
    tilt : float
        Across it (rad).
    centre : float
        (m)
    kappa : float
        Of the finite sizes (m^2); that of coils of 3 cm radius.
    """
    sigma = np.empty(antenna.vector().shape[-1])
    for columns, coils in (
        (MOMENTS, antenna.moments_beacon),
        (SENSITIVITIES, antenna.sensitivities_sensor),
    ):
        size = np.linalg.norm(coils, axis=-1, keepdims=True)
        along = np.abs(coils / size)
        sigma[columns] = (size * np.hypot(gain * along, tilt * np.sqrt(1 - along**2))).ravel()
    sigma[CENTRES] = sigma[SENSOR_CENTRES] = centre
    sigma[KAPPAS] = kappa
    return sigma


def prior_root(sigma: Array) -> Array:
    """Return a factor L of a prior's covariance ``L L^T`` (k, k), of standard deviations (k,)."""
    return np.diag(sigma) if sigma.ndim == 1 else sigma


def fit_at_known_poses(
    survey: AntennaSurvey, start: Antenna, sigma: Array, model: Observe = observe_antenna
) -> AntennaFit:
    """Fit the antenna by least squares, the poses taken as exact.

    Many surveys are fitted in one call. `start`: mean of the prior; of a single antenna, or with
    the survey's leading axes. `sigma` (k,) or (k, k): of the prior (`prior_sigma`), or a factor of
    its covariance (`prior_root`). `model`: predicts the couplings; one that is not
    `observe_antenna` takes one survey alone. Raises EstimationError where it does not converge.
    """
    lead = survey.coupling.shape[:-3]
    root = prior_root(sigma)
    mean = np.broadcast_to(start.vector(), (*lead, len(sigma))).reshape(-1, len(sigma))
    n = survey.coupling.shape[-3]
    rotation = survey.beacon_from_sensor.reshape(-1, n, 3, 3)
    position = survey.position_beacon.reshape(-1, n, 3)
    coupling = survey.coupling.reshape(-1, n, 3, 3)
    weight = 1.0 / survey.sigma.reshape(-1, n)[..., None, None]

    def normal(rows: IntArray, scaled: Array) -> NormalEquations:
        """Return the product of the root and (vector - mean)."""
        antenna = antenna_from_vector((mean[rows] + scaled @ root.T)[:, None])
        seen = model(antenna, rotation[rows], position[rows])
        error = (seen.value - coupling[rows]) * weight[rows]
        jacobian = (seen.antenna * weight[rows, ..., None]) @ root
        fields = normal_equations(
            error.reshape(len(rows), -1), jacobian.reshape(len(rows), -1, len(sigma))
        )
        return NormalEquations(
            fields.cost + np.sum(scaled**2, axis=-1),
            fields.gradient + scaled,
            fields.information + np.eye(len(sigma)),
        )

    result = minimise(normal, np.zeros_like(mean), max_iterations=ITERATIONS, absolute=CONVERGED**2)
    if not np.all(result.converged):
        raise EstimationError(
            f"the antenna calibration does not converge in {ITERATIONS} iterations: poses and"
            " couplings are inconsistent by far more than the prior allows"
        )
    cov = root @ np.linalg.inv(result.information) @ root.T
    return AntennaFit(
        antenna=antenna_from_vector((mean + result.state @ root.T).reshape(*lead, -1)),
        cov=cov.reshape(*lead, *cov.shape[1:]),
        chi2=result.cost.reshape(lead),
        dof=9 * n,
        beacon_from_sensor=survey.beacon_from_sensor,
        position_beacon=survey.position_beacon,
    )


def with_receiver_gain(fit: AntennaFit, declared: Antenna) -> AntennaFit:
    """Return a fit scaled so that the geometric mean of its sensitivities is as declared.

    Couplings determine only the product of moments and sensitivities.  The prior splits it, with a
    sigma that is no error of any coupling.  Here the receiver's mean gain is fixed, and the sigmas
    are those of all other parameters (the S-transformation of geodesy). `fit`: of one antenna.
    """
    result = fit.antenna
    size = np.linalg.norm(result.sensitivities_sensor, axis=-1)
    reference = np.linalg.norm(declared.sensitivities_sensor, axis=-1)
    factor = float(np.exp(np.mean(np.log(reference / size))))
    fixed = replace(
        result,
        moments_beacon=result.moments_beacon / factor,
        sensitivities_sensor=result.sensitivities_sensor * factor,
    )
    scale = np.ones(len(fit.cov))
    scale[MOMENTS], scale[SENSITIVITIES] = 1.0 / factor, factor
    gauge, by_gain = np.zeros(len(scale)), np.zeros(len(scale))
    gauge[MOMENTS] = -fixed.moments_beacon.ravel()
    gauge[SENSITIVITIES] = fixed.sensitivities_sensor.ravel()
    square = (size * factor)[:, None] ** 2
    by_gain[SENSITIVITIES] = (fixed.sensitivities_sensor / square / len(size)).ravel()
    projection = np.eye(len(scale)) - np.outer(gauge, by_gain)  # by_gain @ gauge is one
    transform = projection * scale
    return replace(fit, antenna=fixed, cov=transform @ fit.cov @ transform.T)
