"""Attitude from a database of field vectors: paper 001, section 2, with and without interpolation.

The matched entry is that of Eq 17 and 18, `magfusion.papers.p001_magnetometer.equations`.  Where
the field is known, `magfusion.papers.p001_magnetometer.matching` is at least as accurate without a
database; a database is useful where the platform distorts the field in an unmodelled way.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from magfusion.errors import InputError
from magfusion.files.attitude_table import MIN_ENTRIES, Angles, AttitudeDatabase
from magfusion.papers.p001_magnetometer.matching import (
    MIN_SHARE,
    THREE_ANGLES,
    Matches,
    check_roll_axis,
    fold_side,
    predict_field,
    roll_sigma,
    with_other_pitch,
    wrap,
)
from magfusion.units import DEGREE, Array, IntArray

FIXED = 2.0 * DEGREE  # rad; a yaw that is free by this much costs up to 4 of the paper's 5 degrees
NEIGHBOURS = {"roll": 3, "roll-pitch": 9}
# Relative to the neighbours' extent: directions in which they extend less have no slope.
_FLAT = 0.05
_CHUNK = 50_000  # fields at once
_OUTSIDE = 3.0  # spacings of the database


@dataclass(frozen=True, eq=False)
class Index:
    """A database ready for queries."""

    database: AttitudeDatabase
    tree: KDTree  # over the compared components (T)
    field_world: Array  # (3,), the uniform field that best fits the entries (T)
    sigma: float  # its residual, per component (T)
    spacing: float  # nearest-neighbour distance of an entry (T), 95th percentile
    side: int  # of the fold on which all entries lie


@dataclass(frozen=True, eq=False)
class Built:
    """A database, and the number of excluded measurements."""

    database: AttitudeDatabase
    # measurements on the rarer side of the fold, where the same fields have other attitudes
    beyond_fold: int


def build_database(
    field_body: Array,
    world_from_body: Array,
    source: str,
    angles: str | None = None,
    step: float = 1.0 * DEGREE,
) -> Built:
    """Return a database of measurements with known attitude.

    Parameters
    ----------
    field_body : ndarray, shape (n, 3)
        (T), calibrated.
    world_from_body : ndarray, shape (n, 3, 3)
        Of the reference.
    source : str
        Log of the measurements.
    angles : {"roll", "roll-pitch"}, optional
        Angles to estimate; default: those that vary.
    step : float
        Measurements within one cell of this size in each angle are averaged (rad).

    Raises
    ------
    InputError
        Where an angle that must be fixed varies, the field does not determine a requested angle, or
        too few attitudes remain.
    """
    chosen, rpy = _angles_of(world_from_body, angles)
    beyond = np.zeros(len(rpy), dtype=bool)
    field_world = np.mean(np.einsum("nij,nj->ni", world_from_body, field_body), axis=0)
    if chosen == "roll":
        check_roll_axis(float(rpy[0, 1]), float(rpy[0, 2]), field_world)
    else:
        side = fold_side(rpy[:, 1], rpy[:, 2], field_world)
        usual = 1.0 if np.sum(np.sign(side)) >= 0.0 else -1.0
        beyond = usual * side < MIN_SHARE
    thinned = _thin(field_body[~beyond], rpy[~beyond], step)
    if len(thinned[0]) < MIN_ENTRIES:
        raise InputError(
            f"holds {len(thinned[0])} attitudes that differ by {step / DEGREE:g} degrees and do not"
            f" lie beyond the fold; a database requires {MIN_ENTRIES}; rotate the platform"
            " through all attitudes to be estimated"
        )
    return Built(AttitudeDatabase(*thinned, chosen, source), int(np.sum(beyond)))


def prepare(database: AttitudeDatabase) -> Index:
    """Return a database ready for queries.

    Raises InputError where a fixed angle varies, or the entries lie on both sides of the fold.
    """
    fixed = (1, 2) if database.angles == "roll" else (2,)
    for axis in fixed:
        name = ("roll", "pitch", "yaw")[axis]
        if np.ptp(wrap(database.rpy[:, axis] - database.rpy[0, axis])) > 1e-6:
            raise InputError(f"its {name} varies and must be fixed; {THREE_ANGLES}")
    rotated = np.stack([predict_field(database.rpy, axis) for axis in np.eye(3)], axis=-1)
    field_world = np.einsum("nij,ni->j", rotated, database.field_body) / len(database)
    residual = database.field_body - predict_field(database.rpy, field_world)
    side = fold_side(database.rpy[:, 1], database.rpy[:, 2], field_world)
    if database.angles == "roll-pitch" and np.min(side) * np.max(side) <= 0.0:
        raise InputError(
            "its entries lie on both sides of the fold of pitch, where one field has two attitudes;"
            " keep those of one side"
        )
    tree = KDTree(_compared(database.angles, database.field_body))
    gap, _ = tree.query(tree.data, k=2)
    return Index(
        database=database,
        tree=tree,
        field_world=field_world,
        sigma=float(np.sqrt(np.mean(residual**2))),
        spacing=float(np.quantile(gap[:, 1], 0.95)),
        side=1 if float(np.mean(side)) >= 0.0 else -1,
    )


def nearest_entries(index: Index, field_body: Array, count: int = 1) -> tuple[Array, IntArray]:
    """Return distance (T) and row of the entries nearest to each field, shape (n, count)."""
    requested = _compared(index.database.angles, field_body)
    distance, row = index.tree.query(requested, k=np.arange(1, count + 1))
    return distance, row


def match_nearest(index: Index, field_body: Array, sigma: float) -> Matches:
    """Return the attitude of the entry nearest to each field (n, 3) (T), as in the paper."""
    distance, row = nearest_entries(index, field_body)
    return _matches(index, field_body, index.database.rpy[row[:, 0]], distance[:, 0], sigma)


def match_interpolated(index: Index, field_body: Array, sigma: float) -> Matches:
    """Return the attitude from an affine map fitted to the entries nearest to each field (n, 3)."""
    rows = [slice(k, k + _CHUNK) for k in range(0, len(field_body), _CHUNK)]
    parts = [_interpolated(index, field_body[part]) for part in rows]
    rpy, distance, residual = (np.concatenate(part) for part in zip(*parts, strict=True))
    result = _matches(index, field_body, rpy, distance, sigma, interpolated=True)
    result.sigma[:, 0] = np.hypot(result.sigma[:, 0], residual)
    return result


def _interpolated(index: Index, field_body: Array) -> tuple[Array, Array, Array]:
    """Return angles, distance of the nearest entry (T), and the map's residuals in the angles."""
    kind = index.database.angles
    distance, row = nearest_entries(index, field_body, NEIGHBOURS[kind])
    near = _unit(_compared(kind, index.database.field_body[row]))
    requested = _unit(_compared(kind, field_body))
    centre = np.mean(near, axis=1)
    # Only directions count; the length is noise.  The fit is in the plane across the centre.
    across = np.eye(near.shape[-1]) - _unit(centre)[:, :, None] * _unit(centre)[:, None, :]
    spread = (near - centre[:, None]) @ across
    known = index.database.rpy[row]
    rotated = wrap(known - known[:, :1])
    mean = np.mean(rotated, axis=1)
    slope = np.linalg.pinv(spread, rcond=_FLAT) @ (rotated - mean[:, None])
    rpy = known[:, 0] + mean + ((requested - centre)[:, None] @ across @ slope)[:, 0]
    rpy[:, 0] = wrap(rpy[:, 0])
    # The residuals of an affine map at the neighbours are those between them too.
    residual = rotated - mean[:, None] - spread @ slope
    free_parameters = residual.shape[1] - (2 if kind == "roll" else 3)
    return rpy, distance[:, 0], np.sqrt(np.sum(residual**2, axis=1) / free_parameters)


def _matches(
    index: Index,
    field_body: Array,
    rpy: Array,
    distance: Array,
    sigma: float,
    *,
    interpolated: bool = False,
) -> Matches:
    within = distance <= _OUTSIDE * index.spacing + 5.0 * np.hypot(sigma, index.sigma)
    # The nearest entry is off by up to half a spacing, uniformly.
    step = 0.0 if interpolated else index.spacing / np.sqrt(12.0)
    total = float(np.sqrt(sigma**2 + index.sigma**2 + step**2))
    if index.database.angles == "roll-pitch":
        result = with_other_pitch(rpy, field_body, index.field_world, total, within)
        result.residual[:, 0] = distance
        return result
    spread = roll_sigma(rpy, index.field_world, total)
    return Matches(rpy[:, None], spread[:, None], distance[:, None], within[:, None])


def _compared(angles: Angles, field_body: Array) -> Array:
    """Return the components that determine the attitude: a rotation about x keeps its own."""
    return field_body[..., 1:] if angles == "roll" else field_body


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _angles_of(world_from_body: Array, angles: str | None) -> tuple[Angles, Array]:
    """Return the varying angles, and the angles with the others fixed at their mean."""
    axis = world_from_body[:, :, 0]
    mean = _unit(np.mean(axis, axis=0))
    turning = np.arccos(np.clip(axis @ mean, -1.0, 1.0))
    if angles == "roll" or (angles is None and np.max(turning) <= FIXED):
        if np.max(turning) > FIXED:
            raise InputError(
                f"the axis of roll rotates by {np.max(turning) / DEGREE:.3g} degrees from its mean;"
                f" at most {FIXED / DEGREE:g} are allowed; keep pitch and yaw fixed, or select roll"
                " and pitch"
            )
        level = float(np.hypot(mean[0], mean[1]))
        # On a vertical axis yaw and roll coincide: roll then counts from world x.
        yaw = float(np.arctan2(mean[1], mean[0])) if level > np.sin(FIXED) else 0.0
        return "roll", angles_about(world_from_body, yaw, -float(np.arctan2(mean[2], level)))
    heading = np.arctan2(axis[:, 1], axis[:, 0])
    yaw = float(np.angle(np.mean(np.exp(1j * heading))))
    turning = np.abs(wrap(heading - yaw))
    if angles not in (None, "roll-pitch") or np.max(turning) > FIXED:
        raise InputError(
            f"the yaw rotates by {np.max(turning) / DEGREE:.3g} degrees from its mean; at most"
            f" {FIXED / DEGREE:g} are allowed; {THREE_ANGLES}"
        )
    return "roll-pitch", angles_about(world_from_body, yaw)


def angles_about(world_from_body: Array, yaw: Array | float, pitch: float | None = None) -> Array:
    """Return roll, pitch, yaw (n, 3) (rad) of attitudes (n, 3, 3), fixed at the values given (rad).

    Defined at a vertical x axis too, where roll and yaw coincide.
    """
    n = len(world_from_body)
    if pitch is None:
        tilt = -np.arcsin(np.clip(world_from_body[:, 2, 0], -1.0, 1.0))
    else:
        tilt = np.full(n, pitch)
    # The image of body y in the axes of the pitched frame is (0, cos roll, sin roll).
    y_axis = world_from_body[:, :, 1]
    level_x = np.cos(yaw) * y_axis[:, 0] + np.sin(yaw) * y_axis[:, 1]
    level_y = np.cos(yaw) * y_axis[:, 1] - np.sin(yaw) * y_axis[:, 0]
    up = np.sin(tilt) * level_x + np.cos(tilt) * y_axis[:, 2]
    return np.stack([np.arctan2(up, level_y), tilt, np.broadcast_to(yaw, n)], axis=1)


def _thin(field_body: Array, rpy: Array, step: float) -> tuple[Array, Array]:
    """Average the measurements in one cell of roll and pitch."""
    cells = np.floor(rpy[:, :2] / step).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell).astype(np.float64)[:, None]

    def mean(values: Array) -> Array:
        columns = [np.bincount(cell, weights=column) for column in values.T]
        return np.stack(columns, axis=1) / count

    return mean(field_body), mean(rpy)
