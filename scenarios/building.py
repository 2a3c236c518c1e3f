"""A building over a year: changes of its beacons found by the logs of several vehicles.

A hall of 60 beacons, roughly surveyed, is driven through by three vehicles, each with its own
magnetometer: 100 logs at random dates of a year, each in one part of the hall.  Two beacons are
exchanged (other moments, the attitude within the survey's sigma), and one is moved; the site does
not declare it.  Some logs are real: simulated drives, smoothed with the survey, those after a
change as well.  The others are simulated in condensed form: each has the information of a real one,
at another date and by another vehicle, and a calibration drawn from it.  Search for changes, rounds
and report are those of ``magfusion calibrate log --calendar``.

1. Which changes are found, and between which dates?
2. How far is the common survey from the truth, in its declared sigmas, but for its common place?
3. Is it within its own sigmas?

``--real 100`` simulates all logs as drives.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness import chosen_scale, conclude, rms, scenario_parser
from many_logs import SETTINGS, Metered, SimulatedLog, drawn
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.calendar import BlockName, Calendar, LogBlocks
from magfusion.estimation.batch.joint import Shared, SharedCalibration, apart_in_sigmas
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_calendar import ChangeReport, describe_change
from magfusion.jobs.joint_driver import Driver
from magfusion.jobs.joint_kept import load_information, save_information
from magfusion.jobs.joint_run import site_files, tasks_of
from magfusion.jobs.joint_tasks import LogTask, alone
from magfusion.model.parameters import (
    BeaconParameter,
    difference,
    initial_calibration,
    placed,
    prior_sigma,
)
from magfusion.model.progress import quiet
from magfusion.model.site import Beacon, BeaconSigma, Site
from magfusion.results.observability import gauge_basis
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, perturb_site, simulate_fields, simulate_log
from magfusion.simulation.monte_carlo import worker_pool
from magfusion.units import DEGREE, Array

BEACONS, VEHICLES = 60, 3
SPACING = 6.0  # m, of the beacons, in rows of five
MOMENT = 20.0  # A m^2: received up to some 15 m
NOISE = 3e-10  # T; of each part of a phasor
PART = 4.0  # m, half the side of the part of the hall that a log covers
# Centres (m) of the parts, shape (16, 2).
PARTS = np.stack(np.meshgrid(np.linspace(4.0, 62.0, 8), [6.0, 18.0]), axis=-1).reshape(-1, 2)
BEGIN = datetime(2025, 1, 1, tzinfo=UTC).timestamp()
DAY, DAYS = 86400.0, 365.0  # s; of the year
CHANGED_BETWEEN = (45.0, 320.0)  # days
MOVED_M, MOVED_DEG = 0.3, 10.0
EXCHANGED = (0.05, 0.1)  # of the logarithm of a moment, of either sign


class Event(NamedTuple):
    """A change of a beacon."""

    day: float
    cause: str
    beacon: Beacon  # true, from then on


@dataclass(frozen=True)
class Drive:
    """A log to be simulated."""

    true: Site
    path: Path
    day: float
    centre: Array
    duration: float  # s


def surveyed(rng: np.random.Generator) -> Site:
    """Return the hall, roughly surveyed."""
    site = replace(demo_site(coil_radius=None), model_error=1e-4)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 1.0 * DEGREE), np.full(2, 0.01))
    (first, *_), beacons = site.beacons, []
    for k in range(BEACONS):
        place = np.array([SPACING * (k // 5), SPACING * (k % 5), (0.3, 3.0)[k % 2]])
        one = replace(
            first,
            name=f"B{k + 1:02d}",
            position_world=place + rng.uniform(-0.7, 0.7, 3) * [1.0, 1.0, 0.3],
            world_from_beacon=Rotation.random(random_state=rng).as_matrix(),
            frequency_hz=20.0 + 2.5 * k,
            sigma=sigma,
        )
        beacons.append(scaled(one, np.full(2, MOMENT / 220.0)))
    return replace(site, beacons=tuple(beacons))


def scaled(beacon: Beacon, factor: Array) -> Beacon:
    """Return a beacon with other moments."""
    coils = zip(beacon.coils, factor, strict=True)
    new = tuple(replace(c, moment_beacon=f * c.moment_beacon) for c, f in coils)
    return replace(beacon, coils=new)


def events(true: Site, rng: np.random.Generator) -> list[Event]:
    """Draw two exchanged beacons and a moved one, in the order of their dates."""
    days = np.sort(rng.uniform(*CHANGED_BETWEEN, 3))
    causes = rng.permutation(["exchanged", "exchanged", "moved"])
    which = rng.choice(BEACONS, 3, replace=False)
    out = []
    for day, cause, k in zip(days, causes, which, strict=True):
        old = true.beacons[k]
        if cause == "moved":
            way = rng.standard_normal(3)
            axis = rng.standard_normal(3)
            rotation = Rotation.from_rotvec(MOVED_DEG * DEGREE * axis / np.linalg.norm(axis))
            new = replace(
                old,
                position_world=old.position_world + MOVED_M * way / np.linalg.norm(way),
                world_from_beacon=old.world_from_beacon @ rotation.as_matrix(),
            )
        else:
            change = rng.uniform(*EXCHANGED, 2) * rng.choice([-1.0, 1.0])
            rotation = Rotation.from_rotvec(0.5 * DEGREE * rng.standard_normal(3))
            rotated = replace(old, world_from_beacon=old.world_from_beacon @ rotation.as_matrix())
            new = scaled(rotated, np.exp(change))
        out.append(Event(float(day), str(cause), new))
    return out


def at_day(true: Site, all_events: list[Event], day: float) -> Site:
    """Return the true site of a day."""
    new = {event.beacon.name: event.beacon for event in all_events if event.day <= day}
    return replace(true, beacons=tuple(new.get(b.name, b) for b in true.beacons))


def driven(given: Drive, rng: np.random.Generator) -> None:
    """Write a short drive through a part of the hall, as phasors."""
    low, high = given.centre - PART, given.centre + PART
    box = np.array([[*low, 0.8], [*high, 1.6]])
    config = SimulationConfig(
        box, duration=given.duration, perturb=False, magnetometer_rate_hz=500.0
    )
    built = simulate_log(given.true, config, rng)
    epochs = built.motion.trajectory(np.arange(0.3, given.duration - 0.3, 0.25))
    fields = simulate_fields(built.true_site, epochs, NOISE, rng, built.drives, window=0.2)
    epoch_ns = int((BEGIN + DAY * given.day) * 1e9)
    write_log(replace(built.log, waveform=None, fields=fields, epoch_ns=epoch_ns), given.path)


def truth_of(shared: Shared, true: Site, names: tuple[BlockName, ...] | None = None) -> Array:
    """Return the step from the declared calibration to the true one, of some blocks."""
    whole = difference(shared.declared, initial_calibration(true, 0.0), shared.blocks)
    if names is None:
        return whole
    at = {(b.group, b.owner, b.kind): whole[b.columns] for b in shared.blocks}
    return np.concatenate([at[name.group, name.owner, name.kind] for name in names])


def local_shared(shared: Shared, names: tuple[BlockName, ...]) -> Shared:
    """Return some of the blocks."""
    at = {(b.group, b.owner, b.kind): b for b in shared.blocks}
    blocks = placed(at[name.group, name.owner, name.kind] for name in names)
    return Shared(shared.declared, blocks)


def of_changes(reports: list[ChangeReport], changes: list[Event]) -> dict[str, int]:
    """Return how many changes were named, with their dates and causes, and how many were false."""
    named = dated = caused = 0
    for event in changes:
        for report in reports:
            if report.row["owner"].split()[0] == event.beacon.name:
                named += 1
                day = date(event.day)
                dated += report.row["after"] <= day <= report.row["before"]
                caused += report.cause == event.cause
                break
    false = len(reports) - named
    return {
        "changes": len(changes),
        "named": named,
        "dated": dated,
        "caused": caused,
        "false": false,
    }


def date(day: float) -> str:
    """Return the date of a day of the year, ISO 8601."""
    return str(np.datetime64(int(BEGIN + DAY * day), "s"))


def of_survey(
    calendar: Calendar, known: SharedCalibration, vehicles: list[Site], changes: list[Event]
) -> dict[str, float]:
    """Return the error of the site at the end of the year, with the first vehicle.

    In declared sigmas, root mean square over the beacons' parameters: the survey's, the estimate's,
    that but for the common place, which no log determines, as it is and as its covariance expects;
    and the estimate's in its own sigmas.
    """
    shared = calendar.platforms[0].shared
    now = known.of(*calendar.columns(calendar.on(0, np.inf)))
    truth = truth_of(shared, at_day(vehicles[0], changes, np.inf))
    gauge = gauge_basis(shared.declared, shared.blocks)
    rows = np.concatenate(
        [np.full(len(b.sigma), isinstance(b.parameter, BeaconParameter)) for b in shared.blocks]
    )
    unit = prior_sigma(shared.blocks)
    relative = np.eye(len(unit)) - gauge @ gauge.T
    error, cov = (now.step - truth) / unit, now.honest / unit / unit[:, None]
    expected = np.diagonal(relative @ cov @ relative)
    return {
        "survey_sigma": rms(truth_of(shared, vehicles[0])[rows] / unit[rows]),
        "error_with_common_place_sigma": rms(error[rows]),
        "error_sigma": rms((relative @ error)[rows]),
        "expected_error_sigma": rms(np.sqrt(expected[rows])),
        "error_in_own_sigma": apart_in_sigmas(now.step, truth, now.honest),
    }


def main() -> None:
    """Print what was found; end with one JSON line."""
    parser = scenario_parser(__doc__, seed=0, output=None, parallel=True)
    parser.add_argument("--logs", type=int, default=100, help="of them all")
    parser.add_argument("--duration", type=float, default=8.0, help="of a drive, s")
    parser.add_argument("--real", type=int, default=16, help="simulated as drives, and smoothed")
    options = parser.parse_args()
    if options.real < len(PARTS):
        parser.error(f"--real must be at least {len(PARTS)}, to cover the hall")
    scale = chosen_scale(options)
    rng = np.random.default_rng(options.seed)
    site = surveyed(rng)
    true = perturb_site(site, rng)
    changes = events(true, rng)
    declared, vehicles = [], []
    for _ in range(VEHICLES):
        magnetometer = site.platform.magnetometer
        arm = magnetometer.position_body + rng.uniform(-0.1, 0.1, 3)
        mounted = replace(magnetometer, position_body=arm)
        own = replace(site, platform=replace(site.platform, magnetometer=mounted))
        declared.append(own)
        vehicles.append(replace(true, platform=perturb_site(own, rng).platform))
    days = rng.uniform(0.0, DAYS, options.logs)
    vehicle = rng.integers(VEHICLES, size=options.logs)
    real = min(options.real, options.logs)
    with (
        tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch,
        worker_pool(options.logs, cluster=scale["cluster"], workers=scale["workers"]) as hands,
    ):
        place = Path(scratch)
        sites = [place / f"vehicle{i + 1}.yaml" for i in range(VEHICLES)]
        for own, path in zip(declared, sites, strict=True):
            save_site(own, path)
        vehicle[:VEHICLES] = np.arange(VEHICLES)
        drives = []
        for i in range(real):
            centre = PARTS[i % len(PARTS)]
            now = at_day(vehicles[vehicle[i]], changes, days[i])
            drives.append(Drive(now, place / f"log{i}", days[i], centre, options.duration))
        hands.run(driven, drives, seed=1)
        jobs = [Job(d.path, sites[v], place / "out") for d, v in zip(drives, vehicle, strict=False)]
        tasks: list[LogTask] = tasks_of(jobs, SETTINGS, place / "out")
        began = time.perf_counter()
        first = hands.run(alone, tasks)
        alone_s = time.perf_counter() - began
        failed = sum(one.facts["verdict"] == "failed" for one in first)
        files = site_files(tasks)
        plain = files.calendar()
        for i in range(real, options.logs):
            like = tasks[rng.integers(real)]
            stored = load_information(like.information(0))
            assert stored.blocks is not None
            v, names = int(vehicle[i]), stored.blocks.shared
            of_vehicle = plain.platforms[v].shared
            truth = truth_of(of_vehicle, at_day(vehicles[v], changes, days[i]), names)
            local = local_shared(of_vehicle, names)
            kept = like.kept.with_stem(f"simulated{i}")
            tasks.append(SimulatedLog(kept.stem, jobs[v], SETTINGS, kept, like.key, v))
            blocks = LogBlocks(BEGIN + DAY * days[i], v, names, stored.blocks.considered)
            drawn_log = drawn(stored.information, local, truth, rng)
            save_information(tasks[-1].information(0), drawn_log, blocks)
        driver = Driver(Metered(hands.executor), tasks, files, quiet)
        began = time.perf_counter()
        driver, detected = driver.with_changes()
        search_s = time.perf_counter() - began
        sums = driver.first_sums()
        disagree = driver.agreement(sums)
        began = time.perf_counter()
        sums, moved = driver.repeated(sums)
        rounds_s = time.perf_counter() - began
        months = driver.months(sums)
    known, calendar = sums.known, driver.calendar
    reports = [describe_change(one, calendar, known) for one in detected]
    figures = {"logs": options.logs, "real": real, "failed": failed, "rounds": sums.rounds}
    figures |= {"moved_sigma": moved, "rows_by_month": len(months)}
    figures |= of_changes(reports, changes) | of_survey(calendar, known, vehicles, changes)
    figures |= {"contradicting": sum(bool(findings) for findings in disagree.of_log)}
    figures |= {"alone_s": alone_s, "search_s": search_s, "rounds_s": rounds_s}
    text = [report.finding.text for report in reports]
    text += [f"{e.beacon.name} {e.cause} at {date(e.day)}" for e in changes]
    text += [f"{name:<28}{value:12.4g}" for name, value in figures.items()]
    conclude("\n".join(text), figures)


if __name__ == "__main__":
    main()
