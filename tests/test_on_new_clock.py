"""States follow the IMU's clock: the motion itself, a little earlier or later."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from small_problem import small_log

from magfusion.estimation.batch.on_new_clock import on_new_clock
from magfusion.estimation.batch.preprocessed_log import preprocess
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.model.progress import quiet
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

TURN, BIAS = np.array([0.4, -0.7, 1.1]), np.array([0.01, 0.0, -0.02])  # rad/s


def _at(time: Array, labels: Array) -> Trajectory:
    """Return a steady turn along a parabola."""
    along, bend = np.array([0.5, -0.2, 0.1]), np.array([0.3, 0.2, -0.4])
    return Trajectory(
        time=labels,
        world_from_body=Rotation.from_rotvec(time[:, None] * TURN).as_matrix(),
        position_world=time[:, None] * along + 0.5 * time[:, None] ** 2 * bend,
        velocity_world=along + time[:, None] * bend,
        gyro_bias_body=np.tile(BIAS, (len(time), 1)),
        accel_bias_body=np.zeros((len(time), 3)),
    )


def test_states_are_the_motion_by_the_new_clock() -> None:
    small = small_log(3, epochs=12)
    log = preprocess(small.log, small.site, SmootherSettings(), quiet)
    imu = replace(log.imu, gyro_body=np.tile(TURN + BIAS, (len(log.imu), 1)))
    demodulation = replace(log.demodulation, log=replace(log.demodulation.log, imu=imu))
    log = replace(log, demodulation=demodulation)
    time, old = log.states.time, log.declared
    new = replace(old, time_offset=old.time_offset + 8e-4, clock_rate=3e-5)
    lag = new.imu_offset(time) - old.imu_offset(time)
    standing = np.arange(len(time)) == 4
    lag[standing] = 0.0
    states, expected = _at(time, time), _at(time - lag, time)
    result = on_new_clock(log, states, old, new, standing)
    np.testing.assert_allclose(result.world_from_body, expected.world_from_body, atol=1e-12)
    inner = slice(1, -1)
    position = result.position_world[inner] - expected.position_world[inner]
    assert np.max(np.abs(position)) < np.max(lag**2)  # of second order
    velocity = result.velocity_world, expected.velocity_world
    assert velocity[0] is not None
    assert velocity[1] is not None
    np.testing.assert_allclose(velocity[0], velocity[1], atol=1e-12)
    assert on_new_clock(log, states, old, old, standing) is states
