"""Exclusion of false beacons from a smoothed trajectory, by stretches of time."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation
from scipy.special import chdtri

from magfusion.estimation.batch.batch import Smoothed, solved_again
from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.graph.measurement import Measurement, robust_weight
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.integrity.smoothed_separation import (
    aiding_used,
    separate_sensors,
    separate_smoothed,
)
from magfusion.estimation.measurements.joint_phasors import JointPhasors, at_nearest
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import SLACK, Separation, radii
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import LISTED, Finding, Risk, StateTrust, Trust, Verdict, uniform_trust
from magfusion.units import Array, BoolArray, IntArray

UNEXPECTED = 1e-4  # probability of a larger deviation of a field from the others' prediction
JOINED = 1.0  # s; a shorter gap between two false stretches is false too
BETTER = 0.8  # of the largest separation, above which an exclusion has not explained it
MAX_FALSE = 0.9  # share of a log; a beacon that is false for longer is declared wrongly
LEFT_OUT = 0.1  # robust weight below which a field does not count
ROUNDS = 3  # of exclusions
TOGETHER = 3.0  # s; closer stretches are reported as one
MIN_LEFT_OUT_EPOCHS = 5  # excluded field epochs of a beacon that are reported; fewer are outliers
MAX_EXCLUSION = 5.0  # s of a beacon; after more, other findings are its traces
EXCLUDED_FIRST = 1e5  # weight
OF_A_LOG = 5e-4  # false alarms of a whole log


class SeparatedSmooth(NamedTuple):
    """A smoothed trajectory after the exclusion of false fields."""

    result: Smoothed  # where an alarm remains, its covariance covers it
    states: StateTrust  # of each state
    trust: Trust  # of the whole


def separated_smooth(
    result: Smoothed, risk: Risk | None = None, *, excluding: bool = True
) -> SeparatedSmooth:
    """Compare a smoothed trajectory with those without each beacon; exclude false fields."""
    risk = Risk() if risk is None else risk
    names = tuple(beacon.name for beacon in result.declared.site.beacons)
    estimate = separate_smoothed(result)
    if estimate is None or result.states.pose_cov is None:
        return _without_level(result)
    first = estimate
    out = np.zeros((len(result.fields.time), len(names)), dtype=bool)
    if excluding:
        result, estimate, out = _without_false(result, estimate, names, risk)
    sources = [f"beacon {name}" for name in names]
    if (by_sensor := separate_sensors(result)) is not None:
        estimate |= by_sensor
        sources += aiding_used(result)
    excess = estimate.excess(risk, SLACK)
    alarmed = np.any(excess > 1.0, axis=1)
    level_m, level_deg = protection_levels(estimate, risk, SLACK)
    level_m[alarmed] = level_deg[alarmed] = np.nan
    out |= _without_weight(result, names)
    trust = Trust(
        (
            *_excluded_findings(result, first, out, names),
            *_alarm_findings(result, estimate, excess, sources, risk),
            *_redundancy_findings(level_m, alarmed),
        )
    )
    if np.any(alarmed):
        result = _covering(result, estimate, alarmed)
    verdict = tuple(Verdict.DOUBTFUL if a else Verdict.TRUSTWORTHY for a in alarmed.tolist())
    excluded = _names_by_state(result, out, names)
    return SeparatedSmooth(result, StateTrust(verdict, level_m, level_deg, excluded), trust)


def _without_false(
    result: Smoothed, separated: Separation, names: tuple[str, ...], risk: Risk
) -> tuple[Smoothed, Separation, BoolArray]:
    """Exclude stretches of beacons, one after the other, while that reduces the separation.

    Returns `result`, `separated`: without them; `out` (n, beacons): the excluded fields.
    """
    out = np.zeros((len(result.fields.time), len(names)), dtype=bool)
    for _ in range(ROUNDS):
        # Significant deviations count, whether covered or not.
        before = float(np.max(separated.excess(risk)))
        if before <= 1.0:
            break
        beacon = int(np.argmin(np.mean(separated.cost + 2.0 * separated.rows, axis=0)))
        false = _false_stretches(result, separated, beacon)
        if not np.any(false & ~out[:, beacon]) or np.mean(false) > MAX_FALSE:
            break
        trial = _resolved(result, names[beacon], false)
        again = None if trial is None else separate_smoothed(trial)
        if trial is None or again is None or np.max(again.excess(risk)) > BETTER * before:
            break  # it is not this beacon, or not only this one
        result, separated = trial, again
        out[:, beacon] |= false
    return result, separated, out


def states_judged(separated: SeparatedSmooth, result: Smoothed, whole: Verdict) -> StateTrust:
    """Return the judgement of each state, after all tests.

    `result`: with the covariance that they allow.
    """
    before, after = separated.result.states.pose_cov, result.states.pose_cov
    assert before is not None
    assert after is not None
    ratio = radii(after).whole / radii(before).whole
    return separated.states.within(whole, np.maximum(ratio, 1.0))


def states_between(states: StateTrust, known: Trajectory, dense: Trajectory) -> StateTrust:
    """Return the judgement at other times: that of the nearest state, as far as it applies.

    `known`: of the states.
    """
    if known is dense:
        return states
    assert known.pose_cov is not None
    assert dense.pose_cov is not None
    middle = 0.5 * (known.time[1:] + known.time[:-1])
    nearest = np.searchsorted(middle, dense.time)
    ratio = radii(dense.pose_cov).whole / radii(known.pose_cov[nearest]).whole
    return states.rows(nearest).within(Verdict.TRUSTWORTHY, np.maximum(ratio, 1.0))


def _without_level(result: Smoothed) -> SeparatedSmooth:
    """Return a result without a separation."""
    text = (
        "There are no protection levels: they need the phasors of all beacons in one solution."
        " Loose coupling, logs of hours, and tones that are only measured jointly do not provide"
        " this."
    )
    trust = Trust((Finding("no_redundancy", text, Verdict.TRUSTWORTHY, 0.0),))
    return SeparatedSmooth(result, uniform_trust(len(result.states), Verdict.TRUSTWORTHY), trust)


def _phasors(result: Smoothed) -> FieldPhasors:
    return next(m for m in result.graph.measurements if isinstance(m, FieldPhasors))


def _owner(result: Smoothed, names: tuple[str, ...]) -> IntArray:
    return np.array([names.index(name) for name, _ in result.fields.channels])


def _false_stretches(result: Smoothed, separated: Separation, beacon: int) -> BoolArray:
    """Return at which field epochs a beacon deviates from the others' prediction, shape (m,)."""
    names = tuple(b.name for b in result.declared.site.beacons)
    own = _owner(result, names) == beacon
    phasors, states = _phasors(result).alone(), states_in(result.estimate.values)
    rows = phasors.linearize(states.rows(phasors.epoch), result.calibration, ())
    jacobian = rows.jacobian(0)[:, own][..., :6]
    jacobian = jacobian.reshape(len(phasors.epoch), -1, 6)
    error = rows.error[:, own].reshape(len(phasors.epoch), -1)
    at = phasors.epoch
    error = error + (jacobian @ separated.step[at, beacon][..., None])[..., 0]
    cov = jacobian @ separated.subset_cov[at, beacon] @ np.swapaxes(jacobian, 1, 2)
    repeats = overlap(result.fields)
    spread = cov + np.eye(error.shape[1]) / repeats
    square = np.sum(error * np.linalg.solve(spread, error[..., None])[..., 0], axis=1)
    detected = np.any(phasors.sqrt_information[:, own] != 0.0, axis=(1, 2, 3))
    deviates = detected & (square > chdtri(error.shape[1], UNEXPECTED))
    step = float(np.median(np.diff(result.fields.time)))
    near = np.ones(2 * int(np.ceil(JOINED / step)) + 1, dtype=bool)
    window = np.ones(2 * int(np.ceil(repeats)) + 1, dtype=bool)
    joined = binary_closing(np.pad(deviates, len(near)), near)[len(near) : -len(near)]
    return np.asarray(binary_dilation(joined | deviates, window) & detected)


def _resolved(result: Smoothed, name: str, false: BoolArray) -> Smoothed | None:
    """Return the result without a beacon at some field epochs; None if there is no solution."""
    try:
        return solved_again(result, without_beacon(result, name, false))
    except RuntimeError:  # GTSAM's: without it the pose is undetermined
        return None


def without_beacon(
    result: Smoothed, name: str, false: BoolArray | None = None
) -> tuple[Measurement, ...]:
    """Return the measurements of a result without a beacon, at some field epochs or at all."""
    phasors = _phasors(result)
    false = np.ones(len(phasors.time), dtype=bool) if false is None else false
    own = np.array([owner == name for owner, _ in result.fields.channels])
    left_out = (false[:, None] & own)[..., None, None]
    kept = replace(phasors, sqrt_information=np.where(left_out, 0.0, phasors.sqrt_information))
    every = result.graph.measurements
    return tuple(_without_part(m, phasors, kept, false, own) for m in every)


def _without_part(
    measurement: Measurement,
    phasors: FieldPhasors,
    kept: FieldPhasors,
    false: BoolArray,
    own: BoolArray,
) -> Measurement:
    """Return a measurement without a beacon."""
    if isinstance(measurement, JointPhasors):
        out = at_nearest(phasors.time, false[:, None] & own, measurement.time)
        return measurement.leaving_out(out)
    return kept if measurement is phasors else measurement


def _without_weight(result: Smoothed, names: tuple[str, ...]) -> BoolArray:
    """Return at which field epochs the robust loss rejects a beacon, (m, beacons)."""
    loss, owner = _phasors(result).loss, _owner(result, names)
    out = np.zeros((len(result.residual), len(names)), dtype=bool)
    if loss is None:
        return out
    # By the residual of each epoch itself, not of correlated epochs together.
    square = np.sum(np.nan_to_num(result.residual) ** 2, axis=2)
    weight, _ = robust_weight(square, loss.kind)
    for j in range(len(names)):
        own = np.any(weight[:, owner == j] < LEFT_OUT, axis=1)
        # A beacon that is always rejected is declared wrongly, which other tests report.
        out[:, j] = own & (np.mean(own) <= MAX_FALSE)
    return out


def _names_by_state(
    result: Smoothed, out: BoolArray, names: tuple[str, ...]
) -> tuple[tuple[str, ...], ...]:
    by_state = np.zeros((len(result.states), len(names)), dtype=bool)
    by_state[result.epoch] = out
    return tuple(
        tuple(name for name, is_out in zip(names, row, strict=True) if is_out)
        for row in by_state.tolist()
    )


def _covering(result: Smoothed, separated: Separation, alarmed: BoolArray) -> Smoothed:
    """Return the result with a covariance that covers those without each beacon."""
    assert result.states.pose_cov is not None
    cov = result.states.pose_cov.copy()
    step = np.where(separated.determined[..., None], separated.step, 0.0)[alarmed]
    cov[alarmed] += np.einsum("nbi,nbj->nij", step, step)
    return replace(result, states=replace(result.states, pose_cov=cov))


def _largest(separated: Separation, beacon: int | None = None) -> float:
    shift = np.where(separated.determined, separated.shift[..., 1], 0.0)
    return float(np.max(shift if beacon is None else shift[:, beacon]))


def _excluded_findings(
    result: Smoothed, separated: Separation, out: BoolArray, names: tuple[str, ...]
) -> list[Finding]:
    findings = []
    time = result.fields.time
    for j in np.flatnonzero(np.sum(out, axis=0) >= MIN_LEFT_OUT_EPOCHS).tolist():
        spans = [
            f"{time[a]:.1f} to {time[b]:.1f} s"
            for a, b in _stretches(np.flatnonzero(out[:, j]), time)
        ]
        lasting = float(np.sum(out[:, j]) * np.median(np.diff(time))) > MAX_EXCLUSION
        more = f" and {len(spans) - LISTED} more times" if len(spans) > LISTED else ""
        findings.append(
            Finding(
                "beacon_excluded",
                f"Beacon {names[j]} contradicts the others from {', '.join(spans[:LISTED])}{more}:"
                f" the trajectory without it is up to {1e3 * _largest(separated, j):.3g} mm away,"
                " so it is excluded there. Check its drive current, and iron or a shield near it.",
                Verdict.TRUSTWORTHY,
                EXCLUDED_FIRST if lasting else 1.0,
            )
        )
    return findings


def excluded_to_the_end(separated: SeparatedSmooth) -> dict[str, float]:
    """Return from when on (s) a beacon is excluded, where it is until the end."""
    result, excluded = separated.result, separated.states.excluded
    time, onsets = result.fields.time, {}
    for beacon in result.declared.site.beacons if excluded else ():
        out = np.flatnonzero([beacon.name in excluded[i] for i in result.epoch.tolist()])
        if not len(out):
            continue
        first, last = _stretches(out, time)[-1]
        lasting = time[last] - time[first] > MAX_EXCLUSION
        if lasting and first > 0 and time[-1] - time[last] < TOGETHER:
            onsets[beacon.name] = float(time[first])
    return onsets


def with_long_exclusions(trust: Trust) -> Trust:
    """Return findings in which a long exclusion precedes all others: they are its traces.

    An exclusion that explains everything remains a remark.
    """
    if not trust.reasons:
        return trust
    findings = tuple(
        replace(f, verdict=Verdict.DOUBTFUL)
        if f.code == "beacon_excluded" and f.weight >= EXCLUDED_FIRST
        else f
        for f in trust.findings
    )
    return replace(trust, findings=findings)


def _stretches(epochs: IntArray, time: Array) -> list[tuple[int, int]]:
    """Return first and last epoch of stretches; close ones are joined."""
    separate = np.flatnonzero(np.diff(time[epochs]) > TOGETHER)
    begins, ends = epochs[np.r_[0, separate + 1]], epochs[np.r_[separate, len(epochs) - 1]]
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def _alarm_findings(
    result: Smoothed, separated: Separation, excess: Array, sources: list[str], risk: Risk
) -> list[Finding]:
    worst = float(np.max(excess))
    if worst <= _of_a_whole_log(separated, risk):
        return []
    state, source = np.unravel_index(np.argmax(excess), excess.shape)
    is_beacon = source < len(result.declared.site.beacons)
    remedy = (
        "the beacons contradict each other. Check their positions and moments in the site, and iron"
        " in the room."
        if is_beacon
        else "it contradicts the others. Check its scale, mounting and clock in the site."
    )
    text = (
        f"The trajectory with and without {sources[int(source)]} differ by up to"
        f" {1e3 * _largest(separated, int(source)):.3g} mm, {worst:.3g} times what noise and survey"
        f" explain, most at {result.states.time[int(state)]:.1f} s: {remedy}"
    )
    return [Finding("separation", text, weight=worst)]


def _of_a_whole_log(separated: Separation, risk: Risk) -> float:
    """Return the excess over the threshold that only one log in many exceeds by chance."""
    tests = 2 * separated.step.shape[1]
    alone = separated.separation_sigma.beyond(risk.false_alarm / tests)
    every = separated.separation_sigma.beyond(OF_A_LOG / (tests * len(separated.step)))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(every / alone, 1.0)
    return float(np.nanmax(np.where(np.isfinite(ratio), ratio, 1.0)))


def _redundancy_findings(level_m: Array, alarmed: BoolArray) -> list[Finding]:
    without = ~np.isfinite(level_m) & ~alarmed
    if not np.any(without):
        return []
    text = (
        f"{int(np.sum(without))} of {len(level_m)} states have no protection level: without one of"
        " the beacons or aiding sensors the pose is undetermined, so that a false one would not be"
        " detected. Add a beacon."
    )
    return [Finding("no_redundancy", text, Verdict.TRUSTWORTHY, 0.0)]
