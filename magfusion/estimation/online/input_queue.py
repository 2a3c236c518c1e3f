"""Input queue of a navigator: samples that are not processed yet.

It knows until when all streams are complete, and what was measured at an epoch.
"""

from collections import deque
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.detection import DetectionFilter
from magfusion.estimation.data_checks.freeze import Freeze
from magfusion.estimation.data_checks.stream_buffer import Buffer, check_clock
from magfusion.estimation.demodulation.motion_compensation import (
    MotionCompensated,
    demodulate_predicted,
)
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.preintegration import RATE_SPAN, inertial_at
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.graph.state import MOTION, VELOCITY, State, as_trajectory
from magfusion.estimation.initialization.online import NoStart, OnlineStart, find_online_start
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.measurements.earth import earth_measurement
from magfusion.estimation.measurements.model_error import epochs_sharing_error_at
from magfusion.estimation.measurements.phasors import field_phasors
from magfusion.estimation.measurements.relative_pose import RelativePose, longest_interval
from magfusion.estimation.measurements.signs import OPEN_SIGN, count_open, with_signs
from magfusion.estimation.measurements.zero_velocity import (
    REACH,
    may_stand,
    quiet_before,
)
from magfusion.estimation.online.imu_gap_filler import ImuGapFiller
from magfusion.estimation.online.measured import EpochMeasurements
from magfusion.estimation.online.short_windows import ShortWindows
from magfusion.files.named_records import magnetometer_number
from magfusion.model.marks import Marks
from magfusion.model.parameters import CLOCK_RATE, TIME_OFFSET, Block, corrected_imu
from magfusion.model.samples import FieldSamples, ImuSamples, SteadyFields, Waveform
from magfusion.model.trust import Finding
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.units import Array, IntArray

LONGEST_WAIT = 5.0  # s; fields are processed without an IMU that is silent for longer
OFFSET_STALE = 1e-4  # s; at a radian a second, six thousandths of a degree
SHORTEST_STEP = 1e-6  # s; of epochs of one magnetometer
MARGIN = 0.1  # s; of inertial samples about a window


class Arrivals:
    """Streams, sorted by time, each on its own clock.

    Parameters
    ----------
    receiver : Receiver
        Of the waveform; it begins with the first state, and never where phasors are given.
    applied_offset : float
        Added to the IMU's stamps (s).

    Attributes
    ----------
    imu, waveform : Buffer
        Rates and specific forces of the body; raw fields.
    fields : list of FieldSamples
        One epoch each, the oldest first.
    steady : dict
        By the time of the epoch (s), its static fields.
    others : list of (float, Measurement)
        Other measurements, with their times (s).
    windows : deque of int
        Numbers of windows that are admitted and not demodulated yet.
    usual : float, optional
        Sampling interval of the IMU (s), once there is a state.
    last_epoch : float
        Time of the last fields (s).
    unseen : int
        Windows without inertial samples.
    open_signs : int
        Amplitudes that are dropped because their sign is undetermined.
    frozen : int
        Inertial samples that are dropped because the IMU is frozen.
    imu_filler : ImuGapFiller
        Substitutes for missing inertial samples.
    short : ShortWindows, optional
        Of tones that are close.
    """

    receiver: Receiver
    short: ShortWindows | None
    applied_offset: float
    imu: Buffer
    waveform: Buffer
    fields: list[FieldSamples]
    steady: dict[float, SteadyFields]
    others: list[tuple[float, Measurement]]
    windows: deque[int]
    usual: float | None
    _last_sample_times: dict[
        str, float
    ]  # time of the last samples of each of several magnetometers (s)
    last_epoch: float
    unseen: int
    open_signs: int
    frozen: int
    imu_filler: ImuGapFiller
    _gyro: Freeze
    _accel: Freeze
    _detection: DetectionFilter
    _window: int | None  # at the state that is to be predicted
    _noise: list[Array]
    _noise_unseen: bool

    def __init__(self, receiver: Receiver, applied_offset: float) -> None:
        self.receiver, self.short = receiver, None
        # Substitutes need a state; a whole log has one only in the smoother.
        receiver.needs_turn = not isinstance(receiver, LockinReceiver)
        receiver.joined = True
        self.applied_offset = applied_offset
        self.imu = Buffer("imu", 6)
        self.waveform = Buffer("magnetometer", 3)
        self.fields, self.steady, self.others = [], {}, []
        self.windows = deque()
        self.usual = self._window = None
        self.last_epoch = -np.inf
        self._detection = DetectionFilter()
        self.unseen, self.imu_filler, self.open_signs = 0, ImuGapFiller(), 0
        self.frozen, self._gyro, self._accel = 0, Freeze(), Freeze()
        self._noise, self._noise_unseen = [], False
        self._last_sample_times = {}

    # Input

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples, as `Navigator.add_imu`."""
        stamps = np.atleast_1d(time)
        check_clock("imu", stamps, self.newest)
        rows = np.hstack([np.atleast_2d(gyro_body), np.atleast_2d(accel_body)])
        self.imu.add(stamps, rows)
        if not self.receiver.site.platform.inertial:
            return
        for instrument, own in ((self._gyro, rows[:, :3]), (self._accel, rows[:, 3:])):
            for after, until in instrument.stretches(stamps, own):
                self.frozen += self.imu.leave_out(after, until)

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Add raw samples of the magnetometer, as `Navigator.add_magnetometer`."""
        magnetometer_number(self.receiver.site, magnetometer, "samples")
        stamps = np.atleast_1d(time)
        check_clock("magnetometer", stamps, self.newest)
        self.waveform.add(stamps, np.atleast_2d(measured_sensor))

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils, as `Navigator.add_marks`."""
        check_clock("marks", marks.end, self.newest)
        self.receiver.add_marks(marks)

    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Add the slots of samples, as `Navigator.add_slots`."""
        check_clock("magnetometer", time, self.newest)
        self.receiver.add_slots(time, slot)

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None, after: float) -> int:
        """Add phasors, as `Navigator.add_fields`; return how many are not after a time (s)."""
        check_clock("fields", samples.time, self.newest)
        if self.fields and self.fields[-1].signed != samples.signed:
            raise InputError(
                "fields: amplitudes without sign are mixed with phasors; use only one of them"
            )
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

    def add_measurement(self, time: float, measurement: Measurement, after: float) -> bool:
        """Add any other measurement; return whether it is after a time (s)."""
        check_clock("measurement", np.array([time]), self.newest)
        in_time = time > after + SAME_TIME
        if in_time:
            self.others.append((time, measurement.at(0)))
            self.others.sort(key=lambda other: other[0])
        return in_time

    # Times

    @property
    def next_field(self) -> float:
        """Time of the next fields (s), as far as is known."""
        if self.fields:
            return float(self.fields[0].time[0])
        if self.receiver.grid is None:
            return np.inf
        number = self.windows[0] if self.windows else self.receiver.next_number
        return self.receiver.centre_of(number)

    @property
    def next_other(self) -> float:
        """Time of the next other measurement (s)."""
        return self.others[0][0] if self.others else np.inf

    @property
    def newest(self) -> float:
        """Newest stamp of all streams (s)."""
        return max(self.imu.newest, self.waveform.newest, self._newest_field)

    @property
    def _newest_field(self) -> float:
        """Newest stamp of the fields (s)."""
        last = float(self.fields[-1].time[0]) if self.fields else -np.inf
        return max(last, self.waveform.newest)

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
    def hung_since(self) -> float | None:
        """Stamp since which the IMU is frozen (s), on the log's clock; None where it is not."""
        start_time = [one.frozen_since for one in (self._gyro, self._accel) if one.is_frozen]
        return min(start_time) + self.applied_offset if start_time else None

    @property
    def reached(self) -> float:
        """Time until which all streams have arrived (s)."""
        return min(self.inertial, self._newest_field)

    @property
    def awaited(self) -> float:
        """Time until which inertial samples have arrived, or are not awaited any more (s)."""
        return max(self.inertial, self._newest_field - LONGEST_WAIT)

    def due(self, inertial: float) -> bool:
        """Return whether phasors are due for processing, up to a time of the IMU (s)."""
        return bool(self.fields) and bool(self.fields[0].time[0] <= inertial)

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings on the streams; none on those of a single magnetometer."""
        return ()

    @property
    def losses(self) -> dict[str, int]:
        """Numbers of unused windows and samples, by reason."""
        frozen = {"imu sample of a sensor that hung": self.frozen} if self.frozen else {}
        late = {f"{b.name} sample too late": b.late for b in (self.imu, self.waveform) if b.late}
        unseen = {"window without inertial samples": self.unseen} if self.unseen else {}
        unseen |= {OPEN_SIGN: self.open_signs} if self.open_signs else {}
        return {
            **{f"window: {k}": v for k, v in self.receiver.dropped.items()},
            **unseen,
            **frozen,
            **late,
        }

    # Processing

    def settle(self) -> None:
        """Sort the newest samples, as a checkpoint stores them."""
        self.imu.rows()
        self.waveform.rows()

    def gathered(self, delay: float, span: float) -> float | None:
        """Return until when to search for a first state (s); None as long as that is too early.

        Parameters
        ----------
        delay : float
            As of `receive` (s).
        span : float
            Required duration of data (s).
        """
        reached = self.reached - delay
        return reached if reached - self.first >= span else None

    def first_state(
        self, until: float, settings: EstimatorSettings, *, diagnose: bool
    ) -> OnlineStart | NoStart:
        """Return the first state from the data so far, or why there is none."""
        steady = list(self.steady.values())
        return find_online_start(
            self.receiver.site,
            self.inertial_samples(end=until - self.applied_offset + MARGIN),
            self.waveform,
            self.fields,
            steady,
            until,
            settings,
            self.receiver.marks,
            diagnose=diagnose,
        )

    def limit_history(self, kept: float) -> None:
        """Keep only the last so many seconds of everything."""
        oldest = self.reached - kept
        for buffer in (self.imu, self.waveform):
            buffer.discard_before(oldest, oldest)
        self.fields = [s for s in self.fields if s.time[0] >= oldest]
        self.receiver.discard_marks(oldest)

    def start(self, start: OnlineStart, delay: float) -> None:
        """Continue from a first state, and drop the data it used; the delay as of `receive`."""
        time = start.state.time
        self.applied_offset = float(start.state.calibration.imu_offset(np.array(time)))
        self.usual = float(np.median(np.diff(self.imu.rows()[0])))
        self.fields = [s for s in self.fields if s.time[0] > time]
        self.steady = {t: s for t, s in self.steady.items() if t > time}
        self.others = [other for other in self.others if other[0] > time]
        self.last_epoch = time
        if start.waveform is not None:
            if isinstance(self.receiver, LockinReceiver):
                self.receiver.extra_lines = start.extra_lines
            self.receiver.begin(start.waveform, self.inertial_samples())
            if self.short is not None:
                self.short.receiver.fit_extra_lines(start.extra_lines)
                self.short.receiver.begin(start.waveform, self.inertial_samples())
            self.receive(start.state, delay)
        self.discard_before(time)

    def receive(self, state: State, delay: float) -> None:
        """Check the windows that are complete and within a delay (s); demodulate slots.

        Windows wait for a prediction of the motion in them.
        """
        until, receiver = min(self.awaited, self.waveform.newest) - delay, self.receiver
        if self.short is not None and self.short.receiver.complete(until):
            samples = self._waveform_samples(), self.inertial_samples()
            self.short.receive(*samples, until, self.last_epoch)
        if not receiver.complete(until):
            return
        assert receiver.grid is not None
        waveform, imu = self._waveform_samples(), self.inertial_samples()
        # The first state has used windows, too.
        after = self.last_epoch + 0.25 * receiver.grid.step
        if isinstance(receiver, LockinReceiver):
            windows = receiver.admit(waveform, imu, until)
            self.windows.extend(windows.number[windows.centre > after].tolist())
        else:
            offset = self.applied_offset
            result = receiver.push(waveform, imu, until, state.gyro_bias_body, offset)
            self.fields += result.rows(result.time > after).epochs()

    def next_window(self, state: State, *, is_lost: bool = False) -> float | None:
        """Advance to the next admitted window; return its centre (s), None for none.

        For close tones it is the next short window, as long as the state is certain enough.

        Parameters
        ----------
        is_lost : bool
            Whether the tones must first be separated.
        """
        if self.short is not None:
            while self.windows and self.receiver.centre_of(self.windows[0]) <= state.time:
                self.windows.popleft()
            centre = None if is_lost else self.short.next_after(state.time)
            if centre is not None:
                return centre
        if not self.windows:
            return None
        self._window = self.windows.popleft()
        return self.receiver.centre_of(self._window)

    @property
    def window_to_come(self) -> bool:
        """Whether all samples of a window exist that awaits its inertial samples."""
        newest = self.waveform.newest
        short = self.short is not None and self.short.receiver.complete(newest)
        return short or self.receiver.complete(newest)

    def reapply_time_offset(self, state: State, blocks: tuple[Block, ...]) -> float:
        """Apply the time offset learnt since to the inertial stream; return the change (s).

        A state belongs to its stamp on the IMU's clock; with another offset the same state is a
        little earlier or later (s) on the log's clock.
        """
        lag = float(state.calibration.imu_offset(np.array(state.time))) - self.applied_offset
        if abs(lag) < OFFSET_STALE:
            return 0.0
        by_state, run = np.zeros(len(state.cov)), state.time - state.calibration.imu_begin
        for parameter, _, columns, _ in blocks:
            if parameter == TIME_OFFSET:
                by_state[MOTION + columns.start] = 1.0
            elif parameter == CLOCK_RATE:
                by_state[MOTION + columns.start] = run
        if not np.any(by_state):
            return 0.0
        sigma = float(np.sqrt(by_state @ state.cov @ by_state))
        if abs(lag) < 2.0 * sigma:
            return 0.0
        self.applied_offset += lag
        return lag

    def discard_before(self, time: float) -> None:
        """Keep only the samples that are needed after a state (s)."""
        reach = 2.0 + self.receiver.history + longest_interval(self.receiver.site)
        self.imu.discard_before(time - reach, time - self.applied_offset - 1.0)
        self.imu_filler.discard_before(time - reach)
        self.waveform.discard_before(time - reach, time - reach)

    # Output

    def inertial_samples(self, begin: float = -np.inf, end: float = np.inf) -> ImuSamples:
        """Return the inertial samples between two of their own stamps, with both neighbours."""
        time, rows = self.imu.between(begin, end)
        return ImuSamples(time, rows[:, :3], rows[:, 3:])

    def motion_samples(self, begin: float, end: float) -> ImuSamples:
        """Return them, with substitutes for missing ones."""
        return self.imu_filler.among(self.inertial_samples(begin, end), begin, end)

    def fill_silence(self, state: State, time: float) -> None:
        """Substitute missing inertial samples from a state to a time (s), from the fields."""
        receiver = self.receiver
        if self.fields or not isinstance(receiver, LockinReceiver) or receiver.admission is None:
            return
        until, streams = time + receiver.settings.window / 2.0, (self.imu, self.waveform)
        if self.inertial >= self.awaited:  # what has not arrived yet is no silence
            until = min(until, self.inertial)
        self.imu_filler.fill(state, until, *streams, self.applied_offset, receiver.admission)

    def others_at(self, time: float) -> list[Measurement]:
        """Return the other measurements at a time (s), and remove them."""
        due = [measurement for when, measurement in self.others if when <= time + SAME_TIME]
        self.others = [other for other in self.others if other[0] > time + SAME_TIME]
        return due

    def with_inertial(
        self, measurement: Measurement, state: State, blocks: tuple[Block, ...]
    ) -> Measurement:
        """Return a measurement with the inertial samples that it needs at a predicted state."""
        if not isinstance(measurement, AidingMeasurement):
            return measurement
        time, offset = state.time, self.applied_offset
        stamp = time - offset
        if isinstance(measurement, RelativePose):
            begin = stamp - float(measurement.interval[0])
            imu = self.inertial_samples(begin - RATE_SPAN, stamp + RATE_SPAN)
            imu = corrected_imu(state.calibration, blocks, imu)
            bias = np.hstack([state.accel_bias_body, state.gyro_bias_body])[None]
            measurement = measurement.over_interval(
                imu, offset, np.array([time]), bias, self.receiver.site, self.usual
            )
        imu = self.inertial_samples(stamp - RATE_SPAN, stamp + RATE_SPAN)
        if not len(imu):
            return measurement
        at = inertial_at(imu, offset, np.array([time]))
        return measurement.with_inertial(at)

    def rests(self, state: State) -> bool:
        """Return whether the platform is stationary, as far as is known."""
        stamp = state.time - self.applied_offset
        motion = state.calibration.site.platform.motion
        if not may_stand(state.velocity_world, state.cov[VELOCITY, VELOCITY], motion):
            return False
        imu = self.inertial_samples(stamp - motion.rest_span - REACH, stamp + REACH)
        return bool(quiet_before(imu, np.array([stamp]), motion)[0])

    def measured(
        self,
        before: State,
        predicted: State,
        samples: FieldSamples | None,
        step: float,
        *,
        earth: bool,
        standing: bool,
        is_lost: bool = False,
    ) -> EpochMeasurements | None:
        """Return what was detected and measured at a prediction; None without a measurement.

        Parameters
        ----------
        before, predicted : State
            At the previous epoch and at this one.
        samples : FieldSamples, optional
            Of this epoch; None where it may have a window.
        step : float
            Since fields were last measured (s).
        earth : bool
            Whether a static field is a measurement.
        standing : bool
            Whether the platform is known to be stationary.
        """
        time = predicted.time
        by_offset, steady = None, self.steady.pop(time, None)
        if samples is None and self.short is not None and self.short.at(time):
            return self._measured_together(self.short, before, predicted, standing=standing)
        if samples is None:
            wave = self._demodulated(before, predicted, is_lost=is_lost)
            if wave is None:
                return None  # only the clock went on
            samples, steady, by_offset = wave.fields, wave.steady, wave.by_time_offset
        own = step if not samples.magnetometers else self._own_step(samples)
        samples = self._detection.of(samples, own)
        if not samples.signed:
            here, result = as_trajectory([predicted]), samples
            samples = with_signs(samples, here, predicted.calibration)
            self.open_signs += count_open(result, samples)
        if not np.any(samples.valid) and not (earth and steady is not None):
            return None
        self.last_epoch = time
        now, offset = np.zeros(1, dtype=np.int64), np.full(1, self.applied_offset)
        rate_body = (self._rate_body(time) - predicted.gyro_bias_body)[None]
        repeats = max(1.0, float(samples.window[0]) / own)
        phasors = field_phasors(
            predicted.calibration.site,
            samples,
            now,
            as_trajectory([predicted]),
            rate_body,
            offset,
            repeats,
            by_offset,
            epochs_sharing_error_at(predicted, step),
            np.array([standing]),
        )
        field = None
        if earth and steady is not None:
            site = predicted.calibration.site
            field = earth_measurement(site, steady, now, rate_body, offset, step)
        return EpochMeasurements(samples, phasors, field, steady, repeats)

    def _measured_together(
        self, short: ShortWindows, before: State, predicted: State, *, standing: bool
    ) -> EpochMeasurements:
        """Return the joint measurement of a short window's tones."""
        half, time = 0.5 * short.length, predicted.time
        begin, end = min(before.time, time - half), time + half
        imu = self.motion_samples(begin - MARGIN, end + MARGIN)
        rate_body = self._rate_body(time) - predicted.gyro_bias_body
        self.last_epoch = time
        return short.measured(
            before,
            predicted,
            self._waveform_samples(),
            imu,
            self.applied_offset,
            rate_body,
            standing=standing,
        )

    def _own_step(self, samples: FieldSamples) -> float:
        """Return the shortest time since an epoch's magnetometers last measured (s)."""
        time, valid = float(samples.time[0]), samples.valid[0]
        named = zip(samples.magnetometers, valid.tolist(), strict=True)
        names = dict.fromkeys(name for name, there in named if there)
        steps = [time - self._last_sample_times.get(name, -np.inf) for name in names]
        self._last_sample_times |= dict.fromkeys(names, time)
        return max(min(steps, default=np.inf), SHORTEST_STEP)

    def _demodulated(
        self, before: State, predicted: State, *, is_lost: bool
    ) -> MotionCompensated | None:
        """Return the window at a prediction; None where there is none."""
        number, receiver = self._window, self.receiver
        if number is None or receiver.centre_of(number) != predicted.time:
            return None
        assert isinstance(receiver, LockinReceiver)
        half = receiver.settings.window / 2.0
        begin, end = min(before.time, predicted.time - half), predicted.time + half
        imu = self.motion_samples(begin - MARGIN, end + MARGIN)
        wave, offset = self._waveform_samples(), self.applied_offset
        blind = self.imu_filler.covers(begin - offset, end - offset)
        result = demodulate_predicted(
            receiver, number, wave, imu, before, predicted, offset, blind=blind, is_lost=is_lost
        )
        unseen = result.unseen or blind
        self.unseen += unseen
        if unseen != self._noise_unseen:
            self._noise, self._noise_unseen = [], unseen
        # The mean over neighbouring windows, as far as they are known.
        self._noise = [*self._noise, result.fields.phasor_cov][-receiver.settings.noise_windows :]
        return replace(
            result, fields=replace(result.fields, phasor_cov=np.mean(self._noise, axis=0))
        )

    def _waveform_samples(self) -> Waveform:
        axes = self.receiver.site.platform.magnetometer.axes
        return Waveform(*self.waveform.rows(), axes=axes)

    def _rate_body(self, time: float) -> Array:
        stamp = time - self.applied_offset
        imu = self.motion_samples(stamp - RATE_SPAN / 2, stamp + RATE_SPAN / 2)
        return np.asarray(np.mean(imu.gyro_body, axis=0)) if len(imu) else np.zeros(3)
