"""Field factors of a whole batch, linearised in one call of the measurement model.

GTSAM copies all values into every Python callback of a native optimizer, which makes it quadratic.
Here each epoch owns one JacobianFactor whose memory is rewritten in place at each iteration.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from magfusion.fusion.earth_rows import linearize_earth, predict_earth
from magfusion.parameters import (
    Block,
    Calibration,
    dimension,
    linearize_channels,
    predict_channels,
)
from magfusion.units import Array

CALIBRATION_KEY = gtsam.symbol("c", 0)
# 95 % efficient on white noise of one dimension; the last is for what is no noise at all.
ROBUST_WIDTH = {"huber": 1.345, "cauchy": 2.385, "geman-mcclure": 2.385}


@dataclass(frozen=True, eq=False)
class FieldMeasurements:
    """Phasors as the smoother takes them.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    measured : ndarray, shape (n, channels, 6)
        Real, then imaginary part (T); zero where missing.
    root : ndarray, shape (n, channels, 6, 6)
        Whitening; zero where missing.
    rate_body : ndarray, shape (n, 3)
        Angular rate, for the time offset (rad/s).
    applied_offset : float
        IMU time offset with which the inertial data were cut (s).
    by_time_offset : ndarray, shape (n, channels, 6)
        What a change of it does to the lock-in, the states held (T/s).
    earth_repeats : float, optional
        How many epochs in a row count as one measurement of the Earth field, which then stands
        behind the last channel as one more; None where it is not measured.
    """

    time: Array
    measured: Array
    root: Array
    rate_body: Array
    applied_offset: float
    by_time_offset: Array
    earth_repeats: float | None = None


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses and velocities of all epochs as arrays."""

    world_from_body: Array
    position_world: Array
    velocity_world: Array


def read_poses(values: gtsam.Values) -> Poses:
    """Return the states in ``values`` as arrays, in order of their keys."""
    flat = gtsam.utilities.extractPose3(values)
    return Poses(
        world_from_body=flat[:, :9].reshape(-1, 3, 3),
        position_world=flat[:, 9:],
        velocity_world=gtsam.utilities.extractVectors(values, "v"),
    )


def robust_weight(square: Array, loss: str | None, components: int = 6) -> tuple[Array, Array]:
    """Return weight and loss of squared whitened residual norms.

    Parameters
    ----------
    square : ndarray
    loss : {None, 'huber', 'cauchy', 'geman-mcclure'}
    components : int
        Of each residual.

    Returns
    -------
    weight, rho : ndarray
        ``rho`` replaces ``square`` in the cost; ``weight`` is its derivative by ``square``.
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


class FieldFactors:
    """One linear factor an epoch on its pose and on the calibration.

    Parameters
    ----------
    measurements : FieldMeasurements
    blocks : tuple of Block
        Calibration parameters that are estimated.
    loss : str, optional
        Robust loss for each channel.
    earth_loss : str, optional
        Robust loss of the Earth field.
    """

    def __init__(
        self,
        measurements: FieldMeasurements,
        blocks: tuple[Block, ...],
        loss: str | None,
        earth_loss: str | None = None,
    ) -> None:
        self.measurements, self.blocks = measurements, blocks
        self.loss, self.earth_loss = loss, earth_loss
        n, channels = measurements.measured.shape[:2]
        rows, self.columns = 6 * channels, dimension(blocks)
        self.graph = gtsam.GaussianFactorGraph()
        self._jacobians: list[Array] = []
        self._errors: list[Array] = []
        unit = gtsam.noiseModel.Unit.Create(rows)
        zero, by_pose = np.zeros(rows), np.zeros((rows, 6))
        by_calibration = np.zeros((rows, self.columns))
        for i in range(n):
            if self.columns:
                factor = gtsam.JacobianFactor(
                    X(i), by_pose, CALIBRATION_KEY, by_calibration, zero, unit
                )
            else:
                factor = gtsam.JacobianFactor(X(i), by_pose, zero, unit)
            self.graph.push_back(factor)
            self._jacobians.append(factor.getA())
            self._errors.append(factor.getb())

    def cost(self, poses: Poses, calibration: Calibration) -> float:
        """Return half the sum of the losses, without a Jacobian."""
        data = self.measurements
        lag, world_from_body, position_world = self._at_field(poses, calibration)
        phasor = predict_channels(calibration, data.time, world_from_body, position_world)
        value = np.concatenate([phasor.real, phasor.imag], axis=-1)
        if data.earth_repeats is not None:
            value = np.concatenate([value, predict_earth(calibration, world_from_body)], axis=1)
        value = value + lag * data.by_time_offset
        error = data.root @ (value - data.measured)[..., None]
        _, rho = self._robust(np.sum(error[..., 0] ** 2, axis=2))
        return 0.5 * float(np.sum(rho))

    def residual(self, poses: Poses, calibration: Calibration) -> tuple[Array, Array, Array]:
        """Return whitened residual (n, channels, 6) and its Jacobians by pose and calibration."""
        data = self.measurements
        value, by_pose, by_calibration = self._predicted(poses, calibration, self.blocks)
        error = (data.root @ (value - data.measured)[..., None])[..., 0]
        return error, data.root @ by_pose, data.root @ by_calibration

    def sensitivity(
        self, poses: Poses, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Array:
        """Return the whitened Jacobian by other parameters, shape (n, channels, 6, dimension).

        With the robust weights of the factors, since an outlier that has little say in the estimate
        passes little of the others' errors on.
        """
        data = self.measurements
        value, _, by_other = self._predicted(poses, calibration, blocks)
        error = (data.root @ (value - data.measured)[..., None])[..., 0]
        weight, _ = self._robust(np.sum(error**2, axis=2))
        return np.asarray(np.sqrt(weight)[..., None, None] * (data.root @ by_other))

    def with_others(self, key: int, columns: Array) -> gtsam.GaussianFactorGraph:
        """Return the factors as last linearised, with other parameters and nothing to explain.

        Parameters
        ----------
        key : int
            Of the other parameters.
        columns : ndarray, shape (n, channels, 6, others)
            Their whitened Jacobian.
        """
        graph = gtsam.GaussianFactorGraph()
        zero = np.zeros(columns.shape[1] * 6)
        unit = gtsam.noiseModel.Unit.Create(len(zero))
        flat = columns.reshape(len(columns), len(zero), -1)
        for i, (own, other) in enumerate(zip(self._jacobians, flat, strict=True)):
            by_pose, by_calibration = own[:, :6], own[:, 6:]
            if self.columns:
                factor = gtsam.JacobianFactor(
                    X(i), by_pose, CALIBRATION_KEY, by_calibration, key, other, zero, unit
                )
            else:
                factor = gtsam.JacobianFactor(X(i), by_pose, key, other, zero, unit)
            graph.push_back(factor)
        return graph

    def _robust(self, square: Array) -> tuple[Array, Array]:
        """Return weight and loss of every channel, the Earth field by its own loss.

        An epoch that counts only in part is an outlier no less.
        """
        weight, rho = robust_weight(square, self.loss)
        repeats = self.measurements.earth_repeats
        if repeats is not None:
            last = robust_weight(repeats * square[:, -1:], self.earth_loss, components=3)
            weight = np.concatenate([weight[:, :-1], last[0]], axis=1)
            rho = np.concatenate([rho[:, :-1], last[1] / repeats], axis=1)
        return weight, rho

    def _at_field(self, poses: Poses, calibration: Calibration) -> tuple[float, Array, Array]:
        """Return lag, attitude and position where the field was taken.

        The states carry the IMU's clock: that was a little before or after.
        """
        lag = calibration.time_offset - self.measurements.applied_offset
        turn = Rotation.from_rotvec(-lag * self.measurements.rate_body).as_matrix()
        return lag, poses.world_from_body @ turn, poses.position_world - lag * poses.velocity_world

    def _predicted(
        self, poses: Poses, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> tuple[Array, Array, Array]:
        data = self.measurements
        velocity_body = (
            np.swapaxes(poses.world_from_body, 1, 2) @ poses.velocity_world[..., None]
        )[..., 0]
        lag, world_from_body, position_world = self._at_field(poses, calibration)
        value, by_pose, by_calibration = linearize_channels(
            calibration,
            blocks,
            data.time,
            world_from_body,
            position_world,
            np.concatenate([data.rate_body, velocity_body], axis=1),
        )
        if data.earth_repeats is not None:
            last = linearize_earth(calibration, blocks, world_from_body, data.rate_body)
            value, by_pose, by_calibration = (
                np.concatenate(pair, axis=1)
                for pair in zip((value, by_pose, by_calibration), last, strict=True)
            )
        value += lag * data.by_time_offset
        for block in blocks:
            if block.kind == "time_offset":
                by_calibration[..., block.columns.start] += data.by_time_offset
        return value, by_pose, by_calibration

    def linearize(self, values: gtsam.Values, calibration: Calibration) -> float:
        """Rewrite the factors at a new estimate; return the cost (half the squared residual)."""
        error, by_pose, by_calibration = self.residual(read_poses(values), calibration)
        weight, rho = self._robust(np.sum(error**2, axis=2))
        share = np.sqrt(weight)[..., None]
        n = len(error)
        block = np.concatenate([by_pose, by_calibration], axis=-1) * share[..., None]
        block = block.reshape(n, -1, 6 + self.columns)
        right = -(error * share).reshape(n, -1)
        for view, rows in zip(self._jacobians, block, strict=True):
            view[...] = rows
        for view, row in zip(self._errors, right, strict=True):
            view[...] = row
        return 0.5 * float(np.sum(rho))
