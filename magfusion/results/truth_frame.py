"""What a constant of the frames, or a standstill of the tracker, explains of a truth's errors."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.truth import LEAST_TURN, SPAN
from magfusion.results.association import AssociatedPoses
from magfusion.units import DEGREE, Array, BoolArray

LEAST_ANGLE = 5.0 * DEGREE  # of a frame; surveys and calibrations do better
CONVENTION = 15.0 * DEGREE  # from the axes of a convention
LEVEL = 2.0 * DEGREE  # of the vertical of a world that is turned by yaw alone
EXPLAINED = 0.3  # of the errors that a constant leaves
MIN_TURNS = 10
MIN_FLATNESS = 0.05  # second extent of a path over the first; along a line the roll is open
FROZEN_MOVE, FROZEN_TURN = 0.1, 5.0 * DEGREE  # m, rad of the estimate; beyond its noise at rest
FROZEN_SHARE = 0.01  # of the compared poses
UP_FROM_DOWN = np.diag([1.0, -1.0, -1.0])


def frame_remarks(pairs: AssociatedPoses) -> list[str]:
    """Return sentences on the frames of a truth, each with its remedy."""
    return [text for text in (_frozen_text(pairs), _world_text(pairs), _body_text(pairs)) if text]


def _frozen_text(pairs: AssociatedPoses) -> str:
    """Return the share of the poses between which the estimate moves and the truth repeats."""
    own, true = pairs.estimate, pairs.truth
    repeats = np.ones(len(true), dtype=bool)
    repeats[1:] = _repeated(true.position_world) & _repeated(true.world_from_body)
    repeats[0] = False
    first = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(true))))
    moved = np.linalg.norm(own.position_world - own.position_world[first], axis=1) > FROZEN_MOVE
    if own.has_attitude:
        angle = (own.rotation[first].inv() * own.rotation).magnitude()
        moved |= (angle > FROZEN_TURN) & true.has_attitude
    share = float(np.mean(repeats & moved))
    if share < FROZEN_SHARE:
        return ""
    return (
        f"The truth is frozen in {100.0 * share:.0f} % of the compared poses: it repeats while the"
        " estimate moves. Use another part of it, or remove the repeated rows."
    )


def _repeated(values: Array) -> BoolArray:
    flat = values.reshape(len(values), -1)
    return np.asarray((flat[1:] == flat[:-1]).all(axis=1) | np.isnan(flat[1:]).any(axis=1))


def _world_text(pairs: AssociatedPoses) -> str:
    """Return how the world of the truth is turned against that of the estimate."""
    turn = _world_turn(pairs)
    if turn is None or turn.magnitude() < LEAST_ANGLE:
        return ""
    up = turn.as_matrix()[:, 2]
    if np.arccos(np.clip(-up[2], -1.0, 1.0)) < CONVENTION:
        return "The truth's world has z down, as NED: give --truth-axes ned."
    angle = float(turn.magnitude()) / DEGREE
    if np.arccos(np.clip(up[2], -1.0, 1.0)) < LEVEL:
        return (
            f"The truth's world is turned by {angle:.0f} deg about the vertical against the"
            " estimate's: give --align yaw."
        )
    return (
        f"The truth's world is turned by {angle:.0f} deg against the estimate's, and not about the"
        " vertical alone: give --align se3."
    )


def _world_turn(pairs: AssociatedPoses) -> Rotation | None:
    """Return ``truth_world_from_world``, where the positions or else the attitudes determine it."""
    own, true = pairs.estimate, pairs.truth
    if own.has_position and true.has_position:
        moved, target = (p.position_world - p.position_world.mean(axis=0) for p in (own, true))
        extent = np.linalg.svd(moved, compute_uv=False)
        if extent[1] < MIN_FLATNESS * extent[0] or extent[1] == 0.0:
            return None
        turn, residual = Rotation.align_vectors(target, moved)
        return turn if residual < EXPLAINED * np.linalg.norm(target - moved) else None
    body = _body_turn(pairs)
    if body is None:
        return None
    offset = true.rotation * (own.rotation * body).inv()
    turn = offset.mean()
    spread = np.sqrt(np.mean((turn.inv() * offset).magnitude() ** 2))
    return turn if spread < EXPLAINED * turn.magnitude() else None


def _body_text(pairs: AssociatedPoses) -> str:
    """Return how the tracked frame is turned against the body."""
    body = _body_turn(pairs)
    if body is None or body.magnitude() < LEAST_ANGLE:
        return ""
    if (body * Rotation.from_matrix(UP_FROM_DOWN)).magnitude() < CONVENTION:
        return (
            "The truth's body axes are forward, right, down: give --truth-axes ned, or"
            " --mounting 180,0,0 where its world has z up."
        )
    rpy = ",".join(f"{angle:.1f}" for angle in body.as_euler("xyz", degrees=True))
    return (
        f"The truth's body axes are turned by {body.magnitude() / DEGREE:.0f} deg against the"
        f" estimate's: give --mounting={rpy}."
    )


def _body_turn(pairs: AssociatedPoses) -> Rotation | None:
    """Return ``body_from_tracked``, where rotations between poses determine it."""
    own, true = pairs.estimate, pairs.truth
    if not (own.has_attitude and true.has_attitude):
        return None
    step = max(1, round(SPAN / float(np.median(np.diff(true.time)))))
    if len(true) <= step:
        return None
    moved, target = (
        (p.rotation[:-step].inv() * p.rotation[step:]).as_rotvec() for p in (own, true)
    )
    active = np.linalg.norm(moved, axis=1) > LEAST_TURN
    extent = np.linalg.svd(moved[active], compute_uv=False) if active.any() else np.zeros(3)
    if np.sum(active) < MIN_TURNS or extent[1] < MIN_FLATNESS * extent[0]:
        return None
    body, residual = Rotation.align_vectors(moved[active], target[active])
    return body if residual < EXPLAINED * np.linalg.norm(target[active]) else None
