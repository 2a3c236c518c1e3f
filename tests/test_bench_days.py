"""Days of raw samples: the tool's world is one that the filter finds its way in."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "bench_days.py"


@pytest.mark.slow
def test_six_minutes_lead_to_states_in_bounded_memory() -> None:
    done = subprocess.run(
        [sys.executable, str(TOOL), "--hours", "0.1"], check=True, capture_output=True, text=True
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert 300 < result["states"] < 400  # one a second, but for those of the start
    assert result["largest_mib"] < 1024.0
    assert result["error_mm"] < 10.0
