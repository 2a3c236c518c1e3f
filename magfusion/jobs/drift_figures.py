"""What the runs of an estimator come to: figures, and a verdict in words for each."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.stats import ttest_ind

from magfusion.evaluation.drift import (
    CONFIDENCE,
    DAY,
    FEWEST_COMMON,
    QUANTITIES,
    THREE_SIGMA,
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
)
from magfusion.jobs.drift_world import PACE, PIECE, STRETCH, WorldRun
from magfusion.report import Figures
from magfusion.simulation.endurance import BLOCK
from magfusion.units import Array, BoolArray

MINUTE = 60.0  # s; errors count at the phasors of whole minutes, which rests and walks have alike
NEES_LIMITS = (0.5, 2.0)  # of a degree of freedom; sigmas honest to within a factor of 1.4
CARRIED_LIMIT = 1.0  # m, at rest for a minute without a phasor
MEMORY_RATIO, MEMORY_GROWTH = 1.10, 20.0  # last hour to second; MiB
LATENCY_LIMIT = 1.10  # last hour to second, at rest, beside a bare loop of the same minutes
TIME, SECONDS, UPDATES, MEMORY, DISTORTION, BARE_SAMPLE = range(len(PACE))
FEW_WORLDS = 4
# The first walk begins the run; the start is found in it.
_STARTED = 60.0  # s


@dataclass(frozen=True)
class Finding:
    """One judged figure.

    Parameters
    ----------
    name : str
        Of its verdict in the report.
    verdict : {'pass', 'fail', 'undecided'}
    sentence : str
    """

    name: str
    verdict: Verdict
    sentence: str


def judged(name: str, runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    """Return figures of one estimator's runs, each key beginning with its name, and the findings.

    Parameters
    ----------
    name : str
        Of the estimator.
    runs : list of WorldRun
        One of each world.
    """
    figures: Figures = {}
    findings: list[Finding] = []
    for part in (_drifts, _carried, _consistency, _memory, _latency, _losses):
        found, told = part(runs)
        figures |= {f"{name}_{key}": value for key, value in found.items()}
        findings += [Finding(f"{name}_{f.name}", f.verdict, f"{name}: {f.sentence}") for f in told]
    figures |= {f"{finding.name}_verdict": finding.verdict for finding in findings}
    return figures, findings


def minutes(run: WorldRun) -> ErrorSeries:
    """Return the states at the phasors of whole minutes."""
    return evenly(run.errors, MINUTE)


def settled(run: WorldRun) -> ErrorSeries:
    """Return the same after the time from which slopes count."""
    series = minutes(run)
    return series.rows(series.time >= settled_after(run.task.hours))


def drift_of(quantity: Quantity, runs: list[WorldRun]) -> Slope:
    """Return the slope of the length of an error (unit per day)."""
    every = [settled(run) for run in runs]
    return slope_over_worlds(
        [s.time for s in every], [quantity.scale * s.size(quantity.part) for s in every]
    )


def _drifts(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    figures: Figures = {}
    findings = []
    for quantity in QUANTITIES:
        name, unit = quantity.name, quantity.unit
        slope = drift_of(quantity, runs)
        every = [quantity.scale * settled(run).size(quantity.part) for run in runs]
        figures |= {
            f"{name}_rms_{unit}": _rms(np.concatenate(every)),
            f"{name}_slope_{unit}_per_day": slope.per_day,
            f"{name}_slope_standard_error": slope.standard_error,
        }
        verdict = slope.verdict(quantity.limit)
        if verdict == "fail" and len(runs) == 1 and _as_claimed(quantity, slope, settled(runs[0])):
            verdict = "undecided"
        findings.append(
            Finding(
                f"{name}_drift",
                verdict,
                f"{name} {_WORDS[verdict]}: {slope.per_day:+.3g} +- {slope.margin:.2g} {unit} a day"
                f" (95 %), limit {quantity.limit:g}",
            )
        )
        if len(runs) >= FEWEST_COMMON:
            found, told = _common(quantity, runs)
            figures |= found
            findings.append(told)
    walking = [run.errors.rows(run.errors.measured & ~_at_minutes(run.errors)) for run in runs]
    position = QUANTITIES[0].part
    figures["position_rms_walking_m"] = _rms(
        np.concatenate([w.rows(w.time > _STARTED).size(position) for w in walking])
    )
    return figures, findings


def _common(quantity: Quantity, runs: list[WorldRun]) -> tuple[Figures, Finding]:
    """Judge what the components have in common in all worlds."""
    every = [settled(run) for run in runs]
    slope = common_slope(
        [s.time for s in every], [quantity.scale * s.error[:, quantity.part] for s in every]
    )
    name, unit = quantity.name, quantity.unit
    most = float(np.max(np.abs(slope.per_day / slope.standard_error)))
    figures: Figures = {
        f"{name}_common_slope_standard_errors": most,
        f"{name}_common_slope_probability": slope.probability,
    }
    for axis, per_day in zip("xyz", slope.per_day.tolist(), strict=True):
        figures[f"{name}_common_slope_{axis}_{unit}_per_day"] = per_day
    word = "go one way" if slope.verdict == "fail" else "do not go one way"
    told = (
        f"the worlds' errors of {name} {word}: slope of a component at most {most:.1f} standard"
        f" errors, of all three by chance with p = {slope.probability:.2g}, limit {THREE_SIGMA:g}"
    )
    return figures, Finding(f"{name}_common_drift", slope.verdict, told)


def _as_claimed(quantity: Quantity, slope: Slope, series: ErrorSeries) -> bool:
    """Tell whether an error of one world grew by no more than the estimator says of itself.

    A bias walks; its block means then lie on a line for hours, which several worlds show to be
    none.
    """
    days = float(np.ptp(series.time)) / DAY
    claimed = quantity.scale * np.linalg.norm(series.sigma[:, quantity.part], axis=1)
    return abs(slope.per_day) * days < _rms(claimed)


_WORDS = {
    "pass": "does not drift",
    "fail": "drifts",
    "undecided": "is not told to drift nor to stand (run longer, or more worlds)",
}


def _carried(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    """Judge the states at rest between two phasors, which the IMU alone carries on."""
    found = []
    for run in runs:
        errors = run.errors
        between = errors.rows(~errors.measured & (errors.time > _STARTED))
        found.append(between.size(QUANTITIES[0].part))
    every = np.concatenate(found)
    largest = float(np.max(every, initial=0.0))
    figures: Figures = {
        "position_rms_between_fields_m": _rms(every),
        "position_largest_between_fields_m": largest,
    }
    verdict = within(largest, largest, CARRIED_LIMIT)
    word = "stays" if verdict == "pass" else "does not stay"
    told = f"between phasors the position {word}: {_rms(every):.3g} m rms, {largest:.3g} m at most"
    return figures, [Finding("carried", verdict, f"{told}, limit {CARRIED_LIMIT:g}")]


def _at_minutes(series: ErrorSeries) -> BoolArray:
    return np.asarray(np.abs(series.time / MINUTE - np.round(series.time / MINUTE)) < 1e-7)


def _consistency(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    figures: Figures = {}
    findings = []
    low, high = NEES_LIMITS
    for name in ("pose", "bias"):
        every = [settled(run) for run in runs]
        level = [getattr(s, f"{name}_nees") / 6.0 for s in every]
        time = [s.time for s in every]
        mean = float(np.mean(np.concatenate(level)))
        begin, end = settled_after(runs[0].task.hours), 3600.0 * runs[0].task.hours
        halves = in_windows(
            np.concatenate(time),
            np.concatenate(level),
            np.array([begin, 0.5 * (begin + end), end]),
        ).tolist()
        figures |= {
            f"{name}_nees_per_dof": mean,
            f"{name}_nees_first_half": halves[0],
            f"{name}_nees_last_half": halves[1],
        }
        verdict: Verdict = "pass" if low < mean < high else "fail"
        if mean <= low and len(runs) < FEW_WORLDS:
            verdict = "undecided"  # a world is one draw of the survey's error
        word = "honest" if verdict == "pass" else "too small" if mean >= high else "too large"
        findings.append(
            Finding(
                f"{name}_consistency",
                verdict,
                f"the sigmas of the {name} are {word}: squared error {mean:.3g} of what they say"
                f" ({halves[0]:.3g} in the first half, {halves[1]:.3g} in the last), limits {low:g}"
                f" and {high:g}",
            )
        )
    innovation = np.concatenate([run.pace[:, DISTORTION] for run in runs])
    figures["innovation_level"] = float(np.nanmean(innovation))
    return figures, findings


def _memory(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    growth, ratio = [], []
    for run in runs:
        second, last = (float(np.median(part[:, MEMORY])) for part in _hours(run))
        growth.append(last - second)
        ratio.append(last / second)
    elapsed = 3600.0 * runs[0].task.hours - 2.0 * _hour(runs[0])
    worst = max(ratio)
    figures: Figures = {
        "memory_growth_mib": max(growth),
        "memory_growth_mib_per_day": max(growth) * DAY / elapsed,
        "memory_last_to_second_hour": worst,
        "memory_mib": float(max(np.max(run.pace[:, MEMORY]) for run in runs)),
    }
    stays = worst < MEMORY_RATIO and max(growth) < MEMORY_GROWTH
    told = (
        f"memory {'stays' if stays else 'grows'}: {worst:.3f} times from {_spans(runs[0])},"
        f" {max(growth):+.2f} MiB, limits {MEMORY_RATIO:g} and {MEMORY_GROWTH:g}"
    )
    return figures, [Finding("memory", "pass" if stays else "fail", told)]


def _latency(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    every = np.concatenate([run.pace[run.pace[:, UPDATES] > 0.0] for run in runs])
    each = 1e3 * every[:, SECONDS] / every[:, UPDATES]
    spent = sum(float(np.sum(run.pace[:, SECONDS])) for run in runs)
    bare = sum(run.bare_seconds for run in runs)
    hours = sum(run.task.hours for run in runs)
    figures: Figures = {
        "update_ms_median": float(np.median(each)),
        "update_ms_p99": float(np.percentile(each, 99)),
        "update_ms_max": float(np.max(each)),
        "navigated_s_per_48_h": spent * 48.0 / hours,
        "bare_loop_s_per_48_h": bare * 48.0 / hours,
        "bare_loops": spent / bare,
    }
    second, last = (np.concatenate(part) for part in zip(*map(_costs, runs), strict=True))
    if min(len(second), len(last)) < 2:
        return figures, []
    growth, margin = _growth(np.log(second), np.log(last))
    figures["update_last_to_second_hour"] = float(np.exp(growth))
    verdict = within(float(np.exp(growth - margin)), float(np.exp(growth + margin)), LATENCY_LIMIT)
    told = (
        f"updates {_SLOWER[verdict]}: {np.exp(growth):.2f} times from {_spans(runs[0])}, between"
        f" {np.exp(growth - margin):.2f} and {np.exp(growth + margin):.2f} (95 %), beside a bare"
        f" loop of the same minutes, limit {LATENCY_LIMIT:g}"
    )
    return figures, [Finding("latency", verdict, told)]


_SLOWER = {
    "pass": "are as fast at the end as before",
    "fail": "become slower",
    "undecided": "are not told to become slower nor to stay (the machine is busy, or run longer)",
}


def _costs(run: WorldRun) -> tuple[Array, Array]:
    """Return what updates at rest cost in bare loops, of each stretch of the hours compared."""
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


def _growth(second: Array, last: Array) -> tuple[float, float]:
    """Return a difference of means and half its interval of 95 %, by Welch's approximation."""
    found = ttest_ind(last, second, equal_var=False)
    low, high = found.confidence_interval(CONFIDENCE)
    return float(np.mean(last) - np.mean(second)), 0.5 * float(high - low)


def _losses(runs: list[WorldRun]) -> tuple[Figures, list[Finding]]:
    total: Counter[str] = Counter()
    for run in runs:
        total.update(run.losses)
    figures: Figures = {"losses": [f"{what}: {count}" for what, count in sorted(total.items())]}
    lost = total["lost and found again"]
    verdict: Verdict = "fail" if lost else "pass"
    told = f"it was lost {lost} times" if lost else "it was never lost"
    return figures, [Finding("lost", verdict, told)]


def _hour(run: WorldRun) -> float:
    """Return the length of what is compared (s): an hour, or a quarter of a run below four."""
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
