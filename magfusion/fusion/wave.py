"""What the lock-in makes of motion inside its window, predicted and taken off."""

from dataclasses import dataclass

import numpy as np

from magfusion.fusion.inertial import motion_at
from magfusion.parameters import Calibration, predict_channels
from magfusion.receiver.lockin import WindowOperator
from magfusion.records.samples import ImuSamples
from magfusion.trajectory import Trajectory
from magfusion.units import Array, ComplexArray

OFFSET_STEP = 5e-4  # s; of the difference quotient


def predicted_waveform(
    motion: Trajectory, calibration: Calibration, earth_field_world: Array
) -> Array:
    """Return the samples that a magnetometer takes along a motion.

    Parameters
    ----------
    motion : Trajectory
        At the sample times.
    calibration : Calibration
    earth_field_world : ndarray, shape (3,)
        (T)

    Returns
    -------
    ndarray, shape (n, 3)
        (T), measured axes, without noise.
    """
    site = calibration.site
    phasor = predict_channels(
        calibration, motion.time, motion.world_from_body, motion.position_world
    )
    frequencies = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    carrier = np.exp(2j * np.pi * frequencies * motion.time[:, None])
    beacons = np.einsum("ncx,nc->nx", phasor, carrier).real
    sensor = site.platform.magnetometer
    measured_from_body = sensor.matrix @ sensor.body_from_sensor.T
    earth_body = np.einsum("nji,j->ni", motion.world_from_body, earth_field_world)
    return np.asarray(beacons + earth_body @ measured_from_body.T + sensor.offset)


@dataclass(frozen=True, eq=False)
class LockinError:
    """By how much the lock-in's phasors differ from those at the centre of the window.

    Parameters
    ----------
    phasor_sensor : complex ndarray, shape (n, channels, 3)
        (T), to be subtracted from measured phasors.
    by_time_offset : complex ndarray, shape (n, channels, 3)
        Its derivative by the IMU's time offset, the states held (T/s).
    """

    phasor_sensor: ComplexArray
    by_time_offset: ComplexArray


def lockin_error(
    operator: WindowOperator, states: Trajectory, imu: ImuSamples, calibration: Calibration
) -> LockinError:
    """Predict what the lock-in makes of the motion inside its windows.

    The raw samples of each window are predicted from the state and from the IMU's motion inside
    the window, and pass through the same lock-in as the measured ones.

    Parameters
    ----------
    operator : WindowOperator
    states : Trajectory
        At the centres of the windows.
    imu : ImuSamples
    calibration : Calibration

    Returns
    -------
    LockinError
    """
    site = calibration.site
    earth = np.zeros(3) if site.earth_field_world is None else site.earth_field_world

    def seen(time_offset: float) -> ComplexArray:
        motion = motion_at(states, imu, time_offset, site.gravity, operator.time)
        return operator.apply(predicted_waveform(motion, calibration, earth))

    now = seen(calibration.time_offset)
    later = seen(calibration.time_offset + OFFSET_STEP)
    at_centre = predict_channels(
        calibration, states.time, states.world_from_body, states.position_world
    )
    return LockinError(now - at_centre, (later - now) / OFFSET_STEP)
