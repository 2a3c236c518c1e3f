"""What one epoch of a rotating beacon determines exactly, and how many poses remain.

The corrected equations of paper 004 hold to rounding: the direction survives its normal (Eq 5-7),
and the ellipse's axes are those of theory, the minor one the same in all directions.  What the
paper does not state is how many poses explain the same field: two for one beacon and a known
attitude, four where the attitude is unknown, one for three beacons, and again two for three
beacons of unknown polarity, the second in the mirror of their plane and turned by half a turn.
Near the beacon's plane Eq 7 loses the direction, the completed tensor does not: at 80 degrees from
the axis the mean square errors differ by a factor of 85.
"""

from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, scenario_parser
from scipy.spatial.transform import Rotation
from tensor_fix import locate_by_tensor

from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.field import predict
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.papers.p004_fingerprints.equations import eq_05_normal, eq_07_direction
from magfusion.receiver.ellipse import plane_normal, rms_amplitude, semi_axes
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives
from magfusion.simulation.log import simulate_fields
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

PLACES = np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.0], [1.0, 3.0, 0.0]])  # m, all in one plane
SIGMA = 3e-10  # T, of a phasor's component
AS_LIKELY = 9.0  # chi square by which a rival may be worse and still explain the epoch


@dataclass(frozen=True)
class Config:
    """Sizes of the run."""

    directions: int = 10_000
    epochs: int = 150
    noisy_fixes: int = 40_000
    seed: int = 5


def one_beacon() -> Site:
    """Return a site with one level two-axis beacon at the origin, a dipole known exactly."""
    site = demo_site(coil_radius=None)
    beacon = replace(site.beacons[0], position_world=np.zeros(3), world_from_beacon=np.eye(3))
    sensor = replace(
        site.platform.magnetometer,
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        matrix=np.eye(3),
    )
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, beacons=(beacon,), platform=platform, model_error=0.0)


def phasors_at(site: Site, position_world: Array) -> ComplexArray:
    """Return the phasors of the first beacon at positions (n, 3), level sensor, (n, 3)."""
    level = np.broadcast_to(np.eye(3), (len(position_world), 3, 3))
    seen = predict(site.beacons[0], site.platform.magnetometer, level, position_world)
    return np.asarray(seen[:, 0])


def exactness(config: Config) -> dict[str, float]:
    """Return the largest errors of the closed forms without noise (B1, B2)."""
    rng = np.random.default_rng(config.seed)
    direction = rng.standard_normal((config.directions, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    again = eq_07_direction(eq_05_normal(direction))
    site = one_beacon()
    beacon = site.beacons[0]
    distance = rng.uniform(1.0, 6.0, (config.directions, 1))
    phasor = phasors_at(site, direction * distance)
    seen = eq_07_direction(plane_normal(phasor))
    moment = float(np.linalg.norm(beacon.moments_beacon[0]))
    scale = MU0_OVER_4PI * moment / distance[:, 0] ** 3
    sine_square = 1.0 - direction[:, 2] ** 2
    expected = {
        "minor": np.ones(config.directions),
        "major": np.sqrt(1.0 + 3.0 * sine_square),
        "rms": np.sqrt((2.0 + 3.0 * sine_square) / 2.0),
    }
    axes = semi_axes(phasor)
    result = {"minor": axes[..., 0], "major": axes[..., 1], "rms": rms_amplitude(phasor)}
    errors = {
        f"{k}_axis_error": float(np.max(np.abs(result[k] / scale / expected[k] - 1.0)))
        for k in expected
    }
    return {
        "direction_error": float(np.max(np.abs(again - direction))),
        "direction_from_phasors_error": float(np.max(np.abs(seen - direction))),
    } | errors


def solutions(config: Config, beacons: int, *, attitude: bool, synchronised: bool) -> float:
    """Return the mean number of poses that explain an epoch (B3)."""
    site = demo_site(coil_radius=None, synchronised=synchronised)
    level = tuple(
        replace(b, position_world=place, world_from_beacon=np.eye(3))
        for b, place in zip(site.beacons, PLACES[:beacons], strict=False)
    )
    site = replace(site, beacons=level, model_error=0.0)
    rng = np.random.default_rng(config.seed)
    truth = Trajectory(
        np.arange(float(config.epochs)),
        Rotation.random(config.epochs, random_state=config.seed).as_matrix(),
        rng.uniform(*DEMO_BOX_WORLD, (config.epochs, 3)),
    )
    # All drives share a clock whose polarity is unknown: half a turn, or none.
    common = np.pi * float(not synchronised)
    drives = Drives(np.full(len(level), common), np.zeros(len(level)))
    samples = simulate_fields(site, truth, SIGMA, rng, drives)
    prior = None
    if attitude:
        cov = np.diag([1e-6] * 3 + [1e4] * 3)
        prior = replace(truth, pose_cov=np.broadcast_to(cov, (config.epochs, 6, 6)).copy())
    fixes = fix_epochs(samples, initial_calibration(site, 0.0), prior=prior, survey_error=False)
    remaining = fixes.cost - fixes.cost[:, :1] < AS_LIKELY
    return float(np.mean(np.sum(remaining, axis=1)))


def coefficients(config: Config, polar_deg: float = 80.0) -> dict[str, float]:
    """Return the mean square direction errors by ``(sigma r^3 / K m)^2`` (B6)."""
    site = one_beacon()
    beacon = site.beacons[0]
    polar, distance = np.deg2rad(polar_deg), 4.0
    direction = np.array([np.sin(polar), 0.0, np.cos(polar)])
    clean = phasors_at(site, distance * direction[None])
    moment = float(np.linalg.norm(beacon.moments_beacon[0]))
    unit = 1e-4  # noise over K m / r^3: small enough for the law to be linear
    rng = np.random.default_rng(config.seed)
    noise = rng.standard_normal((2, config.noisy_fixes, 3))
    sigma = unit * MU0_OVER_4PI * moment / distance**3
    noisy = clean + sigma * (noise[0] + 1j * noise[1])
    by_tensor = locate_by_tensor(beacon, noisy[:, None]).direction_beacon
    by_normal = eq_07_direction(plane_normal(noisy))
    squares = {
        name: np.sum((result - direction) ** 2, axis=1)
        for name, result in (("tensor", by_tensor), ("eq_7", by_normal))
    }
    return {f"coefficient_{name}": float(np.mean(s) / unit**2) for name, s in squares.items()}


def run(config: Config) -> dict[str, float]:
    """Return all figures."""
    counts = {
        "solutions_1_beacon_attitude_known": solutions(config, 1, attitude=True, synchronised=True),
        "solutions_1_beacon": solutions(config, 1, attitude=False, synchronised=True),
        "solutions_3_beacons": solutions(config, 3, attitude=False, synchronised=True),
        "solutions_3_beacons_polarity_unknown": solutions(
            config, 3, attitude=False, synchronised=False
        ),
    }
    return exactness(config) | counts | coefficients(config)


def report(figures: dict[str, float]) -> str:
    """Return the table that a reader sees."""
    expected = {
        "solutions_1_beacon_attitude_known": "2",
        "solutions_1_beacon": "4",
        "solutions_3_beacons": "1",
        "solutions_3_beacons_polarity_unknown": "2",
        "coefficient_tensor": "",
        "coefficient_eq_7": "",
    }
    lines = [f"{'':<40}{'found':>12}{'expected':>12}"]
    for name, value in figures.items():
        lines.append(f"{name.replace('_', ' '):<40}{value:12.3g}{expected.get(name, '0'):>12}")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, output=None).parse_args()
    figures = run(Config(seed=given.seed))
    conclude(report(figures), figures)


if __name__ == "__main__":
    main()
