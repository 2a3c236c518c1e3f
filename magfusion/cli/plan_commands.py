"""Commands that take a site."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from magfusion.cli.app import AsJson, Output, Window, app, show_result
from magfusion.jobs.coverage import CoverageSettings, run_coverage
from magfusion.options import box_option, check_simulation
from magfusion.pipeline import run_simulate
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.site_file import load_site


class MotionKind(StrEnum):
    """Simulated motion."""

    WALK = "walk"
    TURN = "turn"
    STATIC = "static"


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
    iron: Annotated[
        int,
        typer.Option(min=0, max=200, help="Steel spheres about the room, 0.5 m from it or more."),
    ] = 0,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate a log, with truth, in the files a user has."""
    check_simulation(duration, 1.0, 1e6, seed)
    declared = demo_site() if site is None else load_site(site)
    config = SimulationConfig(
        box_world=box_option(box),
        duration=duration,
        motion=motion.value,
        perturb=perturb,
        iron=iron,
    )
    figures = run_simulate(declared, config, output, seed)
    show_result(figures, output, as_json)


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
    show_result(run_coverage(site, settings, output), output, as_json)
