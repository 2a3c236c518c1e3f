"""The smoothed trajectory without each beacon or sensor: alarms and protection levels by state."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.considered import AT_ONCE
from magfusion.estimation.graph.graph import Graph
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.block_tridiagonal_system import (
    EpochRows,
    block_tridiagonal_system,
    column_groups,
)
from magfusion.estimation.posterior.information_contributions import Parts, parts_of
from magfusion.estimation.posterior.separation import OPEN_POSITION, OPEN_ROTATION, Separation
from magfusion.estimation.solve.chain import STRETCH, inverses, solve_chain
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray

FALSE_REJECTIONS = 1e-3  # of true samples of aiding sensors: a thousandth of their information
CONTRADICTS = 0.25  # share of rejected samples beyond which a sensor is not as declared
# A prior that keeps undetermined states finite: far wider than any useful covariance.
OPEN = np.repeat([30.0, 300.0, 300.0, 30.0, 3.0], 3)  # rad, m, m/s, m/s^2, rad/s


def separate_smoothed(result: Smoothed, *, by_magnetometer: bool = False) -> Separation | None:
    """Return the separation at every state, in body axes; None where it is not available.

    That is with fixes in the graph (loose coupling), for logs so long that their calibration
    drifts, for close tones that are measured jointly, and with factors of a user's.
    `by_magnetometer`: whether to exclude each magnetometer rather than each beacon.
    """
    graph = result.graph
    if not _can_separate(graph):
        return None
    site = result.declared.site
    owner = site.sensor if by_magnetometer else site.owner
    every = range(len(site.platform.magnetometers if by_magnetometer else site.beacons))
    kept = np.array([owner >= 0, *(owner != j for j in every)])
    tally = _Tally(len(owner))
    solved: list[_Variant] = []
    for columns in column_groups(result.uncertain, graph.epochs):
        rest, rows = block_tridiagonal_system(graph, result.estimate, result.uncertain, columns)
        assert rows is not None
        rest.diagonal += np.diag(1.0 / OPEN**2)
        pieces = rows.pieces() if solved else tally.over(rows.pieces())
        parts = parts_of(rest, rows, pieces, kept)
        del rest, rows, pieces
        give_back_memory()
        solved, _ = _without_each(parts, kept, solved)
        del parts  # before the next group: for a long log they are large
        give_back_memory()
    detected, count = tally.detected, tally.count
    cost = kept @ tally.square - np.array([one.explained for one in solved])
    numbers = np.array([6 * np.sum(detected & (owner == j)) * count for j in every])
    others = np.array([np.any(detected & (owner != j)) for j in every])
    return _separation(solved, others, cost[1:], numbers)


def aiding_used(result: Smoothed) -> list[str]:
    """Return the aiding sensors with samples in a result."""
    measured = (m for m in result.graph.measurements if isinstance(m, AidingMeasurement))
    return list(dict.fromkeys(m.sensor for m in measured))


def disagreement(sensor: str, share: float) -> Finding:
    """Return the finding on an aiding sensor of whose samples a share is rejected."""
    return Finding(
        "aiding_disagrees",
        f"{sensor} contradicts the estimate, {100.0 * share:.0f} % of its samples are not used: it"
        " slips or is blocked, or its unit, scale, mounting, lever arm or clock is not as declared."
        " Correct it in the site's aiding, or leave the sensor out.",
        Verdict.DOUBTFUL,
        share / CONTRADICTS,
    )


def contradicting_sensors(result: Smoothed, explained: Collection[str]) -> tuple[Finding, ...]:
    """Return the findings on aiding sensors whose robust loss rejects too many samples.

    `explained`: sensors of which a parameter is named already.
    """
    rejected: dict[str, list[BoolArray]] = {}
    for measured in result.graph.measurements:
        if isinstance(measured, AidingMeasurement) and measured.sensor not in explained:
            error = result.graph.residual(measured, result.estimate)
            numbers = np.sum(np.isfinite(measured.sigma), axis=1)
            square = np.sum(error.reshape(len(error), -1) ** 2, axis=1)
            beyond = square > chdtri(np.maximum(numbers, 1), FALSE_REJECTIONS)
            rejected.setdefault(measured.sensor, []).append(beyond)
    shares = {name: float(np.mean(np.concatenate(parts))) for name, parts in rejected.items()}
    return tuple(disagreement(*one) for one in shares.items() if one[1] > CONTRADICTS)


def separate_sensors(result: Smoothed) -> Separation | None:
    """Return the separation from the estimates without each aiding sensor.

    None where it is not available, or without sensors.
    """
    graph = result.graph
    sensors = aiding_used(result)
    if not sensors or not _can_separate(graph):
        return None
    graphs = [graph, *(_without_sensor(graph, name) for name in sensors)]
    kept = np.ones((1, len(result.declared.site.owner)), dtype=bool)
    solved: list[list[_Variant]] = [[] for _ in graphs]
    for columns in column_groups(result.uncertain, graph.epochs):
        reference = None
        for k, one in enumerate(graphs):
            rest, rows = block_tridiagonal_system(one, result.estimate, result.uncertain, columns)
            assert rows is not None
            rest.diagonal += np.diag(1.0 / OPEN**2)
            parts = parts_of(rest, rows, rows.pieces(), kept)
            del rest, rows
            solved[k], reference = _without_each(parts, kept, solved[k], reference)
            del parts
            give_back_memory()
    variants, number = [one for (one,) in solved], len(sensors)
    estimate = _separation(variants, np.ones(number, dtype=bool), np.zeros(number), np.ones(number))
    near = np.einsum("nbii->nbi", estimate.subset_cov)[..., 3:].sum(axis=2) < OPEN_POSITION**2
    return replace(estimate, determined=estimate.determined & near)


def _without_sensor(graph: Graph, name: str) -> Graph:
    kept = tuple(
        m for m in graph.measurements if not (isinstance(m, AidingMeasurement) and m.sensor == name)
    )
    return replace(graph, measurements=kept)


def _separation(
    solved: list["_Variant"], others: BoolArray, cost: Array, numbers: Array
) -> Separation:
    """Return the separation of variants from the first one.

    `others` (variants - 1,): whether any other beacon is detected. `cost`, `numbers` (variants -
    1,): squared residuals, and number of rows that are left out.
    """
    step, cov = (np.array([getattr(v, name) for v in solved]) for name in ("step", "cov"))
    separate = np.array([v.separate_errors for v in solved[1:]])
    variance = np.einsum("hnii->hni", cov[1:])
    shift = step[1:] - step[:1]
    determined = np.isfinite(shift).all(axis=2) & (variance > 0.0).all(axis=2)
    determined &= np.sum(variance[..., :3], axis=2) < OPEN_ROTATION**2
    determined &= others[:, None]
    shape = shift.shape[1], len(shift)
    return Separation(
        np.swapaxes(shift, 0, 1),
        cov[0],
        np.swapaxes(cov[1:], 0, 1),
        np.swapaxes(separate, 0, 1),
        np.swapaxes(determined, 0, 1),
        np.broadcast_to(cost, shape),
        np.broadcast_to(numbers, shape),
    )


def _can_separate(graph: Graph) -> bool:
    """Return whether a graph has the fields of one calibration, each tone separate."""
    fields = [f for f in graph.factors if isinstance(f.measurement, FieldPhasors)]
    together = any(isinstance(m, JointPhasors) for m in graph.measurements)
    one = len(fields) == 1 and len(graph.segments) <= 1
    return one and not together and graph.declared is not None and graph.user is None


class _Tally:
    """Channels that are detected in any epoch, and the sum of squares of each."""

    def __init__(self, channels: int) -> None:
        self.detected, self.count = np.zeros(channels, dtype=bool), 0
        self.square = np.zeros(channels)

    def over(self, pieces: Iterator[EpochRows]) -> Iterator[EpochRows]:
        """Count pieces while passing them on."""
        for piece in pieces:
            self.detected |= np.any(piece.by_state != 0.0, axis=(0, 2, 3))
            self.square += np.sum(piece.right[..., 0] ** 2, axis=(0, 2))
            self.count += len(piece.epoch)
            yield piece


@dataclass(eq=False)
class _Variant:
    """A solution with some of the channels."""

    step: Array  # (n, 6)
    # cov, separate_errors: (n, 6, 6), of it, and of its difference from the first; both include
    # considered parameters
    cov: Array
    separate_errors: Array
    explained: float  # part of the sum of squares
    inverse: Array  # (n, 15, 15), as in `ChainSolution`


class _Reference(NamedTuple):
    """Response (n, 6, columns) and covariance (n, 6, 6) of the estimate with all."""

    response: Array
    alone: Array


def _without_each(
    parts: Parts, kept: BoolArray, before: list[_Variant], reference: _Reference | None = None
) -> tuple[list[_Variant], _Reference]:
    """Solve variants with some of the channels, shape (h, channels).

    `before`: solved with other columns of the considered parameters. `reference`: by default the
    first variant.
    """
    count, _, size = parts.parts[0].sums.border.shape
    per_variant = 8.0 * 4.0 * count * MOTION * (MOTION + parts.count + size)
    group = max(1, int(AT_ONCE / per_variant))
    known = [one.inverse for one in before] if before else _inverses(parts, kept)
    parts.discard_diagonals()
    out = list(before)
    for first in range(0, len(kept), group):
        some = slice(first, first + group)
        result = solve_chain(
            parts.chain(kept[some]), 6, np.array(known[some]), covariance=not before
        )
        for k, states in enumerate(result.states):
            response = states[..., 1:]
            if reference is None:
                reference = _Reference(response.copy(), result.cov[k].copy())
            whole, alone = reference
            if not before:
                own, explained = result.cov[k].copy(), float(result.explained[k])
                step = states[..., 0].copy()
                out.append(_Variant(step, own, own - alone, explained, known[first + k]))
            for begin in range(0, count, STRETCH):
                here = slice(begin, begin + STRETCH)
                own, moved = response[here], response[here] - whole[here]
                out[first + k].cov[here] += own @ np.swapaxes(own, -1, -2)
                out[first + k].separate_errors[here] += moved @ np.swapaxes(moved, -1, -2)
        del result, states, response  # before the next group, too
    assert reference is not None
    return out, reference


def _inverses(parts: Parts, kept: BoolArray) -> list[Array]:
    """Return `inverses` of all variants together, since each is many small matrices."""
    out: list[Array] = []
    group = max(1, int(AT_ONCE / (8.0 * 4.0 * parts.parts[0].sums.diagonal.size)))
    for first in range(0, len(kept), group):
        some = kept[first : first + group]
        out += list(inverses(parts.diagonals(some), parts.following[None]))
    return out
