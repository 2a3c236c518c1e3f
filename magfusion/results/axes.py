"""Errors and sigmas of a trajectory, axis by axis in the world, and the part of the frame in them.

A log does not determine where the frame of the beacons is: all beacons shifted, or turned about the
vertical, give the same measurements.  The survey alone bounds this part.
"""

from typing import NamedTuple

import numpy as np

from magfusion.model.parameters import BEACON_POSITION, Block, Calibration, prior_sigma
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.figures import Figure, Figures, Section
from magfusion.results.gauge import frame_directions
from magfusion.units import Array

# Axes of a row, with their units; rotations are about axes of the world.
AXES = (("x", "m"), ("y", "m"), ("z", "m"), ("rot_x", "deg"), ("rot_y", "deg"), ("yaw", "deg"))
ROWS = {
    "error": "error",
    "sigma": "sigma",
    "frame_sigma": "sigma of the common frame (survey)",
    "frame_removed_error": "error without the frame",
    "frame_removed_sigma": "sigma without the frame",
}
_TOLERANCE = 1.02  # of the sigma, which other sensors reduce where they determine the frame


class Frame(NamedTuple):
    """Uncertainty of the frame of the beacons.

    `cov` (4, 4): of x, y, z and yaw (m, rad). `survey_m`: declared sigma of the beacons' positions,
    per axis.
    """

    cov: Array
    survey_m: float


def survey_frame(calibration: Calibration, blocks: tuple[Block, ...]) -> Frame | None:
    """Return the uncertainty of the frame by the survey; None where the frame is fixed.

    Along a gauge direction the posterior is the prior.
    """
    moves = frame_directions(calibration.site.beacons, blocks)
    if moves is None:
        return None
    scaled = moves / prior_sigma(blocks)[:, None]
    places = [block.sigma for block in blocks if block.parameter == BEACON_POSITION]
    survey = float(np.sqrt(np.mean(np.concatenate(places) ** 2)))
    return Frame(np.asarray(np.linalg.inv(scaled.T @ scaled)), survey)


def axis_figures(
    states: Trajectory, errors: TrajectoryErrors | None, frame: Frame | None = None
) -> Figures:
    """Return errors and sigmas of each axis, root mean square over the same epochs.

    `errors`: of these states. `frame`: as from `survey_frame`.
    """
    turn, place, cov = states.world_from_body, states.position_world, states.pose_cov
    if errors is not None and not errors.at_truth:
        place, turn, cov = place[errors.compared], errors.world_from_body, errors.pose_cov
    rows: dict[str, Array] = {}
    error = None if errors is None else _world_errors(errors)
    if error is not None:
        rows["error"] = _rms(error)
    if cov is not None:
        variance = _world_variance(turn, cov)
        rows["sigma"] = np.sqrt(np.mean(variance, axis=0))
        part = None if frame is None else _frame_variance(place, frame.cov)
        if part is not None and np.all(part.mean(axis=0) <= _TOLERANCE**2 * variance.mean(axis=0)):
            rows["frame_sigma"] = np.sqrt(part.mean(axis=0))
            remaining = np.sqrt(np.maximum(variance - part, 0.0).mean(axis=0))
            if error is not None and np.isfinite(error).all() and len(error) == len(place):
                rows["frame_removed_error"] = _rms(_frame_removed(error, place, remaining))
            rows["frame_removed_sigma"] = remaining
    labels = ROWS if frame is None else ROWS | {"frame_sigma": _frame_label(frame)}
    return Figures(
        *(
            Figure(f"{row}_{axis}_{unit}", value, unit, None, Section.AXES, labels[row])
            for row in ROWS
            if row in rows
            for (axis, unit), value in zip(AXES, _in_units(rows[row]), strict=True)
            if np.isfinite(value)
        )
    )


def _frame_label(frame: Frame) -> str:
    return f"common frame (survey ± {1e3 * frame.survey_m:.3g} mm)"


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _in_units(row: Array) -> list[float]:
    return [*row[:3].tolist(), *np.rad2deg(row[3:]).tolist()]


def _world_errors(errors: TrajectoryErrors) -> Array:
    """Return position and rotation vector of the errors in world axes (m, rad), shape (n, 6)."""
    rotated = (errors.world_from_body @ errors.attitude_body[..., None])[..., 0]
    return np.concatenate([errors.position_world, rotated], axis=1)


def _world_variance(world_from_body: Array, pose_cov: Array) -> Array:
    """Return the variances of position and rotation in world axes, shape (n, 6)."""
    parts = [
        np.einsum("nij,njk,nik->ni", world_from_body, pose_cov[:, part, part], world_from_body)
        for part in (slice(3, 6), slice(0, 3))
    ]
    return np.concatenate(parts, axis=1)


def _moves(place: Array) -> Array:
    """Return the motion of poses with the frame, shape (n, 6, 4)."""
    moves = np.zeros((len(place), 6, 4))
    moves[:, [0, 1, 2, 5], [0, 1, 2, 3]] = 1.0
    moves[:, 0, 3], moves[:, 1, 3] = -place[:, 1], place[:, 0]
    return moves


def _frame_variance(place: Array, frame: Array) -> Array:
    moves = _moves(place)
    return np.asarray(np.einsum("nij,jk,nik->ni", moves, frame, moves))


def _frame_removed(error: Array, place: Array, sigma: Array) -> Array:
    """Return the errors without the best-fitting motion of the frame, weighted by their sigmas."""
    weight = 1.0 / np.maximum(sigma, np.finfo(np.float64).tiny)
    moves = _moves(place)
    system, target = weight[:, None] * moves, weight * error
    motion = np.linalg.lstsq(system.reshape(-1, 4), target.ravel(), rcond=None)[0]
    return error - moves @ motion
