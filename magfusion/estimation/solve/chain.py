"""Linear least squares of a chain of states with a border, for many variants of it at once.

GTSAM eliminates one system at a time; here the same system without each of some measurements is
solved in one sweep, with the covariance of every state.  Block elimination along the chain, the
border last; the covariance by the recursion of the selected inverse.
"""

from typing import NamedTuple

import numpy as np

from magfusion.units import Array

STRETCH = 256  # states that are multiplied at once


class Chain(NamedTuple):
    """Normal equations of variants h of a chain of n states of size s with a border of size c."""

    diagonal: Array  # (h, n, s, s)
    following: Array  # (h or 1, n - 1, s, s), between each state and the next
    border: Array  # (h, n, s, c), between each state and the border
    corner: Array  # (h, c, c)
    right: Array  # (h, n, s, r)
    right_border: Array  # (h, c, r)
    # (h, n, s, r + c), array whose parts are right sides and border: solving the chain overwrites
    # it
    sides: Array | None = None

    @staticmethod
    def of_sides(
        diagonal: Array, following: Array, sides: Array, corner: Array, right_border: Array
    ) -> "Chain":
        """Return a chain whose right sides and border are views of one array."""
        right, border = np.split(sides, [right_border.shape[-1]], axis=-1)
        return Chain(diagonal, following, border, corner, right, right_border, sides)


class ChainSolution(NamedTuple):
    """Solution of every variant."""

    states: Array  # (h, n, k, r) of the first k of each state
    border: Array  # (h, c, r)
    cov: Array  # (h, n, k, k) of the same
    border_cov: Array  # (h, c, c)
    explained: Array  # (h,) of the sum of squares, by the solution for the first right side
    inverse: Array  # (h, n, s, s) of each state's Schur complement: reused for other right sides


@np.errstate(all="ignore")
def solve_chain(
    chain: Chain, kept: int, known: Array | None = None, *, covariance: bool = True
) -> ChainSolution:
    """Solve every variant; an undetermined one has infinite, NaN or very large results.

    `kept`: number of leading components of each state whose covariance is returned.
    `known` (h, n, s, s): as `inverses` of the chain, or `ChainSolution.inverse` of it with other
    right sides. `covariance`: whether to compute that of the states.
    """
    n, size = chain.diagonal.shape[1:3]
    # The sweep overwrites the right sides, and the solution overwrites the sweep: in a log of
    # hours they are the largest arrays.
    first, outer = chain.right[..., 0].copy(), chain.border.copy()
    solved = chain.sides
    if solved is None:
        solved = np.concatenate([chain.right, chain.border], axis=-1)
    inverse = inverses(chain.diagonal, chain.following) if known is None else known
    gain = inverse[:, :-1] @ chain.following
    back = np.swapaxes(gain, 2, 3)
    for i in range(n - 1):
        solved[:, i + 1] -= back[:, i] @ solved[:, i]
    for begin in range(0, n, STRETCH):
        here = slice(begin, begin + STRETCH)
        solved[:, here] = inverse[:, here] @ solved[:, here]
    for i in range(n - 2, -1, -1):
        solved[:, i] -= gain[:, i] @ solved[:, i + 1]
    own = np.empty((len(inverse), 0, kept, kept))
    if covariance:
        own = _covariances(inverse, gain, kept)
    del gain, back
    count = chain.right.shape[-1]
    alone, by_border = solved[..., :count], solved[..., count:]
    explained = np.einsum("hns,hns->h", first, alone[..., 0])
    if not chain.corner.shape[1]:
        states = alone[:, :, :kept]
        return ChainSolution(states, chain.right_border, own, chain.corner, explained, inverse)
    # Schur complement of the border.
    remaining = np.swapaxes(outer.reshape(len(outer), n * size, -1), 1, 2)
    selected = remaining @ solved.reshape(len(outer), n * size, -1)
    corner = _inverse(chain.corner - selected[..., count:])
    rest = chain.right_border - selected[..., :count]
    border = corner @ rest
    part = by_border[..., :kept, :]
    states = alone[:, :, :kept] - part @ border[:, None]
    # Back substitution of the border.
    explained += np.einsum("hc,hc->h", rest[..., 0], border[..., 0])
    if covariance:
        own += part @ corner[:, None] @ np.swapaxes(part, -1, -2)
    return ChainSolution(states, border, own, corner, explained, inverse)


@np.errstate(all="ignore")
def inverses(diagonal: Array, following: Array) -> Array:
    """Return the inverse of the Schur complement of each state, shape (h, n, s, s).

    `diagonal`, `following`: as of `Chain`.
    """
    out, count, selected = np.empty_like(diagonal), diagonal.shape[1], np.zeros(1)
    # In units in which all components of a state are about one.
    size = np.sqrt(np.maximum(np.einsum("hnii->hni", diagonal), np.finfo(np.float64).tiny))
    for begin in range(0, count, STRETCH):
        here = slice(begin, min(begin + STRETCH, count))
        square = size[:, here, :, None] * size[:, here, None, :]
        own = diagonal[:, here] / square
        last = min(begin + STRETCH, count - 1)
        between = size[:, begin:last, :, None] * size[:, begin + 1 : last + 1, None]
        after = following[:, begin:last] / between
        for k in range(own.shape[1]):
            inverse = _inverted(own[:, k] - selected)
            out[:, begin + k] = inverse
            if k < after.shape[1]:
                selected = np.swapaxes(inverse @ after[:, k], 1, 2) @ after[:, k]
        out[:, here] /= square
    return out


def _inverted(matrix: Array) -> Array:
    """Return inverses of symmetric positive matrices of similar units, (h, k, k)."""
    try:
        inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return _inverse(matrix)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)))


def _covariances(inverse: Array, gain: Array, kept: int) -> Array:
    """Return the covariance of the leading components of each state, shape (h, n, kept, kept)."""
    own = np.empty((*inverse.shape[:2], kept, kept))
    cov = inverse[:, -1]
    own[:, -1] = cov[:, :kept, :kept]
    for i in range(inverse.shape[1] - 2, -1, -1):
        cov = inverse[:, i] + gain[:, i] @ cov @ np.swapaxes(gain[:, i], 1, 2)
        own[:, i] = cov[:, :kept, :kept]
    return own


def _inverse(matrix: Array) -> Array:
    """Return inverses of symmetric positive matrices of any units, (h, k, k)."""
    size = np.sqrt(np.maximum(np.einsum("hii->hi", matrix), np.finfo(np.float64).tiny))
    scaled = matrix / (size[:, :, None] * size[:, None, :])
    try:
        inverse = np.linalg.inv(0.5 * (scaled + np.swapaxes(scaled, 1, 2)))
    except np.linalg.LinAlgError:  # one of them is singular to the last digit
        inverse = np.linalg.inv(scaled + 1e-12 * np.eye(matrix.shape[1]))
    return 0.5 * (inverse + np.swapaxes(inverse, 1, 2)) / (size[:, :, None] * size[:, None, :])
