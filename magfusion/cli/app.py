"""What all commands share: the application, the usual options, progress, the result shown."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from magfusion.errors import InputError
from magfusion.job import Job, read_job
from magfusion.options import lockin_option, topics_option
from magfusion.pipeline import Report
from magfusion.receiver.slots import has_schedule, slot_lockin
from magfusion.receiver.windows import default_settings
from magfusion.report import Figures
from magfusion.screen import show as show_figures

app = typer.Typer(
    help="Navigation from magnetic beacons and inertial sensors where there is no GNSS.",
    pretty_exceptions_enable=False,
    add_completion=False,
)
calibrate = typer.Typer(help="Calibrate what the estimators take for known.")
app.add_typer(calibrate, name="calibrate")


LogPath = Annotated[Path, typer.Argument(help="Log: a directory, a EuRoC folder, or a ROS 2 bag.")]
SitePath = Annotated[
    Path | None, typer.Option("--site", help="Site file; default: site.yaml in the log.")
]
Output = Annotated[Path, typer.Option("--output", "-o", help="Directory of the results.")]
JobOutput = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", help="Directory of the results; default: the log's name and the job's."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as the last line.")]
Window = Annotated[
    float | None, typer.Option(help="Lock-in window, s; default: from the tones' spacing.")
]
Step = Annotated[float | None, typer.Option(help="Distance of windows, s; default: half a window.")]
MainsHz = Annotated[float, typer.Option(help="Mains frequency, Hz; 0 for none.")]
Start = Annotated[float | None, typer.Option(help="Use the log from here, s since its epoch.")]
End = Annotated[float | None, typer.Option(help="Use the log up to here, s since its epoch.")]
TopicNames = Annotated[
    str | None,
    typer.Option(
        "--topics",
        metavar="ROLE=NAME,...",
        help="Topics of a bag that has several, e.g. imu=/imu/data,magnetometer=/mag,truth=/odom.",
    ),
]


@contextmanager
def progress() -> Iterator[Report]:
    """Yield a progress reporter: a bar on a terminal, nothing otherwise."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _stage, _done, _total: None
        return
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    )
    with bar:
        task = bar.add_task("starting", total=None)

        def report(stage: str, done: int, total: int) -> None:
            bar.update(task, description=stage, completed=done, total=total)

        yield report


Earth = Annotated[
    bool,
    typer.Option(
        "--earth", help="Measure the Earth field too: it holds the heading where no beacon does."
    ),
]


def log_job(
    name: str,
    log: Path,
    site: Path | None,
    output: Path | None,
    window: float | None,
    step: float | None,
    mains_hz: float,
    start: float | None,
    end: float | None,
    topics: str | None,
) -> Job:
    """Check the options that all jobs on a log share; name the result after log and job."""
    if not 0.0 <= mains_hz < 1e3:
        raise InputError(f"--mains-hz must lie between 0 and 1000 Hz; got {mains_hz:g}")
    if start is not None and end is not None and not start < end:
        raise InputError(f"--start must come before --end; got {start:g} and {end:g}")
    place = Path(f"{log.resolve().name}_{name}") if output is None else output
    job = Job(log, site, place, None, start, end, topics_option(topics))
    if window is None and step is None and mains_hz == 50.0:
        return job
    declared = read_job(job, unknown=True)[1]
    usual = slot_lockin if has_schedule(declared) else default_settings
    return replace(
        job, lockin=lockin_option(usual(declared, mains_hz).window, window, step, mains_hz)
    )


def show_result(figures: Figures, output: Path | None, as_json: bool) -> None:
    """Show the figures of a job as a table, and as the last line in JSON where that is asked."""
    show_figures(figures, output)
    if as_json:
        sys.stdout.write(json.dumps(figures, default=float) + "\n")


def _print_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"magfusion {version('magfusion')}\n")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help="Tell the version."),
    ] = False,
) -> None:
    """Navigate by magnetic beacons and inertial sensors where there is no GNSS."""
