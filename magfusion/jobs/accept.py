"""The job that accepts an installation: fields at known marks and check distances."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.jobs.settings import Command, LogSettings, WindowSettings, option
from magfusion.model.aiding import AidingSensor
from magfusion.model.check_distance import CheckDistance
from magfusion.model.progress import Report, quiet
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array, IntArray

if TYPE_CHECKING:
    from magfusion.calibration.installation import BeaconCheck
    from magfusion.calibration.marked_snapshots import MarkedSnapshots
    from magfusion.model.samples import Log
    from magfusion.model.site import Site
    from magfusion.receiver.windows import LockinSettings

MIN_MARKS = 3
TAPE_SIGMAS = 4.0  # of a distance's difference, from which it is named
CODES = {
    "reversed": "coil_reversed",
    "moment": "moments",
    "position": "beacon_pose",
    "axis": "beacon_pose",
}


@dataclass(frozen=True, kw_only=True)
class AcceptSettings(LogSettings, WindowSettings):
    """Log with stops on marks, check distances, and what they must prove."""

    distances: Path | None = option(
        None, "Check distances between beacons and marks: CSV with from, to, measured_m"
    )
    tape: float = option(
        0.005, "Standard deviation of a check distance", unit="m", least=1e-4, most=1.0
    )
    tolerance: float = option(
        0.1, "Displacement of a beacon that must not stay undetected", unit="m", least=1e-3, most=10
    )


def run_accept(
    settings: AcceptSettings, output: Path | None = None, report: Report = quiet
) -> Figures:
    """Test each beacon of an installation, and name what to correct."""
    from magfusion.calibration.installation import check_installation
    from magfusion.files.distances import read_distances
    from magfusion.files.site import save_site
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.result_directory import claim
    from magfusion.results.report import write_report

    claimed = nullcontext(None) if output is None else claim(output, "accept")
    job = settings.job(Path() if output is None else output)
    report("reading", 0, 3)
    lockin = settings.lockin(job)
    log, site = read_job(job, lockin=lockin, select_beacons=False, report=report)
    sensor = _mark_sensor(site, job.declared_path)
    distances: tuple[CheckDistance, ...] = ()
    if settings.distances is not None:
        names = frozenset({b.name for b in site.every_beacon} | set(sensor.marks_world))
        every = read_distances(settings.distances, names, settings.tape)
        silent = {b.name for _, b in site.undetected}
        distances = tuple(d for d in every if not silent & {d.begin, d.end})
    report("demodulating", 1, 3)
    with named(job.log_path):
        marked, left_out = _at_marks(log, site, sensor, lockin, distances)
    report("testing", 2, 3)
    result = check_installation(marked)
    trust = Trust(
        (
            *(_finding(check) for check in result.beacons if check.contradicted),
            *(_silent(beacon.name) for _, beacon in site.undetected),
            *(
                _unproven(check, settings.tolerance)
                for check in result.beacons
                if not check.contradicted and check.detectable > settings.tolerance
            ),
        )
    )
    answer = {Verdict.TRUSTWORTHY: "pass", Verdict.DOUBTFUL: "not proven"}.get(trust.verdict)
    figures = heading("accept", log.name) | trust_figures(trust, answer)
    figures |= Figures(
        Figure("marks", len(marked.samples), label="stops on marks"),
        Figure("stops_left_out", left_out, section=Section.REPORT),
        Figure("check_distances", len(distances)),
        Figure(
            "chi_square_ratio", result.chi_square / result.freedom, label="chi square / freedom"
        ),
        *(figure for check in result.beacons for figure in _of_beacon(check)),
        Figure("distances", _distance_rows(marked, site), section=Section.REPORT),
    )
    with claimed as directory:
        if directory is not None:
            save_site(result.site, directory / "site.yaml")
            write_report(directory, figures)
    report("done", 3, 3)
    return figures


def _mark_sensor(site: Site, path: Path) -> AidingSensor:
    sensors = [sensor for sensor in site.aiding if sensor.quantity == "mark"]
    if not sensors:
        raise InputError(
            f"{path}: declares no marks; add an aiding sensor of quantity: mark with marks_m"
        )
    return sensors[0]


def _at_marks(
    log: Log,
    site: Site,
    sensor: AidingSensor,
    lockin: LockinSettings | None,
    distances: tuple[CheckDistance, ...],
) -> tuple[MarkedSnapshots, int]:
    """Return one epoch of each stop on a mark, and the number of stops left out."""
    from magfusion.calibration.marked_snapshots import MarkedSnapshots
    from magfusion.estimation.demodulation.demodulation import fix_inputs, phasors
    from magfusion.model.parameters import initial_calibration

    visits = _visits(log, sensor)
    samples, gravity = fix_inputs(phasors(log, site, lockin)[0], log, site)
    if gravity is None or len(samples) == 0:
        raise InputError("accept requires stops: the platform never rests; stop on each mark")
    rows: list[int] = []
    marks: list[Array] = []
    for time, name in visits:
        near = int(np.argmin(np.abs(samples.time - time)))
        within = abs(samples.time[near] - time) < samples.window[near]
        if within and np.isfinite(gravity.sigma[near]):
            rows.append(near)
            marks.append(sensor.marks_world[name])
    if len(rows) < MIN_MARKS:
        raise InputError(
            f"accept requires {MIN_MARKS} stops on marks, and the log has {len(rows)} at which"
            " the platform rests; stop for some seconds on each mark"
        )
    order: IntArray = np.argsort(np.array(rows), kind="stable")
    chosen = samples.rows(np.array(rows)[order])
    known = initial_calibration(site, float(np.mean(chosen.time)))
    result = MarkedSnapshots(
        chosen,
        known,
        survey_error=False,
        marks_world=np.array(marks)[order],
        mark_sigma=sensor.sigma,
        lever_body=sensor.position_body,
        up_body=gravity.up_body[np.array(rows)[order]],
        distances=distances,
        points_world=dict(sensor.marks_world),
    )
    return result, len(visits) - len(rows)


def _visits(log: Log, sensor: AidingSensor) -> list[tuple[float, str]]:
    """Return the middle of each stop on a mark, and its name."""
    samples = log.aiding.get(sensor.name)
    if samples is None or len(samples) == 0:
        raise InputError(
            f"the log has no record of marks; write table {sensor.name} with time_ns and mark"
        )
    unknown = sorted(set(samples.marks) - set(sensor.marks_world))
    if unknown:
        raise InputError(f"mark {unknown[0]!r} is not among marks_m of the site; add it")
    names = np.array(samples.marks)
    begins = np.flatnonzero(np.concatenate([[True], names[1:] != names[:-1]]))
    ends = np.append(begins[1:], len(names))
    return [
        (float(np.median(samples.time[b:e])), str(names[b]))
        for b, e in zip(begins, ends, strict=True)
    ]


def _finding(check: BeaconCheck) -> Finding:
    from magfusion.calibration.installation import words_of

    text = f"Beacon {check.name} is not as declared: {words_of(check)}."
    return Finding(CODES[check.faults[0]], text, Verdict.FAILED)


def _silent(name: str) -> Finding:
    text = f"Beacon {name} is not detected: check its supply and frequency."
    return Finding("silent_beacon", text, Verdict.FAILED)


def _unproven(check: BeaconCheck, tolerance: float) -> Finding:
    text = (
        f"The measurements would not detect beacon {check.name} less than"
        f" {100.0 * check.detectable:.0f} cm off its place (--tolerance {100.0 * tolerance:g} cm):"
        " stop on more marks near it, on several sides."
    )
    return Finding("not_proven", text, Verdict.DOUBTFUL)


def _of_beacon(check: BeaconCheck) -> list[Figure]:
    name = check.name
    state = ", ".join(check.faults) if check.contradicted else "as declared"
    rows = (
        ("state", state, "", "state"),
        ("offset_m", float(np.linalg.norm(check.step_world)), "m", "found off by"),
        ("detectable_m", check.detectable, "m", "smallest detectable"),
        ("turned_deg", float(np.rad2deg(check.angle)), "deg", "found turned by"),
        ("moment_factor", check.factor, "", "moment over declared"),
        ("marks", check.marks, "", "marks in range"),
    )
    return [
        Figure(f"{{beacon}}.{key}", value, unit, name, label=label)
        for key, value, unit, label in rows
    ]


def _distance_rows(marked: MarkedSnapshots, site: Site) -> list[dict[str, object]]:
    """Return each check distance with its difference from the site."""
    points = {b.name: (b.position_world, b.sigma.position_world) for b in site.beacons}
    mark = np.full(3, marked.mark_sigma)
    points |= {name: (place, mark) for name, place in marked.points_world.items()}
    rows: list[dict[str, object]] = []
    for one in marked.distances:
        (begin, begin_sigma), (end, end_sigma) = points[one.begin], points[one.end]
        way = end - begin
        declared = float(np.linalg.norm(way))
        along = way / declared
        sigma = float(
            np.sqrt(one.sigma**2 + np.sum((along * begin_sigma) ** 2 + (along * end_sigma) ** 2))
        )
        rows.append(
            {
                "from": one.begin,
                "to": one.end,
                "declared_m": declared,
                "measured_m": one.distance,
                "sigma_m": sigma,
                "within": bool(abs(one.distance - declared) <= TAPE_SIGMAS * sigma),
            }
        )
    return rows


COMMAND = Command(
    AcceptSettings,
    run_accept,
    output_optional=True,
    example="magfusion accept log --site site.yaml --distances distances.csv",
)
