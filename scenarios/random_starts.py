"""Success of the initialization on random logs, with the verdict on each.

Of every log a site of one to eight beacons, synchronised or not, and the speed of a walk are drawn.
At least 99 % should have a start that is right at 95 % of the epochs.  Where none is, the log is
smoothed, and the result should be right all the same or not be trusted::

    python scenarios/random_starts.py --runs 200

``--lone`` walks about one rotating beacon that everything depends on, and smooths every log::

    python scenarios/random_starts.py --lone --runs 20

What its survey errs by is one draw a log, which nothing in the log contradicts: the mean NEES of a
log is then a draw of chi square of six, and one in sixteen is above 12 where all is as claimed.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, scenario_parser
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from magfusion.errors import EstimationError
from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.batch.offline import OfflineStart, begin
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.integrity.judge import judge_result
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

FAR_M, FAR_RAD = 0.3, 0.4  # further off, an epoch is at another hypothesis
MAX_WRONG_SHARE = 0.05  # of the epochs
LARGE_NEES, SILENT_NEES = 12.0, 20.0


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated log and its phasors."""

    site: Site
    simulated: SimulatedLog
    samples: FieldSamples

    def starts(self) -> list[OfflineStart]:
        """Return the starts that are offered."""
        calibration = initial_calibration(self.site, float(np.mean(self.samples.time)))
        return begin(self.samples, None, self.simulated.log, calibration)

    def wrong(self, states: Trajectory) -> float:
        """Return the share of epochs that are at another hypothesis than the truth's."""
        truth = self.simulated.motion.trajectory(states.time)
        away = np.linalg.norm(states.position_world - truth.position_world, axis=1)
        between = np.swapaxes(truth.world_from_body, 1, 2) @ states.world_from_body
        angle = Rotation.from_matrix(between).magnitude()
        return float(np.mean((away > FAR_M) | (angle > FAR_RAD)))


@dataclass(frozen=True)
class Row:
    """One log: share of wrong epochs of the best start, and what the smoother made of it."""

    seed: int
    beacons: int
    synchronised: bool
    wrong: float
    verdict: str | None = None
    codes: tuple[str, ...] = ()
    wrong_smoothed: float | None = None
    nees: float | None = None

    @property
    def success(self) -> bool:
        """Whether some start is right."""
        return self.wrong < MAX_WRONG_SHARE

    @property
    def silent(self) -> bool:
        """Whether a wrong result is trusted."""
        trusted = self.verdict == str(Verdict.TRUSTWORTHY)
        return trusted and ((self.wrong_smoothed or 0.0) > 0.0 or (self.nees or 0.0) > SILENT_NEES)


def recorded(site: Site, seed: int, duration: float, speed: float = 0.5) -> Case:
    """Return a walk with rests."""
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration, speed=speed, rests=Rests(start=3.0, move=20.0, pause=3.0)
    )
    built = simulate_log(site, config, np.random.default_rng([7, seed]))
    samples, _ = phasors(built.log, site)
    return Case(site, built, samples)


def single(
    seed: int,
    duration: float,
    *,
    synchronised: bool = True,
    rpy_deg: tuple[float, ...] = (2, -3, 10),
) -> Case:
    """Return a walk about one rotating beacon."""
    site = replace(demo_site(coil_radius=None), model_error=1e-3)
    beacon = replace(
        site.beacons[0],
        synchronised=synchronised,
        world_from_beacon=Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix(),
    )
    return recorded(replace(site, beacons=(beacon,)), seed, duration)


def drawn(seed: int, duration: float) -> Case:
    """Return a walk among beacons of any number, place and attitude."""
    rng = np.random.default_rng([11, seed])
    site = replace(demo_site(coil_radius=None), model_error=1e-3)
    sync = bool(rng.random() < 0.5)
    beacons = tuple(
        replace(
            site.beacons[i % 4],
            name="ABCDEFGH"[i],
            position_world=rng.uniform([-1.0, -1.0, -0.5], [0.5, 6.0, 2.5]),
            world_from_beacon=Rotation.random(rng=rng).as_matrix(),
            frequency_hz=20.0 + 5.0 * i,
            synchronised=sync,
        )
        for i in range(int(rng.integers(1, 9)))
    )
    return recorded(replace(site, beacons=beacons), seed, duration, float(rng.uniform(0.2, 1.5)))


def run_one(seed: int, *, alone: bool) -> Row:
    """Simulate a log and look for its starts; smooth it where that decides something."""
    case = single(seed, 30.0) if alone else drawn(seed, 15.0)
    beacons = case.site.beacons
    row = Row(seed, len(beacons), beacons[0].synchronised, _least_wrong(case))
    if row.success and not alone:
        return row
    try:
        result, trust = judge_result(smooth(case.simulated.log, case.site), case.simulated.log)
    except EstimationError:
        return replace(row, verdict=str(Verdict.FAILED))
    truth = case.simulated.log.truth
    assert truth is not None
    errors = trajectory_errors(result.states, truth)
    return replace(
        row,
        verdict=str(trust.verdict),
        codes=tuple(reason.code for reason in trust.reasons),
        wrong_smoothed=case.wrong(result.states),
        nees=None if errors.nees is None else float(np.mean(errors.nees)),
    )


def _least_wrong(case: Case) -> float:
    try:
        return min(case.wrong(start.states) for start in case.starts())
    except EstimationError:
        return 1.0


def report(rows: Sequence[Row]) -> str:
    """Return the table of the logs that were smoothed, and the shares."""
    lines = ["seed beacons  wrong  smoothed   NEES"]
    for row in rows:
        if row.verdict is not None:
            smoothed = "-" if row.wrong_smoothed is None else f"{100 * row.wrong_smoothed:.0f} %"
            nees = "-" if row.nees is None else f"{row.nees:.2f}"
            lines.append(
                f"{row.seed:4d} {row.beacons:7d} {100 * row.wrong:4.0f} % {smoothed:>9} {nees:>6}"
                f"  {row.verdict} {', '.join(row.codes)}"
            )
    result, silent = sum(row.success for row in rows), [row.seed for row in rows if row.silent]
    lines.append(f"a right start in {result} of {len(rows)} ({100 * result / len(rows):.1f} %)")
    trusted = [row.nees for row in rows if row.verdict == "trustworthy" and row.nees is not None]
    if trusted:
        above, due = sum(one > LARGE_NEES for one in trusted), float(chi2.sf(LARGE_NEES, 6))
        lines.append(
            f"trusted: mean NEES {np.mean(trusted):.2f}; above {LARGE_NEES:g}: {above} of"
            f" {len(trusted)}, where {due * len(trusted):.1f} are due; that as many are has a"
            f" probability of {binom.sf(above - 1, len(trusted), due):.2f}"
        )
    lines.append(f"trusted and wrong: {silent or 'none'}")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, 0, output=None)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--lone", action="store_true", help="one rotating beacon, smoothed")
    given = parser.parse_args()
    rows: list[Row] = []
    for seed in range(given.seed, given.seed + given.runs):
        rows.append(run_one(seed, alone=given.lone))
        print(rows[-1], file=sys.stderr, flush=True)
    trusted = [row.nees for row in rows if row.verdict == str(Verdict.TRUSTWORTHY)]
    figures = {
        "logs": len(rows),
        "right_starts": sum(row.success for row in rows),
        "trusted": len(trusted),
        "trusted_nees": float(np.mean(np.array(trusted, dtype=float))) if trusted else None,
        "largest_nees": max((row.nees for row in rows if row.nees is not None), default=None),
    }
    conclude(report(rows), figures | {"rows": rows})


if __name__ == "__main__":
    main()
