"""Relative position of two wells, from a rotating magnet that passes a sensor at rest."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.ranging.ranging_data import RangingWindows
from magfusion.estimation.ranging.ranging_model import RangingModel
from magfusion.estimation.ranging.ranging_starts import starts
from magfusion.estimation.solve.batched import (
    NormalEquations,
    Solution,
    minimise,
    moved_poses,
    normal_equations,
)
from magfusion.model.field import skew
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray, IntArray

MAX_ITERATIONS, BEST_ITERATIONS, FOLLOWED = 40, 60, 3
THINNED = 24  # approximate number of windows for the comparison of starts
KEPT = 24  # starts that are refined


@dataclass(frozen=True, eq=False)
class Ranged:
    """The sensor's pose relative to the magnet, of the most probable start and of its rivals."""

    world_from_body: Array  # (3, 3), attitude of the high side's frame in that of the rotor
    position_world: Array  # (3,), of the sensor when both are at the windows' depth origins (m)
    names: tuple[str, ...]  # of the parameters estimated with the pose
    values: Array  # (names,)
    prior_sigma: Array  # (names,)
    # (6 + names, 6 + names), rotation and translation in the axes of the high side's frame
    # (rad, m), then the names
    cov: Array
    chi_square: float  # without priors
    freedom: int
    rival_chi_square: float  # of the second-best separate minimum; infinite where there is none
    residual: Array
    converged: bool


def _moved(state: Array, step: Array) -> Array:
    """Return states moved along the screws of their steps, as in a rotation about the magnet."""
    turn, angle = step[:, :3], np.linalg.norm(step[:, :3], axis=1)[:, None, None]
    small = np.maximum(angle, 1e-4)
    cross = skew(turn)
    first = np.where(angle < 1e-4, 0.5 - angle**2 / 24.0, (1.0 - np.cos(small)) / small**2)
    second = np.where(angle < 1e-4, 1.0 / 6.0, (small - np.sin(small)) / small**3)
    bent = (np.eye(3) + first * cross + second * cross @ cross) @ step[:, 3:6, None]
    poses = moved_poses(state[:, :12], np.concatenate([turn, bent[..., 0]], axis=1))
    return np.concatenate([poses, state[:, 12:] + step[:, POSE:]], axis=1)


def find_range(site: Site, windows: RangingWindows) -> Ranged:
    """Return the pose of the sensor relative to the magnet.

    `site`: its only beacon is a rotor.
    """
    every = max(len(windows.fields) // THINNED, 1)
    thin = RangingModel(site, windows.rows(slice(every // 2, None, every)))
    tried = _solved(thin, starts(thin)[:KEPT], MAX_ITERATIONS)
    result = _solved(RangingModel(site, windows), tried.state[:FOLLOWED], BEST_ITERATIONS)
    # Weighted at the most probable: its rivals by the same weights, as a likelihood requires.
    model = RangingModel(site, windows, about=result.state[0])
    result = _solved(model, result.state, BEST_ITERATIONS)
    best = result.state[:1]
    error, _ = model.residuals(best)
    rival = result.cost[_elsewhere(model, result.state, windows)]
    used = 2 * 3 * int(np.sum(windows.fields.valid))
    used -= 0 if windows.angle_known else len(windows.fields) + POSE - 5
    return Ranged(
        world_from_body=best[0, :9].reshape(3, 3),
        position_world=best[0, 9:12],
        names=model.names,
        values=best[0, 12:],
        prior_sigma=model.prior,
        cov=np.linalg.pinv(result.information[0], hermitian=True),
        chi_square=float(np.sum(error**2)),
        freedom=max(used - POSE, 1),
        rival_chi_square=float(np.min(rival - result.cost[0], initial=np.inf)),
        residual=error[0],
        converged=bool(result.converged[0]),
    )


def _solved(model: RangingModel, starts: Array, max_iterations: int) -> Solution:
    """Return the solutions of starts, the most probable first."""

    def normal(rows: IntArray, state: Array) -> NormalEquations:
        del rows
        return normal_equations(*model.with_priors(state))

    result = minimise(normal, starts, _moved, max_iterations=max_iterations)
    order = np.argsort(np.where(np.isfinite(result.cost), result.cost, np.inf))
    return Solution(
        result.state[order], result.cost[order], result.information[order], result.converged[order]
    )


def _elsewhere(model: RangingModel, states: Array, windows: RangingWindows) -> BoolArray:
    """Return which states differ from the first, as seen from the sensor."""
    rotation, place = states[:, :9].reshape(-1, 3, 3), states[:, 9:12]
    middle = float(np.median(windows.magnet))
    seen = np.einsum("kba,kb->ka", rotation, middle * model.axis - place)
    along = np.einsum("kba,b->ka", rotation, model.axis)
    far = np.linalg.norm(seen - seen[0], axis=1) > 0.05 * np.linalg.norm(seen[0])
    return far | (np.linalg.norm(along - along[0], axis=1) > 0.1)
