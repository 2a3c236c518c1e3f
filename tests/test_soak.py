"""The soak: its faults occur as requested, what is wrong is found, and a short one passes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from soak import CALM, KINDS, WRONG, Judge, Result, grown_mib, schedule

from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.endurance import EnduranceConfig, draw_endurance

TOOL = Path(__file__).parents[1] / "tools" / "soak.py"
WORLD = draw_endurance(demo_site(), EnduranceConfig(0.02), (1, 0))


def _line(time: float, stamp: float, verdict: str = "trustworthy", off: float = 0.0) -> bytes:
    """Return a state off its true position (m), protected to half a metre."""
    true = WORLD.motion.position_world(np.array([time]))[0]
    state = {
        "time": stamp,
        "started": True,
        "lost": False,
        "verdict": verdict,
        "position": np.add(true, [off, 0.0, 0.0]).tolist(),
        "protection_level_m": 0.5,
    }
    return json.dumps(state).encode()


def test_each_fault_occurs_as_often_as_requested_and_alone() -> None:
    faults = schedule(6.0, 10, np.random.default_rng(3))
    assert sorted(f.kind for f in faults) == sorted(KINDS * 10)
    edges = np.array([[f.begin, f.end] for f in faults])
    assert np.all(edges[1:, 0] - edges[:-1, 1] >= CALM)
    assert edges[0, 0] >= CALM
    assert edges[-1, 1] <= 6.0 * 3600.0 - CALM
    silences = [f.end - f.begin for f in faults if f.kind == "imu_silent"]
    assert 0.5 <= min(silences) < 60.0 < max(silences) <= 600.0
    assert faults == schedule(6.0, 10, np.random.default_rng(3))
    with pytest.raises(SystemExit, match="do not fit"):
        schedule(0.05, 10, np.random.default_rng(3))


@pytest.mark.parametrize(
    ("verdict", "off", "seconds", "count"),
    [
        ("trustworthy", 1.0, 10.0, 1),
        ("trustworthy", 1.0, 0.5 * WRONG, 0),
        ("trustworthy", 0.1, 10.0, 0),
        ("doubtful", 1.0, 10.0, 0),
    ],
)
def test_a_believed_error_beyond_the_claim_is_found_once(
    verdict: str, off: float, seconds: float, count: int
) -> None:
    judge = Judge(WORLD, Result(1, 0.02, 1, "ekf"))
    for time in np.arange(10.0, 10.0 + seconds, 0.5):
        judge.see(_line(time, time, verdict, off))
    assert len(judge.result.finds) == count


def test_states_are_on_the_new_clock_from_the_new_start_on() -> None:
    judge = Judge(WORLD, Result(1, 0.02, 1, "ekf"))
    judge.result.offset = -4.0
    for time in np.arange(22.0, 26.0, 0.5):  # not read before the step was written
        judge.see(_line(time, time))
    judge.see(json.dumps({"time": 23.0, "started": False}).encode())
    for time in np.arange(34.0, 40.0, 0.5):
        judge.see(_line(time, time - 4.0))
    assert not judge.result.finds


def test_memory_that_grows_is_told_from_that_of_the_start() -> None:
    assert grown_mib([100.0, 300.0, 290.0, 295.0, 300.0, 299.0]) == 0.0
    assert grown_mib([100.0, 150.0, 200.0, 250.0, 300.0, 350.0]) == 200.0


@pytest.mark.slow
def test_six_minutes_with_each_fault_once(tmp_path: Path) -> None:
    short = ("--hours", "0.1", "--faults", "1", "--place", str(tmp_path / "soak"))
    done = subprocess.run([sys.executable, str(TOOL), *short], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((tmp_path / "soak" / "result.json").read_text())
    assert result["states"] > 150
    assert sorted(row["kind"] for row in result["back_s"]) == sorted(KINDS)
