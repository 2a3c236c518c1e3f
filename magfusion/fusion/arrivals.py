"""What has arrived for a navigator and is not used up yet.

How far all of it goes, and what of it was measured at an epoch.
"""

import numpy as np

from magfusion.fusion.buffers import Buffer, check_clock
from magfusion.fusion.epoch import measured_at
from magfusion.fusion.factors import FieldMeasurements
from magfusion.fusion.hearing import Hearing
from magfusion.fusion.inertial import RATE_SPAN
from magfusion.fusion.outset import Outset
from magfusion.fusion.receive import OnlineReceiver, inertial_gap
from magfusion.fusion.state import MOTION, State
from magfusion.fusion.stillness import REACH, REST_SPAN, stands
from magfusion.fusion.wave import WaveFields
from magfusion.parameters import Block
from magfusion.records.samples import FieldSamples, ImuSamples, SteadyFields
from magfusion.units import Array

LONGEST_WAIT = 5.0  # s; the fields go on without an IMU that is silent for longer
OFFSET_STALE = 1e-4  # s; at a radian a second, six thousandths of a degree
MARGIN = 0.1  # s; of inertial samples about a window


class Arrivals:
    """Streams in order of time, each on its own clock.

    Parameters
    ----------
    applied_offset : float
        Added to the IMU's stamps (s).

    Attributes
    ----------
    imu, waveform : Buffer
        Rates and specific forces of the body; raw fields.
    fields : list of FieldSamples
        One epoch each, the oldest first.
    steady : dict
        By the time of the epoch (s), the steady fields with it.
    receiver : OnlineReceiver, optional
        Of the waveform, once that is demodulated.
    usual : float, optional
        Sampling interval of the IMU (s), once there is a state.
    last_epoch : float
        When fields were last measured (s).
    """

    def __init__(self, applied_offset: float) -> None:
        self.applied_offset = applied_offset
        self.imu = Buffer("imu", 6)
        self.waveform = Buffer("magnetometer", 3)
        self.fields: list[FieldSamples] = []
        self.steady: dict[float, SteadyFields] = {}
        self.receiver: OnlineReceiver | None = None
        self.usual: float | None = None
        self.last_epoch = -np.inf
        self._hearing = Hearing()

    # What goes in

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Take inertial samples, as `Navigator.add_imu`."""
        stamps = np.atleast_1d(time)
        check_clock("imu", stamps, self._newest)
        self.imu.add(stamps, np.hstack([np.atleast_2d(gyro_body), np.atleast_2d(accel_body)]))

    def add_magnetometer(self, time: Array, measured_sensor: Array) -> None:
        """Take raw samples of the magnetometer, as `Navigator.add_magnetometer`."""
        stamps = np.atleast_1d(time)
        check_clock("magnetometer", stamps, self._newest)
        self.waveform.add(stamps, np.atleast_2d(measured_sensor))

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None, after: float) -> int:
        """Take phasors, as `Navigator.add_fields`; return how many are not after a time (s)."""
        check_clock("fields", samples.time, self._newest)
        late = 0
        for i in range(len(samples)):
            one = samples.rows(slice(i, i + 1))
            if one.time[0] <= after:
                late += 1
                continue
            self.fields.append(one)
            if steady is not None:
                self.steady[float(one.time[0])] = steady.rows(slice(i, i + 1))
        self.fields.sort(key=lambda s: float(s.time[0]))
        return late

    # How far it goes

    @property
    def _newest(self) -> float:
        """Newest stamp of all streams (s)."""
        return max(self.imu.newest, self.waveform.newest, self._heard)

    @property
    def _heard(self) -> float:
        """Newest stamp of the fields (s)."""
        return float(self.fields[-1].time[0]) if self.fields else self.waveform.newest

    @property
    def first(self) -> float:
        """Oldest stamp of the fields (s)."""
        if self.fields:
            return float(self.fields[0].time[0])
        time, _ = self.waveform.rows()
        return float(time[0]) if len(time) else np.inf

    @property
    def inertial(self) -> float:
        """Time of the newest inertial sample (s)."""
        return self.imu.newest + self.applied_offset

    @property
    def reached(self) -> float:
        """Until when everything has come (s)."""
        return min(self.inertial, self._heard)

    @property
    def awaited(self) -> float:
        """Until when the inertial samples have come, or are not waited for any more (s)."""
        return max(self.inertial, self._heard - LONGEST_WAIT)

    @property
    def losses(self) -> dict[str, int]:
        """What was of no use, with the reason: windows, samples."""
        late = {f"{b.name} sample too late": b.late for b in (self.imu, self.waveform) if b.late}
        dropped = {} if self.receiver is None else self.receiver.dropped
        return {**{f"window: {k}": v for k, v in dropped.items()}, **late}

    # How it goes on

    def forget_before_start(self, kept: float) -> None:
        """Keep no more than so long (s), whatever it is."""
        oldest = self.reached - kept
        for buffer in (self.imu, self.waveform):
            buffer.forget(oldest, oldest)
        self.fields = [s for s in self.fields if s.time[0] >= oldest]

    def start(self, outset: Outset) -> None:
        """Go on from a first state, with its receiver, and drop what it has used."""
        time = outset.state.time
        self.applied_offset = outset.state.calibration.time_offset
        self.usual = float(np.median(np.diff(self.imu.rows()[0])))
        if outset.lockin is not None:
            self.receiver = OnlineReceiver(outset.lockin, outset.rate_hz, time + outset.lockin.step)
        self.fields = [s for s in self.fields if s.time[0] > time]
        self.steady = {t: s for t, s in self.steady.items() if t > time}
        self.last_epoch = time
        self.forget(time)

    def apply_offset_anew(self, state: State, blocks: tuple[Block, ...]) -> float:
        """Cut the inertial stream by the time offset that has been learnt since; return the change.

        A state is the platform's where the IMU's stamp says; under another offset it is the same
        state, a little earlier or later (s) on the log's clock.
        """
        own = [MOTION + b.columns.start for b in blocks if b.kind == "time_offset"]
        if not own:
            return 0.0
        lag = state.calibration.time_offset - self.applied_offset
        if abs(lag) < max(OFFSET_STALE, 2.0 * float(np.sqrt(state.cov[own[0], own[0]]))):
            return 0.0
        self.applied_offset += lag
        return lag

    def forget(self, time: float) -> None:
        """Keep the samples that are needed after a state (s)."""
        reach = 2.0 + (0.0 if self.receiver is None else self.receiver.settings.window)
        self.imu.forget(time - reach, time - self.applied_offset - 1.0)
        self.waveform.forget(time - reach, time - reach)

    # What comes out

    def inertial_samples(self, begin: float = -np.inf, end: float = np.inf) -> ImuSamples:
        """Return the inertial samples between two stamps of their own, and the next outside."""
        time, rows = self.imu.between(begin, end)
        return ImuSamples(time, rows[:, :3], rows[:, 3:])

    def rests(self, state: State) -> bool:
        """Tell whether the platform stands, as `stands`."""
        stamp = state.time - self.applied_offset
        imu = self.inertial_samples(stamp - REST_SPAN - REACH, stamp + REACH)
        return stands(state, imu.time, imu.gyro_body, imu.accel_body, stamp)

    def window_usable(self, receiver: OnlineReceiver, before: State) -> bool:
        """Tell whether the receiver's next window can be demodulated; it counts why not."""
        half = receiver.settings.window / 2.0
        begin, end = receiver.next_centre - half, receiver.next_centre + half
        imu = self.inertial_samples(before.time - MARGIN, end + MARGIN)
        silent = inertial_gap(imu.time + self.applied_offset, begin, end)
        return receiver.usable(self.waveform, silent)

    def measured(
        self,
        before: State,
        predicted: State,
        samples: FieldSamples | None,
        step: float,
        *,
        earth: bool,
    ) -> tuple[FieldMeasurements, FieldSamples, SteadyFields | None] | None:
        """Return what was measured at a prediction; None where nothing was.

        Parameters
        ----------
        before, predicted : State
            At the epoch before and at this.
        samples : FieldSamples, optional
            Of this epoch; None where the receiver's next window may be of it.
        step : float
            Since fields were last measured (s).
        earth : bool
            Whether a steady field alone is a measurement.
        """
        time = predicted.time
        wave, steady = None, self.steady.pop(time, None)
        if samples is None:
            wave = self._demodulated(before, predicted)
            if wave is None:
                return None  # only the clock went on
            samples, steady = wave.fields, wave.steady
        samples = self._hearing.of(samples, step)
        if not np.any(samples.valid) and (not earth or steady is None):
            return None
        self.last_epoch = time
        rate_body = self._rate_body(time) - predicted.gyro_bias_body
        offset = self.applied_offset
        return measured_at(samples, wave, predicted, rate_body, offset, step), samples, steady

    def _demodulated(self, before: State, predicted: State) -> WaveFields | None:
        receiver, time = self.receiver, predicted.time
        if receiver is None or receiver.next_centre != time:
            return None
        half = receiver.settings.window / 2.0
        begin = min(before.time, time - half)
        imu = self.inertial_samples(begin - MARGIN, time + half + MARGIN)
        return receiver.demodulate(self.waveform, imu, before, predicted, self.applied_offset)

    def _rate_body(self, time: float) -> Array:
        stamp = time - self.applied_offset
        _, rows = self.imu.between(stamp - RATE_SPAN / 2, stamp + RATE_SPAN / 2)
        return np.asarray(np.mean(rows[:, :3], axis=0)) if len(rows) else np.zeros(3)
