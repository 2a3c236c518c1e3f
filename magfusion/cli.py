"""The face: one command a job, no logic."""

import errno
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from magfusion.coverage_job import CoverageSettings, run_coverage
from magfusion.demo import run_demo
from magfusion.errors import EstimationError, InputError
from magfusion.fusion.batch import SmootherSettings
from magfusion.job import Job, read_job
from magfusion.options import (
    box_option,
    check_simulation,
    groups_option,
    lockin_option,
    topics_option,
)
from magfusion.parameters import GROUPS
from magfusion.pipeline import (
    Report,
    run_demodulate,
    run_evaluate,
    run_fix,
    run_simulate,
    run_smooth,
)
from magfusion.receiver.windows import default_settings
from magfusion.report import Figures
from magfusion.screen import show as show_figures
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.site_file import load_site
from magfusion.view import open_viewer

app = typer.Typer(
    help="Navigation from magnetic beacons and inertial sensors where there is no GNSS.",
    pretty_exceptions_enable=False,
    add_completion=False,
)


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


class MotionKind(StrEnum):
    """Simulated motion."""

    WALK = "walk"
    TURN = "turn"
    STATIC = "static"


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


def _job(
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
    if not 0.0 <= mains_hz < 1e3:
        raise InputError(f"--mains-hz must lie between 0 and 1000 Hz; got {mains_hz:g}")
    if start is not None and end is not None and not start < end:
        raise InputError(f"--start must come before --end; got {start:g} and {end:g}")
    place = Path(f"{log.resolve().name}_{name}") if output is None else output
    job = Job(log, site, place, None, start, end, topics_option(topics))
    if window is None and step is None and mains_hz == 50.0:
        return job
    usual = default_settings(read_job(job)[1], mains_hz).window
    return replace(job, lockin=lockin_option(usual, window, step, mains_hz))


def _show(figures: Figures, output: Path | None, as_json: bool) -> None:
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
    job = _job("smooth", log, site, output, window, step, mains_hz, start, end, topics)
    settings = SmootherSettings(
        coupling=coupling.value,
        loss=None if robust is Robust.NONE else robust.value,
        estimate=groups_option(estimate),
    )
    with progress() as report:
        figures = run_smooth(job, settings, imu_rate=rate is Rate.IMU, report=report)
    _show(figures, job.output, as_json)


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
    job = _job("fix", log, site, output, window, step, mains_hz, start, end, topics)
    with progress() as report:
        figures = run_fix(job, report=report)
    _show(figures, job.output, as_json)


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
    job = _job("demodulate", log, site, output, window, step, mains_hz, start, end, topics)
    with progress() as report:
        figures = run_demodulate(job, report=report)
    _show(figures, job.output, as_json)


@app.command()
def simulate(
    output: Output,
    site: Annotated[
        Path | None, typer.Option("--site", help="Site file; default: the demo's four beacons.")
    ] = None,
    motion: Annotated[MotionKind, typer.Option(help="How the platform moves.")] = MotionKind.WALK,
    duration: Annotated[float, typer.Option(help="Length, s.")] = 120.0,
    box: Annotated[
        str | None,
        typer.Option(help="Room to move in, m: xmin,xmax,ymin,ymax,zmin,zmax."),
    ] = None,
    perturb: Annotated[
        bool, typer.Option(help="Draw the true calibration from the site's sigmas.")
    ] = True,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate a log, with truth, in the files a user has."""
    check_simulation(duration, 1.0, 1e6, seed)
    declared = demo_site() if site is None else load_site(site)
    config = SimulationConfig(
        box_world=box_option(box), duration=duration, motion=motion.value, perturb=perturb
    )
    figures = run_simulate(declared, config, output, seed)
    _show(figures, output, as_json)


@app.command()
def coverage(
    site: Annotated[Path, typer.Argument(help="Site file of the installation.")],
    output: Output = Path("coverage"),
    box: Annotated[
        str | None,
        typer.Option(help="Volume, m: xmin,xmax,ymin,ymax,zmin,zmax; default: about the beacons."),
    ] = None,
    height: Annotated[float | None, typer.Option(help="A single height, m.")] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Of the points, m; default: a twentieth of the volume.")
    ] = None,
    window: Window = None,
    extra_beacon: Annotated[
        bool, typer.Option("--extra-beacon", help="Find where one more beacon adds most.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Tell where an installation can navigate: the best position and attitude over a volume."""
    limits = None if box is None else box_option(box)
    settings = CoverageSettings(limits, height, spacing, window, extra_beacon)
    _show(run_coverage(site, settings, output), output, as_json)


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Result directory, TUM file or table.")],
    truth: Annotated[Path, typer.Argument(help="Log with truth, TUM file or table.")],
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Compare a trajectory with a truth: ATE, RPE and attitude, absolute and aligned."""
    _show(run_evaluate(estimate, truth, topics_option(topics)), None, as_json)


@app.command()
def view(
    result: Annotated[Path, typer.Argument(help="Result directory, or its run.rrd.")],
) -> None:
    """Open the recording of a result in the rerun viewer."""
    path = result / "run.rrd" if result.is_dir() else result
    if not path.is_file():
        raise InputError(f"{path}: no recording there; run magfusion smooth first")
    with path.open("rb") as stream:
        if stream.read(3) != b"RRF":
            raise InputError(f"{path}: is no recording; give a result's directory or its run.rrd")
    open_viewer(path)


@app.command()
def demo(
    output: Output = Path("magfusion_demo"),
    show: Annotated[bool, typer.Option(help="Open the recording in the viewer.")] = True,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    duration: Annotated[float, typer.Option(help="Length of the walk, s.")] = 120.0,
    as_json: AsJson = False,
) -> None:
    """Simulate a two-minute walk among four beacons, smooth it, and show the result."""
    check_simulation(duration, 5.0, 3600.0, seed)
    with progress() as report:
        figures = run_demo(output, seed, duration, report)
    _show(figures, output, as_json)
    if show and Console().is_terminal:
        open_viewer(output / "run.rrd")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line.

    Exits with 0 and the result; with 2 and one sentence for bad input or usage; with 1 and one
    sentence for an estimator that failed; with 130 where the user interrupted.
    """
    given = sys.argv[1:] if arguments is None else arguments
    try:
        status = app(args=given or ["--help"], prog_name="magfusion", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        command = "magfusion" if context is None else context.command_path
        _fail(2, f"{error.format_message().rstrip('.')}; see {command} --help")
    except InputError as error:
        _fail(2, str(error))
    except EstimationError as error:
        _fail(1, str(error))
    except OSError as error:
        _fail(2, _told(error))
    except MemoryError:
        _fail(2, "the memory does not suffice; use a shorter part, by --start and --end")
    raise SystemExit(status)


def _told(error: OSError) -> str:
    place = error.filename if error.filename is not None else "a file"
    remedy = "free some space" if error.errno == errno.ENOSPC else "allow it, or give another path"
    return f"{place}: cannot be read or written ({error.strerror or error}); {remedy}"


def _fail(status: int, sentence: str) -> NoReturn:
    sys.stderr.write(f"magfusion: {' '.join(sentence.split())}\n")
    raise SystemExit(status) from None
