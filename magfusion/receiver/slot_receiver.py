"""Receiver of coils in time slots: each slot a row at its own time, assessed by cycles."""

from dataclasses import replace
from functools import cached_property, reduce

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import ROUNDING, WindowGrid, Windows, sample_rate_hz
from magfusion.receiver.cycles import cycles, joins
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.slot_phasors import SlotValues, demodulate_slots, slot_values
from magfusion.receiver.slot_timing import (
    check_timing_declared,
    informative_share,
    is_searched,
    slot_start,
)
from magfusion.receiver.slots import (
    SlotSettings,
    check_carriers,
    driven_slots,
    history_of,
    is_pulsed,
    schedule,
    slot_settings_of,
)
from magfusion.receiver.turn import Turn, slot_turn_of
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, IntArray

MIN_SHARE_OF_SLOT = 0.9  # of the samples of a slot, which has few columns
FOLLOWED_EVERY = 0.2  # s; clocks that are 100 ppm apart drift by 20 us


class SlotReceiver(Receiver):
    """Receiver of coils driven in turn: each slot a row at its own time, assessed by cycles."""

    _values: SlotValues  # that the phasors of later slots need
    _followed: float  # when the grid was last compared with the stream (s)

    def __init__(self, site: Site, settings: LockinSettings | SlotSettings | None = None) -> None:
        super().__init__(site)
        self._given, self._values = settings, SlotValues.none()
        self._followed = -np.inf

    @cached_property
    def settings(self) -> SlotSettings:
        """Removal and taper, chosen from the drives if not given."""
        given = self._given
        return given if isinstance(given, SlotSettings) else slot_settings_of(self.site, given)

    @property
    def history_length(self) -> int:
        """Number of slots to whose ambient field and noise an admitted one contributes."""
        return history_of(self.site, self.settings) * schedule(self.site).count

    def check(self) -> None:
        """Reject a schedule that not all coils keep, as `Receiver.check`."""
        schedule(self.site)
        check_timing_declared(self.site)
        slot_settings_of(self.site, None if isinstance(self._given, SlotSettings) else self._given)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Set up slots from the first whole one of the schedule, as `Receiver.begin`."""
        slots = schedule(self.site)
        rate_hz = sample_rate_hz(waveform)
        check_timing_declared(self.site)
        check_carriers(self.site, rate_hz, self.settings)
        if is_searched(self.site):
            start = slot_start(waveform, self.site, rate_hz)
            if start is None:
                raise InputError(
                    "magnetometer: the time slots are not found in the stream; bring the sensor"
                    " closer, or give the log's clock (synchronised: true, with start_s)"
                )
            slots, self._followed = replace(slots, start=start), float(waveform.time[-1])
        grid = WindowGrid(
            centre=slots.start + 0.5 * slots.duration,
            step=slots.duration,
            length=slots.duration,
            early=0.5 / rate_hz,
            rounding=ROUNDING * slots.duration,
            together=slots.count,
        )
        elapsed = float(waveform.time[0]) - 1.0 / rate_hz - slots.start
        self.next_number = int(np.ceil(elapsed / slots.duration + ROUNDING))
        # The plateau of a pulse is not saturation.
        clips = not is_pulsed(self.site)
        self._begin(waveform, imu, grid, MIN_SHARE_OF_SLOT, clips=clips)

    def _admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Track searched slots through a whole log, as through a stream."""
        if not is_searched(self.site):
            return super()._admitted(waveform, imu)
        time, refusal, parts = waveform.time, None, [Windows.none()]
        span = informative_share(schedule(self.site))
        ends = np.searchsorted(time, np.arange(time[0] + span, time[-1], span))
        for end in np.append(ends, len(time)).tolist():
            newest = float(time[end - 1])
            rows = slice(int(np.searchsorted(time, newest - 1.01 * span)), end)
            look = waveform.rows(rows)
            if self.grid is None:
                # Before the first detection there is no grid to number slots by.
                try:
                    self.begin(look, imu)
                except InputError as error:
                    refusal = error
                    continue
            self._follow(look)
            come = waveform.rows(slice(end))
            own, inertial = self._samples_from(come, imu, None, self.next_number)
            result = self.admit(own, inertial, None if end == len(time) else newest)
            parts.append(replace(result, first=result.first + end - len(own)))
        if self.grid is None and refusal is not None:
            raise refusal
        return reduce(Windows.joined, parts)

    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of driven slots less the ambient field of the silent ones."""
        turn = slot_turn_of(imu, site)
        values = self._fit_slots(waveform, turn, windows, site)
        return demodulate_slots(values, turn, site, self.settings)

    def pushed(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, first_number: int
    ) -> tuple[FieldSamples, int]:
        """Return the phasors of slots from a number on, as `Receiver.pushed`."""
        turn = slot_turn_of(imu, self.site)
        same = self._values.number[:, None] == windows.number
        known = self._values.rows(np.any(same, axis=1))
        fresh = windows.rows(~np.any(same, axis=0))
        self._values = known.joined(self._fit_slots(waveform, turn, fresh, self.site))
        result, number = demodulate_slots(self._values, turn, self.site, self.settings)
        number, result = number[number >= first_number], result.rows(number >= first_number)
        seen = len(result)
        if seen and self.joined and not self.site.platform.magnetometer.lacking:
            result = self._joined(result, number, turn)
        return result, seen

    def _joined(self, result: FieldSamples, number: IntArray, turn: Turn) -> FieldSamples:  # noqa: ARG002
        """Join the slots of each cycle to one epoch, where it is short."""
        return cycles(result, turn, self.site) if joins(self.site) else result

    def _follow(self, waveform: Waveform) -> None:
        """Move the slots half-way to their position in the stream, as one estimate is noisy."""
        newest = float(waveform.time[-1])
        if newest < self._followed + FOLLOWED_EVERY or not is_searched(self.site):
            return
        assert self.grid is not None
        assert self.admission is not None
        self._followed = newest
        start = slot_start(waveform, self.site, 1.0 / self.admission.magnetometer_step)
        if start is not None:
            cycle, centre = self.grid.step * self.grid.together, self.grid.centre
            late = (start + 0.5 * self.grid.step - centre + 0.5 * cycle) % cycle - 0.5 * cycle
            if abs(late) < 0.5 * self.grid.step:
                self.grid = replace(self.grid, centre=centre + 0.5 * late)

    def _fit_slots(
        self, waveform: Waveform, turn: Turn, windows: Windows, site: Site
    ) -> SlotValues:
        assert self.admission is not None
        rate_hz = 1.0 / self.admission.magnetometer_step
        return slot_values(waveform, turn, site, self.settings, windows, rate_hz)

    def _driven(self, windows: Windows) -> BoolArray:
        return driven_slots(self.site, windows.number)

    def _growth(self, windows: Windows, time: Array) -> Array:  # noqa: ARG002
        """Return one: the few columns of a slot remain separable without a few samples."""
        return np.ones(len(windows))
