"""Propagation from one field epoch to the next by the inertial stream: mean, transition, noise."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from magfusion.estimation.graph.imu_decimation import thinned
from magfusion.estimation.graph.inertial import Link, Steps, inertial_factor, links_between
from magfusion.estimation.graph.preintegration import cut_at_epochs
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.state import MOTION, State, values_from
from magfusion.model.parameters import Block, Calibration, corrected_imu
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array

# Columns of GTSAM's factor, by key: x0 v0 x1 v1 b0 b1.
_BEFORE = np.r_[0:6, 6:9, 18:24]
_AFTER = np.r_[9:15, 15:18, 24:30]


@dataclass(frozen=True, eq=False)
class Propagated:
    """Result of a propagation by the inertial stream."""

    state: State  # at the later time, with its propagated covariance
    link: Link
    gap_bridged: bool  # whether the stream had a gap
    # transition, noise: (15 + calibration, 15 + calibration), of the state's tangent
    transition: Array
    noise: Array


def propagate(
    state: State,
    imu: ImuSamples,
    time: float,
    site: Site,
    time_offset: float,
    process_noise: ProcessNoise | None = None,
    usual: float | None = None,
    blocks: tuple[Block, ...] = (),
    *,
    blind: bool = False,
) -> Propagated:
    """Propagate a state to a later time.

    Transition and noise are those of the graph's own inertial factor, so that a filter built on
    this and the graph agree to round-off.

    Parameters
    ----------
    imu : ImuSamples
        Covering the interval; where it does not, its end values are extended.
    time : float
        (s)
    site : Site
        Its IMU's noise and its gravity.
    time_offset : float
        Added to the IMU's stamps (s).
    process_noise : ProcessNoise, optional
        Of the calibration.
    usual : float, optional
        Sampling interval of the IMU (s), as in `cut_at_epochs`.
    blocks : tuple of Block
        Calibration parameters in the state's tangent.
    blind : bool
        Whether other samples replace inertial ones: they have the noise of a gap.
    """
    epochs = np.array([state.time, time])
    accel, gyro = state.accel_bias_body, state.gyro_bias_body
    bias = gtsam.imuBias.ConstantBias(accel, gyro)
    before = gtsam.NavState(state.pose, state.velocity_world)

    def steps(calibration: Calibration) -> Steps:
        stream = corrected_imu(calibration, blocks, imu)
        increments = cut_at_epochs(stream, time_offset, epochs, usual)
        if blind:
            increments = replace(increments, gap_bridged=np.ones_like(increments.gap_bridged))
        return Steps(thinned(increments, accel[None], gyro[None]), accel, gyro)

    def values(after: gtsam.NavState) -> gtsam.Values:
        both = before, after
        velocities = [at.velocity() for at in both]
        return values_from([at.pose() for at in both], velocities, [bias.vector()] * 2)

    own = steps(state.calibration)
    (link,) = links_between(
        lambda calibration: [
            (own if calibration is state.calibration else steps(calibration)).preintegrated(site)
        ],
        state.calibration,
        blocks,
        lambda result: values(result[0].predict(before, bias)),
    )
    after = link.measurement.predict(before, bias)
    transition, noise = _linearized(link, values(after), len(state.cov))
    if process_noise is not None:
        noise[MOTION:, MOTION:] = process_noise.cov(state.calibration, time, time - state.time)
    cov = _moved_cov(state.cov, transition[:MOTION]) + noise
    pose = after.pose()
    later = replace(
        state,
        time=time,
        world_from_body=pose.rotation().matrix(),
        position_world=np.asarray(pose.translation()),
        velocity_world=np.asarray(after.velocity()),
        cov=cov,
    )
    gap_bridged = bool(own.increments.gap_bridged[0])
    return Propagated(later, replace(link, steps=own), gap_bridged, transition, noise)


def _linearized(link: Link, values: gtsam.Values, size: int) -> tuple[Array, Array]:
    """Return transition and noise of a motion step, shape (size, size) each."""
    rows, _ = inertial_factor(0, link.measurement).linearize(values).jacobian()
    root = np.linalg.inv(rows[:, _AFTER])
    transition, noise = np.eye(size), np.zeros((size, size))
    transition[:MOTION, :MOTION] = -root @ rows[:, _BEFORE]
    if link.by_calibration is not None:
        transition[:MOTION, MOTION:] = -root @ link.by_calibration
    noise[:MOTION, :MOTION] = root @ root.T
    return transition, noise


def _moved_cov(cov: Array, motion: Array) -> Array:
    """Return a covariance after a motion step (15, size); the calibration is constant."""
    out, across = cov.copy(), motion @ cov
    out[:MOTION, :MOTION] = across @ motion.T
    out[:MOTION, MOTION:], out[MOTION:, :MOTION] = across[:, MOTION:], across[:, MOTION:].T
    return out
