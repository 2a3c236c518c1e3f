"""Phasors as the magnetometer's samples come: one window after the other."""

from collections import Counter, deque
from dataclasses import replace

import numpy as np

from magfusion.fusion.buffers import Buffer
from magfusion.fusion.state import State
from magfusion.fusion.wave import WaveFields, demodulate_about
from magfusion.receiver.lockin import window_operator
from magfusion.receiver.windows import LockinSettings, Windows
from magfusion.records.samples import ImuSamples, Waveform
from magfusion.trajectory import Trajectory
from magfusion.units import Array

LEAST_SHARE = 0.9  # of the samples that a window should hold
EDGE = 0.02  # s; of a window that the inertial stream may leave out
SATURATED_RUN = 3  # consecutive samples at the extreme of all that was seen


class OnlineReceiver:
    """Demodulates windows that follow each other by a fixed step.

    Parameters
    ----------
    settings : LockinSettings
    rate_hz : float
        Of the magnetometer.
    next_centre : float
        Of the first window (s).
    """

    def __init__(self, settings: LockinSettings, rate_hz: float, next_centre: float) -> None:
        self.settings, self.rate_hz = settings, rate_hz
        self.next_centre = next_centre
        self.dropped: Counter[str] = Counter()
        self._covs: deque[Array] = deque(maxlen=settings.noise_windows)
        self._extremes = np.array([[np.inf] * 3, [-np.inf] * 3])

    @property
    def next_end(self) -> float:
        """When the next window is complete (s): its last sample is half a step earlier."""
        return self.next_centre + self.settings.window / 2.0 - 0.6 / self.rate_hz

    def skip(self) -> None:
        """Go on to the next window."""
        self.next_centre += self.settings.step

    def usable(self, waveform: Buffer, imu_gap: bool) -> bool:
        """Tell whether the next window can be demodulated; count why it cannot."""
        time, rows = self._samples(waveform)
        expected = self.settings.window * self.rate_hz
        if len(time) < LEAST_SHARE * expected:
            self.dropped["too few samples"] += 1
            return False
        if np.max(np.diff(time)) > 1.5 / self.rate_hz:
            self.dropped["gap in the magnetometer stream"] += 1
            return False
        if imu_gap:
            self.dropped["gap in the inertial stream"] += 1
            return False
        if self._saturated(rows):
            self.dropped["magnetometer saturated"] += 1
            return False
        return True

    def demodulate(
        self, waveform: Buffer, imu: ImuSamples, before: State, predicted: State, offset: float
    ) -> WaveFields:
        """Return the phasors at the centre of the next window, about a prediction.

        Parameters
        ----------
        waveform : Buffer
        imu : ImuSamples
            Covering the window and the interval before it.
        before, predicted : State
            At the epoch before and at the centre.
        offset : float
            IMU time offset with which the states were propagated (s).
        """
        time, rows = self._samples(waveform)
        windows = Windows(
            centre=np.array([self.next_centre]),
            first=np.zeros(1, dtype=np.int64),
            count=np.array([len(time)]),
            dropped={},
        )
        calibration = replace(predicted.calibration, time_offset=offset)
        operator = window_operator(
            Waveform(time, rows),
            imu,
            calibration.site,
            self.settings,
            windows,
            gyro_bias_body=predicted.gyro_bias_body,
            time_offset=offset,
        )
        centre, path = _path([predicted]), _path([before, predicted])
        found = demodulate_about(operator, rows, centre, imu, calibration, path)
        # The mean over neighbouring windows, as far as they are known.
        self._covs.append(found.fields.phasor_cov)
        cov = np.mean(self._covs, axis=0)
        return replace(found, fields=replace(found.fields, phasor_cov=cov))

    def _samples(self, waveform: Buffer) -> tuple[Array, Array]:
        half = self.settings.window / 2.0
        time, rows = waveform.rows()
        lo, hi = np.searchsorted(time, [self.next_centre - half, self.next_centre + half])
        return time[lo:hi], rows[lo:hi]

    def _saturated(self, rows: Array) -> bool:
        low = np.minimum(self._extremes[0], rows.min(axis=0))
        high = np.maximum(self._extremes[1], rows.max(axis=0))
        self._extremes = np.stack([low, high])
        for extreme in (low, high):
            at = rows == extreme
            runs = at[:-2] & at[1:-1] & at[2:]
            if np.any(runs):
                return True
        return False


def _path(states: list[State]) -> Trajectory:
    return Trajectory(
        time=np.array([s.time for s in states]),
        world_from_body=np.array([s.world_from_body for s in states]),
        position_world=np.array([s.position_world for s in states]),
        velocity_world=np.array([s.velocity_world for s in states]),
        gyro_bias_body=np.array([s.gyro_bias_body for s in states]),
        accel_bias_body=np.array([s.accel_bias_body for s in states]),
    )


def inertial_gap(time: Array, begin: float, end: float) -> bool:
    """Tell whether inertial samples at these times leave a part of a window without any."""
    if len(time) < 2 or time[0] > begin + EDGE or time[-1] < end - EDGE:
        return True
    step = float(np.median(np.diff(time)))
    wide = np.diff(time) > 3.0 * step
    return bool(np.any(wide & (time[:-1] < end) & (time[1:] > begin)))
