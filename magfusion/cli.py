"""The face: one command a job, no logic."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from magfusion.demo import run_demo
from magfusion.errors import EstimationError, InputError
from magfusion.fusion.batch import SmootherSettings
from magfusion.parameters import GROUPS
from magfusion.pipeline import (
    Job,
    Report,
    read_job,
    run_demodulate,
    run_evaluate,
    run_fix,
    run_simulate,
    run_smooth,
)
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.report import Figures
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.site_file import load_site
from magfusion.view import open_viewer

app = typer.Typer(
    help="Navigation from magnetic beacons and inertial sensors where there is no GNSS.",
    no_args_is_help=True,
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
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as the last line.")]
Window = Annotated[
    float | None, typer.Option(help="Lock-in window, s; default: from the tones' spacing.")
]
Step = Annotated[float | None, typer.Option(help="Distance of windows, s; default: half a window.")]
MainsHz = Annotated[float, typer.Option(help="Mains frequency, Hz; 0 for none.")]
Start = Annotated[float | None, typer.Option(help="Use the log from here, s since its epoch.")]
End = Annotated[float | None, typer.Option(help="Use the log up to here, s since its epoch.")]


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
    log: Path,
    site: Path | None,
    output: Path,
    window: float | None,
    step: float | None,
    mains_hz: float,
    start: float | None,
    end: float | None,
) -> Job:
    for name, value in (("--window", window), ("--step", step)):
        if value is not None and not 0.0 < value < 60.0:
            raise InputError(f"{name} must lie between 0 and 60 s; got {value:g}")
    if not 0.0 <= mains_hz < 1e3:
        raise InputError(f"--mains-hz must lie between 0 and 1000 Hz; got {mains_hz:g}")
    if start is not None and end is not None and not start < end:
        raise InputError(f"--start must come before --end; got {start:g} and {end:g}")
    job = Job(log, site, output, None, start, end)
    if window is None and step is None and mains_hz == 50.0:
        return job
    chosen = default_settings(read_job(job)[1], mains_hz)
    length = chosen.window if window is None else window
    lockin = LockinSettings(length, length / 2.0 if step is None else step, mains_hz)
    return Job(log, site, output, lockin, start, end)


def _groups(estimate: str | None) -> tuple[str, ...] | None:
    if estimate is None:
        return None
    chosen = tuple(part.strip() for part in estimate.split(",") if part.strip())
    if chosen == ("none",):
        return ()
    unknown = [group for group in chosen if group not in GROUPS]
    if unknown or not chosen:
        raise InputError(
            f"--estimate {estimate!r}: {', '.join(unknown) or 'nothing'} is not a calibration "
            f"group; choose from {', '.join(GROUPS)}, or none"
        )
    return chosen


def _show(figures: Figures, output: Path | None, as_json: bool) -> None:
    table = Table(show_header=False, box=None)
    for key, value in figures.items():
        if isinstance(value, list):
            table.add_row(key, f"{len(value)} parameters" if value else "none")
        elif "." not in key:
            table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    console = Console()
    console.print(table)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True, highlight=False)
    if as_json:
        sys.stdout.write(json.dumps(figures, default=float) + "\n")


@app.command()
def smooth(
    log: LogPath,
    output: Output,
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
    as_json: AsJson = False,
) -> None:
    """Smooth a log into the best trajectory, with the calibration in the same solution."""
    job = _job(log, site, output, window, step, mains_hz, start, end)
    settings = SmootherSettings(
        coupling=coupling.value,
        loss=None if robust is Robust.NONE else robust.value,
        estimate=_groups(estimate),
    )
    with progress() as report:
        figures = run_smooth(job, settings, imu_rate=rate is Rate.IMU, report=report)
    _show(figures, output, as_json)


@app.command()
def fix(
    log: LogPath,
    output: Output,
    site: SitePath = None,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    as_json: AsJson = False,
) -> None:
    """Fix the pose at every epoch on its own, with every hypothesis that survives."""
    job = _job(log, site, output, window, step, mains_hz, start, end)
    with progress() as report:
        figures = run_fix(job, report=report)
    _show(figures, output, as_json)


@app.command()
def demodulate(
    log: LogPath,
    output: Output,
    site: SitePath = None,
    window: Window = None,
    step: Step = None,
    mains_hz: MainsHz = 50.0,
    start: Start = None,
    end: End = None,
    as_json: AsJson = False,
) -> None:
    """Turn a log's waveform into phasors: a log that every other command reads."""
    job = _job(log, site, output, window, step, mains_hz, start, end)
    with progress() as report:
        figures = run_demodulate(job, report=report)
    _show(figures, output, as_json)


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
    if not 1.0 <= duration <= 1e6:
        raise InputError(f"--duration must lie between 1 and 1000000 s; got {duration:g}")
    if seed < 0:
        raise InputError(f"--seed must not be negative; got {seed}")
    declared = demo_site() if site is None else load_site(site)
    config = SimulationConfig(
        box_world=_box(box), duration=duration, motion=motion.value, perturb=perturb
    )
    figures = run_simulate(declared, config, output, seed)
    _show(figures, output, as_json)


def _box(text: str | None) -> np.ndarray:
    if text is None:
        return DEMO_BOX_WORLD
    try:
        box = np.array([float(part) for part in text.split(",")]).reshape(3, 2).T
    except ValueError:
        raise InputError(
            f"--box {text!r}: six numbers in metres are needed, x, y, z limits"
        ) from None
    if not np.all(np.isfinite(box)) or np.any(box[0] >= box[1]):
        raise InputError(f"--box {text!r}: each lower limit must be below its upper limit")
    return box


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Result directory, TUM file or table.")],
    truth: Annotated[Path, typer.Argument(help="Log with truth, TUM file or table.")],
    as_json: AsJson = False,
) -> None:
    """Compare a trajectory with a truth: ATE, RPE and attitude, absolute and aligned."""
    _show(run_evaluate(estimate, truth), None, as_json)


@app.command()
def view(
    result: Annotated[Path, typer.Argument(help="Result directory, or its run.rrd.")],
) -> None:
    """Open the recording of a result in the rerun viewer."""
    path = result / "run.rrd" if result.is_dir() else result
    if not path.is_file():
        raise InputError(f"{path}: no recording there; run magfusion smooth first")
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
    if not 5.0 <= duration <= 3600.0:
        raise InputError(f"--duration must lie between 5 and 3600 s; got {duration:g}")
    with progress() as report:
        figures = run_demo(output, seed, duration, report)
    _show(figures, output, as_json)
    if show and Console().is_terminal:
        open_viewer(output / "run.rrd")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line: exit 2 with one sentence for bad input, 1 for a failed estimator."""
    command: Callable[..., object] = app
    try:
        command(args=arguments)
    except InputError as error:
        sys.stderr.write(f"magfusion: {error}\n")
        raise SystemExit(2) from None
    except EstimationError as error:
        sys.stderr.write(f"magfusion: {error}\n")
        raise SystemExit(1) from None
