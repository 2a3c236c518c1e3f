"""Observability of a tracker's antennas from a survey: rank, null space and minimum pose count.

Computed from singular values of the whitened Jacobian; uncertain pose components are eliminated
first by projection.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.calibration.antenna import AntennaSurvey
from magfusion.model.antenna import (
    CENTRES,
    KAPPAS,
    MOMENTS,
    SENSITIVITIES,
    SENSOR_CENTRES,
    Antenna,
    observe_antenna,
)
from magfusion.model.field import skew
from magfusion.units import Array

NO_INFORMATION = 1e-8  # of the largest singular value; arithmetic leaves 1e-13, weak poses 1e-3
SAME = 1e-3  # how far a gauge may stand out of the null space and still be in it
_PARTS = {
    "moments": MOMENTS,
    "transmitter centres": CENTRES,
    "sensitivities": SENSITIVITIES,
    "receiver centres": SENSOR_CENTRES,
    "sizes": KAPPAS,
}


@dataclass(frozen=True, eq=False)
class AntennaObservability:
    """Observability of the antennas from couplings at some poses."""

    parameters: int
    rank: int
    # relative to the largest, in descending order: parameters are relative to the coils' moments
    # and sensitivities and to the mean distance
    singular: Array
    null_space: tuple[str, ...]  # one line for each group of undetermined combinations, in words
    min_poses: int  # number of these poses, in their order, with which the rank is reached


def observability(
    survey: AntennaSurvey,
    antenna: Antenna,
    *,
    attitudes_known: bool = True,
    positions_known: bool = True,
    centred: bool = False,
) -> AntennaObservability:
    """Return the observability of the antennas from a survey, without any prior.

    Parameters
    ----------
    survey : AntennaSurvey
        One survey; its couplings are not used.
    antenna : Antenna
        Linearisation point.  Symmetric opposites ((p, c, b) to -(p, c, b), (m, s) to -(m, s)) are
        beyond a linear analysis.
    attitudes_known, positions_known : bool
        Whether the survey provides the attitudes and positions of its poses.
    centred : bool
        All coils of an antenna are at its origin; the centres are no parameters.
    """
    free_parameters = ([] if attitudes_known else [0, 1, 2]) + (
        [] if positions_known else [3, 4, 5]
    )
    columns = np.arange(antenna.vector().shape[-1])
    if centred:
        columns = np.setdiff1d(columns, np.r_[CENTRES, SENSOR_CENTRES])
    scale = _scale(antenna, float(np.mean(np.linalg.norm(survey.position_beacon, axis=-1))))
    rows = _remaining(survey, antenna, scale, free_parameters)[:, :, columns]
    whole = rows.reshape(-1, len(columns))
    _, size, right = np.linalg.svd(whole, full_matrices=True)
    size = np.concatenate([size, np.zeros(len(columns) - len(size))])
    rank = int(np.sum(size > NO_INFORMATION * size[0]))
    null = np.zeros((len(columns) - rank, len(scale)))
    null[:, columns] = right[rank:]
    return AntennaObservability(
        parameters=len(columns),
        rank=rank,
        singular=size / size[0],
        null_space=_in_words(null, _gauges(antenna, survey.beacon_from_sensor[0]), scale),
        min_poses=_min_poses(rows, rank),
    )


def _scale(antenna: Antenna, distance: float) -> Array:
    scale = np.full(antenna.vector().shape[-1], distance)
    for columns, coils in (
        (MOMENTS, antenna.moments_beacon),
        (SENSITIVITIES, antenna.sensitivities_sensor),
    ):
        scale[columns] = np.repeat(np.linalg.norm(coils, axis=-1), 3)
    scale[KAPPAS] = distance**2
    return scale


def _remaining(
    survey: AntennaSurvey, antenna: Antenna, scale: Array, directions: list[int]
) -> Array:
    """Return the whitened Jacobian of each pose, less its projection on the pose, (n, rows, k)."""
    seen = observe_antenna(antenna, survey.beacon_from_sensor, survey.position_beacon)
    weight = 1.0 / survey.sigma[:, None, None]
    rows = (seen.antenna * weight[..., None] * scale).reshape(len(weight), 9, -1)
    if not directions:
        return rows
    by_pose = (seen.pose * weight[..., None]).reshape(len(weight), 9, 6)[..., directions]
    residual, _, _ = np.linalg.svd(by_pose / np.linalg.norm(by_pose, axis=1, keepdims=True))
    return np.swapaxes(residual[..., len(directions) :], 1, 2) @ rows


def _min_poses(rows: Array, rank: int) -> int:
    for number in range(1, len(rows)):
        size = np.linalg.svd(rows[:number].reshape(-1, rows.shape[-1]), compute_uv=False)
        if int(np.sum(size > NO_INFORMATION * size[0])) == rank:
            return number
    return len(rows)


def _gauges(antenna: Antenna, beacon_from_sensor: Array) -> dict[str, Array]:
    """Return the unobservable combinations of some surveys, rows of unscaled parameters."""
    moments, centres = antenna.moments_beacon, antenna.centres_beacon
    axes, arms = antenna.sensitivities_sensor, antenna.centres_sensor
    unit, zero = np.eye(3), np.zeros((3, 3))

    def rows(*parts: tuple[Array, Array, Array, Array]) -> Array:
        tangent = np.array([np.concatenate([p.ravel() for p in part]) for part in parts])
        return np.pad(tangent, ((0, 0), (0, antenna.vector().shape[-1] - KAPPAS.start)))

    def rotated(coils: Array, axis: Array) -> Array:
        return coils @ skew(axis).T

    shifts = [np.tile(axis, (3, 1)) for axis in unit]
    scale = rows((3.0 * moments, centres, zero, arms))
    if antenna.kappa_beacon is not None and antenna.kappa_sensor is not None:
        scale[:, KAPPAS] = 2.0 * np.append(antenna.kappa_beacon, antenna.kappa_sensor)
    return {
        "the share of moments and sensitivities in their product": rows(
            (moments, zero, -axes, zero)
        ),
        "rotation of the transmitter's frame": rows(
            *((rotated(moments, a), rotated(centres, a), zero, zero) for a in unit)
        ),
        "rotation of the receiver's frame": rows(
            *((zero, zero, rotated(axes, a), rotated(arms, a)) for a in unit)
        ),
        "shift of the transmitter's centres": rows(*((zero, s, zero, zero) for s in shifts)),
        "shift of the receiver's centres": rows(*((zero, zero, zero, s) for s in shifts)),
        "shift of both antennas' centres together": rows(
            *((zero, s, zero, s @ beacon_from_sensor) for s in shifts)
        ),
        "the scale of all lengths": scale,
    }


def _in_words(null: Array, gauges: dict[str, Array], scale: Array) -> tuple[str, ...]:
    words: list[str] = []
    named = np.zeros((0, len(scale)))
    for name, tangent in gauges.items():
        scaled = tangent / scale
        size = np.linalg.norm(scaled, axis=1)
        scaled = scaled[size > 0.0] / size[size > 0.0, None]
        outside = np.linalg.norm(scaled - scaled @ null.T @ null, axis=1)
        together = np.concatenate([named, scaled])
        new = np.linalg.matrix_rank(together, tol=SAME) - np.linalg.matrix_rank(named, tol=SAME)
        if len(scaled) and np.all(outside < SAME) and new == len(scaled):
            words.append(name if len(scaled) == 1 else f"{name} ({len(scaled)})")
            named = together
    rest = _without(null, named)
    if len(rest):
        share = {part: float(np.sum(rest[:, columns] ** 2)) for part, columns in _PARTS.items()}
        main = [f"{part} {v / len(rest):.0%}" for part, v in share.items() if v > 0.05 * len(rest)]
        words.append(f"{len(rest)} more, in {', '.join(main)}")
    return tuple(words)


def _without(null: Array, known: Array) -> Array:
    """Return an orthonormal basis of a null space's complement to directions within it."""
    if not len(known):
        return null
    basis = np.linalg.qr(known.T)[0]
    _, size, right = np.linalg.svd(null - null @ basis @ basis.T, full_matrices=False)
    return right[size > 0.5]
