"""Initial states for the fix of a receiver of two axes about a single source of three coils.

The field matrix of concentric coils is ``c/r^3 (3 n n^T - 1) K``, with K the moments.  With K and
the receiver's own skew removed, two axes s_1, s_2 measure ``A = c/r^3 (3 n n^T - 1) S`` with S
orthonormal, and ``A^T A - 3/4 (A^T n)(A^T n)^T = (c/r^3)^2``.  The smaller eigenvalue of ``A^T A``
therefore gives the range and the larger, with its vector, ``A^T n``: two numbers of the direction n
of three, and its length.  Four poses explain an epoch: of both signs, either with its mirror in the
plane of the columns of A.
"""

from itertools import product

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.axis_starts import phases_of
from magfusion.estimation.snapshot.coil_starts import at_point, middle_of
from magfusion.estimation.snapshot.problem import FixProblem, FixState
from magfusion.model.parameters import predict_channels
from magfusion.model.site import Site
from magfusion.units import TINY, Array, BoolArray, ComplexArray

FLAT = 1e-6  # of the largest singular value; coils of which one adds no direction
REFERENCE = 1.0  # m; distance at which the source is first evaluated


def is_single_source(site: Site) -> bool:
    """Return whether all beacons of a site are at one position."""
    return not middle_of(site.beacons)[1] > 0.0


def starts_about_one(problem: FixProblem) -> tuple[FixState, int]:
    """Return the states that explain epochs of two axes, so many rows an epoch.

    `problem`: its whitening is zero where a component is missing. Raises EstimationError where the
    receiver has one axis, or the source's coils span no space.
    """
    site = problem.calibration.site
    if len(site.platform.magnetometer.axes) == 1:
        raise EstimationError(
            "a receiver of one axis measures three numbers of a single source of three coils, but"
            " position and direction are five: add separate sources, or a second axis"
        )
    there = np.einsum("...ii->...i", problem.sqrt_information) > 0.0
    measured = problem.measured[..., :3] + 1j * problem.measured[..., 3:]
    free_parameters = np.concatenate(
        [np.full(len(b.tones), not b.synchronised) for b in site.beacons]
    )
    distance = REFERENCE
    for _ in range(2):  # near coils are not dipoles: evaluate them at the measured distance
        source = _source(problem, distance)
        turn, offset = _poses(problem, measured, there, free_parameters, source)
        distance = float(np.median(np.linalg.norm(offset, axis=-1)))
    lever = site.platform.magnetometer.position_body
    position = middle_of(site.beacons)[0] + offset - turn @ lever
    if problem.prior is not None:
        turn = np.concatenate([problem.prior.rotation[:, None], turn], axis=1)
        position = np.concatenate([problem.prior.position[:, None], position], axis=1)
    n, count = turn.shape[:2]
    state = problem.start(turn.reshape(-1, 3, 3), position.reshape(-1, 3))
    if np.any(free_parameters):
        own = problem.rows(np.repeat(np.arange(n), count))
        state = state._replace(phase=phases_of(own, state, free_parameters))
    return state, count


def _source(problem: FixProblem, distance: float) -> ComplexArray:
    """Return the moment of each coil as half its axial field at 1 m, (channels, 3) (T)."""
    middle, ahead = middle_of(problem.calibration.site.beacons)[0], np.array([1.0, 0.0, 0.0])
    where = (middle + distance * ahead)[None]
    time = np.array([float(np.mean(problem.time))])
    seen = predict_channels(at_point(problem.calibration), time, np.eye(3)[None], where)[0]
    moments = distance**3 * seen @ np.linalg.inv(3.0 * np.outer(ahead, ahead) - np.eye(3))
    size = np.linalg.svd(np.concatenate([moments.real, moments.imag]), compute_uv=False)
    if size[-1] < FLAT * size[0]:
        raise EstimationError(
            "a single source whose coils are in one plane does not determine the pose of a"
            " receiver of two axes; give it a third coil, or add separate sources"
        )
    return np.asarray(moments)


def _poses(
    problem: FixProblem,
    measured: ComplexArray,
    there: BoolArray,
    free_parameters: BoolArray,
    source: ComplexArray,
) -> tuple[Array, Array]:
    """Return attitudes (n, k, 3, 3) of the body and positions (n, k, 3) from the source (m)."""
    sensor = problem.calibration.site.platform.magnetometer
    body = sensor.matrix @ sensor.body_from_sensor.T
    turns, offsets = [], []
    for value, own in zip(measured, there, strict=True):
        axes = np.sort(np.argsort(-np.sum(own, axis=0), kind="stable")[:2])
        lower = np.linalg.cholesky(body[axes] @ body[axes].T)
        square = np.linalg.inv(lower) @ body[axes]  # orthonormal, body axes
        turn, offset = [], []
        for real, moments in _signed(value[:, axes], own[:, axes], free_parameters, source):
            column = [
                np.linalg.lstsq(moments[rows], part[rows], rcond=None)[0]
                for part, rows in zip(real.T, np.isfinite(real).T, strict=True)
            ]
            flat = np.stack(column, axis=1) @ np.linalg.inv(lower).T
            for direction, size in _directions(flat):
                turn.append(_attitude(flat, direction, square))
                offset.append(direction * size ** (-1.0 / 3.0))
        turns.append(turn)
        offsets.append(offset)
    return np.array(turns), np.array(offsets)


def _signed(
    value: ComplexArray, own: BoolArray, free_parameters: BoolArray, source: ComplexArray
) -> list[tuple[Array, Array]]:
    """Return measurements and moments as real rows; NaN where missing.

    For coils of unknown phase, once with each choice of their signs.
    """
    known = np.where(own, value, 0.0)
    if not np.any(free_parameters):
        both = np.where(own, value, np.nan)
        rows = np.concatenate([both.real, both.imag])
        return [(rows, np.concatenate([source.real, source.imag]))]
    rotated = np.exp(-0.5j * np.angle(np.sum(known**2, axis=1)))
    real = np.where(own, (rotated[:, None] * value).real, np.nan)
    phase = np.exp(-0.5j * np.angle(np.sum(source**2, axis=1)))
    signs = [np.array(s)[:, None] for s in product((1.0, -1.0), repeat=len(value))]
    return [(sign * real, (phase[:, None] * source).real) for sign in signs]


def _directions(flat: Array) -> list[tuple[Array, float]]:
    """Return the directions from the source, each with ``c/r^3`` of unit moments."""
    value, vector = np.linalg.eigh(flat.T @ flat)
    size = float(np.sqrt(max(value[0], 1e-12 * value[1], TINY)))
    along = np.sqrt(4.0 / 3.0 * max(value[1] - value[0], 0.0)) * vector[:, 1]
    within = np.linalg.pinv(flat.T) @ along
    within = within / max(float(np.linalg.norm(within)), 1.0)
    across = np.linalg.svd(flat.T)[2][-1]
    others = np.sqrt(max(1.0 - float(within @ within), 0.0)) * across
    return [
        (sign * part, size) for sign in (1.0, -1.0) for part in (within + others, within - others)
    ]


def _attitude(flat: Array, direction: Array, square: Array) -> Array:
    """Return the attitude for the measurements of two axes and the direction of the source."""
    world = (1.5 * np.outer(direction, direction) - np.eye(3)) @ flat
    residual, _, right = np.linalg.svd(world, full_matrices=False)
    axes = residual @ right
    ends = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
    own = np.column_stack([square.T, np.cross(square[0], square[1])])
    return np.asarray(ends @ own.T)
