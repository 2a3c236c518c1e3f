"""Calibration of a tracker's antennas at poses that are uncertain, in a GTSAM graph.

A turntable's error of a tenth of a degree is larger than the couplings' noise; taken as exact it
goes into the antenna.  Here every pose is a variable with its prior.  The factors are linearised in
one batched call of the measurement model and eliminated by GTSAM, the antenna last.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from magfusion.antenna import Antenna, antenna_from_vector, observe_antenna
from magfusion.calibration.antenna import CONVERGED, ITERATIONS, AntennaFit, AntennaSurvey
from magfusion.errors import EstimationError
from magfusion.units import Array

_ANTENNA = gtsam.symbol("a", 0)


def fit_at_uncertain_poses(
    survey: AntennaSurvey,
    start: Antenna,
    sigma: Array,
    rotation_sigma: float,
    position_sigma: float,
) -> AntennaFit:
    """Fit the antenna and all poses together.

    Parameters
    ----------
    survey : AntennaSurvey
        One survey; its poses are the means of their priors and the start.
    start : Antenna
        Mean of the prior.
    sigma : ndarray, shape (k,)
        Of the prior (`magfusion.calibration.antenna.prior_sigma`): it holds the gauges too.
    rotation_sigma, position_sigma : float
        Of each axis of a pose (rad, m).  Infinite where the poses are not known at all: then the
        antenna's shape is found, but neither its frames nor its scale (self-calibration).

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
    problem = _Problem(survey, start.vector(), sigma, rotation_sigma, position_sigma)
    poses = [
        gtsam.Pose3(gtsam.Rot3(rotation), position)
        for rotation, position in zip(
            survey.beacon_from_sensor, survey.position_beacon, strict=True
        )
    ]
    scaled = np.zeros(len(sigma))
    cost = problem.cost(poses, scaled)
    for _ in range(ITERATIONS):
        try:
            net = problem.linearized(poses, scaled).eliminateSequential(problem.ordering)
        except RuntimeError:  # GTSAM's for a singular system: a pose that its couplings leave open
            break
        delta = net.optimize()
        share = 1.0
        while True:  # a full step may be too long far from the solution
            moved = [p.retract(share * delta.at(X(i))) for i, p in enumerate(poses)]
            trial = scaled + share * delta.at(_ANTENNA)
            found = problem.cost(moved, trial)
            if found <= cost * (1.0 + 1e-9) or share < 1e-3:
                break
            share *= 0.5
        poses, scaled, cost = moved, trial, found
        if np.max(np.abs(delta.at(_ANTENNA))) < CONVERGED:
            root = np.linalg.inv(net.at(net.size() - 1).R()) * sigma[:, None]
            return AntennaFit(
                antenna=antenna_from_vector(problem.mean + scaled * sigma),
                cov=root @ root.T,
                chi2=np.asarray(cost),
                dof=problem.dof,
                beacon_from_sensor=np.array([p.rotation().matrix() for p in poses]),
                position_beacon=np.array([p.translation() for p in poses]),
            )
    raise EstimationError(
        f"the antenna's calibration does not converge in {ITERATIONS} steps: poses and couplings"
        " disagree by far more than the priors allow"
    )


class _Problem:
    def __init__(
        self,
        survey: AntennaSurvey,
        mean: Array,
        sigma: Array,
        rotation_sigma: float,
        position_sigma: float,
    ) -> None:
        self.survey, self.mean, self.sigma = survey, mean, sigma
        # Zero where a pose is not known: no prior on it at all.
        self.weight = np.repeat(1.0 / np.array([rotation_sigma, position_sigma]), 3)
        self.given = [
            gtsam.Pose3(gtsam.Rot3(rotation), position)
            for rotation, position in zip(
                survey.beacon_from_sensor, survey.position_beacon, strict=True
            )
        ]
        self.dof = survey.coupling.size - len(self.given) * int(np.sum(self.weight == 0.0))
        self.ordering = gtsam.Ordering()
        for i in range(len(self.given)):
            self.ordering.push_back(X(i))
        self.ordering.push_back(_ANTENNA)

    def _seen(self, poses: list[gtsam.Pose3], scaled: Array) -> tuple[Array, Array, Array]:
        """Return whitened residual (n, 9) and Jacobians by pose and scaled antenna."""
        seen = observe_antenna(
            antenna_from_vector(self.mean + scaled * self.sigma),
            np.array([p.rotation().matrix() for p in poses]),
            np.array([p.translation() for p in poses]),
        )
        n, weight = len(poses), 1.0 / self.survey.sigma[:, None, None]
        rest = ((self.survey.coupling - seen.value) * weight).reshape(n, 9)
        by_pose = (seen.pose * weight[..., None]).reshape(n, 9, 6)
        by_antenna = (seen.antenna * weight[..., None] * self.sigma).reshape(n, 9, -1)
        return rest, by_pose, by_antenna

    def _from_given(self, poses: list[gtsam.Pose3]) -> Array:
        pairs = zip(self.given, poses, strict=True)
        return np.array([given.localCoordinates(pose) for given, pose in pairs]) * self.weight

    def cost(self, poses: list[gtsam.Pose3], scaled: Array) -> float:
        """Return the sum of all squared whitened residuals."""
        rest, _, _ = self._seen(poses, scaled)
        return float(np.sum(rest**2) + np.sum(self._from_given(poses) ** 2) + np.sum(scaled**2))

    def linearized(self, poses: list[gtsam.Pose3], scaled: Array) -> gtsam.GaussianFactorGraph:
        graph = gtsam.GaussianFactorGraph()
        rest, by_pose, by_antenna = self._seen(poses, scaled)
        off = self._from_given(poses)
        unit9, unit6 = gtsam.noiseModel.Unit.Create(9), gtsam.noiseModel.Unit.Create(6)
        for i in range(len(poses)):
            graph.push_back(
                gtsam.JacobianFactor(X(i), by_pose[i], _ANTENNA, by_antenna[i], rest[i], unit9)
            )
            # Close to the mean of the prior the derivative of the logarithm is the identity.
            graph.push_back(gtsam.JacobianFactor(X(i), np.diag(self.weight), -off[i], unit6))
        unit = gtsam.noiseModel.Unit.Create(len(scaled))
        graph.push_back(gtsam.JacobianFactor(_ANTENNA, np.eye(len(scaled)), -scaled, unit))
        return graph
