"""Two wells, a magnet that turns in one and a sensor at rest in the other: how far, and where.

Rotating magnet ranging as it is practised (A. F. Kuckes, US patent 5 589 775): a magnet across a
shaft near the bit passes a sensor in a cased well, twice, the sensor elsewhere the second time.
Published systems reach about 3 % of the distance at 25 m.

Two cases.  ``crossing``: about 25 m apart, any direction, wells that converge by some degrees.
``pair``: a steam-assisted pair, 5 m apart over 80 m.  The field of the magnet is that of a stack
that is turned sample by sample, with tilt, whirl and slip, at a speed that drifts; in layers of
ground (empymod); through the steel of a casing that is not as declared, which is magnetised along
as well; with a rail next to each place of the sensor; at depths that scatter and stretch.

What is declared is what is drawn, otherwise no NEES is meaningful: the moment, the scale of the
depths, the shaft's slip and the casing's wall, permeability and conductivity are drawn with their
declared sigmas.  That of a window's depth follows from that of a reading.  The thin wall's formula
errs by about the wall over its radius, 0.1.  What rails and layers do is calculated without any
estimate, over draws of other seeds (``ranging_left_out.py``), and declared, rounded: as
``model_error`` its root mean square over all places of the magnet, as its length where its
correlation falls to 1/e.

The rule, stated before the run: over all draws with the angle measured the mean NEES of the six
numbers of the pose lies between 4 and 8 in both cases; and of ``crossing`` the root mean square of
the distance's error is at most 0.6 % of the distance, a fifth of what is published.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from harness import conclude, rms, scenario_parser

from magfusion.estimation.ranging.ranging import Ranged, find_range
from magfusion.estimation.ranging.ranging_data import SHARE, RangingWindows
from magfusion.estimation.ranging.ranging_windows import DepthErrors, ranging_log
from magfusion.estimation.ranging.relative_wells import Wells
from magfusion.model.physics.casing import Casing
from magfusion.model.rotor import Rotor
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, BeaconSigma, Site, rotor_coils
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.layers import Layers
from magfusion.simulation.pipe import Pipe, Steel
from magfusion.simulation.rotor import Pass, Surroundings, simulate_transits
from magfusion.simulation.shaft import Shaft
from magfusion.simulation.wells import TwoWells, drawn_steel
from magfusion.units import Array

PUBLISHED, BETTER = 0.03, 5.0
MIN_NEES, MAX_NEES = 4.0, 8.0
MOMENT, MOMENT_SIGMA = 300.0, 0.02  # A m^2, relative
SPEED_HZ, NOISE = 3.0, 2e-11  # Hz, T/sqrt(Hz)
RATE_HZ = 50.0
RADIUS, WALL, STRETCH, READING = 0.09, 0.01, 5e-4, 0.02  # m, m, relative, m
PERMEABILITY, STEEL_CONDUCTIVITY = 100.0, 5e6  # relative, S/m
STEEL_SIGMA = 0.05, 0.2, 0.1  # of the logarithms of wall, permeability and conductivity
THIN, THIN_PHASE = 0.1, 0.03  # by which the thin wall's formula errs, relative and in rad
ELLIPSE = 0.005  # of the moment's circle, each of two numbers
# Of a window's depth: readings each second, linear in between, at three places of the window.
WINDOW_DEPTH = READING * float(np.sqrt(2.0 / 3.0 * np.sum(SHARE**2)))
LAYERS = Layers((300.0, 20.0, -15.0), (0.02, 0.005, 0.1))
CONDUCTIVITY = 0.01  # S/m, as declared
RAIL_FROM, RAIL_TO, RAIL_LENGTH = 4.0, 8.0, 20.0  # m, from the sensor, sideways
CASING = Casing(
    RADIUS - 0.5 * WALL, WALL, PERMEABILITY, STEEL_CONDUCTIVITY, THIN, THIN_PHASE, *STEEL_SIGMA
)


@dataclass(frozen=True)
class Case:
    """Two wells.

    Parameters
    ----------
    distance : float
        About (m).
    well_distance : float
        Of the sensor's two places along its well (m).
    reach : float
        Of the magnet's way on either side of the sensor (m).
    converge : float
        One sigma of the angle between the wells (rad).
    speed : float
        Of the magnet along its well (m/s).
    window : float
        (s)
    model_error, model_error_length : float
        As declared: by ``ranging_left_out.py``; the length in m.
    segment : float
        Of the simulated steel (m).
    """

    name: str
    distance: float
    well_distance: float
    reach: float
    converge: float
    speed: float
    window: float
    model_error: float
    model_error_length: float
    segment: float


CROSSING = Case("crossing", 25.0, 15.0, 30.0, 0.04, 0.1, 10.0, 3e-4, 17.0, 0.5)
PAIR = Case("pair", 5.0, 80.0, 10.0, 0.005, 0.03, 10.0, 2e-4, 5.0, 0.25)


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    seed: int = 1
    runs: int = 25
    others: int = 5
    encoder: bool = True
    steel: bool = True
    layers: bool = True


def declared_site(*, cased: bool) -> Site:
    """Return what a driller declares."""
    plain = demo_site()
    axis, zero = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    rotor = Rotor(MOMENT, axis, zero, ellipse_sigma=ELLIPSE, length=Shaft.length)
    sigma = BeaconSigma(np.zeros(3), np.zeros(3), np.full(2, MOMENT_SIGMA))
    beacon = Beacon(
        "bit",
        np.zeros(3),
        np.eye(3),
        SPEED_HZ,
        rotor_coils(rotor, SPEED_HZ),
        True,
        sigma,
        rotor=rotor,
        conductivity=CONDUCTIVITY,
    )
    sensor = replace(
        plain.platform.magnetometer,
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        matrix=np.eye(3),
        offset=np.zeros(3),
        noise_density=NOISE,
        casing=CASING if cased else None,
    )
    platform = replace(plain.platform, magnetometer=sensor)
    return replace(plain, beacons=(beacon,), platform=platform)


@dataclass(frozen=True, eq=False)
class World:
    """Two wells and what is about them."""

    site: Site
    shaft: Shaft
    wells: TwoWells
    transits: tuple[Pass, ...]
    around: Surroundings


@dataclass(frozen=True, eq=False)
class Scene:
    """A log, and where the sensor truly is from the magnet."""

    log: Log
    wells: TwoWells
    transits: tuple[Pass, ...]
    stretch: float


def draw_world(case: Case, config: Config, rng: np.random.Generator) -> World:
    """Draw two wells."""
    site = declared_site(cased=False)
    rotor = site.beacons[0].rotor
    assert rotor is not None
    moment = MOMENT * np.exp(MOMENT_SIGMA * rng.standard_normal())
    tilted = replace(rotor, moment=moment, tilt=float(np.deg2rad(2.0) * rng.standard_normal()))
    beacon = replace(site.beacons[0], rotor=tilted)
    site = replace(site, beacons=(beacon,))
    dip = rng.normal(0.0, 0.02)  # the sensor's well goes a little down
    angle = rng.uniform(0.0, 2.0 * np.pi) if case is CROSSING else rng.normal(0.0, 0.1)
    distance = case.distance * rng.uniform(0.9, 1.1)
    right, up = rng.normal(0.0, case.converge, 2)
    turn, ahead = rng.uniform(-np.pi, np.pi), rng.uniform(-2.0, 2.0)
    way = case.well_distance, case.reach, case.speed
    wells = TwoWells(distance, angle, dip, (right, up), turn, ahead, *way)
    transits = wells.transits_of(rng.uniform(-np.pi, np.pi, 2))
    # An error of the angle twice a turn makes an ellipse of half its size.
    first, second = 2.0 * ELLIPSE * rng.standard_normal(2)
    shaft = Shaft(
        angle_start=rng.uniform(0.0, 6.0),
        slip=float(np.hypot(first, second)),
        slip_phase=float(np.arctan2(second, first)),
        whirl=0.01,
        drift_hz=0.1,
    )
    around = Surroundings(
        LAYERS if config.layers else None,
        _steel(case, wells, rng) if config.steel else None,
        STRETCH * rng.standard_normal(),
        READING,
    )
    return World(site, shaft, wells, transits, around)


def draw(case: Case, config: Config, seed: int) -> Scene:
    """Draw two wells, and what the sensor records in two passes."""
    rng = np.random.default_rng([seed, 19])
    own = draw_world(case, config, rng)
    log = simulate_transits(
        own.site, own.shaft, own.transits, own.around, RATE_HZ, rng, encoder=config.encoder
    )
    return Scene(log, own.wells, own.transits, own.around.depth_scale)


def _steel(case: Case, wells: TwoWells, rng: np.random.Generator) -> Steel:
    """Return the casing about the sensor, not quite as declared, and rails off the magnet's way."""
    true = drawn_steel(CASING, rng)
    steel = true.wall, true.permeability, true.conductivity
    half = 0.5 * case.well_distance + case.reach + case.distance
    casing = wells.casing(half, RADIUS, steel, case.segment)
    rails = []
    for place in (-0.5 * case.well_distance, 0.5 * case.well_distance):
        away = wells.direction + rng.uniform(0.5 * np.pi, 1.5 * np.pi)
        across = rng.uniform(RAIL_FROM, RAIL_TO) * np.array([0.0, -np.sin(away), np.cos(away)])
        ends = [
            wells.side_world @ (across + np.array([place + end * RAIL_LENGTH, 0.0, 0.0]))
            for end in (-0.5, 0.5)
        ]
        rails.append(Pipe(ends[0], ends[1], 0.045, 0.045))
    return Steel((casing, *rails), about=0)


@dataclass(frozen=True)
class Row:
    """What is found of a draw; errors are those of the mean of both places."""

    case: str
    angle: str
    seed: int
    distance_m: float
    error_m: float
    sigma_m: float
    direction_error_deg: float
    depth_error_m: float
    nees: float  # of all six where the angle is measured, otherwise of the five that are not open
    residual_rms: float
    converged: bool


@dataclass(frozen=True)
class Judgement:
    """What the draws of a case come to."""

    case: str
    angle: str
    runs: int
    rms_share: float
    worst_share: float
    direction_rms_deg: float
    depth_rms_m: float
    nees: float
    largest_nees: float
    largest_residual_rms: float
    fulfilled: bool | None  # None where there is no rule


def pose_error(
    scene: Scene, windows: RangingWindows, result: Ranged, *, measured: bool = True
) -> Array:
    """Return the error of the pose in the axes of the true high side (6,), rotation first.

    Where the angle is not measured, zero of the magnet's turn is anywhere: the truth is turned to
    the estimate about the magnet's axis, for a covariance holds near by and not half a turn away.
    """
    own = scene.transits[0]
    rotor_world = own.world_from_rotor
    depth = windows.magnet_from / (1.0 + scene.stretch)
    magnet = own.start_world + (depth - own.depth[0]) * rotor_world[:, 0]
    place = rotor_world.T @ (own.sensor_world - magnet)
    true = gtsam.Pose3(gtsam.Rot3(rotor_world.T @ scene.wells.side_world), place)
    estimated = gtsam.Pose3(gtsam.Rot3(result.world_from_body), result.position_world)
    if not measured:
        between = estimated.rotation().matrix() @ true.rotation().matrix().T
        turn = np.arctan2(between[2, 1] - between[1, 2], between[1, 1] + between[2, 2])
        true = gtsam.Pose3(gtsam.Rot3.Rx(float(turn)), np.zeros(3)).compose(true)
    return np.asarray(gtsam.Pose3.Logmap(true.between(estimated)))


def nees(error: Array, result: Ranged, *, measured: bool) -> float:
    """Return the NEES of a pose; where the angle is not measured without the turn that is open."""
    weight = np.linalg.inv(result.cov[:6, :6])
    if not measured:
        axis = np.array([1.0, 0.0, 0.0])
        turn = np.concatenate([axis, np.cross(axis, result.position_world)]).reshape(2, 3)
        way = (turn @ result.world_from_body).ravel()
        weight = weight - np.outer(weight @ way, way @ weight) / (way @ weight @ way)
    return float(error @ weight @ error)


def run_one(case: Case, config: Config, seed: int) -> Row:
    """Draw, find, compare."""
    scene = draw(case, config, seed)
    site = replace(
        declared_site(cased=config.steel),
        model_error=case.model_error,
        model_error_length=case.model_error_length,
    )
    reported = ranging_log(scene.log, site, case.window, errors=DepthErrors(WINDOW_DEPTH, STRETCH))
    result = find_range(site, reported.windows)
    wells = Wells(result, reported.windows, np.array([1.0, 0.0, 0.0]))
    errors, distances, sigmas = [], [], []
    for own in scene.transits:
        distance, direction, depth = scene.wells.truth_of(own)
        one = wells.wells_at(own.sensor_depth)
        rotated = np.angle(np.exp(1j * (one.direction - direction)))
        errors.append([one.distance - distance, np.rad2deg(rotated), one.depth - depth])
        distances.append(distance)
        sigmas.append(one.distance_sigma)
    error = np.mean(errors, axis=0)
    pose = pose_error(scene, reported.windows, result, measured=config.encoder)
    return Row(
        case=case.name,
        angle="measured" if config.encoder else "followed",
        seed=seed,
        distance_m=float(np.mean(distances)),
        error_m=float(error[0]),
        sigma_m=float(np.mean(sigmas)),
        direction_error_deg=float(error[1]),
        depth_error_m=float(error[2]),
        nees=nees(pose, result, measured=config.encoder),
        residual_rms=float(np.sqrt(result.chi_square / result.freedom)),
        converged=result.converged,
    )


def judge_ranging(rows: list[Row]) -> Judgement:
    """Judge the draws of a case."""
    share = np.array([row.error_m / row.distance_m for row in rows])
    mean = float(np.mean([row.nees for row in rows]))
    first, good = rows[0], MIN_NEES <= mean <= MAX_NEES
    if first.case == CROSSING.name:
        good = good and rms(share) <= PUBLISHED / BETTER
    return Judgement(
        first.case,
        first.angle,
        len(rows),
        rms(share),
        float(np.max(np.abs(share))),
        rms(np.array([row.direction_error_deg for row in rows])),
        rms(np.array([row.depth_error_m for row in rows])),
        mean,
        max(row.nees for row in rows),
        max(row.residual_rms for row in rows),
        good if first.angle == "measured" else None,
    )


def report(rows: list[Row], result: list[Judgement]) -> str:
    """Return the table of the draws, and the verdict."""
    lines = [
        f"{'case':10}{'angle':10}{'seed':>5}{'distance':>10}{'error':>10}{'sigma':>10}"
        f"{'direction':>11}{'depth':>9}{'NEES':>8}{'residual':>10}"
    ]
    for row in rows:
        lines.append(
            f"{row.case:10}{row.angle:10}{row.seed:5d}{row.distance_m:8.2f} m"
            f"{100 * row.error_m:7.2f} cm{100 * row.sigma_m:7.2f} cm"
            f"{row.direction_error_deg:7.2f} deg{100 * row.depth_error_m:6.1f} cm{row.nees:8.2f}"
            f"{row.residual_rms:10.3f}{'' if row.converged else '  not converged'}"
        )
    for one in result:
        word = {True: "fulfilled: ", False: "NOT fulfilled: ", None: ""}[one.fulfilled]
        lines.append(
            f"{one.case}, angle {one.angle}, {one.runs} draws: {word}distance"
            f" {100 * one.rms_share:.3f} % rms, {100 * one.worst_share:.3f} % at most, direction"
            f" {one.direction_rms_deg:.2f} deg, depth {100 * one.depth_rms_m:.1f} cm, mean NEES"
            f" {one.nees:.2f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Range in both cases, with the angle measured and followed."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="of each case of the rule")
    parser.add_argument("--others", type=int, default=Config.others, help="with a followed angle")
    given = parser.parse_args()
    rows, result = list[Row](), list[Judgement]()
    for case in (CROSSING, PAIR):
        for encoder, runs in ((True, given.runs), (False, given.others)):
            config = Config(seed=given.seed, encoder=encoder)
            own = [run_one(case, config, given.seed + k) for k in range(runs)]
            rows += own
            result += [judge_ranging(own)] if own else []
    conclude(report(rows, result), {"rows": rows, "judgements": result})


if __name__ == "__main__":
    main()
