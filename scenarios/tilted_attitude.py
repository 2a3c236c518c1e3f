"""Why paper 004 finds an attitude only where there is none, and what finds it everywhere.

The paper turns the normal of the field's plane into a direction (Eq 7) and takes what it gets in
the sensor's axes for the true direction, rotated (Eq 18).  But Eq 7 knows the beacon's z axis: f
of a rotated normal is not the rotated f of the normal, unless the rotation is about that axis.  The
printed attitudes are all zero, so that the paper could not see it.  The scenario tilts a sensor at
the seven points of the paper's Table 1, gives both methods its true position and no noise at all,
and answers:

1. How wrong is Eq 18, solved as printed (Eq 21 and 23, mean of three angles) and by the nearest
   rotation (SVD, angle of the rotation between estimate and truth)?  Three degrees for the first
   degree of tilt, thirty for ten.
2. How wrong is Wahba's problem over all phasors?  Not at all.
3. And where the position is unknown too, and the phasors carry the noise that the paper states?
   The maximum of the likelihood errs by the same few hundredths of a degree at every tilt.
"""

from dataclasses import dataclass, replace

import numpy as np
from harness import between_deg, conclude, scenario_parser
from scipy.spatial.transform import Rotation
from table1_real_fields import BEACONS_WORLD, FREQUENCIES_HZ, TABLE

from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, BeaconSigma, Coil, Site
from magfusion.model.trajectory import Trajectory
from magfusion.papers.p004_fingerprints.direction import attitude_from_vectors
from magfusion.papers.p004_fingerprints.equations import (
    eq_07_direction,
    eq_21_attitude_as_printed,
    eq_23_angles,
)
from magfusion.receiver.ellipse import plane_normal
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import DEGREE, NANOTESLA, Array, ComplexArray

POINTS_WORLD = TABLE[:, :3]  # m
HEIGHTS = (0.5, 1.5, 3.0)  # m; the first is that of Table 1


@dataclass(frozen=True)
class Config:
    """What is tilted how far, and the noise of the last question."""

    tilts_deg: tuple[float, ...] = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
    random_axes: int = 300
    moment: float = 65.0  # A m^2
    sample_sigma_nt: float = 3.0  # nT, section 3.1
    samples: int = 200  # averaged into a phasor; the paper does not say
    fixes_per_point: int = 30
    seed: int = 1


@dataclass(frozen=True)
class Row:
    """Mean attitude errors at one tilt (deg); a pair is as printed, then the nearest rotation."""

    tilt_deg: float
    about_x: tuple[float, float]
    about_y: tuple[float, float]
    about_z: tuple[float, float]
    about_random: tuple[tuple[float, float], ...]  # at each of HEIGHTS
    wahba_max: float  # no noise, true position; worst of all cases
    likelihood: float  # noise, unknown position


def build(moment: float) -> Site:
    """Return the beacons of the paper, as dipoles that are known exactly, and a bare sensor."""
    plain = demo_site(coil_radius=None)
    coils = (Coil(np.array([moment, 0.0, 0.0])), Coil(np.array([0.0, moment, 0.0]), -np.pi / 2.0))
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    beacons = tuple(
        Beacon(f"M{i + 1}", place, np.eye(3), FREQUENCIES_HZ[i], coils, True, known)
        for i, place in enumerate(BEACONS_WORLD)
    )
    sensor = plain.platform.magnetometer
    # The sensor is the body: the paper knows no other.
    sensor = replace(sensor, body_from_sensor=np.eye(3), position_body=np.zeros(3))
    return Site(plain.gravity, 0.0, beacons, replace(plain.platform, magnetometer=sensor))


def turns(angle: float, axis: Array) -> Array:
    """Return rotations by one angle (rad) about axes (n, 3) of any length."""
    unit = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    return np.asarray(Rotation.from_rotvec(angle * unit).as_matrix())


def observe(
    site: Site, position_world: Array, sensor_from_world: Array, sigma: float, seed: int
) -> FieldSamples:
    """Return the phasors of sensors at positions (n, 3) and attitudes (n, 3, 3)."""
    world_from_body = np.swapaxes(sensor_from_world, -1, -2)
    time = np.arange(float(len(position_world)))
    poses = Trajectory(time, world_from_body, position_world)
    return simulate_fields(site, poses, sigma, np.random.default_rng(seed))


def by_paper(
    phasor_sensor: ComplexArray, position_world: Array, sensor_from_world: Array
) -> tuple[float, float]:
    """Return the mean error of the three printed angles, and of the nearest rotation (deg)."""
    offset = position_world[:, None] - BEACONS_WORLD
    direction_world = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    pseudo = eq_07_direction(plane_normal(phasor_sensor))
    printed = eq_23_angles(eq_21_attitude_as_printed(pseudo, direction_world))
    difference = printed - eq_23_angles(sensor_from_world)
    wrapped = np.angle(np.exp(1j * difference))
    nearest = np.swapaxes(attitude_from_vectors(pseudo, direction_world), -1, -2)
    error_deg = between_deg(nearest, sensor_from_world)
    return float(np.mean(np.abs(wrapped)) / DEGREE), float(np.mean(error_deg))


def by_likelihood(site: Site, config: Config, tilt_deg: float) -> float:
    """Return the mean attitude error of fixes from noisy phasors alone (deg)."""
    position_world = np.repeat(POINTS_WORLD, config.fixes_per_point, axis=0)
    rng = np.random.default_rng(config.seed)
    true = turns(tilt_deg * DEGREE, rng.standard_normal(position_world.shape))
    sigma = config.sample_sigma_nt * NANOTESLA * np.sqrt(2.0 / config.samples)
    samples = observe(site, position_world, true, float(sigma), config.seed + 1)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    result = np.swapaxes(fixes.world_from_body[:, 0], -1, -2)
    return float(np.mean(between_deg(result, true)))


def run(config: Config) -> tuple[Row, ...]:
    """Tilt the sensor by each angle, about each axis."""
    site = build(config.moment)
    return tuple(_row(site, config, tilt_deg) for tilt_deg in config.tilts_deg)


def _row(site: Site, config: Config, tilt_deg: float) -> Row:
    worst: list[float] = []

    def paper(axis: Array, height: float = HEIGHTS[0]) -> tuple[float, float]:
        at_height = np.column_stack([POINTS_WORLD[:, :2], np.full(len(POINTS_WORLD), height)])
        position_world = np.tile(at_height, (len(axis), 1))
        true = np.repeat(turns(tilt_deg * DEGREE, axis), len(at_height), axis=0)
        level = np.broadcast_to(np.eye(3), true.shape)
        in_world = observe(site, position_world, level, 0.0, 0).phasor_sensor
        in_sensor = observe(site, position_world, true, 0.0, 0).phasor_sensor
        exact = np.swapaxes(attitude_from_vectors(in_sensor, in_world), -1, -2)
        worst.append(float(np.max(between_deg(exact, true))))
        return by_paper(in_sensor, position_world, true)

    rng = np.random.default_rng(config.seed)
    x, y, z = np.eye(3)[:, None]
    return Row(
        tilt_deg=tilt_deg,
        about_x=paper(x),
        about_y=paper(y),
        about_z=paper(z),
        about_random=tuple(
            paper(rng.standard_normal((config.random_axes, 3)), height) for height in HEIGHTS
        ),
        wahba_max=max(worst),
        likelihood=by_likelihood(site, config, tilt_deg),
    )


def report(rows: tuple[Row, ...]) -> str:
    """Return the table that a reader sees."""
    axes = ["x", "y", "z", *(f"any, {height:g} m" for height in HEIGHTS)]
    lines = [
        "attitude error (deg): Eq 21 and 23, mean of three angles; nearest rotation",
        f"{'tilt':>6}" + "".join(f"{a:>14}" for a in axes) + f"{'all phasors':>14}{'a fix':>8}",
    ]
    for row in rows:
        pairs = (row.about_x, row.about_y, row.about_z, *row.about_random)
        cells = "".join(f"{p[0]:7.1f};{p[1]:6.1f}" for p in pairs)
        lines.append(f"{row.tilt_deg:6g}{cells}{row.wahba_max:14.0e}{row.likelihood:8.3f}")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, output=None).parse_args()
    rows = run(Config(seed=given.seed))
    conclude(report(rows), {"rows": rows})


if __name__ == "__main__":
    main()
