"""Navigate a vehicle through a warehouse while what can go wrong does.

Six two-axis beacons in a hall of 12 m by 8 m, a vehicle with a MEMS IMU among them, phasors twice
a second.  From the first minute on, a tenth of the phasors are outliers; then one beacon is silent
for a minute, the IMU for ten seconds, and the fields come 0.4 s late.  Both online estimators run
on the same data.  The question is what each disturbance costs while it lasts, and whether
anything of it is left afterwards: the position error should be back at its usual size within ten
epochs.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser

from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Coil, Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import SimulatedMotion, random_walk_motion
from magfusion.units import Array

Estimator = Literal["smoother", "ekf"]
ESTIMATORS: tuple[Estimator, ...] = ("smoother", "ekf")
HALL_WORLD = np.array([[0.5, 0.5, 0.4], [11.5, 7.5, 1.6]])  # m, where the vehicle drives
PLACES = ((0, 0), (6, 0), (12, 0), (0, 8), (6, 8), (12, 8))  # m
MOMENT = 300.0  # A m^2
STEP = 0.5  # s, between epochs
PHASES = {  # s
    "undisturbed": (20.0, 60.0),
    "outliers": (60.0, 120.0),
    "outliers, beacon 2 silent": (120.0, 180.0),
    "IMU silent": (180.0, 190.0),
    "after it": (195.0, 220.0),
    "fields 0.4 s late": (220.0, 260.0),
    "at the end": (265.0, 300.0),
}


@dataclass(frozen=True)
class Config:
    """Length and size of what goes wrong."""

    duration: float = 300.0  # s
    outlier_share: float = 0.1
    outlier_size: float = 0.5  # of the field
    field_sigma: float = 3e-10  # T
    delay: float = 0.5  # s, how late samples may be
    seed: int = 4


@dataclass(frozen=True, eq=False)
class World:
    """The data, and what they were made of."""

    site: Site
    motion: SimulatedMotion
    imu: ImuSamples
    fields: FieldSamples


def warehouse() -> Site:
    """Return the demo's platform among six stronger beacons."""
    plain = demo_site(coil_radius=None)
    first = plain.beacons[0]
    coils = (Coil(np.array([MOMENT, 0.0, 0.0])), Coil(np.array([0.0, MOMENT, 0.0]), -np.pi / 2.0))
    beacons = tuple(
        replace(
            first,
            name=f"W{i}",
            position_world=np.array([x, y, 0.2 + 0.3 * (i % 3)]),
            frequency_hz=15.0 + 5.0 * i,
            coils=coils,
        )
        for i, (x, y) in enumerate(PLACES)
    )
    return replace(plain, beacons=beacons)


def draw(config: Config) -> World:
    """Return a drive with everything that goes wrong on the way."""
    rng = np.random.default_rng(config.seed)
    site = warehouse()
    motion = random_walk_motion(rng, config.duration, HALL_WORLD, 0.8, tilt_rms=0.05)
    imu = simulate_imu(
        motion, site.platform.imu, site.gravity, 100.0, config.duration, rng, 0.0, None
    ).samples
    epochs = motion.trajectory(np.arange(STEP, config.duration - STEP, STEP))
    fields = simulate_fields(site, epochs, config.field_sigma, rng, window=0.4)
    return World(site, motion, _silenced(imu), _corrupted(fields, config, rng))


def _silenced(imu: ImuSamples) -> ImuSamples:
    begin, end = PHASES["IMU silent"]
    there = (imu.time < begin) | (imu.time > end)
    return ImuSamples(imu.time[there], imu.gyro_body[there], imu.accel_body[there])


def _corrupted(fields: FieldSamples, config: Config, rng: np.random.Generator) -> FieldSamples:
    phasor = fields.phasor_sensor.copy()
    after = fields.time >= PHASES["outliers"][0]
    hit = (rng.random(phasor.shape[:2]) < config.outlier_share) & after[:, None]
    wrong = rng.normal(0.0, config.outlier_size, (2, *phasor.shape))
    size = np.linalg.norm(phasor, axis=2, keepdims=True)
    phasor = np.where(hit[..., None], phasor + size * (wrong[0] + 1j * wrong[1]), phasor)
    begin, end = PHASES["outliers, beacon 2 silent"]
    silent = (fields.time >= begin) & (fields.time < end)
    phasor[silent, 2] = np.nan
    return replace(fields, phasor_sensor=phasor)


def navigate(world: World, estimator: Estimator, config: Config) -> tuple[list[State], Navigator]:
    """Feed an estimator half a second at a time, the fields of the late phase later."""
    navigator = Navigator(world.site, NavigatorSettings(estimator=estimator, delay=config.delay))
    late_from, late_to = PHASES["fields 0.4 s late"]
    time = world.fields.time
    late = np.where((time >= late_from) & (time < late_to), 0.4, 0.0)
    arrives = np.searchsorted(np.sort(time + late), time + late)
    order = np.argsort(arrives, kind="stable")
    built: list[State] = []
    fed = 0
    for k in order:
        rows = slice(fed, int(np.searchsorted(world.imu.time, time[k] + late[k])))
        if rows.stop > rows.start:
            fed = rows.stop
            navigator.add_imu(
                world.imu.time[rows], world.imu.gyro_body[rows], world.imu.accel_body[rows]
            )
        navigator.add_fields(world.fields.rows(slice(int(k), int(k) + 1)))
        built += navigator.take()
    return built, navigator


def errors(world: World, result: Trajectory) -> Array:
    """Return the distance from the true position at each state (m)."""
    true = world.motion.trajectory(result.time)
    return np.asarray(np.linalg.norm(result.position_world - true.position_world, axis=1))


def recovery(result: Trajectory, error: Array) -> int:
    """Return how many epochs after the IMU came back the error stays within three times usual."""
    begin, end = PHASES["undisturbed"]
    usual = float(np.sqrt(np.mean(error[(result.time >= begin) & (result.time < end)] ** 2)))
    after = np.flatnonzero(result.time > PHASES["IMU silent"][1])
    beyond = np.flatnonzero(error[after][:40] > 3.0 * usual)
    return int(beyond[-1] + 1) if len(beyond) else 0


def run(config: Config, output: Path | None = None) -> dict[str, object]:
    """Navigate with both estimators; return the figures."""
    world = draw(config)
    figures: dict[str, object] = {}
    drawn = {}
    for estimator in ESTIMATORS:
        states, navigator = navigate(world, estimator, config)
        result = as_trajectory(states)
        error = errors(world, result)
        drawn[estimator] = (result, error)
        for name, (begin, end) in PHASES.items():
            part = (result.time >= begin) & (result.time < end)
            rms = float(np.sqrt(np.mean(error[part] ** 2))) if np.any(part) else None
            figures[f"{estimator}, {name}"] = None if rms is None else round(100.0 * rms, 3)
        figures[f"{estimator}, epochs to recover"] = recovery(result, error)
        figures[f"{estimator}, counts"] = dict(navigator.counts)
    if output is not None:
        write_picture(drawn, output)
    return figures


def report(figures: dict[str, object]) -> str:
    """Return the table that a reader sees."""
    lines = [f"{'position error, rms (cm)':<32}" + "".join(f"{e:>12}" for e in ESTIMATORS)]
    for name in (*PHASES, "epochs to recover"):
        cells = "".join(f"{figures[f'{e}, {name}']!s:>12}" for e in ESTIMATORS)
        lines.append(f"  {name:<30}{cells}")
    return "\n".join(lines)


def write_picture(drawn: dict[Estimator, tuple[Trajectory, Array]], output: Path) -> None:
    """Write the way through the hall, and the errors over time."""
    figure = blank_figure(13.0, 5.0)
    plan, over_time = figure.subplots(1, 2)
    for estimator, (result, error) in drawn.items():
        plan.plot(*result.position_world[:, :2].T, linewidth=0.8, label=estimator)
        over_time.semilogy(result.time, 100.0 * error, linewidth=0.8, label=estimator)
    plan.plot(*np.array(PLACES, dtype=float).T, "k^", label="beacons")
    plan.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="the way")
    plan.legend(loc="upper right")
    for name, (begin, end) in PHASES.items():
        over_time.axvspan(begin, end, color="0.9")
        over_time.text(begin, 0.12, name, rotation=90, fontsize=8, va="bottom")
    over_time.set(xlabel="time (s)", ylabel="position error (cm)", title="what it costs")
    over_time.legend()
    save_picture(figure, output / "online_warehouse.png", dpi=100)


def main() -> None:
    """Print the table and one JSON line; draw where a directory is given."""
    options = scenario_parser(__doc__, Config.seed).parse_args()
    figures = run(Config(seed=options.seed), options.output)
    conclude(report(figures), figures)


if __name__ == "__main__":
    main()
