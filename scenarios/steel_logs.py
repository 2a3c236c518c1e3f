"""Several walks in drawn rooms with steel, calibrated together with and without a map of it.

The rooms of `steel`, four beacons.  The walks are calibrated by ``calibrate log`` without and with
``--map-steel``; a further walk is smoothed with each refined site.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from steel import IMU_RATE_HZ, RATE_HZ, WORLDS, kind_of, site_of

from magfusion.estimation.batch.batch import smooth
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.calibrate_log import LogCalibrationSettings, run_calibrate_log
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.steel_worlds import draw_steel


@dataclass(frozen=True)
class Room:
    """A room and how often it is walked."""

    seed: int
    walks: int
    duration: float  # s


@dataclass(frozen=True)
class Calibrated:
    """A refined site against the true one, and the next walk by it."""

    beacon_mm: float  # error of the beacons' positions, rms
    beacon_sigma_mm: float
    position_mm: float  # of the next walk
    attitude_deg: float
    nees: float


@dataclass(frozen=True)
class Row:
    """A room with both calibrations."""

    kind: str
    seed: int
    mapped: int  # walks whose map is used
    plain: Calibrated
    with_map: Calibrated


def judge(room: Room, _: np.random.Generator) -> Row:
    """Simulate the walks in a room, and calibrate them together."""
    rng, site, kind = np.random.default_rng([room.seed, 4]), site_of(4), kind_of(room.seed)
    beacons_world = np.array([beacon.position_world for beacon in site.beacons])
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=room.duration,
        imu_rate_hz=IMU_RATE_HZ,
        magnetometer_rate_hz=RATE_HZ,
        ambient=Ambient(rails=draw_steel(kind, rng, DEMO_BOX_WORLD, beacons_world)),
    )
    first = simulate_log(site, config, rng)
    same = replace(config, perturb=False)
    others = [simulate_log(first.true_site, same, rng) for _ in range(room.walks)]
    with TemporaryDirectory() as place:
        directory = Path(place)
        paths = [directory / f"walk_{i + 1}" for i in range(room.walks)]
        for path, built in zip(paths, (first, *others), strict=False):
            write_log(built.log, path)
            save_site(site, path / "site.yaml")
        result, mapped = list[Calibrated](), 0
        for mapping in (False, True):
            settings = LogCalibrationSettings(
                log=paths[0], more=tuple(paths[1:]), workers=1, map_steel=mapping
            )
            output = directory / f"site_{mapping}"
            known = run_calibrate_log(settings, output)
            mapped = sum(row["used"] == "yes" for row in known.get("steel_maps", ()))
            refined = load_site(output / "site.yaml")
            result.append(_calibrated(refined, first, others[-1].log))
    return Row(kind, room.seed, mapped, *result)


def _calibrated(site: Site, built: SimulatedLog, following: Log) -> Calibrated:
    pairs = list(zip(site.beacons, built.true_site.beacons, strict=True))
    error = np.array([one.position_world - true.position_world for one, true in pairs])
    sigma = np.array([one.sigma.position_world for one, _ in pairs])
    truth = following.truth
    assert truth is not None
    errors = trajectory_errors(smooth(replace(following, truth=None), site).states, truth)
    assert errors.nees is not None
    return Calibrated(
        1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        1e3 * float(np.sqrt(np.mean(np.sum(sigma**2, axis=1)))),
        1e3 * errors.ate,
        errors.attitude_rmse_deg,
        float(np.mean(errors.nees)),
    )


def run(rooms: Sequence[Room], scale: Scale | None = None) -> list[Row]:
    """Return what came out of each room."""
    return run_many(judge, list(rooms), **(scale or {}))


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Return medians over the rooms, and the largest ratio of the next walk's errors."""
    out = {}
    for name in ("plain", "with_map"):
        every = [getattr(row, name) for row in rows]
        for key in asdict(every[0]):
            out[f"{name}_{key}"] = float(np.median([getattr(one, key) for one in every]))
    ratios = [row.with_map.position_mm / row.plain.position_mm for row in rows]
    beacons = [row.with_map.beacon_mm / row.plain.beacon_mm for row in rows]
    return out | {
        "rooms": len(rows),
        "mapped": sum(row.mapped > 0 for row in rows),
        "beacon_ratio": float(np.median(beacons)),
        "largest_beacon_ratio": float(np.max(beacons)),
        "position_ratio": float(np.median(ratios)),
        "largest_position_ratio": float(np.max(ratios)),
    }


def report(rows: Sequence[Row]) -> str:
    """Return the table that a reader sees."""
    lines = [f"{'kind':9}{'seed':>5}{'maps':>5}  beacons mm (sigma)        next walk mm, deg, NEES"]
    for row in rows:
        lines.append(f"{row.kind:9}{row.seed:5}{row.mapped:5}")
        for one in (row.plain, row.with_map):
            lines[-1] += (
                f"  |{one.beacon_mm:6.2f} ({one.beacon_sigma_mm:5.2f}){one.position_mm:7.2f}"
                f"{one.attitude_deg:7.3f}{one.nees:7.1f}"
            )
    return "\n".join([*lines, ", ".join(f"{k} {v:.3g}" for k, v in figures(rows).items())])


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, 0, "two walks in one room", output=None, parallel=True)
    parser.add_argument("--worlds", type=int, default=WORLDS)
    parser.add_argument("--walks", type=int, default=4)
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + (1 if given.quick else given.worlds))
    walks, duration = (2, 30.0) if given.quick else (given.walks, 60.0)
    rows = run([Room(seed, walks, duration) for seed in seeds], chosen_scale(given))
    conclude(report(rows), {"figures": figures(rows), "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
