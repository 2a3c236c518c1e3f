"""Prediction and removal of the effect of motion inside a lock-in window."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.linalg import norm

from magfusion.errors import InputError
from magfusion.estimation.data_checks.detection import only
from magfusion.estimation.demodulation.active_beacons import ActiveBeacons
from magfusion.estimation.demodulation.motion_shape import MotionShape
from magfusion.estimation.demodulation.motion_stretches import joined, only_stretch, stretches
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.model.detection_range import Owned, only_owned, owned_at
from magfusion.model.field import predict_earth
from magfusion.model.noise import calibration_error, model_error, sensor_positions
from magfusion.model.parameters import Calibration, linearize_channels, predict_channels
from magfusion.model.quaternion import unit
from magfusion.model.samples import FieldSamples, ImuSamples, StaticFields, Waveform
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.waveform import MotionChange, carriers, predicted_waveform
from magfusion.receiver.cells import owned_by
from magfusion.receiver.lockin import WindowOperator
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.turn import BodyTurn, on_clock
from magfusion.units import Array, BoolArray, ComplexArray

# Error within a window of a motion estimated without an IMU, one sigma.
MISSED_SPIN, MISSED_PUSH = 1.5, 3.0  # rad/s^2, m/s^2


@dataclass(frozen=True, eq=False)
class MotionCompensated:
    """Phasors at the centres of the windows, without the effect of motion inside the window."""

    fields: FieldSamples
    # (n, channels, 3), derivative of the removed effect by the IMU's time offset at fixed states
    # (T/s)
    by_time_offset: ComplexArray
    static: StaticFields  # the Earth field and the offset
    unseen: bool = False  # whether the motion was unknown, and nothing was removed
    # (samples, 3), samples minus their prediction (T), where requested with ``wanted``
    unexplained_sensor: Array | None = None
    wanted: Trajectory | None = None  # motion at other times

    @staticmethod
    def of_slots(fields: FieldSamples) -> "MotionCompensated":
        """Return phasors of slots: too short for motion, and without a static field."""
        none = np.full((len(fields), 3), np.nan)
        static = StaticFields(fields.time, none, np.full((*none.shape, 3), np.nan))
        return MotionCompensated(fields, np.zeros_like(fields.phasor_sensor), static)


class TakenOff(NamedTuple):
    """Residuals of samples after a prediction."""

    # unexplained_sensor, change_sensor: (samples, 3), residual (T), and the prediction's derivative
    # by the IMU's time offset (T/s)
    unexplained_sensor: Array
    change_sensor: Array
    active_beacons: ActiveBeacons
    earth_world: Array
    wanted: Trajectory | None  # motion at the other requested times


class KnownMotion(NamedTuple):
    """Motion along the samples of one window, and its rotation at them (4, samples).

    As of `MotionShape.turned_at`.
    """

    shape: MotionShape
    rotation: Array


def taken_off(
    samples: Waveform,
    path: Trajectory,
    imu: ImuSamples,
    calibration: Calibration,
    time_offset: float,
    window: float,
    wanted: Array | None = None,
    known: KnownMotion | None = None,
) -> TakenOff:
    """Return the residuals of samples after a prediction along a motion.

    Parameters
    ----------
    path : Trajectory
        States between which the motion is interpolated by the IMU.
    time_offset : float
        Of the IMU (s).
    window : float
        Window length (s) that sets which beacons are predicted.
    wanted : ndarray, shape (m,), optional
        Other requested times of the motion (s).
    known : KnownMotion, optional
        The motion, if known.
    """
    site, measured_sensor = calibration.site, samples.measured_sensor
    earth = np.zeros(3) if site.earth_field_world is None else site.earth_field_world
    unexplained, change = np.empty_like(measured_sensor), np.empty_like(measured_sensor)
    active_beacons, others = ActiveBeacons.of(calibration, window), []
    along = (
        stretches(samples.time, path, imu, time_offset, site.gravity)
        if known is None
        else only_stretch(samples.time, known.shape)
    )
    for stretch in along:
        shape = stretch.shape
        for rows in stretch.pieces(active_beacons.at_once):
            time = samples.time[rows]
            rotated = None if known is None else known.rotation[:, rows]
            motion, change_of = shape.changing_at(time, rotated)
            detected = active_beacons.along(motion)
            predicted, change[rows] = predicted_waveform(
                motion,
                detected,
                earth,
                carriers(detected.site.tone_frequencies_hz, time),
                MotionChange(*change_of),
                through_nodes=True,
            )
            unexplained[rows] = measured_sensor[rows] - predicted
        if wanted is not None:
            others.append(stretch.at_others(wanted))
    return TakenOff(unexplained, change, active_beacons, earth, joined(others) if others else None)


def demodulate_about(
    operator: WindowOperator,
    measured_sensor: Array,
    states: Trajectory,
    imu: ImuSamples,
    calibration: Calibration,
    path: Trajectory | None = None,
    *,
    wanted: Array | None = None,
    motion: KnownMotion | None = None,
) -> MotionCompensated:
    """Demodulate the residuals of a waveform prediction, and add the phasors at the centres.

    The raw samples of each window are predicted from the state and the IMU's motion inside the
    window; only the difference to the measured samples passes through the lock-in.

    Parameters
    ----------
    measured_sensor : ndarray, shape (samples, 3)
        (T)
    states : Trajectory
        At the centres of the windows.
    path : Trajectory, optional
        States between which the motion is interpolated, where these are not those of the windows.
    wanted : ndarray, shape (m,), optional
        Other times of the motion (s); with them the residuals are returned too.
    motion : KnownMotion, optional
        Along the samples, if known.
    """
    # The field of steel varies within a window by some ten-thousandths of that of the beacons.
    calibration = replace(calibration, site=calibration.site.without_steel())
    site, known = calibration.site, states if path is None else path
    samples = Waveform(operator.designs.time, measured_sensor)
    window = operator.designs.settings.window
    offset = calibration.time_offset
    off = taken_off(samples, known, imu, calibration, offset, window, wanted, motion)
    earth, active_beacons, unexplained = off.earth_world, off.active_beacons, off.unexplained_sensor
    rest, remaining, by_time_offset = operator.demodulate_both(unexplained, off.change_sensor)
    at_centre = predict_channels(
        calibration, states.time, states.world_from_body, states.position_world
    )
    static = predict_earth(site.platform.magnetometer, states.world_from_body, earth)
    fields = replace(rest, phasor_sensor=rest.phasor_sensor + at_centre)
    return MotionCompensated(
        fields=fields
        if operator.tone_of_channel is None
        else _of_strongest(fields, active_beacons, states),
        by_time_offset=by_time_offset,
        static=replace(remaining, measured_sensor=remaining.measured_sensor + static),
        unexplained_sensor=None if wanted is None else unexplained,
        wanted=off.wanted,
    )


def _of_strongest(
    fields: FieldSamples, active_beacons: ActiveBeacons, states: Trajectory
) -> FieldSamples:
    """Return phasors of the strongest on each frequency, minus the prediction of the others."""
    site = active_beacons.calibration.site
    places = sensor_positions(site, states)
    place = places[:, 0]  # samples are of a single magnetometer
    unknown = np.ones((len(place), len(site.channels)))
    affected = active_beacons.along(states)
    far = np.stack([norm(place - b.position_world, axis=1) for b in affected.site.beacons], axis=1)
    names = {beacon.name for beacon in affected.site.beacons}
    own = np.array([name in names for name, _ in site.channels])
    missed = calibration_error(affected.site, far)[:, affected.site.owner]
    unknown[:, own] = np.hypot(missed, model_error(affected.site, places))
    owned, count = owned_at(site, place, unknown=unknown), len(fields.channels)
    return only_owned(fields, Owned(owned.channels[:, :count], owned.others[:, :count]))


def _without_motion(
    operator: WindowOperator, measured_sensor: Array, offset: Array
) -> MotionCompensated:
    """Demodulate windows of unknown motion."""
    fields, static = operator.demodulate(measured_sensor - offset)
    static = replace(static, measured_sensor=static.measured_sensor + offset)
    return MotionCompensated(fields, np.zeros_like(fields.phasor_sensor), static, unseen=True)


def _by_strength(operator: WindowOperator, measured_sensor: Array, site: Site) -> MotionCompensated:
    """Demodulate windows of beacons that share frequencies, independent of the position."""
    result = _without_motion(operator, measured_sensor, site.platform.magnetometer.offset)
    try:
        fields = owned_by(result.fields, site)
    except InputError:
        fields = only(result.fields, np.zeros(result.fields.valid.shape, dtype=bool))
    return replace(result, fields=fields, unseen=False)


def demodulate_predicted(
    receiver: LockinReceiver,
    number: int,
    waveform: Waveform,
    imu: ImuSamples,
    before: State,
    predicted: State,
    offset: float,
    *,
    blind: bool = False,
    is_lost: bool = False,
) -> MotionCompensated:
    """Demodulate one window about a predicted state.

    Parameters
    ----------
    number : int
        Of the window.
    waveform, imu : Waveform, ImuSamples
        Covering the window and, of the IMU, the interval before it.
    before, predicted : State
        At the epoch before and at the centre.
    offset : float
        IMU time offset with which the states were propagated (s).
    blind : bool
        Whether other samples replace inertial ones.
    is_lost : bool
        Whether the predicted position is unknown, so that it does not assign phasors to beacons.
    """
    assert receiver.grid is not None
    window = receiver.grid.windows(np.array([number]), waveform.time)
    inside = slice(int(window.first[0]), int(window.first[0] + window.count[0]))
    samples = waveform.rows(inside)
    alone = replace(window, first=np.zeros(1, dtype=np.int64))
    calibration = replace(predicted.calibration, time_offset=offset)
    known = on_clock(imu, offset, predicted.gyro_bias_body)
    site = calibration.site
    centre, path = as_trajectory([predicted]), as_trajectory([before, predicted])
    assert receiver.admission is not None
    shape = MotionShape.of(path, imu, offset, site.gravity, usual=receiver.admission.imu_step)
    rotated = shape.turned_at(np.concatenate([samples.time, window.centre]))
    whole, rotated = unit(rotated), rotated[:, :-1]
    turn = BodyTurn(whole[:, :-1], whole[:, -1:])
    operator = receiver.operator_of_one(samples, known, alone, site, turn)
    if operator.unseen[0]:
        return _without_motion(operator, samples.measured_sensor, site.platform.magnetometer.offset)
    if is_lost and operator.tone_of_channel is not None:
        return _by_strength(operator, samples.measured_sensor, receiver.site)
    motion = KnownMotion(shape, rotated)
    result = demodulate_about(
        operator, samples.measured_sensor, centre, imu, calibration, path, motion=motion
    )
    length = receiver.settings.window
    if not blind:
        return result
    fields = noisier(result.fields, np.ones(1, dtype=bool), centre, calibration, length)
    return replace(result, fields=fields)


def noisier(
    samples: FieldSamples,
    blind: BoolArray,
    states: Trajectory,
    calibration: Calibration,
    window: float,
) -> FieldSamples:
    """Return phasors with the noise by an error of the motion's shape.

    It is common to all channels: assuming them independent must not average it out. `blind` (n,):
    windows whose motion was estimated without an IMU. `states`: at their centres. `window`: length
    of the windows (s).
    """
    rows = np.flatnonzero(blind)
    pose = states.world_from_body[rows], states.position_world[rows]
    _, by_pose, _ = linearize_channels(calibration, (), states.time[rows], *pose)
    # The mean over the window of half the square of time.
    shape = window**2 / 24.0 * np.repeat([MISSED_SPIN, MISSED_PUSH], 3)
    channels = len(samples.channels)
    by = (by_pose * shape).reshape(len(rows), channels, 2, 3, 6)
    cov = samples.phasor_cov.copy()
    missed = 0.5 * channels * np.einsum("nckxi,nckyi->ncxy", by, by)
    # The estimated noise factor of a beacon does not apply to this.
    site = calibration.site
    factor = np.array([beacon.noise_factor for beacon in site.beacons])[site.owner]
    cov[rows] += missed / factor[:, None, None] ** 2
    return replace(samples, phasor_cov=cov)
