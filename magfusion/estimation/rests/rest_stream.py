"""Running estimate of the pose during a rest, which improves while the platform does not move.

Each segment of a rest is integrated like a whole rest, with its reference and its mains, and its
information is added to that of the segments before.  Only the sums are stored: hours take as much
memory as minutes.  Nothing is propagated from one rest to the next.
"""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stream_buffer import Buffer, check_clock
from magfusion.estimation.demodulation.demodulation import gravity_at_rest
from magfusion.estimation.rests.reference_noise_cancellation import (
    ReferenceHistory,
    reference_findings,
)
from magfusion.estimation.rests.rest_lengths import coherent, piece_length
from magfusion.estimation.rests.running_stationary_mean import RunningMean
from magfusion.estimation.rests.stationary_integration import (
    Rest,
    assumed_stationary,
    check_tones,
    rest_epoch,
    rests,
    undetected_in_rests,
)
from magfusion.estimation.snapshot.explained_fixes import ExplainedFixes, explained_fixes
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Trust
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.units import Array, BoolArray

FIRST, LATER = 60.0, 120.0  # s; of the first segment of a rest, and of those after it
LOOK = 2.0  # s; interval of the checks for rest
MAX_WAIT = 10.0  # s; timeout of the reference
SAME_REST = 0.5  # of the span of rest: maximum gap between two segments of one rest
MARGIN = 4.0  # s; of inertial samples that are kept before a segment


@dataclass(frozen=True, eq=False)
class RestState:
    """Estimate of a rest so far."""

    time: float  # (s)
    standing: bool  # False once the platform has moved: then nothing else is reported
    duration: float  # of the rest as far as it is integrated (s)
    samples: FieldSamples | None  # its phasors, one epoch
    detected: BoolArray  # (channels,)
    fixes: ExplainedFixes | None  # None while no beacon is detected
    trust: Trust
    # (channels,), ratio by which the reference reduces the sigmas of the newest segment; NaN where
    # it is not used
    gain: Array


class RestNavigator:
    """Running estimate of the pose of a platform at rest.

    `lockin`: length of the pieces, and the mains; by default chosen by the tones. `false_alarm`:
    probability, per rest and beacon, of a false detection in any of its states. `risk`: integrity
    risk of the protection levels. Raises InputError where tones cannot be integrated, or there is
    not exactly one magnetometer of three axes.
    """

    def __init__(
        self,
        site: Site,
        lockin: LockinSettings | None = None,
        false_alarm: float = 1e-3,
        risk: Risk | None = None,
    ) -> None:
        check_tones(site)
        if site.platform.further or site.platform.magnetometer.lacking:
            raise InputError("--at-rest requires one magnetometer of three axes; omit --at-rest")
        self.site, self._false_alarm, self._risk = site, false_alarm, risk
        self._usual, self._lockin = default_settings(site), lockin
        self._longest = coherent(site)
        self._imu, self._wave = Buffer("imu", 6), Buffer("magnetometer", 3)
        self._reference = Buffer("reference", 3)
        self._looked = self._done = -np.inf
        self._running: RunningMean | None = None
        self._known = ReferenceHistory()
        self._pending: list[RestState] = []

    # Input

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples: times (k,), rates and specific forces (k, 3)."""
        check_clock("imu", time, self._newest)
        self._imu.add(time, np.hstack([gyro_body, accel_body]))

    def add_magnetometer(self, time: Array, measured_sensor: Array) -> None:
        """Add raw samples and process them: times (k,), fields (k, 3) (T)."""
        check_clock("magnetometer", time, self._newest)
        self._wave.add(time, measured_sensor)
        self.advance()

    def add_reference(self, time: Array, measured_sensor: Array) -> None:
        """Add samples of a reference sensor, on its own clock: times (k,), fields (k, 3) (T)."""
        check_clock("reference", time, self._newest)
        self._reference.add(time, measured_sensor)

    @property
    def _newest(self) -> float:
        return max(self._imu.newest, self._wave.newest, self._reference.newest)

    # Output

    def take(self) -> list[RestState]:
        """Return the states made since the last call."""
        built, self._pending = self._pending, []
        return built

    @property
    def kept(self) -> int:
        """Number of buffered samples."""
        return len(self._imu) + len(self._wave) + len(self._reference)

    # Processing

    def end(self) -> None:
        """Process the remaining samples at the end of a log."""
        self.advance(last=True)

    def advance(self, *, last: bool = False) -> None:
        """Integrate every complete segment."""
        inertial = self.site.platform.inertial
        newest = self._wave.newest
        if inertial:
            newest = min(newest, self._imu.newest + self.site.platform.imu.time_offset)
        if not last and np.isfinite(self._reference.newest):
            newest = min(newest, max(self._reference.newest, newest - MAX_WAIT))
        due = np.isfinite(newest) and newest >= self._looked + LOOK
        if not (last or due) or len(self._wave) < 2:
            return
        self._looked = newest
        log = self._log()
        span = self.site.platform.motion.rest_span
        for begin, until in rests(log, self.site):
            if until <= max(self._done, begin):
                continue
            moved = inertial and until < newest - 2.0 * span
            until = min(until, newest)
            self._integrate(log, max(begin, self._done), until, over=moved or last)
            if moved and self._running is not None:
                self._pending.append(_moved(until, self._running, len(self.site.channels)))
                self._running = None
        if self._running is None:
            self._done = max(self._done, newest - LATER)
        self._discard_before(self._done - MARGIN - span)

    def _integrate(self, log: Log, begin: float, until: float, *, over: bool) -> None:
        """Integrate the complete segments of a rest."""
        running, gap = self._running, SAME_REST * self.site.platform.motion.rest_span
        if running is None or begin > running.end + gap:
            running = self._running = RunningMean.begun(begin, len(self.site.channels))
        begin = max(begin, running.end)
        while until - begin > 0.0:
            wanted = LATER if running.looks else FIRST
            if until - begin < wanted and not over:
                break
            # A short remainder of a rest that is over makes no segment of its own.
            end = until if over and until - begin < wanted + 0.5 * LATER else begin + wanted
            running = self._stretch(log, running, (begin, end))
            begin = end
        self._running, self._done = running, begin

    def _stretch(self, log: Log, running: RunningMean, span: tuple[float, float]) -> RunningMean:
        length = piece_length(self.site, self._usual, self._lockin, span[1] - span[0])
        if length is None:
            return replace(running, end=span[1])
        mains_hz = (self._lockin or self._usual).mains_hz
        parts = (log, span, self.site, length, mains_hz, self._false_alarm, self._known)
        rest = rest_epoch(*parts)
        self._known = rest.known or self._known
        running = running.with_stretch(rest, self.site, span[1], self._longest, self._false_alarm)
        self._pending.append(self._state(log, running, rest))
        return running

    def _state(self, log: Log, running: RunningMean, rest: Rest) -> RestState:
        """Return the estimate after a segment."""
        samples = running.fields(self.site, self._longest)
        detected = running.chance(self.site) < self._false_alarm
        # The gravity of a rest's last moment lies before it.
        shown = replace(samples, time=samples.time - self.site.platform.motion.rest_span)
        findings = (
            *assumed_stationary(log),
            *undetected_in_rests(samples, detected[None], self.site, self._false_alarm),
        )
        gain = np.array([tone.gain for tone in rest.tones])
        if np.isfinite(self._reference.newest):
            findings += reference_findings([rest.tones], self.site)
        result = None
        if np.any(detected):
            calibration = initial_calibration(self.site, float(shown.time[0]))
            gravity = gravity_at_rest(log.imu, self.site, shown.time) if log.inertial else None
            result = explained_fixes(shown, calibration, gravity=gravity, risk=self._risk)
        trust = Trust(tuple(findings)) | (Trust() if result is None else result.trust)
        return RestState(
            running.end, True, running.duration, samples, detected, result, trust, gain
        )

    def _log(self) -> Log:
        imu, rows = self._imu.rows()
        wave, field = self._wave.rows()
        other, detected = self._reference.rows()
        reference = Waveform(other, detected) if len(other) > 1 else None
        samples = ImuSamples(imu, rows[:, :3], rows[:, 3:])
        inertial = self.site.platform.inertial
        whole = Log("stream", 0, "stream", samples, Waveform(wave, field), inertial=inertial)
        return replace(whole, reference=reference)

    def _discard_before(self, before: float) -> None:
        self._imu.discard_before(before - self.site.platform.imu.time_offset, -np.inf)
        self._wave.discard_before(before, -np.inf)
        self._reference.discard_before(before - MAX_WAIT, -np.inf)


def _moved(time: float, running: RunningMean, channels: int) -> RestState:
    none = np.zeros(channels, dtype=bool)
    nothing: tuple[Finding, ...] = ()
    gain = np.full(channels, np.nan)
    return RestState(time, False, running.duration, None, none, None, Trust(nothing), gain)
