"""Stops of the sensor for a calibration, selected one by one by their information.

A stop is a pose kept for some time.  Its information on the calibration is that of its fields with
the pose marginalised, of which only gravity is known; or all of it, for measured poses.  IMU data
between stops are neglected: a log determines more, not less.  Field errors are correlated between
places close to each other: of these only one is selected.

The weight of a parameter is the change of the fields for one sigma of it, where the platform is to
navigate, in units of their noise: so metres, radians and shares can be compared.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.parameters import Block, choose_blocks, initial_calibration, prior_sigma
from magfusion.model.prior import prior_sqrt_information
from magfusion.model.site import Site
from magfusion.results.observability import parameter_names
from magfusion.results.pose_information import (
    NEAREST,
    SURVEY_GROUPS,
    is_free,
    phasor_variance,
    whitened,
)
from magfusion.units import Array, BoolArray, IntArray

ATTITUDES_DEG = (
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 90.0),
    (0.0, 0.0, 180.0),
    (0.0, 0.0, -90.0),
    (90.0, 0.0, 0.0),
    (-90.0, 0.0, 0.0),
    (0.0, 90.0, 0.0),
    (0.0, -90.0, 0.0),
    (180.0, 0.0, 0.0),
)  # roll, pitch, yaw
MAX_PLACES = 120
OUT_OF_REACH = 0.9  # of a sigma, that all stops together leave: no motion determines it
LEVEL_SIGMA = 2e-3  # rad, of gravity, at the least
UNKNOWN = 1e-4  # information (1/rad^2) of a phase of which nothing is known
AT_ONCE = 200


@dataclass(frozen=True, eq=False)
class Parameters:
    """The parameters to calibrate."""

    names: list[tuple[str, str, float]]  # in words, with unit and the unit's size
    sigma: Array  # (k,), declared by the site, as tangent vector
    weight: Array  # (k,), change of the fields for one sigma, in sigmas of their noise
    limit: Array  # (k,), relative to the declared sigma, after all possible stops
    # (k,), whether stops can determine it, and it belongs to the site rather than to one log
    requested: BoolArray

    def worst(self, ratio: Array) -> int:
        """Return the parameter with the largest possible gain in the fields.

        `ratio` (k,): each sigma relative to the declared one.
        """
        return int(np.argmax(np.where(self.requested, self.excess(ratio), -1.0)))

    def excess(self, ratio: Array) -> Array:
        """Return the possible change of the fields from further stops, in sigmas of noise."""
        remaining = np.maximum(ratio**2 - self.limit**2, 0.0)
        return np.asarray(self.weight * np.sqrt(remaining))

    def sized(self, index: int, ratio: float) -> str:
        """Return a sigma with its unit, from its ratio to the declared one."""
        _, unit, size = self.names[index]
        return f"{ratio * self.sigma[index] / size:.2g} {unit}".strip()


@dataclass(frozen=True, eq=False)
class Stop:
    """A pose to keep, and its effect."""

    position_world: Array
    rpy_deg: tuple[float, float, float]
    worst: int  # the parameter for which it is selected
    # before, after: its sigma, relative to the declared one
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Stops in their order, and the remaining sigmas.

    `ratio` (k,): sigma of each parameter after all stops, relative to the declared one.
    """

    stops: tuple[Stop, ...]
    parameters: Parameters
    ratio: Array


@dataclass(frozen=True, eq=False)
class Poses:
    """Candidate stops, and their information."""

    position_world: Array  # (n, 3) (m)
    attitude: IntArray  # (n,), index of `ATTITUDES_DEG`
    # (n, rows, k), of the information on the calibration, in units of the declared sigmas
    root: Array


def next_motion(site: Site, places: Array, count: int, stop: float, *, known: bool) -> MotionPlan:
    """Select stops one after another, each for the parameter that is then the worst.

    `places` (m, 3): possible positions of the platform (m); thinned evenly if many. `stop`:
    duration (s). `known`: whether the poses are measured, as those of a survey.
    """
    blocks = choose_blocks(site, SURVEY_GROUPS)
    poses = candidate_poses(site, blocks, places, stop, known=known)
    information = prior_information(site, blocks)
    limit = _ratio(information + np.sum(np.swapaxes(poses.root, 1, 2) @ poses.root, axis=0))
    parameters = Parameters(
        parameter_names(blocks, initial_calibration(site, 0.0)),
        np.where(is_free(blocks), 1.0, prior_sigma(blocks)),
        _weight(site, blocks, poses.position_world, stop),
        limit,
        ~is_free(blocks) & (limit < OUT_OF_REACH),
    )
    stops: list[Stop] = []
    ratio, fresh = _ratio(information), np.ones(len(poses.root), dtype=bool)
    for _ in range(count if np.any(parameters.requested) else 0):
        worst = parameters.worst(ratio)
        chosen, reached = _best(information, poses, worst, np.flatnonzero(fresh))
        information = information + poses.root[chosen].T @ poses.root[chosen]
        fresh = fresh & ~_shares_model_error(site, poses, chosen)
        fresh = fresh if np.any(fresh) else np.ones_like(fresh)
        stops.append(
            Stop(
                poses.position_world[chosen],
                ATTITUDES_DEG[int(poses.attitude[chosen])],
                worst,
                float(ratio[worst]),
                reached,
            )
        )
        ratio = _ratio(information)
    return MotionPlan(tuple(stops), parameters, ratio)


def prior_information(site: Site, blocks: tuple[Block, ...]) -> Array:
    """Return the site's prior information on the calibration, in units of its sigmas, (k, k)."""
    allowed = is_free(blocks)
    root = (prior_sqrt_information(site, blocks) * prior_sigma(blocks))[~allowed]
    return np.asarray(root.T @ root + UNKNOWN * np.diag(allowed.astype(float)))


def candidate_poses(
    site: Site, blocks: tuple[Block, ...], places: Array, stop: float, *, known: bool
) -> Poses:
    """Return every place in every attitude, with the information of a stop there."""
    places = places[np.unique(np.linspace(0, len(places) - 1, MAX_PLACES).astype(int))]
    centres = np.array([b.position_world for b in site.beacons])
    separate = np.linalg.norm(places[:, None] - centres, axis=2).min(axis=1)
    places = places[separate > NEAREST + np.linalg.norm(site.platform.magnetometer.position_body)]
    variance, calibration = phasor_variance(site, stop), initial_calibration(site, 0.0)
    sigma = np.where(is_free(blocks), 1.0, prior_sigma(blocks))
    level = max(site.platform.imu.accel_bias_sigma / site.gravity, LEVEL_SIGMA)
    roots = []
    for rpy_deg in ATTITUDES_DEG:
        attitude = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()
        seen = whitened(calibration, blocks, variance, attitude, places)
        by_calibration = seen.by_nuisance * sigma
        if known:
            roots.append(by_calibration)
            continue
        x, y, z = attitude[2]  # up, body axes: a turn about it is not felt
        gravity = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / level
        rows = np.zeros((len(places), 3, 6 + len(sigma)))
        rows[:, :, :3] = gravity
        fields = np.concatenate([seen.by_pose, by_calibration], axis=2)
        every = np.concatenate([fields, rows], axis=1)
        missing = max(every.shape[2] - every.shape[1], 0)
        every = np.pad(every, ((0, 0), (0, missing), (0, 0)))
        triangle = np.asarray(np.linalg.qr(every, mode="r"))
        roots.append(triangle[:, 6 : seen.by_pose.shape[1] + 3, 6:])
    count = len(places)
    return Poses(
        np.tile(places, (len(roots), 1)),
        np.repeat(np.arange(len(roots)), count),
        np.concatenate(roots),
    )


def _weight(site: Site, blocks: tuple[Block, ...], places: Array, stop: float) -> Array:
    """Return the change of the fields per unit parameter, in sigmas of noise, rms."""
    level = places[: len(places) // len(ATTITUDES_DEG)]
    calibration = initial_calibration(site, 0.0)
    seen = whitened(calibration, blocks, phasor_variance(site, stop), np.eye(3), level)
    moved = seen.by_nuisance * np.where(is_free(blocks), 1.0, prior_sigma(blocks))
    return np.sqrt(np.mean(np.sum(moved**2, axis=1), axis=0))


def _ratio(information: Array) -> Array:
    return np.sqrt(np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1))


def _shares_model_error(site: Site, poses: Poses, chosen: int) -> BoolArray:
    """Return where the model error is correlated with a stop's: a second one there adds less."""
    if site.model_error == 0.0:
        return np.zeros(len(poses.root), dtype=bool)
    separate = np.linalg.norm(poses.position_world - poses.position_world[chosen], axis=1)
    return np.asarray(separate <= site.model_error_length)


def _best(information: Array, poses: Poses, worst: int, among: IntArray) -> tuple[int, float]:
    """Return the candidate that minimises the sigma of a parameter, and that sigma."""
    result = []
    for start in range(0, len(among), AT_ONCE):
        root = poses.root[among[start : start + AT_ONCE]]
        ratio = _ratio(information + np.swapaxes(root, 1, 2) @ root)
        result.append(ratio[:, worst])
    each = np.concatenate(result)
    chosen = int(np.argmin(each))
    return int(among[chosen]), float(each[chosen])
