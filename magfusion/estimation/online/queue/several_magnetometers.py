"""Input queue of several magnetometers: windows and fields of one time form one epoch.

Each has its own receiver and clock, and may be later than another.  An epoch waits for all of
them except a silent one, which is reported.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.stream_buffer import Buffer, check_clock
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.demodulation.several_demodulation import same_windows
from magfusion.estimation.demodulation.temperature_compensation import refuse_warm
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.online import NoStart, OnlineStart, find_online_start
from magfusion.estimation.online.queue.arrivals import MARGIN, MAX_WAIT, Arrivals
from magfusion.estimation.online.queue.sensor_stream import SensorStream
from magfusion.files.fields import SAME_TIME, side_by_side
from magfusion.files.named_records import magnetometer_number
from magfusion.model.parameters import seen_by
from magfusion.model.samples import FieldSamples, StaticFields, Waveform
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
    """Streams of a platform with several magnetometers.

    `begun_at`: first stamp of any of them (s).
    """

    begun_at: float
    _fields_to: dict[str, float]  # stamp of the newest fields of each (s)
    _longest: float  # of their windows (s)
    _centre: float  # of the windows at the state that is to be predicted (s)
    _looked: float  # until when a first state was last searched (s)

    def __init__(self, site: Site, lockin: LockinSettings | None) -> None:
        refuse_warm(site)
        lockin = same_windows(site, lockin) if site.beacons else lockin
        self.sensors, streams = site.platform.magnetometers, []
        for sensor in self.sensors:
            platform = site.platform.with_magnetometers((replace(sensor, clock_offset=0.0),))
            receiver = receiver_of(replace(site, platform=platform), lockin)
            streams.append(SensorStream(receiver, f"magnetometer {sensor.name}"))
        super().__init__(site, streams)
        self.begun_at = np.inf
        self._fields_to, self._longest = {}, 0.0
        self._centre = self._looked = -np.inf
        self._delay = 0.0

    @property
    def _named(self) -> Iterator[tuple[str, SensorStream]]:
        return zip((sensor.name for sensor in self.sensors), self.streams, strict=True)

    # Input

    def _add_samples(self, stamps: Array, samples: Array, magnetometer: str | None) -> None:
        which = magnetometer_number(self.site, magnetometer, "samples")
        if self._fields_to:
            raise InputError(
                f"magnetometer: samples of {magnetometer} are mixed with fields; use only one of"
                " them for all magnetometers"
            )
        buffer, stamps = self.streams[which].samples, stamps + self.sensors[which].clock_offset
        check_clock(buffer.name, stamps, self.newest)
        buffer.add(stamps, samples)
        self.begun_at = min(self.begun_at, float(np.min(stamps, initial=np.inf)))

    def add_slots(self, time: Array, slot: IntArray) -> None:  # noqa: ARG002
        """Reject slots of samples: each magnetometer would have its own."""
        raise InputError(
            "magnetometer: slots of the samples of several are not supported; use records of marks"
        )

    def _add_epochs(
        self,
        samples: FieldSamples,
        static: StaticFields | None,  # noqa: ARG002
        after: float,
    ) -> int:
        """Add phasors on the log's clock; those of equal times are merged."""
        if any(np.isfinite(stream.samples.newest) for stream in self.streams):
            raise InputError(
                "fields: they are mixed with samples of the magnetometers; use only one of them for"
                " all magnetometers"
            )
        late = 0
        for one in samples.epochs():
            self._take_fields(one)
            if one.time[0] <= after:
                late += 1
            else:
                self._put(one)
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
            name: max(stream.samples.newest, self._fields_to.get(name, self.begun_at))
            for name, stream in self._named
        }

    @property
    def complete(self) -> float:
        """Time until which all have sent samples, or are not awaited any more (s)."""
        if not np.isfinite(self.begun_at):
            return -np.inf
        detected, silent = self._last_times(), self._silent()
        waited = min(to for name, to in detected.items() if name not in silent)
        return max(waited, self.imu.reached - MAX_WAIT)

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
    def next_field(self) -> float:
        """Time of the next fields (s), as far as is known."""
        silent = self._silent()
        live = [stream for name, stream in self._named if stream.windows or name not in silent]
        known = [float(samples.time[0]) for samples in self.fields[:1]]
        centres = [stream.next_centre for stream in live]
        return min([*known, *centres, self._next_arrival], default=np.inf)

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
        for name, stream in self._named:
            counts = stream.dropped
            counts["window too late"] = stream.late
            counts["sample too late"] = stream.samples.late
            counts["epoch while it was silent"] = self.without[name]
            result |= {f"magnetometer {name}: {k}": v for k, v in counts.items() if v}
        return result

    # Processing

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
        waves = {}
        for sensor, stream in zip(self.sensors, self.streams, strict=True):
            wave = stream.waveform
            wave = wave.rows(wave.time <= until)
            if len(wave):
                time, marks = wave.time - sensor.clock_offset, stream.receiver.marks
                waves[sensor.name] = Waveform(time, wave.measured_sensor, marks)
        return find_online_start(
            self.site,
            self.imu.measured(end=until - self.imu.offset),
            Buffer("magnetometer", 3),
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
        self._keep_from(self._looked - kept)

    def _begin_receivers(self, start: OnlineStart, delay: float) -> None:
        for name, stream in self._named:
            if isinstance(stream.receiver, LockinReceiver):
                stream.receiver.extra_lines = start.lines.get(name)
        self.discard_before(start.state.time)
        self.receive(start.state, delay)

    def receive(self, state: State, delay: float) -> None:
        """Check the windows of each that are complete and within a delay (s)."""
        self._delay = delay
        imu, offset = self.imu.measured(), self.imu.offset
        for k, stream in enumerate(self.streams):
            stream.begin_late(imu)
            until = min(self.awaited, stream.samples.newest) - delay
            result = stream.receive(imu, until, self.last_epoch, state, offset)
            if result is None:
                continue
            for one in self._as_channels_of_all({k: result}).epochs():
                self._put(one)
        self.fields.sort(key=lambda s: float(s.time[0]))

    def _as_channels_of_all(self, result: dict[int, FieldSamples]) -> FieldSamples:
        """Return the fields of some magnetometers as channels of all."""
        none = FieldSamples.empty(self.streams[0].receiver.site.channels)
        return side_by_side([result.get(k, none) for k in range(len(self.streams))], self.site)

    def next_window(self, _state: State, _needs_separate: Callable[[State], bool]) -> float | None:
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

    def fill_silence(self, state: State, time: float) -> None:
        """Do nothing where the IMU is silent: no single magnetometer's samples replace it."""

    # Output

    def _demodulated(
        self, before: State, predicted: State, *, is_lost: bool
    ) -> MotionCompensated | None:
        """Return the windows at a prediction, each of its own magnetometer; None for none."""
        if self._centre != predicted.time:
            return None
        half = 0.5 * max(s.receiver.grid.length for s in self.streams if s.receiver.grid)
        begin, end = min(before.time, predicted.time - half), predicted.time + half
        imu, offset = self.imu.filled(begin - MARGIN, end + MARGIN), self.imu.offset
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
