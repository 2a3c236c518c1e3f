"""A vehicle that drives out of the field and back by its aiding sensors.

Of every vehicle the speed (1 to 3 m/s), the line, the calibration within what the site declares and
all noise are drawn.  A gallery of 400 m has four beacons at each end; between the ends no beacon is
detected for some 150 m.  The wheels have 1 % of noise, a scale within 2 %, and slip twice by 10 %
for 2 s.  Reported is the error at the end of the gap as a share of its way, and its NEES.

1. By odometry the median share is at most 0.6 %, the mean NEES 4.5 to 7.5, none above 25.
2. At the end of the gap the position moves by at most 3 sigma of what was claimed.
3. Without aiding the position is wide or lost there, never confident.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from harness import chosen_scale, conclude, scenario_parser
from scipy.spatial.transform import Rotation

import magfusion as mf
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.jobs.replay import Replay, feed
from magfusion.model.aiding import AidingSamples, AidingSensor, AidingSigma
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.motion import Rests
from magfusion.units import Array

LENGTH, WIDTH = 400.0, 8.0  # m
PLACES = (10.0, 40.0, 70.0, 100.0)  # m from each end
GAP = (125.0, 275.0)  # m from the first end
SLIP, SLIP_DURATION = 0.1, 2.0  # share, s
TONES_HZ = 15.0 + 2.5 * np.arange(8)
CONFIDENT = 3.0  # m; who claims less after the gap must be right
SILENT = 25.0  # NEES of six numbers; what is beyond is believed and wrong
Aiding = Literal["wheels", "ranges", "heights", "marks", "none"]
Method = Literal["ekf", "smoother", "smooth"]


@dataclass(frozen=True)
class Config:
    """What is drawn, and how often."""

    vehicles: int = 30
    aiding: Aiding = "wheels"
    method: Method = "ekf"
    seed: int = 0


@dataclass(frozen=True)
class Row:
    """A vehicle at the end of the gap."""

    speed: float
    way_m: float
    error_m: float
    sigma_m: float
    nees: float
    step_sigma: float
    verdict: str


def gallery(sensors: tuple[AidingSensor, ...]) -> Site:
    """Return the site: beacons on alternate walls of both ends."""
    usual, rng = demo_site(), np.random.default_rng(1)
    beacons = []
    for i, x in enumerate([*PLACES, *(LENGTH - place for place in PLACES)]):
        turn = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3)).as_matrix()
        place = np.array([x, WIDTH * (i % 2), 0.5 + 2.0 * (i // 2 % 2)])
        beacons.append(_beacon(usual.beacons[i % 4], "ABCDEFGH"[i], place, turn, TONES_HZ[i]))
    return replace(usual, beacons=tuple(beacons), aiding=sensors)


def _beacon(usual: Beacon, name: str, place: Array, turn: Array, frequency_hz: float) -> Beacon:
    return replace(
        usual,
        name=name,
        position_world=place,
        world_from_beacon=turn,
        frequency_hz=frequency_hz,
    )


def sensors_of(aiding: Aiding) -> tuple[AidingSensor, ...]:
    """Return the aiding sensors of a vehicle; all but none have wheels."""
    wheels = AidingSensor(
        "wheels",
        "velocity",
        sigma=0.005,
        relative_sigma=0.01,
        constraint_sigma=0.02,
        sigmas=AidingSigma(scale=np.array(0.02)),
    )
    if aiding == "none":
        return ()
    lever = np.array([0.3, 0.2, 1.0])
    more = {
        "wheels": (),
        "ranges": tuple(
            AidingSensor(
                f"range_{i}",
                "range",
                0.1,
                position_body=lever,
                point_world=np.array([x, WIDTH * i, 2.0]),
                rate_hz=2.0,
                sigmas=AidingSigma(offset=np.array(0.3)),
            )
            for i, x in enumerate((150.0, 250.0))
        ),
        "heights": (
            AidingSensor(
                "height", "height", 0.05, position_body=lever, offset_walk=0.3, rate_hz=2.0
            ),
        ),
        "marks": (AidingSensor("mark", "mark", 0.02, marks_world={}),),
    }
    return (wheels, *more[aiding])


def simulate_vehicle(config: Config, rng: np.random.Generator) -> tuple[SimulatedLog, Site, float]:
    """Return the log of a vehicle with its slips, its site, and its speed (m/s)."""
    speed = float(rng.uniform(1.0, 3.0))
    site = gallery(sensors_of(config.aiding))
    box = np.array([[2.0, 0.2 * WIDTH, 1.0], [LENGTH - 2.0, 0.8 * WIDTH, 1.0]])
    duration = 0.9 * LENGTH / speed
    simulated = simulate_log(
        site,
        SimulationConfig(
            box,
            duration,
            motion="drive",
            speed=speed,
            rests=Rests(2.0, duration, 0.0),
            imu_rate_hz=100.0,
            magnetometer_rate_hz=100.0,
        ),
        rng,
    )
    log = simulated.log
    if "wheels" in log.aiding:
        slipped = _slipping(log.aiding["wheels"], simulated, rng)
        log = replace(log, aiding={**log.aiding, "wheels": slipped})
    if config.aiding == "marks":
        site, log = _with_marks(site, log, simulated, rng)
    return replace(simulated, log=log), site, speed


def _slipping(
    samples: AidingSamples, simulated: SimulatedLog, rng: np.random.Generator
) -> AidingSamples:
    """Return the wheels' samples with two slips in the gap."""
    time = samples.time
    inside = time[_in_gap(simulated.motion.position_world(time))]
    value = samples.value.copy()
    for begin in rng.uniform(inside[0], inside[-1] - SLIP_DURATION, 2):
        value[(time >= begin) & (time < begin + SLIP_DURATION)] *= 1.0 + SLIP
    return replace(samples, value=value)


def _with_marks(
    site: Site, log: Log, simulated: SimulatedLog, rng: np.random.Generator
) -> tuple[Site, Log]:
    """Return site and log with two marks in the gap over which the body passes."""
    time = log.aiding["wheels"].time
    inside = np.flatnonzero(_in_gap(simulated.motion.position_world(time)))
    passed = time[inside[[len(inside) // 3, 2 * len(inside) // 3]]]
    there = simulated.motion.position_world(passed) + rng.normal(0.0, 0.02, (2, 3))
    names = ("1", "2")
    sensors = tuple(
        replace(s, marks_world=dict(zip(names, there, strict=True))) if s.quantity == "mark" else s
        for s in site.aiding
    )
    samples = AidingSamples("mark", passed, np.zeros((2, 0)), names)
    return replace(site, aiding=sensors), replace(log, aiding={**log.aiding, "mark": samples})


def _in_gap(position_world: Array) -> Array:
    return (position_world[:, 0] > GAP[0]) & (position_world[:, 0] < GAP[1])


def run_vehicle(config: Config, rng: np.random.Generator) -> Row:
    """Drive a vehicle and return how it is at the end of the gap."""
    simulated, site, speed = simulate_vehicle(config, rng)
    run = _smoothed if config.method == "smooth" else _navigated
    time, rotation, position, cov, failed, verdict = run(simulated.log, site, config)
    true = simulated.motion.position_world(time)
    inside = _in_gap(true)
    last = int(np.flatnonzero(inside)[-1])
    after = int(np.flatnonzero(true[:, 0] > GAP[1] + 30.0)[0])
    cov_world = rotation[last] @ cov[last][3:6, 3:6] @ rotation[last].T
    error = position[last] - true[last]
    nees = _nees(rotation[last], error, cov[last], simulated, float(time[last]))
    step = (position[after] - true[after]) - error
    jump = float(np.sqrt(step @ np.linalg.solve(cov_world, step) / 3.0))
    way = float(np.ptp(true[inside, 0]))
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(cov_world))))
    verdict = Verdict.FAILED.value if failed[last] else verdict
    return Row(speed, way, float(np.linalg.norm(error)), sigma, nees, jump, verdict)


def _nees(rotation: Array, error: Array, cov: Array, simulated: SimulatedLog, time: float) -> float:
    true = simulated.motion.world_from_body(np.array([time])).as_matrix()[0]
    turn = Rotation.from_matrix(true.T @ rotation).as_rotvec()
    both = np.concatenate([turn, rotation.T @ error])
    return float(both @ np.linalg.solve(cov[:6, :6], both))


def _navigated(
    log: Log, site: Site, config: Config
) -> tuple[Array, Array, Array, Array, Array, str]:
    method = "ekf" if config.method == "ekf" else "smoother"
    navigator = Navigator(site, NavigatorSettings(estimator=method))
    states = []
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
        states += navigator.take()
    return (
        np.array([s.time for s in states]),
        np.array([s.world_from_body for s in states]),
        np.array([s.position_world for s in states]),
        np.array([s.cov[:6, :6] for s in states]),
        np.array([s.is_lost for s in states]),
        states[-1].verdict.value,
    )


def _smoothed(log: Log, site: Site, _: Config) -> tuple[Array, Array, Array, Array, Array, str]:
    result, trust = mf.judge_result(mf.smooth(log, site), log)
    states = result.states
    assert states.pose_cov is not None
    failed = np.full(len(states), trust.verdict is Verdict.FAILED)
    parts = states.time, states.world_from_body, states.position_world, states.pose_cov
    return *parts, failed, trust.verdict.value


def main() -> None:
    """Run the vehicles, print them and their statistics, and check the criteria."""
    parser = scenario_parser(__doc__, seed=0, output=None, parallel=True)
    parser.add_argument("--vehicles", type=int, default=30)
    parser.add_argument(
        "--aiding", default="wheels", choices=["wheels", "ranges", "heights", "marks", "none"]
    )
    parser.add_argument("--method", default="ekf", choices=["ekf", "smoother", "smooth"])
    options = parser.parse_args()
    config = Config(options.vehicles, options.aiding, options.method, options.seed)
    scale = chosen_scale(options)
    rows = run_many(run_vehicle, [config] * config.vehicles, seed=config.seed, **scale)
    conclude(report(rows), {"config": config, "rows": rows, "summary": summary(rows)})


def summary(rows: list[Row]) -> dict[str, float]:
    """Return the statistics that the criteria are about."""
    nees = np.array([row.nees for row in rows])
    share = np.array([row.error_m / row.way_m for row in rows])
    return {
        "median_share_percent": 100.0 * float(np.median(share)),
        "mean_nees": float(np.mean(nees)),
        "max_nees": float(np.max(nees)),
        "max_step_sigma": max(row.step_sigma for row in rows),
        "confident": float(sum(row.sigma_m < CONFIDENT and row.nees > SILENT for row in rows)),
    }


def report(rows: list[Row]) -> str:
    """Return a line for each vehicle, and the statistics."""
    lines = ["speed  way     error   sigma   NEES   step   verdict"]
    lines += [
        f"{row.speed:4.2f}  {row.way_m:5.1f} m {row.error_m:6.2f} m {row.sigma_m:5.2f} m"
        f" {row.nees:6.1f} {row.step_sigma:6.2f}   {row.verdict}"
        for row in rows
    ]
    return "\n".join([*lines, *(f"{name:22} {value:.3g}" for name, value in summary(rows).items())])


if __name__ == "__main__":
    main()
