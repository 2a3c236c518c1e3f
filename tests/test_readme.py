"""What the README says is what happens: its blocks run in their order, in an empty directory."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.M | re.S)
SCRIPTS = Path(sys.executable).parent
NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]\d+)?")
# .ci/run installs and tests; a viewer needs a screen, and test_cli.py sees it called.
LEFT_OUT = ("pip ", "pytest", "magfusion view")


def _commands(block: str) -> list[str]:
    lines = [part.strip() for line in block.splitlines() for part in line.split("&&")]
    return [line for line in lines if line and not line.startswith(LEFT_OUT)]


def _run(command: str | list[str], directory: Path) -> str:
    path = os.pathsep.join([str(SCRIPTS), os.environ["PATH"]])
    done = subprocess.run(
        command,
        shell=isinstance(command, str),
        cwd=directory,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def _shape(text: str) -> list[list[str]]:
    return [NUMBER.sub("#", line).split() for line in text.splitlines()]


def test_every_block_of_the_readme_runs_and_shows_what_it_says(tmp_path: Path) -> None:
    shown = ""
    for language, block in BLOCKS:
        if language == "yaml":
            (tmp_path / block.split()[1]).write_text(block, encoding="utf-8")
        elif language == "sh":
            for command in _commands(block):
                shown = _run(command, tmp_path)
        elif language == "python":
            _run([sys.executable, "-c", block], tmp_path)
        else:
            assert _shape(block) == _shape(shown)
    for name in ("magfusion_demo", "run", "fixes", "run_from_phasors"):
        assert (tmp_path / name / "trajectory.tum").is_file()


def test_the_readme_shows_blocks_of_every_kind() -> None:
    assert {language for language, _ in BLOCKS} == {"sh", "yaml", "python", "text"}


@pytest.mark.parametrize("place", re.findall(r"\]\(([^)#:]+)\)", README))
def test_what_the_readme_points_to_is_there(place: str) -> None:
    assert (ROOT / place).is_file()


def test_the_readmes_picture_is_small() -> None:
    assert (ROOT / ".github" / "readme.png").stat().st_size <= 300_000  # bytes
