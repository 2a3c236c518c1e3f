"""Short windows of close tones online: each advances an estimate by its own length."""

from collections import deque

import numpy as np

from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE_ONLINE
from magfusion.estimation.demodulation.close_tones import joint_phasors
from magfusion.estimation.demodulation.motion_compensation import taken_off
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.model_error import epochs_sharing_error_at
from magfusion.estimation.online.queue.epoch_measurements import EpochMeasurements
from magfusion.model.parameters import predict_channels
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.joint import JointReceiver, joint_settings
from magfusion.receiver.turn import on_clock
from magfusion.receiver.windows import MAX_WINDOW, LockinSettings
from magfusion.units import Array


class ShortWindows:
    """The admitted short windows, and the noise of earlier ones.

    `receiver`: it begins with the first state. `numbers`: of windows that are not used yet.
    `window`: at the state that is to be predicted.
    """

    receiver: JointReceiver
    numbers: deque[int]
    window: int | None
    _noise: list[Array]

    def __init__(self, receiver: JointReceiver) -> None:
        self.receiver, self.numbers = receiver, deque()
        self.window, self._noise = None, []

    @staticmethod
    def of(site: Site, requested: LockinSettings | None) -> "ShortWindows | None":
        """Return those of a site whose tones are close; None for any other."""
        settings = joint_settings(site, requested)
        return None if settings is None else ShortWindows(JointReceiver(site, settings))

    def receive(self, waveform: Waveform, imu: ImuSamples, until: float, after: float) -> None:
        """Check the windows that are complete at a time (s), and keep those after another (s)."""
        if self.receiver.complete(until):
            windows = self.receiver.admit(waveform, imu, until)
            later = windows.centre > after + 0.25 * self.receiver.settings.step
            self.numbers.extend(windows.number[later].tolist())

    def next_after(self, time: float) -> float | None:
        """Advance to the next window after a time (s), and return its centre."""
        self.window = None
        while self.numbers:
            number = self.numbers.popleft()
            if self.receiver.centre_of(number) > time:
                self.window = number
                return self.receiver.centre_of(number)
        return None

    @property
    def length(self) -> float:
        """Of a window (s)."""
        return self.receiver.settings.window

    def at(self, time: float) -> bool:
        """Return whether the current window is at a time (s)."""
        return self.window is not None and self.receiver.centre_of(self.window) == time

    def measured(
        self,
        before: State,
        predicted: State,
        waveform: Waveform,
        imu: ImuSamples,
        offset: float,
        rate_body: Array,
        *,
        standing: bool,
    ) -> EpochMeasurements:
        """Return the measurement of the current window at a prediction.

        Parameters
        ----------
        before, predicted : State
            At the epoch before and at the centre.
        waveform, imu : Waveform, ImuSamples
            Covering the window and, of the IMU, the interval before it.
        offset : float
            IMU time offset with which the states were propagated (s).
        rate_body : ndarray, shape (3,)
            Without the gyro's bias (rad/s).
        """
        receiver = self.receiver
        assert receiver.grid is not None
        assert self.window is not None
        windows = receiver.grid.windows(np.array([self.window]), waveform.time)
        first, count = int(windows.first[0]), int(windows.count[0])
        samples = waveform.rows(slice(first, first + count))
        windows.first[:] = 0
        calibration = predicted.calibration
        centre, path = as_trajectory([predicted]), as_trajectory([before, predicted])
        wanted = predicted.time + receiver.nodes
        off = taken_off(samples, path, imu, calibration, offset, MAX_WINDOW, wanted)
        assert off.wanted is not None
        result, shown = joint_phasors(
            receiver.designs,
            windows,
            samples.time,
            off.unexplained_sensor,
            centre,
            off.wanted,
            calibration,
            on_clock(imu, offset, predicted.gyro_bias_body),
            np.zeros(1, dtype=np.int64),
            rate_body[None],
            np.full(1, offset),
            shared_by=epochs_sharing_error_at(predicted, receiver.settings.step),
            standing=np.array([standing]),
            noise=np.array(self._noise).reshape(-1, 3, 3),
        )
        self._noise = [*self._noise, shown[0]][-receiver.settings.noise_windows :]
        detected = _foreseen(result, predicted, self.length)
        return EpochMeasurements(detected, result, None, None, 1.0)


def _foreseen(joint: JointPhasors, state: State, length: float) -> FieldSamples:
    """Return the phasors expected in a window; undetectable ones are missing."""
    centre, site = as_trajectory([state]), state.calibration.site
    phasor = predict_channels(
        state.calibration, centre.time, centre.world_from_body, centre.position_world
    )
    by = joint.of_channels()[0]
    parts = np.concatenate([phasor.real, phasor.imag], axis=-1)[0]
    square = np.sum((by @ parts[..., None])[..., 0] ** 2, axis=1)
    information = np.sum(by**2, axis=(1, 2)) / 6.0
    strong = square * (MAX_WINDOW / length) > DETECTION_CHI_SQUARE_ONLINE
    detected = joint.is_predicted[0] & strong & (information > 0.0)
    variance = np.where(detected, 1.0 / np.where(detected, information, 1.0), 1.0)
    return FieldSamples(
        time=centre.time,
        window=np.full(1, length),
        channels=site.channels,
        phasor_sensor=np.where(detected[:, None], phasor[0], np.nan)[None],
        phasor_cov=(variance[:, None, None] * np.eye(3))[None],
    )
