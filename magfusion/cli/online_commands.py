"""Commands that navigate as the data come, and the one that lets a log come as data."""

import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

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
from magfusion.fusion.online import NavigatorSettings
from magfusion.jobs.navigate import NavigateSettings, run_navigate
from magfusion.jobs.stream import StreamSettings, run_replay, run_stream, until_closed
from magfusion.options import groups_option, lockin_option, topics_option
from magfusion.parameters import GROUPS
from magfusion.receiver.windows import default_settings
from magfusion.records.open import open_log
from magfusion.site_file import load_site

STREAM = Path("-")


class Estimator(StrEnum):
    """What navigates."""

    SMOOTHER = "smoother"
    EKF = "ekf"


class RecordFormat(StrEnum):
    """Of records in a pipe."""

    JSON = "json"
    MSGPACK = "msgpack"


RecordsAs = Annotated[RecordFormat, typer.Option("--format", help="Records in the pipe.")]
Realtime = Annotated[bool, typer.Option("--realtime", help="Pace by the log's clock.")]


@app.command()
def navigate(
    log: Annotated[Path, typer.Argument(help="Log to replay, or - for records on standard input.")],
    output: JobOutput = None,
    site: SitePath = None,
    estimator: Annotated[
        Estimator, typer.Option(help="Fixed-lag smoother, or Kalman filter.")
    ] = Estimator.SMOOTHER,
    lag: Annotated[float, typer.Option(help="Window of the smoother, s.")] = 4.0,
    delay: Annotated[
        float, typer.Option(help="How late samples may come, s; so much later are states.")
    ] = 0.0,
    estimate: Annotated[
        str | None,
        typer.Option(
            help=f"Calibration to estimate: any of {','.join(GROUPS)}, or none; "
            "default: what the site's sigmas leave open."
        ),
    ] = None,
    earth: Earth = False,
    realtime: Realtime = False,
    live: Annotated[bool, typer.Option("--live", help="Show the states in the viewer.")] = False,
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="File to go on from; default: in the output while the job runs."),
    ] = None,
    every: Annotated[float, typer.Option(help="Between checkpoints, s.")] = 30.0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint, if there is one.")
    ] = False,
    form: RecordsAs = RecordFormat.JSON,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Count bad records, and pass over them.")
    ] = False,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Navigate as the data come: along a log, or by records on standard input (-)."""
    _check(lag, delay, every)
    chosen = NavigatorSettings(
        estimator=estimator.value,
        lag=lag,
        delay=delay,
        estimate=groups_option(estimate),
        earth=earth,
    )
    if log == STREAM:
        if site is None:
            raise InputError("navigate - needs the site's file; name it with --site SITE.yaml")
        given = (output, start, end, topics, realtime or None, as_json or None)
        if any(value is not None for value in given):
            raise InputError(
                "--output, --start, --end, --topics, --realtime and --json belong to a log;"
                " leave them out with -"
            )
        if not (window is None and step is None and mains_hz == 50.0):
            usual = default_settings(load_site(site), mains_hz).window
            lockin = lockin_option(usual, window, step, mains_hz)
            chosen = replace(chosen, lockin=lockin)
        streamed = StreamSettings(chosen, form.value, keep_going, live, checkpoint, every, resume)
        with until_closed():
            run_stream(site, streamed, sys.stdin.buffer, sys.stdout.buffer, sys.stderr)
        return
    if keep_going or form is not RecordFormat.JSON:
        raise InputError("--keep-going and --format belong to a stream; give - in place of a log")
    job = log_job("navigate", log, site, output, window, step, mains_hz, start, end, topics)
    settings = NavigateSettings(
        replace(chosen, lockin=job.lockin), realtime, live, resume, checkpoint, every
    )
    with progress() as report:
        figures = run_navigate(job, settings, report)
    show_result(figures, job.output, as_json)


def _check(lag: float, delay: float, every: float) -> None:
    for name, value, least, most in (
        ("--lag", lag, 0.5, 60.0),
        ("--delay", delay, 0.0, 10.0),
        ("--every", every, 0.1, 86400.0),
    ):
        if not least <= value <= most:
            raise InputError(f"{name} must lie between {least:g} and {most:g} s; got {value:g}")


@app.command()
def replay(
    log: LogPath,
    form: RecordsAs = RecordFormat.JSON,
    realtime: Realtime = False,
    start: Start = None,
    end: End = None,
    topics: TopicNames = None,
) -> None:
    """Print a log as the records that magfusion navigate - reads."""
    found = open_log(log, start, end, topics_option(topics))
    with until_closed():
        run_replay(found, sys.stdout.buffer, form.value, realtime)
