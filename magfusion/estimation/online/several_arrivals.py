"""Input queue of several magnetometers: windows and fields of one time form one epoch.

Each has its own receiver and clock, and may be later than another.  An epoch waits for all of
them except a silent one, which is reported.
"""

from collections import Counter
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.stream_buffer import check_clock
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.demodulation.several_demodulation import same_windows
from magfusion.estimation.demodulation.temperature_compensation import refuse_warm
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.online import NoStart, OnlineStart, find_online_start
from magfusion.estimation.measurements.relative_pose import longest_interval
from magfusion.estimation.online.input_queue import LONGEST_WAIT, MARGIN, Arrivals
from magfusion.estimation.online.measured import EpochMeasurements
from magfusion.estimation.online.sensor_stream import SensorStream
from magfusion.files.fields import SAME_TIME, side_by_side
from magfusion.files.named_records import magnetometer_number
from magfusion.model.marks import Marks
from magfusion.model.parameters import seen_by
from magfusion.model.samples import FieldSamples, SteadyFields, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.marked_bursts import LATE
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.slots import is_marked
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, IntArray

SILENCE = 1.0  # s; plus a window: the others do not wait for one that is silent for longer


class SeveralArrivals(Arrivals):
    """Streams of a platform with several magnetometers, as `Arrivals`.

    Attributes
    ----------
    streams : list of SensorStream
        Of each magnetometer; empty where fields are given.
    begun_at : float
        First stamp of any of them (s).
    without : Counter
        Number of epochs without each magnetometer, while it was silent.
    """

    streams: list[SensorStream]
    begun_at: float
    without: Counter[str]
    _fields_to: dict[str, float]  # stamp of the newest fields of each (s)
    _longest: float  # of their windows (s)
    _centre: float  # of the windows at the state that is to be predicted (s)
    _looked: float  # until when a first state was last searched (s)

    def __init__(self, site: Site, lockin: LockinSettings | None, applied_offset: float) -> None:
        refuse_warm(site)
        super().__init__(receiver_of(site, lockin), applied_offset)
        self.site, sensors = site, site.platform.magnetometers
        self._lockin = same_windows(site, lockin) if site.beacons else lockin
        self.streams = []
        for sensor in sensors:
            alone = site.platform.with_magnetometers((replace(sensor, clock_offset=0.0),))
            self.streams.append(SensorStream(replace(site, platform=alone), self._lockin))
        self.begun_at, self.without = np.inf, Counter()
        self._fields_to, self._longest = {}, 0.0
        self._centre = self._looked = -np.inf
        self._delay = 0.0

    # Input

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Add raw samples of a magnetometer, stamped by itself."""
        which = magnetometer_number(self.site, magnetometer, "samples")
        if self._fields_to:
            raise InputError(
                f"magnetometer: samples of {magnetometer} are mixed with fields; use only one of"
                " them for all magnetometers"
            )
        stream, late = self.streams[which], self.site.platform.magnetometers[which].clock_offset
        stamps = np.atleast_1d(time) + late
        check_clock(stream.samples.name, stamps, self.newest)
        stream.samples.add(stamps, np.atleast_2d(measured_sensor))
        self.begun_at = min(self.begun_at, float(np.min(stamps, initial=np.inf)))

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils, which every magnetometer receives."""
        check_clock("marks", marks.end, self.newest)
        for stream in self.streams:
            stream.receiver.add_marks(marks)

    def add_slots(self, time: Array, slot: IntArray) -> None:  # noqa: ARG002
        """Reject slots of samples: each magnetometer would have its own."""
        raise InputError(
            "magnetometer: slots of the samples of several are not supported; use records of marks"
        )

    def add_fields(
        self,
        samples: FieldSamples,
        steady: SteadyFields | None,  # noqa: ARG002
        after: float,
    ) -> int:
        """Add phasors on the log's clock; those of equal times are merged."""
        if any(np.isfinite(stream.samples.newest) for stream in self.streams):
            raise InputError(
                "fields: they are mixed with samples of the magnetometers; use only one of them for"
                " all magnetometers"
            )
        check_clock("fields", samples.time, self.newest)
        late = 0
        for one in samples.epochs():
            self._take_fields(one)
            if one.time[0] <= after:
                late += 1
            else:
                self._put(one)
        self.fields.sort(key=lambda s: float(s.time[0]))
        return late

    def _take_fields(self, one: FieldSamples) -> None:
        time = float(one.time[0])
        named = zip(one.magnetometers, one.valid[0].tolist(), strict=True)
        for name in dict.fromkeys(name for name, there in named if there):
            self._fields_to[name] = max(self._fields_to.get(name, -np.inf), time)
        self.begun_at = min(self.begun_at, time)
        self._longest = max(self._longest, float(one.window[0]))

    def _put(self, one: FieldSamples) -> None:
        """Insert an epoch, or merge it with the one of the same time."""
        for k, known in enumerate(self.fields):
            separate = not np.any(known.valid & one.valid)
            if separate and abs(known.time[0] - one.time[0]) < SAME_TIME:
                there = one.valid[..., None]
                self.fields[k] = replace(
                    known,
                    window=np.maximum(known.window, one.window),
                    phasor_sensor=np.where(there, one.phasor_sensor, known.phasor_sensor),
                    phasor_cov=np.where(there[..., None], one.phasor_cov, known.phasor_cov),
                )
                return
        self.fields.append(one)

    # Times

    def _last_times(self) -> dict[str, float]:
        """Return the time until which each magnetometer has sent samples (s)."""
        return {
            stream.name: max(stream.samples.newest, self._fields_to.get(stream.name, self.begun_at))
            for stream in self.streams
        }

    @property
    def complete(self) -> float:
        """Time until which all have sent samples, or are not awaited any more (s)."""
        if not np.isfinite(self.begun_at):
            return -np.inf
        detected, silent = self._last_times(), self._silent()
        waited = min(to for name, to in detected.items() if name not in silent)
        return max(waited, self.inertial - LONGEST_WAIT)

    def _silent(self) -> list[str]:
        """Return the magnetometers that are not awaited."""
        detected = self._last_times()
        newest = max(detected.values())
        return [n for n, to in detected.items() if newest - to > SILENCE + self._longest]

    @property
    def newest(self) -> float:
        """Newest stamp of all streams (s)."""
        detected = max(self._last_times().values()) if np.isfinite(self.begun_at) else -np.inf
        return max(self.imu.newest, detected)

    @property
    def _newest_field(self) -> float:
        return self.complete

    @property
    def first(self) -> float:
        """Oldest stamp of the stored fields (s)."""
        known = [stream.waveform.time[:1] for stream in self.streams]
        known += [samples.time for samples in self.fields[:1]]
        return float(np.min(np.concatenate(known), initial=np.inf))

    @property
    def next_field(self) -> float:
        """Time of the next fields (s), as far as is known."""
        silent = self._silent()
        live = [stream for stream in self.streams if stream.windows or stream.name not in silent]
        known = [float(samples.time[0]) for samples in self.fields[:1]]
        return min([*known, *(stream.next_centre for stream in live)], default=np.inf)

    @property
    def window_to_come(self) -> bool:
        """Whether an incomplete epoch of fields awaits more."""
        return bool(self.fields) or any(stream.to_come for stream in self.streams)

    def due(self, inertial: float) -> bool:
        """Return whether the oldest epoch of fields is complete."""
        until = min(inertial, self.complete - self._delay) - self._slots_late
        return bool(self.fields) and bool(self.fields[0].time[0] <= until)

    @property
    def _slots_late(self) -> float:
        """Largest delay of a slot's phasor (s)."""
        grids = [
            s.receiver.grid for s in self.streams if not isinstance(s.receiver, LockinReceiver)
        ]
        known = [grid.step * (grid.together + 1) + grid.wait for grid in grids if grid is not None]
        marked = LATE if known and is_marked(self.site) else 0.0
        return max(known, default=0.0) + marked

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings on silent magnetometers."""
        detected = self._last_times()
        return tuple(
            Finding(
                "magnetometer_silent",
                f"Magnetometer {name} has sent nothing since {detected[name]:.3f} s: the others are"
                " used without it. Check its supply, its cable and its channel.",
                Verdict.TRUSTWORTHY,
            )
            for name in self._silent()
        )

    @property
    def losses(self) -> dict[str, int]:
        """Numbers of unused windows and samples, by magnetometer and reason."""
        result = super().losses
        for stream in self.streams:
            name = stream.name
            counts = {f"window: {k}": v for k, v in stream.receiver.dropped.items()}
            counts["window too late"] = stream.late
            counts["sample too late"] = stream.samples.late
            counts["epoch while it was silent"] = self.without[name]
            result |= {f"magnetometer {name}: {k}": v for k, v in counts.items() if v}
        return result

    # Processing

    def settle(self) -> None:
        """Sort the newest samples."""
        super().settle()
        for stream in self.streams:
            stream.samples.rows()

    def gathered(self, delay: float, span: float) -> float | None:
        """Return until when to search for a first state (s), independent of the size of pieces."""
        until = self.first + span
        if not self.reached - delay >= until:
            return None
        self._looked = until
        return until

    def first_state(
        self, until: float, settings: EstimatorSettings, *, diagnose: bool
    ) -> OnlineStart | NoStart:
        """Return the first state from the measurements up to a time (s)."""
        late = {sensor.name: sensor.clock_offset for sensor in self.site.platform.magnetometers}
        waves = {}
        for stream in self.streams:
            wave = stream.waveform
            wave = wave.rows(wave.time <= until)
            if len(wave):
                marks = stream.receiver.marks
                waves[stream.name] = Waveform(
                    wave.time - late[stream.name], wave.measured_sensor, marks
                )
        return find_online_start(
            self.site,
            self.inertial_samples(end=until - self.applied_offset),
            self.waveform,
            self.fields,
            [],
            until,
            settings,
            None,
            waves,
            diagnose=diagnose,
        )

    def limit_history(self, kept: float) -> None:
        """Keep only so much before the last search (s)."""
        oldest = self._looked - kept
        self.imu.discard_before(oldest, oldest)
        self.fields = [s for s in self.fields if s.time[0] >= oldest]
        for stream in self.streams:
            stream.samples.discard_before(oldest, oldest)
            stream.receiver.discard_marks(oldest)

    def start(self, start: OnlineStart, delay: float) -> None:
        """Continue from a first state, each receiver by its own samples."""
        for stream in self.streams:
            if isinstance(stream.receiver, LockinReceiver):
                stream.receiver.extra_lines = start.lines.get(stream.name)
        super().start(start, delay)
        self.receive(start.state, delay)

    def receive(self, state: State, delay: float) -> None:
        """Check the windows of each that are complete and within a delay (s)."""
        self._delay = delay
        imu = self.inertial_samples()
        for k, stream in enumerate(self.streams):
            until = min(self.awaited, stream.samples.newest) - delay
            result = stream.receive(imu, until, self.last_epoch, state, self.applied_offset)
            if result is None:
                continue
            for one in self._as_channels_of_all({k: result}).epochs():
                self._put(one)
        self.fields.sort(key=lambda s: float(s.time[0]))

    def _as_channels_of_all(self, result: dict[int, FieldSamples]) -> FieldSamples:
        """Return the fields of some magnetometers as channels of all."""
        none = FieldSamples.empty(self.streams[0].receiver.site.channels)
        return side_by_side([result.get(k, none) for k in range(len(self.streams))], self.site)

    def next_window(self, state: State, *, is_lost: bool = False) -> float | None:  # noqa: ARG002
        """Advance to the next windows of all; return their centre (s), None where one may come."""
        centre = min(stream.next_admitted for stream in self.streams)
        grids = [s.receiver for s in self.streams if s.receiver.grid is not None]
        if not np.isfinite(centre):
            return None
        steps = [r.admission.magnetometer_step for r in grids if r.admission is not None]
        length = max(r.grid.length for r in grids if r.grid is not None)
        whole = min(self.awaited, self.complete) - self._delay
        if centre + 0.5 * length + 2.0 * max(steps) > whole:
            return None
        self._centre = centre
        for stream in self.streams:
            mine = stream.next_admitted - centre < SAME_TIME
            stream.now = stream.windows.popleft() if mine else None
        return centre

    def discard_before(self, time: float) -> None:
        """Keep only the samples that are needed after a state (s)."""
        reach = 2.0 + max(stream.receiver.history for stream in self.streams)
        reach += longest_interval(self.receiver.site)
        self.imu.discard_before(time - reach, time - self.applied_offset - 1.0)
        for stream in self.streams:
            stream.samples.discard_before(time - reach, time - reach)

    def fill_silence(self, state: State, time: float) -> None:
        """Do nothing where the IMU is silent: no single magnetometer's samples replace it."""

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
        """Return the measurements at a prediction, as `Arrivals.measured`."""
        self.without.update(self._silent())
        return super().measured(
            before, predicted, samples, step, earth=earth, standing=standing, is_lost=is_lost
        )

    def _demodulated(
        self, before: State, predicted: State, *, is_lost: bool
    ) -> MotionCompensated | None:
        """Return the windows at a prediction, each of its own magnetometer; None for none."""
        if self._centre != predicted.time:
            return None
        half = 0.5 * max(s.receiver.grid.length for s in self.streams if s.receiver.grid)
        begin, end = min(before.time, predicted.time - half), predicted.time + half
        imu, offset = self.motion_samples(begin - MARGIN, end + MARGIN), self.applied_offset
        result: dict[int, MotionCompensated] = {}
        for k, stream in enumerate(self.streams):
            if stream.now is None:
                continue
            mine = replace(predicted, calibration=seen_by(predicted.calibration, k))
            result[k] = stream.demodulated(before, mine, imu, offset, is_lost=is_lost)
            stream.now = None
        fields = self._as_channels_of_all({k: one.fields for k, one in result.items()})
        fields = replace(fields, time=np.array([predicted.time]))
        wave = MotionCompensated.of_slots(fields)
        by_offset = wave.by_time_offset.copy()
        for k, one in result.items():
            by_offset[:, self.site.of_sensor(k)] = one.by_time_offset
        return replace(wave, by_time_offset=by_offset)
