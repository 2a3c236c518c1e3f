"""Raw samples of a magnetometer as they arrive, and their windows."""

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
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.units import Array

BEGINNING = 0.5  # s; of samples, to start a receiver that had none at the first state


class SensorStream:
    """One magnetometer's samples on the log's clock, its receiver, and its pending windows.

    `name`: of the samples, for error messages.
    """

    # of this magnetometer only, on the log's clock. It begins with the first state, and never where
    # phasors are given
    receiver: Receiver
    samples: Buffer
    windows: deque[int]  # numbers of windows that are admitted and not demodulated yet
    now: int | None  # of the window at the state that is to be predicted
    late: int  # windows that arrived after the others were processed
    unseen: int  # windows without inertial samples
    _noise: list[Array]
    _noise_unseen: bool

    def __init__(self, receiver: Receiver, name: str) -> None:
        self.receiver, self.samples = receiver, Buffer(name, 3)
        self.windows, self.now = deque(), None
        self.late = self.unseen = 0
        self._noise, self._noise_unseen = [], False

    @property
    def waveform(self) -> Waveform:
        """Stored samples."""
        axes = self.receiver.site.platform.magnetometer.axes
        return Waveform(*self.samples.rows(), axes=axes)

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

    @property
    def dropped(self) -> dict[str, int]:
        """Numbers of unused windows, by reason."""
        return {f"window: {reason}": count for reason, count in self.receiver.dropped.items()}

    def begin_late(self, imu: ImuSamples) -> None:
        """Begin a receiver that had no samples at the first state, once it has enough."""
        wave = self.waveform
        if self.receiver.grid is not None or len(wave) < 2 or len(imu) < 2:
            return
        if np.ptp(wave.time) >= BEGINNING:
            self.receiver.begin(wave, imu)

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
        receiver = self.receiver
        if not receiver.complete(until):
            return None
        assert receiver.grid is not None
        wave = self.waveform
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
        self,
        before: State,
        predicted: State,
        imu: ImuSamples,
        offset: float,
        *,
        blind: bool = False,
        is_lost: bool,
    ) -> MotionCompensated:
        """Return the window at a prediction, by the calibration of this magnetometer.

        `before`, `predicted`, `imu`, `offset`, `blind`, `is_lost`: as of
        `magfusion.estimation.demodulation.motion_compensation.demodulate_predicted`.
        """
        receiver = self.receiver
        assert isinstance(receiver, LockinReceiver)
        assert self.now is not None
        wave = self.waveform
        result = demodulate_predicted(
            receiver, self.now, wave, imu, before, predicted, offset, blind=blind, is_lost=is_lost
        )
        unseen = result.unseen or blind
        self.unseen += unseen
        if unseen != self._noise_unseen:
            self._noise, self._noise_unseen = [], unseen
        # The mean over neighbouring windows, as far as they are known.
        self._noise = [*self._noise, result.fields.phasor_cov][-receiver.settings.noise_windows :]
        cov = np.mean(self._noise, axis=0)
        return replace(result, fields=replace(result.fields, phasor_cov=cov))
