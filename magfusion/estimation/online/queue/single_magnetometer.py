"""Input queue of a platform with one magnetometer."""

from collections.abc import Callable

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.stream_buffer import check_clock
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.online import NoStart, OnlineStart, find_online_start
from magfusion.estimation.online.queue.arrivals import MARGIN, Arrivals
from magfusion.estimation.online.queue.sensor_stream import SensorStream
from magfusion.estimation.online.queue.short_windows import ShortWindows
from magfusion.files.named_records import magnetometer_number
from magfusion.model.samples import FieldSamples, StaticFields
from magfusion.model.site import Site
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, IntArray


class SingleArrivals(Arrivals):
    """Streams of a platform with one magnetometer."""

    def __init__(self, site: Site, lockin: LockinSettings | None, *, short: bool) -> None:
        self.receiver = receiver_of(site, lockin)
        # Substitutes need a state; a whole log has one only in the smoother.
        self.receiver.needs_turn = not isinstance(self.receiver, LockinReceiver)
        self.receiver.joined = True
        self.stream = SensorStream(self.receiver, "magnetometer")
        super().__init__(site, [self.stream])
        self.short = ShortWindows.of(site, lockin) if short else None

    # Input

    def _add_samples(self, stamps: Array, samples: Array, magnetometer: str | None) -> None:
        magnetometer_number(self.site, magnetometer, "samples")
        check_clock("magnetometer", stamps, self.newest)
        self.stream.samples.add(stamps, samples)

    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Add the slots of samples, as `Navigator.add_slots`."""
        time = self.site.platform.on_drive_clock(time)
        check_clock("magnetometer", time, self.newest)
        self.receiver.add_slots(time, slot)

    def _add_epochs(self, samples: FieldSamples, static: StaticFields | None, after: float) -> int:
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
            if static is not None:
                self.static[float(one.time[0])] = static.rows(slice(i, i + 1))
        return late

    # Times

    @property
    def next_field(self) -> float:
        """Time of the next fields (s), as far as is known."""
        if self.fields:
            return float(self.fields[0].time[0])
        return min(self.stream.next_centre, self._next_arrival)

    @property
    def newest(self) -> float:
        """Newest stamp of all streams (s)."""
        return max(self.imu.newest, self._newest_field)

    @property
    def _newest_field(self) -> float:
        last = float(self.fields[-1].time[0]) if self.fields else -np.inf
        return max(last, self.stream.samples.newest)

    @property
    def window_to_come(self) -> bool:
        """Whether all samples of a window exist that awaits its inertial samples."""
        newest = self.stream.samples.newest
        short = self.short is not None and self.short.receiver.complete(newest)
        return short or self.stream.to_come

    @property
    def losses(self) -> dict[str, int]:
        """Numbers of unused windows and samples, by reason."""
        unseen, late = self.stream.unseen, self.stream.samples.late
        return {
            **self.stream.dropped,
            **({"window without inertial samples": unseen} if unseen else {}),
            **super().losses,
            **({"magnetometer sample too late": late} if late else {}),
        }

    # Processing

    def gathered(self, delay: float, span: float) -> float | None:
        """Return until when to search for a first state (s)."""
        reached = self.reached - delay
        return reached if reached - self.first >= span else None

    def first_state(
        self, until: float, settings: EstimatorSettings, *, diagnose: bool
    ) -> OnlineStart | NoStart:
        """Return the first state from the data so far, or why there is none."""
        return find_online_start(
            self.site,
            self.imu.measured(end=until - self.imu.offset + MARGIN),
            self.stream.samples,
            self.fields,
            list(self.static.values()),
            until,
            settings,
            self.receiver.marks,
            diagnose=diagnose,
        )

    def limit_history(self, kept: float) -> None:
        """Keep only the last so many seconds of everything."""
        self._keep_from(self.reached - kept)

    def _begin_receivers(self, start: OnlineStart, delay: float) -> None:
        if start.waveform is not None:
            if isinstance(self.receiver, LockinReceiver):
                self.receiver.extra_lines = start.extra_lines
            self.receiver.begin(start.waveform, self.imu.measured())
            if self.short is not None:
                self.short.receiver.fit_extra_lines(start.extra_lines)
                self.short.receiver.begin(start.waveform, self.imu.measured())
            self.receive(start.state, delay)
        self.discard_before(start.state.time)

    def receive(self, state: State, delay: float) -> None:
        """Check the windows that are complete and within a delay (s); demodulate slots."""
        until = min(self.awaited, self.stream.samples.newest) - delay
        if self.short is not None and self.short.receiver.complete(until):
            samples = self.stream.waveform, self.imu.measured()
            self.short.receive(*samples, until, self.last_epoch)
        if not self.receiver.complete(until):
            return
        imu, offset = self.imu.measured(), self.imu.offset
        # The first state has used windows, too.
        result = self.stream.receive(imu, until, self.last_epoch, state, offset)
        if result is not None:
            self.fields += result.epochs()

    def next_window(self, state: State, needs_separate: Callable[[State], bool]) -> float | None:
        """Advance to the next admitted window; return its centre (s), None for none.

        For close tones it is the next short window, as long as the state is certain enough.
        """
        stream = self.stream
        if self.short is not None:
            while stream.windows and stream.next_centre <= state.time:
                stream.windows.popleft()
            centre = None if needs_separate(state) else self.short.next_after(state.time)
            if centre is not None:
                return centre
        if not stream.windows:
            return None
        stream.now = stream.windows.popleft()
        return self.receiver.centre_of(stream.now)

    def fill_silence(self, state: State, time: float) -> None:
        """Substitute missing inertial samples from a state to a time (s), from the fields."""
        receiver, imu = self.receiver, self.imu
        if self.fields or not isinstance(receiver, LockinReceiver) or receiver.admission is None:
            return
        until, streams = time + receiver.settings.window / 2.0, (imu.buffer, self.stream.samples)
        if imu.reached >= self.awaited:  # what has not arrived yet is no silence
            until = min(until, imu.reached)
        imu.filler.fill(state, until, *streams, imu.offset, receiver.admission)

    # Output

    def _demodulated(
        self, before: State, predicted: State, *, is_lost: bool
    ) -> MotionCompensated | None:
        stream, receiver = self.stream, self.receiver
        if stream.now is None or receiver.centre_of(stream.now) != predicted.time:
            return None
        assert isinstance(receiver, LockinReceiver)
        half, offset = receiver.settings.window / 2.0, self.imu.offset
        begin, end = min(before.time, predicted.time - half), predicted.time + half
        imu = self.imu.filled(begin - MARGIN, end + MARGIN)
        blind = self.imu.is_filled(begin - offset, end - offset)
        return stream.demodulated(before, predicted, imu, offset, blind=blind, is_lost=is_lost)
