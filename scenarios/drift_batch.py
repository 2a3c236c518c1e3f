"""Is a batch of hours as honest as the estimators online?  `magfusion drift`'s worlds, smoothed.

The same worlds in which `magfusion drift` judges the online estimators (moments that fade and
wander, clocks, a magnetometer's scale that follows the day, biases that walk) are given to the
smoother as one log.  The mean NEES of the poses should be 4 to 8 where 6 is expected, in every
part of the log, and no part's errors larger than the others'.  All of it::

    python scenarios/drift_batch.py --hours 8 --worlds 4

The default is an hour of one world.
"""

from dataclasses import dataclass

import numpy as np
from harness import conclude, scenario_parser

from magfusion.estimation.batch.batch import smooth
from magfusion.jobs.drift_world import STRETCH, WorldTask, draw_task
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.results.errors import trajectory_errors

PARTS = 4  # of a log, judged each
EXPECTED = (4.0, 8.0)


@dataclass(frozen=True)
class Config:
    """Size of the test."""

    hours: float = 1.0
    worlds: int = 1
    seed: int = 1
    phase_known: bool = False


@dataclass(frozen=True)
class Row:
    """One world: mean NEES in all and in each part of the log, and errors (m, deg)."""

    world: int
    nees: float
    nees_of_part: tuple[float, ...]
    position_m: float
    attitude_deg: float
    converged: bool


def whole_log(config: Config, world: int) -> tuple[Log, Site]:
    """Return the log of a world with its truth, and the site that is declared."""
    task = WorldTask(world, "ekf", config.hours, config.seed, phase_known=config.phase_known)
    drawn, built = draw_task(task), []
    before = drawn.start()
    for stretch in range(task.stretches):
        part = drawn.stretch(stretch * STRETCH, STRETCH, before)
        before = part.after
        built.append(part)
    imu = ImuSamples(
        np.concatenate([part.imu.time for part in built]),
        np.concatenate([part.imu.gyro_body for part in built]),
        np.concatenate([part.imu.accel_body for part in built]),
    )
    fields = FieldSamples.joined([part.fields for part in built])
    truth = drawn.motion.trajectory(fields.time)
    return Log(f"world {world}", 0, "drift", imu, None, fields, truth), drawn.site


def run_world(config: Config, world: int) -> Row:
    """Smooth one world and compare it with its truth, at the epochs of its fields."""
    log, site = whole_log(config, world)
    result = smooth(log, site)
    assert log.truth is not None
    estimate = trajectory_errors(result.states, log.truth)
    assert estimate.nees is not None
    part = np.minimum((PARTS * estimate.time / estimate.time[-1]).astype(int), PARTS - 1)
    return Row(
        world,
        float(np.mean(estimate.nees)),
        tuple(float(np.mean(estimate.nees[part == k])) for k in range(PARTS)),
        estimate.ate,
        estimate.attitude_rmse_deg,
        result.converged,
    )


def report(config: Config, rows: list[Row]) -> str:
    """Return the table."""
    lines = [
        f"{config.hours:g} h a world; NEES of 6 is expected",
        "world   NEES  by part of the log",
    ]
    for row in rows:
        parts = " ".join(f"{one:6.2f}" for one in row.nees_of_part)
        lines.append(
            f"{row.world:5d} {row.nees:6.2f}  {parts}  {1e3 * row.position_m:.2f} mm"
            f" {row.attitude_deg:.3f} deg{'' if row.converged else ', did not converge'}"
        )
    mean = float(np.mean([row.nees for row in rows]))
    honest = EXPECTED[0] <= mean <= EXPECTED[1]
    lines.append(f"mean {mean:.2f}: {'as claimed' if honest else 'not as claimed'}")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--hours", type=float, default=Config.hours)
    parser.add_argument("--worlds", type=int, default=Config.worlds)
    parser.add_argument("--phase-known", action="store_true")
    given = parser.parse_args()
    config = Config(given.hours, given.worlds, given.seed, given.phase_known)
    rows = [run_world(config, world) for world in range(config.worlds)]
    nees = [row.nees for row in rows]
    figures = {"least_nees": min(nees), "largest_nees": max(nees), "rows": rows}
    conclude(report(config, rows), figures)


if __name__ == "__main__":
    main()
