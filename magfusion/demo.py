"""The demonstration: simulate a walk among four beacons and smooth it."""

from pathlib import Path
from tempfile import TemporaryDirectory

from magfusion.fusion.batch import SmootherSettings
from magfusion.job import Job
from magfusion.pipeline import Report, run_simulate, run_smooth
from magfusion.report import Figures
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig
from magfusion.simulation.motion import Rests


def run_demo(output: Path, seed: int, duration: float, report: Report) -> Figures:
    """Simulate a walk among the demo's beacons, smooth it, and write the result.

    Parameters
    ----------
    output : Path
        Directory of the result.
    seed : int
    duration : float
        (s)
    report : callable
        Told of the progress.

    Returns
    -------
    dict
        The figures of ``report.json``.
    """
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=duration,
        motion="walk",
        rests=Rests(start=3.0, move=20.0, pause=2.0),
    )
    with TemporaryDirectory() as directory:
        log = Path(directory) / "log"
        run_simulate(demo_site(), config, log, seed)
        return run_smooth(Job(log, None, output), SmootherSettings(), report=report)
