"""Commands that take a result, and the demo that makes one: evaluate, view, demo."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from magfusion.cli.app import AsJson, Output, TopicNames, app, progress, show_result
from magfusion.demo import run_demo
from magfusion.errors import InputError
from magfusion.options import check_simulation, topics_option
from magfusion.pipeline import run_evaluate
from magfusion.view import open_viewer


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Result directory, TUM file or table.")],
    truth: Annotated[Path, typer.Argument(help="Log with truth, TUM file or table.")],
    topics: TopicNames = None,
    as_json: AsJson = False,
) -> None:
    """Compare a trajectory with a truth: ATE, RPE and attitude, absolute and aligned."""
    show_result(run_evaluate(estimate, truth, topics_option(topics)), None, as_json)


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
    show_result(figures, output, as_json)
    if show and Console().is_terminal:
        open_viewer(output / "run.rrd")
