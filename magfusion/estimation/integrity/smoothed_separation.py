"""The smoothed trajectory without each beacon: alarms and protection levels by state."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation import chain_system as chains
from magfusion.estimation.batch import Smoothed
from magfusion.estimation.chain_parts import Part, parts_of
from magfusion.estimation.chain_system import FieldRows, Normal, chain_system, column_groups
from magfusion.estimation.convergence import OPEN_ROTATION
from magfusion.estimation.integrity.separation import Separation
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.solve.chain import ChainSolution, inverses, solve_chain
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.units import Array, BoolArray

# A prior that keeps what is open finite: far wider than anything that is of use.
OPEN = np.repeat([30.0, 300.0, 300.0, 30.0, 3.0], 3)  # rad, m, m/s, m/s^2, rad/s


def separate_smoothed(result: Smoothed, *, by_magnetometer: bool = False) -> Separation | None:
    """Return the separation at every state, in body axes; None where there is none to be had.

    That is with fixes in the graph (loose coupling), of a log so long that its calibration drifts,
    and of close tones that count together.

    Parameters
    ----------
    by_magnetometer : bool
        Whether it is of solutions without each magnetometer, rather than without each beacon.
    """
    graph = result.graph
    fields = [f.measurement for f in graph.factors if isinstance(f.measurement, FieldPhasors)]
    together = any(isinstance(m, JointPhasors) for m in graph.measurements)
    if together or len(fields) != 1 or len(graph.segments) > 1 or graph.declared is None:
        return None
    site = result.declared.site
    owner = site.sensor if by_magnetometer else site.owner
    every = range(len(site.platform.magnetometers if by_magnetometer else site.beacons))
    kept = np.array([owner >= 0, *(owner != j for j in every)])
    heard, square, count = np.zeros(len(owner), dtype=bool), np.zeros(len(owner)), 0
    solved: list[_Variant] = []
    for columns in column_groups(result.uncertain, graph.epochs):
        rest, rows = chain_system(graph, result.estimate, result.uncertain, columns)
        assert rows is not None
        rest.diagonal += np.diag(1.0 / OPEN**2)
        if not solved:
            for piece in rows.pieces():
                heard |= np.any(piece.by_state != 0.0, axis=(0, 2, 3))
                square += np.sum(piece.right[..., 0] ** 2, axis=(0, 2))
                count += len(piece.epoch)
        solved = _without_each(rest, rows, kept, solved)
        del rest, rows  # before the next group: of a long log they are much
        give_back_memory()
    cost = kept @ square - np.array([one.explained for one in solved])
    numbers = np.array([6 * np.sum(heard & (owner == j)) * count for j in every])
    others = np.array([np.any(heard & (owner != j)) for j in every])
    step, cov = np.array([v.step for v in solved]), np.array([v.cov for v in solved])
    apart = np.array([v.apart for v in solved[1:]])
    del solved
    variance = np.einsum("hnii->hni", cov[1:])
    shift = step[1:] - step[:1]
    determined = np.isfinite(shift).all(axis=2) & (variance > 0.0).all(axis=2)
    determined &= np.sum(variance[..., :3], axis=2) < OPEN_ROTATION**2
    determined &= others[:, None]
    shape = (graph.epochs, len(every))
    return Separation(
        np.swapaxes(shift, 0, 1),
        cov[0],
        np.swapaxes(cov[1:], 0, 1),
        np.swapaxes(apart, 0, 1),
        np.swapaxes(determined, 0, 1),
        np.broadcast_to(cost[1:], shape),
        np.broadcast_to(numbers, shape),
    )


@dataclass(eq=False)
class _Variant:
    """A solution with some of the channels.

    Parameters
    ----------
    step : ndarray, shape (n, 6)
    cov, apart : ndarray, shape (n, 6, 6)
        Of it, and of its difference from the first; both grow by what is considered.
    explained : float
        Of the sum of squares.
    inverse : ndarray, shape (n, 15, 15)
        As of `ChainSolution`.
    """

    step: Array
    cov: Array
    apart: Array
    explained: float
    inverse: Array


def _without_each(
    rest: Normal, rows: FieldRows, kept: BoolArray, before: list[_Variant]
) -> list[_Variant]:
    """Solve variants with some of the channels, shape (h, channels).

    Parameters
    ----------
    before : list of _Variant
        Solved with other columns of what is considered.
    """
    per_variant = 8.0 * 4.0 * (rest.diagonal.size + rest.border.size + rest.right.size)
    group = max(1, int(chains.AT_ONCE / per_variant))
    parts = parts_of(rows, kept, rest)
    known = [v.inverse for v in before] if before else _inverses(rest, parts, kept)
    out, whole, alone = list(before), np.zeros((0, 6, 0)), np.zeros((0, 6, 6))
    for first in range(0, len(kept), group):
        some = slice(first, first + group)
        found = _solved(rest, parts, kept[some], np.array(known[some]), covariance=not before)
        for k, states in enumerate(found.states):
            response = states[..., 1:]
            if first + k == 0:
                whole = response.copy()
                alone = found.cov[k].copy()
            if not before:
                own, explained = found.cov[k].copy(), float(found.explained[k])
                inverse = known[first + k]
                step = states[..., 0].copy()
                out.append(_Variant(step, own, own - alone, explained, inverse))
            moved = response - whole
            out[first + k].cov += response @ np.swapaxes(response, -1, -2)
            out[first + k].apart += moved @ np.swapaxes(moved, -1, -2)
            del moved
        del found, states, response  # before the next group, too
    return out


def _inverses(rest: Normal, parts: list[Part], kept: BoolArray) -> list[Array]:
    """Return `inverses` of each variant: together, since each is many small matrices."""
    out: list[Array] = []
    group = max(1, int(chains.AT_ONCE / (8.0 * 4.0 * rest.diagonal.size)))
    for first in range(0, len(kept), group):
        some = kept[first : first + group]
        diagonal = np.repeat(rest.diagonal[None], len(some), axis=0)
        for own, channels in zip(diagonal, some, strict=True):
            for part in parts:
                if np.all(channels[part.channels]):
                    own += part.sums.diagonal
        out += list(inverses(diagonal, rest.following[None]))
    return out


def _solved(
    rest: Normal, parts: list[Part], some: BoolArray, known: Array, *, covariance: bool
) -> ChainSolution:
    """Solve some variants at once; all else is as of `solve_chain`."""
    chain, variants = rest.variants(len(some))
    for normal, channels in zip(variants, some, strict=True):
        for part in parts:
            if np.all(channels[part.channels]):
                part.added_to(normal)
    return solve_chain(chain, 6, known, covariance=covariance)
