"""Input queue of a navigator: samples that are not processed yet.

It knows until when all streams are complete, and what was measured at an epoch.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable

import numpy as np

from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.detection import DetectionFilter
from magfusion.estimation.data_checks.stream_buffer import check_clock
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.demodulation.sensor_frame_samples import (
    sensor_frame_phasors,
    sensor_frame_samples,
)
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.estimation.measurements.relative_pose import longest_interval
from magfusion.estimation.measurements.signs import OPEN_SIGN, count_open, with_signs
from magfusion.estimation.online.queue.epoch_measurements import (
    EpochMeasurements,
    measurements_of_fields,
)
from magfusion.estimation.online.queue.inertial_stream import InertialStream
from magfusion.estimation.online.queue.other_measurements import OtherMeasurements
from magfusion.estimation.online.queue.sensor_stream import SensorStream
from magfusion.estimation.online.queue.short_windows import ShortWindows
from magfusion.estimation.online.queue.still_samples import StillSamples
from magfusion.model.aiding import AidingSamples, sensor_named
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, StaticFields
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import Array, IntArray

MAX_WAIT = 5.0  # s; fields are processed without an IMU that is silent for longer
MIN_STEP = 1e-6  # s; of epochs of one magnetometer
MARGIN = 0.1  # s; of inertial samples about a window
MAX_RECORD = 0.1  # s; of samples that arrive together, twice what a replay sends at once


class Arrivals(ABC):
    """Streams of a platform, sorted by time, each on its own clock.

    What depends on how many magnetometers there are is left to its two kinds.
    """

    imu: InertialStream  # of the motion prior, where the platform has none
    streams: list[SensorStream]  # raw samples of each magnetometer; empty where fields are given
    fields: list[FieldSamples]  # one epoch each, the oldest first
    static: dict[float, StaticFields]  # by the time of the epoch (s), its static fields
    others: OtherMeasurements
    last_epoch: float  # time of the last fields (s)
    # time after which phasors have arrived, or are awaited only by the delay (s); 0 before any
    fields_latency: float
    # of tones that are close, where one magnetometer measures them together
    short: ShortWindows | None
    open_signs: int  # amplitudes that are dropped because their sign is undetermined
    without: Counter[str]  # number of epochs without each magnetometer, while it was silent
    _detection: DetectionFilter
    _still: StillSamples
    _last_sample_times: dict[str, float]  # of each of several magnetometers (s)

    def __init__(self, site: Site, streams: list[SensorStream]) -> None:
        self.site, self.streams = site, streams
        self.imu = InertialStream(site.platform.imu.time_offset)
        self.fields, self.static, self.others = [], {}, OtherMeasurements()
        self.last_epoch, self.fields_latency, self.open_signs = -np.inf, 0.0, 0
        self.short, self.without = None, Counter()
        self._detection, self._still = DetectionFilter(), StillSamples()
        self._last_sample_times = {}

    # Input

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples, as `Navigator.add_imu`."""
        self._add_imu(time, *self.site.platform.corrected_imu(gyro_body, accel_body))

    def _add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        stamps = np.atleast_1d(time)
        check_clock("imu", stamps, self.newest)
        self.imu.add(stamps, gyro_body, accel_body, measured=self.site.platform.inertial)

    def _stand_still(self, time: Array, *, raw: bool) -> None:
        """Advance a motion prior to the newest fields (s), where the site has no IMU."""
        if self.site.platform.inertial:
            return
        built = self._still.stamps(time, raw=raw)
        if len(built):
            nothing = np.zeros((len(built), 3))
            self._add_imu(built, nothing, nothing)

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Add raw samples of a magnetometer, as `Navigator.add_magnetometer`."""
        time = self.site.platform.on_drive_clock(time)
        samples = sensor_frame_samples(self.site, time, measured_sensor)
        self._add_samples(np.atleast_1d(time), np.atleast_2d(samples), magnetometer)
        self._stand_still(np.atleast_1d(time), raw=True)

    @abstractmethod
    def _add_samples(self, stamps: Array, samples: Array, magnetometer: str | None) -> None:
        """Add raw samples in the sensor's frame."""

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils, which every magnetometer receives, as `Navigator.add_marks`."""
        clock = self.site.platform.on_drive_clock
        marks = Marks(clock(marks.begin), clock(marks.end), marks.slot)
        check_clock("marks", marks.end, self.newest)
        for stream in self.streams:
            stream.receiver.add_marks(marks)

    @abstractmethod
    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Add the slots of samples, as `Navigator.add_slots`."""

    def add_fields(self, samples: FieldSamples, static: StaticFields | None, after: float) -> int:
        """Add phasors, as `Navigator.add_fields`; return how many are not after a time (s)."""
        samples = sensor_frame_phasors(self.site, samples)
        check_clock("fields", samples.time, self.newest)
        # Phasors arrive when their window ends, with the samples of a record.
        latency = samples.window / 2.0 + MAX_RECORD
        self.fields_latency = float(np.max(latency, initial=self.fields_latency))
        late = self._add_epochs(samples, static, after)
        self.fields.sort(key=lambda s: float(s.time[0]))
        received = np.append([s.time[0] for s in self.fields], samples.time)
        self._stand_still(np.unique(received), raw=False)
        return late

    @abstractmethod
    def _add_epochs(self, samples: FieldSamples, static: StaticFields | None, after: float) -> int:
        """Add phasors on the log's clock; return how many are not after a time (s)."""

    def add_measurement(self, time: float, measurement: Measurement, after: float) -> bool:
        """Add any other measurement; return whether it is after a time (s)."""
        return self.others.add(time, measurement, after, self.newest)

    def add_aiding(self, sensor: str, samples: AidingSamples, after: float) -> Counter[str]:
        """Add samples of an aiding sensor; return how many are unused, by reason."""
        declared = sensor_named(self.site.aiding, sensor, samples.quantity)
        return self.others.add_aiding(declared, samples, after, self.newest)

    # Times

    @property
    @abstractmethod
    def next_field(self) -> float:
        """Time of the next fields (s), as far as is known."""

    @property
    def _next_arrival(self) -> float:
        """Earliest time of phasors that have not arrived yet (s); infinity if there are none."""
        if not self.fields_latency:
            return np.inf
        return max(self._newest_field, self.awaited - self.fields_latency)

    @property
    @abstractmethod
    def newest(self) -> float:
        """Newest stamp of all streams (s)."""

    @property
    @abstractmethod
    def _newest_field(self) -> float:
        """Time until which the fields have arrived, or are not awaited any more (s)."""

    @property
    def first(self) -> float:
        """Oldest stamp of the stored fields (s)."""
        if self.fields:
            return float(self.fields[0].time[0])
        known = [stream.waveform.time[:1] for stream in self.streams]
        return float(np.min(np.concatenate(known), initial=np.inf))

    @property
    def reached(self) -> float:
        """Time until which all streams have arrived (s)."""
        return min(self.imu.reached, self._newest_field)

    @property
    def awaited(self) -> float:
        """Time until which inertial samples have arrived, or are not awaited any more (s)."""
        return max(self.imu.reached, self._newest_field - MAX_WAIT)

    def due(self, inertial: float) -> bool:
        """Return whether phasors are due for processing, up to a time of the IMU (s)."""
        return bool(self.fields) and bool(self.fields[0].time[0] <= inertial)

    @property
    @abstractmethod
    def window_to_come(self) -> bool:
        """Whether all samples of a window exist that awaits its inertial samples."""

    def _silent(self) -> list[str]:
        """Return the magnetometers that are not awaited."""
        return []

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings on the streams."""
        return ()

    @property
    def losses(self) -> dict[str, int]:
        """Numbers of unused windows and samples, by reason."""
        counts = {
            OPEN_SIGN: self.open_signs,
            "imu sample of a sensor that hung": self.imu.frozen,
            "imu sample too late": self.imu.buffer.late,
        }
        return {reason: count for reason, count in counts.items() if count}

    # Processing

    def settle(self) -> None:
        """Sort the newest samples, as a checkpoint stores them."""
        for buffer in (self.imu.buffer, *(stream.samples for stream in self.streams)):
            buffer.rows()

    @abstractmethod
    def gathered(self, delay: float, span: float) -> float | None:
        """Return until when to search for a first state (s); None as long as that is too early.

        `delay`: as of `receive` (s). `span`: required duration of data (s).
        """

    @abstractmethod
    def first_state(
        self, until: float, settings: EstimatorSettings, *, diagnose: bool
    ) -> OnlineStart | NoStart:
        """Return the first state from the data up to a time (s), or why there is none."""

    @abstractmethod
    def limit_history(self, kept: float) -> None:
        """Keep only the last so many seconds of everything."""

    def _keep_from(self, oldest: float) -> None:
        self.imu.buffer.discard_before(oldest, oldest)
        self.fields = [s for s in self.fields if s.time[0] >= oldest]
        for stream in self.streams:
            stream.samples.discard_before(oldest, oldest)
            stream.receiver.discard_marks(oldest)

    def start(self, start: OnlineStart, delay: float) -> None:
        """Continue from a first state, and drop the data it used; the delay as of `receive`."""
        time = start.state.time
        self.imu.begin(start.state)
        self.fields = [s for s in self.fields if s.time[0] > time]
        self.static = {t: s for t, s in self.static.items() if t > time}
        self.others.drop_until(time)
        self.last_epoch = time
        self._begin_receivers(start, delay)

    @abstractmethod
    def _begin_receivers(self, start: OnlineStart, delay: float) -> None:
        """Receive windows from a first state on, and discard what is older."""

    @abstractmethod
    def receive(self, state: State, delay: float) -> None:
        """Check the windows that are complete and within a delay (s); demodulate slots.

        Windows wait for a prediction of the motion in them.
        """

    @abstractmethod
    def next_window(self, state: State, needs_separate: Callable[[State], bool]) -> float | None:
        """Advance to the next admitted window; return its centre (s), None for none.

        `needs_separate`: returns whether close tones must first be separated at a state.
        """

    @abstractmethod
    def fill_silence(self, state: State, time: float) -> None:
        """Substitute missing inertial samples from a state to a time (s), where fields can."""

    def discard_before(self, time: float) -> None:
        """Keep only the samples that are needed after a state (s)."""
        reach = 2.0 + max(stream.receiver.history for stream in self.streams)
        reach += longest_interval(self.site)
        self.imu.discard_before(time, reach)
        for stream in self.streams:
            stream.samples.discard_before(time - reach, time - reach)

    # Output

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
        self.without.update(self._silent())
        by_offset, static = None, self.static.pop(time, None)
        if samples is None:
            if self.short is not None and self.short.at(time):
                return self._measured_together(self.short, before, predicted, standing=standing)
            wave = self._demodulated(before, predicted, is_lost=is_lost)
            if wave is None:
                return None  # only the clock went on
            samples, static, by_offset = wave.fields, wave.static, wave.by_time_offset
        own = step if not samples.magnetometers else self._own_step(samples)
        samples = self._detection.of(samples, own)
        if not samples.signed:
            here, result = as_trajectory([predicted]), samples
            samples = with_signs(samples, here, predicted.calibration)
            self.open_signs += count_open(result, samples)
        if not np.any(samples.valid) and not (earth and static is not None):
            return None
        self.last_epoch = time
        repeats = max(1.0, float(samples.window[0]) / own)
        return measurements_of_fields(
            predicted,
            samples,
            static,
            self.imu,
            step,
            repeats,
            by_offset,
            earth=earth,
            standing=standing,
        )

    def _measured_together(
        self, short: ShortWindows, before: State, predicted: State, *, standing: bool
    ) -> EpochMeasurements:
        """Return the joint measurement of a short window's tones."""
        time, half = predicted.time, 0.5 * short.length
        imu = self.imu.filled(min(before.time, time - half) - MARGIN, time + half + MARGIN)
        rate_body = self.imu.rate_body(time) - predicted.gyro_bias_body
        self.last_epoch = time
        clock = self.streams[0].waveform, imu, self.imu.offset
        return short.measured(before, predicted, *clock, rate_body, standing=standing)

    @abstractmethod
    def _demodulated(
        self, before: State, predicted: State, *, is_lost: bool
    ) -> MotionCompensated | None:
        """Return the window at a prediction; None where there is none."""

    def _own_step(self, samples: FieldSamples) -> float:
        """Return the shortest time since an epoch's magnetometers last measured (s)."""
        time, valid = float(samples.time[0]), samples.valid[0]
        named = zip(samples.magnetometers, valid.tolist(), strict=True)
        names = dict.fromkeys(name for name, there in named if there)
        steps = [time - self._last_sample_times.get(name, -np.inf) for name in names]
        self._last_sample_times |= dict.fromkeys(names, time)
        return max(min(steps, default=np.inf), MIN_STEP)
