"""Do the online estimators drift in 48 hours?  `magfusion drift` in the three cases that matter.

A platform mostly at rest, three minutes of walk an hour, 100 Hz inertial data, phasors each minute
at rest and once a second about a walk; moments that fade with the coils' heat and wander, noisy
days and quiet nights, a magnetometer's scale that follows the day, biases that walk:

1. free: beacons with clocks of their own, whose phase and rate the estimator finds.
2. known: the drives are declared synchronised, and are.
3. trap: they are declared synchronised, and their clock is 0.01 ppm off.  The test must find it:
   a snapshot of maximum likelihood turns by 6.4 degrees a day (scenarios/static_48h.py).

Each estimator is judged by the slope of its errors in a day, its consistency, its memory, and the
time of an update (processor time, which other work on the machine disturbs little).  All of it::

    python scenarios/drift_48h.py --hours 48 --worlds 8 --workers 8 -o drift_48h

The default is a few minutes long, and determines less: slopes of a short run are mostly undecided.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from harness import conclude, scenario_parser, show_progress

from magfusion.jobs.drift import ESTIMATORS, DriftSettings, run_drift
from magfusion.results.drift import QUANTITIES
from magfusion.results.report import Figures

CASES = {
    "free": DriftSettings(),
    "known": DriftSettings(phase_known=True),
    "trap": DriftSettings(phase_known=True, clock_ppm=0.01),
}
SNAPSHOT_TRAP = 6.43  # deg a day, ML with the phase believed (static_48h.py)


@dataclass(frozen=True)
class Config:
    """Size of the test."""

    hours: float = 4.0
    worlds: int = 1
    cases: tuple[str, ...] = tuple(CASES)
    seed: int = 1


def run_case(
    config: Config, case: str, place: Path, cluster: str | None, workers: int | None, resume: bool
) -> Figures:
    """Return the report of one case."""
    settings = replace(
        CASES[case],
        hours=config.hours,
        worlds=config.worlds,
        seed=config.seed,
        cluster=cluster,
        workers=workers,
        resume=resume,
    )
    return run_drift(settings, place / case, show_progress)


def report(config: Config, result: dict[str, Figures]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"{config.hours:g} h, {config.worlds} world(s); slope a day +- standard error, verdict",
        f"{'':18}" + "".join(f"{f'{q.name} ({q.unit})':>34}" for q in QUANTITIES),
    ]
    for case, figures in result.items():
        for estimator in ESTIMATORS:
            cells = []
            for quantity in QUANTITIES:
                key = f"{estimator}_{quantity.name}"
                slope = _float(figures[f"{key}_slope_{quantity.unit}_per_day"])
                error = _float(figures[f"{key}_slope_standard_error"])
                verdict = figures[f"{key}_drift_stability"]
                cells.append(f"{slope:+11.3g} +-{error:8.2g} {verdict!s:<10}")
            lines.append(f" {case:7}{estimator:10}" + "".join(f"{cell:>34}" for cell in cells))
    lines += ["", f"{'':18}   rms: position   attitude     NEES / dof   an update   bare   memory"]
    lines.append(f"{'':18}           (mm)      (deg)  pose   biases     p50 (ms)  loops    (MiB)")
    for case, figures in result.items():
        for estimator in ESTIMATORS:
            own = {k.removeprefix(f"{estimator}_"): v for k, v in figures.items()}
            lines.append(
                f" {case:7}{estimator:10}{1e3 * _float(own['position_rms_m']):15.2f}"
                f"{_float(own['attitude_rms_deg']):11.3f}"
                f"{_float(own['pose_nees_per_dof']):6.2f}{_float(own['bias_nees_per_dof']):9.2f}"
                f"{_float(own['update_ms_median']):13.2f}{_float(own['bare_loops']):7.1f}"
                f"{_float(own['memory_growth_mib']):+9.2f}"
            )
    lines.append(f"a snapshot's attitude in the trap: {SNAPSHOT_TRAP} deg a day")
    return "\n".join(lines)


def _float(value: object) -> float:
    assert isinstance(value, int | float)
    return float(value)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(
        __doc__,
        Config.seed,
        "half an hour of each",
        "directory of the reports and pictures",
        parallel=True,
    )
    parser.add_argument("--hours", type=float, default=Config.hours)
    parser.add_argument("--worlds", type=int, default=Config.worlds)
    parser.add_argument("--case", choices=tuple(CASES), help="one case only")
    parser.add_argument("--resume", action="store_true", help="continue interrupted runs")
    given = parser.parse_args()
    cases = tuple(CASES) if given.case is None else (given.case,)
    hours = 0.5 if given.quick else given.hours
    config = Config(hours=hours, worlds=given.worlds, cases=cases, seed=given.seed)
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch) if given.output is None else given.output
        result = {
            case: run_case(config, case, place, given.cluster, given.workers, given.resume)
            for case in cases
        }
    shown = {case: {k: v for k, v in own.items() if k != "notes"} for case, own in result.items()}
    conclude(
        report(config, result), {"hours": config.hours, "worlds": config.worlds, "cases": shown}
    )


if __name__ == "__main__":
    main()
