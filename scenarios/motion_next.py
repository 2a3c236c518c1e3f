"""Next stops proposed by `design --motion`: predicted and achieved sigmas.

A site is known to centimetres and degrees.  `design --motion` proposes stops, and predicts what
sigma they leave of each parameter; for a poor motion, stops close together without a turn, the same
information predicts what remains.  Both motions are then simulated, each several times with a
survey that errs as declared and fields that are bent as declared, and the logs go through what
`calibrate log` does.  Compared are, of the parameters that stops can determine,

- the predicted sigma over the one that is found: above one by the information of the paths between
  stops, which the prediction leaves out; below one it predicts too much;
- the error in units of the predicted and of the found sigma: no more than one is right.

The rule, set before the first run: seeds 0 to 4; of each motion, the rms error is at most 1.2
predicted sigmas, and no kind of parameter is found more than 1.2 times worse than predicted.
"""

from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.judge import judge_result
from magfusion.jobs.calibrate_log import against_site, grown
from magfusion.model.parameters import (
    Block,
    choose_blocks,
    difference,
    initial_calibration,
    prior_sigma,
)
from magfusion.model.samples import Log
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.model.trust import Verdict
from magfusion.results.coverage import volume
from magfusion.results.design.motion import (
    ATTITUDES_DEG,
    Poses,
    candidate_poses,
    next_motion,
    prior_information,
)
from magfusion.results.pose_information import SURVEY_GROUPS, is_free
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient, draw_bending
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, draw_drives, perturb_site
from magfusion.simulation.motion import Rests, SimulatedMotion, progress_rate
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import Array

PLACES = volume(DEMO_BOX_WORLD, 1.0)
IMU_RATE_HZ, RATE_HZ = 100.0, 250.0


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    stops: int = 10
    stop: float = 2.0  # s
    move: float = 4.0  # s, from one to the next
    model_error: float = 0.005
    runs: int = 5
    seed: int = 0

    @property
    def duration(self) -> float:
        """Of a log (s)."""
        return self.stops * self.stop + (self.stops - 1) * self.move


@dataclass(frozen=True, eq=False)
class Planned:
    """Stops, and what sigma they are to leave.

    Parameters
    ----------
    predicted : ndarray, shape (k,)
        Of the declared sigma.
    """

    position_world: Array
    rpy_deg: Array
    predicted: Array


@dataclass(frozen=True)
class Kept:
    """What is predicted and found of one kind of parameter.

    Parameters
    ----------
    numbers : int
        That stops can determine.
    predicted : float
        Of the declared sigma, median.
    over_found : float
        Predicted over found sigma, median of all runs and numbers.
    least_over_found : float
        The least of a number's, median of the runs.
    error_predicted, error_found : float
        Root mean square of the error in units of either sigma.
    """

    motion: str
    kind: str
    numbers: int
    predicted: float
    over_found: float
    least_over_found: float
    error_predicted: float
    error_found: float


@dataclass(frozen=True)
class Result:
    """Of both motions; ``doubted`` and ``failed`` are logs."""

    kept: list[Kept]
    doubted: dict[str, int]
    failed: dict[str, int]


def loose_site(model_error: float) -> Site:
    """Return a site that is known to centimetres and degrees."""
    site = demo_site(coil_radius=None)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 0.02), np.full(2, 0.03))
    own = MagnetometerSigma(np.full((3, 3), 0.01), np.zeros(3), np.full(3, 0.03), np.full(3, 5e-3))
    sensor = replace(site.platform.magnetometer, sigma=own)
    return replace(
        site,
        beacons=tuple(replace(b, sigma=sigma) for b in site.beacons),
        platform=replace(site.platform, magnetometer=sensor),
        model_error=model_error,
    )


def planned(site: Site, config: Config) -> tuple[dict[str, Planned], Array]:
    """Return both motions, and which parameters stops can determine."""
    blocks = choose_blocks(site, SURVEY_GROUPS)
    result = next_motion(site, PLACES, config.stops, config.stop, known=False)
    proposed = Planned(
        np.array([stop.position_world for stop in result.stops]),
        np.array([stop.rpy_deg for stop in result.stops]),
        result.ratio,
    )
    poses = candidate_poses(site, blocks, PLACES, config.stop, known=False)
    away = np.linalg.norm(poses.position_world - np.mean(DEMO_BOX_WORLD, axis=0), axis=1)
    away[poses.attitude > 0] = np.inf
    near = np.argsort(away)[: config.stops]
    poor = Planned(
        poses.position_world[near],
        np.array([ATTITUDES_DEG[k] for k in poses.attitude[near]]),
        left_by(site, blocks, poses, near),
    )
    return {"proposed": proposed, "poor": poor}, result.parameters.requested


def left_by(site: Site, blocks: tuple[Block, ...], poses: Poses, chosen: Array) -> Array:
    """Return the sigmas that chosen candidates leave, of the declared ones."""
    root = poses.root[chosen]
    whole = prior_information(site, blocks) + np.sum(np.swapaxes(root, 1, 2) @ root, axis=0)
    return np.sqrt(np.diagonal(np.linalg.inv(whole)))


def through(plan: Planned, config: Config) -> SimulatedMotion:
    """Return a motion that rests at each stop, and goes straight from one to the next."""
    rests = Rests(start=config.stop, move=config.move, pause=config.stop)
    rate = progress_rate(config.duration, rests)
    whole = float(rate.integrate(rate.x[0], rate.x[-1]))
    at = np.linspace(0.0, whole, len(plan.rpy_deg))
    # All rests at the corners of the path, so that it need not be smooth there.
    knots = np.concatenate([at[:1], at, at[-1:]])
    turns = Rotation.from_euler("xyz", plan.rpy_deg, degrees=True)
    return SimulatedMotion(BSpline(knots, plan.position_world, 1), RotationSpline(at, turns), rate)


def recorded(site: Site, motion: SimulatedMotion, config: Config, seed: int) -> tuple[Log, Site]:
    """Return a log of a motion, and the true site."""
    site_rng, field_rng, imu_rng, wave_rng = np.random.default_rng(seed).spawn(4)
    true = perturb_site(site, site_rng)
    drives = draw_drives(true, site_rng)
    ambient = None
    if config.model_error > 0.0:
        length = site.model_error_length
        bent = draw_bending(field_rng, config.model_error, length, len(site.beacons))
        ambient = Ambient(bending=bent)
    known, duration = true.platform.imu, config.duration
    imu = simulate_imu(
        motion, known, true.gravity, IMU_RATE_HZ, duration, imu_rng, known.time_offset
    )
    wave = simulate_waveform(motion, true, drives, RATE_HZ, duration, wave_rng, None, None, ambient)
    return Log("stops", EPOCH_NS, "simulation", imu.samples, wave), true


def calibrated(log: Log, site: Site, true: Site) -> tuple[Array, Array, Verdict]:
    """Return error and found sigma of the survey's parameters, as reported by `calibrate log`."""
    result = smooth(log, site, SmootherSettings())
    honest, trust = judge_result(result, log)
    result, moved = against_site(honest, grown(result, honest))
    reference = result.calibration.reference_time
    error = difference(initial_calibration(true, reference), result.calibration, result.blocks)
    sigma = np.sqrt(np.diagonal(result.calibration_cov))
    at = {block.key: block.columns for block in result.blocks}
    own = [at[block.key] for block in choose_blocks(site, SURVEY_GROUPS)]
    rows = np.concatenate([np.arange(s.start, s.stop) for s in own])
    return error[rows], sigma[rows], (trust | moved).verdict


def run(config: Config) -> Result:
    """Measure both motions."""
    site = loose_site(config.model_error)
    blocks = choose_blocks(site, SURVEY_GROUPS)
    plans, requested = planned(site, config)
    requested = requested & ~is_free(blocks)
    declared, kept = prior_sigma(blocks), []
    kinds = np.array([f"{b.group}: {b.kind}" for b in blocks for _ in b.sigma])
    doubted, failed = dict.fromkeys(plans, 0), dict.fromkeys(plans, 0)
    for name, plan in plans.items():
        motion, errors, sigmas = through(plan, config), [], []
        for seed in range(config.seed, config.seed + config.runs):
            error, sigma, verdict = calibrated(*logged(site, motion, config, seed))
            doubted[name] += verdict is Verdict.DOUBTFUL
            failed[name] += verdict is Verdict.FAILED
            errors.append(error)
            sigmas.append(sigma)
        result, error = np.array(sigmas), np.array(errors)
        predicted = plan.predicted * declared
        for kind in [*dict.fromkeys(kinds[requested].tolist()), "all"]:
            own = requested & ((kinds == kind) | (kind == "all"))
            ratio = predicted[own] / result[:, own]
            kept.append(
                Kept(
                    name,
                    kind,
                    int(np.sum(own)),
                    float(np.median(plan.predicted[own])),
                    float(np.median(ratio)),
                    float(np.min(np.median(ratio, axis=0))),
                    rms(error[:, own] / predicted[own]),
                    rms(error[:, own] / result[:, own]),
                )
            )
    return Result(kept, doubted, failed)


def logged(
    site: Site, motion: SimulatedMotion, config: Config, seed: int
) -> tuple[Log, Site, Site]:
    """Return a log with the declared and the true site."""
    log, true = recorded(site, motion, config, seed)
    return log, site, true


def report(result: Result) -> str:
    """Return the table."""
    lines = [
        f"{'':41}predicted,  predicted over found    error in sigmas",
        f"{'motion':10}{'parameters':22}{'':5}of declared     median    least   predicted   found",
    ]
    for one in result.kept:
        lines.append(
            f"{one.motion:10}{one.kind:24}{one.numbers:3}{one.predicted:12.3f}"
            f"{one.over_found:13.2f}{one.least_over_found:9.2f}{one.error_predicted:11.2f}"
            f"{one.error_found:9.2f}"
        )
    lines += [
        f"{k}: {v} logs doubted, {result.failed[k]} failed" for k, v in result.doubted.items()
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure both motions."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="logs of each motion")
    parser.add_argument("--stops", type=int, default=Config.stops)
    parser.add_argument(
        "--model-error", type=float, default=Config.model_error, help="share of the fields"
    )
    given = parser.parse_args()
    config = Config(
        stops=given.stops, runs=given.runs, seed=given.seed, model_error=given.model_error
    )
    result = run(config)
    conclude(report(result), result)


if __name__ == "__main__":
    main()
