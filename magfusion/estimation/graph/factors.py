"""Linear factors of a measurement, one per epoch, on its state and on the calibration.

GTSAM copies all values into every Python callback of a native optimizer, which makes it quadratic.
Here a measurement is linearised in one call, and each epoch owns one JacobianFactor whose memory is
rewritten in place at each iteration.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.estimation.solve.sparse_rows import times_spread
from magfusion.model.parameters import Block, Calibration
from magfusion.units import Array, IntArray

CALIBRATION_KEY = gtsam.symbol("c", 0)
CONSIDERED_KEY = gtsam.symbol("h", 0)
NUISANCE_KEY = gtsam.symbol("n", 0)
PIECE = 128  # epochs that are differentiated at once: by hundreds of parameters, tens of megabytes
Key = Callable[[int], int]  # of an epoch's variable


def _constant(key: int) -> Key:
    return lambda _epoch: key


class Factors:
    """Linear factors of a measurement, one per epoch, on its state and on the calibration.

    `measurement`: of one segment. `blocks`: calibration parameters that are estimated. `own`: key
    of the segment's own variable, and its columns of the calibration.
    """

    def __init__(
        self,
        measurement: Measurement,
        blocks: tuple[Block, ...],
        segment: int = 0,
        own: tuple[int, IntArray] | None = None,
    ) -> None:
        self.measurement, self.blocks = measurement, blocks
        self.segment, self.own = segment, own
        self.graph = gtsam.GaussianFactorGraph()
        self._views: list[tuple[Array, Array]] = []

    def cost(self, states: States, calibration: Calibration) -> float:
        """Return half the sum of the losses, without a Jacobian."""
        error = self.measurement.error(states.rows(self.measurement.epoch), calibration)
        _, rho = Rows(error).weighed(self.measurement.loss)
        return 0.5 * float(np.sum(rho))

    def linearize(self, states: States, calibration: Calibration) -> gtsam.GaussianFactorGraph:
        """Return the factors at a new estimate, rewritten in place."""
        rows = self.rows(states, calibration, self.blocks)
        parts = self._parts(rows)
        jacobian = np.concatenate([part for _, part in parts], axis=-1)
        right = -rows.error.reshape(len(jacobian), -1)
        if not self._views:
            keys = [(key, part.shape[-1]) for key, part in parts]
            for epoch, reported in zip(
                self.measurement.epoch.tolist(), self.informative_rows, strict=True
            ):
                own = [(key(epoch), width) for key, width in keys]
                size = right.shape[1] if isinstance(reported, slice) else len(reported)
                factor = empty_factor(own, size)
                self.graph.push_back(factor)
                self._views.append((factor.getA()[:size], factor.getb()[:size]))
        rows_of = zip(self._views, jacobian, right, self.informative_rows, strict=True)
        for (by, error), own_by, own_right, reported in rows_of:
            by[...] = own_by[reported]
            error[...] = own_right[reported]
        return self.graph

    def considering(
        self,
        states: States,
        calibration: Calibration,
        others: tuple[Block, ...],
        spread: Array,
        *,
        explaining: bool = False,
        nuisance: tuple[Block, ...] = (),
    ) -> gtsam.GaussianFactorGraph:
        """Return the factors with other parameters, and a zero right-hand side.

        The robust weights are those of the factors, since a downweighted outlier transmits little
        of the other parameters' errors.

        Parameters
        ----------
        others : tuple of Block
        spread : ndarray, shape (dimension, dimension)
            Maps unit noise to a step of the other parameters.
        explaining : bool
            With the residuals as right-hand side.
        nuisance : tuple of Block
            More parameters, as a separate variable.
        """
        graph = gtsam.GaussianFactorGraph()
        for piece in self.pieces():
            own = piece.rows(states, calibration, self.blocks)
            parts = piece._with_other_columns(states, calibration, own, others, spread, nuisance)
            for i, epoch in enumerate(piece.measurement.epoch.tolist()):
                reported = piece.informative_rows[i]
                values = np.concatenate([p[i][reported] for _, p in parts], axis=1)
                size = len(values)
                factor = empty_factor([(k(epoch), p.shape[-1]) for k, p in parts], size)
                factor.getA()[:size] = values
                if explaining:
                    factor.getb()[:size] = -own.error[i].ravel()[reported]
                graph.push_back(factor)
        return graph

    @cached_property
    def informative_rows(self) -> list[slice | IntArray]:
        """Rows of each epoch's factor: all, or with many beacons those that are predicted."""
        predicted = self.measurement.predicted_groups()
        if predicted is None:
            return [slice(None)] * len(self.measurement.epoch)
        return [np.flatnonzero(np.repeat(own, 6)) for own in predicted]

    def pieces(self) -> Iterator["Factors"]:
        """Yield the factors in blocks of epochs, to limit the memory of derivatives."""
        for begin in range(0, len(self.measurement.epoch), PIECE):
            part = self.measurement.rows(slice(begin, begin + PIECE))
            yield Factors(part, self.blocks, self.segment, self.own)

    def _with_other_columns(
        self,
        states: States,
        calibration: Calibration,
        rows: Rows,
        others: tuple[Block, ...],
        spread: Array,
        nuisance: tuple[Block, ...],
    ) -> list[tuple[Key, Array]]:
        """Return key and derivative of every variable, with other parameters and nuisances."""
        parts = self._parts(rows)
        by_other = self.rows(states, calibration, others).by_calibration
        if by_other is not None:
            parts.append((_constant(CONSIDERED_KEY), times_spread(_flat(by_other), spread)))
        by_nuisance = self.rows(states, calibration, nuisance).by_calibration if nuisance else None
        if by_nuisance is not None:
            parts.append((_constant(NUISANCE_KEY), _flat(by_nuisance)))
        return parts

    def rows(self, states: States, calibration: Calibration, blocks: tuple[Block, ...]) -> Rows:
        """Return the rows at an estimate, weighted by the robust loss."""
        own = states.rows(self.measurement.epoch)
        result = self.measurement.linearize(own, calibration, blocks)
        return result.weighed(self.measurement.loss)[0]

    def _parts(self, rows: Rows) -> list[tuple[Key, Array]]:
        """Return key and derivative, shape (n, rows, k), of every variable involved."""
        by_calibration = rows.by_calibration if self.blocks else None
        every = ((X, rows.by_pose), (V, rows.by_velocity), (B, rows.by_bias))
        parts: list[tuple[Key, Array]] = [
            (key, _flat(part)) for key, part in every if part is not None
        ]
        if by_calibration is not None:
            result = calibration_parts(_flat(by_calibration), self.own)
            parts += [(_constant(key), part) for key, part in result]
        return parts


def calibration_parts(
    by_calibration: Array, own: tuple[int, IntArray] | None
) -> list[tuple[int, Array]]:
    """Return key and derivative of every variable that holds a part of the calibration."""
    if own is None:
        return [(CALIBRATION_KEY, by_calibration)]
    key, columns = own
    common = by_calibration.copy()
    common[..., columns] = 0.0
    return [(CALIBRATION_KEY, common), (key, by_calibration[..., columns])]


def _flat(part: Array) -> Array:
    return part.reshape(len(part), -1, part.shape[-1])


def empty_factor(parts: Sequence[tuple[int, int]], rows: int) -> gtsam.JacobianFactor:
    """Return a factor of zeros, to be filled.

    `parts`: key and width of each variable, in the order of the columns. `rows`: to be filled;
    there may be a few more, which stay zero.
    """
    groups = [parts[i : i + 3] for i in range(0, len(parts), 3)]  # no constructor takes more
    graph, ordering = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for i, group in enumerate(groups):
        own = max(rows - len(groups) + 1, 1) if i == 0 else 1
        right, unit = _nothing(own)
        blank: list[Any] = [x for key, width in group for x in (key, _zeros(own, width))]
        blank += [right, unit]
        factor = gtsam.JacobianFactor(*blank)
        if len(groups) == 1:
            return factor
        graph.push_back(factor)
    for key, _ in parts:
        ordering.push_back(key)
    return gtsam.JacobianFactor(graph, ordering)


@lru_cache(maxsize=256)
def _zeros(rows: int, width: int) -> Array:
    return np.zeros((rows, width))  # GTSAM copies it


@lru_cache(maxsize=64)
def _nothing(rows: int) -> tuple[Array, gtsam.noiseModel.Unit]:
    return np.zeros(rows), gtsam.noiseModel.Unit.Create(rows)
