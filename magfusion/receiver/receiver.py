"""The receiver: a magnetometer's samples, pushed as they come or all at once, to phasors.

Of tones that are sent at once, `LockinReceiver`; of time slots, `SlotReceiver`.  Which windows are
used `magfusion.receiver.admission` says, for both and whatever the size of the pieces.
"""

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import replace
from functools import cached_property, reduce

import numpy as np

from magfusion.errors import InputError
from magfusion.model.marks import Marks
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import (
    INERTIAL_GAP,
    REASONS,
    ROUNDING,
    Admission,
    Grid,
    Windows,
    sample_rate_hz,
    usual_step,
)
from magfusion.receiver.cells import owned_by
from magfusion.receiver.cycles import cycles, joins
from magfusion.receiver.design import Designs, separable, variance_growth
from magfusion.receiver.lockin import WindowOperator, designs_of, window_operator
from magfusion.receiver.slot_phasors import SlotValues, demodulate_slots, slot_values
from magfusion.receiver.slot_timing import check_told, heard_for, is_searched, slot_start
from magfusion.receiver.slots import (
    SlotSettings,
    check_carriers,
    driven_slots,
    has_schedule,
    history_of,
    is_marked,
    is_pulsed,
    schedule,
    slot_lockin,
    slot_settings_of,
)
from magfusion.receiver.turn import Turn, on_clock, slot_turn_of
from magfusion.receiver.windows import LockinSettings, default_settings, sent_frequencies_hz
from magfusion.units import Array, BoolArray, IntArray

NO_SILENT_SLOT = "no silent slot beside it"
# Of the samples of a window: its design tells whether they suffice; of a slot: it has few columns.
LEAST_SHARE, LEAST_SHARE_OF_SLOT = 0.5, 0.9
FOLLOWED_EVERY = 0.2  # s; clocks that are 100 ppm apart drift by 20 us
INERTIAL_MARGIN = 0.1  # s; by which their clocks may be apart, and before a window
BEFORE = 256  # samples before a window, among which an axis that keeps one value is seen to


class Receiver(ABC):
    """Windows of a waveform, each admitted or dropped once, and their phasors.

    Attributes
    ----------
    grid : Grid, optional
        Where the windows lie, once it has begun.
    next_number : int
        Of the window that is judged next.
    recent : int ndarray
        Numbers of windows that were admitted and that the phasors of later ones need.
    dropped : Counter
        Reason to number of windows.
    needs_turn : bool
        Whether windows without inertial samples are of no use.
    joined : bool
        Whether the slots of a short cycle that are pushed are one epoch.
    without_turn : Windows
        Of those that were judged last, which lack nothing else.
    """

    grid: Grid | None
    admission: Admission | None
    next_number: int
    recent: IntArray
    dropped: Counter[str]
    needs_turn: bool
    joined: bool
    without_turn: Windows

    def __init__(self, site: Site) -> None:
        self.needs_turn, self.joined = True, False
        self.without_turn = Windows.none()
        self.site = site
        self.grid = self.admission = None
        self.next_number = 0
        self.recent = np.zeros(0, dtype=np.int64)
        self.dropped = Counter()

    @staticmethod
    def of(site: Site, settings: LockinSettings | SlotSettings | None = None) -> "Receiver":
        """Return the receiver for the drives of a site.

        Parameters
        ----------
        settings : LockinSettings or SlotSettings, optional
            None chooses them by the tones or the time slots.
        """
        if is_marked(site):
            from magfusion.receiver.marked import MarkedReceiver

            return MarkedReceiver(site, settings)
        if isinstance(settings, SlotSettings) or has_schedule(site):
            return SlotReceiver(site, settings)
        return LockinReceiver(site, settings)

    @property
    @abstractmethod
    def remembered(self) -> int:
        """For how many windows one that was admitted is needed."""

    @property
    def history(self) -> float:
        """How much older than a window's centre the samples are that its phasors need (s)."""
        if self.grid is None:
            return 0.0
        return self.grid.length + (self.remembered + self.grid.together) * self.grid.step

    @abstractmethod
    def check(self) -> None:
        """Refuse drives that cannot be separated, and settings that do not suit them.

        Raises
        ------
        InputError
        """

    def lockin(self) -> "LockinReceiver":
        """Return this receiver where its windows leave a steady field, the Earth's.

        Raises
        ------
        InputError
            Where it is of time slots.
        """
        if isinstance(self, LockinReceiver):
            return self
        raise InputError(
            "of coils in time slots the Earth field is taken off with the silent slots; leave"
            " --earth out"
        )

    @abstractmethod
    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay the grid by the first samples.

        Raises
        ------
        InputError
            Where the sampling rate does not suit the drives, or a stream has less than two samples.
        """

    @abstractmethod
    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of windows at what is known, and the number of each row's window.

        Parameters
        ----------
        imu : ImuSamples
            As from `magfusion.receiver.turn.on_clock`.
        site : Site
            With the calibration of the magnetometer.
        """

    def pushed(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, since: int
    ) -> tuple[FieldSamples, int]:
        """Return the phasors of windows from a number on, and how many windows they are of.

        Parameters
        ----------
        windows : Windows
            With those before that they need.
        """
        found, number = self.phasors(waveform, imu, windows, self.site)
        found = found.rows(number >= since)
        return found, len(found)

    @property
    def marks(self) -> Marks | None:
        """The bursts that are kept; None of drives that keep to a clock."""
        return None

    def hear_marks(self, marks: Marks) -> None:  # noqa: B027
        """Take bursts as they were marked; drives that keep to a clock need none.

        Raises
        ------
        InputError
            Where they do not follow those that came, or a slot is of no coil.
        """

    def hear_slots(self, time: Array, slot: IntArray) -> None:  # noqa: B027
        """Take the slots beside samples, as `hear_marks`."""

    def forget_marks(self, before: float) -> None:  # noqa: B027
        """Drop the bursts before a time (s), as long as none is judged."""

    def _follow(self, waveform: Waveform) -> None:  # noqa: B027
        """Bring the grid to where the stream shows it."""

    @abstractmethod
    def _driven(self, windows: Windows) -> BoolArray:
        """Tell which windows lead to a row of phasors."""

    @abstractmethod
    def _growth(self, windows: Windows, time: Array) -> Array:
        """Return what missing samples do to the variance of phasors, as of `Growth`."""

    def push(
        self,
        waveform: Waveform,
        imu: ImuSamples,
        until: float,
        gyro_bias_body: Array | None = None,
        time_offset: float | None = None,
    ) -> FieldSamples:
        """Return the phasors of the windows that have become complete.

        Parameters
        ----------
        waveform : Waveform
            With all samples of these windows, and since so long before as `history` says.
        imu : ImuSamples
            Likewise.
        until : float
            When what has come ends (s).
        gyro_bias_body, time_offset
            As of `magfusion.receiver.turn.on_clock`; the offset is the site's where none is given.
        """
        assert self.grid is not None
        self._follow(waveform)
        new = self.admit(*self._since(waveform, imu, time_offset, self.next_number), until)
        known = self._known(new)
        oldest = min([*known[:1].tolist(), self.next_number])
        waveform, imu = self._since(waveform, imu, time_offset, oldest)
        expected = int(np.sum(self._driven(new)))
        self.recent = known[known >= self.next_number - self.remembered]
        if expected == 0:
            return FieldSamples.empty(self.site.channels)
        windows = self._windows(known, waveform.time)
        offset = self.site.platform.imu.time_offset if time_offset is None else time_offset
        known_imu = on_clock(imu, offset, gyro_bias_body)
        found, seen = self.pushed(waveform, known_imu, windows, int(new.number[0]))
        self._count(NO_SILENT_SLOT, expected - seen)
        return found

    def whole(self, waveform: Waveform, imu: ImuSamples) -> tuple[Windows, FieldSamples]:
        """Return the usable windows of a whole log, and their phasors.

        Raises
        ------
        InputError
            Where no window is usable.
        """
        if len(imu):
            imu = initial_calibration(self.site, 0.0, float(imu.time[0])).on_log_rate(imu)
        windows = self._admitted(waveform, imu)
        expected = int(np.sum(self._driven(windows)))
        if expected == 0:
            raise self._none_usable()
        known = on_clock(imu, self.site.platform.imu.time_offset)
        found, _ = self.phasors(waveform, known, windows, self.site)
        self._count(NO_SILENT_SLOT, expected - len(found))
        if len(found) == 0:
            raise self._none_usable()
        return windows, found

    def _admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Begin, and return the usable windows of a whole log."""
        self.begin(waveform, imu)
        return self.admit(waveform, imu)

    def centre_of(self, number: int) -> float:
        """Return the centre of a window (s)."""
        assert self.grid is not None
        return self.grid.centre + self.grid.step * number

    def complete(self, until: float) -> bool:
        """Return whether there is a window to judge at a time (s)."""
        return self.grid is not None and self._last(until) >= self.next_number

    def _last(self, until: float) -> int:
        """Return the number of the last window that can be judged at a time (s)."""
        assert self.grid is not None
        return self.grid.last(until)

    def _last_of_log(self, waveform: Waveform) -> int:
        """Return the number of the last window that the samples of a whole log fill."""
        assert self.grid is not None
        assert self.admission is not None
        return self.grid.last_of_log(waveform.time, self.admission.magnetometer_step)

    def _windows(self, number: IntArray, time: Array) -> Windows:
        """Return windows by their numbers."""
        assert self.grid is not None
        return self.grid.windows(number, time)

    def _known(self, new: Windows) -> IntArray:
        """Return the numbers of windows that were admitted and may be needed, to the newest."""
        return np.concatenate([self.recent, new.number])

    def admit(self, waveform: Waveform, imu: ImuSamples, until: float | None = None) -> Windows:
        """Return the windows that have become complete and can be demodulated.

        Parameters
        ----------
        waveform, imu, until
            As of `push`; no time means the end of the log.
        """
        assert self.grid is not None
        assert self.admission is not None
        last = self._last_of_log(waveform) if until is None else self._last(until)
        number = np.arange(self.next_number, max(last + 1, self.next_number))
        self.next_number += len(number)
        windows = self._windows(number, waveform.time)
        # By the clock as declared: what is learnt of it later changes no verdict.
        stamps = imu.time + self.site.platform.imu.time_offset
        verdict = self.admission.verdicts(self.grid, windows, waveform, stamps, self._growth)
        counts = np.bincount(verdict + 1, minlength=len(REASONS) + 1)[1:]
        for reason, count in zip(REASONS, counts.tolist(), strict=True):
            self._count(reason, count)
        self.without_turn = windows.rows(verdict == REASONS.index(INERTIAL_GAP))
        return windows.rows(verdict < 0)

    def _since(
        self, waveform: Waveform, imu: ImuSamples, time_offset: float | None, number: int
    ) -> tuple[Waveform, ImuSamples]:
        """Return the samples that windows from a number on can need."""
        oldest = self.centre_of(number - 1)
        first = max(int(np.searchsorted(waveform.time, oldest)) - BEFORE, 0)
        offset = self.site.platform.imu.time_offset if time_offset is None else time_offset
        begin = max(int(np.searchsorted(imu.time, oldest - offset - INERTIAL_MARGIN)) - 1, 0)
        return (
            waveform.rows(slice(first, None)),
            ImuSamples(imu.time[begin:], imu.gyro_body[begin:], imu.accel_body[begin:]),
        )

    def _count(self, reason: str, dropped: int) -> None:
        if dropped:
            self.dropped[reason] += dropped

    def _begin(
        self,
        waveform: Waveform,
        imu: ImuSamples,
        grid: Grid,
        share: float,
        *,
        clips: bool,
    ) -> None:
        model = self.site.platform.imu
        stamps = imu.time + model.time_offset
        step = usual_step(stamps, "imu")
        self.grid = grid
        self.admission = Admission(
            magnetometer_step=usual_step(waveform.time, "magnetometer"),
            imu_step=step,
            imu_begin=float(stamps[0]),
            imu_margin=2.0 * step + 3.0 * model.time_offset_sigma,
            clips=clips,
            needs_turn=self.needs_turn,
            least_share=share,
        )

    def _none_usable(self) -> InputError:
        assert self.grid is not None
        slots = has_schedule(self.site)
        one, remedy = ("slot", "") if slots else ("window", ", or choose a shorter window")
        one += f" of {self.grid.length:g} s" if self.grid.length else ""
        reasons = "; ".join(f"{k}: {v}" for k, v in self.dropped.items())
        return InputError(
            f"magnetometer: no {one} is usable"
            f" ({reasons or 'the log is too short'}); record longer{remedy}"
        )


class LockinReceiver(Receiver):
    """Of tones that are sent at once: windows that overlap, long against the motion."""

    remembered = 0
    # With the lines that were found beside the tones; of a checkpoint, as the others are.
    beside: LockinSettings | None

    def __init__(self, site: Site, settings: LockinSettings | None = None) -> None:
        super().__init__(site)
        self._given, self.beside = settings, None
        self._designs: Designs | None = None

    @property
    def settings(self) -> LockinSettings:
        """Window and step, chosen by the tones where they were not given."""
        return self._chosen if self.beside is None else self.beside

    @cached_property
    def _chosen(self) -> LockinSettings:
        return default_settings(self.site) if self._given is None else self._given

    @cached_property
    def _sent(self) -> Array:
        return sent_frequencies_hz(self.site)

    def check(self) -> None:
        """Refuse tones that cannot be separated, as `Receiver.check`."""
        sent_frequencies_hz(self.site)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay windows from the first sample on, as `Receiver.begin`."""
        rate_hz = sample_rate_hz(waveform)
        frequencies = self._sent
        highest = float(np.max(frequencies))
        if highest > 0.45 * rate_hz:
            raise InputError(
                f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for the tone at {highest:g}"
                f" Hz; at least {highest / 0.45:.4g} Hz are needed"
            )
        window = self.settings.window
        if not separable(1.0 / rate_hz, self.settings, frequencies):
            raise InputError(
                f"magnetometer: {window * rate_hz:.3g} samples in a window of {window:.3g} s are"
                " too few to tell tones, drift and steady field apart; choose a longer"
                f" window (--window), or sample faster than at {rate_hz:.4g} Hz"
            )
        grid = Grid(
            centre=self.settings.first_centre(float(waveform.time[0]) - 0.5 / rate_hz),
            step=self.settings.step,
            length=window,
            wait=-0.6 / rate_hz,  # the last sample is half a step earlier
        )
        self._begin(waveform, imu, grid, LEAST_SHARE, clips=True)

    def whole(self, waveform: Waveform, imu: ImuSamples) -> tuple[Windows, FieldSamples]:
        """Return windows and phasors as `Receiver.whole`, each phasor of one beacon."""
        windows, found = super().whole(waveform, imu)
        return windows, owned_by(found, self.site)

    def sent(self, waveform: Waveform, imu: ImuSamples) -> FieldSamples:
        """Return what is received of each channel, of whichever beacon on its frequency."""
        return super().whole(waveform, imu)[1]

    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of windows without what is known of the motion but the turns."""
        operator = self.operator(waveform, imu, windows, site)
        return operator.demodulate(waveform.measured_sensor)[0], windows.number

    def operator(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> WindowOperator:
        """Return the map from a waveform to phasors, as of `window_operator`.

        What is made of the sample times alone is kept until others come.
        """
        known = self._designs
        if known is None or known.windows is not windows or known.time is not waveform.time:
            known = self._designs = designs_of(waveform, site, self.settings, windows)
        return window_operator(waveform, imu, site, self.settings, windows, designs=known)

    def _driven(self, windows: Windows) -> BoolArray:
        return np.ones(len(windows), dtype=bool)

    def _growth(self, windows: Windows, time: Array) -> Array:
        assert self.admission is not None
        frequencies = self._sent
        step = self.admission.magnetometer_step
        return variance_growth(windows, time, step, self.settings, frequencies)


class SlotReceiver(Receiver):
    """Of coils driven in turn: each slot a row at its own time, judged by whole cycles."""

    _values: SlotValues  # of those that the phasors of later ones need
    _followed: float  # when the grid was last compared with the stream (s)

    def __init__(self, site: Site, settings: LockinSettings | SlotSettings | None = None) -> None:
        super().__init__(site)
        self._given, self._values = settings, SlotValues.none()
        self._followed = -np.inf

    @cached_property
    def settings(self) -> SlotSettings:
        """Removal and taper, chosen by the drives where they were not given."""
        given = self._given
        return given if isinstance(given, SlotSettings) else slot_settings_of(self.site, given)

    @property
    def remembered(self) -> int:
        """For how many slots one that was admitted tells the ambient field and the noise."""
        return history_of(self.site, self.settings) * schedule(self.site).count

    def check(self) -> None:
        """Refuse a schedule that not all coils keep, as `Receiver.check`."""
        schedule(self.site)
        check_told(self.site)
        slot_settings_of(self.site, None if isinstance(self._given, SlotSettings) else self._given)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay slots by the schedule, from the first that is whole, as `Receiver.begin`."""
        slots = schedule(self.site)
        rate_hz = sample_rate_hz(waveform)
        check_told(self.site)
        check_carriers(self.site, rate_hz, self.settings)
        if is_searched(self.site):
            start = slot_start(waveform, self.site, rate_hz)
            if start is None:
                raise InputError(
                    "magnetometer: the time slots are not found in the stream; bring the sensor"
                    " nearer, or give the log's clock (synchronised: true, with start_s)"
                )
            slots, self._followed = replace(slots, start=start), float(waveform.time[-1])
        grid = Grid(
            centre=slots.start + 0.5 * slots.duration,
            step=slots.duration,
            length=slots.duration,
            early=0.5 / rate_hz,
            rounding=ROUNDING * slots.duration,
            together=slots.count,
        )
        elapsed = float(waveform.time[0]) - 1.0 / rate_hz - slots.start
        self.next_number = int(np.ceil(elapsed / slots.duration + ROUNDING))
        # The plateau of a pulse is no saturation.
        clips = not is_pulsed(self.site)
        self._begin(waveform, imu, grid, LEAST_SHARE_OF_SLOT, clips=clips)

    def _admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Follow slots that are searched through a whole log, as through a stream."""
        if not is_searched(self.site):
            return super()._admitted(waveform, imu)
        time, refusal, parts = waveform.time, None, [Windows.none()]
        span = heard_for(schedule(self.site))
        ends = np.searchsorted(time, np.arange(time[0] + span, time[-1], span))
        for end in np.append(ends, len(time)).tolist():
            newest = float(time[end - 1])
            rows = slice(int(np.searchsorted(time, newest - 1.01 * span)), end)
            look = waveform.rows(rows)
            if self.grid is None:
                # Where nothing is heard yet, there is nothing to count on from.
                try:
                    self.begin(look, imu)
                except InputError as error:
                    refusal = error
                    continue
            self._follow(look)
            come = waveform.rows(slice(end))
            own, inertial = self._since(come, imu, None, self.next_number)
            found = self.admit(own, inertial, None if end == len(time) else newest)
            parts.append(replace(found, first=found.first + end - len(own)))
        if self.grid is None and refusal is not None:
            raise refusal
        return reduce(Windows.joined, parts)

    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of driven slots, freed of what the silent ones tell."""
        turn = slot_turn_of(imu, site)
        values = self._held(waveform, turn, windows, site)
        return demodulate_slots(values, turn, site, self.settings)

    def pushed(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, since: int
    ) -> tuple[FieldSamples, int]:
        """Return the phasors of slots from a number on, as `Receiver.pushed`."""
        turn = slot_turn_of(imu, self.site)
        same = self._values.number[:, None] == windows.number
        known = self._values.rows(np.any(same, axis=1))
        fresh = windows.rows(~np.any(same, axis=0))
        self._values = known.joined(self._held(waveform, turn, fresh, self.site))
        found, number = demodulate_slots(self._values, turn, self.site, self.settings)
        number, found = number[number >= since], found.rows(number >= since)
        seen = len(found)
        if seen and self.joined and not self.site.platform.magnetometer.lacking:
            found = self._joined(found, number, turn)
        return found, seen

    def _joined(self, found: FieldSamples, number: IntArray, turn: Turn) -> FieldSamples:  # noqa: ARG002
        """Return the slots of each cycle as one epoch, where it is short."""
        return cycles(found, turn, self.site) if joins(self.site) else found

    def _follow(self, waveform: Waveform) -> None:
        """Bring the slots to where the stream shows them, half the way: a look is noisy."""
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

    def _held(self, waveform: Waveform, turn: Turn, windows: Windows, site: Site) -> SlotValues:
        assert self.admission is not None
        rate_hz = 1.0 / self.admission.magnetometer_step
        return slot_values(waveform, turn, site, self.settings, windows, rate_hz)

    def _driven(self, windows: Windows) -> BoolArray:
        return driven_slots(self.site, windows.number)

    def _growth(self, windows: Windows, time: Array) -> Array:  # noqa: ARG002
        """Return one: the few columns of a slot stay apart without a few samples."""
        return np.ones(len(windows))


def usual_lockin(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Return the window and step of a site where nothing else is asked: of slots, theirs.

    Raises
    ------
    InputError
        Where its drives cannot be separated.
    """
    return (slot_lockin if has_schedule(site) else default_settings)(site, mains_hz)


def received(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings | SlotSettings | None = None,
) -> tuple[FieldSamples, Counter[str]]:
    """Return the phasors of a whole waveform, and how many windows were dropped for which reason.

    Parameters
    ----------
    settings : LockinSettings or SlotSettings, optional
        As of `Receiver.of`.

    Raises
    ------
    InputError
        Where no window is usable.
    """
    receiver = Receiver.of(site, settings)
    _, found = receiver.whole(waveform, imu)
    return found, receiver.dropped
