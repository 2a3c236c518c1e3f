"""From one field epoch to the next by the inertial stream: mean, transition and noise."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.fusion.inertial import cut_at_epochs, preintegrate
from magfusion.fusion.state import MOTION, State, pose_of
from magfusion.fusion.walk import Walk
from magfusion.parameters import Block, choose_blocks, dimension, held_blocks
from magfusion.records.samples import ImuSamples
from magfusion.site import Site
from magfusion.units import Array

# Columns of GTSAM's factor, by key: x0 v0 x1 v1 b0 b1.
_BEFORE = np.r_[0:6, 6:9, 18:24]
_AFTER = np.r_[9:15, 15:18, 24:30]


@dataclass(frozen=True, eq=False)
class Propagated:
    """Where the inertial stream leads.

    Parameters
    ----------
    state : State
        At the later time, its covariance carried on.
    measurement : gtsam.PreintegratedCombinedMeasurementsG
    bridged : bool
        Whether the stream had a gap.
    """

    state: State
    measurement: gtsam.PreintegratedCombinedMeasurementsG
    bridged: bool


def propagate(
    state: State,
    imu: ImuSamples,
    time: float,
    site: Site,
    time_offset: float,
    walk: Walk | None = None,
    usual: float | None = None,
) -> Propagated:
    """Carry a state on to a later time.

    Transition and noise are those of the graph's own inertial factor, so that a filter built on
    this and the graph agree to round-off.

    Parameters
    ----------
    state : State
    imu : ImuSamples
        Covering the interval; where it does not, its end values are held.
    time : float
        (s)
    site : Site
        Its IMU's noise and its gravity.
    time_offset : float
        Added to the IMU's stamps (s).
    walk : Walk, optional
        Of the calibration.
    usual : float, optional
        Sampling interval of the IMU (s), as in `cut_at_epochs`.

    Returns
    -------
    Propagated
    """
    epochs = np.array([state.time, time])
    increments = cut_at_epochs(imu, time_offset, epochs, usual)
    accel, gyro = state.accel_bias_body, state.gyro_bias_body
    measurement = preintegrate(
        increments, site.platform.imu, site.gravity, accel[None], gyro[None]
    )[0]
    bias = gtsam.imuBias.ConstantBias(accel, gyro)
    before = gtsam.NavState(pose_of(state), state.velocity_world)
    after = measurement.predict(before, bias)
    later = replace(
        state,
        time=time,
        world_from_body=after.pose().rotation().matrix(),
        position_world=np.asarray(after.pose().translation()),
        velocity_world=np.asarray(after.velocity()),
    )
    transition, noise = _linear(measurement, state, later)
    cov = state.cov.copy()
    cov[:MOTION] = transition @ cov[:MOTION]
    cov[:, :MOTION] = cov[:, :MOTION] @ transition.T
    cov[:MOTION, :MOTION] += noise
    if walk is not None:
        cov[MOTION:, MOTION:] += walk.cov(state.calibration, time, time - state.time)
    return Propagated(replace(later, cov=cov), measurement, bool(increments.bridged[0]))


def _linear(
    measurement: gtsam.PreintegratedCombinedMeasurementsG, before: State, after: State
) -> tuple[Array, Array]:
    """Return transition and noise of the motion's part of the tangent, (15, 15) each."""
    factor = gtsam.GalileanCombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measurement)
    values = gtsam.Values()
    for i, state in enumerate((before, after)):
        values.insert(X(i), pose_of(state))
        values.insert(V(i), state.velocity_world)
        values.insert(B(i), gtsam.imuBias.ConstantBias(state.accel_bias_body, state.gyro_bias_body))
    rows, _ = factor.linearize(values).jacobian()
    root = np.linalg.inv(rows[:, _AFTER])
    return np.asarray(-root @ rows[:, _BEFORE]), np.asarray(root @ root.T)


def online_blocks(
    site: Site, estimate: tuple[str, ...] | None, *, earth: bool
) -> tuple[tuple[Block, ...], int]:
    """Return the calibration in an online estimator's tangent, and how much of it is held.

    What is estimated comes first, then what is only considered.
    """
    estimated = choose_blocks(site, estimate, earth=earth)
    held = held_blocks(site, estimated, earth=earth)
    behind = dimension(estimated)
    moved = tuple(
        b._replace(columns=slice(b.columns.start + behind, b.columns.stop + behind)) for b in held
    )
    return (*estimated, *moved), dimension(held)
