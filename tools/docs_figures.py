"""Draw the figures of the theory page, of the package's own functions: docs/figures/*.png.

``python tools/docs_figures.py [NAME ...]``
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.graph.preintegration import preintegration_parameters
from magfusion.estimation.integrity.fault_candidates import fault_candidates
from magfusion.estimation.integrity.score import scores_of
from magfusion.estimation.snapshot.fix_separation import separate_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.field import predict
from magfusion.model.parameters import initial_calibration
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_fields, simulate_log
from magfusion.units import NANOTESLA, Array

mpl.use("Agg")
DIRECTORY = Path(__file__).resolve().parents[1] / "docs" / "figures"
GOOD, WRONG = "#1f77b4", "#d62728"


def _titled(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)


def _grid(points: int) -> tuple[Array, Array]:
    along = np.linspace(-3.0, 3.0, points)
    plane = np.stack(np.meshgrid(along, along), axis=-1)
    return along, np.concatenate([plane, np.zeros((points, points, 1))], axis=-1)


def dipole(figure: Figure) -> None:
    """Draw field lines of one coil; ellipses of a rotating beacon, small where it is weak."""
    remaining, right = figure.subplots(1, 2)
    along, places = _grid(60)
    field = dipole_field(places, np.array([0.0, 220.0, 0.0]))
    colour = np.log10(np.linalg.norm(field, axis=-1) / NANOTESLA)
    remaining.streamplot(along, along, field[..., 0], field[..., 1], color=colour, density=1.2)
    _titled(remaining, "field of one coil, its moment upwards; yellow: strong", "x (m)", "y (m)")
    site = demo_site(coil_radius=None)
    beacon = replace(site.beacons[0], position_world=np.zeros(3), world_from_beacon=np.eye(3))
    magnetometer = replace(
        site.platform.magnetometer, position_body=np.zeros(3), body_from_sensor=np.eye(3)
    )
    turn = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 60))
    for place in _grid(7)[1].reshape(-1, 3):
        if np.linalg.norm(place) < 0.5:
            continue
        phasor = predict(beacon, magnetometer, np.eye(3), place)[0]
        ellipse = (phasor * turn[:, None]).real[:, :2]
        size = np.max(np.linalg.norm(ellipse, axis=1))
        shown = 0.33 * ellipse / size * (size / 2e-6) ** 0.2
        right.plot(place[0] + shown[:, 0], place[1] + shown[:, 1], color=GOOD)
        right.plot(place[0] + shown[0, 0], place[1] + shown[0, 1], ".", color=WRONG)
    right.plot(0.0, 0.0, "k*")
    _titled(right, "a rotating beacon; dots: at the zero of the phase", "x (m)", "y (m)")
    for axes in (remaining, right):
        axes.set_aspect("equal")


def inertial(figure: Figure) -> None:
    """Draw the standard deviation of position by dead reckoning, and the error of a fix."""
    imu = demo_site().platform.imu
    parameters = preintegration_parameters(imu, 9.81, bridge=False)
    summed = gtsam.PreintegratedCombinedMeasurementsG(parameters, gtsam.imuBias.ConstantBias())
    time, position = np.arange(1, 6001) / 100.0, []
    for _ in time:
        summed.integrateMeasurement(np.array([0.0, 0.0, 9.81]), np.zeros(3), 0.01)
        position.append(np.sqrt(np.trace(summed.preintMeasCov()[3:6, 3:6]) / 3.0))
    axes = figure.subplots()
    axes.loglog(time, position, color=WRONG, label="white noise of the demo's IMU, alone")
    biased = np.hypot(position, 0.5 * imu.accel_bias_sigma * time**2)
    axes.loglog(time, biased, "--", color=WRONG, label="and its bias, before it is learnt")
    samples, truth, site = _walk(200, np.random.default_rng(1))
    fixes = fix_epochs(samples, initial_calibration(site, 0.0))
    fixed = np.median(np.linalg.norm(fixes.position_world[:, 0] - truth.position_world, axis=1))
    axes.axhline(fixed, color=GOOD, label="one fix among four beacons, median error")
    _titled(axes, "sigma of the position", "time without fields (s)", "position (m)")
    axes.legend(fontsize=8)


def _walk(epochs: int, rng: np.random.Generator) -> tuple[FieldSamples, Trajectory, Site]:
    site = replace(demo_site(coil_radius=None), model_error=5e-4)
    truth = Trajectory(
        time=0.2 * np.arange(epochs),
        world_from_body=Rotation.random(epochs, random_state=rng).as_matrix(),
        position_world=rng.uniform(*DEMO_BOX_WORLD, (epochs, 3)),
    )
    return simulate_fields(site, truth, 3e-10, rng), truth, site


def _gains(site: Site, declared: Site) -> dict[str, float]:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, perturb=False)
    log = simulate_log(site, config, np.random.default_rng(4)).log
    result = smooth(log, declared, SmootherSettings(estimate=()))
    scores = scores_of(result, log.imu)
    assert scores is not None
    score = scores.fixed
    gains = {}
    for fault in fault_candidates(declared, score.fixed):
        gradient = fault.combine.T @ score.gradient
        information = fault.combine.T @ score.information @ fault.combine
        degrees = fault.combine.shape[1]
        fall = float(gradient @ np.linalg.pinv(information, rcond=1e-10) @ gradient)
        gains[fault.name] = max(gains.get(fault.name, 0.0), fall / degrees)
    return gains


def score(figure: Figure) -> None:
    """Draw the fall of the cost by estimating each fixed parameter, for each degree of freedom."""
    site = demo_site(coil_radius=None)
    magnetometer = site.platform.magnetometer
    off = replace(magnetometer, position_body=magnetometer.position_body + np.array([0.03, 0, 0]))
    wrong = replace(site, platform=replace(site.platform, magnetometer=off))
    good, bad = _gains(site, site), _gains(site, wrong)
    names = sorted(bad, key=lambda name: -bad[name])[:10][::-1]
    axes, rows = figure.subplots(), np.arange(len(names))
    axes.barh(rows + 0.2, [bad[n] for n in names], 0.4, color=WRONG, label="lever arm 3 cm off")
    axes.barh(rows - 0.2, [good[n] for n in names], 0.4, color=GOOD, label="site as it is")
    axes.axvline(1.0, color="k", linewidth=0.8)
    axes.set_yticks(rows, names, fontsize=8)
    axes.set_xscale("log")
    axes.set_xlim(left=0.1)
    _titled(
        axes,
        "gain of estimating a parameter (1: by chance)",
        "decrease of cost per degree of freedom",
        "",
    )
    axes.legend(fontsize=8, loc="center right")


def separation(figure: Figure) -> None:
    """Draw the error of fixes where one beacon is false, and without it."""
    samples, truth, site = _walk(120, np.random.default_rng(2))
    owner = np.array([name for name, _ in samples.channels]) == site.beacons[0].name
    calibration = initial_calibration(site, 0.0)
    shares = np.array([0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2])
    errors, kept, levels = [], [], []
    for share in shares:
        false = np.where(owner[:, None], 1.0 + share, 1.0)
        spoiled = replace(samples, phasor_sensor=samples.phasor_sensor * false)
        fixes = fix_epochs(spoiled, calibration)
        separated = separate_fixes(spoiled, calibration, fixes)
        for result, into in ((fixes, errors), (separated.fixes, kept)):
            off = np.linalg.norm(result.position_world[:, 0] - truth.position_world, axis=1)
            into.append(1e3 * np.median(off))
        levels.append(1e3 * np.nanmedian(separated.states.protection_level_m))
    axes = figure.subplots()
    axes.loglog(100.0 * shares[1:], errors[1:], "o-", color=WRONG, label="all beacons")
    axes.loglog(100.0 * shares[1:], kept[1:], "o-", color=GOOD, label="without the excluded beacon")
    axes.loglog(100.0 * shares[1:], levels[1:], "k--", label="protection level")
    axes.axhline(errors[0], color="k", linestyle=":", label="all beacons, no fault")
    axes.set_ylim(bottom=0.6 * errors[0])
    _titled(
        axes,
        "one of four beacons has a scale error (medians)",
        "scale error (%)",
        "position error (mm)",
    )
    axes.legend(fontsize=8)


FIGURES: dict[str, tuple[Callable[[Figure], None], tuple[float, float]]] = {
    "dipole": (dipole, (9.0, 4.4)),
    "inertial": (inertial, (6.0, 3.6)),
    "score": (score, (7.0, 3.8)),
    "separation": (separation, (6.0, 3.6)),
}


def draw(names: list[str], directory: Path = DIRECTORY) -> list[Path]:
    """Draw figures, and return where they are."""
    directory.mkdir(parents=True, exist_ok=True)
    built = []
    for name in names:
        make, size = FIGURES[name]
        figure = Figure(figsize=size, layout="constrained")
        make(figure)
        built.append(directory / f"{name}.png")
        figure.savefig(built[-1], dpi=80)
    return built


def main() -> None:
    """Draw those that are named, or all."""
    parser = argparse.ArgumentParser(description="Draw the figures of the theory page.")
    parser.add_argument("names", nargs="*", choices=[*FIGURES, []])
    for path in draw(parser.parse_args().names or list(FIGURES)):
        print(path)


if __name__ == "__main__":
    main()
