"""`magfusion calibrate ...`: commands that refine a site."""

from pathlib import Path
from typing import Annotated

import typer

from magfusion.cli.app import (
    AsJson,
    End,
    LogPath,
    MainsHz,
    Output,
    SitePath,
    Start,
    Step,
    TopicNames,
    Window,
    calibrate,
    log_job,
    progress,
    show_result,
)
from magfusion.fusion.batch import SmootherSettings
from magfusion.jobs.calibrate_antenna import AntennaSettings, run_calibrate_antenna
from magfusion.jobs.calibrate_beacon import run_calibrate_beacon
from magfusion.jobs.calibrate_fieldmap import MapSource, run_calibrate_fieldmap
from magfusion.jobs.calibrate_log import run_calibrate_log
from magfusion.jobs.calibrate_magnetometer import run_calibrate_magnetometer
from magfusion.options import groups_option
from magfusion.parameters import GROUPS
from magfusion.units import DEGREE


@calibrate.command()
def beacon(
    survey: Annotated[
        Path, typer.Argument(help="Survey: what magnetometers at known poses measured.")
    ],
    site: Annotated[Path, typer.Option("--site", help="Site file with the declared beacons.")],
    output: Output = Path("beacon"),
    beacon: Annotated[
        list[str] | None,
        typer.Option(help="Name of a beacon; repeatable; default: all that were surveyed."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find the magnetic centre, attitude and moments of beacons from a survey around them."""
    with progress() as report:
        figures = run_calibrate_beacon(survey, site, tuple(beacon or ()), output, report=report)
    show_result(figures, output, as_json)


@calibrate.command()
def fieldmap(
    source: Annotated[
        Path, typer.Argument(help="Survey (a table, or a directory that holds one), or a log.")
    ],
    output: Output = Path("field_map"),
    site: Annotated[
        Path | None, typer.Option("--site", help="Site file; default: beside the survey or log.")
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Of a log: poses, best not from this field; default: the log's truth."),
    ] = None,
    spacing: Annotated[
        float, typer.Option(help="Of a log: one point in each cube of this edge, m.")
    ] = 0.25,
    as_json: AsJson = False,
) -> None:
    """Learn where the beacons' fields differ from their model, for every later job."""
    with progress() as report:
        figures = run_calibrate_fieldmap(
            MapSource(source, site, trajectory, spacing), output, report=report
        )
    show_result(figures, output, as_json)


@calibrate.command()
def magnetometer(
    log: LogPath,
    output: Output = Path("magnetometer"),
    site: SitePath = None,
    positions: Annotated[
        bool, typer.Option("--positions", help="Use only the stops of the log: twelve or more.")
    ] = False,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate the magnetometer on a log of slow turning by hand, in the Earth's field."""
    job = log_job("magnetometer", log, site, output, None, None, 50.0, start, end, topics)
    show_result(run_calibrate_magnetometer(job, positions=positions), output, as_json)


@calibrate.command(name="log")
def by_log(
    log: LogPath,
    output: Output = Path("calibration"),
    site: SitePath = None,
    estimate: Annotated[
        str | None,
        typer.Option(
            help=f"Calibration to estimate: any of {','.join(GROUPS)}; default: what the site's"
            " sigmas leave open."
        ),
    ] = None,
    cross_validate: Annotated[
        int | None,
        typer.Option(help="Calibrate on each of so many parts of the log, score on the others."),
    ] = None,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Refine the site by a log of ordinary motion, and tell what motion is missing."""
    job = log_job("calibration", log, site, output, window, step, mains_hz, start, end, topics)
    settings = SmootherSettings(estimate=groups_option(estimate))
    with progress() as report:
        figures = run_calibrate_log(job, settings, parts=cross_validate, report=report)
    show_result(figures, output, as_json)


@calibrate.command()
def antenna(
    survey: Annotated[
        Path, typer.Argument(help="Survey: known poses and the phasors of a three-coil beacon.")
    ],
    site: Annotated[Path, typer.Option("--site", help="Site file.")],
    output: Output = Path("antenna"),
    beacon: Annotated[
        str | None, typer.Option(help="Which; default: the only one of three coils.")
    ] = None,
    pose_rotation_deg: Annotated[
        float, typer.Option(help="Error of the survey's attitudes, one sigma an axis; 0: exact.")
    ] = 0.1,
    pose_position_m: Annotated[
        float, typer.Option(help="Error of the survey's positions, one sigma an axis; 0: exact.")
    ] = 0.0005,
    sizes: Annotated[
        bool, typer.Option("--sizes", help="Estimate the coils' size too (for the report alone).")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a tracker's antennas at known poses: moments, axes and centres of all six coils."""
    settings = AntennaSettings(beacon, pose_rotation_deg * DEGREE, pose_position_m, sizes)
    show_result(run_calibrate_antenna(survey, site, settings, output), output, as_json)
