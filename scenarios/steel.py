"""Walks in drawn rooms with steel: how honest are the sigmas of an estimate.

Forty rooms by seed: in the first twenty spheres and meshes, in the others racks, pipes and
cabinets; each with four and with eight beacons.  Errors by steel are common to a log, so that
each log is one draw.  Of one estimate three covariances are compared, with the mean NEES over the
log (6 is expected): without an error of the fields that is constant in place, with a kernel in
place for each beacon that knows no physics, and as `smooth` has it.
The steel of the simulator is bars, sheets and spheres in each other's fields; the estimator
knows nothing of it.  With `--map`, the steel is mapped, too (`smooth --map-steel`), and where the
map is used, a second walk in the room is smoothed by the site that the first refined, with the map
and without it.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import Smoothed, smooth
from magfusion.estimation.integrity.steel_map import SteelMap, explained_without_map, map_steel
from magfusion.estimation.measurements.model_error import cells
from magfusion.estimation.posterior.marginals import marginals
from magfusion.model.noise import model_error
from magfusion.model.parameters import BeaconParameter, Block, placed
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.results.refinement import result_site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient
from magfusion.simulation.field import phasors_world
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.steel import SteelStructure
from magfusion.simulation.steel_worlds import draw_steel
from magfusion.units import DEGREE, Array, ComplexArray

WORLDS = 40
COMPACT, LONG = ("spheres", "mesh"), ("racks", "pipes", "cabinets")
MODEL_ERROR = 0.01  # as declared; `smooth` estimates it
IMU_RATE_HZ, RATE_HZ = 100.0, 160.0
# Position (m), roll, pitch and yaw (degrees) and tone (Hz) of four more beacons.
MORE = {
    "E": ((3.0, -0.2, 2.3), (20.0, -40.0, 30.0), 40.0),
    "F": ((6.1, 2.5, 0.3), (-60.0, 10.0, 80.0), 45.0),
    "G": ((3.0, 5.2, 2.2), (85.0, 20.0, -10.0), 50.0),
    "H": ((-0.1, 2.5, 0.2), (10.0, 60.0, 150.0), 55.0),
}
LIMITS = (4.0, 8.0), 12.6, 20.0  # of the median; of all but six logs; of all
KERNEL_COLUMNS = 288


@dataclass(frozen=True)
class Walk:
    """One log."""

    seed: int
    beacons: int
    duration: float  # s
    mapping: bool = False


@dataclass(frozen=True)
class Row:
    """What one log came to."""

    kind: str
    seed: int
    beacons: int
    steel_percent: float  # of the field, rms over beacons and path
    position_mm: float
    attitude_deg: float
    nees_white: float
    nees_kernel: float
    nees: float
    map_error_ratio: float | None = None  # of beacons left out; None without a map
    map_used: bool = False
    map_position_mm: float | None = None
    map_attitude_deg: float | None = None
    map_nees: float | None = None
    second_position_mm: float | None = None  # of the next log, by the refined site
    second_map_position_mm: float | None = None  # with the map
    second_map_attitude_ratio: float | None = None
    second_map_nees: float | None = None
    second_map_kept: bool = False  # the next log is explained better with it


def kind_of(seed: int) -> str:
    """Return the kind of a room."""
    number = seed % WORLDS
    return COMPACT[number % 2] if number < WORLDS // 2 else LONG[number % 3]


def site_of(beacons: int) -> Site:
    """Return the demo's room with four or eight beacons."""
    plain = demo_site(coil_radius=None)
    more = tuple(_beacon(plain.beacons[0], name, *given) for name, given in MORE.items())
    return replace(plain, beacons=(*plain.beacons, *more)[:beacons], model_error=MODEL_ERROR)


def _beacon(
    like: Beacon, name: str, place: Sequence[float], rpy: Sequence[float], hz: float
) -> Beacon:
    turn = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    place_world = np.array(place)
    return replace(
        like, name=name, position_world=place_world, world_from_beacon=turn, frequency_hz=hz
    )


def judge(walk: Walk, _: np.random.Generator) -> Row:
    """Simulate one log and return the errors of its estimate and the honesty of its sigmas."""
    rng = np.random.default_rng([walk.seed, walk.beacons])
    site, kind = site_of(walk.beacons), kind_of(walk.seed)
    beacons_world = np.array([beacon.position_world for beacon in site.beacons])
    steel = draw_steel(kind, rng, DEMO_BOX_WORLD, beacons_world)
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=walk.duration,
        imu_rate_hz=IMU_RATE_HZ,
        magnetometer_rate_hz=RATE_HZ,
        ambient=Ambient(rails=steel),
    )
    built = simulate_log(site, config, rng)
    truth = built.log.truth
    assert truth is not None
    result = smooth(replace(built.log, truth=None), site)
    kernel = placed((*result.considered, *kernel_errors(result)))
    nees_white, nees_kernel, nees = (
        _mean_nees(replace(result.states, pose_cov=cov), truth)
        for cov in (
            marginals(result.graph, result.estimate, result.considered)[0],
            marginals(result.graph, result.estimate, kernel)[0],
            result.states.pose_cov,
        )
    )
    few = truth.position_world[::50]
    steel_map = map_steel(result, built.log.imu) if walk.mapping else None
    mapped: dict[str, Any] = {}
    if isinstance(steel_map, SteelMap):
        mapped = _mapped(steel_map, result, truth)
        if steel_map.is_used:
            again = simulate_log(built.true_site, replace(config, perturb=False), rng).log
            mapped |= _second(steel_map, result, again)
    return Row(
        kind,
        walk.seed,
        walk.beacons,
        100.0 * _distortion(site, few, steel),
        *_errors(result.states, truth),
        nees_white,
        nees_kernel,
        nees,
        **mapped,
    )


def _errors(states: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return the errors of position (mm) and attitude (degrees), rms."""
    errors = trajectory_errors(states, truth)
    position_mm = 1e3 * float(np.sqrt(np.mean(np.sum(errors.position_world**2, axis=1))))
    return position_mm, float(np.sqrt(np.mean(errors.attitude**2))) / DEGREE


def _mapped(steel: SteelMap, result: Smoothed, truth: Trajectory) -> dict[str, float]:
    """Return the columns of a row that a map has, whether it is used or not."""
    states = steel.applied(result).states
    position_mm, attitude_deg = _errors(states, truth)
    return {
        "map_error_ratio": steel.ratio,
        "map_used": steel.is_used,
        "map_position_mm": position_mm,
        "map_attitude_deg": attitude_deg,
        "map_nees": _mean_nees(states, truth),
    }


def _second(steel: SteelMap, result: Smoothed, again: Log) -> dict[str, float]:
    """Return the columns of a row that the next log in the room has."""
    truth, alone = again.truth, replace(again, truth=None)
    assert truth is not None
    plain = smooth(alone, result_site(result, again.name))
    known = smooth(alone, steel.on(result_site(steel.applied(result), again.name)))
    before, after = (_errors(each.states, truth) for each in (plain, known))
    return {
        "second_position_mm": before[0],
        "second_map_position_mm": after[0],
        "second_map_attitude_ratio": after[1] / before[1],
        "second_map_nees": _mean_nees(known.states, truth),
        "second_map_kept": not explained_without_map(known),
    }


def _distortion(site: Site, point_world: Array, steel: SteelStructure) -> float:
    """Return the field of steel over that of the beacons, rms over beacons and points."""
    ratios = []
    for beacon in site.beacons:
        clean = phasors_world(beacon, point_world)
        added = phasors_world(beacon, point_world, rails=steel) - clean
        ratios.append(np.sum(np.abs(added) ** 2, axis=2) / np.sum(np.abs(clean) ** 2, axis=2))
    return float(np.sqrt(np.mean(ratios)))


def _mean_nees(states: Trajectory, truth: Trajectory) -> float:
    nees = trajectory_errors(states, truth).nees
    assert nees is not None
    return float(np.mean(nees))


class KernelError(BeaconParameter):
    """A matrix in place times the beacon's field, of each beacon for itself."""

    group = kind = "kernel_error"

    def __init__(self, time: Array, shape: Array, sensor_from_world: Array) -> None:
        self._time, self._shape, self._turn = time, shape, sensor_from_world

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        """Return the columns of the owner's phasors."""
        time = view.calibration.reference_time + view.elapsed
        at = np.searchsorted(self._time, time - 1e-6)
        turn = self._turn[at]
        field_world = np.einsum("nak,nta->ntk", turn, view.phasor)
        bent = np.einsum("nm,naj,ntk->ntamjk", self._shape[at], turn, field_world)
        return bent.reshape(*view.phasor.shape, -1)


def kernel_errors(result: Smoothed) -> tuple[Block, ...]:
    """Return errors of correlation exp(-d / length), each beacon's for itself, to be considered."""
    site, states = result.calibration.site, result.states
    sensor, length = site.platform.magnetometer, site.model_error_length
    place = states.position_world + states.world_from_body @ sensor.position_body
    owner, members, centre = cells(place, length)
    weight, separate = np.sqrt(members), np.linalg.norm(centre[:, None] - centre, axis=2)
    value, vector = np.linalg.eigh(weight[:, None] * np.exp(-separate / length) * weight)
    kept = slice(-1, -1 - KERNEL_COLUMNS // (9 * len(site.beacons)), -1)
    modes = (vector[:, kept] * np.sqrt(value[kept]) / weight[:, None])[owner] / np.sqrt(3.0)
    turn = np.swapaxes(states.world_from_body @ sensor.body_from_sensor, 1, 2)
    unit = np.ones(9 * modes.shape[1])
    return placed(
        Block(KernelError(states.time, size * modes, turn), beacon.name, slice(0), unit)
        for beacon, size in zip(site.beacons, model_error(site), strict=True)
    )


def run(
    seeds: Sequence[int],
    beacons: Sequence[int],
    duration: float,
    scale: Scale | None = None,
    *,
    mapping: bool = False,
) -> list[Row]:
    """Return what came out of each log."""
    walks = [Walk(seed, count, duration, mapping) for count in beacons for seed in seeds]
    return run_many(judge, walks, **(scale or {}))


def figures(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return median, largest, and how many are above the limit, of each covariance."""
    out = {}
    for name in ("nees_white", "nees_kernel", "nees"):
        values = np.array([getattr(row, name) for row in rows])
        out[name] = {
            "median": float(np.median(values)),
            "largest": float(np.max(values)),
            "above": int(np.sum(values > LIMITS[1])),
            "far_above": int(np.sum(values > LIMITS[2])),
        }
    return out


def map_figures(rows: Sequence[Row]) -> dict[str, float]:
    """Return what the maps that are used do: errors over those without, and the mean NEES."""
    used = [row for row in rows if row.map_used]
    position = [(row.map_position_mm or 0.0) / row.position_mm for row in used]
    attitude = [(row.map_attitude_deg or 0.0) / row.attitude_deg for row in used]
    nees = [row.map_nees or 0.0 for row in used]
    return {
        "logs": len(rows),
        "used": len(used),
        "used_compact": sum(row.kind in COMPACT for row in used),
        "position_ratio": float(np.median(position)),
        "largest_position_ratio": float(np.max(position)),
        "attitude_ratio": float(np.median(attitude)),
        "nees": float(np.median(nees)),
        "nees_without": float(np.median([row.nees for row in used])),
        "second_kept": sum(row.second_map_kept for row in used),
        "second_position_ratio": float(np.median(_ratios_of_second(used))),
        "largest_second_position_ratio": float(np.max(_ratios_of_second(used))),
        "second_attitude_ratio": float(
            np.median([row.second_map_attitude_ratio or 0.0 for row in used])
        ),
        "second_nees": float(np.median([row.second_map_nees or 0.0 for row in used])),
    }


def _ratios_of_second(rows: Sequence[Row]) -> list[float]:
    return [(row.second_map_position_mm or 0.0) / (row.second_position_mm or 1.0) for row in rows]


def report(rows: Sequence[Row]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"{'kind':9}{'seed':>5}{'beacons':>8}{'steel %':>8}{'mm':>7}{'deg':>7}"
        f"{'white':>8}{'kernel':>8}{'smooth':>8}"
    ]
    for row in rows:
        lines.append(
            f"{row.kind:9}{row.seed:5}{row.beacons:8}{row.steel_percent:8.2f}"
            f"{row.position_mm:7.1f}{row.attitude_deg:7.3f}"
            f"{row.nees_white:8.1f}{row.nees_kernel:8.1f}{row.nees:8.1f}"
        )
        if row.map_error_ratio is not None:
            lines[-1] += (
                f" map {'used' if row.map_used else 'not '} at {row.map_error_ratio:.3f}:"
                f"{row.map_position_mm:7.1f}{row.map_attitude_deg:7.3f}{row.map_nees:8.1f}"
            )
        if row.second_position_mm is not None:
            lines[-1] += (
                f"; next log{row.second_position_mm:7.1f} ->{row.second_map_position_mm:7.1f}"
                f"{row.second_map_nees:8.1f}{'' if row.second_map_kept else ' not used'}"
            )
    for count in sorted({row.beacons for row in rows}):
        for name, one in figures([row for row in rows if row.beacons == count]).items():
            lines.append(
                f"{count} beacons, {name}: median {one['median']:.1f}, above {LIMITS[1]}:"
                f" {one['above']}, above {LIMITS[2]:g}: {one['far_above']},"
                f" largest {one['largest']:.1f}"
            )
    if any(row.map_used for row in rows):
        lines.append(", ".join(f"{name} {v:.3g}" for name, v in map_figures(rows).items()))
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, 0, "two walks of 20 s", output=None, parallel=True)
    parser.add_argument("--worlds", type=int, default=WORLDS)
    parser.add_argument("--beacons", type=int, nargs="+", default=[4, 8], choices=(4, 8))
    parser.add_argument("--map", action="store_true", help="map the steel, too")
    parser.add_argument("--duration", type=float, default=60.0, help="of a walk (s)")
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + (2 if given.quick else given.worlds))
    beacons = [4] if given.quick else given.beacons
    duration = 20.0 if given.quick else given.duration
    rows = run(seeds, beacons, duration, chosen_scale(given), mapping=given.map)
    measured = {"figures": figures(rows), "rows": [asdict(row) for row in rows]}
    if any(row.map_used for row in rows):
        measured["maps"] = map_figures(rows)
    conclude(report(rows), measured)


if __name__ == "__main__":
    main()
