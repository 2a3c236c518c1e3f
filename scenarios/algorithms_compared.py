"""Paper 004's three algorithms compared with maximum likelihood, in nine rooms (figures 7 and 8).

Ten rooms of each kind (`paper_rooms`) with two hundred targets: noise alone (S0), a
smooth gain error (S1), two sets of errors fitted to the printed figures (F1, F2), coils of the true
size (P0) and iron near them, as far as it has an effect (P1, P2) or near (N1, N2).  The sensor is
level, as it was in the paper.

1. Do the algorithms err as the paper prints?  Algorithms 1 and 3 do in F1, whose errors were fitted
   to that; algorithm 2 errs by its grid in any room, 0.09 m where the grid holds all targets.  The
   three attitudes do not come out together in any room.
2. Is maximum likelihood better?  In white noise it meets the Cramér-Rao bound, ten times below
   algorithm 3.  Where the model is wrong by more than the noise, it is **worse** than algorithm 3.
   `magfusion fix` is not: it estimates the gains as far as the targets require.
3. What is better still?  Weights that know how wrong the model is, and the very survey that
   algorithm 3 needs, made into a map of what the model misses: at most half its error.
4. Does the attitude matter to the likelihood?  No: the same errors at any tilt.

Our methods are compared with algorithm 3, the paper's own, by a rule fixed before any run
(`compared_with_algorithm_3`).

The lines of algorithm 1 carry `World.line_bias`, a change since they were fitted.  It cancels in
algorithm 3, which takes from its lines the slope alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from algorithms_figures import bounds, compared_with_algorithm_3, draw, report, summary, worst_ratio
from algorithms_tried import (
    LEVEL,
    MAPPED,
    METHODS,
    OURS,
    AlgorithmOutcome,
    Task,
    angle_deg,
    fixed,
    size,
    try_world,
)
from harness import Scale, chosen_scale, conclude, scenario_parser
from paper_rooms import ROOM, S0, SCENARIOS, draw_world
from scipy.spatial.transform import Rotation

from magfusion.simulation.monte_carlo import run_many
from magfusion.units import DEGREE

TILTS_DEG = (0.0, 2.0, 10.0, 30.0, 90.0, 180.0)


@dataclass(frozen=True)
class Config:
    """Rooms of each kind, targets in each, and the targets that are tilted."""

    worlds: int = 10
    targets: int = 200
    tilted: int = 1000
    scenarios: tuple[str, ...] = tuple(SCENARIOS)
    gain_length: float | None = None  # m; of smooth gain errors, where it is not the scenario's
    seed: int = 0


def run(
    config: Config, scale: Scale | None = None, methods: Sequence[str] = tuple(METHODS)
) -> dict[str, list[AlgorithmOutcome]]:
    """Return what came out in every room of each scenario."""
    kinds = {name: SCENARIOS[name] for name in config.scenarios}
    if config.gain_length is not None:
        kinds = {n: replace(kind, gain_length=config.gain_length) for n, kind in kinds.items()}
    tasks = [
        Task(kinds[name], config.targets, ROOM, tuple(methods))
        for name in config.scenarios
        for _ in range(config.worlds)
    ]
    result = run_many(try_world, tasks, seed=config.seed, **(scale or {}))
    return {
        name: result[i * config.worlds : (i + 1) * config.worlds]
        for i, name in enumerate(config.scenarios)
    }


def likelihood_at_tilts(config: Config) -> dict[float, float]:
    """Return the mean attitude error (deg) of plain likelihood at each tilt, in S0.

    The sensor turns in the same field with the same noise, which has no direction of its own, so
    that nothing but the attitude differs.
    """
    rng = np.random.default_rng(config.seed)
    world = draw_world(S0, rng, model_error=0.0)
    level = world.measure(ROOM.draw_targets(rng, config.tilted), LEVEL, rng)
    axis = rng.standard_normal((config.tilted, 3))
    axis /= size(axis)[:, None]
    errors = {}
    for tilt_deg in TILTS_DEG:
        true = Rotation.from_rotvec(tilt_deg * DEGREE * axis).as_matrix()
        rotated = replace(level, phasor_sensor=level.phasor_sensor @ true)
        result = fixed(rotated, world.site).world_from_body
        errors[tilt_deg] = float(np.mean(angle_deg(np.swapaxes(true, -1, -2) @ result)))
    return errors


def main() -> None:
    """Print the tables and one JSON line."""
    quick = "two worlds of fifty targets"
    parser = scenario_parser(__doc__, Config.seed, quick, parallel=True)
    parser.add_argument("--worlds", type=int, help=f"of each scenario (default {Config.worlds})")
    parser.add_argument("--rooms", nargs="+", choices=SCENARIOS, help="kinds (default: all)")
    parser.add_argument("--gain-length", type=float, help="correlation length of gain errors (m)")
    given = parser.parse_args()
    if given.worlds is not None and given.worlds < 2:
        parser.error("--worlds must be at least 2, for a standard error")
    small = Config(worlds=2, targets=50, tilted=200) if given.quick else Config()
    config = replace(
        small,
        seed=given.seed,
        worlds=given.worlds or small.worlds,
        scenarios=tuple(given.rooms or small.scenarios),
        gain_length=given.gain_length,
    )
    result, tilts = run(config, chosen_scale(given)), likelihood_at_tilts(config)
    if given.output is not None:
        draw(given.output, result)
    bound_m, bound_deg = bounds(next(iter(result.values())))
    figures = {
        "worlds": config.worlds,
        "seed": config.seed,
        "scenarios": {name: summary(outcomes) for name, outcomes in result.items()},
        "bound_rms_m": bound_m,
        "bound_rms_deg": bound_deg,
        "over_algorithm_3": {
            n: {m: compared_with_algorithm_3(o, m) for m in OURS} for n, o in result.items()
        },
        "map_over_best_published": {n: worst_ratio(o, MAPPED) for n, o in result.items()},
        "ml_attitude_by_tilt_deg": tilts,
    }
    conclude(report(result, tilts), figures)


if __name__ == "__main__":
    main()
