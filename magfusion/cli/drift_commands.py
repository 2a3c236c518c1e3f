"""The command that tries the online estimators for days."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from magfusion.cli.app import AsJson, Output, app, progress, show_result
from magfusion.jobs.drift import ESTIMATORS, DriftSettings, run_drift
from magfusion.jobs.drift_world import Estimator


class Tried(StrEnum):
    """Estimators."""

    BOTH = "both"
    EKF = "ekf"
    SMOOTHER = "smoother"

    @property
    def estimators(self) -> tuple[Estimator, ...]:
        """Names of the estimators."""
        return tuple(e for e in ESTIMATORS if self in (Tried.BOTH, e))


class Drive(StrEnum):
    """How coils are driven."""

    CURRENT = "current"
    VOLTAGE = "voltage"


class Phase(StrEnum):
    """Of the drives."""

    FREE = "free"
    KNOWN = "known"


@app.command()
def drift(
    output: Output = Path("drift"),
    hours: Annotated[float, typer.Option(help="Simulated length, h.")] = 48.0,
    estimator: Annotated[Tried, typer.Option(help="What navigates.")] = Tried.BOTH,
    worlds: Annotated[int, typer.Option(help="Independent worlds; 8 for a firm verdict.")] = 1,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    drive: Annotated[
        Drive, typer.Option(help="A voltage drives less current through warm coils.")
    ] = Drive.CURRENT,
    phase: Annotated[
        Phase, typer.Option(help="Declared of the drives: own clocks, or synchronised.")
    ] = Phase.FREE,
    clock_ppm: Annotated[
        float, typer.Option(help="Error of the drives' common clock; with --phase known: a trap.")
    ] = 0.0,
    cluster: Annotated[
        str | None,
        typer.Option(help="Dask scheduler, tcp://host:8786, whose workers see the results."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; default: one a core.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with what was interrupted.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Prove that the online estimators do not drift: days of simulated data, judged."""
    settings = DriftSettings(
        hours=hours,
        estimators=estimator.estimators,
        worlds=worlds,
        seed=seed,
        drive=drive.value,
        phase_known=phase is Phase.KNOWN,
        clock_ppm=clock_ppm,
        cluster=cluster,
        workers=workers,
        resume=resume,
    )
    with progress() as report:
        figures = run_drift(settings, output, report)
    show_result(figures, output, as_json)
