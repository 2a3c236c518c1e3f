"""The job that tests the stability of an online estimator over days."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from magfusion.errors import InputError
from magfusion.files.atomic import real
from magfusion.files.checkpoint import read_position
from magfusion.jobs.drift_conditions import Condition
from magfusion.jobs.settings import Command, RandomSettings, option
from magfusion.model.progress import Report
from magfusion.model.trust import Finding, Trust
from magfusion.results.drift import (
    QUANTITIES,
    Criterion,
    EstimatorPlot,
    Verdict,
    settled_after,
    worlds_text,
)
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.simulation.monte_carlo import run_many

if TYPE_CHECKING:
    from magfusion.jobs.drift_world import Estimator, WorldRun, WorldTask


ESTIMATORS: tuple[Estimator, ...] = ("ekf", "smoother")
MIN_HOURS, MAX_HOURS = 0.1, 1000.0  # h
LOOK = 1.0  # s between two looks at how far the runs are


@dataclass(frozen=True, kw_only=True)
class DriftSettings(RandomSettings):
    """Settings of the stability test.

    A declared phase with a clock error is a case that the test must detect.
    """

    hours: float = option(48.0, "Simulated length", unit="h", least=MIN_HOURS, most=MAX_HOURS)
    estimators: tuple[Literal["ekf", "smoother"], ...] = option(
        ESTIMATORS,
        "Estimator",
        name="estimator",
        words={"both": ESTIMATORS, "ekf": ("ekf",), "smoother": ("smoother",)},
    )
    worlds: int = option(1, "Independent worlds", least=1, most=10_000, note="8 for a firm verdict")
    condition: Condition = option(
        "usual",
        "What happens: a day's temperature cycle, mains that wander, a beacon exchanged at noon, or"
        " beacons that sink by 1 mm a day, one or all, seen by a static platform",
    )
    drive: Literal["current", "voltage"] = option(
        "current", "A voltage drives less current through warm coils"
    )
    phase_known: bool = option(
        False,
        "Declared clocks of the drives: separate, or synchronised",
        name="phase",
        words={"free": False, "known": True},
    )
    clock_ppm: float = option(
        0.0,
        "Error of the drives' common clock",
        least=-100.0,
        most=100.0,
        note="with --phase known: a model error",
    )
    cluster: str | None = option(
        None, "Dask scheduler, tcp://host:8786, whose workers can access the results"
    )
    workers: int | None = option(None, "Processes on this machine", note="default: one a core")
    resume: bool = option(False, "Continue an interrupted run")

    def tasks(self, place: Path) -> list[WorldTask]:
        """Return all runs."""
        from magfusion.jobs.drift_world import WorldTask

        return [
            WorldTask(
                world=world,
                estimator=estimator,
                hours=self.hours,
                seed=self.seed,
                condition=self.condition,
                drive=self.drive,
                phase_known=self.phase_known,
                clock_rate=1e-6 * self.clock_ppm,
                place=str(place),
            )
            for world in range(self.worlds)
            for estimator in self.estimators
        ]


def run_drift(settings: DriftSettings, output: Path, report: Report | None = None) -> Figures:
    """Run estimators through days of simulated worlds and assess them.

    Until all runs are complete, ``output`` contains the files needed to resume.
    """
    from magfusion.jobs.drift_world import claim_place, run_world
    from magfusion.jobs.result_directory import claim
    from magfusion.jobs.written import UNFINISHED_DRIFT
    from magfusion.results.plots.drift import write_plot, write_stability
    from magfusion.results.recording_drift import write_drift_recording
    from magfusion.results.report import write_report

    claimed = claim(output, "drift")
    place = real(output) / UNFINISHED_DRIFT
    tasks = settings.tasks(place)
    claim_place(place)
    if settings.resume:
        for task in tasks:
            read_position(task.progress, task.key)
    else:
        shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True, exist_ok=True)
    try:
        with _progress(tasks, report):
            runs = run_many(
                run_world,
                tasks,
                seed=settings.seed,
                cluster=settings.cluster,
                workers=settings.workers,
            )
    except InputError:
        if not settings.resume:  # nothing is there to go on with
            shutil.rmtree(place, ignore_errors=True)
            with suppress(OSError):
                place.parent.rmdir()
        raise
    figures = summarise(settings, runs)
    drawn = courses(settings, runs)
    figures |= Figures(
        *(
            Figure(f"{course.name}_nees_by_hour", course.nees_by_hour(), section=Section.REPORT)
            for course in drawn
        )
    )
    with claimed as directory:
        write_plot(directory / "drift.png", drawn, figures)
        write_stability(directory / "stability.png", drawn)
        write_drift_recording(directory / "run.rrd", drawn, figures)
        write_report(directory, figures)
    return figures


def summarise(settings: DriftSettings, runs: list[WorldRun]) -> Figures:
    """Return the figures of all runs, the verdict first, and the judgements as sentences.

    Stable, unstable, or inconclusive where the run is too short to decide.
    """
    from magfusion.jobs.drift_figures import STABILITY, judge_runs

    figures = Figures()
    judgements: list[Criterion] = []
    for estimator in settings.estimators:
        own = [run for run in runs if run.task.estimator == estimator]
        result, judgements_of_one = judge_runs(estimator, own)
        figures |= result
        judgements += judgements_of_one
    failed = [one for one in judgements if one.verdict == "fail"]
    trust = Trust(tuple(Finding("unstable", f"{one.sentence}.") for one in failed))
    by_quantity = {
        quantity.name: [
            one.verdict
            for one in judgements
            if one.name.endswith((f"{quantity.name}_drift", f"{quantity.name}_common_drift"))
        ]
        for quantity in QUANTITIES
    }
    head = heading("drift", f"{settings.hours:g} h in {worlds_text(settings.worlds)}")
    answer = STABILITY[overall([one.verdict for one in judgements])]
    head |= trust_figures(trust, answer) | Figures(
        *(
            Figure(f"{name}_stability", STABILITY[overall(verdicts)], section=Section.REPORT)
            for name, verdicts in by_quantity.items()
        ),
        Figure("hours", settings.hours),
        Figure("worlds", settings.worlds),
        Figure("seed", settings.seed),
        Figure("condition", settings.condition),
        Figure("drive", settings.drive),
        Figure("phase", "known" if settings.phase_known else "free"),
        Figure("clock_ppm", settings.clock_ppm, "ppm"),
        Figure("settled_after_h", settled_after(settings.hours) / 3600.0, "h"),
    )
    notes = [f"{_WORD[one.verdict]}: {one.sentence}." for one in judgements]
    return head | figures | Figures(Figure("notes", notes, section=Section.NOTES))


_WORD = {"pass": "PASS", "fail": "FAIL", "undecided": "INCONCLUSIVE"}  # of one criterion


def overall(verdicts: list[Verdict]) -> Verdict:
    """Return the worst verdict."""
    order: tuple[Verdict, ...] = ("fail", "undecided", "pass")
    return min(verdicts, key=order.index)


def courses(settings: DriftSettings, runs: list[WorldRun]) -> list[EstimatorPlot]:
    """Return the plotted data of each estimator: its errors, and its pace in the first world."""
    from magfusion.jobs.drift_figures import MINUTE, minutes

    out = []
    for estimator in settings.estimators:
        own = [r for r in runs if r.task.estimator == estimator]
        out.append(EstimatorPlot(estimator, tuple(minutes(r) for r in own), MINUTE, own[0].pace))
    return out


@contextmanager
def _progress(tasks: list[WorldTask], report: Report | None) -> Iterator[None]:
    """Report the progress of the runs, in any process."""
    from magfusion.jobs.drift_world import stretches_done

    if report is None:
        yield
        return
    report_progress, stop, total = report, threading.Event(), sum(t.stretches for t in tasks)

    def look() -> None:
        while not stop.wait(LOOK):
            report_progress("navigating", stretches_done(tasks), total)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


COMMAND = Command(
    DriftSettings,
    run_drift,
    output="drift",
    example="magfusion drift --hours 0.5 --estimator ekf -o drift",
)
