"""Commands that take a log."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from magfusion.cli.app import (
    AsJson,
    Earth,
    End,
    JobOutput,
    LogPath,
    MainsHz,
    SitePath,
    Start,
    Step,
    TopicNames,
    Window,
    app,
    log_job,
    progress,
    show_result,
)
from magfusion.errors import InputError
from magfusion.fixes.published import Method
from magfusion.fusion.batch import SmootherSettings
from magfusion.jobs.published import run_published_fix
from magfusion.jobs.survey import SurveySettings, run_survey
from magfusion.options import check_fix, free_option, groups_option
from magfusion.parameters import GROUPS
from magfusion.pipeline import run_demodulate, run_fix, run_smooth


class Coupling(StrEnum):
    """What enters the graph."""

    TIGHT = "tight"
    LOOSE = "loose"


class Robust(StrEnum):
    """Robust loss."""

    NONE = "none"
    HUBER = "huber"
    CAUCHY = "cauchy"


class FixMethod(StrEnum):
    """How an epoch is located."""

    LIKELIHOOD = "likelihood"
    PAPER_LINES = "paper-lines"
    PAPER_KNN = "paper-knn"
    PAPER_KNN_NT = "paper-knn-nt"
    PAPER_FINGERPRINT = "paper-fingerprint"


class SurveyPoints(StrEnum):
    """What becomes a point of a survey."""

    RESTS = "rests"
    EPOCHS = "epochs"


class Rate(StrEnum):
    """Rate of the written trajectory."""

    FIELD = "field"
    IMU = "imu"


@app.command()
def smooth(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    coupling: Annotated[Coupling, typer.Option(help="Phasors or fixes in the graph.")] = (
        Coupling.TIGHT
    ),
    robust: Annotated[Robust, typer.Option(help="Robust loss of the fields.")] = Robust.NONE,
    estimate: Annotated[
        str | None,
        typer.Option(
            help=f"Calibration to estimate: any of {','.join(GROUPS)}, or none; "
            "default: what the site's sigmas leave open."
        ),
    ] = None,
    earth: Earth = False,
    rate: Annotated[Rate, typer.Option(help="Epochs of the written trajectory.")] = Rate.FIELD,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Smooth a log into the best trajectory, with the calibration in the same solution."""
    if earth and coupling is Coupling.LOOSE:
        raise InputError("--earth needs the phasors themselves; leave --coupling loose out")
    job = log_job("smooth", log, site, output, window, step, mains_hz, start, end, topics)
    settings = SmootherSettings(
        coupling=coupling.value,
        loss=None if robust is Robust.NONE else robust.value,
        estimate=groups_option(estimate),
        earth=earth,
    )
    with progress() as report:
        figures = run_smooth(job, settings, imu_rate=rate is Rate.IMU, report=report)
    show_result(figures, job.output, as_json)


@app.command()
def fix(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    method: Annotated[
        FixMethod, typer.Option(help="Maximum likelihood, or an algorithm of paper 004.")
    ] = FixMethod.LIKELIHOOD,
    survey: Annotated[
        Path | None, typer.Option(help="Fingerprint survey, which the paper's methods need.")
    ] = None,
    block: Annotated[
        float | None, typer.Option(help="Of paper-lines: a line for each block of this size, m.")
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            metavar="phase,gain",
            help="Find these of every beacon beside the pose, whatever the site says of them.",
        ),
    ] = None,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Fix the pose at every epoch on its own, with every hypothesis that survives."""
    job = log_job("fix", log, site, output, window, step, mains_hz, start, end, topics)
    chosen: Literal["likelihood"] | Method = method.value
    check_fix(chosen, survey, block, free)
    beside = free_option(free)
    if chosen == "likelihood":
        with progress() as report:
            figures = run_fix(job, free=beside, report=report)
    else:
        figures = run_published_fix(job, chosen, survey, block)
    show_result(figures, job.output, as_json)


@app.command()
def demodulate(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Turn a log's waveform into phasors: a log that every other command reads."""
    job = log_job("demodulate", log, site, output, window, step, mains_hz, start, end, topics)
    with progress() as report:
        figures = run_demodulate(job, report=report)
    show_result(figures, job.output, as_json)


@app.command()
def survey(
    log: LogPath,
    output: JobOutput = None,
    site: SitePath = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Result, TUM file or table with the poses; default: the log's truth."),
    ] = None,
    points: Annotated[SurveyPoints, typer.Option(help="One point a stop, or one an epoch.")] = (
        SurveyPoints.RESTS
    ),
    spacing: Annotated[float, typer.Option(help="Least distance of two points, m.")] = 0.0,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Make a fingerprint survey of a log: the fields at places with known poses."""
    job = log_job("survey", log, site, output, window, step, mains_hz, start, end, topics)
    figures = run_survey(job, SurveySettings(points.value, spacing, trajectory))
    show_result(figures, job.output, as_json)
