"""A tracker from its bench to its fixes: what the calibration reports, and the errors of fixes.

Files of a bench are made by code that shares nothing with the estimators: every turn of three
windings by elliptic integrals, receiving coils by the mean over their discs, a probe of three axes
at six points about the source, and a robot's list of poses with its errors.  The site's owner knows
the windings, but neither the coils' tilts, offsets and gains nor how the receiver is mounted
exactly.  `magfusion calibrate antenna` makes a site of the files; `magfusion fix` locates a log of
other poses with it, whose truth is exact.

The rule, made before any run: of attitude and of position, what the calibration reports as
``after`` is within 20 % of what `fix` errs by on the other poses, RMS over all seeds; and no seed
is off by more than a third, which is three sigmas of the chance of so few poses.
"""

import csv
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation
from tracker_coils import CURRENT, FORMERS, LAYERS, ROWS, WIRE, loop_field

from magfusion.files.plain_table import POSITION, QUATERNION
from magfusion.jobs.calibrate_antenna import AntennaSettings, run_calibrate_antenna
from magfusion.jobs.fix import FixSettings, run
from magfusion.units import DEGREE, Array

CARRIERS_HZ = (5000.0, 6000.0, 7000.0)
WITHIN, SEED_WITHIN = 0.2, 1.0 / 3.0
DISC = 6  # points on each of two rings of a receiving coil's disc
Table = dict[str, Array | Sequence[object]]


@dataclass(frozen=True)
class Config:
    """One tracker and its bench; errors are standard deviations.

    Parameters
    ----------
    size : float
        Of the formers of the windings, by those of `tracker_coils`.
    gain, tilt_deg, centre
        Of each coil of both antennas (relative, deg about each of two axes, m).
    receiver_radius : float
        Of its coils (m).
    noise : float
        Of a phasor's component (T).
    pose_deg, pose_m
        Of the robot's list, each axis.
    probe_distance, probe_m, probe_deg, probe_noise
        Of the probe's points, of their places (m), of its axes (deg), of a reading (T).
    mounting_deg, mounting_m
        By which the receiver is mounted otherwise than declared, each axis.
    """

    poses: int = 60
    others: int = 200
    size: float = 1.0
    gain: float = 0.01
    tilt_deg: float = 0.4
    centre: float = 1e-3
    receiver_radius: float = 0.008
    nearest: float = 0.28
    farthest: float = 0.55
    noise: float = 0.3e-9
    pose_deg: float = 0.05
    pose_m: float = 0.2e-3
    probe_distance: float = 0.2
    probe_m: float = 50e-6
    probe_deg: float = 0.02
    probe_noise: float = 1e-9
    mounting_deg: float = 0.0
    mounting_m: float = 0.0
    options: tuple[str, ...] = ()
    seed: int = 0


@dataclass(frozen=True)
class Coils:
    """Three coils: how each is turned, where it is (m), and its gain."""

    turn: Rotation
    centre: Array
    gain: Array


@dataclass(frozen=True)
class BenchOutcome:
    """What was reported and what was found (deg, m)."""

    seed: int
    before: tuple[float, float]
    reported: tuple[float, float]
    estimate: tuple[float, float]


def drawn(config: Config, rng: np.random.Generator) -> Coils:
    """Return coils along x, y and z with their errors; each is a coil about its own z."""
    along = Rotation.from_matrix([np.roll(np.eye(3), k + 1, axis=0) for k in range(3)])
    tilt = Rotation.from_rotvec(config.tilt_deg * DEGREE * rng.standard_normal((3, 3)))
    centre = config.centre * rng.standard_normal((3, 3))
    return Coils(tilt * along, centre, 1.0 + config.gain * rng.standard_normal(3))


def source_field(coils: Coils, size: float, place: Array) -> Array:
    """Return the field (coils, n, 3) (T) of every turn of each winding at places (n, 3) (m)."""
    out = []
    for k, former in enumerate(FORMERS):
        own = coils.turn[k].inv().apply(place - coils.centre[k])
        field = np.zeros_like(own)
        for layer in range(LAYERS):
            for row in range(ROWS):
                turn = own - [0.0, 0.0, (row - 0.5 * (ROWS - 1)) * WIRE]
                field += loop_field(size * former + (layer + 0.5) * WIRE, turn)
        out.append(CURRENT * coils.gain[k] * coils.turn[k].apply(field))
    return np.array(out)


def sensed(config: Config, source: Coils, receiver: Coils, turn: Rotation, place: Array) -> Array:
    """Return mean fields (n, transmitting, receiving) (T) at poses of the sensor in the source."""
    angle = 2.0 * np.pi * np.arange(DISC) / DISC
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(DISC)], axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(2)  # in the square of the radius
    rings = [config.receiver_radius * np.sqrt(0.5 * (s + 1.0)) * circle for s in nodes]
    out = np.zeros((len(place), 3, 3))
    for i in range(3):
        axis_source = turn.apply(receiver.turn[i].apply([0.0, 0.0, 1.0]))
        for ring, weight in zip(rings, weights, strict=True):
            for point in receiver.turn[i].apply(ring) + receiver.centre[i]:
                field = source_field(source, config.size, place + turn.apply(point))
                flux = np.sum(field * axis_source, axis=2)
                out[:, :, i] += 0.5 * weight / DISC * receiver.gain[i] * flux.T
    return out


def site_text(config: Config) -> str:
    """Return the site as its owner writes it, of the drawing alone."""
    coils = "".join(
        f"""
      - frequency_hz: {CARRIERS_HZ[k]}
        winding: {{axis: {np.eye(3)[k].tolist()}, current_a: {CURRENT}, layers: {LAYERS},
                  rows: {ROWS}, inner_radius_m: {config.size * former}, wire_m: {WIRE}}}"""
        for k, former in enumerate(FORMERS)
    )
    return f"""magfusion_site: 1
world: {{model_error: 0.001}}
beacons:
  - name: T
    position_m: [0, 0, 0]
    rpy_deg: [0, 0, 0]
    frequency_hz: {CARRIERS_HZ[0]}
    coils:{coils}
region:
  half_space: {{normal: [1, 0, 0]}}
platform:
  magnetometer:
    body_from_sensor: {{position_m: [0.02, 0.01, 0.03], rpy_deg: [10, 20, -30]}}
    coil_kappa_m2: {config.receiver_radius**2 / 8.0}
    noise_density_t_rthz: 1.0e-10
"""


class World:
    """A tracker as it was made, which its bench and its log are read of."""

    def __init__(self, config: Config) -> None:
        self.config, self.rng = config, np.random.default_rng(config.seed)
        self.source, self.receiver = drawn(config, self.rng), drawn(config, self.rng)
        off = config.mounting_deg * DEGREE * self.rng.standard_normal(3)
        declared = Rotation.from_euler("xyz", [10.0, 20.0, -30.0], degrees=True)
        self.mounting = Rotation.from_rotvec(off) * declared
        arm = config.mounting_m * self.rng.standard_normal(3)
        self.arm = np.array([0.02, 0.01, 0.03]) + arm

    def poses(self, number: int) -> tuple[Rotation, Array]:
        """Return poses of the body before the source."""
        toward = self.rng.standard_normal((number, 3))
        toward[:, 0] = np.abs(toward[:, 0]) + 0.3
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        reach = self.rng.uniform(self.config.nearest, self.config.farthest, (number, 1))
        return Rotation.random(number, rng=self.rng), reach * toward

    def phasors(self, turn: Rotation, place: Array) -> Array:
        """Return what the receiver measures at poses of the body (n, tones, axes) (T)."""
        spot = place + turn.apply(self.arm)
        clean = sensed(self.config, self.source, self.receiver, turn * self.mounting, spot)
        return clean + self.config.noise * self.rng.standard_normal(clean.shape)

    def probe(self) -> Table:
        """Return what a probe of three axes reads at six points about each coil."""
        config, rng = self.config, self.rng
        points = config.probe_distance * np.concatenate([np.eye(3), -np.eye(3)])
        coil, point = (part.ravel() for part in np.meshgrid(np.arange(3), np.arange(6)))
        place = points[point] + config.probe_m * rng.standard_normal((len(coil), 3))
        field = source_field(self.source, config.size, place)[coil, np.arange(len(coil))]
        tilt = Rotation.from_rotvec(config.probe_deg * DEGREE * rng.standard_normal(field.shape))
        field = tilt.apply(field) + config.probe_noise * rng.standard_normal(field.shape)
        return (
            {"coil": coil}
            | dict(zip(POSITION, points[point].T, strict=True))
            | dict(zip(("field_x", "field_y", "field_z"), field.T, strict=True))
            | {"sigma": np.full(len(coil), config.probe_noise)}
        )

    def survey(self) -> tuple[Table, Table]:
        """Return phasors at a robot's poses, and its list of them."""
        turn, place = self.poses(self.config.poses)
        phasor = self.phasors(turn, place)
        off = self.config.pose_deg * DEGREE * self.rng.standard_normal(place.shape)
        reported = (turn * Rotation.from_rotvec(off)).as_quat(scalar_first=True)
        moved = place + self.config.pose_m * self.rng.standard_normal(place.shape)
        listed = {"point": np.arange(len(place))} | dict(zip(POSITION, moved.T, strict=True))
        read = {"point": np.repeat(np.arange(len(place)), 3)} | self._columns(phasor)
        return read, listed | dict(zip(QUATERNION, reported.T, strict=True))

    def _columns(self, phasor: Array) -> Table:
        flat = phasor.reshape(-1, 3)
        none = np.zeros(len(flat))
        return (
            {"beacon": ["T"] * len(flat), "tone": np.tile(np.arange(3), len(phasor))}
            | dict(zip(("re_x", "re_y", "re_z"), flat.T, strict=True))
            | {"im_x": none, "im_y": none, "im_z": none}
            | {"sigma": np.full(len(flat), self.config.noise)}
        )

    def write_log(self, path: Path) -> None:
        """Write phasors at other poses as a log with its truth."""
        turn, place = self.poses(self.config.others)
        stamp = 100_000_000 * np.arange(len(place))
        path.mkdir()
        (path / "log.yaml").write_text(
            "magfusion_log: 1\nname: others\nepoch_ns: 0\nsource: bench\n"
        )
        fields: Table = {"time_ns": np.repeat(stamp, 3)} | self._columns(self.phasors(turn, place))
        write_csv(path / "fields.csv", fields | {"window": np.full(3 * len(place), 0.1)})
        truth = {"time_ns": stamp} | dict(zip(POSITION, place.T, strict=True))
        quaternion = turn.as_quat(scalar_first=True)
        write_csv(path / "truth.csv", truth | dict(zip(QUATERNION, quaternion.T, strict=True)))


def write_csv(path: Path, table: Mapping[str, Array | Sequence[object]]) -> None:
    """Write columns of one length."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        columns = [c.tolist() if isinstance(c, np.ndarray) else c for c in table.values()]
        writer.writerows(zip(*columns, strict=True))


def write_bench(config: Config, directory: Path) -> None:
    """Write the files of a bench, the site of the drawing, and a log of other poses."""
    world = World(config)
    (directory / "site.yaml").write_text(site_text(config))
    write_csv(directory / "probe.csv", world.probe())
    read, listed = world.survey()
    write_csv(directory / "readings.csv", read)
    write_csv(directory / "robot.csv", listed)
    world.write_log(directory / "others")


def run_seed(config: Config) -> BenchOutcome:
    """Calibrate one tracker by its bench, and fix a log with the site that was written."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        write_bench(config, path)
        settings = AntennaSettings(
            survey=path / "readings.csv",
            site=path / "site.yaml",
            poses=path / "robot.csv",
            probe=(path / "probe.csv",) if "no probe" not in config.options else (),
            pose_rotation_deg=config.pose_deg,
            pose_position_m=config.pose_m,
            probe_position_m=config.probe_m,
            probe_tilt_deg=config.probe_deg,
            sizes="sizes" in config.options,
            boresight="boresight" in config.options,
        )
        run_calibrate_antenna(settings, path / "antenna")
        reported = json.loads((path / "antenna" / "report.json").read_text())
        run(FixSettings(log=path / "others", site=path / "antenna" / "site.yaml"), path / "fixes")
        fixed = json.loads((path / "fixes" / "report.json").read_text())
        before, after = (
            (reported[f"attitude_deg_{when}"], reported[f"position_m_{when}"])
            for when in ("before", "after")
        )
        result = fixed["attitude_rmse_deg"], fixed["ate_m"]
        return BenchOutcome(config.seed, before, after, result)


def ratios(outcomes: list[BenchOutcome]) -> Array:
    """Return reported over found, of all seeds together, of attitude and position."""
    reported, result = ([getattr(o, name) for o in outcomes] for name in ("reported", "estimate"))
    return np.array([rms(np.array(reported)[:, k]) / rms(np.array(result)[:, k]) for k in range(2)])


def passes_check(outcomes: list[BenchOutcome]) -> bool:
    """Return whether the rule is met."""
    each = np.array([np.divide(o.reported, o.estimate) for o in outcomes])
    whole = np.abs(np.log(ratios(outcomes))) < np.log1p(WITHIN)
    return bool(np.all(whole) and np.all(np.abs(np.log(each)) < np.log1p(SEED_WITHIN)))


def report(name: str, outcomes: list[BenchOutcome]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"{name}: the drawing's site -> reported after / found by fix elsewhere",
        *(
            f"seed {o.seed}: {o.before[0]:.3f} -> {o.reported[0]:.4f} / {o.estimate[0]:.4f} deg,"
            f" {1e3 * o.before[1]:.2f} -> {1e3 * o.reported[1]:.3f} / {1e3 * o.estimate[1]:.3f} mm"
            for o in outcomes
        ),
    ]
    attitude, position = ratios(outcomes)
    verdict = "holds" if passes_check(outcomes) else "does NOT hold"
    return "\n".join(
        [*lines, f"reported / found: {attitude:.3f} and {position:.3f}; the rule {verdict}"]
    )


KINDS = {
    "probe and robot": Config(),
    "robot alone, sizes sought": Config(options=("no probe", "sizes")),
    "receiver mounted anyhow": Config(
        mounting_deg=15.0, mounting_m=0.02, options=("boresight",), poses=80
    ),
    "coils of 10 cm": Config(size=2.0),
    "a poor turntable": Config(pose_deg=0.2, pose_m=1e-3, poses=100),
}


def main() -> None:
    """Print the tables and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, "one tracker of each kind", output=None)
    parser.add_argument("--seeds", type=int, default=6)
    given = parser.parse_args()
    result = {}
    for name, config in KINDS.items():
        count = 1 if given.quick else given.seeds
        seeds = range(given.seed, given.seed + count)
        result[name] = [run_seed(Config(**vars(config) | {"seed": k})) for k in seeds]
    text = "\n".join(report(name, outcomes) for name, outcomes in result.items())
    conclude(text, {name: list(ratios(outcomes)) for name, outcomes in result.items()})


if __name__ == "__main__":
    main()
