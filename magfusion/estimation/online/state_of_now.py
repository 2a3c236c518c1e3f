"""The current state: the newest estimate, propagated by every inertial sample, as output."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.state import State
from magfusion.estimation.online.blend import Blend
from magfusion.estimation.online.carried import (
    Departure,
    Passage,
    ahead,
    carried_states,
    carry,
    departing,
    in_tangent,
)
from magfusion.estimation.online.held_motion import HeldMotion
from magfusion.estimation.online.input_queue import Arrivals
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.prior_ahead import ahead_by_prior
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
    judged_state,
    parts_of,
)
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.model.short_repr import short_repr
from magfusion.units import DEGREE, Array


@dataclass(frozen=True, eq=False)
class CarriedState(JudgedState):
    """A state that is propagated by inertial samples.

    Parameters
    ----------
    epoch : float
        Time of the estimate that was propagated (s).
    """

    __repr__ = short_repr

    epoch: float = 0.0


@dataclass(frozen=True, eq=False)
class Said:
    """Judgement and levels that all states propagated from one epoch share.

    Parameters
    ----------
    bank : SubsetBank, optional
        The filters that exclude each beacon, of that epoch.
    """

    judgement: Judgement
    reset_counter: int
    bank: SubsetBank | None


class StateOfNow:
    """Propagates the newest estimate to the newest inertial sample, or ahead of it.

    Attributes
    ----------
    made : list of CarriedState
        At the requested rate, in order of time.
    """

    made: list[CarriedState]
    _stamp: float  # of the newest sample, or instant, with a state
    _until: float  # time of the newest state (s)
    _blend: Blend
    _held: HeldMotion

    def __init__(self, settings: NavigatorSettings) -> None:
        self.rate, self.horizon = settings.rate, settings.horizon
        self.made, self._stamp, self._until = [], -np.inf, -np.inf
        self._blend, self._held = Blend(settings.blend), HeldMotion(settings.horizon)
        self._departure: Departure | None = None
        self._said = Said(Judgement(), 0, None)
        self._last: Passage | None = None
        self._told: State | None = None  # of the newest sample, before a correction

    def depart(self, departure: Departure, said: Said, arrived: Arrivals) -> None:
        """Continue from the state of a new epoch, which may include a correction."""
        jumped = said.reset_counter != self._said.reset_counter
        before = self._told
        self._departure, self._said, self._last = departure, said, None
        if self.rate == "field":
            return
        if self._stamp == -np.inf:  # states start with the next sample
            self._stamp = self._reached(arrived)
        if self.horizon > 0.0:
            self._held.hear(arrived.inertial_samples())
        if self._blend.length == 0.0:
            return
        if jumped:
            self._blend.forget()
        elif before is not None and before.time - self.horizon > departure.state.time:
            passage = self._passage(arrived, np.array([before.time - self.horizon]))
            (corrected,) = carried_states(departure, self._ahead(passage, self.horizon))
            self._blend.take(before, corrected)

    def reach(self, arrived: Arrivals) -> None:
        """Propagate the state to the inertial samples that have arrived."""
        if self.rate == "field" or self._departure is None:
            return
        wanted = self._wanted(arrived)
        if len(wanted) == 0:
            return
        self._stamp = float(wanted[-1])
        if self.rate == "imu":
            wanted = wanted + arrived.applied_offset
        # Another time offset may go back in time.
        wanted = wanted[wanted > max(self._departure.state.time, self._until)]
        if len(wanted) == 0:
            return
        self._until = float(wanted[-1])
        self.made += self._judged(self._passage(arrived, wanted), self.horizon)
        self._told = self.made[-1]

    def at(self, arrived: Arrivals, time: float) -> JudgedState:
        """Return the state at any time since the epoch (s)."""
        assert self._departure is not None
        newest = max(arrived.inertial, self._departure.state.time)
        passage = self._passage(arrived, np.array([min(time, newest)]))
        if time > newest:
            self._held.hear(arrived.inertial_samples())
        return self._judged(passage, max(time - newest, 0.0))[0]

    def _reached(self, arrived: Arrivals) -> float:
        return arrived.imu.newest if self.rate == "imu" else arrived.inertial

    def _wanted(self, arrived: Arrivals) -> Array:
        """Return the stamps of samples, or instants, for new states."""
        if self.rate == "imu":
            stamps, _ = arrived.imu.rows()
            return stamps[np.searchsorted(stamps, self._stamp, side="right") :]
        assert not isinstance(self.rate, str)
        first = np.floor(self._stamp * self.rate + 1e-6) + 1.0
        last = np.floor(arrived.inertial * self.rate + 1e-6)
        return np.arange(first, last + 1.0) / self.rate

    def _passage(self, arrived: Arrivals, wanted: Array) -> Passage:
        """Return the passage at some times, continued from the last propagation."""
        departure, last = self._departure, self._last
        assert departure is not None
        if last is None or wanted[0] < last.time[0]:
            last = departing(departure)
        begin, offset = float(last.time[0]) - departure.time_offset, departure.time_offset
        end = max(float(wanted[-1]) - offset, arrived.imu.newest)
        imu = arrived.motion_samples(begin, end)
        blind = arrived.stand_in.covers(begin, end)
        passage, newest = carry(departure, last, imu, np.maximum(wanted, last.time), blind=blind)
        if self._last is None or newest.time[0] > self._last.time[0]:
            self._last = newest
        return passage

    def _ahead(self, passage: Passage, horizon: float) -> Passage:
        if horizon == 0.0:
            return passage
        assert self._departure is not None
        site = self._departure.site
        if not site.platform.inertial:
            return ahead_by_prior(passage, horizon, site.platform.imu)
        return ahead(passage, horizon, site.gravity, self._held.cov(horizon))

    def _judged(self, passage: Passage, horizon: float) -> list[CarriedState]:
        departure, said = self._departure, self._said
        assert departure is not None
        passage = self._ahead(passage, horizon)
        grown = np.ones((len(passage), 2))
        if said.bank is not None and said.judgement.protection_level_m is not None:
            grown = said.bank.grown(*in_tangent(passage))
        found = []
        for state, more in zip(carried_states(departure, passage), grown.tolist(), strict=True):
            own, step = (
                self._blend.told(state) if self._blend.length > 0.0 else (state, np.zeros(9))
            )
            judgement = _wider(said.judgement, more, step)
            told = judged_state(own, judgement, said.reset_counter)
            found.append(CarriedState(**parts_of(told), epoch=departure.state.time))
        return found


def _wider(judgement: Judgement, grown: list[float], step: Array) -> Judgement:
    """Return a judgement whose levels are scaled, attitude first, and shifted by an offset."""
    metres, degrees = judgement.protection_level_m, judgement.protection_level_deg
    if metres is None and degrees is None:
        return judgement
    turn, shift = (float(np.linalg.norm(part)) for part in (step[:3], step[3:6]))
    return replace(
        judgement,
        levels=Levels(
            (
                None if metres is None else metres * grown[1] + shift,
                None if degrees is None else degrees * grown[0] + turn / DEGREE,
            )
        ),
    )
