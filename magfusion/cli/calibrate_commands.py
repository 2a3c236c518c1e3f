"""`magfusion calibrate ...`: commands that refine a site."""

from pathlib import Path
from typing import Annotated

import typer

from magfusion.cli.app import AsJson, Output, calibrate, progress, show_result
from magfusion.jobs.calibrate_fieldmap import MapSource, run_calibrate_fieldmap


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
        typer.Option(help="Of a log: result of smooth, or a table; default: the log's truth."),
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
