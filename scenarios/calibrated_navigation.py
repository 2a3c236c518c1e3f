"""What the calibration of the beacons is worth to who navigates by them: paper 002, second part.

The paper fixes 200 targets with beacons whose magnetic centre is taken to be the geometric one
and to point where their coils point, and with calibrated ones: 0.154 m and 3.5 degrees become
0.110 m and 1.3 degrees (figures 9 and 10; drawn here with -o).  It does not state how far off its
beacons were.  The scenario displaces three beacons by 3 cm and 3 degrees along each axis, which is
the paper's gain (0.108 m and 3.25 degrees removed by calibration), and answers:

1. What do such beacons do to trilateration where amplitudes are exact?  0.11 m and 2.9 degrees on
   average, with a spread from world to world of half of that: the paper saw one world.
2. With an error of each amplitude on top, selected (2.75 %) so that calibrated beacons give the
   paper's 0.110 m, does the uncalibrated site give its 0.154 m and 3.5 degrees?  0.158 m and 3.5
   degrees.  But 1.9 degrees are left after the calibration, where the paper has 1.3.
3. How much of the gain does the calibration reach, from four magnetometers at one percent of noise
   about each beacon?  Within 5 mm and 0.1 degrees of beacons that are known exactly.
4. And a maximum-likelihood fix?  It errs by half of what trilateration does with uncalibrated
   beacons, by a quarter to a fifth with calibrated ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from beacon_calibration import PLACES_WORLD, bare_magnetometer
from harness import between_deg, blank_figure, chosen_scale, conclude, save_picture, scenario_parser
from scipy.spatial.transform import Rotation
from tilted_attitude import build

from magfusion.calibration.beacon import REACH, BeaconMeasurements
from magfusion.calibration.beacon_refined import calibrate_one
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, BeaconSigma, MagnetometerSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.papers.p004_fingerprints.direction import attitude_from_vectors
from magfusion.papers.p004_fingerprints.rssi import ranges_from_minor_axis, trilaterate
from magfusion.receiver.ellipse import semi_axes
from magfusion.simulation.field import phasors_world
from magfusion.simulation.log import perturb_site, simulate_fields
from magfusion.simulation.monte_carlo import run_many
from magfusion.units import DEGREE, Array

LOW, HIGH = np.array([0.6, 0.6, 0.5]), np.array([5.1, 3.9, 0.5])  # m; where the targets are
SITES = ("geometric", "calibrated", "true")
METHODS = ("trilateration", "likelihood")
PAPER = {"geometric": (0.154, 3.5), "calibrated": (0.110, 1.3)}  # m, deg
MOMENT = 65.0  # A m^2


@dataclass(frozen=True)
class Config:
    """How far off the beacons are, how well all is measured, how often."""

    targets: int = 200
    worlds: int = 40
    place_sigma: float = 0.03  # m, each axis
    turn_sigma_deg: float = 3.0  # each axis
    noise: float = 3e-10  # T, of each phasor component
    amplitude_error: float = 0.0  # relative, of each beacon at each target
    calibration_noise: float = 0.01  # of the field at the magnetometers about a beacon
    seed: int = 1


def declared_site(config: Config) -> Site:
    """Return the beacons as their geometry gives them, with the sigmas by which they are off."""
    plain = build(MOMENT)
    turn = np.full(3, config.turn_sigma_deg * DEGREE)
    sigma = BeaconSigma(np.full(3, config.place_sigma), turn, np.zeros(2))
    zeros = np.zeros(3)
    exact = MagnetometerSigma(np.zeros((3, 3)), zeros, zeros, zeros)
    sensor = replace(bare_magnetometer(), sigma=exact)
    beacons = tuple(replace(b, sigma=sigma) for b in plain.beacons)
    platform = replace(plain.platform, magnetometer=sensor)
    return replace(plain, beacons=beacons, platform=platform, model_error=0.005)


def calibrated(site: Site, true_site: Site, noise: float, rng: np.random.Generator) -> Site:
    """Return the site after each beacon's calibration by four magnetometers about it."""

    def one(declared: Beacon, true: Beacon) -> Beacon:
        places = declared.position_world + PLACES_WORLD
        exact = phasors_world(true, places)
        size = np.linalg.norm(np.stack([exact.real, exact.imag], axis=-1), axis=-2)
        sigma = noise * size / np.sqrt(3.0)  # of each component, (magnetometers, tones, 2)
        draws = rng.standard_normal((*exact.shape, 2)) * sigma[:, :, None]
        phasor = exact + draws[..., 0] + 1j * draws[..., 1]
        aligned = np.broadcast_to(np.eye(3), (len(places), 3, 3))
        sensor = site.platform.magnetometer
        measured = BeaconMeasurements(declared, sensor, aligned, places, phasor[None], sigma)
        return calibrate_one(measured, REACH)[1].beacon

    pairs = zip(site.beacons, true_site.beacons, strict=True)
    return replace(site, beacons=tuple(one(*pair) for pair in pairs))


def trilaterated(site: Site, samples: FieldSamples) -> tuple[Array, Array]:
    """Return positions (n, 3) from the ranges alone, and the attitudes (n, 3, 3) that fit there."""
    places = np.array([b.position_world for b in site.beacons])
    moment = np.array([np.mean(np.linalg.norm(b.moments_beacon, axis=1)) for b in site.beacons])
    ranges = ranges_from_minor_axis(semi_axes(samples.phasor_sensor)[..., 0], moment)
    position = trilaterate(ranges, places, 0.5 * (LOW + HIGH))
    level = np.broadcast_to(np.eye(3), (len(position), 3, 3))
    known = predict_channels(initial_calibration(site, 0.0), samples.time, level, position)
    unit = np.linalg.norm(known, axis=-1, keepdims=True)
    return position, attitude_from_vectors(samples.phasor_sensor / unit, known / unit)


def run_world(config: Config, rng: np.random.Generator) -> Array:
    """Draw beacons and targets; return errors, shape (sites, methods, targets, 2) (m, deg)."""
    site = declared_site(config)
    true_site = perturb_site(site, rng)
    position = rng.uniform(LOW, HIGH, (config.targets, 3))
    rotated = Rotation.random(config.targets, random_state=rng).as_matrix()
    poses = Trajectory(np.arange(float(config.targets)), rotated, position)
    samples = simulate_fields(true_site, poses, config.noise, rng)
    gain = np.exp(config.amplitude_error * rng.standard_normal(samples.phasor_sensor.shape[:2]))
    samples = replace(samples, phasor_sensor=samples.phasor_sensor * gain[..., None])
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    exact = replace(true_site, beacons=tuple(replace(b, sigma=known) for b in true_site.beacons))
    sites = (site, calibrated(site, true_site, config.calibration_noise, rng), exact)
    return np.stack([_errors(one, config, samples, poses) for one in sites])


def _errors(site: Site, config: Config, samples: FieldSamples, poses: Trajectory) -> Array:
    weighed = replace(site, model_error=max(site.model_error, config.amplitude_error))
    surveyed = any(np.any(b.sigma.position_world > 0.0) for b in site.beacons)
    fixes = fix_epochs(samples, initial_calibration(weighed, 0.0), survey_error=surveyed)
    result = (
        trilaterated(site, samples),
        (fixes.position_world[:, 0], fixes.world_from_body[:, 0]),
    )
    return np.stack(
        [
            np.stack(
                [
                    np.linalg.norm(position - poses.position_world, axis=-1),
                    between_deg(rotated, poses.world_from_body),
                ],
                axis=-1,
            )
            for position, rotated in result
        ]
    )


def run(config: Config, **scale: Any) -> Array:
    """Return the errors of all worlds, shape (worlds, sites, methods, targets, 2) (m, deg)."""
    result = run_many(run_world, [config] * config.worlds, seed=config.seed, **scale)
    return np.stack(result)


def means(errors: Array) -> dict[str, dict[str, list[float]]]:
    """Return mean position (m) and attitude error (deg) and their spread from world to world."""
    each = errors.mean(axis=3)
    return {
        site: {
            method: [*each[:, i, j].mean(axis=0).tolist(), *each[:, i, j].std(axis=0).tolist()]
            for j, method in enumerate(METHODS)
        }
        for i, site in enumerate(SITES)
    }


def taken_off(geometric: Sequence[float], calibrated: Sequence[float]) -> tuple[float, float]:
    """Return by how much calibration lowers errors of position and attitude (per cent)."""
    position, attitude = (100.0 * (1.0 - calibrated[i] / geometric[i]) for i in (0, 1))
    return position, attitude


def report(table: dict[str, dict[str, list[float]]]) -> str:
    """Return one table, and the reduction by calibration with the paper's shares."""
    lines = [f"{'site':<12}" + "".join(f"{m:>36}" for m in METHODS) + f"{'paper':>18}"]
    for site, own in table.items():
        cells = (own[m] for m in METHODS)
        row = "".join(f"{p:11.4f} ±{ps:6.4f} m {a:7.3f} ±{s:5.2f}°" for p, a, ps, s in cells)
        printed = PAPER.get(site)
        lines.append(
            f"{site:<12}{row}" + (f"{printed[0]:9.3f} m{printed[1]:5.1f}°" if printed else "")
        )
    shares = [taken_off(*(table[site][m] for site in SITES[:2])) for m in METHODS]
    cells = "".join(f"{-p:11.1f} %{'':9}{-a:9.1f} %{'':6}" for p, a in shares)
    position, attitude = taken_off(*PAPER.values())
    lines.append(f"{'taken off':<12}{cells}{-position:8.1f} %{-attitude:6.1f} %")
    return "\n".join(lines)


def draw(errors: Array, directory: Path) -> Path:
    """Draw the errors of the first world's targets by trilateration: figures 9 and 10."""
    figure = blank_figure(10.0, 6.0)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, k, label in zip(panels, (0, 1), ("position (m)", "attitude (deg)"), strict=True):
        for i, colour in ((0, "tab:blue"), (1, "tab:red")):
            own = errors[0, i, 0, :, k]
            shown = f"{SITES[i]}, mean {np.mean(own):.3f}; paper {PAPER[SITES[i]][k]:g}"
            axes.plot(own, ".-", color=colour, linewidth=0.5, markersize=3, label=shown)
        axes.set(ylabel=f"error of {label}")
        axes.legend(loc="upper right", fontsize=8)
    panels[1].set(xlabel="target")
    figure.suptitle("Fixes by trilateration with beacons as built and as calibrated, one world")
    path = directory / "calibrated_navigation.png"
    save_picture(figure, path)
    return path


def main() -> None:
    """Print both tables and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, parallel=True)
    parser.add_argument("--worlds", type=int, default=Config.worlds)
    parser.add_argument("--targets", type=int, default=Config.targets)
    parser.add_argument("--amplitude-error", type=float, default=0.0275, help="of the second table")
    options = parser.parse_args()
    config = Config(targets=options.targets, worlds=options.worlds, seed=options.seed)
    figures: dict[str, object] = {"columns": ["position_m", "attitude_deg", "sd_m", "sd_deg"]}
    lines = []
    for error in (0.0, options.amplitude_error):
        errors = run(replace(config, amplitude_error=error), **chosen_scale(options))
        table = figures[f"{error:g}"] = means(errors)
        title = f"mean error of {config.targets} targets ± from world to world"
        lines += [f"\n{title}; amplitudes off by {100.0 * error:g} %", report(table)]
    if options.output is not None:
        lines.append(f"picture in {draw(errors, options.output)}")
    conclude("\n".join(lines), figures)


if __name__ == "__main__":
    main()
