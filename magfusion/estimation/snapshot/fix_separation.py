"""Solution separation of fixes: alarm, exclusion of a faulty beacon, and protection levels."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from magfusion.estimation.posterior.protection_levels import protection_levels, with_rivals
from magfusion.estimation.posterior.separation import Separation, linear_separation
from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.many import by_beacon, parts_detected, some_fixes, whole_fixes
from magfusion.estimation.snapshot.problem import GAIN_SIGMA, FixState, epochs_of
from magfusion.estimation.snapshot.refine import joined, rows_at
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import Calibration, channels_of
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Finding, Risk, StateTrust, Trust, Verdict
from magfusion.units import DEGREE, Array, BoolArray, IntArray

MIN_PROBABILITY = 0.9  # probability of the fault hypothesis for which a beacon is excluded
MISFIT = 1e-6  # probability of a larger residual, after the faulty beacon has been excluded
MIN_DETECTED = 3  # beacons; of two that contradict each other either may be faulty


class SeparatedFixes(NamedTuple):
    """Fixes after the exclusion of faulty beacons."""

    fixes: Fixes  # with a covariance that covers an alarm not attributed to a beacon
    states: StateTrust  # doubtful where there is an alarm that no exclusion explains
    # (n, beacons), distance of the fix without each beacon from the fix with all, relative to its
    # threshold
    excess: Array
    shift_m: Array  # (n, beacons), the same in metres


@dataclass(frozen=True)
class _How:
    """Inputs and options of fixes."""

    samples: FieldSamples
    calibration: Calibration
    gravity: Gravity | None
    survey_error: bool
    free_parameters: tuple[str, ...]
    gain_sigma: float

    @property
    def names(self) -> list[str]:
        """Names of the beacons."""
        return [beacon.name for beacon in self.calibration.site.beacons]

    def without(self, rows: IntArray, excluded: BoolArray) -> "_How":
        """Return selected epochs without some beacons, shape (rows, beacons)."""
        owner = [self.names.index(name) for name, _ in self.samples.channels]
        part = self.samples.rows(rows)
        phasor = np.where(excluded[:, owner, None], np.nan, part.phasor_sensor)
        return replace(
            self,
            samples=replace(part, phasor_sensor=phasor),
            gravity=None if self.gravity is None else self.gravity.rows(rows),
        )

    def fixed(self) -> Fixes:
        """Return the fixes."""
        return fix_epochs(
            self.samples,
            self.calibration,
            gravity=self.gravity,
            survey_error=self.survey_error,
            free_parameters=self.free_parameters,
            gain_sigma=self.gain_sigma,
        )

    def fits(self, fixes: Fixes) -> BoolArray:
        """Return whether the residuals are consistent with the declared noise."""
        rows = np.sum(self.samples.numbers, axis=1) + 3 * (self.gravity is not None)
        return np.asarray(fixes.cost[:, 0] < chdtri(rows, MISFIT))


@dataclass(eq=False)
class _Result:
    """Current results of all epochs; modified in place."""

    fixes: Fixes
    level_m: Array
    level_deg: Array
    excluded: BoolArray
    bad: BoolArray  # an alarm that no exclusion explains

    def take(self, rows: IntArray, chosen: IntArray, fixes: Fixes, levels: "_Levels") -> None:
        """Replace the fixes without one beacon each, where they have no alarm."""
        good = np.flatnonzero(~levels.bad)
        kept = rows[good]
        some = fixes.rows(good)
        self.fixes = _replaced(self.fixes, kept, some)
        self.level_m[kept], self.level_deg[kept] = levels.position_m[good], levels.degrees[good]
        self.excluded[kept, chosen[good]] = True
        self.bad[kept] = False


class _Levels(NamedTuple):
    position_m: Array
    degrees: Array
    bad: BoolArray


def separate_fixes(
    samples: FieldSamples,
    calibration: Calibration,
    fixes: Fixes,
    *,
    gravity: Gravity | None = None,
    survey_error: bool = True,
    free_parameters: tuple[str, ...] = (),
    gain_sigma: float = GAIN_SIGMA,
    risk: Risk | None = None,
) -> SeparatedFixes:
    """Compare every fix with those without each beacon; exclude the faulty one.

    `samples`: of the fixes. `gravity`, `survey_error`, `free_parameters`, `gain_sigma`: those of
    the fixes, as in `magfusion.estimation.snapshot.likelihood.fix_epochs`.
    """
    risk = Risk() if risk is None else risk
    how = _How(samples, calibration, gravity, survey_error, free_parameters, gain_sigma)
    if are_many(calibration.site) and len(samples):
        return _among_many(how, fixes, risk)
    return _separated(how, fixes, risk)


def _separated(how: _How, fixes: Fixes, risk: Risk) -> SeparatedFixes:
    estimate = _separation(how, fixes)
    prior, excess = estimate.prior(risk), estimate.excess(risk)
    first = _levels(estimate, fixes, risk, prior)
    nothing = np.zeros(prior.shape, dtype=bool)
    result = _Result(fixes, *first[:2], nothing, np.any(excess > 1.0, axis=1))
    tried = result.bad & (np.sum(prior > 0.0, axis=1) >= MIN_DETECTED)
    rows = np.flatnonzero(tried)
    if len(rows):
        _leave_out(how, result, rows, estimate.likely(prior)[rows], prior[rows], risk)
    rows = np.flatnonzero(tried & result.bad)
    if len(rows):
        # Too large a deviation for a linearisation to identify the faulty beacon.
        likely = _likely_by_fixes(how, rows, prior[rows])
        _leave_out(how, result, rows, likely, prior[rows], risk)
    result.level_m[result.bad] = result.level_deg[result.bad] = np.nan
    if np.any(result.bad):
        result.fixes = _covering(result.fixes, how, result.bad)
    states = StateTrust(
        tuple(Verdict.DOUBTFUL if bad else Verdict.TRUSTWORTHY for bad in result.bad.tolist()),
        result.level_m,
        result.level_deg,
        tuple(
            tuple(name for name, out in zip(how.names, row, strict=True) if out)
            for row in result.excluded.tolist()
        ),
    )
    return SeparatedFixes(result.fixes, states, excess, estimate.shift[..., 1])


def _among_many(how: _How, fixes: Fixes, risk: Risk) -> SeparatedFixes:
    """Compare the fixes of each stretch with those without each beacon that it detects."""
    site, parts, result = how.calibration.site, [], []
    for rows, beacons, some, known, up in parts_detected(how.samples, how.calibration, how.gravity):
        channels = channels_of(site, beacons)
        own = some_fixes(fixes, rows, channels)
        here = replace(how, samples=some, calibration=known, gravity=up)
        part = _separated(here, own, risk)
        parts.append(whole_fixes(part.fixes, how.calibration, channels))
        result.append((part, beacons))
    states, count = [part.states for part, _ in result], len(site.beacons)
    return SeparatedFixes(
        joined(parts),
        StateTrust(
            tuple(verdict for state in states for verdict in state.verdict),
            np.concatenate([state.protection_level_m for state in states]),
            np.concatenate([state.protection_level_deg for state in states]),
            tuple(names for state in states for names in state.excluded),
        ),
        by_beacon([(part.excess, beacons) for part, beacons in result], count),
        by_beacon([(part.shift_m, beacons) for part, beacons in result], count),
    )


def _leave_out(
    how: _How, result: _Result, rows: IntArray, likely: Array, prior: Array, risk: Risk
) -> None:
    """Fix epochs again without the probably faulty beacon, if that is certain."""
    chosen = np.argmax(likely, axis=1)
    each = np.arange(len(rows))
    certain = likely[each, chosen] >= MIN_PROBABILITY
    rows, chosen, likely, prior = rows[certain], chosen[certain], likely[certain], prior[certain]
    if not len(rows):
        return
    excluded = chosen[:, None] == np.arange(likely.shape[1])
    part = how.without(rows, excluded)
    again = part.fixed()
    # The remaining beacons may be faulty, or the wrong one was excluded.
    known = np.where((prior > 0.0) & ~excluded, np.maximum(prior, likely), 0.0)
    estimate = _separation(part, again)
    levels = _levels(estimate, again, risk, known)
    bad = np.any(estimate.excess(risk) > 1.0, axis=1) | ~part.fits(again)
    result.take(rows, chosen, again, levels._replace(bad=bad))


def _likely_by_fixes(how: _How, rows: IntArray, prior: Array) -> Array:
    """Return the probability that each beacon is the faulty one, from the fixes without it."""
    cost = np.full(prior.shape, np.inf)
    own = np.bincount(how.calibration.site.owner, minlength=prior.shape[1])
    for beacon in range(prior.shape[1]):
        detected = np.flatnonzero(prior[:, beacon] > 0.0)
        if len(detected):
            excluded = np.zeros((len(detected), prior.shape[1]), dtype=bool)
            excluded[:, beacon] = True
            result = how.without(rows[detected], excluded).fixed()
            cost[detected, beacon] = result.cost[:, 0] + 2.0 * 6 * own[beacon]
    weight = prior * np.exp(-0.5 * (cost - np.min(cost, axis=1, keepdims=True)))
    return weight / np.sum(weight, axis=1, keepdims=True)


def _separation(how: _How, fixes: Fixes) -> Separation:
    """Return the separation at the best hypotheses, in body axes."""
    names = how.names
    owner = [names.index(name) for name, _ in how.samples.channels for _ in range(6)]
    parts, first = [], 0
    for epochs in epochs_of(
        how.samples,
        how.calibration,
        gravity=how.gravity,
        prior=None,
        survey_error=how.survey_error,
        free_parameters=how.free_parameters,
        gain_sigma=how.gain_sigma,
    ):
        rows = slice(first, first + len(epochs.samples))
        first = rows.stop
        at = FixState(
            fixes.world_from_body[rows, 0],
            fixes.position_world[rows, 0],
            fixes.phase[rows, 0],
            fixes.log_gain[rows, 0],
        )
        problem = epochs.reweighed(at.rotation, at.position) or epochs.problem
        jacobian, error, covariance = rows_at(problem, at)
        of_row = np.full(jacobian.shape[1], -1)
        of_row[: len(owner)] = owner
        parts.append(linear_separation(jacobian, error, covariance, of_row, len(names)))
    return Separation(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in Separation.__dataclass_fields__)
    )


def _levels(result: Separation, fixes: Fixes, risk: Risk, prior: Array) -> _Levels:
    """Return the levels of position (m) and attitude (deg), including alternative poses."""
    position, degrees = protection_levels(result, risk, prior=prior)
    weight = fixes.probability[:, 1:]
    way = np.linalg.norm(fixes.position_world[:, 1:] - fixes.position_world[:, :1], axis=2)
    turn = np.swapaxes(fixes.world_from_body[:, :1], 2, 3) @ fixes.world_from_body[:, 1:]
    angle = Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude() / DEGREE
    share = risk.mirrors * risk.total
    position = with_rivals(position, way, weight, share)
    degrees = with_rivals(degrees, angle.reshape(way.shape), weight, share)
    open_pose = ~fixes.determined[:, 0]
    position[open_pose] = degrees[open_pose] = np.nan
    return _Levels(position, np.minimum(degrees, 180.0), open_pose)


def _replaced(fixes: Fixes, rows: IntArray, new: Fixes) -> Fixes:
    """Replace some epochs of fixes, keeping the number of hypotheses."""
    count, result = fixes.cost.shape[1], new.cost.shape[1]
    chosen = np.minimum(np.arange(count), result - 1)
    changed = {}
    for name, value in vars(fixes).items():
        own = getattr(new, name)
        changed[name] = value.copy()
        changed[name][rows] = own if own.ndim == 1 else own[:, chosen]
    changed["cost"][np.ix_(rows, np.arange(count) >= result)] = np.inf
    return Fixes(**changed)


def _covering(fixes: Fixes, how: _How, alarmed: BoolArray) -> Fixes:
    """Inflate covariances to cover the fixes without each beacon, where there is an alarm."""
    rows = np.flatnonzero(alarmed)
    some = fixes.rows(rows)
    nothing = np.zeros((len(rows), len(how.names)), dtype=bool)
    result = _separation(how.without(rows, nothing), some)
    known = np.flatnonzero(np.any(result.determined, axis=0))
    cov = fixes.pose_cov.copy()
    for beacon in known:
        step = result.step[:, beacon]
        other = result.separation_cov[:, beacon] + step[:, :, None] * step[:, None, :]
        cov[rows, 0] += np.where(result.determined[:, beacon, None, None], other, 0.0)
    return replace(fixes, pose_cov=cov)


def separation_trust(separated: SeparatedFixes, names: tuple[str, ...], risk: Risk) -> Trust:
    """Return the findings for a whole log of fixes."""
    states, n = separated.states, len(separated.fixes)
    by_chance = risk.false_alarm * n
    maximum = by_chance + 3.0 * np.sqrt(by_chance) + 1.0
    findings = []
    for i, name in enumerate(names):
        rows = np.flatnonzero([name in left_out for left_out in states.excluded])
        if len(rows) <= maximum:
            continue
        shift, excess = np.max(separated.shift_m[rows, i]), np.max(separated.excess[rows, i])
        findings.append(
            Finding(
                "beacon_excluded",
                f"In {len(rows)} of {n} epochs the fixes without beacon {name} contradict it: by up"
                f" to {1e3 * shift:.3g} mm, {excess:.3g} times what noise and survey explain. It"
                " was excluded there. Check its drive current, and iron or a screen near it.",
                Verdict.TRUSTWORTHY,
                float(excess),
            )
        )
    doubtful = np.array([v is not Verdict.TRUSTWORTHY for v in states.verdict])
    if np.sum(doubtful) > maximum:
        shift, excess = (np.max(part[doubtful]) for part in (separated.shift_m, separated.excess))
        findings.append(
            Finding(
                "separation",
                f"In {int(np.sum(doubtful))} of {n} epochs the beacons contradict each other, and"
                f" the faulty one cannot be identified: excluding one moves the fix by up to"
                f" {1e3 * shift:.3g} mm, {excess:.3g} times what noise and survey explain. Check"
                " positions and moments of the beacons in the site, and iron in the room.",
                weight=float(excess),
            )
        )
    without = ~np.isfinite(states.protection_level_m) & ~doubtful
    if np.any(without):
        findings.append(
            Finding(
                "no_redundancy",
                f"{int(np.sum(without))} of {n} epochs have no protection level: without one of the"
                " beacons the pose is not determined, so that a fault of it is not detectable."
                " Add a beacon.",
                Verdict.TRUSTWORTHY,
                0.0,
            )
        )
    return Trust(tuple(findings))
