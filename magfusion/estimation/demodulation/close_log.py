"""A log of close tones: short windows determine the motion, long ones resolve the beacons.

Samples count once.  The long windows, which resolve the tones, have next to no weight in the
estimate, but all tests of single beacons use them.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.detection import (
    DETECTION_CHI_SQUARE_ONLINE,
    STRONG_CHI_SQUARE,
    above_noise,
)
from magfusion.estimation.data_checks.disturbing_lines import with_disturbing_lines
from magfusion.estimation.demodulation.close_tones import joint_phasors
from magfusion.estimation.graph.preintegration import low_passed_rate_at
from magfusion.estimation.measurements.joint_phasors import JointPhasors, at_nearest
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.noise import whitening
from magfusion.model.parameters import Calibration, initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.receiver.admission import Windows
from magfusion.receiver.joint import JointReceiver, joint_settings
from magfusion.receiver.turn import on_clock
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray

IGNORED_VARIANCE_FACTOR = 1e6  # times the variance: a window that is tested, but not used


class CloseLog(NamedTuple):
    """The short windows of a log."""

    receiver: JointReceiver
    windows: Windows
    time: Array  # (samples,), of its waveform (s)

    @staticmethod
    def of(log: Log, site: Site, requested: LockinSettings | None) -> "CloseLog | None":
        """Return the short windows of a log of close tones; None of any other."""
        settings = None if log.waveform is None else joint_settings(site, requested)
        if settings is None or log.waveform is None:
            return None
        receiver = JointReceiver(site, settings)
        receiver.fit_extra_lines(with_disturbing_lines(log, site, requested))
        imu = initial_calibration(site, 0.0, float(log.imu.time[0])).on_log_rate(log.imu)
        windows = receiver.admitted(log.waveform, imu)
        return CloseLog(receiver, windows, log.waveform.time) if len(windows) else None

    @property
    def nodes(self) -> Array:
        """Sample times of the motion in all windows, concatenated (s)."""
        return np.asarray((self.windows.centre[:, None] + self.receiver.nodes).ravel())

    def measured(
        self,
        unexplained_sensor: Array,
        nodes: Trajectory,
        states: Trajectory,
        calibration: Calibration,
        imu: ImuSamples,
        standing: BoolArray | None,
    ) -> JointPhasors:
        """Return the measurement by the short windows.

        Parameters
        ----------
        unexplained_sensor : ndarray, shape (samples, 3)
            Samples minus their prediction along the states (T).
        nodes : Trajectory
            The motion at `nodes`.
        states : Trajectory
            At all epochs, which include the centres of the windows.
        imu : ImuSamples
            As corrected by the calibration.
        standing : bool ndarray, shape (states,), optional
        """
        assert states.gyro_bias_body is not None
        centre = self.windows.centre
        epoch = np.searchsorted(states.time, centre)
        here, offset = states.rows(epoch), calibration.time_offset
        assert here.gyro_bias_body is not None
        rate_body = low_passed_rate_at(imu, offset, centre) - here.gyro_bias_body
        bias = interpolated(imu.time + offset, states.time, states.gyro_bias_body)
        result, _ = joint_phasors(
            self.receiver.designs,
            self.windows,
            self.time,
            unexplained_sensor,
            here,
            nodes,
            calibration,
            on_clock(imu, offset, bias),
            epoch,
            rate_body,
            calibration.imu_offset(centre),
            standing=None if standing is None else standing[epoch],
        )
        return result


def looked_at(phasors: FieldPhasors, joint: JointPhasors, window: float) -> FieldPhasors:
    """Return phasors with next to no weight where short windows are used instead.

    `window`: length of the phasors' windows (s), the longest gap of the short ones.
    """
    before = np.ones(phasors.measured.shape[:2]) if phasors.excess is None else phasors.excess
    middle = 0.5 * (joint.time[1:] + joint.time[:-1])
    separate = np.abs(joint.time[np.searchsorted(middle, phasors.time)] - phasors.time)
    less = np.where(separate < 0.25 * window, IGNORED_VARIANCE_FACTOR, 1.0)[:, None]
    root = phasors.sqrt_information / np.sqrt(less)[..., None, None]
    return replace(phasors, sqrt_information=root, excess=less * before)


def without_silent(
    joint: JointPhasors, samples: FieldSamples, states: Trajectory, calibration: Calibration
) -> JointPhasors:
    """Return short windows without beacons that long ones nearby should detect, but do not.

    `samples`, `states`: of the long windows.
    """
    every = np.ones((*samples.valid.shape, 3), dtype=bool)
    expected = predict_channels(
        calibration, states.time, states.world_from_body, states.position_world
    )
    root = whitening(samples.phasor_cov, every)
    power = np.sum(np.abs((root @ expected[..., None])[..., 0]) ** 2, axis=-1)
    silent = ~above_noise(samples, DETECTION_CHI_SQUARE_ONLINE)
    silent &= power > STRONG_CHI_SQUARE * DETECTION_CHI_SQUARE_ONLINE
    if not np.any(silent):
        return joint
    return joint.leaving_out(at_nearest(samples.time, silent, joint.time))
