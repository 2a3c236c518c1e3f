"""One field epoch as an online estimator takes it: whitened rows in the state's tangent."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.fusion.factors import FieldFactors, FieldMeasurements, Poses
from magfusion.fusion.state import MOTION, State
from magfusion.fusion.wave import WaveFields
from magfusion.parameters import Block
from magfusion.records.samples import FieldSamples
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray
from magfusion.weights import measurement_cov, paired_whitening, sensor_positions, stacked


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened measurement: ``error + jacobian @ step`` is unit noise.

    Parameters
    ----------
    error : ndarray, shape (rows,)
        Predicted minus measured.
    jacobian : ndarray, shape (rows, 15 + calibration)
    """

    error: Array
    jacobian: Array


def field_rows(factors: FieldFactors, state: State) -> Rows:
    """Return the rows of a field epoch at a state, channel by channel.

    Parameters
    ----------
    factors : FieldFactors
        Of one epoch.
    state : State
        At its time.
    """
    poses = Poses(
        state.world_from_body[None], state.position_world[None], state.velocity_world[None]
    )
    error, by_pose, by_calibration = factors.residual(poses, state.calibration)
    flat = error.reshape(-1)
    jacobian = np.zeros((len(flat), len(state.cov)))
    jacobian[:, :6] = by_pose.reshape(-1, 6)
    jacobian[:, MOTION:] = by_calibration.reshape(len(flat), -1)
    return Rows(flat, jacobian)


def rest_rows(state: State, sigma: float) -> Rows:
    """Return the rows of standing still: no velocity, to within sigma (m/s)."""
    jacobian = np.zeros((3, len(state.cov)))
    jacobian[:, 6:9] = np.eye(3) / sigma
    return Rows(state.velocity_world / sigma, jacobian)


def joined(parts: list[Rows]) -> Rows:
    """Return several measurements as one."""
    return Rows(
        np.concatenate([p.error for p in parts]), np.concatenate([p.jacobian for p in parts])
    )


def channel_distances(rows: Rows, cov: Array, channels: int) -> Array:
    """Return the squared Mahalanobis distance of each channel's innovation, (channels,).

    Zero where a channel is missing.
    """
    error = rows.error.reshape(channels, 6)
    jacobian = rows.jacobian.reshape(channels, 6, -1)
    spread = jacobian @ cov @ np.swapaxes(jacobian, 1, 2) + np.eye(6)
    solved = np.linalg.solve(spread, error[..., None])[..., 0]
    return np.asarray(np.sum(error * solved, axis=1))


def without(measurements: FieldMeasurements, rejected: BoolArray) -> FieldMeasurements:
    """Return an epoch's measurements with some channels taken out."""
    root = np.where(rejected[None, :, None, None], 0.0, measurements.root)
    return replace(measurements, root=root)


def measured_at(
    samples: FieldSamples,
    wave: WaveFields | None,
    state: State,
    rate_body: Array,
    applied_offset: float,
    step: float,
) -> FieldMeasurements:
    """Return an epoch as the estimators take it, weighed at a predicted state.

    Parameters
    ----------
    samples : FieldSamples
        One epoch.
    wave : WaveFields, optional
        Where it was demodulated about a prediction.
    state : State
    rate_body : ndarray, shape (3,)
        Angular rate without its bias (rad/s).
    applied_offset : float
        IMU time offset with which the state was propagated (s).
    step : float
        Time since the epoch before (s): overlapping windows hold the same samples, and that must
        not count twice.
    """
    site = state.calibration.site
    pose = Trajectory(samples.time, state.world_from_body[None], state.position_world[None])
    cov = measurement_cov(site, samples, sensor_world=sensor_positions(site, pose))
    cov = cov * max(1.0, float(samples.window[0]) / step)
    shape = (*samples.phasor_sensor.shape[:2], 6)
    return FieldMeasurements(
        time=samples.time,
        measured=stacked(samples.phasor_sensor),
        root=paired_whitening(cov, samples.valid),
        rate_body=rate_body[None],
        applied_offset=applied_offset,
        by_time_offset=np.zeros(shape) if wave is None else stacked(wave.by_time_offset),
    )


def single(measurements: FieldMeasurements, blocks: tuple[Block, ...]) -> FieldFactors:
    """Return the factors of one epoch."""
    return FieldFactors(measurements, blocks, None)
