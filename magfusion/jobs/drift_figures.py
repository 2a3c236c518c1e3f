"""Figures of an estimator's runs, with a verdict and its sentence for each criterion."""

from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.stats import chi2, ttest_ind

from magfusion.jobs.drift_events import judge_events
from magfusion.jobs.drift_world import PACE, PIECE, STRETCH, WorldRun
from magfusion.results.drift import (
    CERTAIN,
    CONFIDENCE,
    MIN_COMMON,
    QUANTITIES,
    THREE_SIGMA,
    Criterion,
    ErrorSeries,
    Quantity,
    Slope,
    Verdict,
    common_slope,
    evenly,
    in_windows,
    settled_after,
    slope_over_worlds,
    within,
    worlds_text,
)
from magfusion.results.figures import Figure, Figures, Section
from magfusion.simulation.endurance import BLOCK
from magfusion.units import DAY, Array, BoolArray

MINUTE = 60.0  # s; errors count at the phasors of whole minutes, which rests and walks have alike
# False-alarm rate of the chi-square test of the NEES: one run in fifty, fewer as the rests of a
# world are partly independent of each other.
NEES_PROBABILITY = 0.98
MAX_PROPAGATION_ERROR = 1.0  # m, at rest for a minute without a phasor
MEMORY_RATIO, MEMORY_GROWTH = 1.10, 20.0  # last hour to second; MiB
LATENCY_LIMIT = 1.10  # last hour to second, at rest, beside a bare loop of the same minutes
TIME, SECONDS, UPDATES, MEMORY, DISTORTION, BARE_SAMPLE = range(len(PACE))
FREEDOM = 6  # of a NEES of one world: the errors of its survey are drawn once, whatever its length
# Threshold, in standard deviations, on the growth of a line through the length of an error of three
# components: stationary errors, however long their correlation, exceed two less than once in a
# thousand.
CLAIMED = 2.5
# The first walk begins the run and contains the start.
_STARTED = 60.0  # s


STABILITY = {"pass": "stable", "fail": "unstable", "undecided": "inconclusive"}


def judge_runs(name: str, runs: list[WorldRun]) -> tuple[Figures, list[Criterion]]:
    """Return figures of one estimator's runs, each key beginning with its name, and the judgements.

    `name`: of the estimator. `runs`: one of each world.
    """
    figures: list[Figure] = []
    judgements: list[Criterion] = []
    for part in (
        _drifts,
        _propagation_figures,
        _consistency,
        _memory,
        _latency,
        _losses,
        judge_events,
    ):
        result, own = part(runs)
        figures += result
        judgements += own
    figures += [Figure(f"{one.name}_verdict", one.verdict) for one in judgements]
    figures += [
        Figure(f"{one.name}_stability", STABILITY[one.verdict], section=Section.REPORT)
        for one in judgements
    ]
    named = [
        replace(one, name=f"{name}_{one.name}", sentence=f"{name}: {one.sentence}")
        for one in judgements
    ]
    return Figures(*figures).prefixed(f"{name}_"), named


def minutes(run: WorldRun) -> ErrorSeries:
    """Return the states at the phasors of whole minutes."""
    return evenly(run.errors, MINUTE)


def after_settling(run: WorldRun) -> ErrorSeries:
    """Return those after the time from which slopes count."""
    series = minutes(run)
    return series.rows(series.time >= settled_after(run.task.hours))


def drift_of(quantity: Quantity, runs: list[WorldRun]) -> Slope:
    """Return the slope of the length of an error (unit per day)."""
    every = [after_settling(run) for run in runs]
    return slope_over_worlds(
        [s.time for s in every], [quantity.scale * s.size(quantity.part) for s in every]
    )


def _drifts(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    figures: list[Figure] = []
    judgements = []
    for quantity in QUANTITIES:
        name, unit = quantity.name, quantity.unit
        slope = drift_of(quantity, runs)
        every = [quantity.scale * after_settling(run).size(quantity.part) for run in runs]
        figures += [
            Figure(f"{name}_rms_{unit}", _rms(np.concatenate(every)), quantity.symbol),
            Figure(f"{name}_slope_{unit}_per_day", slope.per_day, f"{quantity.symbol} per day"),
            Figure(
                f"{name}_slope_standard_error", slope.standard_error, f"{quantity.symbol} per day"
            ),
        ]
        verdict = slope.verdict(quantity.limit)
        if len(runs) == 1:
            verdict = verdict_of_one(quantity, slope, after_settling(runs[0]))
        judgements.append(
            Criterion(
                f"{name}_drift",
                verdict,
                f"{_DRIFTS[verdict].format(name.replace('_', ' '))}: {slope.per_day:+.3g} +-"
                f" {slope.margin:.2g} {quantity.symbol} a day (95 %), limit {quantity.limit:g}",
            )
        )
        if len(runs) >= MIN_COMMON:
            result, common = _common(quantity, runs)
            figures += result
            judgements.append(common)
    walking = [run.errors.rows(run.errors.measured & ~_at_minutes(run.errors)) for run in runs]
    position = QUANTITIES[0].part
    moving = _rms(np.concatenate([w.rows(w.time > _STARTED).size(position) for w in walking]))
    return [*figures, Figure("position_rms_walking_m", moving, "m")], judgements


def _common(quantity: Quantity, runs: list[WorldRun]) -> tuple[list[Figure], Criterion]:
    """Test whether the components drift in the same direction in all worlds."""
    every = [after_settling(run) for run in runs]
    slope = common_slope(
        [s.time for s in every], [quantity.scale * s.error[:, quantity.part] for s in every]
    )
    name, unit = quantity.name, quantity.unit
    maximum = float(np.max(np.abs(slope.per_day / slope.standard_error)))
    figures = [
        Figure(f"{name}_common_slope_standard_errors", maximum),
        Figure(f"{name}_common_slope_probability", slope.probability),
        *(
            Figure(
                f"{name}_common_slope_{axis}_{unit}_per_day", per_day, f"{quantity.symbol} per day"
            )
            for axis, per_day in zip("xyz", slope.per_day.tolist(), strict=True)
        ),
    ]
    word = "a" if slope.verdict == "fail" else "no"
    sentence = (
        f"the errors of {name.replace('_', ' ')} have {word} common drift in all worlds: mean slope"
        f" of a component at most {maximum:.1f} standard errors, probability by chance"
        f" {slope.probability:.2g}, limit {THREE_SIGMA:g}"
    )
    return figures, Criterion(f"{name}_common_drift", slope.verdict, sentence)


def verdict_of_one(quantity: Quantity, slope: Slope, series: ErrorSeries) -> Verdict:
    """Test one world, with the estimator's own sigmas.

    A bias is a random walk: its errors may lie on a line for hours without any drift, which only
    several worlds can show.  Growth by less than the estimated standard deviation is not evidence
    of drift; `CLAIMED` of them is, however long the errors are correlated.
    """
    days = float(np.ptp(series.time)) / DAY
    claimed = _rms(quantity.scale * np.linalg.norm(series.sigma[:, quantity.part], axis=1))
    grown = abs(slope.per_day) * days
    if grown > CLAIMED * claimed and abs(slope.per_day) > quantity.limit:
        return "fail"
    verdict = slope.verdict(quantity.limit)
    return "undecided" if verdict == "fail" and grown < claimed else verdict


_DRIFTS = {
    "pass": "{} does not drift",
    "fail": "{} drifts",
    "undecided": "the drift of {} is within its uncertainty (run longer, or more worlds)",
}


def _propagation_figures(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    """Test the states at rest between two phasors, which are propagated by the IMU alone."""
    result = []
    for run in runs:
        errors = run.errors
        between = errors.rows(~errors.measured & (errors.time > _STARTED))
        result.append(between.size(QUANTITIES[0].part))
    every = np.concatenate(result)
    largest = float(np.max(every, initial=0.0))
    figures = [
        Figure("position_rms_between_fields_m", _rms(every), "m"),
        Figure("position_largest_between_fields_m", largest, "m"),
    ]
    verdict = within(largest, largest, MAX_PROPAGATION_ERROR)
    word = "is" if verdict == "pass" else "is not"
    sentence = (
        f"the position error between phasors {word} bounded: {_rms(every):.3g} m rms,"
        f" {largest:.3g} m at most, limit {MAX_PROPAGATION_ERROR:g}"
    )
    return figures, [Criterion("carried", verdict, sentence)]


def _at_minutes(series: ErrorSeries) -> BoolArray:
    return np.asarray(np.abs(series.time / MINUTE - np.round(series.time / MINUTE)) < 1e-7)


def nees_limits(worlds: int) -> tuple[float, float]:
    """Return the interval of the mean NEES per degree of freedom for so many worlds."""
    freedom = FREEDOM * worlds
    low, high = chi2.interval(NEES_PROBABILITY, freedom)
    return float(low) / freedom, float(high) / freedom


def _consistency(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    figures: list[Figure] = []
    judgements = []
    low, high = nees_limits(len(runs))
    for name in ("pose", "bias"):
        every = [after_settling(run) for run in runs]
        level = [getattr(s, f"{name}_nees") / 6.0 for s in every]
        time = [s.time for s in every]
        mean = float(np.mean(np.concatenate(level)))
        begin, end = settled_after(runs[0].task.hours), 3600.0 * runs[0].task.hours
        halves = in_windows(
            np.concatenate(time), np.concatenate(level), np.array([begin, 0.5 * (begin + end), end])
        ).tolist()
        figures += [
            Figure(f"{name}_nees_per_dof", mean),
            Figure(f"{name}_nees_first_half", halves[0]),
            Figure(f"{name}_nees_last_half", halves[1]),
        ]
        small = max(halves) > high
        verdict: Verdict = "fail" if small or min(halves) < low else "pass"
        word = "consistent" if verdict == "pass" else "too small" if small else "too large"
        judgements.append(
            Criterion(
                f"{name}_consistency",
                verdict,
                f"the estimated standard deviations of the {name} are {word}: NEES per degree of"
                f" freedom {mean:.3g} ({halves[0]:.3g} in the first half, {halves[1]:.3g} in the"
                f" last), limits {low:.3g} and {high:.3g} for {worlds_text(len(runs))}",
            )
        )
    innovation = np.concatenate([run.pace[:, DISTORTION] for run in runs])
    return [*figures, Figure("innovation_level", float(np.nanmean(innovation)))], judgements


def _memory(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    growth, ratio = [], []
    for run in runs:
        second, last = (float(np.median(part[:, MEMORY])) for part in _hours(run))
        growth.append(last - second)
        ratio.append(last / second)
    elapsed = 3600.0 * runs[0].task.hours - 2.0 * _hour(runs[0])
    worst = max(ratio)
    figures = [
        Figure("memory_growth_mib", max(growth), "MiB"),
        Figure("memory_growth_mib_per_day", max(growth) * DAY / elapsed, "MiB per day"),
        Figure("memory_last_to_second_hour", worst),
        Figure("memory_mib", float(max(np.max(run.pace[:, MEMORY]) for run in runs)), "MiB"),
    ]
    stays = worst < MEMORY_RATIO and max(growth) < MEMORY_GROWTH
    sentence = (
        f"memory {'does not grow' if stays else 'grows'}: {worst:.3f} times from {_spans(runs[0])},"
        f" {max(growth):+.2f} MiB, limits {MEMORY_RATIO:g} and {MEMORY_GROWTH:g}"
    )
    return figures, [Criterion("memory", "pass" if stays else "fail", sentence)]


def _latency(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    every = np.concatenate([run.pace[run.pace[:, UPDATES] > 0.0] for run in runs])
    each = 1e3 * every[:, SECONDS] / every[:, UPDATES]
    spent = sum(float(np.sum(run.pace[:, SECONDS])) for run in runs)
    bare = sum(run.bare_seconds for run in runs)
    hours = sum(run.task.hours for run in runs)
    figures = [
        Figure("update_ms_median", float(np.median(each)), "ms"),
        Figure("update_ms_p99", float(np.percentile(each, 99)), "ms"),
        Figure("update_ms_max", float(np.max(each)), "ms"),
        Figure("navigated_s_per_48_h", spent * 48.0 / hours, "s"),
        Figure("bare_loop_s_per_48_h", bare * 48.0 / hours, "s"),
        Figure("bare_loops", spent / bare),
    ]
    second, last = (np.concatenate(part) for part in zip(*map(_costs, runs), strict=True))
    if min(len(second), len(last)) < 2:
        return figures, []
    growth, margin = _growth(np.log(second), np.log(last), CONFIDENCE)
    certain = _growth(np.log(second), np.log(last), CERTAIN)[1]
    figures.append(Figure("update_last_to_second_hour", float(np.exp(growth))))
    low, high = float(np.exp(growth - certain)), float(np.exp(growth + margin))
    verdict = within(low, high, LATENCY_LIMIT)
    sentence = (
        f"{_SLOWER[verdict]}: {np.exp(growth):.2f} times from {_spans(runs[0])}, between"
        f" {np.exp(growth - margin):.2f} and {np.exp(growth + margin):.2f} (95 %), in units of a"
        f" bare loop at the same time, limit {LATENCY_LIMIT:g}"
    )
    return figures, [Criterion("latency", verdict, sentence)]


_SLOWER = {
    "pass": "the time of an update does not grow",
    "fail": "the time of an update grows",
    "undecided": "the growth of the time of an update is within its uncertainty (the machine is"
    " busy, or the run is too short)",
}


def _costs(run: WorldRun) -> tuple[Array, Array]:
    """Return the cost of updates at rest in bare loops, for each compared stretch of hours."""
    out = []
    for pace in _hours(run):
        rest = _resting(pace)
        stretch = rest[:, TIME] // (STRETCH * BLOCK)
        out.append(
            np.array(
                [
                    np.median(own[:, SECONDS] / own[:, BARE_SAMPLE])
                    for own in (rest[stretch == k] for k in np.unique(stretch))
                ]
            )
        )
    return out[0], out[1]


def _growth(second: Array, last: Array, confidence: float) -> tuple[float, float]:
    """Return a difference of means and half of its interval, by Welch's approximation."""
    result = ttest_ind(last, second, equal_var=False)
    low, high = result.confidence_interval(confidence)
    return float(np.mean(last) - np.mean(second)), 0.5 * float(high - low)


def _losses(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    total: Counter[str] = Counter()
    for run in runs:
        total.update(run.losses)
    counts = [f"{what}: {count}" for what, count in sorted(total.items())]
    lost_epochs = total["lost and found again"]
    verdict: Verdict = "fail" if lost_epochs else "pass"
    sentence = (
        f"tracking was lost {lost_epochs} times" if lost_epochs else "tracking was never lost"
    )
    return [Figure("losses", counts)], [Criterion("lost", verdict, sentence)]


def _hour(run: WorldRun) -> float:
    """Return the length of the compared stretches (s): an hour, or a quarter of a short run."""
    return 3600.0 * min(1.0, 0.25 * run.task.hours)


def _spans(run: WorldRun) -> str:
    word = "hour" if run.task.hours >= 4.0 else "quarter"
    return f"the second {word} to the last"


def _hours(run: WorldRun) -> tuple[Array, Array]:
    """Return the pace of the second and of the last hour of a run."""
    begin, hour = run.pace[:, TIME], _hour(run)
    end = 3600.0 * run.task.hours - hour
    return run.pace[(begin >= hour) & (begin < 2.0 * hour)], run.pace[begin >= end]


def _resting(pace: Array) -> Array:
    """Return the pieces of full length: those between the phasors of a walk are shorter."""
    length = np.diff(pace[:, TIME], append=np.inf)
    return np.asarray(pace[np.abs(length - PIECE) < 1e-6])


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2))) if len(value) else 0.0
