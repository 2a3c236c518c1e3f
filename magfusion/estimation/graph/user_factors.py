"""Factors of a user's GTSAM graph on the states of an estimator."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import InputError
from magfusion.estimation.graph.factors import empty_factor
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.short_repr import short_repr
from magfusion.units import Array, IntArray

MOTION: dict[str, Callable[[int], int]] = {"x": X, "v": V, "b": B}
RESERVED = "cdhn"  # of the calibration, its segments, considered parameters and nuisances
OWN_ITERATIONS = 3  # of Gauss and Newton, for the optimum of own keys at given states


@contextmanager
def _evaluated() -> Iterator[None]:
    try:
        yield
    except RuntimeError as failure:  # as of a key whose variable has another type
        reason = str(failure).strip().splitlines()[0]
        raise InputError(f"a factor of yours cannot be evaluated ({reason})") from failure


@dataclass(frozen=True, eq=False)
class UserFactors:
    """Factors on states at given times, under the user's numbers, and on keys of their own."""

    __repr__ = short_repr

    # on X(j), V(j), B(j) of the j-th time, and on keys of its own
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values  # initial values of its own keys
    time: Array  # (times,) (s), ascending
    epoch: IntArray  # (times,), state index of each time

    @classmethod
    def of(
        cls,
        graph: gtsam.NonlinearFactorGraph | gtsam.NonlinearFactor,
        values: gtsam.Values | None,
        time: Array | Sequence[float],
    ) -> "UserFactors":
        """Return factors, or one, of which every key is known."""
        time = np.atleast_1d(np.asarray(time, dtype=float))
        if isinstance(graph, gtsam.NonlinearFactor):
            single, graph = graph, gtsam.NonlinearFactorGraph()
            graph.add(single)
        if not (np.all(np.isfinite(time)) and np.all(np.diff(time) > 0.0)):
            raise InputError("times of factors must be finite and ascending")
        own, used = gtsam.Values() if values is None else gtsam.Values(values), set()
        for key in graph.keyVector():
            symbol = gtsam.Symbol(key)
            kind, number = chr(symbol.chr()), symbol.index()
            if kind in RESERVED:
                raise InputError(
                    f"a factor is on {kind}{number}, a key of the estimator; rename it"
                )
            if kind in MOTION and number >= len(time):
                raise InputError(
                    f"a factor is on {kind}{number}, but times has {len(time)}; add the time of"
                    " every state"
                )
            if kind not in MOTION and not own.exists(key):
                raise InputError(
                    f"a factor is on {kind}{number}, which has no initial value; add it to values"
                )
            used |= set() if kind in MOTION else {key}
        for key in list(own.keys()):
            if key not in used:
                own.erase(key)
        return cls(graph, own, time, np.zeros(0, dtype=np.int64))

    def among(self, time: Array) -> "UserFactors":
        """Return the factors on the states of all times (s), shape (epochs,)."""
        return replace(self, epoch=np.searchsorted(time, self.time))

    @property
    def own(self) -> list[tuple[int, int]]:
        """Key and dimension of every variable of their own."""
        zero = self.values.zeroVectors()
        return [(key, len(zero.at(key))) for key in list(self.values.keys())]

    def error(self, values: gtsam.Values, own: gtsam.Values | None) -> float:
        """Return half the sum of squares, or the loss, at an estimate of states and own keys."""
        with _evaluated():
            return float(self.graph.error(self.named(values, own)))

    def linearize(
        self, values: gtsam.Values, own: gtsam.Values | None
    ) -> gtsam.GaussianFactorGraph:
        """Return the linear factors at an estimate, on the estimator's keys."""
        out, at = gtsam.GaussianFactorGraph(), self.named(values, own)
        linear, zero = self.graph.linearize(at), at.zeroVectors()
        for i in range(linear.size()):
            factor = gtsam.JacobianFactor(linear.at(i))
            keys, right = list(factor.keys()), factor.getb()
            whole = empty_factor([(self.key(k), len(zero.at(k))) for k in keys], len(right))
            whole.getA()[: len(right)] = factor.getA()
            whole.getb()[: len(right)] = right
            out.push_back(whole)
        return out

    def marginalized(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Return the linear factors at an estimate of the states, without their own keys.

        These are at their optimum for the states, and eliminated.
        """
        with _evaluated():
            if not self.own:
                return self.linearize(values, None)
            own, ordering = self.values, gtsam.Ordering()
            for key, _ in self.own:
                ordering.push_back(key)
            fixed = values.zeroVectors()
            for _ in range(OWN_ITERATIONS):
                linear = self.linearize(values, own)
                solved, rest = eliminate_partial(linear, ordering, orthogonal=True)
                own = own.retract(solved.optimize(fixed))
            return rest

    def key(self, key: int) -> int:
        """Return the estimator's key of a user's key."""
        symbol = gtsam.Symbol(key)
        motion = MOTION.get(chr(symbol.chr()))
        return key if motion is None else motion(int(self.epoch[symbol.index()]))

    def named(self, values: gtsam.Values, own: gtsam.Values | None) -> gtsam.Values:
        """Return an estimate under the user's numbers.

        `values`: of the states, under the estimator's. `own`: of their own keys; the initial ones
        by default.
        """
        out = gtsam.Values(self.values if own is None else own)
        for key in self.graph.keyVector():
            kind, there = chr(gtsam.Symbol(key).chr()), self.key(key)
            if kind == "x":
                out.insert(key, values.atPose3(there))
            elif kind == "v":
                out.insert(key, values.atVector(there))
            elif kind == "b":
                out.insert(key, values.atConstantBias(there))
        return out
