"""Observability of the calibration from a log: determined directions, and the others in words.

The posterior is compared with the prior: in the tangent space scaled by the prior's sigmas the
eigenvalues of the posterior covariance are the squared ratios of posterior to prior sigma, one
where the log adds no information.  Some of these directions are gauge: they do not change any
measurement, so that no log can determine them, and only a better survey helps.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.model.parameters import LOG_MOMENT, Block, Calibration, dimension, prior_sigma
from magfusion.results.figures import DETERMINED_RATIO
from magfusion.results.gauge import Gauge, gauges
from magfusion.units import Array

WEAKEST = 5  # directions that are put in words
DEGENERATE_RATIO = 0.95  # ratio from which directions are alike, so that they may be mixed at will
SHARE_NAMED = 0.08  # of a direction's square, from which a parameter is named
MAX_LISTED = 4
MIN_LISTED = 1e-4  # m, rad or relative; a common shift below it is of no interest


class Weakness(NamedTuple):
    """A direction of the calibration that the log does not determine.

    `ratio`: posterior over prior sigma along it. `direction` (dimension,): tangent vector, one
    posterior sigma long.
    """

    words: str
    ratio: float
    direction: Array


class CalibrationObservability(NamedTuple):
    """Observability of the calibration."""

    ratio: Array  # (dimension,), posterior over prior sigma of each parameter
    # (dimension,), the same, without the open gauge in either; NaN where nothing of the parameter
    # remains
    ratio_but_for_gauge: Array
    direction_ratio: Array  # (dimension,), posterior over prior sigma of each direction, ascending
    gauge: tuple[Weakness, ...]  # gauge directions, which are open for any log
    weakest: tuple[Weakness, ...]  # the weakest of the other directions that are open

    @property
    def determined(self) -> int:
        """Number of directions that the log determined."""
        return int(np.sum(self.direction_ratio < DETERMINED_RATIO))


def observability(
    calibration: Calibration, blocks: tuple[Block, ...], cov: Array
) -> CalibrationObservability:
    """Compare the posterior of a calibration with its prior.

    `calibration`: at the posterior. `blocks`: with the prior's sigmas.
    `cov` (dimension, dimension): posterior.
    """
    prior = prior_sigma(blocks)
    scaled = cov / prior[:, None] / prior
    size = dimension(blocks)
    known, nearly, basis = _open_gauge(calibration, blocks, scaled, prior)
    remaining = np.eye(size) - basis @ basis.T
    reduced = remaining @ scaled @ remaining
    share = np.diagonal(remaining)
    share = np.where(share > 1e-6, share, np.nan)
    others = _weakest(blocks, calibration, scaled, basis, prior)
    value = np.linalg.eigvalsh(scaled) if size else np.zeros(0)
    return CalibrationObservability(
        ratio=np.sqrt(np.diagonal(scaled)),
        ratio_but_for_gauge=np.sqrt(np.diagonal(reduced) / share),
        direction_ratio=np.sqrt(np.maximum(value, 0.0)),
        gauge=known,
        weakest=tuple(sorted(nearly + others, key=lambda one: -one.ratio)[:WEAKEST]),
    )


def gauge_basis(calibration: Calibration, blocks: tuple[Block, ...]) -> Array:
    """Return the gauge directions that no log determines, orthonormal in units of the prior.

    Returns (dimension, gauges), without those that gravity or acceleration may determine.
    """
    prior = prior_sigma(blocks)
    columns = [q for gauge, q, _ in _orthonormal(calibration, blocks, prior) if gauge.exact]
    return np.stack(columns, axis=1) if columns else np.zeros((len(prior), 0))


def _orthonormal(
    calibration: Calibration, blocks: tuple[Block, ...], prior: Array
) -> Iterator[tuple[Gauge, Array, float]]:
    """Yield each gauge's component orthogonal to those before it, and its length."""
    known: Array = np.zeros((len(prior), 0))
    for gauge in gauges(calibration, blocks):
        scaled = gauge.direction / prior
        rest = scaled - known @ (known.T @ scaled)
        rest = rest - known @ (known.T @ rest)
        length = float(np.linalg.norm(rest))
        if length > 1e-6 * float(np.linalg.norm(scaled)):
            known = np.column_stack([known, rest / length])
            yield gauge, rest / length, length


def _open_gauge(
    calibration: Calibration, blocks: tuple[Block, ...], scaled: Array, prior: Array
) -> tuple[tuple[Weakness, ...], tuple[Weakness, ...], Array]:
    """Return the open gauges, the approximate ones, and their orthonormal basis."""
    known: list[Weakness] = []
    nearly: list[Weakness] = []
    columns = []
    for gauge, column, length in _orthonormal(calibration, blocks, prior):
        ratio = float(np.sqrt(max(float(column @ scaled @ column), 0.0)))
        if ratio < DETERMINED_RATIO:
            continue
        columns.append(column)
        amplitude = ratio / length
        if amplitude > MIN_LISTED:
            unit, scale = gauge.unit
            words = f"{gauge.name} by {amplitude / scale:.2g} {unit}: {gauge.remedy}"
            listed = known if gauge.exact else nearly
            listed.append(Weakness(words, ratio, ratio * column * prior))
    basis = np.stack(columns, axis=1) if columns else np.zeros((len(prior), 0))
    return tuple(known), tuple(nearly), basis


def _weakest(
    blocks: tuple[Block, ...], calibration: Calibration, scaled: Array, gauge: Array, prior: Array
) -> tuple[Weakness, ...]:
    """Return the weakest directions apart from the gauge, weakest first."""
    size = len(prior)
    if size == gauge.shape[1]:
        return ()
    others = np.linalg.svd(np.column_stack([gauge, np.zeros(size)]), full_matrices=True)[0]
    others = others[:, gauge.shape[1] :]
    value, vector = np.linalg.eigh(others.T @ scaled @ others)
    ratio, column = np.sqrt(np.maximum(value, 0.0))[::-1], (others @ vector)[:, ::-1]
    shared = int(np.sum(ratio > DEGENERATE_RATIO))
    if shared > 1:
        column = np.column_stack([_simplest(column[:, :shared]), column[:, shared:]])
        ratio = np.sqrt(np.einsum("ik,ij,jk->k", column, scaled, column))
    open_ = np.flatnonzero(ratio > DETERMINED_RATIO)
    order = open_[np.argsort(-ratio[open_], kind="stable")][:WEAKEST]
    names = parameter_names(blocks, calibration)
    return tuple(
        Weakness(
            _in_words(column[:, k], float(ratio[k]), blocks, names, prior),
            float(ratio[k]),
            ratio[k] * column[:, k] * prior,
        )
        for k in order
    )


def _simplest(basis: Array, rounds: int = 50) -> Array:
    """Return a basis of the same space whose vectors have few large components each (varimax)."""
    turn = np.eye(basis.shape[1])
    for _ in range(rounds):
        rotated = basis @ turn
        target = rotated**3 - rotated * np.mean(rotated**2, axis=0)
        remaining, _, right = np.linalg.svd(basis.T @ target)
        turn = remaining @ right
    return basis @ turn


def parameter_names(
    blocks: tuple[Block, ...], calibration: Calibration
) -> list[tuple[str, str, float]]:
    """Return the name of each parameter, its unit, and the size of the unit in SI."""
    return [
        (b.parameter.called(calibration.site, b.owner, i), *b.parameter.display_unit)
        for b in blocks
        for i in range(len(b.sigma))
    ]


def _in_words(
    column: Array,
    ratio: float,
    blocks: tuple[Block, ...],
    names: list[tuple[str, str, float]],
    prior: Array,
) -> str:
    moved = ratio * column * prior
    parts = [(column[k] ** 2, moved[k], *names[k]) for k in range(len(column))]
    for block in blocks[::-1]:
        if block.parameter == LOG_MOMENT and _are_degenerate(moved[block.columns]):
            share, mean = np.sum(column[block.columns] ** 2), np.mean(moved[block.columns])
            words = f"the moments of beacon {block.owner}"
            parts[block.columns] = [(share, mean, words, *LOG_MOMENT.display_unit)]
    parts.sort(key=lambda part: -part[0])
    named = [part for part in parts[:MAX_LISTED] if part[0] > SHARE_NAMED] or parts[:1]
    sign = np.sign(named[0][1]) or 1.0
    texts = [f"{name} by {sign * size / scale:+.2g} {unit}" for _, size, name, unit, scale in named]
    listed = texts[0] if len(texts) == 1 else f"{texts[0]} against {', '.join(texts[1:])}"
    return f"{listed} (sigma {ratio:.2f} of the survey's)"


def _are_degenerate(values: Array) -> bool:
    """Return whether the coils of a beacon move together."""
    low, high = np.min(values), np.max(values)
    return len(values) > 1 and bool(low * high > 0.0 and abs(low - high) < 0.5 * abs(low + high))
