"""Factors of GTSAM's nonlinear graphs from measurements, and from a calibration's parameters.

Measurements become ``gtsam.CustomFactor``s, one a group of rows (a beacon's tone at an epoch), so
that the robust loss acts on the group as in our loop.  A CustomFactor calls Python: it cannot be
copied, pickled or serialised, and GTSAM copies all values into each call.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V, X

from magfusion.estimation.graph.measurement import ROBUST_WIDTH, Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import (
    Block,
    Calibration,
    difference,
    dimension,
    prior_sigma,
    retract,
)
from magfusion.model.prior import prior_sqrt_information
from magfusion.units import Array, IntArray

# Of a parameter's sigma, of the chart's difference quotient: its error is a millionth of the
# square of the sigma.
CHART_STEP = 1e-3
M_ESTIMATORS: dict[str, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
}
ErrorFunction = Callable[[gtsam.CustomFactor, gtsam.Values, list[Array] | None], Array]


class Part(NamedTuple):
    """Columns of the calibration's tangent vector that a key holds."""

    key: int
    columns: IntArray


class MotionKeys(NamedTuple):
    """Keys of the pose, velocity and bias of an epoch."""

    pose: int
    velocity: int
    bias: int


class Charted(NamedTuple):
    """A calibration, and the derivative of its tangent vector by the values of the keys."""

    calibration: Calibration
    by_values: Array


class CalibrationKeys:
    """Calibration parameters as vectors of a graph: ``C(i)`` is the step of block ``i``.

    Parameters
    ----------
    declared : Calibration
        Where all steps are zero.
    blocks : tuple of Block
        Estimated parameters, in the order of the keys.
    own : tuple of int and int ndarray, optional
        Key of the variable of a segment of a long log, and the columns that it replaces.
    """

    def __init__(
        self,
        declared: Calibration,
        blocks: tuple[Block, ...],
        own: tuple[int, IntArray] | None = None,
    ) -> None:
        self.declared, self.blocks, self.own = declared, blocks, own
        self.parts = tuple(
            Part(C(i), np.arange(b.columns.start, b.columns.stop)) for i, b in enumerate(blocks)
        )
        if own is not None:
            self.parts = (*self.parts, Part(*own))
        self._known = np.zeros(dimension(blocks)), declared
        self._by_values: Array | None = None if blocks else np.zeros((0, 0))

    def step(self, values: gtsam.Values) -> Array:
        """Return the step from the declared calibration, shape (dimension,)."""
        out = np.zeros(dimension(self.blocks))
        for key, columns in self.parts:
            out[columns] = values.atVector(key)
        return out

    def calibration(self, values: gtsam.Values) -> Calibration:
        """Return the calibration at some values."""
        step = self.step(values)
        if not np.array_equal(step, self._known[0]):
            self._known = step, retract(self.declared, self.blocks, step)
            self._by_values = None
        return self._known[1]

    def charted(self, values: gtsam.Values) -> Charted:
        """Return the calibration, and the derivative of its tangent vector by the steps."""
        calibration = self.calibration(values)
        if self._by_values is None:
            self._by_values = self._chart(self.step(values), calibration)
        return Charted(calibration, self._by_values)

    def _chart(self, step: Array, calibration: Calibration) -> Array:
        """Return the derivative of the tangent vector at a calibration by the steps to it."""
        by_values, sigma = np.zeros((len(step), len(step))), prior_sigma(self.blocks)
        # No block affects another: a component of all of them is moved at once.
        for i in range(max(len(block.sigma) for block in self.blocks)):
            here = [block for block in self.blocks if i < len(block.sigma)]
            columns = [block.columns.start + i for block in here]
            moved = np.zeros(len(step))
            moved[columns] = CHART_STEP * sigma[columns]
            ahead, behind = (
                difference(calibration, retract(self.declared, self.blocks, at), self.blocks)
                for at in (step + moved, step - moved)
            )
            for block, column in zip(here, columns, strict=True):
                slope = (ahead - behind)[block.columns] / (2.0 * moved[column])
                by_values[block.columns, column] = slope
        return by_values

    def by_parts(self, by_values: Array) -> list[Array]:
        """Return the columns of each key, from those of the whole calibration."""
        if self.own is None:
            return [by_values[:, columns] for _, columns in self.parts]
        common = by_values.copy()
        common[:, self.own[1]] = 0.0
        every = [common[:, columns] for _, columns in self.parts[:-1]]
        return [*every, by_values[:, self.own[1]]]

    def insert(self, values: gtsam.Values, calibration: Calibration) -> None:
        """Insert the steps to a calibration; keys that are present stay."""
        step = difference(self.declared, calibration, self.blocks)
        for key, columns in self.parts:
            if not values.exists(key):
                values.insert(key, step[columns])

    def prior_factor(self) -> gtsam.NoiseModelFactor:
        """Return the prior of the declared calibration, with its correlations."""
        whitening = prior_sqrt_information(self.declared.site, self.blocks)
        parts = [(key, whitening[:, columns]) for key, columns in self.parts]
        return linear_factor(parts)


def fill(jacobians: list[Array], parts: Sequence[Array]) -> None:
    """Write the derivatives of a callback into the list that GTSAM passes."""
    for i, part in enumerate(parts):
        jacobians[i] = part


def whitened_factor(
    keys: Sequence[int], rows: int, error: ErrorFunction, like: gtsam.noiseModel.Base | None = None
) -> gtsam.NoiseModelFactor:
    """Return a factor of a whitened error, computed by a callback of GTSAM's form.

    `like`: noise with the robust loss of the factor, if any.
    """
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Unit.Create(rows)
    if isinstance(like, gtsam.noiseModel.Robust):
        noise = gtsam.noiseModel.Robust.Create(like.robust(), noise)
    return gtsam.CustomFactor(noise, keys, error)


def linear_factor(parts: Sequence[tuple[int, Array]]) -> gtsam.NoiseModelFactor:
    """Return a factor whose whitened error is a matrix times each vector, of unit noise."""

    def error(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        if jacobians is not None:
            fill(jacobians, [by for _, by in parts])
        return np.asarray(sum(by @ values.atVector(key) for key, by in parts))

    return whitened_factor([key for key, _ in parts], len(parts[0][1]), error)


class EpochRows:
    """Rows of a measurement at one epoch, computed once for the factors of all its groups.

    `measurement`: of one epoch. `at`: a variable that is not in the values is zero.
    """

    def __init__(self, measurement: Measurement, keys: CalibrationKeys, at: MotionKeys) -> None:
        self.measurement, self.keys, self.at = measurement, keys, at
        self._known: tuple[bytes, Calibration, Rows] | None = None

    def states(self, values: gtsam.Values) -> States:
        """Return the state of the epoch."""
        pose, velocity, bias = self.at
        at = values.atPose3(pose) if values.exists(pose) else gtsam.Pose3()
        return States(
            at.rotation().matrix()[None],
            np.asarray(at.translation())[None],
            (values.atVector(velocity) if values.exists(velocity) else np.zeros(3))[None],
            lambda: (values.atConstantBias(bias).vector() if values.exists(bias) else np.zeros(6))[
                None
            ],
        )

    def error(self, values: gtsam.Values) -> Array:
        """Return the whitened error, shape (groups, components)."""
        return self.measurement.error(self.states(values), self.keys.calibration(values))[0]

    def rows(self, values: gtsam.Values) -> Rows:
        """Return the rows, with derivatives by the calibration's keys."""
        states, (calibration, by_values) = self.states(values), self.keys.charted(values)
        place = states.world_from_body, states.position_world, states.velocity_world
        at = b"".join(part.tobytes() for part in (*place, states.read_bias()))
        if self._known is None or self._known[0] != at or self._known[1] is not calibration:
            rows = self.measurement.linearize(states, calibration, self.keys.blocks)
            if rows.by_calibration is not None:
                rows = replace(rows, by_calibration=rows.by_calibration @ by_values)
            self._known = at, calibration, rows
        return self._known[2]

    def parts(self, rows: Rows, group: int) -> list[tuple[int, Array]]:
        """Return key and derivative, shape (components, k), of every variable of a group."""
        every = zip(self.at, (rows.by_pose, rows.by_velocity, rows.by_bias), strict=True)
        parts = [(key, by[0, group]) for key, by in every if by is not None]
        if rows.by_calibration is not None and self.keys.blocks:
            own = self.keys.by_parts(rows.by_calibration[0, group])
            parts += [(part.key, by) for part, by in zip(self.keys.parts, own, strict=True)]
        return parts


def measurement_factors(
    measurement: Measurement, keys: CalibrationKeys, values: gtsam.Values
) -> Iterator[gtsam.NoiseModelFactor]:
    """Yield a factor of every group of rows of every epoch that carries information.

    `values`: those variables are keys of a factor whose derivative is not zero here.
    """
    for i, epoch in enumerate(measurement.epoch.tolist()):
        motion_keys = MotionKeys(X(epoch), V(epoch), B(epoch))
        shared = EpochRows(measurement.rows(slice(i, i + 1)), keys, motion_keys)
        rows = shared.rows(values)
        for group in range(rows.error.shape[1]):
            used = [key for key, by in shared.parts(rows, group) if by.any()]
            if used:
                yield group_factor(shared, group, used, rows.error.shape[2])


def group_factor(
    shared: EpochRows, group: int, used: list[int], components: int
) -> gtsam.NoiseModelFactor:
    """Return the factor of a group of rows, with the measurement's robust loss.

    `used`: keys of the factor. `components`: rows of the group.
    """
    loss = shared.measurement.loss
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Unit.Create(components)
    if loss is not None:
        of_groups = np.atleast_2d(loss.repeats)[0]
        repeats = float(of_groups[group if len(of_groups) > 1 else 0])
        noise = _robust(noise, loss.kind, components / repeats)
    return gtsam.CustomFactor(noise, used, partial(_group_error, shared, group, used))


def _robust(noise: gtsam.noiseModel.Base, loss: str, square: float) -> gtsam.noiseModel.Robust:
    """Return noise with a loss as wide as `robust_weight`'s for so many components."""
    width = ROBUST_WIDTH[loss] * float(np.sqrt(square))
    return gtsam.noiseModel.Robust.Create(M_ESTIMATORS[loss].Create(width), noise)


def _group_error(
    shared: EpochRows,
    group: int,
    used: list[int],
    _this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    if jacobians is None:
        return shared.error(values)[group]
    rows = shared.rows(values)
    by = dict(shared.parts(rows, group))
    fill(jacobians, [by[key] for key in used])
    return rows.error[0, group]
