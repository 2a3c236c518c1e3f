"""Receiver of coils that a host drives in turn and marks in the log: marked bursts."""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import WindowGrid, Windows, sample_rate_hz
from magfusion.receiver.cycles import cycles
from magfusion.receiver.marked_bursts import LATE, MAX_BURST, Bursts
from magfusion.receiver.slot_phasors import SlotValues
from magfusion.receiver.slot_receiver import MIN_SHARE_OF_SLOT, SlotReceiver
from magfusion.receiver.slots import (
    MIN_CYCLES,
    MIN_SAMPLES,
    SlotSettings,
    carriers_hz,
    check_kept,
    history_of,
    is_pulsed,
    owners,
    places,
    slot_settings_of,
)
from magfusion.receiver.turn import Turn
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, IntArray

TOO_SHORT = "burst too short for its tone"
OUTSIDE = "burst outside of the samples"
MEMORY = 2.0  # s; age up to which a burst contributes to the noise and the ambient field
MAX_WAIT = 0.5  # s; largest delay of marks after their samples
ROUNDING = 1e-8  # s; of a stamp


class MarkedReceiver(SlotReceiver):
    """Receiver that makes each burst a row at its own time; a short cycle is one epoch."""

    bursts: Bursts
    _reached: float

    def __init__(self, site: Site, settings: LockinSettings | SlotSettings | None = None) -> None:
        super().__init__(site, settings)
        self.bursts, self._reached = Bursts(site), -np.inf

    @property
    def history_length(self) -> int:
        """Number of bursts for which an admitted one is needed, unless they are too old."""
        return history_of(self.site, self.settings) * places(self.site)

    @property
    def history(self) -> float:
        """As of `Receiver.history`."""
        return 0.0 if self.grid is None else MEMORY + MAX_WAIT + MAX_BURST

    @property
    def marks(self) -> Marks | None:
        """Stored bursts."""
        return self.bursts.marks

    def add_marks(self, marks: Marks) -> None:
        """Add bursts, as `Receiver.add_marks`."""
        self.bursts.add(marks)

    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Add the bursts that the slots of samples complete, as `Receiver.add_slots`."""
        self.bursts.add(self.bursts.column.add_samples(time, slot))

    def discard_marks(self, before: float) -> None:
        """Discard bursts, as `Receiver.discard_marks`."""
        self.bursts.discard_before(self.bursts.first_after(before))

    def check(self) -> None:
        """Reject beacons that are not all marked, as `Receiver.check`."""
        check_kept(self.site)
        slot_settings_of(self.site, None if isinstance(self._given, SlotSettings) else self._given)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Start at the first burst within the samples, as `Receiver.begin`."""
        check_kept(self.site)
        rate_hz = sample_rate_hz(waveform)
        highest = float(np.max(carriers_hz(self.site, places(self.site))))
        if highest > 0.45 * rate_hz:
            raise InputError(
                f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for the carrier at"
                f" {highest:g} Hz; at least {highest / 0.45:.4g} Hz are needed"
            )
        if len(self.bursts) == 0 and waveform.marks is not None:
            self.bursts.add(waveform.marks)
        if len(self.bursts) == 0:
            raise InputError(
                "magnetometer: the site's slots are marked, but the log has no marks; give each"
                " sample its slot, or a table of marks with start_ns, end_ns and slot"
            )
        self.next_number = self.bursts.first_after(float(waveform.time[0]) - LATE / rate_hz)
        # The plateau of a pulse is not saturation.
        clips = not is_pulsed(self.site)
        self._begin(waveform, imu, WindowGrid(0.0, 0.0, 0.0), MIN_SHARE_OF_SLOT, clips=clips)
        assert self.admission is not None
        self.admission.slack = 1

    def _admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Return admitted windows; count also the bursts without samples."""
        self.begin(waveform, imu)
        before = self.next_number - self.bursts.first
        result = self.admit(waveform, imu)
        behind = self.bursts.first + len(self.bursts) - self.next_number
        self._count(OUTSIDE, before + behind)
        return result

    def admit(self, waveform: Waveform, imu: ImuSamples, until: float | None = None) -> Windows:
        """Omit also the bursts that are too short for their tone, as `Receiver.admit`."""
        result = super().admit(waveform, imu, until)
        turns = result.length * carriers_hz(self.site, places(self.site))[result.place]
        short = (turns < MIN_CYCLES) & (turns > 0.0) | (result.count < MIN_SAMPLES)
        self._count(TOO_SHORT, int(np.sum(short)))
        return result.rows(~short)

    def centre_of(self, number: int) -> float:
        """Return the middle of a burst (s), or its earliest value if not known yet."""
        centre = self.bursts.next_centre(number)
        known = number < self.bursts.first + len(self.bursts)
        return centre if known else max(centre, self._reached - MAX_WAIT)

    def _last(self, until: float) -> int:
        assert self.admission is not None
        self._reached = max(self._reached, until)
        late = LATE * self.admission.magnetometer_step
        return self.bursts.last(until + late, self.next_number)

    def _last_of_log(self, waveform: Waveform) -> int:
        assert self.admission is not None
        late = LATE * self.admission.magnetometer_step
        return self.bursts.until(float(waveform.time[-1]) + late)

    def _windows(self, number: IntArray, time: Array) -> Windows:
        marks, centre, place = self.bursts.rows(number)
        first = np.searchsorted(time, marks.begin - ROUNDING)
        count = np.searchsorted(time, marks.end - ROUNDING) - first
        return Windows(number, centre, first, count, marks.end - marks.begin, place)

    def _known(self, new: Windows) -> IntArray:
        """Discard old bursts and their marks."""
        known = super()._known(new)
        if len(new):
            centre = self.bursts.rows(known)[1]
            known = known[centre > new.centre[0] - MEMORY]
        # The burst before the first one limits how far back samples are needed.
        self.bursts.discard_before(min([*known[:1].tolist(), self.next_number]) - 1)
        return known

    def _joined(self, result: FieldSamples, number: IntArray, turn: Turn) -> FieldSamples:
        return cycles(result, turn, self.site, self.bursts.epochs(number))

    def _fit_slots(
        self, waveform: Waveform, turn: Turn, windows: Windows, site: Site
    ) -> SlotValues:
        """Fit bursts from their first sample to the last.

        A taper not aligned with the samples leaks carrier power into the noise estimate.
        """
        assert self.admission is not None
        begin = waveform.time[windows.first]
        last = waveform.time[windows.first + windows.count - 1]
        length = last - begin + self.admission.magnetometer_step
        fitted = replace(windows, centre=begin + 0.5 * length, length=length)
        return super()._fit_slots(waveform, turn, fitted, site)

    def _driven(self, windows: Windows) -> BoolArray:
        return np.asarray(owners(self.site, places(self.site))[windows.place] >= 0)

    def _follow(self, waveform: Waveform) -> None:
        """Keep the bursts where they are marked."""
