"""Shift of states after a change of the estimated IMU clock."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.batch.log_graph import PreprocessedLog
from magfusion.estimation.graph.preintegration import low_passed_rate_at
from magfusion.model.parameters import Calibration, corrected_imu
from magfusion.model.quaternion import matrices, of_vectors
from magfusion.model.trajectory import Trajectory
from magfusion.units import BoolArray


def on_new_clock(
    log: PreprocessedLog,
    states: Trajectory,
    old: Calibration,
    new: Calibration,
    standing: BoolArray,
) -> Trajectory:
    """Return the states at the log's epochs after a change of the IMU clock.

    The inertial stream was cut by the old clock: a pass determines the platform's motion at an
    epoch by the state and the lag between both clocks.  The next pass cuts by the new clock and
    starts from these states.  Without the lag it would use a motion delayed by the estimated clock
    offset. `states`: with velocity and bias, by the old clock. `standing` (states,): where the
    platform is known to be at rest, so that no clock moves it.
    """
    lag = np.where(standing, 0.0, new.imu_offset(states.time) - old.imu_offset(states.time))
    velocity, bias = states.velocity_world, states.gyro_bias_body
    if not np.any(lag) or velocity is None or bias is None:
        return states
    imu = old.on_log_rate(corrected_imu(old, log.blocks, log.imu))
    rate = low_passed_rate_at(imu, old.time_offset, states.time) - bias
    later = -lag[:, None]
    gained = np.zeros_like(velocity)
    if len(states) > 1:
        gained = np.gradient(velocity, states.time, axis=0)
    return replace(
        states,
        world_from_body=states.world_from_body @ matrices(of_vectors((later * rate).T)),
        position_world=states.position_world + later * velocity,
        velocity_world=velocity + later * gained,
    )
