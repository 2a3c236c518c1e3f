"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` knows no files.  Samples go in as they come; a state comes out at every field epoch, and
on request at any time since.
"""

import pickle
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from magfusion.errors import EstimationError
from magfusion.fusion.buffers import Buffer, check_clock
from magfusion.fusion.earth import check_earth
from magfusion.fusion.earth_online import EarthWatch
from magfusion.fusion.ekf import ErrorStateFilter
from magfusion.fusion.epoch import measured_at, single
from magfusion.fusion.factors import FieldMeasurements
from magfusion.fusion.gate import Gate
from magfusion.fusion.hearing import Hearing
from magfusion.fusion.navigator import SlidingWindow
from magfusion.fusion.outset import Outset, find_outset
from magfusion.fusion.propagation import Propagated, online_blocks, propagate
from magfusion.fusion.receive import OnlineReceiver, inertial_gap
from magfusion.fusion.recovery import agreed_fix, placed, prior_of, restarted
from magfusion.fusion.state import MOTION, State
from magfusion.fusion.stillness import REACH, REST_SIGMA, REST_SPAN, stands
from magfusion.fusion.walk import calibration_walk
from magfusion.receiver.windows import LockinSettings
from magfusion.records.samples import FieldSamples, ImuSamples, SteadyFields
from magfusion.site import Site
from magfusion.units import Array, BoolArray

WIDE_POSITION, WIDE_ROTATION = 0.3, 0.2  # m, rad; beyond, the prediction is no place to linearise
RATE_SPAN = 0.08  # s; motion is slower, noise is not
LONGEST_WAIT = 5.0  # s; the fields go on without an IMU that is silent for longer
LOST_POSITION = 10.0  # m; a prediction wider than this is worth nothing
OFFSET_STALE = 1e-4  # s; at a radian a second, six thousandths of a degree


@dataclass(frozen=True)
class NavigatorSettings:
    """How to navigate.

    Parameters
    ----------
    estimator : {'smoother', 'ekf'}
    lag : float
        Window of the smoother (s).
    delay : float
        How late samples may come and still be used in their order (s); so much later are states.
    start_duration : float
        Data gathered before the first state (s); longer where they leave it ambiguous.
    longest_step : float
        Without any field a state is made after so long (s).
    estimate : tuple of str, optional
        Groups of calibration parameters; None takes those that the site leaves open.
    lockin : LockinSettings, optional
    earth : bool
        Measure the Earth field too.
    """

    estimator: Literal["smoother", "ekf"] = "smoother"
    lag: float = 4.0
    delay: float = 0.0
    start_duration: float = 6.0
    longest_step: float = 5.0
    estimate: tuple[str, ...] | None = None
    lockin: LockinSettings | None = None
    earth: bool = False


class Navigator:
    """A running estimate of the platform's motion.

    Parameters
    ----------
    site : Site
    settings : NavigatorSettings, optional

    Raises
    ------
    InputError
        Where the Earth field is to be measured but the site has none.

    Attributes
    ----------
    counts : Counter
        What was refused, lost and recovered, with the reason.
    """

    def __init__(self, site: Site, settings: NavigatorSettings | None = None) -> None:
        self.site = site
        self.settings = NavigatorSettings() if settings is None else settings
        earth = self.settings.earth
        if earth:
            check_earth(site)
        self.blocks, self._held = online_blocks(site, self.settings.estimate, earth=earth)
        self._hearing = Hearing()
        self._gate = Gate(site.channels, self.blocks)
        self.counts = self._gate.counts
        self._walk = calibration_walk(self.blocks, self._held)
        self._imu = Buffer("imu", 6)
        self._waveform = Buffer("magnetometer", 3)
        self._fields: list[FieldSamples] = []
        self._steady: dict[float, SteadyFields] = {}
        self._earth = EarthWatch(self.blocks) if earth else None
        self._estimator: SlidingWindow | ErrorStateFilter | None = None
        self._receiver: OnlineReceiver | None = None
        self._applied_offset = site.platform.imu.time_offset
        self._usual: float | None = None  # sampling interval of the IMU (s)
        self._next_start = self.settings.start_duration
        self._last_epoch_time = -np.inf
        self._made: list[State] = []
        self.rival_chi_square: float | None = None

    # What goes in

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Take inertial samples: times (k,), rates and specific forces (k, 3).

        Raises
        ------
        InputError
            Where a number is not finite or the clock jumped.
        """
        stamps = np.atleast_1d(time)
        check_clock("imu", stamps, self._newest)
        self._imu.add(stamps, np.hstack([np.atleast_2d(gyro_body), np.atleast_2d(accel_body)]))
        self._advance()

    def add_magnetometer(self, time: Array, measured_sensor: Array) -> None:
        """Take raw samples of the magnetometer: times (k,), fields (k, 3) (T).

        Raises
        ------
        InputError
            Where a number is not finite or the clock jumped.
        """
        stamps = np.atleast_1d(time)
        check_clock("magnetometer", stamps, self._newest)
        self._waveform.add(stamps, np.atleast_2d(measured_sensor))
        self._advance()

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None = None) -> None:
        """Take demodulated phasors, channels in the site's order, and the steady fields with them.

        Raises
        ------
        InputError
            Where the clock jumped.
        """
        check_clock("fields", samples.time, self._newest)
        for i in range(len(samples)):
            one = samples.rows(slice(i, i + 1))
            if self._estimator is not None and one.time[0] <= self._estimator.state.time:
                self.counts["field too late"] += 1
                continue
            self._fields.append(one)
            if steady is not None and self._earth is not None:
                self._steady[float(one.time[0])] = steady.rows(slice(i, i + 1))
        self._fields.sort(key=lambda s: float(s.time[0]))
        self._advance()

    @property
    def _newest(self) -> float:
        """Newest stamp of all streams (s)."""
        heard = self._fields[-1].time[0] if self._fields else -np.inf
        return float(max(self._imu.newest, self._waveform.newest, heard))

    # What comes out

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self._estimator is not None

    def take(self) -> list[State]:
        """Return the states made since this was last asked."""
        made, self._made = self._made, []
        return made

    def state(self, time: float | None = None) -> State:
        """Return the state at a time, carried on by the inertial stream from the last epoch.

        Parameters
        ----------
        time : float, optional
            (s); the newest inertial sample where it is not given.

        Raises
        ------
        EstimationError
            Before there is a state.
        """
        if self._estimator is None:
            raise EstimationError("there is no state yet: the navigator is still gathering data")
        last = self._estimator.state
        wanted = self._imu.newest + self._applied_offset if time is None else time
        if wanted <= last.time:
            return last
        return self._propagated(wanted).state

    @property
    def distortion(self) -> dict[str, float]:
        """By beacon, running mean of the squared innovation in units of its expectation."""
        return self._gate.distortion

    @property
    def lagged(self) -> State | None:
        """State that left the smoother's window last; that of the filter is of now."""
        return None if self._estimator is None else self._estimator.lagged

    def take_lagged(self) -> list[State]:
        """Return the states that left the smoother's window since this was last asked.

        A filter has none.
        """
        if not isinstance(self._estimator, SlidingWindow):
            return []
        left, self._estimator.left = self._estimator.left, []
        return left

    @property
    def losses(self) -> dict[str, int]:
        """All that was refused, lost or recovered, with the reason: `counts`, windows, samples."""
        late = {f"{b.name} sample too late": b.late for b in (self._imu, self._waveform) if b.late}
        dropped = {} if self._receiver is None else self._receiver.dropped
        return {**self.counts, **{f"window: {k}": v for k, v in dropped.items()}, **late}

    def checkpoint(self) -> bytes:
        """Return everything needed to go on: `restored` makes a navigator of it."""
        return pickle.dumps(self)

    # How it goes on

    def _advance(self) -> None:
        if self._estimator is None and not self._begin():
            return
        while self._step():
            pass

    def _begin(self) -> bool:
        """Find the first state, once enough has come."""
        first = self._first_time()
        reached = self._reached() - self.settings.delay
        if not reached - first >= self._next_start:
            return False
        outset = find_outset(
            self.site,
            self._imu_samples(),
            self._waveform,
            self._fields,
            reached,
            self.settings.estimate,
            self.settings.lockin,
            list(self._steady.values()) if self._earth is not None else None,
        )
        if outset is None or (
            outset.ambiguous and self._next_start < 4 * self.settings.start_duration
        ):
            self._next_start += 0.5 * self.settings.start_duration
            self._forget_before_start()
            return False
        self._start_at(outset)
        return True

    def _first_time(self) -> float:
        if self._fields:
            return float(self._fields[0].time[0])
        time, _ = self._waveform.rows()
        return float(time[0]) if len(time) else np.inf

    def _reached(self) -> float:
        """Until when everything has come."""
        inertial = self._imu.newest + self._applied_offset
        heard = self._fields[-1].time[0] if self._fields else self._waveform.newest
        return float(min(inertial, heard))

    def _forget_before_start(self) -> None:
        """Keep no more than four times what a start takes."""
        oldest = self._reached() - 4.0 * self.settings.start_duration
        for buffer in (self._imu, self._waveform):
            buffer.forget(oldest, oldest)
        self._fields = [s for s in self._fields if s.time[0] >= oldest]

    def _start_at(self, outset: Outset) -> None:
        state = outset.state
        self._applied_offset = state.calibration.time_offset
        self._usual = float(np.median(np.diff(self._imu.rows()[0])))
        self.rival_chi_square = outset.rival_chi_square
        if self.settings.estimator == "ekf":
            self._estimator = ErrorStateFilter(state, self.blocks, self._held)
        else:
            self._estimator = SlidingWindow(
                state,
                self.blocks,
                self.settings.lag,
                self._walk,
                self._applied_offset,
                earth=self._earth is not None,
                held=self._held,
            )
        if outset.lockin is not None:
            self._receiver = OnlineReceiver(
                outset.lockin, outset.rate_hz, state.time + outset.lockin.step
            )
        self._fields = [s for s in self._fields if s.time[0] > state.time]
        self._steady = {t: s for t, s in self._steady.items() if t > state.time}
        self._last_epoch_time = state.time
        self._made.append(state)
        self._forget(state.time)

    def _step(self) -> bool:
        """Process the next epoch, if all that it needs has come."""
        assert self._estimator is not None
        now = self._estimator.state.time
        heard = self._fields[-1].time[0] if self._fields else self._waveform.newest
        inertial = max(self._imu.newest + self._applied_offset, heard - LONGEST_WAIT)
        inertial = float(inertial) - self.settings.delay
        if self._receiver is not None and self._waveform.newest >= self._receiver.next_end:
            return self._step_window(self._receiver, inertial)
        if self._fields and self._fields[0].time[0] <= inertial:
            return self._step_fields(self._fields.pop(0))
        if inertial - now >= self.settings.longest_step:
            self._absorb(now + self.settings.longest_step, None)
            return True
        return False

    def _step_window(self, receiver: OnlineReceiver, inertial: float) -> bool:
        ahead = self._waveform.newest - self.settings.delay
        if min(inertial, ahead) < receiver.next_end:
            return False
        assert self._estimator is not None
        half = receiver.settings.window / 2.0
        begin, end = receiver.next_centre - half, receiver.next_centre + half
        imu = self._imu_samples(self._estimator.state.time - 0.1, end + 0.1)
        silent = inertial_gap(imu.time + self._applied_offset, begin, end)
        if receiver.next_centre <= self._estimator.state.time:
            self.counts["window too late"] += 1
        elif receiver.usable(self._waveform, silent):
            self._absorb(receiver.next_centre, None)
        receiver.skip()
        return True

    def _step_fields(self, samples: FieldSamples) -> bool:
        assert self._estimator is not None
        if samples.time[0] <= self._estimator.state.time:
            self.counts["field too late"] += 1
            self._steady.pop(float(samples.time[0]), None)
            return True
        self._absorb(float(samples.time[0]), samples)
        return True

    def _absorb(self, time: float, samples: FieldSamples | None) -> None:
        """Go on to a time and take in what was measured there."""
        assert self._estimator is not None
        predicted = self._propagated(time)
        if predicted.bridged:
            self.counts["inertial gap bridged"] += 1
        step = max(time - self._last_epoch_time, 1e-6)
        measurements, samples, steady = self._measured(predicted, samples, step)
        about = None
        if measurements is not None and samples is not None and np.any(samples.valid):
            if predicted.state.position_sigma > LOST_POSITION and self._found_again(
                samples, predicted
            ):
                return
            about, refused = self._about(samples, predicted.state)
            explained = predicted.state if about is None else about
            measurements = self._gate.passed(measurements, explained, samples.valid[0], refused)
            if self._gate.lost and self._found_again(samples, predicted):
                return
        slow = None
        if measurements is not None and self._earth is not None and steady is not None:
            known = predicted.state if about is None else replace(about, cov=predicted.state.cov)
            measurements, disturbed = self._earth.weighed(measurements, steady, known, step)
            self.counts["Earth field disturbed"] += disturbed
            slow = self._earth.speed_sigma(measurements, step)
        self._take_in(predicted, measurements, about, slow)

    def _take_in(
        self,
        predicted: Propagated,
        measurements: FieldMeasurements | None,
        about: State | None,
        slow: float | None,
    ) -> None:
        assert self._estimator is not None
        factors = None if measurements is None else single(measurements, self.blocks)
        rest = REST_SIGMA if self._rests(predicted.state) else slow
        try:
            self._estimator.absorb(predicted, factors, rest, about)
        except EstimationError:
            self.counts["update failed"] += 1
            self._gate.refused_in_a_row += 1
            self._estimator.replace_state(predicted.state)
        self._finish()

    def _finish(self) -> None:
        assert self._estimator is not None
        self._made.append(self._estimator.state)
        self._apply_offset_anew()
        self._forget(self._estimator.state.time)

    def _apply_offset_anew(self) -> None:
        """Cut the inertial stream by the time offset that has been learnt since.

        A state is the platform's where the IMU's stamp says; under another offset it is the same
        state, a little earlier or later on the log's clock.
        """
        assert self._estimator is not None
        state = self._estimator.state
        own = [MOTION + b.columns.start for b in self.blocks if b.kind == "time_offset"]
        if not own:
            return
        lag = state.calibration.time_offset - self._applied_offset
        if abs(lag) < max(OFFSET_STALE, 2.0 * float(np.sqrt(state.cov[own[0], own[0]]))):
            return
        self._applied_offset += lag
        if isinstance(self._estimator, SlidingWindow):
            self._estimator.applied_offset = self._applied_offset
        self._estimator.replace_state(replace(state, time=state.time + lag))
        self.counts["time offset applied anew"] += 1

    def _propagated(self, time: float) -> Propagated:
        assert self._estimator is not None
        state = self._estimator.state
        begin, end = state.time - self._applied_offset, time - self._applied_offset
        imu = self._imu_samples(begin, end)
        return propagate(state, imu, time, self.site, self._applied_offset, self._walk, self._usual)

    def _imu_samples(self, begin: float = -np.inf, end: float = np.inf) -> ImuSamples:
        time, rows = self._imu.between(begin, end)
        return ImuSamples(time, rows[:, :3], rows[:, 3:])

    def _forget(self, time: float) -> None:
        reach = 2.0 + (0.0 if self._receiver is None else self._receiver.settings.window)
        self._imu.forget(time - reach, time - self._applied_offset - 1.0)
        self._waveform.forget(time - reach, time - reach)

    # Measurements

    def _measured(
        self, predicted: Propagated, samples: FieldSamples | None, step: float
    ) -> tuple[FieldMeasurements | None, FieldSamples | None, SteadyFields | None]:
        state = predicted.state
        wave, steady = None, self._steady.pop(predicted.state.time, None)
        if samples is None:
            receiver = self._receiver
            if receiver is None or receiver.next_centre != state.time:
                return None, None, None  # only the clock went on
            assert self._estimator is not None
            half = receiver.settings.window / 2.0
            before = self._estimator.state
            imu = self._imu_samples(
                min(before.time, state.time - half) - 0.1, state.time + half + 0.1
            )
            wave = receiver.demodulate(self._waveform, imu, before, state, self._applied_offset)
            samples, steady = wave.fields, wave.steady
        samples = self._hearing.of(samples, step)
        if not np.any(samples.valid) and (self._earth is None or steady is None):
            return None, None, None
        self._last_epoch_time = state.time
        rate_body = self._rate(state.time) - state.gyro_bias_body
        measurements = measured_at(samples, wave, state, rate_body, self._applied_offset, step)
        return measurements, samples, steady

    def _rate(self, time: float) -> Array:
        stamp = time - self._applied_offset
        _, rows = self._imu.between(stamp - RATE_SPAN / 2, stamp + RATE_SPAN / 2)
        return np.asarray(np.mean(rows[:, :3], axis=0)) if len(rows) else np.zeros(3)

    def _rests(self, state: State) -> bool:
        stamp = state.time - self._applied_offset
        time, rows = self._imu.between(stamp - REST_SPAN - REACH, stamp + REACH)
        return stands(state, time, rows[:, :3], rows[:, 3:], stamp)

    # Being lost, and found again

    def _about(self, samples: FieldSamples, state: State) -> tuple[State | None, BoolArray]:
        """Return where to linearise if a prediction is too wide for it, and what disagrees."""
        nothing = np.zeros(len(samples.channels), dtype=bool)
        wide = state.position_sigma > WIDE_POSITION or state.rotation_sigma > WIDE_ROTATION
        fix = agreed_fix(samples, state.calibration, prior_of(state)) if wide else None
        if fix is None:
            return None, nothing
        self.counts["found by a fix"] += 1
        return placed(state, fix), fix.refused

    def _found_again(self, samples: FieldSamples, predicted: Propagated) -> bool:
        """Give the pose up that explains nothing any more, and start from a fix."""
        assert self._estimator is not None
        fix = agreed_fix(samples, predicted.state.calibration)
        if fix is None or not fix.fixes.determined[0, 0]:
            return False
        self.counts["lost and found again"] += 1
        self._gate.refused_in_a_row = 0
        self._estimator.replace_state(restarted(predicted.state, fix))
        self._finish()
        return True


def restored(checkpoint: bytes) -> Navigator:
    """Return the navigator of a checkpoint.  Only open checkpoints that you have written."""
    found = pickle.loads(checkpoint)
    assert isinstance(found, Navigator)
    return found
