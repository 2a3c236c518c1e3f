"""Many logs of one site: the driver passes names, and the truth lies within their sigmas."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCENARIO = Path(__file__).parents[1] / "scenarios" / "many_logs.py"


@pytest.mark.slow
def test_a_hundred_logs_find_the_calibration_and_send_little(tmp_path: Path) -> None:
    command = [sys.executable, str(SCENARIO), "--logs", "100", "--real", "2", "--workers", "1"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path)
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["contradicting"] == 0
    assert figures["moved_sigma"] < 1e-6
    assert 0.3 < figures["off_sigma"] < 1.5  # root mean square of 40 directions
    assert figures["sent_a_log_and_round_bytes"] < 1e4
    assert not list(tmp_path.iterdir())
