"""Raw samples of one of several magnetometers as they arrive, and their windows."""

from collections import deque
from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.stream_buffer import Buffer
from magfusion.estimation.demodulation.motion_compensation import (
    MotionCompensated,
    demodulate_predicted,
)
from magfusion.estimation.graph.state import State
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array

BEGINNING = 0.5  # s; of samples, to start a receiver that had none at the first state


class SensorStream:
    """One magnetometer's samples on the log's clock, its receiver, and its pending windows.

    Parameters
    ----------
    site : Site
        With this magnetometer only, on the log's clock.
    lockin : LockinSettings, optional
        Of windows at the same times for all magnetometers.

    Attributes
    ----------
    receiver : Receiver
    samples : Buffer
    windows : deque of int
        Numbers of windows that are admitted and not demodulated yet.
    now : int, optional
        Of the window at the state that is to be predicted.
    late : int
        Windows that arrived after the others were processed.
    """

    receiver: Receiver
    samples: Buffer
    windows: deque[int]
    now: int | None
    late: int
    _noise: list[Array]
    _noise_unseen: bool

    def __init__(self, site: Site, lockin: LockinSettings | None) -> None:
        self.name = site.platform.magnetometer.name
        self.receiver = receiver_of(site, lockin)
        self.samples = Buffer(f"magnetometer {self.name}", 3)
        self.windows, self.now, self.late = deque(), None, 0
        self._noise, self._noise_unseen = [], False

    @property
    def waveform(self) -> Waveform:
        """Stored samples."""
        return Waveform(*self.samples.rows())

    @property
    def next_centre(self) -> float:
        """Centre of its next window (s), as far as is known."""
        if self.receiver.grid is None:
            return np.inf
        number = self.windows[0] if self.windows else self.receiver.next_number
        return self.receiver.centre_of(number)

    @property
    def next_admitted(self) -> float:
        """Centre of the next window that is to be demodulated (s)."""
        return self.receiver.centre_of(self.windows[0]) if self.windows else np.inf

    @property
    def to_come(self) -> bool:
        """Whether a window is pending, or its samples have arrived."""
        return bool(self.windows) or self.receiver.complete(self.samples.newest)

    def receive(
        self, imu: ImuSamples, until: float, after: float, state: State, offset: float
    ) -> FieldSamples | None:
        """Check the windows that are complete at a time (s); return the phasors of slots.

        Parameters
        ----------
        imu : ImuSamples
            All stored samples.
        after : float
            Windows up to this time are too late (s).
        state : State
            The newest.
        offset : float
            Added to the IMU's stamps (s).
        """
        receiver, wave = self.receiver, self.waveform
        if receiver.grid is None:
            if len(wave) < 2 or np.ptp(wave.time) < BEGINNING or len(imu) < 2:
                return None
            receiver.begin(wave, imu)
        if not receiver.complete(until):
            return None
        assert receiver.grid is not None
        after += 0.25 * receiver.grid.step
        if isinstance(receiver, LockinReceiver):
            windows = receiver.admit(wave, imu, until)
            in_time = windows.centre > after
            self.windows.extend(windows.number[in_time].tolist())
            self.late += int(np.sum(~in_time))
            return None
        result = receiver.push(wave, imu, until, state.gyro_bias_body, offset)
        in_time = result.time > after
        self.late += int(np.sum(~in_time))
        return result.rows(in_time)

    def demodulated(
        self, before: State, predicted: State, imu: ImuSamples, offset: float, *, is_lost: bool
    ) -> MotionCompensated:
        """Return the window at a prediction, by the calibration of this magnetometer.

        Parameters
        ----------
        before, predicted, imu, offset, is_lost
            As of `magfusion.estimation.demodulation.motion_compensation.demodulate_predicted`.
        """
        receiver = self.receiver
        assert isinstance(receiver, LockinReceiver)
        assert self.now is not None
        result = demodulate_predicted(
            receiver, self.now, self.waveform, imu, before, predicted, offset, is_lost=is_lost
        )
        if result.unseen != self._noise_unseen:
            self._noise, self._noise_unseen = [], result.unseen
        # The mean over neighbouring windows, as far as they are known.
        self._noise = [*self._noise, result.fields.phasor_cov][-receiver.settings.noise_windows :]
        cov = np.mean(self._noise, axis=0)
        return replace(result, fields=replace(result.fields, phasor_cov=cov))
