"""Coils in time slots, received by three axes, by two and by one: batch, window and filter.

Walks with raw samples with an IMU: about one source of three coils, on a side that the site
specifies, and in a room with three such sources.  Calibrations are drawn from what the site
declares. Of the same samples all three axes are used, two, and, in the room, one, by `smooth`, by
the default fixed-lag smoother and by the filter.

The rule, stated before the run: of every world, axes and estimator the mean NEES over all seeds is
at most 9 where 6 are expected, nine in ten epochs are within three sigma, and no verdict fails.
"""

from dataclasses import dataclass, replace

import numpy as np
from fewer_axes import INSIDE, MAX_COUNT, Row, filtered, pooled, row_of, smoothed, with_axes
from harness import conclude, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.jobs.replay import Replay, feed
from magfusion.model.region import HalfSpace, Region
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, BeaconSigma, Coil, Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE

CARRIER_HZ, RATE_HZ = 1000.0, 5000.0
SLOT = 4e-3  # s
NO_STATE = "no state"
SINGLE_BOX_WORLD = np.array([[0.35, -0.25, -0.25], [0.75, 0.25, 0.25]])
ROOM = {"A": (0.0, 0.0, 0.5), "B": (6.0, 0.5, 1.5), "C": (2.5, 5.0, 1.0)}
SETS = {"lone": ("xyz", "xy"), "room": ("xyz", "xy", "z")}


def source(name: str, position_m: tuple[float, float, float], moment: float, first: int) -> Beacon:
    """Return three coils in slots of their own, which follow one another."""
    coils = tuple(Coil(moment * axis, 0.0, slot=first + k) for k, axis in enumerate(np.eye(3)))
    known = BeaconSigma(np.full(3, 1e-3), np.full(3, 0.05 * DEGREE), np.full(3, 1e-3))
    turn = Rotation.from_euler("xyz", [10.0 * first, 5.0, 20.0 * first], degrees=True).as_matrix()
    return Beacon(name, np.array(position_m), turn, CARRIER_HZ, coils, True, known)


def world(name: str) -> tuple[Site, np.ndarray]:
    """Return a site of slots and the box in which the platform walks."""
    site = demo_site()
    if name == "lone":
        beacons = (source("T", (0.0, 0.0, 0.0), 0.5, 0),)
        box, region = (
            SINGLE_BOX_WORLD,
            Region(half_space=HalfSpace(np.array([1.0, 0.0, 0.0]), np.zeros(3))),
        )
    else:
        places = enumerate(ROOM.items())
        beacons = tuple(source(own, place, 40.0, 3 * k) for k, (own, place) in places)
        box, region = DEMO_BOX_WORLD, Region()
    slots = Slots(SLOT, 3 * len(beacons) + 1)
    beacons = tuple(replace(beacon, slots=slots) for beacon in beacons)
    return replace(site, beacons=beacons, region=region), box


def windowed(log: Log, site: Site) -> tuple[Trajectory, Trust]:
    """Navigate along a log by the smoother of a fixed lag, as it is by default."""
    navigator, replayed = Navigator(site, NavigatorSettings()), Replay(log)
    states = []
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        states += navigator.take()
    return as_trajectory(states), navigator.summary.trust


@dataclass(frozen=True)
class SlotRow(Row):
    """A row of `fewer_axes`, and where it was."""

    world: str = "room"


def rows_of(name: str, seed: int, duration: float) -> list[SlotRow]:
    """Return the rows of one walk."""
    declared, box_world = world(name)
    plan = SimulationConfig(box_world, duration=duration, magnetometer_rate_hz=RATE_HZ)
    if name == "lone":
        plan = replace(plan, speed=0.1)
    log = simulate_log(declared, plan, np.random.default_rng(seed)).log
    assert log.truth is not None
    rows = []
    for axes in SETS[name]:
        own, site = with_axes(log, declared, axes)
        for kind, estimate in (("smooth", smoothed), ("lag", windowed), ("ekf", filtered)):
            states, trust = estimate(own, site)
            if len(states) == 0:
                nothing = (np.inf, np.inf, np.inf, 0.0, np.inf)
                rows.append(SlotRow(seed, axes, kind, *nothing, NO_STATE, (), world=name))
                continue
            row = row_of(seed, axes, kind, states, trust, log.truth)
            rows.append(SlotRow(**vars(row), world=name))
    return rows


def faults_of(rows: list[SlotRow]) -> list[str]:
    """Return in what the rule is not kept."""
    faults = []
    for key in dict.fromkeys((row.world, row.axes, row.estimator) for row in rows):
        own = [row for row in rows if (row.world, row.axes, row.estimator) == key]
        nees, inside = (float(np.mean([getattr(r, k) for r in own])) for k in ("nees", "inside"))
        where = " ".join(key)
        if nees > 6.0 * MAX_COUNT:
            faults.append(f"{where}: mean NEES {nees:.2f} of 6")
        if inside < INSIDE:
            faults.append(f"{where}: {inside:.0%} within three sigma")
        failed = [row for row in own if row.verdict in (str(Verdict.FAILED), NO_STATE)]
        faults += [
            f"{where}, seed {row.seed}: {row.verdict} {','.join(row.codes)}" for row in failed
        ]
    return faults


def main() -> None:
    """Run the scenario from the command line."""
    parser = scenario_parser(__doc__, seed=0, quick="one walk of 12 s", output=None)
    parser.add_argument("--seeds", type=int, default=3, help="how many, from --seed")
    parser.add_argument("--world", choices=tuple(SETS), help="one alone")
    options = parser.parse_args()
    count, duration = (1, 12.0) if options.quick else (options.seeds, 20.0)
    worlds = tuple(SETS) if options.world is None else (options.world,)
    seeds = range(options.seed, options.seed + count)
    rows = [row for name in worlds for seed in seeds for row in rows_of(name, seed, duration)]
    faults = faults_of(rows)
    lines = [
        f"{'world':6}{'axes':5}{'seed':>5} estimator{'position':>12}{'attitude':>12}{'NEES':>8}"
    ]
    for row in rows:
        errors = f"{row.position_mm:9.2f} mm{row.attitude_deg:8.3f} deg{row.nees:8.2f}"
        reported = f"{row.verdict} {','.join(row.codes)}"
        lines.append(f"{row.world:6}{row.axes:5}{row.seed:5} {row.estimator:9}{errors}  {reported}")
    worlds_pooled = {name: pooled([row for row in rows if row.world == name]) for name in worlds}
    text = "\n".join([*lines, *faults, "FAIL" if faults else "pass"])
    conclude(text, {"rows": rows, "pooled": worlds_pooled})
    if faults:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
