"""What each further beacon is worth: the error with three to six (paper 004, figure 11).

Three to six beacons are evenly spaced on a ring of 3.6 m radius around the square of 2 m in which
the targets lie, in the fitted rooms of `algorithms_compared` (F1), whose lines are not aged here.

1. Do more beacons lower the error of algorithm 3 as the paper prints?  By the same share: to about
   two thirds from three to six.  The paper's own three beacons err by 0.069 m, 0.108 m and 0.110 m
   in three places, so that only the ratios can be compared.
2. And with a map and relative weights?  By nearly the same share, from an eighth of the error.  A
   fourth beacon is worth less than a survey that is put to use.

The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from algorithms_figures import means, standard_error
from algorithms_tried import MAPPED, AlgorithmOutcome, Task, try_world
from harness import Scale, blank_figure, chosen_scale, conclude, save_picture, scenario_parser
from paper_rooms import F1, ring

from magfusion.simulation.monte_carlo import run_many
from magfusion.units import Array

COUNTS = (3, 4, 5, 6)
PAPER = (0.110, 0.085, 0.077, 0.071)  # m
METHODS = ("A3 differential", MAPPED)
BOUND = "Cramér-Rao bound"


@dataclass(frozen=True)
class Config:
    """Rooms for each number of beacons, and targets in each."""

    worlds: int = 12
    targets: int = 200
    seed: int = 0


def run(
    config: Config, scale: Scale | None = None, methods: Sequence[str] = METHODS
) -> dict[int, list[AlgorithmOutcome]]:
    """Return what came out in every room with each number of beacons."""
    scenario = replace(F1, line_bias_rms=0.0)
    tasks = [
        Task(scenario, config.targets, ring(count), tuple(methods))
        for count in COUNTS
        for _ in range(config.worlds)
    ]
    result = run_many(try_world, tasks, seed=config.seed, **(scale or {}))
    return {
        count: result[i * config.worlds : (i + 1) * config.worlds] for i, count in enumerate(COUNTS)
    }


def errors(result: Mapping[int, Sequence[AlgorithmOutcome]], method: str) -> Array:
    """Return mean errors in each room (m), shape (counts, worlds)."""
    return np.array([means(outcomes, "position", method) for outcomes in result.values()])


def bounds(result: Mapping[int, Sequence[AlgorithmOutcome]]) -> Array:
    """Return the root mean square bound of position (m), shape (counts,)."""
    return np.array(
        [
            np.sqrt(np.mean(np.concatenate([o.position_bound for o in outcomes]) ** 2))
            for outcomes in result.values()
        ]
    )


def report(result: Mapping[int, Sequence[AlgorithmOutcome]]) -> str:
    """Return the table that a reader sees."""
    lines = [
        "mean position error (m), its standard error over rooms, and relative to three beacons",
        f"  {'beacons':18}" + "".join(f"{count:>26}" for count in result),
        _row("paper", PAPER),
    ]
    for method in METHODS:
        error = errors(result, method)
        spread = [standard_error(rooms) for rooms in error]
        lines.append(_row(method, error.mean(axis=1), spread))
    lines.append(_row(BOUND, bounds(result)))
    return "\n".join(lines)


def _row(name: str, value: Sequence[float] | Array, spread: Sequence[float] | None = None) -> str:
    cells = ""
    for i, error in enumerate(value):
        doubt = "" if spread is None else f" ({spread[i]:.4f})"
        cells += f"{f'{error:.4f}{doubt} {error / value[0]:.2f}':>26}"
    return f"  {name:18}{cells}"


def draw(path: Path, result: Mapping[int, Sequence[AlgorithmOutcome]]) -> None:
    """Write the paper's figure 11 as a PNG."""
    figure = blank_figure(8.0, 5.0)
    axis = figure.subplots()
    axis.plot(COUNTS, PAPER, "k--o", label="paper")
    for method in METHODS:
        error = errors(result, method)
        spread = [standard_error(rooms) for rooms in error]
        axis.errorbar(COUNTS, error.mean(axis=1), spread, marker="o", capsize=3, label=method)
    axis.plot(COUNTS, bounds(result), ":o", label=f"{BOUND}, noise alone")
    axis.set(yscale="log", xticks=COUNTS, xlabel="beacons", ylabel="mean position error (m)")
    axis.grid(visible=True, which="both", alpha=0.3)
    axis.legend()
    save_picture(figure, path)


def main() -> None:
    """Print the table and one JSON line."""
    quick = "two rooms of fifty targets"
    given = scenario_parser(__doc__, Config.seed, quick, parallel=True).parse_args()
    small = Config(worlds=2, targets=50) if given.quick else Config()
    config = replace(small, seed=given.seed)
    result = run(config, chosen_scale(given))
    if given.output is not None:
        draw(given.output / "figure_11.png", result)
    figures = {
        "beacons": COUNTS,
        "paper_m": PAPER,
        "position_m": {m: errors(result, m).mean(axis=1).tolist() for m in METHODS},
        "bound_rms_m": bounds(result).tolist(),
        "worlds": config.worlds,
        "seed": config.seed,
    }
    conclude(report(result), figures)


if __name__ == "__main__":
    main()
