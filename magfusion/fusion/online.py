"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` knows no files.  Samples go in as they come; a state comes out at every field epoch, and
on request at any time since.
"""

import pickle
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.fusion.arrivals import Arrivals
from magfusion.fusion.earth import check_earth
from magfusion.fusion.earth_online import EarthWatch
from magfusion.fusion.ekf import ErrorStateFilter
from magfusion.fusion.epoch import single
from magfusion.fusion.factors import FieldMeasurements
from magfusion.fusion.gate import Gate
from magfusion.fusion.navigator import SlidingWindow
from magfusion.fusion.outset import Outset, find_outset
from magfusion.fusion.propagation import Propagated, online_blocks, propagate
from magfusion.fusion.receive import OnlineReceiver
from magfusion.fusion.recovery import agreed_fix, placed, prior_of, restarted
from magfusion.fusion.state import State
from magfusion.fusion.stillness import REST_SIGMA
from magfusion.fusion.walk import calibration_walk
from magfusion.receiver.windows import LockinSettings
from magfusion.records.samples import FieldSamples, SteadyFields
from magfusion.site import Site
from magfusion.units import Array, BoolArray

CHECKPOINT_FORMAT = 2  # to be raised with every change of what a navigator holds
WIDE_POSITION, WIDE_ROTATION = 0.3, 0.2  # m, rad; beyond, the prediction is no place to linearise
LOST_POSITION = 10.0  # m; a prediction wider than this is worth nothing


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
        self._gate = Gate(site.channels, self.blocks)
        self.counts = self._gate.counts
        self._walk = calibration_walk(self.blocks, self._held)
        self._arrived = Arrivals(site.platform.imu.time_offset)
        self._earth = EarthWatch(self.blocks) if earth else None
        self._estimator: SlidingWindow | ErrorStateFilter | None = None
        self._next_start = self.settings.start_duration
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
        self._arrived.add_imu(time, gyro_body, accel_body)
        self._advance()

    def add_magnetometer(self, time: Array, measured_sensor: Array) -> None:
        """Take raw samples of the magnetometer: times (k,), fields (k, 3) (T).

        Raises
        ------
        InputError
            Where a number is not finite or the clock jumped.
        """
        self._arrived.add_magnetometer(time, measured_sensor)
        self._advance()

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None = None) -> None:
        """Take demodulated phasors, channels in the site's order, and the steady fields with them.

        Raises
        ------
        InputError
            Where the clock jumped.
        """
        after = -np.inf if self._estimator is None else self._estimator.state.time
        late = self._arrived.add_fields(samples, None if self._earth is None else steady, after)
        if late:
            self.counts["field too late"] += late
        self._advance()

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
        wanted = self._arrived.inertial if time is None else time
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
        return {**self.counts, **self._arrived.losses}

    def checkpoint(self) -> bytes:
        """Return everything needed to go on: `restored` makes a navigator of it."""
        return pickle.dumps((CHECKPOINT_FORMAT, self))

    # How it goes on

    def _advance(self) -> None:
        if self._estimator is None and not self._begin():
            return
        while self._step():
            pass

    def _begin(self) -> bool:
        """Find the first state, once enough has come."""
        arrived = self._arrived
        reached = arrived.reached - self.settings.delay
        if not reached - arrived.first >= self._next_start:
            return False
        outset = find_outset(
            self.site,
            arrived.inertial_samples(),
            arrived.waveform,
            arrived.fields,
            reached,
            self.settings.estimate,
            self.settings.lockin,
            list(arrived.steady.values()) if self._earth is not None else None,
        )
        if outset is None or (
            outset.ambiguous and self._next_start < 4 * self.settings.start_duration
        ):
            self._next_start += 0.5 * self.settings.start_duration
            arrived.forget_before_start(4.0 * self.settings.start_duration)
            return False
        self._start_at(outset)
        return True

    def _start_at(self, outset: Outset) -> None:
        state = outset.state
        self._arrived.start(outset)
        self.rival_chi_square = outset.rival_chi_square
        if self.settings.estimator == "ekf":
            self._estimator = ErrorStateFilter(state, self.blocks, self._held)
        else:
            self._estimator = SlidingWindow(
                state,
                self.blocks,
                self.settings.lag,
                self._walk,
                self._arrived.applied_offset,
                earth=self._earth is not None,
                held=self._held,
            )
        self._made.append(state)

    def _step(self) -> bool:
        """Process the next epoch, if all that it needs has come."""
        assert self._estimator is not None
        now = self._estimator.state.time
        arrived, receiver = self._arrived, self._arrived.receiver
        inertial = arrived.awaited - self.settings.delay
        if receiver is not None and arrived.waveform.newest >= receiver.next_end:
            return self._step_window(receiver, inertial)
        if arrived.fields and arrived.fields[0].time[0] <= inertial:
            return self._step_fields(arrived.fields.pop(0))
        if inertial - now >= self.settings.longest_step:
            self._absorb(now + self.settings.longest_step, None)
            return True
        return False

    def _step_window(self, receiver: OnlineReceiver, inertial: float) -> bool:
        ahead = self._arrived.waveform.newest - self.settings.delay
        if min(inertial, ahead) < receiver.next_end:
            return False
        assert self._estimator is not None
        before = self._estimator.state
        if receiver.next_centre <= before.time:
            self.counts["window too late"] += 1
        elif self._arrived.window_usable(receiver, before):
            self._absorb(receiver.next_centre, None)
        receiver.skip()
        return True

    def _step_fields(self, samples: FieldSamples) -> bool:
        assert self._estimator is not None
        if samples.time[0] <= self._estimator.state.time:
            self.counts["field too late"] += 1
            self._arrived.steady.pop(float(samples.time[0]), None)
            return True
        self._absorb(float(samples.time[0]), samples)
        return True

    def _absorb(self, time: float, samples: FieldSamples | None) -> None:
        """Go on to a time and take in what was measured there."""
        assert self._estimator is not None
        predicted = self._propagated(time)
        if predicted.bridged:
            self.counts["inertial gap bridged"] += 1
        step = max(time - self._arrived.last_epoch, 1e-6)
        found = self._arrived.measured(
            self._estimator.state, predicted.state, samples, step, earth=self._earth is not None
        )
        if found is None:
            self._take_in(predicted, None, None, None)
            return
        measurements, heard, steady = found
        about = slow = None
        if np.any(heard.valid):
            lost = predicted.state.position_sigma > LOST_POSITION
            if lost and self._found_again(heard, predicted):
                return
            about, refused = self._about(heard, predicted.state)
            explained = predicted.state if about is None else about
            measurements = self._gate.passed(measurements, explained, heard.valid[0], refused)
            if self._gate.lost and self._found_again(heard, predicted):
                return
        if self._earth is not None and steady is not None:
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
        rest = REST_SIGMA if self._arrived.rests(predicted.state) else slow
        try:
            self._estimator.absorb(predicted, factors, rest, about)
        except EstimationError:
            self.counts["update failed"] += 1
            self._gate.refused_in_a_row += 1
            self._estimator.replace_state(predicted.state)
        self._finish()

    def _finish(self) -> None:
        assert self._estimator is not None
        state = self._estimator.state
        self._made.append(state)
        lag = self._arrived.apply_offset_anew(state, self.blocks)
        if lag:
            if isinstance(self._estimator, SlidingWindow):
                self._estimator.applied_offset = self._arrived.applied_offset
            self._estimator.replace_state(replace(state, time=state.time + lag))
            self.counts["time offset applied anew"] += 1
        self._arrived.forget(self._estimator.state.time)

    def _propagated(self, time: float) -> Propagated:
        assert self._estimator is not None
        state = self._estimator.state
        offset, usual = self._arrived.applied_offset, self._arrived.usual
        imu = self._arrived.inertial_samples(state.time - offset, time - offset)
        return propagate(state, imu, time, self.site, offset, self._walk, usual)

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
    """Return the navigator of a checkpoint.  Only open checkpoints that you have written.

    Raises
    ------
    InputError
        Where another version of magfusion wrote it.
    """
    other = "the checkpoint is of another version of magfusion; run without --resume"
    try:
        found = pickle.loads(checkpoint)
    except (pickle.UnpicklingError, AttributeError, EOFError, ImportError) as error:
        raise InputError(other) from error
    if not isinstance(found, tuple) or found[0] != CHECKPOINT_FORMAT:
        raise InputError(other)
    navigator = found[1]
    assert isinstance(navigator, Navigator)
    return navigator
