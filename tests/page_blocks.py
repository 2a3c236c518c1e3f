"""The fenced blocks of a page, and how to do what they say."""

import os
import re
import subprocess
import sys
from itertools import groupby
from pathlib import Path

SCRIPTS = Path(sys.executable).parent
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
# Of what a page shows, another processor may give this much else: a tenth, or the last digit.
RELATIVE, DIGITS = 0.1, 1.5
OF_THE_MACHINE = ("elapsed",)  # lines whose numbers are its speed
# .ci/run installs and tests; a viewer needs a screen, and test_cli.py sees it called.
LEFT_OUT = ("pip ", "pytest", "magfusion view")


def blocks(page: str) -> list[tuple[str, str]]:
    """Return language and content of each fenced block."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page, re.M | re.S)


def run_blocks(page: str, directory: Path) -> None:
    """Run the commands of a page in a directory; what it shows of one must be what it says."""
    shown = ""
    for is_python, together in groupby(blocks(page), key=lambda block: block[0] == "python"):
        contents = list(together)
        if is_python:  # a block has the names of the one before
            _run([sys.executable, "-c", "".join(content for _, content in contents)], directory)
            continue
        for language, block in contents:
            if language == "yaml":
                (directory / block.split()[1]).write_text(block, encoding="utf-8")
            elif language == "sh":
                for command in _commands(block):
                    shown = _run(command, directory)
            else:
                reported = differences(block, shown)
                assert not reported, "\n".join(reported)


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


def differences(reported: str, shown: str) -> list[str]:
    """Return what is told otherwise than it is shown: other words, or numbers beyond tolerance."""
    lines, seen = reported.splitlines(), shown.splitlines()
    result = [] if len(lines) == len(seen) else [f"{len(lines)} lines, {len(seen)} shown"]
    for one, other in zip(lines, seen, strict=False):
        same = NUMBER.sub("#", one).split() == NUMBER.sub("#", other).split()
        numbers = zip(NUMBER.findall(one), NUMBER.findall(other), strict=False)
        if one.split()[:1] not in [[word] for word in OF_THE_MACHINE]:
            same = same and all(agree(*pair) for pair in numbers)
        result += [] if same else [f"told  {one}", f"shown {other}"]
    return result


def agree(reported: str, shown: str) -> bool:
    """Tell whether a number is what is told of it."""
    mantissa, _, power = reported.partition("e")
    digit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    separate = abs(float(reported) - float(shown))
    return separate <= max(RELATIVE * abs(float(shown)), DIGITS * digit)
