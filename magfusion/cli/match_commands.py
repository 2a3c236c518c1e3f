"""Commands on attitude from the Earth's field alone."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from magfusion.cli.app import (
    AsJson,
    End,
    JobOutput,
    LogPath,
    SitePath,
    Start,
    TopicNames,
    app,
    calibrate,
    log_job,
    show_result,
)
from magfusion.jobs.attitude_database import DatabaseSettings, Sampling, run_attitude_database
from magfusion.jobs.match import MatchSettings, run_match


class Angles(StrEnum):
    """What varies, or is asked."""

    ROLL = "roll"
    ROLL_PITCH = "roll-pitch"
    ROLL_PITCH_YAW = "roll-pitch-yaw"


class MatchMethod(StrEnum):
    """How a field vector becomes an attitude."""

    NEAREST = "nearest"
    INTERPOLATED = "interpolated"
    CLOSED_FORM = "closed-form"


Raw = Annotated[
    bool,
    typer.Option("--raw", help="Take every sample as it is: no beacon radiates, or it spins fast."),
]
EpochStep = Annotated[
    float | None, typer.Option("--step", help="Distance of epochs, s; default: half a window.")
]


@calibrate.command(name="attitude-database")
def attitude_database(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    angles: Annotated[
        Angles | None, typer.Option(help="What varies in the log; default: as it is found.")
    ] = None,
    step_deg: Annotated[
        float, typer.Option(help="Measurements in cells of this size are averaged, degrees.")
    ] = 1.0,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Reference: result of smooth, or a table; default: the log's truth."),
    ] = None,
    raw: Raw = False,
    step: EpochStep = None,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Learn which field the platform feels at which attitude, for magfusion match."""
    job = log_job("attitude_database", log, site, output, None, None, 50.0, start, end, topics)
    asked = None if angles is None else angles.value
    settings = DatabaseSettings(asked, step_deg, trajectory, Sampling(raw, step))
    show_result(run_attitude_database(job, settings), job.output, as_json)


@app.command()
def match(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    database: Annotated[
        Path | None,
        typer.Option(
            help="Result of calibrate attitude-database; default: the site's Earth field, exactly."
        ),
    ] = None,
    method: Annotated[
        MatchMethod | None,
        typer.Option(help="Default: interpolated in the database; the closed form without one."),
    ] = None,
    angles: Annotated[
        Angles | None, typer.Option(help="What is asked; default: all that can be told.")
    ] = None,
    yaw_deg: Annotated[
        float | None, typer.Option(help="Yaw of the platform, known, degrees.")
    ] = None,
    pitch_deg: Annotated[
        float | None, typer.Option(help="Pitch, where that is known too, degrees.")
    ] = None,
    gravity: Annotated[
        bool, typer.Option("--gravity", help="All three angles, by the accelerometer, at rest.")
    ] = False,
    raw: Raw = False,
    step: EpochStep = None,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Find roll, or roll and pitch, from the Earth's field, by a database or in closed form."""
    job = log_job("match", log, site, output, None, None, 50.0, start, end, topics)
    settings = MatchSettings(
        database=database,
        method=None if method is None else method.value,
        angles=None if angles is None else angles.value,
        pitch_deg=pitch_deg,
        yaw_deg=yaw_deg,
        gravity=gravity,
        sampling=Sampling(raw, step),
    )
    show_result(run_match(job, settings), job.output, as_json)
