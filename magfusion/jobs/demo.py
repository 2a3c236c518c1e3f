"""The demonstration: simulate a walk among four beacons and smooth it."""

import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from magfusion.jobs.settings import Command, RandomSettings, option
from magfusion.jobs.simulate import run_simulate
from magfusion.jobs.smooth import run_smooth
from magfusion.model.progress import Report, quiet
from magfusion.results.figures import Figures
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.simulation.motion import Rests


@dataclass(frozen=True, kw_only=True)
class DemoSettings(RandomSettings):
    """Settings of the demonstration."""

    show: bool = option(True, "Open the recording in the viewer")
    duration: float = option(120.0, "Length of the walk", unit="s", least=5.0, most=3600.0)


def run_demo(settings: DemoSettings, output: Path, report: Report = quiet) -> Figures:
    """Simulate a walk among the demo's beacons, smooth it, and write the result."""
    from magfusion.estimation.batch.batch import SmootherSettings
    from magfusion.jobs.inputs import Job

    site = demo_site()
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=settings.duration,
        motion="walk",
        rests=Rests(start=3.0, move=20.0, pause=2.0),
        random_field=site.model_error,
    )
    with TemporaryDirectory() as directory:
        log = Path(directory) / "log"
        run_simulate(site, config, log, settings.seed)
        return run_smooth(Job(log, None, output), SmootherSettings(), report=report)


def _show(settings: DemoSettings, output: Path) -> None:
    if settings.show and sys.stdout.isatty():
        from magfusion.results.recording import open_viewer

        open_viewer(output / "run.rrd")


COMMAND = Command(
    DemoSettings, run_demo, output="magfusion_demo", after=_show, example="magfusion demo"
)
