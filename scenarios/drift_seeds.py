"""How often the drift test blames an estimator that does not drift.

`magfusion drift` in one world a seed, a few hours each, as it is (the drives' clocks free) and with
its trap (drives declared synchronised whose clock is 0.01 ppm off).  At most 2 % of the seeds may
fail without a cause, and the trap must fail.
"""

import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser

from magfusion.jobs.drift import DriftSettings, run_drift
from magfusion.results.drift import QUANTITIES
from magfusion.simulation.monte_carlo import run_many


@dataclass(frozen=True)
class Config:
    """How many seeds, and how long."""

    seeds: int = 50
    hours: float = 4.0
    estimator: Literal["ekf", "smoother"] = "ekf"
    trap_seeds: int = 5
    seed: int = 0


@dataclass(frozen=True)
class Task:
    """One run of the drift test."""

    seed: int
    hours: float
    estimator: Literal["ekf", "smoother"]
    trap: bool


@dataclass(frozen=True)
class Row:
    """Result of one run."""

    seed: int
    trap: bool
    stability: str
    by_quantity: dict[str, str]
    blamed: tuple[str, ...]  # sentences that fail


def judge(task: Task, _rng: np.random.Generator) -> Row:
    """Run the drift test of one seed."""
    settings = DriftSettings(
        hours=task.hours,
        estimators=(task.estimator,),
        seed=task.seed,
        phase_known=task.trap,
        clock_ppm=0.01 if task.trap else 0.0,
        workers=1,
    )
    with tempfile.TemporaryDirectory(prefix="drift_") as name:
        result = run_drift(settings, Path(name) / "drift")
    notes = result["notes"]
    assert isinstance(notes, list)
    return Row(
        seed=task.seed,
        trap=task.trap,
        stability=str(result["verdict"]),
        by_quantity={q.name: str(result[f"{q.name}_stability"]) for q in QUANTITIES},
        blamed=tuple(str(note) for note in notes if str(note).startswith("FAIL")),
    )


def run(config: Config, scale: Scale | None = None) -> list[Row]:
    """Return the summary of all runs, the traps last."""
    first = config.seed
    tasks = [
        Task(first + i, config.hours, config.estimator, trap)
        for trap, count in ((False, config.seeds), (True, config.trap_seeds))
        for i in range(count)
    ]
    return run_many(judge, tasks, seed=config.seed, **(scale or {}))


def report(rows: list[Row], config: Config) -> str:
    """Return the table that a reader sees."""
    lines = [f"{config.hours:g} h of one world, {config.estimator}; seeds by verdict"]
    for trap in (False, True):
        own = [row for row in rows if row.trap is trap]
        whole = Counter(row.stability for row in own)
        lines.append(f"{'trap' if trap else 'free'}: {len(own)} seeds, {_counted(whole)}")
        for quantity in QUANTITIES:
            counts = Counter(row.by_quantity[quantity.name] for row in own)
            lines.append(f"  {quantity.name:12} {_counted(counts)}")
    for row in rows:
        if not row.trap:
            lines += [f"seed {row.seed}: {sentence}" for sentence in row.blamed]
    return "\n".join(lines)


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, output=None, parallel=True)
    parser.add_argument("--seeds", type=int, default=Config.seeds)
    parser.add_argument("--hours", type=float, default=Config.hours)
    parser.add_argument("--estimator", choices=("ekf", "smoother"), default=Config.estimator)
    given = parser.parse_args()
    config = Config(given.seeds, given.hours, given.estimator, seed=given.seed)
    rows = run(config, chosen_scale(given))
    conclude(report(rows, config), rows)


if __name__ == "__main__":
    main()
