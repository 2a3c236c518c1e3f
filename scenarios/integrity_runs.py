"""Is the protection level kept along a path?  Runs of the filter with one false beacon each.

Every run is a walk of half a minute among four beacons whose field deviates from the model, from
place to place, by what is declared.  At an instant one beacon's field becomes false by up to 20 %
of either sign, at once or in a ramp.  What comes before is the run without a fault.

1. How often is position or attitude beyond its level, without an alarm by two seconds later?  The
   upper 95 % limit over the runs, times the prior of a fault, is below the risk of 1e-4.
2. How often does an alarm begin without a fault?  In less than one epoch of a thousand.
3. Is the level of use?  Its median is below four times the claimed 3-sigma radius, and there is one
   in 99 % of the epochs.

The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from integrity import SIGMA, room, upper_limit
from integrity import Config as Room

from magfusion.estimation.graph.state import POSITION
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.jobs.replay import Replay, feed
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.trust import Risk, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, simulate_fields
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.motion import SimulatedMotion, random_walk_motion
from magfusion.units import DEGREE, Array, ComplexArray

IMU_RATE_HZ = 100.0
STEP = 0.2  # s between epochs
MIN_ONSET, MAX_DELAY_S = 10.0, 20.0  # s, of a fault's begin
MAX_RAMP = 10.0  # s
IN_TIME = 2.0  # s, of an alarm after the level is left
CONVERGED_STEP = 1.0  # s after the first state, before which there is no level yet
MODES = 20  # of the field's error in space
WAVELENGTH = 1.0  # m, of the shortest of them


@dataclass(frozen=True)
class Config:
    """How many runs, and how false a beacon may be."""

    runs: int = 2000
    duration: float = 30.0
    largest: float = 0.2
    estimator: Literal["ekf", "smoother"] = "ekf"
    seed: int = 0


@dataclass(frozen=True)
class OnlineOutcome:
    """What came of one run.

    Parameters
    ----------
    share, ramp : float
        Of the field that is false at last, and the time until then (s).
    clean, onsets : int
        Epochs before the fault, and alarms that began there.
    unseen : int
        Epochs beyond the level without an alarm in time.
    detected : float, optional
        From the fault to the first alarm (s).
    ratio : float
        Median, before the fault, of the level over three times the claimed sigma.
    known : int
        Epochs before the fault with a level.
    error_m, error_before_m : float
        Largest error of what was not lost, after and before the fault began.
    """

    share: float
    ramp: float
    clean: int
    onsets: int
    unseen: int
    detected: float | None
    ratio: float
    known: int
    error_m: float
    error_before_m: float


class Figures(NamedTuple):
    """Size of the run."""

    runs: int
    unseen_runs: int
    unseen_limit: float
    hazard_limit: float
    clean_epochs: int
    false_alarms: int
    false_alarm_limit: float
    detected: float
    median_ratio: float
    finite: float


def error_in_space(
    points_world: Array, count: int, sigma: float, rng: np.random.Generator
) -> Array:
    """Return a smooth random function of place for each of some channels, shape (n, count).

    Its standard deviation over all draws is ``sigma`` anywhere.
    """
    waves = rng.normal(size=(count, MODES, 3))
    waves *= 2.0 * np.pi / WAVELENGTH / np.linalg.norm(waves, axis=2, keepdims=True)
    waves *= rng.uniform(0.2, 1.0, (count, MODES, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (count, MODES))
    turn = np.einsum("nd,cmd->ncm", points_world, waves) + phase
    return sigma * np.sqrt(2.0 / MODES) * np.sum(np.cos(turn), axis=2)


def simulated(
    config: Config, rng: np.random.Generator
) -> tuple[Log, SimulatedMotion, float, float, float]:
    """Return a log, its motion, and when, by how much and how slowly a beacon becomes false."""
    of_room = Room()
    site = room(of_room)
    motion = random_walk_motion(rng, config.duration, DEMO_BOX_WORLD)
    imu = simulate_imu(
        motion, site.platform.imu, site.gravity, IMU_RATE_HZ, config.duration, rng
    ).samples
    truth = motion.trajectory(np.arange(STEP, config.duration - STEP, STEP))
    samples = simulate_fields(site, truth, SIGMA, rng, window=STEP)
    phasor = samples.phasor_sensor
    size = np.sqrt(np.sum(np.abs(phasor) ** 2, axis=-1, keepdims=True) / 6.0)
    channels = len(samples.channels)
    wrong = error_in_space(truth.position_world, 6 * channels, of_room.model_error, rng)
    parts = wrong.reshape(len(truth.time), channels, 3, 2)
    phasor = phasor + size * (parts[..., 0] + 1j * parts[..., 1])
    began = rng.uniform(MIN_ONSET, MAX_DELAY_S)
    ramp = 0.0 if rng.random() < 0.5 else rng.uniform(0.0, MAX_RAMP)
    share = rng.uniform(-config.largest, config.largest)
    name = site.beacons[int(rng.integers(0, len(site.beacons)))].name
    phasor = _falsified(samples, phasor, name, share, began, ramp)
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape).copy()
    fields = replace(samples, phasor_sensor=phasor, phasor_cov=cov)
    log = Log("run", EPOCH_NS, "simulation", imu=imu, waveform=None, fields=fields)
    return log, motion, began, share, ramp


def _falsified(
    samples: FieldSamples, phasor: ComplexArray, name: str, share: float, began: float, ramp: float
) -> ComplexArray:
    grown = np.clip((samples.time - began) / max(ramp, 1e-9), 0.0, 1.0)
    own = np.array([beacon == name for beacon, _ in samples.channels])
    return np.asarray(phasor * (1.0 + share * grown[:, None] * own)[..., None])


def navigated(config: Config, log: Log) -> list[JudgedState]:
    """Return the states as they were when made."""
    settings = NavigatorSettings(estimator=config.estimator, risk=Risk())
    navigator = Navigator(room(Room()), settings)
    replay = Replay(log)
    built = []
    for k in range(len(replay)):
        feed(navigator, replay.piece(k))
        built += navigator.take()
    return built


def try_run(config: Config, rng: np.random.Generator) -> OnlineOutcome:
    """Return what came of one run."""
    log, motion, began, share, ramp = simulated(config, rng)
    states = navigated(config, log)
    time = np.array([state.time for state in states])
    true = motion.trajectory(time)
    error_m = np.array(
        [
            np.linalg.norm(state.position_world - place)
            for state, place in zip(states, true.position_world, strict=True)
        ]
    )
    rotated = np.array(
        [
            np.arccos(np.clip((np.trace(state.world_from_body.T @ pose) - 1.0) / 2.0, -1.0, 1.0))
            for state, pose in zip(states, true.world_from_body, strict=True)
        ]
    )
    levels = [(s.judgement.protection_level_m, s.judgement.protection_level_deg) for s in states]
    known = np.array([None not in level for level in levels])
    level_m = np.array([np.inf if m is None else m for m, _ in levels])
    level_deg = np.array([np.inf if d is None else d for _, d in levels])
    alarm = np.array([state.verdict is not Verdict.TRUSTWORTHY for state in states])
    lost_epochs = np.array([state.is_lost for state in states])
    beyond = (error_m > level_m) | (rotated / DEGREE > level_deg)
    before = (time < began) & (time > time[0] + CONVERGED_STEP)
    unseen = 0
    for t in time[beyond & (time >= began)]:
        unseen += not np.any(alarm[(time >= t) & (time <= t + IN_TIME)])
    first = time[alarm & (time >= began)]
    radius = np.array([3.0 * np.sqrt(np.trace(s.cov[POSITION, POSITION])) for s in states])
    onsets = int(np.sum(np.diff(alarm[before].astype(int), prepend=0) == 1))
    usual = before & known
    return OnlineOutcome(
        share=share,
        ramp=ramp,
        clean=int(np.sum(before)),
        onsets=onsets,
        unseen=unseen,
        detected=float(first[0] - began) if len(first) else None,
        ratio=float(np.median(level_m[usual] / radius[usual])) if np.any(usual) else np.nan,
        known=int(np.sum(usual)),
        error_m=float(np.max(error_m[(time >= began) & ~lost_epochs], initial=0.0)),
        error_before_m=float(np.max(error_m[before], initial=0.0)),
    )


def run(config: Config, scale: Scale | None = None) -> list[OnlineOutcome]:
    """Return what came of all runs."""
    return run_many(try_run, [config] * config.runs, seed=config.seed, **(scale or {}))


def figures(result: Sequence[OnlineOutcome], risk: Risk | None = None) -> Figures:
    """Return the figures of all runs."""
    risk = Risk() if risk is None else risk
    missed = sum(one.unseen > 0 for one in result)
    clean, onsets = sum(one.clean for one in result), sum(one.onsets for one in result)
    limit = upper_limit(missed, len(result))
    return Figures(
        runs=len(result),
        unseen_runs=missed,
        unseen_limit=limit,
        hazard_limit=limit * Room().beacons * risk.fault,
        clean_epochs=clean,
        false_alarms=onsets,
        false_alarm_limit=upper_limit(onsets, clean),
        detected=float(np.mean([one.detected is not None for one in result])),
        median_ratio=float(np.nanmedian([one.ratio for one in result])),
        finite=sum(one.known for one in result) / clean,
    )


def report(result: Sequence[OnlineOutcome]) -> str:
    """Return what a reader sees."""
    sums = figures(result)
    worst = max(result, key=lambda one: one.unseen)
    delays = [one.detected for one in result if one.detected is not None]
    lines = [
        f"{sums.runs} runs with a false beacon; {sums.detected:.0%} findings, after"
        f" {np.median(delays) if delays else np.nan:.1f} s (median)",
        f"  beyond the level, unseen       {sums.unseen_runs} runs: at most {sums.unseen_limit:.2g}"
        f" of them, {sums.hazard_limit:.2g} an epoch",
        f"  alarms without a fault         {sums.false_alarms} in {sums.clean_epochs} epochs, at"
        f" most {sums.false_alarm_limit:.2g}",
        f"  level over the 3-sigma radius  {sums.median_ratio:.2f} (median), known in"
        f" {sums.finite:.2%}",
        f"  largest error not lost         {1e3 * max(one.error_m for one in result):.3g} mm with a"
        f" fault, {1e3 * max(one.error_before_m for one in result):.3g} mm without",
    ]
    if worst.unseen:
        lines.append(
            f"  worst run: {worst.unseen} epochs unseen, {100 * worst.share:.2g} % in"
            f" {worst.ramp:.2g} s"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the figures and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, "twenty runs", output=None, parallel=True)
    parser.add_argument("--runs", type=int, default=Config.runs)
    parser.add_argument("--largest", type=float, default=Config.largest)
    parser.add_argument("--estimator", choices=("ekf", "smoother"), default=Config.estimator)
    given = parser.parse_args()
    config = Config(
        runs=20 if given.quick else given.runs,
        largest=given.largest,
        estimator=given.estimator,
        seed=given.seed,
    )
    result = run(config, chosen_scale(given))
    conclude(report(result), figures(result)._asdict())


if __name__ == "__main__":
    main()
