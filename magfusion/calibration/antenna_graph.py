"""Calibration of a tracker's antennas at uncertain poses, in a GTSAM graph.

A turntable error of a tenth of a degree is larger than the noise of the couplings; if the poses
were fixed, it would bias the antenna.  Here every pose is a variable with its prior.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from magfusion.calibration.antenna import (
    CONVERGED,
    ITERATIONS,
    AntennaFit,
    AntennaSurvey,
    Observe,
    prior_root,
)
from magfusion.calibration.graph import CalibrationEstimate, CalibrationGraph, solve
from magfusion.model.antenna import Antenna, antenna_from_vector, observe_antenna
from magfusion.units import Array

POSE_STEP = np.repeat([0.3, 0.05], 3)  # rad, m


def fit_at_uncertain_poses(
    survey: AntennaSurvey,
    start: Antenna,
    sigma: Array,
    rotation_sigma: float,
    position_sigma: float,
    model: Observe = observe_antenna,
) -> AntennaFit:
    """Fit the antenna and all poses together.

    Parameters
    ----------
    survey : AntennaSurvey
        One survey; its poses are the means of their priors and the start.
    start : Antenna
        Mean of the prior.
    sigma : ndarray, shape (k,) or (k, k)
        Of the prior (`magfusion.calibration.antenna.prior_sigma`), or a factor of its covariance,
        which also fixes the gauges.
    rotation_sigma, position_sigma : float
        Of each axis of a pose (rad, m).  Infinite where the poses are unknown: then only the
        antenna's shape is estimated, neither its frames nor its scale (self-calibration).
    model : callable
        Predicts the couplings.

    Returns
    -------
    AntennaFit
        ``dof`` counts couplings and, where known, poses less poses: the couplings alone, or the
        couplings less six a pose.

    Raises
    ------
    EstimationError
        Where it does not converge.
    """
    n, mean, root = len(survey.position_beacon), start.vector(), prior_root(sigma)
    weight = 1.0 / survey.sigma[:, None, None]

    def rows(estimate: CalibrationEstimate) -> tuple[Array, Array, Array]:
        antenna = antenna_from_vector(mean + root @ estimate.calibration)
        seen = model(antenna, *_poses(estimate.values, n))
        return (
            ((seen.value - survey.coupling) * weight).reshape(n, 9),
            (seen.pose * weight[..., None]).reshape(n, 9, 6),
            (seen.antenna * weight[..., None] @ root).reshape(n, 9, -1),
        )

    # Zero where a pose is unknown: it has no prior.
    precision = np.repeat([rotation_sigma**-2, position_sigma**-2], 3)
    noise = gtsam.noiseModel.Diagonal.Precisions(precision)
    native, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, rotation in enumerate(survey.beacon_from_sensor):
        pose = gtsam.Pose3(gtsam.Rot3(rotation), survey.position_beacon[i])
        values.insert(X(i), pose)
        native.add(gtsam.PriorFactorPose3(X(i), pose, noise))
    steps = {X(i): POSE_STEP for i in range(n)}
    none = np.zeros(len(root))
    graph = CalibrationGraph(rows, native, none, np.eye(len(root)), steps)
    result, cov = solve(
        graph, CalibrationEstimate(values, none), "antenna", ITERATIONS, CONVERGED**2
    )
    beacon_from_sensor, position_beacon = _poses(result.estimate.values, n)
    return AntennaFit(
        antenna=antenna_from_vector(mean + root @ result.estimate.calibration),
        cov=root @ cov @ root.T,
        chi2=np.asarray(2.0 * result.cost),
        dof=survey.coupling.size - n * int(np.sum(precision == 0.0)),
        beacon_from_sensor=beacon_from_sensor,
        position_beacon=position_beacon,
    )


def _poses(values: gtsam.Values, n: int) -> tuple[Array, Array]:
    poses = [values.atPose3(X(i)) for i in range(n)]
    return (
        np.array([pose.rotation().matrix() for pose in poses]),
        np.array([pose.translation() for pose in poses]),
    )
