"""Estimates of candidate faults from the score: step, evidence, and effect on the poses."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.data_checks.statistics import log_p_chi_square
from magfusion.estimation.integrity.fault_candidates import MAX_SIZE, USUAL, FaultCandidate
from magfusion.estimation.integrity.score import Score
from magfusion.model.parameters import AidingParameter
from magfusion.model.parameters.inertial import GRAVITY, Inertial
from magfusion.units import Array

FARTHEST = 30.0  # typical errors; directions with a larger sigma are ignored
COVERED = 4.0  # mean squared Mahalanobis distance that a covariance of six still covers
MISSING = 5.0  # m/s^2 less than declared: gravity was removed from the data
PRIOR_WIDTH = 3.0  # typical errors, one sigma of what people get wrong: the price of a parameter


@dataclass(frozen=True, eq=False)
class ReleaseGain:
    """A candidate fault with its parameters estimated."""

    fault: FaultCandidate
    step: Array  # (h,), in typical errors
    # direction, information, along: (h, k), (k,), (k,), orthogonal combinations of the fixed
    # parameters, the log's information on each, and the gradient along it
    direction: Array
    information: Array
    along: Array
    # chi_square, freedom: twice the decrease of the cost
    chi_square: float
    freedom: int

    @property
    def cov(self) -> Array:
        """Covariance of the step, shape (h, h), in typical errors."""
        return np.asarray((self.direction / self.information) @ self.direction.T)

    @property
    def known_cov(self) -> Array:
        """The same of the directions that the log determines better than typical errors."""
        known = self.information > 1.0
        vector = self.direction[:, known]
        return np.asarray((vector / self.information[known]) @ vector.T)

    @property
    def code(self) -> str:
        """Code of its finding."""
        (block, *_) = self.fault.blocks
        if block.parameter is GRAVITY and float(block.sigma @ self.step[block.columns]) < -MISSING:
            return "gravity_missing"
        return self.fault.finding_code

    @property
    def is_possible(self) -> bool:
        """Whether no parameter is moved by more than it may be."""
        return all(
            float(np.max(np.abs(b.sigma * self.step[b.columns])))
            < MAX_SIZE.get(b.parameter, np.inf)
            for b in self.fault.blocks
        )

    @property
    def log_p(self) -> float:
        """Logarithm of the probability of this decrease by chance."""
        return float(log_p_chi_square(self.chi_square, self.freedom))

    @property
    def gain(self) -> float:
        """Decrease of -2 log likelihood of the log, the parameters having their prior."""
        return float(np.sum(_evidence(self.along, self.information)))

    @property
    def posterior_gain(self) -> float:
        """The same of -2 log posterior: with how often the parameters are wrong."""
        return self.gain + 2.0 * float(np.log(self.fault.odds))


@dataclass(frozen=True, eq=False)
class ReleasedFault(ReleaseGain):
    """The same with its effect on the poses."""

    moved: Array  # (states, 6), change of the poses
    distance: Array  # (states,), its square, by the covariance of the poses

    @property
    def is_mistake(self) -> bool:
        """Whether the poses err by it more than they claim, or a sensor is farther off than usual.

        What is no farther off than instruments usually are is no mistake.
        """
        blocks = self.fault.blocks
        exceeds = any(
            float(np.linalg.norm(b.sigma * self.step[b.columns])) > USUAL.get(b.parameter, 0.0)
            for b in blocks
        )
        of_sensor = all(isinstance(b.parameter, Inertial | AidingParameter) for b in blocks)
        return exceeds and (of_sensor or float(np.mean(self.distance)) > COVERED)


def gains(combine: Array, information: Array, gradient: Array) -> Array:
    """Return `ReleasedFault.gain` of many candidates; zero without information.

    `combine` (candidates, h, columns): of each, padded with columns of zeros. `information`,
    `gradient` (h, h), (h,): shared, or one per candidate.
    """
    across = np.swapaxes(combine, 1, 2)
    value, vector = np.linalg.eigh(across @ information @ combine)
    along = (np.swapaxes(vector, 1, 2) @ (across @ gradient[..., None]))[..., 0]
    kept = value > FARTHEST**-2
    return np.asarray(np.sum(np.where(kept, _evidence(along, np.maximum(value, 0.0)), 0.0), axis=1))


def _evidence(along: Array, information: Array) -> Array:
    """Return the decrease of -2 log likelihood by each parameter, marginalised over its prior.

    The prior is normal, of `PRIOR_WIDTH` typical errors: it is the price of the parameter.
    """
    prior = PRIOR_WIDTH**-2
    return along**2 / (information + prior) - np.log1p(information / prior)


def release_gain(fault: FaultCandidate, information: Array, gradient: Array) -> ReleaseGain | None:
    """Return the gain of estimating a candidate fault; None without information on it."""
    combine = fault.combine
    value, vector = np.linalg.eigh(combine.T @ information @ combine)
    kept = value > FARTHEST**-2
    if not np.any(kept):
        return None
    vector, value = combine @ vector[:, kept], value[kept]
    along = vector.T @ gradient
    gained, freedom = float(np.sum(along**2 / value)), int(np.sum(kept))
    return ReleaseGain(fault, vector @ (along / value), vector, value, along, gained, freedom)


def release_fault(
    pose_cov: Array, score: Score, fault: FaultCandidate, information: Array, gradient: Array
) -> ReleasedFault | None:
    """Estimate a candidate fault; None without information on it."""
    reported = release_gain(fault, information, gradient)
    if reported is None:
        return None
    moved = score.by_pose @ reported.step
    solved = np.linalg.solve(pose_cov, moved[..., None])[..., 0]
    return ReleasedFault(**vars(reported), moved=moved, distance=np.sum(moved * solved, axis=1))
