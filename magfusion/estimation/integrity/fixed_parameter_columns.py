"""Columns of fixed parameters in the inertial factors, interval by interval."""

from typing import NamedTuple

import gtsam
import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.graph import Graph
from magfusion.estimation.graph.inertial import ROWS
from magfusion.model.parameters import Block, dimension
from magfusion.model.parameters.inertial import Inertial, Stream
from magfusion.model.samples import ImuSamples
from magfusion.units import Array, IntArray

STRETCH = 256  # intervals that are processed at once


class InertialColumns(NamedTuple):
    """Columns of inertial factors, most of which are zero."""

    of_bias: Array  # (intervals, 15, 6), derivative of the whitened error by a bias
    bias: Array  # (intervals, 6, k), bias of a typical error, for the columns that are not zero
    at: IntArray  # (k,), indices of these columns
    number: int  # number of all columns

    def of(self, some: IntArray | slice) -> Array:
        """Return the columns of some intervals, shape (m, 15, number)."""
        of_bias = self.of_bias[some]
        out = np.zeros((*of_bias.shape[:2], self.number))
        out[..., self.at] = of_bias @ self.bias[some]
        return out

    def moved(self, step: Array) -> Array:
        """Return the change of the errors by a step of all columns (number,), (intervals, 15)."""
        return np.asarray((self.of_bias @ (self.bias @ step[self.at])[..., None])[..., 0])

    def part(self, columns: slice) -> "InertialColumns":
        """Return a subset of the columns."""
        inside = (self.at >= columns.start) & (self.at < columns.stop)
        at, count = self.at[inside] - columns.start, columns.stop - columns.start
        return InertialColumns(self.of_bias, self.bias[..., inside], at, count)


def inertial_columns(
    result: Smoothed, fixed: tuple[Block, ...], imu: ImuSamples
) -> InertialColumns:
    """Return the effect of typical errors of fixed IMU parameters on the inertial factors."""
    states, calibration = result.states, result.calibration
    acting = [block for block in fixed if isinstance(block.parameter, Inertial)]
    time = calibration.on_log_rate(imu).time + calibration.time_offset
    at = np.searchsorted(time, states.time)
    edges, count = np.arange(0, len(at) + STRETCH, STRETCH), len(at) - 1
    parts = [np.zeros((0, 6, sum(len(block.sigma) for block in acting)))]
    for begin, end in zip(edges, np.minimum(edges[1:], count), strict=False):
        if begin >= end:
            continue
        inside, own = slice(at[begin], at[end]), at[begin : end + 1] - at[begin]
        samples = ImuSamples(imu.time[inside], imu.gyro_body[inside], imu.accel_body[inside])
        stream = Stream(samples, states.world_from_body[begin : end + 1])
        columns = [np.zeros((end - begin, 6, 0))]
        for block in acting:
            assert isinstance(block.parameter, Inertial)
            bias = block.parameter.as_bias(stream)
            if not block.parameter.of_states:
                bias = _means(bias, own)
            columns.append(bias * block.sigma)
        parts.append(np.concatenate(columns, axis=2))
    every = np.arange(dimension(fixed))
    chosen = [every[block.columns] for block in acting]
    return InertialColumns(
        _of_bias(result.graph, result),
        np.concatenate(parts),
        np.concatenate(chosen) if chosen else every[:0],
        len(every),
    )


def _of_bias(graph: Graph, result: Smoothed) -> Array:
    """Return the derivative of each inertial factor by a bias, shape (intervals, 15, 6)."""
    count = graph.epochs - 1
    first, linear = graph.native.size() - count, graph.native.linearize(result.estimate.values)
    out = np.zeros((count, ROWS, 6))
    for k in range(count):
        factor = linear.at(first + k)
        assert isinstance(factor, gtsam.JacobianFactor)
        # A bias that is equal at both ends does not affect its random walk.
        whole, column = factor.getA(), 0
        for key in factor.keys():  # noqa: SIM118
            symbol = gtsam.Symbol(key).chr()
            width = 3 if symbol == ord("v") else 6
            if symbol == ord("b"):
                out[k] += whole[:, column : column + width]
            column += width
    return out


def _means(value: Array, at: IntArray) -> Array:
    """Return the means of samples between indices; zero without samples."""
    total = np.concatenate([np.zeros((1, *value.shape[1:])), np.cumsum(value, axis=0)])
    sums = total[at[1:]] - total[at[:-1]]
    return sums / np.maximum(np.diff(at), 1)[:, None, None]
