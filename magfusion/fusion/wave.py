"""What the lock-in makes of motion inside its window, predicted and taken off."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.fusion.inertial import low_passed, motion_at
from magfusion.observation import observe_earth
from magfusion.parameters import Calibration, predict_channels
from magfusion.receiver.lockin import WindowOperator, demodulate_with_steady
from magfusion.records.samples import FieldSamples, ImuSamples, SteadyFields
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
    earth = observe_earth(site.platform.magnetometer, motion.world_from_body, earth_field_world)
    return np.asarray(beacons + earth.measured_sensor)


@dataclass(frozen=True, eq=False)
class WaveFields:
    """Phasors at the centres of the windows, freed of what motion inside the window does.

    Parameters
    ----------
    fields : FieldSamples
    by_time_offset : complex ndarray, shape (n, channels, 3)
        Derivative of what was taken off by the IMU's time offset, the states held (T/s).
    steady : SteadyFields
        The Earth field and the offset.
    """

    fields: FieldSamples
    by_time_offset: ComplexArray
    steady: SteadyFields


def demodulate_about(
    operator: WindowOperator,
    measured_sensor: Array,
    states: Trajectory,
    imu: ImuSamples,
    calibration: Calibration,
    path: Trajectory | None = None,
) -> WaveFields:
    """Demodulate what a prediction of the waveform leaves, and add the phasors at the centres.

    The raw samples of each window are predicted from the state and from the IMU's motion inside
    the window; only what they differ by from the measured ones passes through the lock-in.

    Parameters
    ----------
    operator : WindowOperator
    measured_sensor : ndarray, shape (samples, 3)
        (T)
    states : Trajectory
        At the centres of the windows.
    imu : ImuSamples
    calibration : Calibration
    path : Trajectory, optional
        States between which the motion is interpolated, where they are not those of the windows.

    Returns
    -------
    WaveFields
    """
    site, known = calibration.site, states if path is None else path
    earth = np.zeros(3) if site.earth_field_world is None else site.earth_field_world

    def predicted(stream: ImuSamples, time_offset: float) -> Array:
        motion = motion_at(known, stream, time_offset, site.gravity, operator.time)
        return predicted_waveform(motion, calibration, earth)

    offset, slow = calibration.time_offset, low_passed(imu)
    rest, left = demodulate_with_steady(operator, measured_sensor - predicted(imu, offset))
    change = predicted(slow, offset + OFFSET_STEP) - predicted(slow, offset - OFFSET_STEP)
    at_centre = predict_channels(
        calibration, states.time, states.world_from_body, states.position_world
    )
    steady = observe_earth(site.platform.magnetometer, states.world_from_body, earth)
    return WaveFields(
        fields=replace(rest, phasor_sensor=rest.phasor_sensor + at_centre),
        by_time_offset=operator.apply(change / (2.0 * OFFSET_STEP)),
        steady=replace(left, measured_sensor=left.measured_sensor + steady.measured_sensor),
    )
