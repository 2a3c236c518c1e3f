"""A gallery of 80 x 6 m: designed for 5 cm, set out with errors, accepted, and navigated.

`design --objective sigma --need 0.05` places coils on the walls.  Each installation has drawn
errors of the survey (5 mm, 0.3 deg, 1 % of moment) and fields bent by the declared 0.5 %.  A log
has stops on marks (5 mm, placed within 5 mm) at drawn headings; distances are taped to 5 mm.
`magfusion accept` tests the installation as it is, and with one drawn beacon 10 cm off in a drawn
direction, wired backwards, or of half the turns.

1. Each of ten installations as designed passes.
2. In each of ten with a fault, that beacon is named, with its fault, and no other.
3. The rms error of fixes of single windows at random places of the accepted installations is at
   most 1.3 times the predicted one, by the coverage of the design.

The rule, set before the first run: seeds 0 to 9.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import conclude, rms, scenario_parser, show_progress
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.accept import AcceptSettings, run_accept
from magfusion.model.aiding import AidingSamples, AidingSensor
from magfusion.model.hall import Hall, Mounts, mounting_places, points_of_use, prism_of
from magfusion.model.parameters import initial_calibration
from magfusion.model.region import Region
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, BeaconSigma, Coil, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk
from magfusion.results.coverage import coverage, phasor_variance
from magfusion.results.design.check_marks import check_marks, check_pairs
from magfusion.results.design.need import least_moment, min_beacons
from magfusion.results.design.pattern import ToneBand
from magfusion.results.design.planning import Task, designed
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.disturbance import Ambient, Bending, draw_bending
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, perturb_site, simulate_fields
from magfusion.simulation.motion import Rests, SimulatedMotion, progress_rate
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import DEGREE

LENGTH, WIDTH, HEIGHT = 80.0, 6.0, 4.0  # m
MOMENT = 400.0  # A m^2
NEED, WINDOW = 0.05, 0.4  # m, s
BAND = ToneBand(10.0, 150.0, WINDOW, 50.0)
MARK, TAPE = 0.005, 0.005  # m; of coordinates, of placement, and of distances
STOP, MOVE = 2.0, 6.0  # s
OFF, TURNS = 0.1, 0.5  # m, share
RATE_HZ, IMU_RATE_HZ = 250.0, 100.0
PLACES = 200  # at which the accuracy is measured


@dataclass(frozen=True)
class Config:
    """How many installations."""

    runs: int = 10
    seed: int = 0


@dataclass(frozen=True)
class Row:
    """One installation.

    ``answer`` of the accept job, ``named`` beacons with their states; ``right`` whether that is the
    truth.
    """

    seed: int
    fault: str
    beacon: str
    answer: str
    named: dict[str, str]
    right: bool
    error_m: float
    predicted_m: float


def gallery() -> Hall:
    """Return the gallery: beacons on its walls, a platform on its floor."""
    room = prism_of(np.array([[0.0, 0.0, 0.0], [LENGTH, WIDTH, HEIGHT]]))
    use = prism_of(np.array([[0.0, 0.0, 0.5], [LENGTH, WIDTH, 1.5]]))
    return Hall(room, Mounts((0, 1, 2, 3), np.array([1.0, 3.5])), use, 1.0)


def template_site() -> Site:
    """Return the platform, and the coil of which copies are placed."""
    usual = demo_site(coil_radius=None)
    first = usual.beacons[0]
    coil = replace(first.coils[0], moment_beacon=np.array([MOMENT, 0.0, 0.0]))
    sigma = BeaconSigma(np.full(3, 0.005), np.full(3, 0.3 * DEGREE), np.full(1, 0.01))
    beacon = replace(first, name="T", coils=(coil,), sigma=sigma, world_from_beacon=np.eye(3))
    return replace(usual, beacons=(beacon,))


def designed_site(seed: int) -> Site:
    """Return the installation for the accuracy, as `design` finds it."""
    site, hall = template_site(), gallery()
    task = Task(
        site=replace(site, beacons=()),
        template=site.beacons[0],
        count=1,
        places=mounting_places(hall, 5.0),
        points=points_of_use(hall, 4.0),
        band=BAND,
        risk=Risk(),
        objective="sigma",
        axes=3,
    )
    needed = min_beacons(
        task,
        NEED,
        20,
        lambda own: designed(own, starts=1, layouts=0, rng=np.random.default_rng(seed)),
    )
    return least_moment(needed, NEED).design.site


def with_marks(site: Site) -> Site:
    """Return the site with marks, and with the room as its region."""
    floor = points_of_use(replace(gallery(), use=prism_of(USE_FLOOR)), 2.0)
    marks = check_marks(site, floor)
    sensor = AidingSensor("mark", "mark", float(np.hypot(MARK, MARK)), marks_world=marks)
    room = Region(box_world=gallery().room.box_world)
    return replace(site, aiding=(sensor,), region=room)


USE_FLOOR = np.array([[0.0, 0.0, 0.5], [LENGTH, WIDTH, 0.5]])


def _off(beacon: Beacon, rng: np.random.Generator) -> Beacon:
    way = rng.standard_normal(3)
    place = beacon.position_world + OFF * way / np.linalg.norm(way)
    return replace(beacon, position_world=place)


def _times(factor: float) -> Callable[[Beacon, np.random.Generator], Beacon]:
    def changed(coil: Coil) -> Coil:
        return replace(coil, moment_beacon=factor * coil.moment_beacon)

    return lambda beacon, _: replace(beacon, coils=tuple(map(changed, beacon.coils)))


FAULTS: dict[str, tuple[Callable[[Beacon, np.random.Generator], Beacon], str]] = {
    "none": (lambda beacon, _: beacon, ""),
    "off": (_off, "position"),
    "backwards": (_times(-1.0), "reversed"),
    "half": (_times(TURNS), "moment"),
}
"""Change of a beacon, and the fault that must be named first."""


def recorded(site: Site, true: Site, bent: Bending, rng: np.random.Generator) -> Log:
    """Return the log of stops on all marks, in fields that are bent as declared."""
    motion_rng, imu_rng, wave_rng = rng.spawn(3)
    marks = site.aiding[0].marks_world
    place = np.array(list(marks.values()))
    place = place + motion_rng.normal(0.0, np.hypot(MARK, MARK), place.shape)
    count = len(place)
    duration = count * STOP + (count - 1) * MOVE
    rate = progress_rate(duration, Rests(start=STOP, move=MOVE, pause=STOP))
    at = np.linspace(0.0, float(rate.integrate(rate.x[0], rate.x[-1])), count)
    tilt = motion_rng.normal(0.0, 2.0, (count, 2))
    heading = motion_rng.uniform(-180.0, 180.0, (count, 1))
    turns = Rotation.from_euler("zyx", np.hstack([heading, tilt]), degrees=True)
    knots = np.concatenate([at[:1], at, at[-1:]])
    motion = SimulatedMotion(BSpline(knots, place, 1), RotationSpline(at, turns), rate)
    known = true.platform.imu
    imu = simulate_imu(
        motion, known, true.gravity, IMU_RATE_HZ, duration, imu_rng, known.time_offset
    )
    drives = synchronised_drives(true)
    wave = simulate_waveform(
        motion, true, drives, RATE_HZ, duration, wave_rng, None, None, Ambient(bending=bent)
    )
    time = STOP / 2.0 + (STOP + MOVE) * np.arange(count)
    samples = AidingSamples("mark", time, np.zeros((count, 0)), tuple(marks))
    return Log("gallery", EPOCH_NS, "simulation", imu.samples, wave, aiding={"mark": samples})


def installed(site: Site, kind: str, seed: int) -> tuple[Site, str]:
    """Return a true installation, and the name of its faulty beacon."""
    rng = np.random.default_rng([seed, list(FAULTS).index(kind)])
    draw, own = rng.spawn(2)
    true = perturb_site(site, draw)
    number = int(own.integers(len(site.beacons)))
    beacons = list(true.beacons)
    beacons[number] = FAULTS[kind][0](beacons[number], own)
    return replace(true, beacons=tuple(beacons)), site.beacons[number].name


def write_distances(site: Site, true: Site, path: Path, rng: np.random.Generator) -> None:
    """Write the check distances as they are taped."""
    marks = site.aiding[0].marks_world
    points = dict(marks) | {b.name: b.position_world for b in true.beacons}
    lines = ["from,to,measured_m"]
    for begin, end in check_pairs(site, marks):
        length = float(np.linalg.norm(points[begin] - points[end])) + rng.normal(0.0, TAPE)
        lines.append(f"{begin},{end},{length:.3f}")
    path.write_text("\n".join(lines) + "\n")


def accuracy(
    site: Site, true: Site, bent: Bending, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the rms error of fixes at random places, and the predicted one (m)."""
    low, high = gallery().use.box_world
    inside = np.array([1.0, 1.0, 0.0])
    place = rng.uniform(low + inside, high - inside, (PLACES, 3))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (PLACES, 1)))
    still = Trajectory(WINDOW * np.arange(PLACES), turn.as_matrix(), place)
    noise = float(np.sqrt(phasor_variance(site, WINDOW)[0]))
    samples = simulate_fields(true, still, noise, rng, window=WINDOW, bending=bent)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0))
    error = np.linalg.norm(fixes.position_world[:, 0] - place, axis=1)
    return rms(error), rms(coverage(site, place, WINDOW).position_sigma)


def run_one(site: Site, kind: str, seed: int) -> Row:
    """Install, record, and accept."""
    true, beacon = installed(site, kind, seed)
    rng = np.random.default_rng([seed, 100 + list(FAULTS).index(kind)])
    bent = draw_bending(rng, site.model_error, site.model_error_length, len(site.beacons))
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        write_log(recorded(site, true, bent, rng), root / "log")
        save_site(site, root / "log" / "site.yaml")
        write_distances(site, true, root / "distances.csv", rng)
        figures = run_accept(
            AcceptSettings(log=root / "log", distances=root / "distances.csv", tape=TAPE)
        )
    states = {b.name: str(figures[f"{b.name}.state"]) for b in site.beacons}
    named = {name: state for name, state in states.items() if state != "as declared"}
    wanted = FAULTS[kind][1]
    if kind == "none":
        right = figures["verdict"] == "pass"
        error, predicted = accuracy(site, true, bent, rng)
    else:
        right = list(named) == [beacon] and named[beacon].split(", ")[0] == wanted
        error = predicted = float("nan")
    return Row(seed, kind, beacon, str(figures["verdict"]), named, right, error, predicted)


def summary(rows: list[Row]) -> dict[str, float]:
    """Return how many are right, and the rms errors of fixes where nothing is at fault (m)."""
    good = [row for row in rows if row.fault == "none"]
    return {
        "accepted": sum(row.right for row in good),
        "named": sum(row.right for row in rows if row.fault != "none"),
        "error_m": rms(np.array([row.error_m for row in good])),
        "predicted_m": rms(np.array([row.predicted_m for row in good])),
    }


def report(rows: list[Row]) -> str:
    """Return the table."""
    lines = []
    for kind in FAULTS:
        own = [row for row in rows if row.fault == kind]
        lines.append(f"{kind:10} {sum(row.right for row in own)} of {len(own)} right")
        lines += [f"  {row}" for row in own if not row.right]
    result = summary(rows)
    ratio = result["error_m"] / result["predicted_m"]
    lines.append(
        f"rms error {1e3 * result['error_m']:.1f} mm, predicted"
        f" {1e3 * result['predicted_m']:.1f} mm: {ratio:.2f} times"
    )
    return "\n".join(lines)


def main() -> None:
    """Run all installations."""
    parser = scenario_parser(__doc__, Config.seed, "two installations of each kind", output=None)
    parser.add_argument("--site", type=Path, help="site.yaml of an earlier design")
    given = parser.parse_args()
    runs = 2 if given.quick else Config.runs
    site = with_marks(designed_site(given.seed) if given.site is None else load_site(given.site))
    rows: list[Row] = []
    for kind in FAULTS:
        for seed in range(given.seed, given.seed + runs):
            show_progress("installations", len(rows), runs * len(FAULTS))
            row = run_one(site, kind, seed)
            print(f"{kind:10} {seed} {row.answer:10} {'right' if row.right else row}", flush=True)
            rows.append(row)
    conclude(report(rows), {"beacons": len(site.beacons), "summary": summary(rows), "rows": rows})


if __name__ == "__main__":
    main()
