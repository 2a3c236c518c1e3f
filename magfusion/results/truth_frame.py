"""What a constant of frames, clock or unit, or a standstill, explains of a truth's errors."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.truth import (
    MAX_DELAY,
    MIN_DELAY,
    MIN_ROTATION,
    SPAN,
    attitude_spans,
    quaternion_text,
    rotation_changes,
)
from magfusion.results.alignment import MIN_RATE
from magfusion.results.association import AssociatedPoses
from magfusion.units import DEGREE, Array, BoolArray

MIN_ANGLE = 5.0 * DEGREE  # of a frame; surveys and calibrations do better
CONVENTION = 15.0 * DEGREE  # from the axes of a convention
LEVEL = 2.0 * DEGREE  # of the vertical of a world that is turned by yaw alone
EXPLAINED = 0.3  # of the errors that a constant leaves
MIN_TURNS = 10
MIN_FLATNESS = 0.05  # second extent of a path over the first; along a line the roll is open
FROZEN_MOVE, FROZEN_TURN = 0.1, 5.0 * DEGREE  # m, rad of the estimate; beyond its noise at rest
FROZEN_SHARE = 0.01  # of the compared poses
UP_FROM_DOWN = np.diag([1.0, -1.0, -1.0])


# Lengths of other units (m), and how far from their ratio an estimate may be.
UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "km": 1e3}
UNIT_TOLERANCE = 0.1


def frame_remarks(pairs: AssociatedPoses, inertial: Sequence[str] = ()) -> list[str]:
    """Return sentences on frames and clock of a truth, each with its remedy.

    `inertial`: how the truth contradicts the inertial samples of its log. They name a delay better
    than the estimate does, which shows more of the rotation.
    """
    frozen = _frozen_text(pairs)
    quaternion = "" if frozen else _quaternion_text(pairs)
    others = [quaternion] if quaternion else list(inertial)
    if not frozen and not others:
        others = [_delay_text(pairs)]
    return [text for text in (frozen, *others, _world_text(pairs), _body_text(pairs)) if text]


def unit_text(pairs: AssociatedPoses) -> str:
    """Return the unit of the truth's positions, where they are an estimate's times its ratio."""
    own, true = pairs.estimate, pairs.truth
    if not (own.has_position and true.has_position and len(true) > MIN_TURNS):
        return ""
    moved, target = (p.position_world - p.position_world.mean(axis=0) for p in (own, true))
    length = np.linalg.norm(moved)
    scale = np.linalg.norm(target) / max(float(length), 1e-12)
    for unit, size in UNITS.items():
        if abs(scale * size - 1.0) < UNIT_TOLERANCE:
            off = _rotated(moved, size * target) - size * target
            if np.linalg.norm(off) < EXPLAINED * length:
                return (
                    f"The truth's positions are {scale:.3g} times those of the estimate: they are"
                    f" in {unit}. Import it with --map 'truth.position=NAMES[{unit}]'."
                )
    return ""


def _is_flat(vectors: Array) -> bool:
    """Return whether vectors (n, 3) are along a line, about which the roll is open."""
    extent = np.linalg.svd(vectors, compute_uv=False)
    return bool(extent[1] < MIN_FLATNESS * extent[0] or extent[1] == 0.0)


def _rotated(moved: Array, target: Array) -> Array:
    """Return one centred path (n, 3) rotated to fit another; as it is along a line."""
    if _is_flat(moved) or _is_flat(target):
        return moved
    return np.asarray(Rotation.align_vectors(target, moved)[0].apply(moved))


def _quaternion_text(pairs: AssociatedPoses) -> str:
    """Return the order or the direction of the truth's quaternion that the estimate shows."""
    own, true = pairs.estimate, pairs.truth
    if not (own.has_attitude and true.has_attitude):
        return ""
    rows = attitude_spans(true.time)
    text = quaternion_text(true.rotation, rows, rotation_changes(own.rotation, rows))
    return f"The truth's {text.removeprefix('its ')}" if text else ""


def _delay_text(pairs: AssociatedPoses) -> str:
    """Return by how much the truth's clock is late, where errors are proportional to motion."""
    own, true = pairs.estimate, pairs.truth
    if len(true) <= MIN_TURNS:
        return ""
    error, speed = np.zeros((1, 3)), np.zeros((1, 3))
    other = ""
    if own.has_attitude and true.has_attitude:
        ahead = np.arange(1, len(true))
        step = rotation_changes(true.rotation, np.stack([ahead - 1, ahead], axis=1))
        speed = step / np.diff(true.time)[:, None]
        world = (own.rotation * true.rotation.inv()).mean()
        off = (true.rotation.inv() * world.inv() * own.rotation).as_rotvec()
        error = 0.5 * (off[1:] + off[:-1])
    if np.std(speed) < MIN_RATE and own.has_position and true.has_position:
        moved, target = (p.position_world - p.position_world.mean(axis=0) for p in (own, true))
        error, speed = _rotated(moved, target) - target, np.gradient(target, true.time, axis=0)
        other = ", or --lever-arm if it tracks a point ahead or behind"
    error, speed = error - error.mean(axis=0), speed - speed.mean(axis=0)
    delay = float(np.sum(error * speed)) / max(float(np.sum(speed**2)), 1e-12)
    remaining = float(np.sum((error - delay * speed) ** 2))
    if not MIN_DELAY < abs(delay) < MAX_DELAY or remaining > EXPLAINED * np.sum(error**2):
        return ""
    return (
        f"The truth's clock is about {1e3 * abs(delay):.0f} ms {'late' if delay > 0.0 else 'early'}"
        f" against the estimate's: give --align-time{other}."
    )


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
    if turn is None or turn.magnitude() < MIN_ANGLE:
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
        if _is_flat(moved) or _is_flat(target):
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
    if body is None or body.magnitude() < MIN_ANGLE:
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
    active = np.linalg.norm(moved, axis=1) > MIN_ROTATION
    if np.sum(active) < MIN_TURNS or _is_flat(moved[active]) or _is_flat(target[active]):
        return None
    body, residual = Rotation.align_vectors(moved[active], target[active])
    return body if residual < EXPLAINED * np.linalg.norm(target[active]) else None
