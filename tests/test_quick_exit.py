"""A process that ends at once has done all that was to be done before."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import atexit, sys, threading, time
from pathlib import Path
from magfusion.files.standard_streams import quick_exit

class Slow:
    def __del__(self, touch=Path(sys.argv[1], "cleared").touch):
        touch()

kept = Slow()
status = quick_exit()
atexit.register(Path(sys.argv[1], "registered").touch)
threading.Thread(target=lambda: (time.sleep(0.2), Path(sys.argv[1], "thread").touch())).start()
print("written", end="")
status += [int(x) for x in sys.argv[2:]]
raise SystemExit(5)
"""


@pytest.mark.parametrize(("given", "ends"), [(["3"], 3), (["0"], 0), ([], 5)])
def test_nothing_is_lost_but_the_clearing(tmp_path: Path, given: list[str], ends: int) -> None:
    asked = [sys.executable, "-c", PROGRAM, str(tmp_path), *given]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == ends
    assert done.stdout == "written"
    names = {path.name for path in tmp_path.iterdir()}
    assert {"registered", "thread"} <= names
    assert ("cleared" in names) == (not given)


def test_output_that_cannot_be_written_is_no_success(tmp_path: Path) -> None:
    asked = [sys.executable, "-c", PROGRAM, str(tmp_path), "0"]
    if not Path("/dev/full").exists():
        pytest.skip("this system has no full device")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(asked, stdout=full, stderr=subprocess.PIPE, check=False)
    assert done.returncode != 0
