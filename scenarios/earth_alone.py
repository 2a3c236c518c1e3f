"""Orientation without beacons, beside VQF: gyroscope, gravity and the Earth's field.

VQF (D. Laidig, T. Seel, Information Fusion 91, 2023) is what orientation filters are measured by.
Both have the same samples: real ones (BROAD, where they are at hand), and simulated ones of turning
by hand, in which a magnet is attached to the sensor, or a part of the time is spent beside iron.
VQF knows no Earth field but its direction, and no calibration; what the site declares is its offset
here, zero.  Errors are root mean squares against the truth, in its own frame.

The answer: in the mean better than VQF, online and offline, by half where a magnet is attached;
online not on every log: where nothing is disturbed, to leave the offset open costs heading.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.orientation.smoother import oriented
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import (
    EarthModel,
    ImuModel,
    Magnetometer,
    MagnetometerSigma,
    Platform,
    Site,
)
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.units import DEGREE, Array

LOGS = Path(__file__).parents[2] / "shared" / "logs"
EARTH_WORLD = np.array([0.0, 1.64e-5, -4.14e-5])  # T
RATE = 200.0  # Hz
REST = 8.0  # s
KINDS = ("nothing", "attached magnet", "iron for a while", "fast translation")


@dataclass(frozen=True)
class Row:
    """Errors of one way on one log (deg)."""

    log: str
    way: str
    heading_deg: float
    tilt_deg: float


def site_of(rng: np.random.Generator) -> tuple[Site, Array]:
    """Return a site as declared, and the magnetometer's true offset (T)."""
    sigma = MagnetometerSigma(np.full((3, 3), 0.01), np.full(3, 1e-6), np.zeros(3), np.zeros(3))
    sensor = Magnetometer(
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        noise_density=2e-8,
        matrix=np.eye(3),
        offset=np.zeros(3),
        sigma=sigma,
    )
    imu = ImuModel(5e-4, 5e-3, 1e-5, 1e-4, 1e-2, 0.05)
    site = Site(
        gravity=9.8,
        model_error=0.005,
        beacons=(),
        platform=Platform(imu, sensor),
        earth_field_world=EARTH_WORLD,
        earth=EarthModel(),
    )
    return site, 1e-6 * rng.normal(size=3)


def _smooth_noise(rng: np.random.Generator, time: Array, hertz: float) -> Array:
    """Return a band-limited motion of unit variance, shape (n, 3)."""
    out = np.zeros((len(time), 3))
    for frequency in hertz * rng.uniform(0.3, 1.0, size=12):
        phase = rng.uniform(0.0, 2.0 * np.pi, size=3)
        out += rng.normal(size=3) * np.sin(2.0 * np.pi * frequency * time[:, None] + phase)
    return out / np.sqrt(6.0)


def simulated(kind: str, seed: int, duration: float = 60.0, rate: float = RATE) -> tuple[Log, Site]:
    """Return a log of turning by hand, and its site."""
    rng = np.random.default_rng(seed)
    site, offset = site_of(rng)
    time = np.arange(0.0, duration, 1.0 / rate)
    begun = np.clip((time - REST) / 2.0, 0.0, 1.0)[:, None]
    spin = 1.5 * _smooth_noise(rng, time, 0.5) * begun  # rad/s
    steps = Rotation.from_rotvec(spin[1:] / rate)
    attitude = [Rotation.from_euler("z", rng.uniform(-3.0, 3.0))]
    for step in steps:
        attitude.append(attitude[-1] * step)
    truth = Rotation.concatenate(attitude)
    far = 0.4 if kind == "fast translation" else 0.1  # m
    place = far * _smooth_noise(rng, time, 0.8) * begun**2
    push = np.gradient(np.gradient(place, time, axis=0), time, axis=0)
    force = truth.inv().apply(push + np.array([0.0, 0.0, 9.8]))
    gyro = np.concatenate([spin[:1], spin[1:]]) + 3e-3 * rng.normal(size=3)
    gyro = gyro @ (np.eye(3) + 1e-3 * rng.normal(size=(3, 3))).T
    imu = site.platform.imu
    gyro += imu.gyro_noise * np.sqrt(rate / 2.0) * rng.normal(size=gyro.shape)
    force += 0.03 * rng.normal(size=3)
    force += imu.accel_noise * np.sqrt(rate / 2.0) * rng.normal(size=force.shape)
    world = np.tile(EARTH_WORLD, (len(time), 1))
    body = np.tile(offset, (len(time), 1))
    if kind == "attached magnet":
        body[time > 0.4 * duration] += 12e-6 * rng.normal(size=3)
    if kind == "iron for a while":
        near = (time > 0.4 * duration) & (time < 0.7 * duration)
        world[near] += 5e-6 * rng.normal(size=3) + 1e-6 * _smooth_noise(rng, time, 0.5)[near]
    field = truth.inv().apply(world) + body + 3e-7 * rng.normal(size=(len(time), 3))
    poses = Trajectory(time, truth.as_matrix(), place)
    streams = ImuSamples(time, gyro, force), Waveform(time, field)
    return Log(f"{kind} {seed}", 0, "simulated", *streams, truth=poses), site


def errors(time: Array, attitude: Array, truth: Trajectory) -> tuple[float, float]:
    """Return heading and tilt error (deg, rms)."""
    known, exists = interpolate(truth, time, 0.1)
    off = Rotation.from_matrix(attitude[exists] @ np.swapaxes(known.world_from_body, 1, 2))
    x, y, z, w = off.as_quat().T
    head = 2.0 * np.arctan(z / w)
    tilt = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
    return rms(head) / DEGREE, rms(tilt) / DEGREE


def vqf(log: Log, site: Site, *, back: bool) -> Array:
    """Return the attitudes of VQF at the inertial samples, north turned to the declared field's."""
    from vqf import VQF, offlineVQF

    imu, wave = log.imu, log.waveform
    assert wave is not None
    assert site.earth_field_world is not None
    field = np.stack([np.interp(imu.time, wave.time, c) for c in wave.measured_sensor.T], axis=1)
    step = float(np.median(np.diff(imu.time)))
    streams = [np.ascontiguousarray(s, dtype=float) for s in (imu.gyro_body, imu.accel_body, field)]
    out = offlineVQF(*streams, step) if back else VQF(step).updateBatch(*streams)
    east, north = site.earth_field_world[:2]
    turn = Rotation.from_euler("z", -np.arctan2(east, north))
    return (turn * Rotation.from_quat(out["quat9D"], scalar_first=True)).as_matrix()


def rows_of(log: Log, site: Site) -> Iterator[Row]:
    """Yield the errors of both, online and offline."""
    assert log.truth is not None
    for way, back in (("online", False), ("offline", True)):
        found = oriented(log, site, back=back)
        yield Row(log.name, way, *errors(found.time, found.world_from_body, log.truth))
        yield Row(
            log.name, f"VQF {way}", *errors(log.imu.time, vqf(log, site, back=back), log.truth)
        )


def main() -> None:
    """Print the table, and one object with all of it."""
    parser = scenario_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="simulated logs of each kind")
    parser.add_argument("--logs", type=Path, default=LOGS, help="directory of logs earth_*")
    arguments = parser.parse_args()
    cases = [simulated(kind, seed) for kind in KINDS for seed in range(arguments.seeds)]
    for path in sorted(arguments.logs.glob("earth_*")):
        cases.append((open_log(path), load_site(path / "site.yaml", without=True)))
    rows = []
    for log, site in cases:
        for row in rows_of(log, site):
            rows.append(row)
            errors_text = f"heading {row.heading_deg:6.2f} tilt {row.tilt_deg:5.2f}"
            print(f"{row.log:28} {row.way:12} {errors_text}")
    means: dict[str, dict[str, float]] = {}
    for way in dict.fromkeys(row.way for row in rows):
        own = [r for r in rows if r.way == way]
        means[way] = {
            "heading_deg": float(np.mean([r.heading_deg for r in own])),
            "tilt_deg": float(np.mean([r.tilt_deg for r in own])),
        }
    lines = [
        f"{'mean':28} {way:12} heading {mean['heading_deg']:6.2f} tilt {mean['tilt_deg']:5.2f}"
        for way, mean in means.items()
    ]
    conclude("\n".join(lines), {"rows": rows, "means": means})


if __name__ == "__main__":
    main()
