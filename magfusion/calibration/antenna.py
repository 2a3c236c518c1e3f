"""Calibration of a tracker's antennas: joint least squares over a survey of known poses.

Where the poses are themselves uncertain, see `magfusion.calibration.antenna_graph`; the procedure
of paper 000 is in `magfusion.calibration.antenna_bench`.
"""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.antenna import (
    CENTRES,
    KAPPAS,
    MOMENTS,
    SENSITIVITIES,
    SENSOR_CENTRES,
    Antenna,
    antenna_from_vector,
    observe_antenna,
)
from magfusion.errors import EstimationError
from magfusion.units import Array

ITERATIONS = 20
CONVERGED = 1e-4  # of a prior sigma


@dataclass(frozen=True, eq=False)
class AntennaSurvey:
    """Couplings at poses of the sensor in the beacon's axes; leading axes hold many surveys.

    Parameters
    ----------
    beacon_from_sensor : ndarray, shape (..., n, 3, 3)
    position_beacon : ndarray, shape (..., n, 3)
        (m)
    coupling : ndarray, shape (..., n, 3, 3)
        Rows are receiving coils, columns transmitting ones (T).
    sigma : ndarray, shape (..., n)
        Standard deviation of each coupling of a pose (T).
    """

    beacon_from_sensor: Array
    position_beacon: Array
    coupling: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class AntennaFit:
    """A calibrated antenna.

    Parameters
    ----------
    antenna : Antenna
    cov : ndarray, shape (..., k, k)
        Of `Antenna.vector`.
    chi2 : ndarray, shape (...)
        Squared whitened residuals, those of the priors included.
    dof : int
        Couplings; every parameter has its prior, which cancels it.
    beacon_from_sensor, position_beacon : ndarray
        The poses, refined where they were uncertain.
    """

    antenna: Antenna
    cov: Array
    chi2: Array
    dof: int
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
        Of both finite sizes (m^2); that of coils of 3 cm radius.
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


def fit_at_known_poses(survey: AntennaSurvey, start: Antenna, sigma: Array) -> AntennaFit:
    """Fit the antenna by least squares, the poses taken as exact.

    Many surveys are fitted in one call.

    Parameters
    ----------
    survey : AntennaSurvey
    start : Antenna
        Mean of the prior; of a single antenna, or with the survey's leading axes.
    sigma : ndarray, shape (k,)
        Of the prior (`prior_sigma`).

    Returns
    -------
    AntennaFit

    Raises
    ------
    EstimationError
        Where it does not converge.
    """
    lead = survey.coupling.shape[:-3]
    mean = np.broadcast_to(start.vector(), (*lead, len(sigma)))
    scaled = np.zeros_like(mean)  # (vector - mean) / sigma
    for _ in range(ITERATIONS):
        rest, jacobian = _linearized(survey, mean + scaled * sigma, sigma)
        turned = np.swapaxes(jacobian, -1, -2)
        normal = turned @ jacobian + np.eye(len(sigma))
        right = (turned @ rest[..., None])[..., 0] - scaled
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        scaled = scaled + step
        if not np.all(np.isfinite(step)):
            break
        if np.max(np.abs(step)) < CONVERGED:
            vector = mean + scaled * sigma
            rest, _ = _linearized(survey, vector, sigma)
            return AntennaFit(
                antenna=antenna_from_vector(vector),
                cov=np.linalg.inv(normal) * sigma[:, None] * sigma,
                chi2=np.asarray(np.sum(rest**2, axis=-1) + np.sum(scaled**2, axis=-1)),
                dof=rest.shape[-1],
                beacon_from_sensor=survey.beacon_from_sensor,
                position_beacon=survey.position_beacon,
            )
    raise EstimationError(
        f"the antenna's calibration does not converge in {ITERATIONS} steps: poses and couplings"
        " disagree by far more than the prior allows"
    )


def _linearized(survey: AntennaSurvey, vector: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the whitened residual (..., 9 n) and its Jacobian by vector / sigma."""
    antenna = antenna_from_vector(vector[..., None, :])
    seen = observe_antenna(antenna, survey.beacon_from_sensor, survey.position_beacon)
    weight = 1.0 / survey.sigma[..., None, None]
    rest = (survey.coupling - seen.value) * weight
    jacobian = seen.antenna * (weight[..., None] * sigma)
    lead = rest.shape[:-3]
    return rest.reshape(*lead, -1), jacobian.reshape(*lead, -1, len(sigma))


def with_receiver_gain(fit: AntennaFit, declared: Antenna) -> AntennaFit:
    """Return a fit whose sensitivities are as large as declared in their geometric mean.

    Couplings tell the product of moments and sensitivities alone.  The prior shares it out, with a
    sigma that is no error of any coupling; here the receiver's mean gain is held, and the sigmas
    are those of everything else (the S-transformation of geodesy).

    Parameters
    ----------
    fit : AntennaFit
        Of one antenna.
    declared : Antenna

    Returns
    -------
    AntennaFit
    """
    found = fit.antenna
    size = np.linalg.norm(found.sensitivities_sensor, axis=-1)
    reference = np.linalg.norm(declared.sensitivities_sensor, axis=-1)
    factor = float(np.exp(np.mean(np.log(reference / size))))
    held = replace(
        found,
        moments_beacon=found.moments_beacon / factor,
        sensitivities_sensor=found.sensitivities_sensor * factor,
    )
    scale = np.ones(len(fit.cov))
    scale[MOMENTS], scale[SENSITIVITIES] = 1.0 / factor, factor
    gauge, by_gain = np.zeros(len(scale)), np.zeros(len(scale))
    gauge[MOMENTS] = -held.moments_beacon.ravel()
    gauge[SENSITIVITIES] = held.sensitivities_sensor.ravel()
    square = (size * factor)[:, None] ** 2
    by_gain[SENSITIVITIES] = (held.sensitivities_sensor / square / len(size)).ravel()
    projection = np.eye(len(scale)) - np.outer(gauge, by_gain)  # by_gain @ gauge is one
    transform = projection * scale
    return replace(fit, antenna=held, cov=transform @ fit.cov @ transform.T)
