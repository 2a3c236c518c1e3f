"""What does one false beacon cost an offline result?  Logs smoothed with a fault and without.

The walks of ``integrity_runs``: four beacons whose field deviates from the model, from place to
place, by what is declared; from an instant on one beacon's is false by up to 20 %, at once or in a
ramp.  The same walk is smoothed without the fault, too, and once more by plain least squares.

1. The error with a fault is at most 1.5 times that without, or the result is not trusted.
2. Without a fault, robust estimation and exclusion cost at most 2 %.

The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from integrity import Config as Room
from integrity import room
from integrity_runs import Config as Walk
from integrity_runs import simulated

from magfusion.errors import EstimationError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.jobs.smooth_result import finished
from magfusion.model.samples import Log
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.simulation.monte_carlo import run_many


@dataclass(frozen=True)
class Config:
    """How many walks, and how false a beacon may be."""

    runs: int = 50
    largest: float = 0.2
    seed: int = 0


@dataclass(frozen=True)
class SmoothOutcome:
    """What came of one walk.

    Parameters
    ----------
    share, ramp : float
        Of the field that is false at last, and the time until then (s).
    error_m, fault_free_m, plain_m : float
        Root mean square with the fault, without it, and without it by plain least squares.
    nees : float
        With the fault, the mean.
    verdict : str
        With the fault.
    """

    share: float
    ramp: float
    error_m: float
    fault_free_m: float
    plain_m: float
    nees: float
    verdict: str
    fault_free_verdict: str

    @property
    def ratio(self) -> float:
        """Error with the fault over that without."""
        return self.error_m / self.fault_free_m


class Figures(NamedTuple):
    """Size of the run."""

    runs: int
    ratio_trusted: float
    ratio_worst_trusted: float
    beyond_trusted: int
    silent: int
    cost_of_robustness: float
    doubtful_without_fault: int


def try_walk(config: Config, rng: np.random.Generator) -> SmoothOutcome:
    """Return what came of one walk."""
    walk, state = Walk(largest=config.largest), rng.bit_generator.state
    log, motion, _, share, ramp = simulated(walk, rng)
    rng.bit_generator.state = state  # the same walk, and the same noise
    good = simulated(replace(walk, largest=0.0), rng)[0]
    # Finer than the field's epochs, at which an offline result has its states.
    truth = motion.trajectory(np.arange(0.0, walk.duration, 0.02))
    faulty, verdict = _smoothed(log, truth)
    clean, clean_verdict = _smoothed(good, truth)
    plain = smooth(good, room(Room()), SmootherSettings(loss=None))
    return SmoothOutcome(
        share=share,
        ramp=ramp,
        error_m=np.nan if faulty is None else faulty.ate,
        fault_free_m=np.nan if clean is None else clean.ate,
        plain_m=trajectory_errors(plain.states, truth).ate,
        nees=np.nan if faulty is None or faulty.nees is None else float(np.mean(faulty.nees)),
        verdict=verdict,
        fault_free_verdict=clean_verdict,
    )


def _smoothed(log: Log, truth: Trajectory) -> tuple[TrajectoryErrors | None, str]:
    site, settings = room(Room()), SmootherSettings()
    try:
        done = finished(log, site, settings, smooth(log, site, settings), None)
    except EstimationError:
        return None, str(Verdict.FAILED)
    return trajectory_errors(done.result.states, truth), str(done.trust.verdict)


def run(config: Config, scale: Scale | None = None) -> list[SmoothOutcome]:
    """Return what came of all walks."""
    return run_many(try_walk, [config] * config.runs, seed=config.seed, **(scale or {}))


def figures(result: Sequence[SmoothOutcome]) -> Figures:
    """Return the figures of all walks."""
    trusted = [one for one in result if one.verdict == Verdict.TRUSTWORTHY]
    ratios = [one.ratio for one in trusted]
    return Figures(
        runs=len(result),
        ratio_trusted=float(np.median(ratios)) if ratios else np.nan,
        ratio_worst_trusted=max(ratios, default=np.nan),
        beyond_trusted=sum(ratio > 1.5 for ratio in ratios),
        silent=sum(one.nees > 20.0 for one in trusted),
        cost_of_robustness=_rms(result, "fault_free_m") / _rms(result, "plain_m") - 1.0,
        doubtful_without_fault=sum(o.fault_free_verdict != Verdict.TRUSTWORTHY for o in result),
    )


def _rms(result: Sequence[SmoothOutcome], name: str) -> float:
    return float(np.sqrt(np.nanmean([getattr(one, name) ** 2 for one in result])))


def report(result: Sequence[SmoothOutcome]) -> str:
    """Return what a reader sees."""
    sums = figures(result)
    lines = [
        f"{'false by':>9}{'ramp s':>8}{'error mm':>10}{'without':>9}{'plain':>8}{'NEES':>7}"
        "  verdict"
    ]
    lines += [
        f"{one.share:9.1%}{one.ramp:8.1f}{1e3 * one.error_m:10.2f}{1e3 * one.fault_free_m:9.2f}"
        f"{1e3 * one.plain_m:8.2f}{one.nees:7.1f}  {one.verdict}"
        for one in result
    ]
    trusted = sum(one.verdict == Verdict.TRUSTWORTHY for one in result)
    return "\n".join(
        (
            *lines,
            f"{sums.runs} walks with a false beacon, {trusted} trusted: error over that without"
            f" the fault {sums.ratio_trusted:.2f} (median), at most"
            f" {sums.ratio_worst_trusted:.2f}; beyond 1.5 in {sums.beyond_trusted}",
            f"  trusted with a mean NEES above 20: {sums.silent}",
            f"  robust estimation without a fault costs {sums.cost_of_robustness:+.2%} of the"
            f" error; {sums.doubtful_without_fault} results are not trusted",
        )
    )


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, "four walks", output=None, parallel=True)
    parser.add_argument("--runs", type=int, default=Config.runs)
    given = parser.parse_args()
    config = Config(runs=4 if given.quick else given.runs, seed=given.seed)
    result = run(config, chosen_scale(given))
    conclude(report(result), figures(result)._asdict())


if __name__ == "__main__":
    main()
