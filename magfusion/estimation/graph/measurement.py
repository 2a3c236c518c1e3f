"""Interface of a measurement to an estimator: whitened rows with derivatives, and a robust loss.

Batch graph, sliding window and filter use nothing else of a sensor.  To add one, write a frozen
dataclass with these methods; nothing else changes.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import repeat
from typing import Self
from weakref import WeakKeyDictionary

import numpy as np

from magfusion.estimation.graph.state import MOTION, State, States, states_of
from magfusion.estimation.solve.sparse_rows import sparse_if_wide
from magfusion.model.parameters import Block, Calibration, dimension
from magfusion.units import Array, BoolArray, IntArray

# 95 % efficient on white noise of one dimension; the last is for residuals that are not noise.
ROBUST_WIDTH = {"huber": 1.345, "cauchy": 2.385, "geman-mcclure": 2.385}


def robust_weight(square: Array, loss: str | None, components: int = 6) -> tuple[Array, Array]:
    """Return weight and loss of squared whitened residual norms.

    `loss`: None, 'huber', 'cauchy' or 'geman-mcclure'. `components`: of each residual. Returns
    `weight`, `rho`: ``rho`` replaces ``square`` in the cost; ``weight`` is its derivative by
    ``square``.
    """
    if loss is None:
        return np.ones_like(square), square
    width = ROBUST_WIDTH[loss] ** 2 * components
    if loss == "geman-mcclure":
        share = 1.0 / (1.0 + square / width)
        return share**2, share * square
    if loss == "cauchy":
        return 1.0 / (1.0 + square / width), width * np.log1p(square / width)
    beyond = square > width
    norm = np.sqrt(np.maximum(square, width))
    edge = np.sqrt(width)
    return np.where(beyond, edge / norm, 1.0), np.where(beyond, 2 * edge * norm - width, square)


@dataclass(frozen=True)
class Loss:
    """Robust loss of each group of a measurement's rows."""

    kind: str  # 'huber', 'cauchy' or 'geman-mcclure'
    # scalar or (n, groups), how many epochs count as one measurement; fractions do not reduce
    # outlier rejection
    repeats: Array | float = 1.0

    def weighed(self, square: Array, components: int) -> tuple[Array, Array]:
        """Return weight and loss as `robust_weight` does."""
        weight, rho = robust_weight(self.repeats * square, self.kind, components)
        return weight, rho / self.repeats


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened measurement: ``error`` plus the derivatives times a step is unit noise.

    Each epoch has groups of components; a robust loss weights a group as a whole.  A derivative
    that is None is zero.
    """

    error: Array  # (n, groups, components), predicted minus measured
    # by_pose, by_velocity, by_bias, by_calibration: (n, groups, components, k), in the tangent of
    # `magfusion.estimation.graph.state`: k is 6, 3, 6 and the calibration's size
    by_pose: Array | None = None
    by_velocity: Array | None = None
    by_bias: Array | None = None
    by_calibration: Array | None = None

    def weighed(self, loss: Loss | None) -> tuple["Rows", Array]:
        """Return rows weighted by a robust loss, and the loss of each group."""
        square = (self.error**2).sum(axis=2)
        if loss is None:
            return self, square
        weight, rho = loss.weighed(square, self.error.shape[2])
        share = np.sqrt(weight)[..., None, None]
        by = (self.by_pose, self.by_velocity, self.by_bias, self.by_calibration)
        return Rows(share[..., 0] * self.error, *(b if b is None else share * b for b in by)), rho

    def of_groups(self, kept: BoolArray) -> "Rows":
        """Return the rows of some groups, shape (groups,)."""
        by = (self.by_pose, self.by_velocity, self.by_bias, self.by_calibration)
        return Rows(self.error[:, kept], *(b if b is None else b[:, kept] for b in by))

    def jacobian(self, calibration: int) -> Array:
        """Return all derivatives, shape (n, groups, components, 15 + calibration)."""
        out = np.zeros((*self.error.shape, MOTION + calibration))
        columns = ((0, 6), (6, 9), (9, MOTION), (MOTION, MOTION + calibration))
        by = (self.by_pose, self.by_velocity, self.by_bias, self.by_calibration)
        for part, (begin, end) in zip(by, columns, strict=True):
            if part is not None:
                out[..., begin:end] = part
        return out


@dataclass(frozen=True, eq=False)
class Measurement(ABC):
    """Measurements at some epochs.

    Fields that are arrays have one row for each of ``epoch``; other fields hold for all of them.
    Fields that are not compared do not belong to the measurement itself.
    """

    epoch: IntArray  # state index of each row

    @abstractmethod
    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate.

        `states`: of the measurement's own epochs, shape (n, ...). `blocks`: columns of the
        calibration's tangent vector.
        """

    def error(self, states: States, calibration: Calibration) -> Array:
        """Return the rows' error alone; override it where that costs less."""
        return self.linearize(states, calibration, ()).error

    @property
    def loss(self) -> Loss | None:
        """Robust loss of each group of rows."""
        return None

    def predicted_groups(self) -> BoolArray | None:
        """Return which groups of rows are predicted, shape (n, groups); None for all."""
        return None

    def at_states(self) -> Self:
        """Return the measurement linearised at its states, if an update has it elsewhere."""
        return self

    def near_solution(self) -> Self:
        """Return the measurement as it is used once the states are near their solution."""
        return self

    def rows(self, kept: BoolArray | slice) -> Self:
        """Return the measurement at some of its epochs."""
        return replace(
            self, **{k: v[kept] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        )

    def at(self, epoch: int) -> Self:
        """Return a measurement of one epoch with another epoch index."""
        return replace(self, epoch=np.full(len(self.epoch), epoch))


def joined(parts: Iterable[Measurement], epochs: Iterable[int] | None = None) -> list[Measurement]:
    """Return measurements of the same kind as one, evaluated in one call.

    `epochs`: of each part, instead of its own.
    """
    kinds: dict[str, list[tuple[Measurement, IntArray]]] = {}
    for part, epoch in zip(parts, repeat(None) if epochs is None else epochs, strict=False):
        own = part.epoch if epoch is None else np.full(len(part.epoch), epoch)
        kinds.setdefault(kind_of(part), []).append((part, own))
    out = []
    for shared in kinds.values():
        first = shared[0][0]
        arrays = [k for k, v in vars(first).items() if isinstance(v, np.ndarray)]
        whole = {k: np.concatenate([getattr(m, k) for m, _ in shared]) for k in arrays}
        whole["epoch"] = np.concatenate([epoch for _, epoch in shared])
        out.append(replace(first, **whole))
    return out


_KINDS: WeakKeyDictionary[Measurement, str] = WeakKeyDictionary()


def kind_of(part: Measurement) -> str:
    """Return a key that is equal for parts which are `joined`; cached for windows."""
    known = _KINDS.get(part)
    if known is None:
        values = ((name, getattr(part, name)) for name in _compared(type(part)))
        shared = {name: value for name, value in values if not isinstance(value, np.ndarray)}
        known = _KINDS[part] = f"{type(part).__qualname__} {shared}"
    return known


@cache
def _compared(kind: type[Measurement]) -> tuple[str, ...]:
    return tuple(f.name for f in fields(kind) if f.compare)


def group_distances(rows: Rows, cov: Array) -> Array:
    """Return the squared Mahalanobis distance of each group's innovation, shape (n, groups).

    Zero where a group is missing. `cov` (15 + calibration, 15 + calibration): of the predicted
    state.
    """
    jacobian = rows.jacobian(len(cov) - MOTION)
    across = sparse_if_wide(jacobian.reshape(-1, len(cov))) @ cov
    spread = across.reshape(jacobian.shape) @ np.swapaxes(jacobian, -1, -2)
    spread += np.eye(rows.error.shape[2])
    solved = np.linalg.solve(spread, rows.error[..., None])[..., 0]
    return np.sum(rows.error * solved, axis=-1)


def calibration_rows(shape: tuple[int, ...], blocks: tuple[Block, ...]) -> Array:
    """Return derivatives by a calibration that are zero, to be filled."""
    return np.zeros((*shape, dimension(blocks)))


def measured_rows(
    measurements: Sequence[Measurement], state: State, blocks: tuple[Block, ...]
) -> tuple[Array, Array]:
    """Return whitened error (m,) and Jacobian (m, 15 + calibration) of the rows of one epoch."""
    size, errors, jacobians = len(state.cov), [np.zeros(0)], [np.zeros((0, len(state.cov)))]
    for measurement in measurements:
        rows = measurement.linearize(states_of([state]), state.calibration, blocks)
        rows, _ = rows.weighed(measurement.loss)
        errors.append(rows.error.reshape(-1))
        jacobians.append(rows.jacobian(size - MOTION).reshape(-1, size))
    return np.concatenate(errors), np.concatenate(jacobians)
