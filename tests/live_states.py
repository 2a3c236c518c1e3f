"""States that are told to robots, for tests of what tells them."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from online_log import online_log
from scipy.spatial.transform import Rotation

from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState, Judgement
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.live import LiveSettings
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import Log
from magfusion.model.trust import Finding, Verdict
from magfusion.simulation.demo_site import demo_site

EPOCH_NS = 1_700_000_000_000_000_000
MAX_FINAL_STEP_SIGMAS = Judgement((Finding("lost", "The platform is lost.", Verdict.FAILED),))
DOUBTFUL = Judgement((Finding("diverged", "It diverged."),), levels=Levels((1.0, None)))


def example_state(seed: int, judgement: Judgement | None = None) -> JudgedState:
    """Return a state in any attitude, all of whose errors are correlated."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(15, 15)) * np.repeat([0.02, 0.05, 0.1, 1e-3, 1e-3], 3)[:, None]
    return JudgedState(
        time=float(rng.uniform(10.0, 20.0)),
        world_from_body=Rotation.random(random_state=rng).as_matrix(),
        position_world=rng.normal(size=3),
        velocity_world=rng.normal(size=3),
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(demo_site(), np.empty(0)),
        cov=root @ root.T,
        judgement=Judgement(levels=Levels((0.25, None))) if judgement is None else judgement,
    )


def release_gain(state: JudgedState) -> dict[str, Any]:
    """Return as much of what a pipe tells of a state as those need who listen."""
    verdict = str(state.verdict)
    return {"time": state.time, "lost": state.is_lost, "verdict": verdict}


def write_walk(path: Path) -> Path:
    """Write the log of a short walk with its site; return its directory."""
    walk = online_log(3, 8.0)
    write_log(Log("walk", EPOCH_NS, "test", walk.imu, None, walk.fields), path)
    save_site(walk.site, path / "site.yaml")
    return path


def piped(log: Path, live: LiveSettings) -> tuple[list[Any], str]:
    """Return the states of a pipe, and what it said, while others are told."""
    from magfusion.files.log import read_log

    records, sink, findings = io.BytesIO(), io.BytesIO(), io.StringIO()
    run_replay(read_log(log), records, "json", realtime=False)
    settings = StreamSettings(NavigatorSettings("ekf"), live=live)
    run_stream(log / "site.yaml", settings, io.BytesIO(records.getvalue()), sink, findings)
    return [json.loads(line) for line in sink.getvalue().splitlines()], findings.getvalue()
