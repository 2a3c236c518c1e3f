"""Graph of a log or a window: inertial factors and measurements, with a shared calibration."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.graph.drift_segments import ONE_SEGMENT, Segments
from magfusion.estimation.graph.factors import (
    CALIBRATION_KEY,
    CONSIDERED_KEY,
    NUISANCE_KEY,
    Factors,
    calibration_parts,
    empty_factor,
)
from magfusion.estimation.graph.inertial import ROWS, Link
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.prior_factor import PriorShift, prior_factor
from magfusion.estimation.graph.state import states_in, values_from
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.solve.ordering import nested_dissection
from magfusion.model.parameters import (
    Block,
    Calibration,
    difference,
    dimension,
    prior_sigma,
    retract,
)
from magfusion.model.prior import prior_sqrt_information
from magfusion.model.short_repr import short_repr
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

# Step that a unit damping allows: metres, radians, m/s, m/s^2, rad/s.
POSE_STEP = np.repeat([0.1, 0.3], 3)
VELOCITY_STEP = np.full(3, 1.0)
BIAS_STEP = np.repeat([0.1, 0.01], 3)


@dataclass(frozen=True, eq=False)
class GraphEstimate:
    """Variables that the smoother estimates."""

    __repr__ = short_repr

    values: gtsam.Values  # pose X(i), velocity V(i) and bias B(i) of each epoch
    calibration: Calibration  # of the main segment, where a log is long enough for several
    segments: tuple[Calibration, ...] = ()  # of every segment; empty where it is the same in all
    # of the own keys of a user's factors; their initial values by default
    own: gtsam.Values | None = None

    def at(self, segment: int) -> Calibration:
        """Return the calibration of a segment."""
        return self.segments[segment] if self.segments else self.calibration


@dataclass(frozen=True, eq=False)
class Graph:
    """A sum of squares over the states of a log or of a window."""

    __repr__ = short_repr

    # inertial factors and priors of the motion, linearised by GTSAM
    native: gtsam.NonlinearFactorGraph
    measurements: tuple[Measurement, ...]  # one per kind, for one call each
    # mean of the calibration's prior; None where another factor constrains it
    declared: Calibration | None
    blocks: tuple[Block, ...]  # calibration parameters that are estimated
    epochs: int
    # of the last inertial factors of ``native``, where parameters act on the inertial stream; their
    # columns are those of ``blocks``, then of the considered parameters
    links: tuple[Link, ...] = ()
    segments: Segments = ONE_SEGMENT  # of a long log in which the calibration drifts
    # shift of the prior's mean by other uncertain parameters, where other logs made the prior
    shift: PriorShift | None = None
    user: UserFactors | None = None  # factors of a user's
    factors: tuple[Factors, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", tuple(self._factors()))

    def _factors(self) -> Iterator[Factors]:
        for measurement in self.measurements:
            for k, part in self._parts(measurement):
                yield Factors(part, self.blocks, k, self.segments.own(k))

    def _parts(self, measurement: Measurement) -> Iterator[tuple[int, Measurement]]:
        """Yield the segments of a measurement's epochs, with its rows in each."""
        if len(self.segments) == 1:
            yield 0, measurement
            return
        segment = self.segments.at(measurement.epoch)
        for k in np.unique(segment).tolist():
            yield k, measurement.rows(segment == k)

    @property
    def ordering(self) -> gtsam.Ordering:
        """Elimination order: halves before their separators, the calibration last."""
        own = () if self.user is None else [key for key, _ in self.user.own]
        if not self.blocks:
            return nested_dissection(self.epochs, None, own=own)
        count = range(len(self.segments))
        first = np.searchsorted(self.segments.of_epoch, count).tolist()
        segments = [(first[k], self.segments.key(k)) for k in count]
        return nested_dissection(self.epochs, CALIBRATION_KEY, segments, own)

    def cost(self, estimate: GraphEstimate) -> float:
        """Return half the sum of squared whitened residuals, priors included."""
        if self.links:
            nothing = estimate.values.zeroVectors()
            nothing.insert(CALIBRATION_KEY, np.zeros(dimension(self.blocks)))
            for key, columns in self.segments.variables():
                nothing.insert(key, np.zeros(len(columns)))
            total = float(self.inertial(estimate).error(nothing))
        else:
            total = float(self.native.error(estimate.values))
        if self.user is not None:
            total += self.user.error(estimate.values, estimate.own)
        states = states_in(estimate.values)
        for factors in self.factors:
            total += factors.cost(states, estimate.at(factors.segment))
        if self.blocks and self.declared is not None:
            step = difference(self.declared, estimate.calibration, self.blocks)
            sqrt_information = prior_sqrt_information(self.declared.site, self.blocks)
            total += 0.5 * float(np.sum((sqrt_information @ step) ** 2))
        drifts = self.segments.steps(self._calibrations(estimate), self.blocks)
        return total + 0.5 * sum(float(step @ step) for step in drifts)

    def residual(self, measurement: Measurement, estimate: GraphEstimate) -> Array:
        """Return the whitened error of a measurement, each segment by its own calibration."""
        states = states_in(estimate.values)
        parts = self._parts(measurement)
        return np.concatenate([p.error(states.rows(p.epoch), estimate.at(k)) for k, p in parts])

    def _calibrations(self, estimate: GraphEstimate) -> list[Calibration]:
        return [estimate.at(k) for k in range(len(self.segments))]

    def linearized(self, estimate: GraphEstimate) -> gtsam.GaussianFactorGraph:
        """Return the linear graph at an estimate."""
        graph = self.inertial(estimate)
        states = states_in(estimate.values)
        for factors in self.factors:
            graph.push_back(factors.linearize(states, estimate.at(factors.segment)))
        if self.blocks and self.declared is not None:
            graph.push_back(prior_factor(self.declared, estimate.calibration, self.blocks))
        for drift in self.segments.factors(self._calibrations(estimate), self.blocks):
            graph.push_back(drift)
        if self.user is not None:
            graph.push_back(self.user.linearize(estimate.values, estimate.own))
        return graph

    def moved(self, estimate: GraphEstimate, step: gtsam.VectorValues) -> GraphEstimate:
        """Return the estimate moved by a step of every variable."""
        values, own = estimate.values.retract(step), None
        if self.user is not None:
            own = (self.user.values if estimate.own is None else estimate.own).retract(step)
        if not self.blocks:
            return GraphEstimate(values, estimate.calibration, own=own)
        segments = []
        for k, before in enumerate(self._calibrations(estimate)):
            whole, variable = np.array(step.at(CALIBRATION_KEY)), self.segments.own(k)
            if variable is not None:
                whole[variable[1]] = step.at(variable[0])
            segments.append(retract(before, self.blocks, whole))
        return GraphEstimate(values, segments[self.segments.main], tuple(segments), own)

    def damping_scales(self) -> list[tuple[int, Array]]:
        """Return, for each key, the step that a unit damping allows."""
        scales = {X: POSE_STEP, V: VELOCITY_STEP, B: BIAS_STEP}
        terms = [(symbol(i), step) for symbol, step in scales.items() for i in range(self.epochs)]
        if self.user is not None:
            terms += [(key, np.ones(size)) for key, size in self.user.own]
        if not self.blocks:
            return terms
        sigma = prior_sigma(self.blocks)
        terms += [(key, sigma[columns]) for key, columns in self.segments.variables()]
        return [*terms, (CALIBRATION_KEY, sigma)]

    def inertial(
        self, estimate: GraphEstimate, by_others: Array | None = None
    ) -> gtsam.GaussianFactorGraph:
        """Return priors and inertial factors at an estimate, with the calibration's columns.

        `by_others` (intervals, 15, others): whitened columns of considered parameters.
        """
        graph = self.native.linearize(estimate.values)
        count = len(self.links) if by_others is None else len(by_others)
        if count == 0:
            return graph
        out, first = gtsam.GaussianFactorGraph(), graph.size() - count
        for i in range(first):
            out.push_back(graph.at(i))
        for k in range(count):
            factor = graph.at(first + k)
            assert isinstance(factor, gtsam.JacobianFactor)
            own = self._by_blocks(k)
            widths = {"x": 6, "v": 3, "b": 6}
            keys = factor.keys()
            parts = [(key, widths[chr(gtsam.Symbol(key).chr())]) for key in keys]
            columns, right = [factor.getA()], factor.getb()
            if own is not None:
                segment = int(self.segments.at(np.array(k)))
                for key, part in calibration_parts(own, self.segments.own(segment)):
                    parts.append((key, part.shape[1]))
                    columns.append(part)
                moved = difference(self.links[k].calibration, estimate.at(segment), self.blocks)
                right = right - own @ moved
            if by_others is not None:
                parts.append((CONSIDERED_KEY, by_others.shape[2]))
                columns.append(by_others[k])
            whole = empty_factor(parts, ROWS)
            whole.getA()[:ROWS] = np.concatenate(columns, axis=1)
            whole.getb()[:ROWS] = right
            out.push_back(whole)
        return out

    def _by_blocks(self, k: int) -> Array | None:
        """Return the columns of estimated parameters in an inertial factor, if any."""
        size = dimension(self.blocks)
        if not self.links or not size:
            return None
        by = self.links[k].by_calibration
        assert by is not None
        return by[:, :size]

    def by_considered(self, spread: Array) -> Array | None:
        """Return the columns of considered parameters in the inertial factors, if any."""
        if not self.links:
            return None
        size = dimension(self.blocks)
        every = [link.by_calibration for link in self.links]
        known = [by[:, size:] for by in every if by is not None]
        # Parameters of the fields alone come last, and have no effect here.
        return np.array([by @ spread[: by.shape[1]] for by in known])

    def with_fixed_columns(
        self,
        estimate: GraphEstimate,
        others: tuple[Block, ...],
        spread: Array,
        by_others: Array | None = None,
        *,
        explaining: bool = False,
        nuisance: tuple[Block, ...] = (),
    ) -> gtsam.GaussianFactorGraph:
        """Return the linear graph at an estimate with the columns of fixed parameters.

        Parameters
        ----------
        spread : ndarray, shape (dimension, columns)
            Maps each column to a step of the parameters.
        by_others : ndarray, shape (intervals, 15, columns), optional
            Their effect on the inertial factors, whitened.
        explaining : bool
            With the residuals as right-hand side, which is zero otherwise.
        nuisance : tuple of Block
            Other uncertain parameters, as the variable `NUISANCE_KEY` with its prior.
        """
        graph = self.inertial(estimate, by_others)
        for drift in self.segments.factors(self._calibrations(estimate), self.blocks):
            graph.push_back(drift)
        if self.blocks and self.declared is not None:
            graph.push_back(prior_factor(self.declared, estimate.calibration, self.blocks))
        if self.user is not None:
            graph.push_back(self.user.linearize(estimate.values, estimate.own))
        if not explaining:
            for i in range(graph.size()):
                factor = graph.at(i)
                assert isinstance(factor, gtsam.JacobianFactor)
                factor.getb()[...] = 0.0
        if nuisance:
            unit = gtsam.noiseModel.Unit.Create(dimension(nuisance))
            size = np.diag(1.0 / prior_sigma(nuisance))
            graph.push_back(gtsam.JacobianFactor(NUISANCE_KEY, size, np.zeros(len(size)), unit))
        states = states_in(estimate.values)
        for factors in self.factors:
            own = estimate.at(factors.segment)
            graph.push_back(
                factors.considering(
                    states, own, others, spread, explaining=explaining, nuisance=nuisance
                )
            )
        return graph


def initial_estimate(
    states: Trajectory, calibration: Calibration, segments: tuple[Calibration, ...] = ()
) -> GraphEstimate:
    """Return an estimate with the given states; absent biases are zero."""
    zero = np.zeros((len(states), 3))
    accel = zero if states.accel_bias_body is None else states.accel_bias_body
    gyro = zero if states.gyro_bias_body is None else states.gyro_bias_body
    velocity = zero if states.velocity_world is None else states.velocity_world
    at = zip(states.world_from_body, states.position_world, strict=True)
    poses = [gtsam.Pose3(gtsam.Rot3(rotation), position) for rotation, position in at]
    values = values_from(poses, list(velocity), list(np.concatenate([accel, gyro], axis=1)))
    return GraphEstimate(values, calibration, segments)


def read_states(values: gtsam.Values, time: Array) -> Trajectory:
    """Return the states in ``values`` as a trajectory, without covariance."""
    states = states_in(values)
    biases = states.read_bias()
    return Trajectory(
        time=time,
        world_from_body=states.world_from_body,
        position_world=states.position_world,
        velocity_world=states.velocity_world,
        accel_bias_body=biases[:, :3],
        gyro_bias_body=biases[:, 3:],
    )
