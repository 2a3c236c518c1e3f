"""Orientation without beacons, compared with VQF: gyroscope, gravity and the Earth's field.

VQF (D. Laidig, T. Seel, Information Fusion 91, 2023) is what orientation filters are measured by.
Both have the same samples: simulated ones of every kind of `earth_worlds`, of sensors as good as
their site declares and ten times better, and real ones (BROAD, where they are at hand).  VQF knows
no Earth field but its direction, and no calibration; what the site declares is its offset here,
zero.  Errors are root mean squares against the truth, in its own frame; that of the heading is
listed with its scatter about its own mean, since a constant part is a matter of the declared
calibration and of how the frame of the truth was found (BROAD: by the uncalibrated field).  The
last column is the squared error of the heading by its claimed variance, one where the claim is
exact.

The filter's constants were chosen by the simulated logs alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from earth_worlds import KINDS, simulated
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.orientation.smoother import Oriented, oriented
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.units import DEGREE, Array

FIRST_SEED = 30  # constants of the filter were chosen by logs of other ones: up to 29, 201 to 203
LOGS = Path(__file__).parents[2] / "shared" / "logs"


@dataclass(frozen=True)
class Case:
    """A log, and the group that it is averaged with."""

    group: str
    log: Log
    site: Site


@dataclass(frozen=True)
class Mean:
    """Means of one way over a group of logs (deg)."""

    group: str
    way: str
    heading_deg: float
    tilt_deg: float
    heading_nees: float | None


@dataclass(frozen=True)
class Row:
    """Errors of one way on one log (deg)."""

    log: str
    way: str
    heading_deg: float
    scatter_deg: float
    tilt_deg: float
    heading_nees: float | None = None


def errors(time: Array, attitude: Array, truth: Trajectory) -> tuple[float, float, float]:
    """Return the heading's error, its scatter about its mean, and the tilt's error (deg, rms)."""
    known, exists = interpolate(truth, time, 0.1)
    off = Rotation.from_matrix(attitude[exists] @ np.swapaxes(known.world_from_body, 1, 2))
    x, y, z, w = off.as_quat().T
    head = 2.0 * np.arctan(z / w)
    tilt = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
    return rms(head) / DEGREE, float(np.std(head)) / DEGREE, rms(tilt) / DEGREE


def heading_nees(result: Oriented, truth: Trajectory) -> float:
    """Return the mean squared error of the heading by its claimed variance, at the states."""
    known, exists = interpolate(truth, result.ends, 0.1)
    states = [s for s, there in zip(result.states, exists, strict=True) if there]
    attitude = np.stack([s.world_from_body for s in states])
    off = Rotation.from_matrix(attitude @ np.swapaxes(known.world_from_body, 1, 2)).as_rotvec()
    return float(np.mean(off[:, 2] ** 2 / np.array([s.cov[2, 2] for s in states])))


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
        result = oriented(log, site, back=back)
        own = errors(result.time, result.world_from_body, log.truth)
        yield Row(log.name, way, *own, heading_nees(result, log.truth))
        yield Row(
            log.name, f"VQF {way}", *errors(log.imu.time, vqf(log, site, back=back), log.truth)
        )


def mean_of(group: str, way: str, rows: list[Row]) -> Mean:
    """Return the means of the rows of one way."""
    own = [row for row in rows if row.way == way]
    nees = [row.heading_nees for row in own if row.heading_nees is not None]
    return Mean(
        group,
        way,
        float(np.mean([row.heading_deg for row in own])),
        float(np.mean([row.tilt_deg for row in own])),
        float(np.mean(nees)) if nees else None,
    )


def _cases(seeds: int, shares: list[float], logs: Path) -> Iterator[Case]:
    for kind in KINDS:
        for share in shares:
            group = "as declared" if share == 1.0 else f"{1.0 / share:g} times better"
            for seed in range(FIRST_SEED, FIRST_SEED + seeds):
                yield Case(group, *simulated(kind, seed, share=share))
    for path in sorted(logs.glob("earth_*")):
        yield Case("real", open_log(path), load_site(path / "site.yaml", without=True))


def main() -> None:
    """Print the table, and one object with all of it."""
    parser = scenario_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="simulated logs of each kind")
    parser.add_argument(
        "--shares", type=float, nargs="+", default=[0.1, 1.0], help="of the declared sigmas"
    )
    parser.add_argument("--logs", type=Path, default=LOGS, help="directory of logs earth_*")
    arguments = parser.parse_args()
    groups: dict[str, list[Row]] = {}
    for case in _cases(arguments.seeds, arguments.shares, arguments.logs):
        for row in rows_of(case.log, case.site):
            groups.setdefault(case.group, []).append(row)
            head = f"heading {row.heading_deg:6.2f} ({row.scatter_deg:5.2f})"
            text = f"{head} tilt {row.tilt_deg:5.2f}"
            claim = "" if row.heading_nees is None else f"  nees {row.heading_nees:5.2f}"
            print(f"{row.log:34} {row.way:12} {text}{claim}", flush=True)
    means = [
        mean_of(group, way, rows)
        for group, rows in groups.items()
        for way in dict.fromkeys(row.way for row in rows)
    ]
    lines = [
        f"{f'mean, {one.group}':34} {one.way:12} heading {one.heading_deg:6.2f} tilt"
        f" {one.tilt_deg:5.2f}"
        for one in means
    ]
    rows = [row for group in groups.values() for row in group]
    conclude("\n".join(lines), {"rows": rows, "means": means})


if __name__ == "__main__":
    main()
