"""Tests of field and inertial residuals, by beacon, by axis, by time and in short windows.

The static field is tested at the poses of a log that does not use the Earth field.

Each is a chi square with the effective number of independent residuals, from their measured
autocorrelation.  Field residuals are taken after all uncertain parameters have moved as far as
their declared sigmas allow, and after the reported causes.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.body_iron import IRON_SPAN, calibrated, iron_on_body
from magfusion.estimation.data_checks.data_quality import beginning, is_mounted
from magfusion.estimation.data_checks.static_field import OffEarth, off_earth
from magfusion.estimation.data_checks.statistics import (
    TEST_BUDGET,
    effective_number,
    holm,
    log_p_chi_square,
    sigmas,
)
from magfusion.estimation.data_checks.still_means import SPAN, still_means
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.integrity.fixed_parameter_columns import inertial_columns
from magfusion.estimation.integrity.inertial_misfit import expected_squares, inertial_errors
from magfusion.estimation.integrity.smoothed_exclusion import LEFT_OUT
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.pose_fix import PoseFix
from magfusion.estimation.snapshot.priors import NOTHING_EXPLAINED
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.windows import MAX_WINDOW
from magfusion.units import Array, BoolArray

BLOCK, MAX_BLOCKS = 10.0, 24  # s; stretches that are tested separately
SHORT_BLOCK = 2.0  # s; all beacons together: as long as iron takes to pass one
MAX_BLOCKS_PER_HOUR = 1800  # of them, in an hour
INDEPENDENT = 3.0  # of a phasor's six numbers: one model error affects several
TOLERATED = 1.2**2  # mean square below which sigmas are acceptable
TOLERATED_INERTIAL = 1.5**2
EXPLAINED_SQUARE = 1.5  # mean square in short windows, one where noise and model are as declared
MIN_WINDOWS = 3  # per mean
SPANS_TOGETHER = 3  # whose mean is tested; about the memory of the same test online
NEAR = 0.5 * SPAN + 1.0  # s; largest distance of a state from the middle of a span
AXES = {0: "gyroscope x", 1: "gyroscope y", 2: "gyroscope z"} | {
    6: "accelerometer x",
    7: "accelerometer y",
    8: "accelerometer z",
}


class Misfit(NamedTuple):
    """Residuals of one kind in one stretch."""

    name: str  # beacon, or axis
    rows: BoolArray  # (n,), the stretch
    square: float  # mean, one where all is as declared
    log_p: float  # logarithm of the probability of this mean by chance
    whole: bool  # whether the stretch is the whole log


def blocks_of(time: Array, block: float = BLOCK, maximum: int = MAX_BLOCKS) -> list[BoolArray]:
    """Return the stretches of a log, the whole of it first; of a length (s), or as many."""
    length = float(time[-1] - time[0])
    count = int(np.clip(length / block, 1, maximum))
    at = np.minimum((time - time[0]) / max(length, 1e-9) * count, count - 1).astype(int)
    whole = np.ones(len(time), dtype=bool)
    return [whole] if count == 1 else [whole, *(at == k for k in range(count))]


def misfits(name: str, residual: Array, blocks: list[BoolArray], numbers: float) -> list[Misfit]:
    """Test residuals of one kind in every stretch.

    `residual` (n, ...): NaN where missing. `numbers`: number of independent ones at a time.
    """
    flat = residual.reshape(len(residual), -1)
    known = np.isfinite(flat).any(axis=1)
    if np.sum(known) < 2:
        return []
    share = effective_number(flat[known]) / float(np.sum(known))
    out = []
    for rows in blocks:
        own = flat[rows & known]
        if not len(own):
            continue
        freedom = numbers * max(1.0, share * len(own))
        square = float(np.nanmean(own**2))
        log_p = float(log_p_chi_square(square * freedom, freedom))
        out.append(Misfit(name, rows, square, log_p, rows is blocks[0]))
    return out


def fields(case: Case, raw: Array, weighed: Array) -> TestResult:
    """Test the residuals of the fields.

    Parameters
    ----------
    raw, weighed : ndarray, shape (n, channels, 6)
        Whitened, NaN where missing: without and with the weights of a robust loss.
    """
    result = case.result
    if not np.any(np.isfinite(raw)):
        return NOTHING
    time, channels = result.fields.time, result.fields.channels
    blocks, tests = blocks_of(time), []
    several = {name for name, tone in channels if tone}
    for c, (name, tone) in enumerate(channels):
        called = f"beacon {name}" + (f", tone {tone}" if name in several else "")
        tests += misfits(called, raw[:, c], blocks, INDEPENDENT)
    informative = _significant(tests, TOLERATED)
    if not informative:
        return NOTHING
    factor = np.maximum(_field_factor(case, weighed, blocks), _unexplained(case, raw, weighed))
    verdict = Verdict.DOUBTFUL if np.max(factor) > TOLERATED else Verdict.TRUSTWORTHY
    findings = tuple(
        _field_finding(result, named, time, verdict) for named in _by_name(informative)
    )
    return TestResult(findings, factor=factor)


def fixes(case: Case) -> TestResult:
    """Test the fixes of loose coupling, where they replace the fields."""
    graph = case.result.graph
    measured = next((m for m in graph.measurements if isinstance(m, PoseFix)), None)
    if measured is None or case.result.fix_response is None:
        return NOTHING
    error = graph.residual(measured, case.result.estimate)
    time = case.result.states.time[measured.epoch]
    informative = _significant(misfits("the fixes", error, blocks_of(time), INDEPENDENT), TOLERATED)
    if not informative:
        return NOTHING
    worst = float(max(one.square for one in informative))
    finding = Finding(
        "field_residuals",
        f"The fixes of single epochs are inconsistent with the inertial sensor"
        f" {_when(informative, time)}, by {np.sqrt(worst):.2g} times their reported sigma. Smooth"
        " with tight coupling to identify the cause.",
        Verdict.DOUBTFUL,
        float(max(sigmas(one.log_p) for one in informative)),
    )
    return TestResult((finding,), factor=np.full(len(case.pose_cov), worst))


def _significant(tests: list[Misfit], tolerated: float) -> list[Misfit]:
    informative = holm([one.log_p for one in tests], TEST_BUDGET)
    return [t for t, yes in zip(tests, informative, strict=True) if yes and t.square > tolerated]


def _by_name(informative: list[Misfit]) -> Iterator[list[Misfit]]:
    for name in dict.fromkeys(one.name for one in informative):
        yield [one for one in informative if one.name == name]


def _field_finding(result: Smoothed, named: list[Misfit], time: Array, verdict: Verdict) -> Finding:
    rms = float(np.sqrt(max(one.square for one in named)))
    error = result.declared.site.model_error
    certain = float(max(sigmas(one.log_p) for one in named))
    return Finding(
        "field_residuals",
        f"The field of {named[0].name} deviates {_when(named, time)} from the model by {rms:.2g}"
        f" times its noise and the model error of {100.0 * error:.2g} %. Iron is near the beacon or"
        " the path, its drive is not as declared, or there is a disturbance. Map the field"
        " (magfusion calibrate fieldmap), check the beacon, or declare a model_error of"
        f" {rms * error:.1g}.",
        verdict,
        certain,
    )


def _when(named: list[Misfit], time: Array) -> str:
    parts = [one for one in named if not one.whole]
    if not parts or (any(one.whole for one in named) and len(parts) > 3):
        return "throughout"
    rows = np.any([one.rows for one in parts], axis=0)
    return f"between {time[rows][0]:.0f} and {time[rows][-1]:.0f} s"


def _field_factor(case: Case, rest: Array, blocks: list[BoolArray]) -> Array:
    """Return the factor that makes the covariance of every pose honest.

    Correlated errors count as often as epochs are averaged, but no more: once in a single fix.
    """
    memory, result = _memory(case), case.result
    # Counted once: neighbouring windows share samples, which their covariance accounts for.
    lasting = [min(_persistence(rest[:, c]), memory) for c in range(rest.shape[1])]
    out = np.ones(len(result.states))
    where = np.interp(result.states.time, result.fields.time, np.arange(len(rest)))
    at = np.round(where).astype(int)
    with np.errstate(invalid="ignore"):
        for rows in blocks:
            squares = np.array(
                [_mean(rest[rows, c] ** 2) for c in range(rest.shape[1])], dtype=float
            )
            factor = float(np.nanmean(squares * lasting))
            inside = rows[at]
            out[inside] = np.maximum(out[inside], factor)
    return out


def _unexplained(case: Case, raw: Array, weighed: Array) -> Array:
    """Return the factor for poses at which no rejected beacon explains the residuals.

    Where those of the accepted beacons are too large as well, whichever is rejected, all may be
    false, as by iron near the platform.
    """
    time = case.result.fields.time
    used = np.any(raw != 0.0, axis=2)  # an excluded beacon has no weight at all
    rejected = np.sum(weighed**2, axis=2) < LEFT_OUT * np.sum(raw**2, axis=2)
    short, every = (
        blocks_of(time, SHORT_BLOCK, MAX_BLOCKS_PER_HOUR),
        np.where(used[..., None], raw, np.nan),
    )
    accepted = np.where(rejected[..., None], np.nan, every)
    tests = misfits("", accepted, short[1:] or short, INDEPENDENT * raw.shape[1])
    rows = [one.rows for one in _significant(tests, TOLERATED) if np.any(rejected[one.rows])]
    return _field_factor(case, every, rows)


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else float("nan")


def _memory(case: Case) -> float:
    """Return the number of field epochs that the estimator averages at a time."""
    graph, estimate = case.result.graph, case.result.estimate
    fields = next(m for m in graph.measurements if isinstance(m, FieldPhasors))
    states = states_in(estimate.values).rows(fields.epoch)
    by_pose = fields.linearize(states, estimate.calibration, ()).by_pose
    assert by_pose is not None
    flat = by_pose.reshape(len(by_pose), -1, 6)
    information = np.swapaxes(flat, 1, 2) @ flat
    share = np.einsum("nij,nji->n", information, case.pose_cov[fields.epoch]) / 6.0
    return float(1.0 / np.clip(np.median(share), 1.0 / len(share), 1.0))


def _persistence(residual: Array) -> float:
    """Return the sum of the autocorrelation of a series, as far as it is significant."""
    known = np.isfinite(residual)
    filled = np.where(known, residual, 0.0)
    count, square = int(np.sum(known)), float(np.sum(filled**2))
    if count == 0 or square == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, len(residual) // 3):
        both = int(np.sum(known[lag:] & known[:-lag]))
        if both == 0:
            break
        correlation = float(np.sum(filled[lag:] * filled[:-lag])) / both * count / square
        if correlation < 2.0 / np.sqrt(both):
            break
        total += 2.0 * correlation
    return total


def inertial(case: Case, estimate: GraphEstimate, step: Array) -> TestResult:
    """Test the inertial residuals at an estimate after a step of the fixed parameters, (h,)."""
    result = case.result
    if result.graph.epochs < 4 or not result.graph.measurements:
        return NOTHING
    time = 0.5 * (result.states.time[1:] + result.states.time[:-1])
    try:
        expected = expected_squares(result)
    except RuntimeError:  # of an undetermined stretch, which other tests report
        return NOTHING
    error, blocks = inertial_errors(result, estimate), blocks_of(time)
    if case.score is not None and case.log.inertial:
        error += inertial_columns(result, case.score.fixed, case.log.imu).moved(step)
    tests: list[Misfit] = []
    for row, name in AXES.items():
        if expected[row] > 1e-6:
            tests += misfits(name, error[:, row] / np.sqrt(expected[row]), blocks, 1.0)
    informative = _significant(tests, TOLERATED_INERTIAL)
    if not informative:
        return NOTHING
    worst = max(informative, key=lambda one: -one.log_p)
    rms = float(np.sqrt(worst.square))
    names = ", ".join(dict.fromkeys(one.name for one in informative))
    text = (
        f"IMU data are inconsistent with the magnetic-field solution"
        f" {_when([one for one in informative if one.name == worst.name], time)} ({names}: up to"
        f" {rms:.2g} times the declared noise). Check the inertial sensor for shocks, a wrong axis"
        " or scale, and its mounting and time stamps, or increase gyro_noise and accel_noise."
    )
    code = "inertial_residuals"
    if not case.log.inertial:
        text = (
            f"The platform moves faster than its motion prior allows"
            f" {_when([one for one in informative if one.name == worst.name], time)}: up to"
            f" {rms:.2g} times. Increase the densities in platform.motion_prior."
        )
    finding = Finding(code, text, Verdict.DOUBTFUL, float(sigmas(worst.log_p)))
    factor = np.ones(len(result.states))
    for one in informative:
        rows = np.append(one.rows, one.rows[-1]) | np.insert(one.rows, 0, one.rows[0])
        factor[rows] = np.maximum(factor[rows], one.square)
    return TestResult((finding,), factor=factor)


def together(case: Case) -> TestResult:
    """Test the short windows, in which close tones are measured jointly, in pieces of seconds."""
    graph = case.result.graph
    measured = next((m for m in graph.measurements if isinstance(m, JointPhasors)), None)
    if measured is None or len(measured.time) < MIN_WINDOWS:
        return NOTHING
    residual = graph.residual(measured, case.result.estimate)
    square = np.mean(residual**2, axis=(1, 2))
    piece = np.floor((measured.time - measured.time[0]) / MAX_WINDOW).astype(np.int64)
    count = np.bincount(piece)
    mean = np.bincount(piece, square) / np.maximum(count, 1)
    mean = np.where(count >= MIN_WINDOWS, mean, np.mean(square))
    worst = float(np.max(mean))
    if worst <= EXPLAINED_SQUARE:
        return NOTHING
    time = case.result.states.time
    at = np.floor((time - measured.time[0]) / MAX_WINDOW).astype(np.int64)
    factor = np.maximum(mean[np.clip(at, 0, len(mean) - 1)], 1.0)
    rms, share = np.sqrt(worst), 100.0 * float(np.mean(mean > EXPLAINED_SQUARE))
    finding = Finding(
        "field_residuals",
        f"The jointly measured fields deviate by up to {rms:.2g} times the noise and model error,"
        f" in {share:.0f} % of the log. A beacon is not as declared, iron is near the path, or the"
        " start is wrong. Record a longer log to identify the beacon.",
        Verdict.FAILED if rms > NOTHING_EXPLAINED else Verdict.DOUBTFUL,
        20.0 + rms,
    )
    return TestResult((finding,), factor=factor)


def compass(case: Case) -> TestResult:
    """Test the static field at the poses, and doubt the poses of the spans where it differs.

    Without that of iron on the body, which is reported by itself.
    """
    site, states, log = case.result.declared.site, case.result.states, case.log
    if case.result.earth_residual is not None or site.earth_field_world is None:
        return NOTHING
    if log.vectors is None or len(site.platform.magnetometer.axes) < 3 or not len(states):
        return NOTHING
    log = beginning(log)
    short = still_means(log, site, IRON_SPAN)
    if is_mounted(site) and any(iron_on_body(short, site)):
        site = calibrated(short, site)
    means = still_means(log, site)
    near, row, attitude = means.near(states, NEAR)
    field_body = means.field_body[near]
    if len(row) < SPANS_TOGETHER or not np.all(np.isfinite(field_body)):
        return NOTHING
    residual = np.einsum("nij,nj->ni", attitude, field_body) - site.earth_field_world
    cov = attitude @ case.pose_cov[row, :3, :3] @ np.swapaxes(attitude, 1, 2)
    result = [
        off_earth(site, np.mean(residual[k : k + SPANS_TOGETHER], axis=0), cov[k])
        for k in range(len(row) - SPANS_TOGETHER + 1)
    ]
    off = [one for one in result if one is not None]
    if not off:
        return NOTHING
    worst = max(off, key=lambda one: one.score)
    return TestResult((worst.finding,), spread=_spread_of_spans(states, means.time[near], result))


def _spread_of_spans(states: Trajectory, time: Array, result: list[OffEarth | None]) -> Array:
    """Return the possible errors of the poses nearest to each span, shape (states, 6, 6)."""
    middle = time[SPANS_TOGETHER // 2 : len(time) - SPANS_TOGETHER // 2]
    nearest = np.argmin(np.abs(states.time[:, None] - middle), axis=1)
    spread = np.zeros((len(states), 6, 6))
    for k, one in enumerate(result):
        if one is None:
            continue
        for row in np.flatnonzero(nearest == k).tolist():
            spread[row, :3, :3] = one.turn**2 * np.eye(3)
            spread[row, 3:, 3:] = one.shift(states.position_world[row]) ** 2 * np.eye(3)
    return spread
