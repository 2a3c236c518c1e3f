"""How neighbours, density and blocks of a fingerprint survey change the errors of paper 004.

Section 2.4 of the paper states that more neighbours n improve the accuracy, section 2.3 that a
denser survey does, and sections 2.3 and 3.3 that smaller blocks improve algorithm 1.  The rooms
are those fitted to the paper's figures (F1 of `algorithms_compared`, whose lines are not aged
here), with its three beacons, its grid of 0.5 m and its n = 4 wherever these are not varied.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, scenario_parser
from paper_rooms import F1, ROOM, SimulatedWorld, draw_world

from magfusion.papers.p004_fingerprints.algorithms import locate_by_lines
from magfusion.papers.p004_fingerprints.equations import distances, eq_25_fingerprint
from magfusion.papers.p004_fingerprints.fingerprint import (
    FingerprintDatabase,
    fingerprint_database,
    locate_by_differential_range,
    locate_by_neighbours,
)
from magfusion.papers.p004_fingerprints.rssi import fit_block_lines, fit_lines
from magfusion.units import Array

NEIGHBOURS = (1, 2, 4, 8, 16)
SPACINGS = (1.0, 0.5, 0.25)  # m
BLOCKS = (None, 4.0, 2.0, 1.5, 1.0)  # m; None: one line for the whole room
PAPER_N, PAPER_SPACING = 4, 0.5


@dataclass(frozen=True)
class Config:
    """Rooms, and targets in each."""

    rooms: int = 6
    targets: int = 200
    seed: int = 0


@dataclass(frozen=True, eq=False)
class SurveyedRoom:
    """A room's surveys by spacing, and the amplitudes (T) at its targets (m)."""

    surveys: dict[float, FingerprintDatabase]
    targets_world: Array
    amplitude: Array


Locate = Callable[[SurveyedRoom], Array]


def draw_room(config: Config, index: int) -> SurveyedRoom:
    """Return a room, whose surveys have the same disturbances and noise of their own."""
    rng = np.random.default_rng([config.seed, index])
    world = draw_world(replace(F1, line_bias_rms=0.0), rng)
    targets = ROOM.draw_targets(rng, config.targets)
    samples = world.measure(targets, np.eye(3), rng)
    surveys = {spacing: _surveyed(world, spacing, rng) for spacing in SPACINGS}
    return SurveyedRoom(surveys, targets, eq_25_fingerprint(samples.phasor_sensor[:, :, None]))


def _surveyed(
    world: SimulatedWorld, spacing: float, rng: np.random.Generator
) -> FingerprintDatabase:
    layout = replace(world.layout, spacing=spacing)
    return fingerprint_database(replace(world, layout=layout).survey(rng), world.site)


def by_neighbours(spacing: float, count: int) -> Locate:
    """Return algorithm 2."""
    return lambda room: locate_by_neighbours(room.surveys[spacing], room.amplitude, count)


def by_differential_range(spacing: float, count: int) -> Locate:
    """Return algorithm 3."""
    return lambda room: locate_by_differential_range(room.surveys[spacing], room.amplitude, count)


def by_lines(block: float | None, spacing: float = PAPER_SPACING) -> Locate:
    """Return algorithm 1 with a line for each block, or one for all."""

    def locate(room: SurveyedRoom) -> Array:
        known = room.surveys[spacing]
        place, beacons = known.position_world, known.beacons_world
        if block is None:
            lines = fit_lines(distances(place, beacons), known.amplitude)
            return locate_by_lines(known, room.amplitude, lines)
        blocks = fit_block_lines(place, beacons, known.amplitude, block)
        return locate_by_lines(known, room.amplitude, blocks)

    return locate


def mean_error(rooms: Sequence[SurveyedRoom], locate: Locate) -> float:
    """Return the mean position error over targets and rooms (m)."""
    errors = [np.linalg.norm(locate(room) - room.targets_world, axis=1) for room in rooms]
    return float(np.mean(errors))


def run(config: Config) -> dict[str, dict[str, float]]:
    """Return the mean position errors (m) of each variation."""
    rooms = [draw_room(config, index) for index in range(config.rooms)]
    table: dict[str, dict[str, Locate]] = {
        "algorithm_2_by_n": {str(n): by_neighbours(PAPER_SPACING, n) for n in NEIGHBOURS},
        "algorithm_3_by_n": {str(n): by_differential_range(PAPER_SPACING, n) for n in NEIGHBOURS},
        "algorithm_2_by_spacing": {f"{s:g}": by_neighbours(s, PAPER_N) for s in SPACINGS},
        "algorithm_3_by_spacing": {f"{s:g}": by_differential_range(s, PAPER_N) for s in SPACINGS},
        "algorithm_1_by_block": {
            "none" if block is None else f"{block:g}": by_lines(block) for block in BLOCKS
        },
    }
    return {
        name: {key: mean_error(rooms, locate) for key, locate in row.items()}
        for name, row in table.items()
    }


def report(figures: dict[str, dict[str, float]]) -> str:
    """Return the table that a reader sees."""
    lines = ["mean position error (m)"]
    for name, row in figures.items():
        cells = "".join(f"{f'{key}: {error:.3f}':>16}" for key, error in row.items())
        lines.append(f"  {name.replace('_', ' '):24}{cells}")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, "two rooms of fifty targets", None).parse_args()
    small = Config(rooms=2, targets=50) if given.quick else Config()
    figures = run(replace(small, seed=given.seed))
    conclude(report(figures), figures)


if __name__ == "__main__":
    main()
