"""A log by the batch smoother and by the filter: errors and verdicts side by side."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from harness import rms

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.jobs.replay import Replay, feed
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.units import DEGREE


@dataclass(frozen=True)
class Row:
    """What an estimator makes of a log by a site."""

    case: str
    estimator: str
    position_mm: float
    attitude_deg: float
    verdict: str


def smoothed(log: Log, site: Site) -> tuple[Trajectory, str]:
    """Smooth a log; return its states and the verdict."""
    result, trust = judge_result(smooth(log, site, SmootherSettings()), log)
    return result.states, str(trust.verdict)


def filtered(log: Log, site: Site) -> tuple[Trajectory, str]:
    """Navigate along a log by the filter; return its states and their worst verdict."""
    navigator, replayed = Navigator(site, NavigatorSettings("ekf")), Replay(log)
    states: list[JudgedState] = []
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        states += navigator.take()
    return as_trajectory(states), str(navigator.summary.trust.verdict)


def rows_of(case: str, log: Log, site: Site) -> Iterator[Row]:
    """Yield the row of each estimator, against the truth of the log."""
    assert log.truth is not None
    for estimator, estimate in (("smooth", smoothed), ("navigate (ekf)", filtered)):
        states, verdict = estimate(log, site)
        result = trajectory_errors(states, log.truth)
        size = rms(np.linalg.norm(result.position_world, axis=1))
        yield Row(case, estimator, 1e3 * size, rms(result.attitude) / DEGREE, verdict)


def table(title: str, rows: list[Row]) -> str:
    """Return the table of the errors."""
    lines = [f"{title:16}{'estimator':16}{'position':>12}{'attitude':>12}"]
    for row in rows:
        errors = f"{row.position_mm:9.2f} mm{row.attitude_deg:8.3f} deg"
        lines.append(f"{row.case:16}{row.estimator:16}{errors}  {row.verdict}")
    return "\n".join(lines)
