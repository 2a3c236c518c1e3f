"""Workers of a killed run end by themselves."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from magfusion.simulation.monte_carlo import run_many

PATIENCE = 120.0  # s; to start processes on a busy machine
LONG = 600.0  # s; of a task


def work(place: str, _: np.random.Generator) -> None:
    """Write the id of this process, and take long."""
    (Path(place) / str(os.getpid())).touch()
    time.sleep(LONG)


def start(place: str) -> None:
    """Run two such tasks in two processes."""
    run_many(work, [place, place], workers=2)


def runs(process: int) -> bool:
    status = Path(f"/proc/{process}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_workers_of_a_killed_run_end_with_it(tmp_path: Path) -> None:
    here = f"{Path(__file__).parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    command = f"from test_killed_parent import start; start({str(tmp_path)!r})"
    parent = subprocess.Popen(
        [sys.executable, "-c", command], env=os.environ | {"PYTHONPATH": here}
    )
    workers: list[int] = []
    try:
        until = time.monotonic() + PATIENCE
        while len(workers) < 2 and time.monotonic() < until:
            time.sleep(0.1)
            workers = [int(path.name) for path in tmp_path.iterdir()]
        assert len(workers) == 2
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        until = time.monotonic() + 10.0
        while any(map(runs, workers)) and time.monotonic() < until:
            time.sleep(0.1)
        assert not any(map(runs, workers))
    finally:
        parent.kill()
        for worker in filter(runs, workers):
            os.kill(worker, signal.SIGKILL)
