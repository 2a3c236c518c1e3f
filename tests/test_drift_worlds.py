"""The drift test on fresh worlds, by the installed command: sigmas are right, both ways."""

import json
import subprocess
from pathlib import Path

import pytest

from magfusion.jobs.drift_figures import nees_limits


@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "worlds", "hours"), [("ekf", 4, 2.0), ("smoother", 3, 1.5)], ids=["ekf", "lag"]
)
def test_poses_and_biases_of_fresh_worlds_are_consistent_in_either_half(
    estimator: str, worlds: int, hours: float, tmp_path: Path
) -> None:
    """A platform at rest is measured once a minute, so that each prediction is 20 cm wide."""
    command = ["magfusion", "drift", "--hours", str(hours), "--worlds", str(worlds)]
    command += ["--estimator", estimator, "--seed", "101", "-o", str(tmp_path / "drift")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((tmp_path / "drift" / "report.json").read_text())
    low, high = nees_limits(worlds)
    for part in ("pose", "bias"):
        assert result[f"{estimator}_{part}_consistency_verdict"] == "pass"
        for half in ("first", "last"):
            assert low < result[f"{estimator}_{part}_nees_{half}_half"] < high


@pytest.mark.slow
@pytest.mark.parametrize(("condition", "hours"), [("exchange", 6.0), ("settlement", 2.5)])
def test_poses_stay_consistent_whatever_happens_to_a_beacon(
    condition: str, hours: float, tmp_path: Path
) -> None:
    """An exchanged beacon moves no state; precise phasors of a static platform do not mislead."""
    worlds = 2
    command = ["magfusion", "drift", "--condition", condition, "--hours", str(hours)]
    command += ["--worlds", str(worlds), "--estimator", "ekf", "--seed", "102"]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "drift")], capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), done.stdout + done.stderr
    result = json.loads((tmp_path / "drift" / "report.json").read_text())
    low, high = nees_limits(worlds)
    for half in ("first", "last"):
        assert low < result[f"ekf_pose_nees_{half}_half"] < high
    assert result["ekf_false_findings"] == 0, result["ekf_reported"]
    assert result["ekf_event_reported_verdict"] in ("pass", "undecided")
