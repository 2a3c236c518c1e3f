"""Three rests of five minutes far from the beacons: one by one, as they last, and all in one.

A receiver rests 300 m from four beacons, as in `far_and_weak`, whose survey errs as declared.  It
rests in three places, and is carried from one to the next within ten seconds.  Compared are

- ``fix --at-rest``: each rest an epoch of its own, when the log is over;
- ``navigate --at-rest``: each rest as it lasts; its last state counts;
- ``smooth --at-rest``: all rests, the inertial stream between them and what the gyroscope shows in
  them, in one solution.

Of each: the error of the position, and the mean NEES of the pose (six are due).  The rule, set
before the first run: seeds 0 to 9; a mean NEES between 4 and 8 is right, and `smooth` errs by no
more than `fix`.  A log of which a method has no result is counted and reported.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from far_and_weak import IMU_RATE_HZ, RATE_HZ, far_site
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.demodulation.demodulation import first_fixes
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.rests.rest_stream import RestNavigator
from magfusion.estimation.rests.stationary_integration import integrate_rests
from magfusion.jobs.navigate_rests import replayed
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust, Verdict
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests
from magfusion.units import Array

MOVE = 10.0  # s
BOX_WORLD = np.array([[-20.0, -20.0, -3.0], [20.0, 20.0, 3.0]])  # m


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    rest: float = 300.0  # s
    rests: int = 3
    runs: int = 10
    seed: int = 0

    @property
    def duration(self) -> float:
        """Of a log (s)."""
        return self.rests * self.rest + (self.rests - 1) * MOVE


@dataclass(frozen=True)
class RestsResult:
    """What a method finds of all rests of all logs.

    Parameters
    ----------
    findings : int
        Rests with a pose.
    failed, doubted : int
        Logs.
    """

    method: str
    findings: int
    failed: int
    doubted: int
    position_m: float
    attitude_deg: float
    nees: float
    nees_each: list[float]
    nees_least: float
    nees_most: float


def resting(site: Site, config: Config, seed: int) -> Log:
    """Return a log of rests, of a site that is drawn from what is declared."""
    simulated = SimulationConfig(
        box_world=BOX_WORLD,
        duration=config.duration,
        speed=1.0,
        rests=Rests(start=config.rest, move=MOVE, pause=config.rest),
        imu_rate_hz=IMU_RATE_HZ,
        magnetometer_rate_hz=RATE_HZ,
    )
    return simulate_log(site, simulated, np.random.default_rng(seed)).log


Poses = tuple[Trajectory, Trust]


def fixed(log: Log, site: Site) -> Poses:
    """Return the poses of rests, each for itself."""
    rested = integrate_rests(log, site)
    best = first_fixes(rested.fields, log, initial_calibration(site, 0.0)).best()
    return best, Trust(rested.findings)


def navigated(log: Log, site: Site) -> Poses:
    """Return the last pose that is reported of each rest as it lasts."""
    last, newest = [], None
    for state in replayed(log, RestNavigator(site)):
        if not state.standing and newest is not None:
            last.append(newest)
            newest = None
        elif state.fixes is not None:
            newest = state
    last += [] if newest is None else [newest]
    if not last:
        raise EstimationError("no rest is reported")
    fixes = [state.fixes.fixes.best() for state in last if state.fixes is not None]
    trust = Trust()
    for state in last:
        trust |= state.trust
    covs = [one.pose_cov for one in fixes if one.pose_cov is not None]
    poses = Trajectory(
        np.array([state.time - 0.5 * state.duration for state in last]),
        np.concatenate([one.world_from_body for one in fixes]),
        np.concatenate([one.position_world for one in fixes]),
        pose_cov=np.concatenate(covs),
    )
    return poses, trust


def smoothed(log: Log, site: Site) -> Poses:
    """Return the poses of rests in one solution, with the covariance that the job reports."""
    rested = integrate_rests(log, site, least=2)
    own = rested.log(log)
    honest, trust = judge_result(smooth(own, site, SmootherSettings()), own)
    states = honest.states
    near = np.abs(states.time - rested.fields.time[:, None]).argmin(axis=1)
    return states.rows(near), trust


METHODS: dict[str, Callable[[Log, Site], Poses]] = {
    "fix --at-rest": fixed,
    "navigate --at-rest": navigated,
    "smooth --at-rest": smoothed,
}


def errors(poses: Trajectory, truth: Trajectory) -> tuple[Array, Array]:
    """Return the errors in body axes, rotation and translation (n, 6), and the NEES (n,)."""
    at = np.abs(truth.time - poses.time[:, None]).argmin(axis=1)
    true = truth.world_from_body[at]
    turn = Rotation.from_matrix(np.swapaxes(true, 1, 2) @ poses.world_from_body).as_rotvec()
    offset = poses.position_world - truth.position_world[at]
    shift = np.einsum("nji,nj->ni", poses.world_from_body, offset)
    error = np.concatenate([turn, shift], axis=1)
    assert poses.pose_cov is not None
    solved = np.linalg.solve(poses.pose_cov, error[..., None])[..., 0]
    return error, np.asarray(np.sum(error * solved, axis=1))


def run(config: Config) -> list[RestsResult]:
    """Measure all methods on the same logs."""
    site = far_site()
    logs = [resting(site, config, config.seed + k) for k in range(config.runs)]
    out = []
    for name, method in METHODS.items():
        parts, nees, failed, doubted = [], [], 0, 0
        for log in logs:
            assert log.truth is not None
            try:
                poses, trust = method(replace(log, truth=None), site)
            except (EstimationError, InputError):
                failed += 1
                continue
            if trust.verdict is Verdict.FAILED:
                failed += 1
                continue
            doubted += trust.verdict is not Verdict.TRUSTWORTHY
            error, own = errors(poses, log.truth)
            parts.append(error)
            nees.append(own)
        error = np.concatenate([np.zeros((0, 6)), *parts])
        each = [float(np.mean(own)) for own in nees]
        out.append(
            RestsResult(
                name,
                len(error),
                failed,
                doubted,
                rms(np.linalg.norm(error[:, 3:], axis=1)),
                rms(np.rad2deg(np.linalg.norm(error[:, :3], axis=1))),
                float(np.mean(np.concatenate([np.zeros(0), *nees]))),
                each,
                min(each, default=np.nan),
                max(each, default=np.nan),
            )
        )
    return out


def report(result: list[RestsResult]) -> str:
    """Return the table."""
    lines = [
        f"{'':20}rests kept  logs failed, doubted   position  attitude  NEES (6)   of the logs"
    ]
    for one in result:
        spread = f"{one.nees_least:.1f} to {one.nees_most:.1f}"
        lines.append(
            f"{one.method:20}{one.findings:10}{one.failed:13}{one.doubted:9}{one.position_m:9.2f} m"
            f"{one.attitude_deg:6.2f} deg{one.nees:10.2f}   {spread}"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure all methods."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="logs, a seed each")
    parser.add_argument("--rest", type=float, default=Config.rest, help="length of a rest (s)")
    given = parser.parse_args()
    result = run(Config(rest=given.rest, runs=given.runs, seed=given.seed))
    conclude(report(result), result)


if __name__ == "__main__":
    main()
