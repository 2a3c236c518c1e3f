"""The job that proves, or disproves, that an online estimator stands for days."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError
from magfusion.evaluation.drift import Course, Verdict, settled_after
from magfusion.files import whole_file
from magfusion.job import UNFINISHED_DRIFT, claim
from magfusion.jobs.drift_figures import MINUTE, Finding, judged, minutes
from magfusion.jobs.drift_world import (
    Estimator,
    WorldRun,
    WorldTask,
    forget,
    run_world,
    stretches_done,
)
from magfusion.monte_carlo import run_many
from magfusion.plots.drift import write_plot, write_stability
from magfusion.report import Figures, write_report
from magfusion.view_drift import write_drift_recording

ESTIMATORS: tuple[Estimator, ...] = ("ekf", "smoother")
SHORTEST, LONGEST = 0.1, 1000.0  # h
LOOK = 1.0  # s between two looks at how far the runs are
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class DriftSettings:
    """What is tried.

    Parameters
    ----------
    hours : float
    estimators : tuple of str
        Of `ESTIMATORS`.
    worlds : int
    seed : int
    drive : {'current', 'voltage'}
        How the coils are driven, and so what their heat does to their moments.
    phase_known : bool
        Declare the drives synchronised.  Together with a clock error: what the test must find.
    clock_ppm : float
        Error of the clock that all drives share.
    cluster : str, optional
        Address of a Dask scheduler, whose workers see the directory of the results.
    workers : int, optional
    resume : bool
        Go on with the runs that are unfinished in the directory.
    """

    hours: float = 48.0
    estimators: tuple[Estimator, ...] = ESTIMATORS
    worlds: int = 1
    seed: int = 0
    drive: str = "current"
    phase_known: bool = False
    clock_ppm: float = 0.0
    cluster: str | None = None
    workers: int | None = None
    resume: bool = False

    def check(self) -> None:
        """Refuse what cannot be run.

        Raises
        ------
        InputError
        """
        if not SHORTEST <= self.hours <= LONGEST:
            raise InputError(f"--hours must lie between 0.1 and 1000; got {self.hours:g}")
        if not 1 <= self.worlds <= 10_000:
            raise InputError(f"--worlds must lie between 1 and 10000; got {self.worlds}")
        if self.seed < 0:
            raise InputError(f"--seed must not be negative; got {self.seed}")
        if not abs(self.clock_ppm) <= 100.0:
            raise InputError(f"--clock-ppm must lie within 100; got {self.clock_ppm:g}")

    @property
    def key(self) -> dict[str, object]:
        """What two runs share that may go on from each other's."""
        return {
            "hours": self.hours,
            "seed": self.seed,
            "drive": self.drive,
            "phase_known": self.phase_known,
            "clock_ppm": self.clock_ppm,
        }

    def tasks(self, place: Path) -> list[WorldTask]:
        """Return all runs."""
        return [
            WorldTask(
                world=world,
                estimator=estimator,
                hours=self.hours,
                seed=self.seed,
                drive=self.drive,
                phase_known=self.phase_known,
                clock_rate=1e-6 * self.clock_ppm,
                place=str(place),
            )
            for world in range(self.worlds)
            for estimator in self.estimators
        ]


def run_drift(settings: DriftSettings, output: Path, report: Report | None = None) -> Figures:
    """Run estimators through days of simulated worlds and judge them.

    Until all is done, ``output`` holds what is needed to go on.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where the settings do not fit, or ``output`` is in the way.
    EstimationError
        Where an estimator finds no start.
    """
    settings.check()
    claimed = claim(output, "drift")
    place = output.resolve() / UNFINISHED_DRIFT
    _prepare(place, settings)
    tasks = settings.tasks(place)
    with _told(place, tasks, report):
        runs = run_many(
            run_world,
            tasks,
            seed=settings.seed,
            cluster=settings.cluster,
            workers=settings.workers,
        )
    figures = summarise(settings, runs)
    drawn = courses(settings, runs)
    with claimed as directory:
        write_plot(directory / "drift.png", drawn, figures)
        write_stability(directory / "stability.png", drawn)
        write_drift_recording(directory / "run.rrd", drawn, figures)
        write_report(directory, figures)
    return figures


def summarise(settings: DriftSettings, runs: list[WorldRun]) -> Figures:
    """Return the figures of all runs, the verdict first, and the findings in words."""
    figures: Figures = {}
    findings: list[Finding] = []
    for estimator in settings.estimators:
        own = [run for run in runs if run.task.estimator == estimator]
        found, told = judged(estimator, own)
        figures |= found
        findings += told
    settled_h = settled_after(settings.hours) / 3600.0
    head: Figures = {
        "job": "drift",
        "log": f"{settings.hours:g} h in {settings.worlds} world(s)",
        "verdict": overall([f.verdict for f in findings]),
        "hours": settings.hours,
        "worlds": settings.worlds,
        "seed": settings.seed,
        "drive": settings.drive,
        "phase": "known" if settings.phase_known else "free",
        "clock_ppm": settings.clock_ppm,
        "settled_after_h": settled_h,
    }
    notes = [f"{f.verdict.upper()}: {f.sentence}." for f in findings]
    return {**head, **figures, "notes": notes}


def overall(verdicts: list[Verdict]) -> Verdict:
    """Return the worst."""
    order: tuple[Verdict, ...] = ("fail", "undecided", "pass")
    return min(verdicts, key=order.index)


def courses(settings: DriftSettings, runs: list[WorldRun]) -> list[Course]:
    """Return what is drawn of each estimator: its errors, and its pace in the first world."""
    out = []
    for estimator in settings.estimators:
        own = [r for r in runs if r.task.estimator == estimator]
        out.append(Course(estimator, tuple(minutes(r) for r in own), MINUTE, own[0].pace))
    return out


def _prepare(place: Path, settings: DriftSettings) -> None:
    """Make the directory of what is unfinished, or see that it is of these settings."""
    told = place / "settings.json"
    if settings.resume and told.is_file():
        if json.loads(told.read_text()) != settings.key:
            raise InputError(
                f"{place}: holds runs of other settings; repeat the command as it was, or run"
                " without --resume"
            )
        return
    forget(place)
    place.mkdir(parents=True)
    with whole_file(told) as unfinished:
        unfinished.write_text(json.dumps(settings.key) + "\n")


@contextmanager
def _told(place: Path, tasks: list[WorldTask], report: Report | None) -> Iterator[None]:
    """Tell how far the runs are while they run, wherever they do."""
    if report is None:
        yield
        return
    tell, stop, total = report, threading.Event(), sum(t.stretches for t in tasks)

    def look() -> None:
        while not stop.wait(LOOK):
            tell("navigating", stretches_done(place), total)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
