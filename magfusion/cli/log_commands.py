"""Commands that take a log."""

from enum import StrEnum
from typing import Annotated

import typer

from magfusion.cli.app import (
    AsJson,
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
from magfusion.fusion.batch import SmootherSettings
from magfusion.options import groups_option
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
    job = log_job("smooth", log, site, output, window, step, mains_hz, start, end, topics)
    settings = SmootherSettings(
        coupling=coupling.value,
        loss=None if robust is Robust.NONE else robust.value,
        estimate=groups_option(estimate),
    )
    with progress() as report:
        figures = run_smooth(job, settings, imu_rate=rate is Rate.IMU, report=report)
    show_result(figures, job.output, as_json)


@app.command()
def fix(
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
    """Fix the pose at every epoch on its own, with every hypothesis that survives."""
    job = log_job("fix", log, site, output, window, step, mains_hz, start, end, topics)
    with progress() as report:
        figures = run_fix(job, report=report)
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
