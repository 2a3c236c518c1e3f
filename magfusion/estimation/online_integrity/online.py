"""Monitors of an online estimate: the judgement of each state, at constant cost.

They test field innovations against their covariance; biases and calibration against their
declaration; gravity and the Earth's field, which are independent of the beacons; and fixes against
the state.  None of them knows the truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri, erfc

from magfusion.estimation.data_checks.static_field import DOUBT, off_earth
from magfusion.estimation.data_checks.statistics import largest_mean_square
from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, State
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.imu_checks import judge_biases, judge_gravity
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.running import DecayingSums, nothing
from magfusion.model.parameters import (
    Block,
    Calibration,
    difference,
    initial_calibration,
    prior_sigma,
)
from magfusion.model.samples import StaticFields
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray

MEMORY = 10.0  # s; of the innovations, gravity and static field
FADES = 20.0  # s; after which findings of the beginning that may have passed are dropped
PASSING = {
    "not_converged",
    "diverged",
    "field_residuals",
    "geometry",
    "gap",
    "low_signal",
    "separation",
}
RESTARTS_MEMORY = 60.0  # s
MIN_EXCESS = 2.5  # mean square that is no doubt, however many epochs show it
P_EXCESS = float(erfc(DOUBT / np.sqrt(2.0)))  # of a mean square by chance
MIN_EQUIVALENT_EPOCHS = 0.2  # epochs
OFTEN_REFUSED = 0.5  # of a beacon's epochs
MAX_RESTARTS = 3.0
PRIOR_EVERY = 1.0  # s
MAX_INFLATION = 1e8
MIN_GAIN = 0.05  # of a prior variance; a barely determined parameter does not move by itself
PROBATION = 2.0  # s; after a recovery or a failed update


@dataclass(frozen=True, eq=False)
class EpochSummary:
    """Data of an epoch besides the state."""

    # (3,), mean acceleration since the previous epoch by the raw accelerometer, in world axes, the
    # residual of gravity (m/s^2)
    accel_world: Array | None = None
    elapsed: float = 0.0  # since that epoch (s)
    static: StaticFields | None = None  # the static field of the window
    repeats: float = 1.0  # number of epochs that contain each sample of overlapping windows


class OnlineMonitor:
    """Monitors of a running estimate.

    `estimated`: calibration parameters that are estimated, first in the state's tangent.
    """

    _level: dict[str, DecayingSums]
    _refused: dict[str, DecayingSums]
    _repeats: float
    _gravity: DecayingSums
    _earth: DecayingSums
    _restarts: DecayingSums
    _uncertain_until: dict[str, float]
    _elsewhere: float | None
    _elsewhere_times: int
    _began: float
    _beginning: Judgement
    _shared_offsets: dict[str, Array]
    _noise_freedom: dict[str, float]
    _prior_at: float
    _prior: Judgement

    def __init__(self, site: Site, estimated: tuple[Block, ...]) -> None:
        self.site, self.estimated = site, estimated
        self.channels = {b.name: len(b.tones) for b in site.beacons}
        self._level, self._refused, self._repeats = {}, {}, 1.0
        self._gravity, self._earth, self._restarts = nothing(3), nothing(3), nothing()
        self._uncertain_until = {}
        self._elsewhere, self._elsewhere_times = None, 0
        self._began, self._prior_at, self._prior = 0.0, -np.inf, Judgement()
        self._beginning = Judgement()
        self._declared: Calibration | None = None
        self._shared_offsets, self._noise_freedom = {}, {}
        self._shared_variance: Array | None = None

    # Input

    def begin(
        self,
        time: float,
        findings: Judgement,
        shared_offsets: Mapping[str, Array],
        noise_freedom: Mapping[str, float],
    ) -> None:
        """Start at a first state (s), with the judgement of the smoothed beginning.

        `shared_offsets`: variance of estimated parameters that is due to considered ones.
        `noise_freedom`: degrees of freedom of each beacon's estimated noise; one without is known.
        """
        self._began, self._beginning, self._shared_offsets = time, findings, dict(shared_offsets)
        self._noise_freedom = dict(noise_freedom)
        self._shared_variance = None

    def update(self, state: State, gate: Gate, epoch: EpochSummary) -> None:
        """Process an epoch: the state after it, and its gate."""
        time = state.time
        for name, level in gate.accepted.items():
            before = self._level.get(name, nothing())
            self._level[name] = before.with_sample(np.array([level]), time, MEMORY)
        for name in {**gate.accepted, **gate.refused}:
            share = np.array([float(name in gate.refused and name not in gate.accepted)])
            before = self._refused.get(name, nothing())
            self._refused[name] = before.with_sample(share, time, MEMORY)
        self._repeats = epoch.repeats
        if epoch.accel_world is not None:
            accel, weight = epoch.accel_world, epoch.elapsed
            self._gravity = self._gravity.with_sample(accel, time, MEMORY, weight)
        if epoch.static is not None:
            self._update_static(state, epoch.static)

    def _update_static(self, state: State, static: StaticFields) -> None:
        measured, earth = static.measured_sensor[0], self.site.earth_field_world
        if earth is None or not np.all(np.isfinite(measured)):
            return
        sensor = self.site.platform.magnetometer
        field = np.linalg.solve(sensor.matrix, measured - sensor.offset)
        field_world = state.world_from_body @ (sensor.body_from_sensor @ field)
        self._earth = self._earth.with_sample(field_world - earth, state.time, MEMORY)

    def uncertain(self, code: str, time: float) -> None:
        """Doubt the states for a while after a temporary problem."""
        self._uncertain_until[code] = time + PROBATION
        if code == "found_again":
            self._restarts = self._restarts.with_sample(np.ones(1), time, RESTARTS_MEMORY)

    def reset_motion(self) -> None:
        """Discard the history of a pose that was given up."""
        self._level, self._refused = {}, {}
        self._gravity, self._earth = nothing(3), nothing(3)
        self._elsewhere, self._elsewhere_times = None, 0

    def compared(self, distance: float, off: float) -> None:
        """Process the comparison with a fix: squared distance and offset (m).

        `distance`: chi square of six components.
        """
        if distance < chdtri(6, 1e-6):
            self._elsewhere, self._elsewhere_times = None, 0
        else:
            self._elsewhere, self._elsewhere_times = off, self._elsewhere_times + 1

    @property
    def needs_second_fix(self) -> bool:
        """Whether a fix that disagrees requests another at once."""
        return self._elsewhere is not None

    # Output

    def judgement(
        self, state: State, gate: Gate, lost_since: float | None, fixed: Judgement
    ) -> Judgement:
        """Return the judgement of a state, including that of its fixed parameters."""
        parts = [
            fixed,
            self._of_the_beginning(state.time),
            self._of_being_lost(state, gate, lost_since),
            self._of_fields(),
            judge_biases(self.site, state, state.time - self._began),
            self._of_calibration(state),
            judge_gravity(self.site, self._gravity, MEMORY),
            self._of_earth(state),
            self._of_what_happened(state.time),
            self._of_fixes(),
        ]
        return Judgement(
            findings=tuple(finding for part in parts for finding in part.findings),
            excluded=tuple(sorted(set(gate.refused))),
            inflation=min(MAX_INFLATION, max(part.inflation for part in parts)),
            turn=max(part.turn for part in parts),
            shift=max(part.shift for part in parts),
        )

    def _of_the_beginning(self, time: float) -> Judgement:
        """Return the judgement of the beginning; temporary findings are dropped with time."""
        messages, findings = self._beginning, self._beginning.findings
        if time >= self._began + FADES:
            findings = tuple(f for f in findings if f.code not in PASSING)
        return replace(messages, findings=findings) if findings else Judgement()

    def _of_being_lost(self, state: State, gate: Gate, lost_since: float | None) -> Judgement:
        if lost_since is not None:
            if not gate.is_lost:
                sigma = np.sqrt(np.linalg.eigvalsh(state.cov[POSITION, POSITION])[-1])
                text = (
                    f"Lost since {lost_since:.1f} s: the sigma of the position is {sigma:.2g} m, as"
                    " the beacons do not determine it. A fix of the beacons ends this; detect more"
                    " of them, or raise --lost-beyond."
                )
                return Judgement((Finding("lost", text, Verdict.FAILED, 10.0),))
            text = (
                f"Lost since {lost_since:.1f} s: neither a fix nor the state explains the fields."
                " Check the frequencies, phases and positions of the beacons in the site."
            )
            return Judgement((Finding("lost", text, Verdict.FAILED, 10.0),))
        if (gate.refused_in_a_row == 0 and not gate.has_no_majority) or not gate.refused:
            return Judgement()
        levels = [*gate.refused.values(), *gate.accepted.values()]
        excess = max(1.0, float(np.mean(levels)) if levels else 1.0)
        text = (
            f"The fields of {_listed(gate.refused)} were rejected together for"
            f" {max(gate.refused_in_a_row, gate.outvoted_in_a_row)} epochs, and the other beacons"
            " are no majority: a disturbance of all, or the state is wrong."
        )
        return Judgement((Finding("field_innovations", text, weight=excess),), inflation=excess)

    def _of_fields(self) -> Judgement:
        result, inflation = [], 1.0
        for name, level in self._level.items():
            mean, worth = float(level.mean[0]), level.count / self._repeats
            freedom = 6.0 * self.channels[name] * max(worth, MIN_EQUIVALENT_EPOCHS)
            limit = largest_mean_square(P_EXCESS, freedom, self._noise_freedom.get(name, np.inf))
            limit = max(limit, MIN_EXCESS)
            if mean > limit:
                inflation = max(inflation, self._repeats * mean)
                text = (
                    f"The field of beacon {name} deviates from its prediction by"
                    f" {np.sqrt(mean):.2g} times its sigma over the last {MEMORY:g} s: iron nearby,"
                    " a wrong survey of it, or motion that the IMU did not measure."
                )
                result.append(Finding("field_innovations", text, weight=mean / limit))
        for name, share in self._refused.items():
            often = float(share.mean[0])
            if often > OFTEN_REFUSED and share.count > 4.0:
                text = (
                    f"The field of beacon {name} was rejected in {100 * often:.0f} % of the last"
                    f" {MEMORY:g} s: it is moved, disturbed, or declared wrongly in the site."
                )
                result.append(Finding("beacon_excluded", text, weight=often / OFTEN_REFUSED))
        return Judgement(tuple(result), inflation=inflation)

    def _of_calibration(self, state: State) -> Judgement:
        if not self.estimated:
            return self._prior
        if state.time < self._prior_at + PRIOR_EVERY:
            return self._prior
        self._prior_at = state.time
        declared = self._declared
        if declared is None or declared.reference_time != state.calibration.reference_time:
            declared = initial_calibration(self.site, state.calibration.reference_time)
            self._declared = declared
        change = difference(declared, state.calibration, self.estimated)
        remaining = np.diagonal(state.cov)[MOTION : MOTION + len(change)]
        walk = self._walk * (state.time - self._began) / 3600.0
        prior = self._declared_variance + walk
        if self._shared_variance is None:  # also after a checkpoint
            own = (self._shared_offsets.get(b.name, np.zeros(len(b.sigma))) for b in self.estimated)
            self._shared_variance = np.concatenate(list(own))
        # Considered parameters shift estimate and error alike: their variance counts in both.
        both = 2.0 * np.minimum(self._shared_variance, remaining)
        gained = np.maximum(prior - remaining + both, MIN_GAIN * prior)
        scores, usual = np.abs(change) / np.sqrt(gained), np.maximum(prior, gained)
        of_site, result, inflation = self._of_site, [], 1.0
        total = float((change**2 / usual)[of_site].sum())
        number = int(np.count_nonzero(of_site))
        for block in self.estimated if scores[of_site].max(initial=0.0) > DOUBT else ():
            score = float(np.max(scores[block.columns]))
            if not block.parameter.of_log and score > DOUBT:
                text = (
                    f"{block.name} deviates from its declared value by {score:.1f} times what the"
                    " declared sigma allows: the value is wrong, or the sigma is too small."
                )
                result.append(Finding("prior", text, weight=score / DOUBT))
                inflation = max(inflation, score**2)
        if number and total > (limit := float(chdtri(number, 1e-5))):
            text = (
                f"Together the {number} calibration parameters deviate from their declared values"
                f" by {np.sqrt(total / number):.2g} times their declared sigmas."
            )
            result.append(Finding("prior", text, weight=total / limit))
            inflation = max(inflation, total / number)
        self._prior = Judgement(tuple(result), inflation=inflation)
        return self._prior

    @cached_property
    def _of_site(self) -> BoolArray:
        """Which of the estimated parameters belong to the site, not to a log."""
        own = [np.full(len(b.sigma), not b.parameter.of_log) for b in self.estimated]
        return np.concatenate(own)

    @cached_property
    def _walk(self) -> Array:
        """Random-walk variance of each estimated parameter in an hour."""
        own = (b.parameter.walk_per_sqrt_hour(self.site, b.owner) ** 2 for b in self.estimated)
        return np.repeat(list(own), [len(b.sigma) for b in self.estimated])

    @cached_property
    def _declared_variance(self) -> Array:
        return np.asarray(prior_sigma(self.estimated) ** 2)

    def _of_earth(self, state: State) -> Judgement:
        if self._earth.weight < 5.0:
            return Judgement()
        attitude, cov = state.world_from_body, state.cov[ROTATION, ROTATION]
        off = off_earth(self.site, self._earth.mean, attitude @ cov @ attitude.T)
        if off is None:
            return Judgement()
        return Judgement((off.finding,), turn=off.turn, shift=off.shift(state.position_world))

    def _of_what_happened(self, time: float) -> Judgement:
        result = []
        for code, until in self._uncertain_until.items():
            if time < until:
                result.append(Finding(code, _PASSED[code], weight=0.5))
        restarts = self._restarts
        kept = np.exp(-max(0.0, time - restarts.time) / RESTARTS_MEMORY) * restarts.weight
        if kept > MAX_RESTARTS - 1.0:
            text = (
                f"The platform was lost about {kept:.0f} times in the last minute: fields and"
                " inertial data are inconsistent. Check axes, signs, units and stamps of the IMU."
            )
            verdict = Verdict.FAILED if kept > 2.0 * MAX_RESTARTS else Verdict.DOUBTFUL
            result.append(Finding("restarts", text, verdict, weight=kept / MAX_RESTARTS))
        return Judgement(tuple(result))

    def _of_fixes(self) -> Judgement:
        if self._elsewhere is None:
            return Judgement()
        text = (
            f"A fix of one epoch is {self._elsewhere:.2g} m from the state: the state is in a"
            " mirrored place, or the survey of a beacon is wrong."
        )
        return Judgement(
            (Finding("fix_disagrees", text, weight=float(self._elsewhere_times)),),
            shift=self._elsewhere,
        )


_PASSED = {
    "found_again": "The platform was lost and has been recovered by a fix of one epoch.",
    "update_failed": "An update of the estimator failed: the state is only predicted.",
}


def _listed(names: dict[str, float]) -> str:
    return ", ".join(sorted(names)) or "the beacons"
