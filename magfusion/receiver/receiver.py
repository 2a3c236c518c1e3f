"""Receiver: magnetometer samples, pushed as they arrive or all at once, to phasors.

Common base of `LockinReceiver`, for simultaneous tones, and `SlotReceiver`, for time slots.
`magfusion.receiver.admission` selects the windows for both, independent of the size of the
pieces.
"""

from abc import ABC, abstractmethod
from collections import Counter

import numpy as np

from magfusion.errors import InputError
from magfusion.files.plausible import declared_range
from magfusion.model.marks import Marks
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import (
    INERTIAL_GAP,
    REASONS,
    Admission,
    WindowGrid,
    Windows,
    usual_step,
)
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.turn import on_clock
from magfusion.units import Array, BoolArray, IntArray

NO_SILENT_SLOT = "no silent slot beside it"
INERTIAL_MARGIN = 0.1  # s; for the offset of their clocks, and before a window
BEFORE = 256  # samples before a window, used to detect an axis that repeats one value


class Receiver(ABC):
    """Windows of a waveform, each admitted or dropped once, and their phasors."""

    grid: WindowGrid | None  # positions of the windows, once it has begun
    admission: Admission | None
    next_number: int  # number of the next window to assess
    recent: IntArray  # numbers of admitted windows that later phasors need
    dropped: Counter[str]  # number of windows by reason
    needs_turn: bool  # whether windows without inertial samples are dropped
    joined: bool  # whether the pushed slots of a short cycle are one epoch
    without_turn: Windows  # windows assessed last that lack only inertial samples

    def __init__(self, site: Site) -> None:
        self.needs_turn, self.joined = True, False
        self.without_turn = Windows.none()
        self.site = site
        self.grid = self.admission = None
        self.next_number = 0
        self.recent = np.zeros(0, dtype=np.int64)
        self.dropped = Counter()

    @property
    @abstractmethod
    def history_length(self) -> int:
        """Number of later windows for which an admitted one is needed."""

    @property
    def history(self) -> float:
        """Return how far before a window's centre its phasors need samples (s)."""
        if self.grid is None:
            return 0.0
        return self.grid.length + (self.history_length + self.grid.together) * self.grid.step

    @abstractmethod
    def check(self) -> None:
        """Reject drives that cannot be separated, and settings that do not suit them."""

    @abstractmethod
    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Set up the grid from the first samples.

        Raises InputError where the sampling rate does not suit the drives, or a stream has less
        than two samples.
        """

    @abstractmethod
    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of windows, and the number of each row's window.

        `imu`: as from `magfusion.receiver.turn.on_clock`. `site`: with the calibration of the
        magnetometer.
        """

    def pushed(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, first_number: int
    ) -> tuple[FieldSamples, int]:
        """Return the phasors of windows from a number on, and the number of these windows.

        `windows`: including the earlier ones that these need.
        """
        result, number = self.phasors(waveform, imu, windows, self.site)
        result = result.rows(number >= first_number)
        return result, len(result)

    @property
    def marks(self) -> Marks | None:
        """Stored bursts; None of drives with a schedule."""
        return None

    def add_marks(self, marks: Marks) -> None:  # noqa: B027
        """Add marked bursts; drives with a schedule ignore them.

        Raises InputError where they are not in order, or a slot has no coil.
        """

    def add_slots(self, time: Array, slot: IntArray) -> None:  # noqa: B027
        """Add the slots given per sample, as `add_marks`."""

    def discard_marks(self, before: float) -> None:  # noqa: B027
        """Discard the bursts before a time (s), as long as none has been assessed."""

    def _follow(self, waveform: Waveform) -> None:  # noqa: B027
        """Align the grid with the stream."""

    @abstractmethod
    def _driven(self, windows: Windows) -> BoolArray:
        """Return which windows lead to a row of phasors."""

    @abstractmethod
    def _growth(self, windows: Windows, time: Array) -> Array:
        """Return the growth of phasors' variance by missing samples, as `Growth`."""

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
            All samples of these windows, and before them back to `history`.
        imu : ImuSamples
            Likewise.
        until : float
            End of the received data (s).
        gyro_bias_body, time_offset
            As of `magfusion.receiver.turn.on_clock`; the offset defaults to the site's.
        """
        assert self.grid is not None
        self._follow(waveform)
        new = self.admit(*self._samples_from(waveform, imu, time_offset, self.next_number), until)
        known = self._known(new)
        oldest = min([*known[:1].tolist(), self.next_number])
        waveform, imu = self._samples_from(waveform, imu, time_offset, oldest)
        expected = int(np.sum(self._driven(new)))
        self.recent = known[known >= self.next_number - self.history_length]
        if expected == 0:
            return FieldSamples.empty(self.site.channels)
        windows = self._windows(known, waveform.time)
        offset = self.site.platform.imu.time_offset if time_offset is None else time_offset
        known_imu = on_clock(imu, offset, gyro_bias_body)
        result, seen = self.pushed(waveform, known_imu, windows, int(new.number[0]))
        self._count(NO_SILENT_SLOT, expected - seen)
        return result

    def whole(self, waveform: Waveform, imu: ImuSamples) -> tuple[Windows, FieldSamples]:
        """Return the usable windows of a whole log, and their phasors.

        Raises InputError where no window is usable.
        """
        if len(imu):
            imu = initial_calibration(self.site, 0.0, float(imu.time[0])).on_log_rate(imu)
        windows = self._admitted(waveform, imu)
        expected = int(np.sum(self._driven(windows)))
        if expected == 0:
            raise self._none_usable()
        known = on_clock(imu, self.site.platform.imu.time_offset)
        result, _ = self.phasors(waveform, known, windows, self.site)
        self._count(NO_SILENT_SLOT, expected - len(result))
        if len(result) == 0:
            raise self._none_usable()
        return windows, result

    def _admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Begin, and return the usable windows of a whole log."""
        self.begin(waveform, imu)
        return self.admit(waveform, imu)

    def centre_of(self, number: int) -> float:
        """Return the centre of a window (s)."""
        assert self.grid is not None
        return self.grid.centre + self.grid.step * number

    def complete(self, until: float) -> bool:
        """Return whether a window can be assessed at a time (s)."""
        return self.grid is not None and self._last(until) >= self.next_number

    def _last(self, until: float) -> int:
        """Return the number of the last window that can be assessed at a time (s)."""
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
        """Return the numbers of admitted windows that may still be needed, to the newest."""
        return np.concatenate([self.recent, new.number])

    def admit(self, waveform: Waveform, imu: ImuSamples, until: float | None = None) -> Windows:
        """Return the windows that have become complete and can be demodulated.

        `waveform`, `imu`, `until`: as of `push`; no time means the end of the log.
        """
        assert self.grid is not None
        assert self.admission is not None
        last = self._last_of_log(waveform) if until is None else self._last(until)
        number = np.arange(self.next_number, max(last + 1, self.next_number))
        self.next_number += len(number)
        windows = self._windows(number, waveform.time)
        # With the declared clock: a later estimate of it changes no decision.
        stamps = imu.time + self.site.platform.imu.time_offset
        largest = declared_range("magnetometer", self.site.platform)
        verdict = self.admission.verdicts(
            self.grid, windows, waveform, stamps, self._growth, largest
        )
        counts = np.bincount(verdict + 1, minlength=len(REASONS) + 1)[1:]
        for reason, count in zip(REASONS, counts.tolist(), strict=True):
            self._count(reason, count)
        self.without_turn = windows.rows(verdict == REASONS.index(INERTIAL_GAP))
        return windows.rows(verdict < 0)

    def _samples_from(
        self, waveform: Waveform, imu: ImuSamples, time_offset: float | None, number: int
    ) -> tuple[Waveform, ImuSamples]:
        """Return the samples needed for windows from a number on."""
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
        self, waveform: Waveform, imu: ImuSamples, grid: WindowGrid, share: float, *, clips: bool
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
