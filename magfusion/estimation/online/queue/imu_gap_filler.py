"""IMU gap filler: inertial samples from the magnetic fields, while beacons are received."""

import numpy as np

from magfusion.estimation.data_checks.stream_buffer import Buffer
from magfusion.estimation.demodulation.motion_from_field import motion_from_field
from magfusion.estimation.graph.state import State
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.receiver.admission import Admission, longest_step, silences
from magfusion.units import Array

MAX_GAP = 2.0  # s; that is filled from a known state
REACH = 0.5  # s; of inertial samples about a stretch, to detect a gap


class ImuGapFiller:
    """Motion measured by the magnetometer in the gaps of the inertial stream.

    `time` (n,): on the IMU's clock (s). `rows` (n, 6): rates and specific forces of the body
    (rad/s, m/s^2).
    """

    time: Array
    rows: Array

    def __init__(self) -> None:
        self.time, self.rows = np.zeros(0), np.zeros((0, 6))

    def fill(
        self,
        state: State,
        until: float,
        imu: Buffer,
        waveform: Buffer,
        offset: float,
        admission: Admission,
    ) -> None:
        """Estimate the motion from a state on, where the inertial stream has a gap.

        `state`: the last known one. `until` (s). `offset`: added to the IMU's stamps (s).
        """
        stamps, detected = imu.between(state.time - offset - REACH, until - offset + REACH)
        begin, end = silences(stamps + offset, admission.imu_step, admission.imu_margin)
        # After the newest sample the stream is silent.
        begin[-1] -= admission.imu_margin
        meets = (begin < until - admission.imu_margin) & (end > state.time)
        if not np.any(meets) or state.calibration.site.platform.magnetometer.lacking:
            return
        time, rows = waveform.rows()
        within = (time > state.time) & (time < until)
        kept = self.time <= state.time - offset
        self.time, self.rows = self.time[kept], self.rows[kept]
        if until - state.time > MAX_GAP:
            return
        inertial = ImuSamples(stamps + offset, detected[:, :3], detected[:, 3:])
        part, step = Waveform(time[within], rows[within]), admission.imu_step
        followed = motion_from_field(state, part, inertial, longest_step(step))
        if followed is None:
            return
        result = followed.imu
        silent = np.zeros(len(result), dtype=bool)
        for first, last in zip(begin[meets], end[meets], strict=True):
            silent |= (result.time > first + 0.5 * step) & (result.time < last - 0.5 * step)
        own = np.hstack([result.gyro_body, result.accel_body])[silent]
        self.time = np.append(self.time, result.time[silent] - offset)
        self.rows = np.vstack([self.rows, own])
        if silent[-1]:  # the last interval extends to the end
            self.time = np.append(self.time, until - offset)
            self.rows = np.vstack([self.rows, own[-1:]])

    def among(self, imu: ImuSamples, begin: float, end: float) -> ImuSamples:
        """Return inertial samples with the substitutes between two stamps."""
        if not self.covers(begin, end):
            return imu
        inside = (self.time >= begin) & (self.time <= end)
        time, first = np.unique(np.append(imu.time, self.time[inside]), return_index=True)
        gyro = np.vstack([imu.gyro_body, self.rows[inside, :3]])[first]
        accel = np.vstack([imu.accel_body, self.rows[inside, 3:]])[first]
        return ImuSamples(time, gyro, accel)

    def covers(self, begin: float, end: float) -> bool:
        """Return whether there are substitutes between two stamps."""
        return len(self.time) > 0 and bool(np.any((self.time > begin) & (self.time < end)))

    def discard_before(self, before: float) -> None:
        """Drop older ones."""
        if not len(self.time):
            return
        kept = self.time >= before
        self.time, self.rows = self.time[kept], self.rows[kept]
