"""Raw samples of two magnetometers: smoothed, navigated, and the same through the pipe.

`several_magnetometers` runs it; the walk's fields are bent as there, and its samples are those of
both instruments with their noise.
"""

import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.data_checks.magnetometers import without_magnetometer
from magfusion.estimation.demodulation.separate_demodulation import demodulated_apart
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.fields import by_own_clocks
from magfusion.files.site import save_site
from magfusion.jobs.replay import Replay, feed, run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

EKF = NavigatorSettings("ekf")


@dataclass(frozen=True)
class Errors:
    """Of one trajectory."""

    position_mm: float
    attitude_deg: float
    nees: float


def walked(site: Site, box_world: np.ndarray, duration: float, seed: int) -> SimulatedLog:
    """Return a walk with raw samples of all magnetometers of a site."""
    config = SimulationConfig(box_world=box_world, duration=duration, random_field=site.model_error)
    return simulate_log(site, config, np.random.default_rng(seed))


def navigated(log: Log, site: Site) -> Trajectory:
    """Return the states of the filter along a log."""
    navigator, replayed = Navigator(site, EKF), Replay(log)
    states = []
    for _, piece in replayed.pieces():
        feed(navigator, piece)
        states += navigator.take()
    return as_trajectory(states)


def run_separately(log: Log, site: Site, states: Trajectory) -> float:
    """Return by how much the states of the pipe differ from those of the log, at most (m)."""
    source, sink = io.BytesIO(), io.BytesIO()
    run_replay(log, source, "json", realtime=False)
    source.seek(0)
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory) / "site.yaml"
        save_site(site, place)
        run_stream(place, StreamSettings(EKF), source, sink, io.StringIO())
    reported = [json.loads(line) for line in sink.getvalue().splitlines()]
    result = np.array([state["position"] for state in reported if state["started"]])
    if result.shape != states.position_world.shape:
        return np.inf
    return float(np.max(np.abs(result - states.position_world)))


def errors_of(states: Trajectory, walk: SimulatedLog) -> Errors:
    """Return the errors of states against the truth."""
    result = trajectory_errors(states, walk.motion.trajectory(states.time))
    assert result.nees is not None
    return Errors(1e3 * result.ate, result.attitude_rmse_deg, float(np.mean(result.nees)))


def raw_errors(walk: SimulatedLog, site: Site) -> tuple[dict[tuple[str, str], Errors], float]:
    """Return the errors by estimator and magnetometers, and how far pipe and log are apart (m)."""
    logs = {"both": (walk.log, site)}
    names = [sensor.name for sensor in site.platform.magnetometers]
    logs |= {
        f"{name} alone": without_magnetometer(walk.log, site, 1 - k) for k, name in enumerate(names)
    }
    fields = demodulated_apart(walk.log, site).log
    assert fields.fields is not None
    stamped = replace(fields, fields=by_own_clocks(fields.fields, site))
    estimators: dict[str, Callable[[Log, Site], Trajectory]] = {
        "smooth, raw": lambda log, site: smooth(log, site).states,
        "filter, raw": navigated,
    }
    result = {
        (name, which): errors_of(run(*one), walk)
        for name, run in estimators.items()
        for which, one in logs.items()
    }
    result["smooth, turns alone taken off", "both"] = errors_of(smooth(fields, site).states, walk)
    by_fields = navigated(fields, site)
    result["filter, turns alone taken off", "both"] = errors_of(by_fields, walk)
    by_samples = navigated(walk.log, site)
    far = max(run_separately(walk.log, site, by_samples), run_separately(stamped, site, by_fields))
    return result, far
