"""Orientation without beacons by drawn twins of a motion-capture recording, compared with VQF.

RepoIMU (A. Szczesna et al., ICCVG 2016) and its like: a consumer IMU on a stick or a rig that a
hand turns and swings for a minute or three, with an optical reference, at 100 to 200 Hz; a
calibrated magnetometer indoors, and now and then something magnetic near it.  Each seed draws the
instrument (by its data sheet, as a user declares it), its errors (from a fifth of the declared ones
to all of them), the motion and what is near.  What VQF is not made for is left out: true biases
are at most those that its constants are for (0.5 deg/s of a gyroscope, 5 mg of an accelerometer).
VQF has its own constants, and the sampling time.

Errors are root mean squares over the whole log, its first seconds too: total, of the heading and
of the inclination, as in VQF's paper.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from earth_alone import errors, heading_nees, vqf
from earth_worlds import Kind, simulated_kind
from harness import conclude, scenario_parser

from magfusion.estimation.orientation.smoother import Oriented, oriented
from magfusion.files.instruments import named_imu
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.units import DEGREE

IMUS = ("MTi-3", "MTi-300", "BMI270", "ICM-42688-P", "LSM6DSO", "BMI160", "MPU-9250")
GYRO_BIAS, ACCEL_BIAS = 0.5 * DEGREE, 0.05  # rad/s, m/s^2; usual ones of what is calibrated
REACH = 0.3  # m; of a hand, usual (each component): well inside of the iron of the building


@dataclass(frozen=True)
class Comparison:
    """Errors on one log (deg), and the squared ones by the claimed variance."""

    log: str
    way: str
    total_deg: float
    heading_deg: float
    tilt_deg: float
    vqf_total_deg: float
    vqf_heading_deg: float
    vqf_tilt_deg: float
    heading_nees: float
    tilt_nees: float

    @property
    def ratio(self) -> float:
        """Total error by that of VQF."""
        return self.total_deg / self.vqf_total_deg


def twin(seed: int) -> tuple[Log, Site]:
    """Return a drawn log, and the site as its user declares it."""
    rng = np.random.default_rng([seed, *b"twin"])
    imu = named_imu(str(rng.choice(IMUS))).model
    usual = replace(
        imu,
        gyro_bias_sigma=min(imu.gyro_bias_sigma, GYRO_BIAS),
        accel_bias_sigma=min(imu.accel_bias_sigma, ACCEL_BIAS),
    )

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    motion = rng.choice(["turned", "swung", "both"])
    one_axis = np.roll([1.0, 0.1, 0.1], rng.integers(3)) if rng.random() < 1 / 3 else np.ones(3)
    hertz = between(0.3, 1.2)
    within_reach = REACH * (2.0 * np.pi * hertz) ** 2
    shaking = between(0.2, 1.0) if motion == "turned" else between(1.0, 8.0)
    kind = Kind(
        turning=0.0 if motion == "swung" else between(0.4, 4.0),
        wobble=between(0.03, 0.2) if motion == "swung" else 0.0,
        shaking=min(shaking, within_reach),
        hertz=hertz,
        pauses=bool(rng.random() < 0.5),
        rest=rng.uniform(0.5, 5.0),
        iron=(1.5, 4.0),
        axes=(float(one_axis[0]), float(one_axis[1]), float(one_axis[2])),
        visits=int(rng.integers(4)),
        repeated=0.0,
        imu=imu,
        imu_errors=usual,
    )
    duration, rate = rng.uniform(60.0, 180.0), float(rng.choice([100.0, 128.0, 200.0]))
    return simulated_kind(kind, rng, duration, rate, between(0.2, 1.0), f"{motion} {seed}")


def tilt_nees(result: Oriented, truth: Trajectory) -> float:
    """Return the mean squared error of the inclination by its claimed variance, per component."""
    known, exists = interpolate(truth, result.ends, 0.1)
    states = [s for s, there in zip(result.states, exists, strict=True) if there]
    ratios = []
    for state, true in zip(states, known.world_from_body, strict=True):
        off = (state.world_from_body @ true.T)[:, 2]
        part = np.array([-off[1], off[0]])
        ratios.append(part @ np.linalg.solve(state.cov[:2, :2], part) / 2.0)
    return float(np.mean(ratios))


def compared(log: Log, site: Site) -> Iterator[Comparison]:
    """Yield the errors of both, online and offline."""
    assert log.truth is not None
    for way, back in (("online", False), ("offline", True)):
        result = oriented(log, site, back=back)
        own = errors(result.time, result.world_from_body, log.truth)[::2]
        other = errors(log.imu.time, vqf(log, site, back=back), log.truth)[::2]
        yield Comparison(
            log.name,
            way,
            float(np.hypot(*own)),
            *own,
            float(np.hypot(*other)),
            *other,
            heading_nees(result, log.truth),
            tilt_nees(result, log.truth),
        )


def main() -> None:
    """Print the table, medians and means, and one object with all of it."""
    parser = scenario_parser(__doc__, seed=0, output=None)
    parser.add_argument("--twins", type=int, default=20, help="logs, of seeds from --seed on")
    arguments = parser.parse_args()
    rows = []
    print(f"{'':14} {'':8} {'total, heading, tilt':>20}  {'VQF':>20}  ratio  nees: heading, tilt")
    for seed in range(arguments.seed, arguments.seed + arguments.twins):
        for row in compared(*twin(seed)):
            rows.append(row)
            own = f"{row.total_deg:6.2f} {row.heading_deg:6.2f} {row.tilt_deg:6.2f}"
            other = f"{row.vqf_total_deg:6.2f} {row.vqf_heading_deg:6.2f} {row.vqf_tilt_deg:6.2f}"
            nees = f"{row.heading_nees:5.2f} {row.tilt_nees:5.2f}"
            print(f"{row.log:14} {row.way:8} {own}  {other}  {row.ratio:5.2f}  {nees}", flush=True)
    medians = {}
    for way in ("online", "offline"):
        own_rows = [r for r in rows if r.way == way]
        medians[way] = {
            "ratio": float(np.median([r.ratio for r in own_rows])),
            "heading_ratio": float(
                np.median([r.heading_deg / r.vqf_heading_deg for r in own_rows])
            ),
            "tilt_ratio": float(np.median([r.tilt_deg / r.vqf_tilt_deg for r in own_rows])),
            "heading_nees": float(np.median([r.heading_nees for r in own_rows])),
            "tilt_nees": float(np.median([r.tilt_nees for r in own_rows])),
            "mean_total_deg": float(np.mean([r.total_deg for r in own_rows])),
            "mean_vqf_total_deg": float(np.mean([r.vqf_total_deg for r in own_rows])),
            "worse": sum(r.ratio > 1.0 for r in own_rows),
            "worst_ratio": max(r.ratio for r in own_rows),
        }
    lines = [
        f"{way:7} " + ", ".join(f"{key} {value:.2f}" for key, value in median.items())
        for way, median in medians.items()
    ]
    conclude("\n".join(lines), {"rows": rows, "medians": medians})


if __name__ == "__main__":
    main()
