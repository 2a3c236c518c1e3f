"""Inertial factors between states, and their derivatives by calibration parameters of the IMU."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.graph.preintegration import (
    MIN_STEP,
    Increments,
    across_held,
    preintegrate,
)
from magfusion.estimation.graph.state import MOTION
from magfusion.model.parameters import Block, Calibration, dimension, inertial_blocks, retract
from magfusion.model.platform_motion import HeldModel
from magfusion.model.site import Platform, Site
from magfusion.units import Array

Preintegrated = gtsam.PreintegratedCombinedMeasurementsG
STEP = 1e-2  # of a parameter's sigma, of the difference quotient
ROWS = MOTION  # of an inertial factor


@dataclass(frozen=True, eq=False)
class Steps:
    """Data to preintegrate the measurement of one interval again."""

    increments: Increments  # of this interval alone
    # accel_bias_body, gyro_bias_body: (3,), at which they are linearised (m/s^2, rad/s)
    accel_bias_body: Array
    gyro_bias_body: Array

    def preintegrated(self, site: Site) -> Preintegrated:
        """Return the measurement."""
        biases = (bias[None] for bias in (self.accel_bias_body, self.gyro_bias_body))
        return preintegrate(self.increments, site.platform.imu, site.gravity, *biases)[0]

    def split(self, after: float) -> "tuple[Steps, Steps]":
        """Return the steps until some time after the first state (s), and the others."""
        own, ends = self.increments, np.cumsum(self.increments.dt)
        k = int(np.searchsorted(ends, after))
        parts = (
            (slice(0, k + 1), np.append(own.dt[:k], after - (ends[k] - own.dt[k]))),
            (slice(k, None), np.append(ends[k] - after, own.dt[k + 1 :])),
        )
        out = []
        for rows, dt in parts:
            kept = dt > MIN_STEP
            gyro, accel, first = own.gyro_body[rows], own.accel_body[rows], [0, int(kept.sum())]
            increments = replace(
                own,
                gyro_body=gyro[kept],
                accel_body=accel[kept],
                dt=dt[kept],
                first=np.array(first),
            )
            out.append(replace(self, increments=increments))
        return out[0], out[1]


@dataclass(frozen=True, eq=False)
class Link:
    """The inertial stream between two states."""

    measurement: Preintegrated
    # (15, dimension), derivative of the factor's whitened error; None where no parameter acts on
    # the stream
    by_calibration: Array | None
    calibration: Calibration  # with which the stream was corrected
    steps: Steps | None = None  # of a link that a checkpoint may have to store

    def split(self, after: float, site: Site) -> "tuple[Link, Link]":
        """Return the links to and from a new state, some time after the first (s)."""
        assert self.steps is not None
        assert self.by_calibration is None
        first, second = (
            replace(self, measurement=steps.preintegrated(site), steps=steps)
            for steps in self.steps.split(after)
        )
        return first, second


def inertial_factor(i: int, measurement: Preintegrated) -> gtsam.GalileanCombinedImuFactor:
    """Return the factor between an epoch and the next."""
    j = i + 1
    return gtsam.GalileanCombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), measurement)


def inertial_graph(
    preintegrated: Sequence[Preintegrated], platform: Platform
) -> gtsam.NonlinearFactorGraph:
    """Return priors of the first velocity and bias, and the inertial factors between epochs."""
    graph, imu = gtsam.NonlinearFactorGraph(), platform.imu
    sigmas = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
    bias_noise: gtsam.noiseModel.Gaussian
    bias_noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-9))
    if isinstance(imu, HeldModel):
        cov = np.diag(sigmas**2)
        cov[3:, 3:] = across_held(cov[3:, 3:], imu)
        bias_noise = gtsam.noiseModel.Gaussian.Covariance(cov)
    zero_bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))
    graph.addPriorConstantBias(B(0), zero_bias, bias_noise)
    speed = gtsam.noiseModel.Isotropic.Sigma(3, platform.motion.start_speed_sigma)
    graph.addPriorVector(V(0), np.zeros(3), speed)
    for i, measurement in enumerate(preintegrated):
        graph.add(inertial_factor(i, measurement))
    return graph


def links_between(
    preintegrate: Callable[[Calibration], list[Preintegrated]],
    calibration: Calibration,
    blocks: tuple[Block, ...],
    states: Callable[[list[Preintegrated]], gtsam.Values],
) -> list[Link]:
    """Return the links between states, differentiated by the parameters that act on the IMU.

    `preintegrate`: returns the measurement of every interval, of the stream as a calibration
    corrects it. `states`: returns where to differentiate.
    """
    base = preintegrate(calibration)
    acting = inertial_blocks(blocks)
    if not acting:
        return [Link(measurement, None, calibration) for measurement in base]
    values, columns = states(base), np.zeros((len(base), ROWS, dimension(blocks)))
    for block in acting:
        for column, sigma in zip(
            range(block.columns.start, block.columns.stop), block.sigma, strict=True
        ):
            step = np.zeros(dimension(blocks))
            step[column] = STEP * sigma
            ahead, behind = (
                _errors(preintegrate(retract(calibration, blocks, sign * step)), values)
                for sign in (1.0, -1.0)
            )
            columns[:, :, column] = (ahead - behind) / (2.0 * step[column])
    for own, measurement in zip(columns, base, strict=True):
        noise = inertial_factor(0, measurement).noiseModel()
        assert isinstance(noise, gtsam.noiseModel.Gaussian)
        own[...] = noise.R() @ own
    return [Link(m, by, calibration) for m, by in zip(base, columns, strict=True)]


def _errors(measurements: list[Preintegrated], values: gtsam.Values) -> Array:
    factors = [inertial_factor(i, m) for i, m in enumerate(measurements)]
    return np.array([factor.unwhitenedError(values) for factor in factors])
