"""The fenced blocks of a page, and how to do what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

SCRIPTS = Path(sys.executable).parent
NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]\d+)?")
# .ci/run installs and tests; a viewer needs a screen, and test_cli.py sees it called.
LEFT_OUT = ("pip ", "pytest", "magfusion view")


def blocks(page: str) -> list[tuple[str, str]]:
    """Return language and content of each fenced block."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page, re.M | re.S)


def run_blocks(page: str, directory: Path) -> None:
    """Run the commands of a page in a directory; what it shows of one must be of that shape."""
    shown = ""
    for language, block in blocks(page):
        if language == "yaml":
            (directory / block.split()[1]).write_text(block, encoding="utf-8")
        elif language == "sh":
            for command in _commands(block):
                shown = _run(command, directory)
        elif language == "python":
            _run([sys.executable, "-c", block], directory)
        else:
            assert _shape(block) == _shape(shown)


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
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]} {done.stderr}"
    return done.stdout


def _shape(text: str) -> list[list[str]]:
    return [NUMBER.sub("#", line).split() for line in text.splitlines()]
