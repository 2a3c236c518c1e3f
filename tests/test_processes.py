"""Commands as they are installed, each a process of its own: what no test in process can see."""

import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from page_blocks import SCRIPTS, blocks, run_blocks

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
LOCATION = "location: {latitude_deg: 50.9, longitude_deg: 13.3, height_m: 400, date: 2026-11-26}"
AT_A_TIME = 4  # processes, on fewer processors: each is interrupted anywhere


def magfusion(directory: Path, words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [SCRIPTS / "magfusion", *shlex.split(words)],
        cwd=directory,
        capture_output=True,
        text=True,
        check=False,
    )


# A site that says where it is, in place of its field ------------------------------------------


def _with_location(page: str) -> str:
    located, count = re.subn(r"earth_field_t: \[[^]]*\].*", LOCATION, page)
    assert count == 1
    return located


@pytest.mark.slow
def test_commands_run_on_a_site_with_a_location(tmp_path: Path) -> None:
    site = next(block for language, block in blocks(README) if language == "yaml")
    (tmp_path / "site.yaml").write_text(_with_location(site))
    for words in (
        "simulate --site site.yaml -o log --duration 12",
        "check log",
        "fix log -o fixes",
        "smooth log -o run",
        "navigate log -o navigated --estimator ekf",
        "evaluate run log",
    ):
        done = magfusion(tmp_path, words)
        assert done.returncode == 0, f"{words}: {done.stderr}"


@pytest.mark.slow
def test_what_the_readme_does_with_a_site_works_with_a_location(tmp_path: Path) -> None:
    page = re.sub(r"^```text\n.*?^```$", "", _with_location(README), flags=re.M | re.S)
    page = re.sub(r"(^|&& )magfusion (demo|drift|papers).*$", "", page, flags=re.M)  # no site
    run_blocks(page, tmp_path)


# What is refused ends with its sentence, and not with a signal --------------------------------

HALF_READ = """
from pathlib import Path
from magfusion.files.foreign import text
text.BLOCK = 1 << 18  # bytes; there is much left to read
parts = text.text_source(Path("long.txt")).read([0, 1], [])
next(parts)
raise SystemExit(2)
"""
REFUSED = (
    "import imu.csv mag.csv --map 'imu.time=t_ms[s]' -o log",
    "import imu.csv mag.csv --map 'imu.gyro=GyrX_dps,GyrY_dps,GyrZ_dps[10*rad/s]' -o log",
    "import cell.csv mag.csv -o log",
    "import imu.csv nowhere.csv -o log",
    "smooth nowhere -o run",
)


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    """Return a directory with tables of an inertial sensor and a magnetometer."""
    head = "t_ms,GyrX_dps,GyrY_dps,GyrZ_dps,AccX_g,AccY_g,AccZ_g\n"
    rows = [f"{5 * k}.0,1.25,-20.75,3.125,0.0125,-0.0625,0.995\n" for k in range(400)]
    (tmp_path / "imu.csv").write_text("".join([head, *rows]))
    (tmp_path / "cell.csv").write_text("".join([head, *rows]).replace("\n35.0,1.25", "\n35.0,ERR"))
    fields = [f"{5 * k}.0,20000.5,0.5,-40000.5\n" for k in range(400)]
    (tmp_path / "mag.csv").write_text("".join(["t_ms,Bx_nT,By_nT,Bz_nT\n", *fields]))
    return tmp_path


@pytest.mark.slow
def test_a_table_of_which_only_the_beginning_was_read_lets_the_process_end(tmp_path: Path) -> None:
    """Threads of Arrow's that came back to Python at its end aborted it, or it never ended."""
    rows = "".join(f"{k} 1.25 -20.75 3.125 0.0125 -0.0625 0.995609\n" for k in range(200_000))
    (tmp_path / "long.txt").write_text(f"t gx gy gz ax ay az\n{rows}")
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", HALF_READ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=60.0,
        )
        assert (done.returncode, done.stderr) == (2, "")


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_refused_commands_end_in_order(tables: Path, times: int) -> None:
    requested = [words for words in REFUSED for _ in range(times)]
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        ended = list(pool.map(lambda words: magfusion(tables, words), requested))
    for words, done in zip(requested, ended, strict=True):
        assert done.returncode == 2, f"{words}: {done.returncode} {done.stderr[-500:]}"
        assert re.fullmatch(r"magfusion: [^\n]+\n", done.stderr), done.stderr
    assert not (tables / "log").exists()
