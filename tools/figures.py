"""Compare the figures that the pages print with what their commands give.

``figures.yaml`` lists commands and the sentences of a page that their results fill: a field
``{rows.0.error_m * 1e3}`` is the number that the page prints there, and where the JSON line that
ends the command's output has it; ``{rows.smooth.both.error_m}`` is of the one of the rows that has
both words among its values.  A row of a table is a sentence; ``{}`` is a number that is compared by
another command's.

``python tools/figures.py`` runs what takes seconds or minutes; ``--release`` everything, and
``--only WORDS`` the commands that have these words.  What is measured at a commit is kept in
``--results``, so that a run that was stopped goes on.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from pydantic import model_validator

from magfusion.files.yaml_files import StrictModel, read_yaml

ROOT = Path(__file__).parents[1]
LOGS = ROOT.parent / "shared" / "logs"
FIELD = re.compile(r"\{([^{}*]*?)(?: \* ([\d.e+-]+))?\}")
MINUS = "\N{MINUS SIGN}"
PRINTED = rf"([-{MINUS}+]?[\d,]*\.?\d+)"


class Entry(StrictModel):
    """Sentences of a page, and the command or the test that holds their figures.

    Parameters
    ----------
    sentences : list of str
        With a field for each figure of a command.
    command : str, optional
        ``{logs}`` are recorded logs that are not in the repository.
    takes : {'seconds', 'minutes', 'hours'}
    spread : float
        Share by which a figure may differ, beyond the rounding of the page.
    why : str, optional
        The reason for the spread.
    test : str, optional
        That fails where the sentence is wrong.
    """

    page: str
    sentences: list[str]
    command: str | None = None
    takes: Literal["seconds", "minutes", "hours"] = "seconds"
    spread: float = 0.0
    why: str | None = None
    test: str | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.command is None) == (self.test is None):
            raise ValueError("give a command or a test")
        if (self.spread > 0.0) == (self.why is None):
            raise ValueError("give a spread with its reason")
        return self


class Register(StrictModel):
    """What `figures.yaml` holds.

    Parameters
    ----------
    given : list of str
        Numbers of the README's prose that are not measurements.
    """

    figures: list[Entry]
    given: list[str]


class Figure(NamedTuple):
    """A figure as it is printed and as it is measured."""

    key: str
    printed: str
    measured: float
    agrees: bool


def register() -> Register:
    """Return the sentences and what holds them."""
    return read_yaml(Path(__file__).with_suffix(".yaml"), Register)


@cache
def flat(page: str) -> str:
    """Return a page on one line."""
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def printed(page: str, sentence: str) -> tuple[list[str], list[tuple[str, str]]]:
    """Return what a page prints in the fields of a sentence, and the fields (key, factor).

    Raises
    ------
    ValueError
        If the page does not have the sentence exactly once.
    """
    parts = FIELD.split(sentence)
    pattern = PRINTED.join(re.escape(text) for text in parts[::3])
    matches = re.findall(pattern, flat(page))
    if len(matches) != 1:
        raise ValueError(f"{page} has {len(matches)} times: {sentence}")
    numbers = [matches[0]] if isinstance(matches[0], str) else list(matches[0])
    fields = list(zip(parts[1::3], (factor or "1" for factor in parts[2::3]), strict=True))
    return numbers if fields else [], fields


def compared(entry: Entry, result: Any) -> list[Figure]:
    """Return all figures of an entry with those of its command's result."""
    out = []
    for sentence in entry.sentences:
        for number, (key, factor) in zip(*printed(entry.page, sentence), strict=True):
            if not key:
                continue
            measured = float(factor) * _value(result, key)
            plain = number.replace(",", "").replace(MINUS, "-")
            rounding = 0.501 * 10.0 ** -len(plain.partition(".")[2])
            within = rounding + entry.spread * abs(measured)
            out.append(Figure(key, number, measured, abs(float(plain) - measured) <= within))
    return out


def _value(result: Any, key: str) -> float:
    for part in key.split("."):
        if not isinstance(result, list):
            result = result[part]
        elif part.isdigit():
            result = result[int(part)]
        elif len(result) == 1 and part in result[0]:
            result = result[0][part]
        else:
            result = [row for row in result if part in row.values()]
    return float(result)


def measured(command: str, directory: Path) -> Any:
    """Run a command in a directory; return what the last line of its output has in JSON."""
    line = command.replace("{logs}", str(LOGS))
    line = re.sub(r"\b(scenarios|tools)/", rf"{ROOT}/\1/", line)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        shlex.split(line),
        cwd=directory,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    if not done.stdout.strip():
        raise RuntimeError(f"{command}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    """Run the commands, print the table, and return 1 where a figure differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--release", action="store_true", help="also what takes hours")
    parser.add_argument("--only", metavar="WORDS", help="commands that have these words")
    parser.add_argument("--results", type=Path, default=ROOT / "figures_measured", help="directory")
    options = parser.parse_args()
    commit = _git("rev-parse", "--short", "HEAD") + ("+" if _git("status", "--porcelain") else "")
    wrong = 0
    print(f"{datetime.now(UTC):%Y-%m-%d}, commit {commit}\n")
    print("| page | command | figure | printed | measured | |\n|---|---|---|---|---|---|")
    for entry in register().figures:
        if entry.command is None or not _chosen(entry, options.release, options.only):
            continue
        if "{logs}" in entry.command and not LOGS.is_dir():
            print(f"| {entry.page} | `{entry.command}` | | | | no recorded logs here |")
            continue
        for one in compared(entry, _kept(entry.command, commit, options.results)):
            wrong += not one.agrees
            row = f"{one.key} | {one.printed} | {one.measured:.4g}"
            mark = "" if one.agrees else "**differs**"
            print(f"| {entry.page} | `{entry.command}` | {row} | {mark} |", flush=True)
    return int(wrong > 0)


def _chosen(entry: Entry, release: bool, only: str | None) -> bool:
    if only is not None:
        return only in (entry.command or "")
    return release or entry.takes != "hours"


def _kept(command: str, commit: str, results: Path) -> Any:
    """Return the result of a command at a commit, measured once."""
    results.mkdir(parents=True, exist_ok=True)
    path = results / f"{re.sub(r'[^A-Za-z0-9]+', '_', command)}.json"
    if path.is_file():
        before = json.loads(path.read_text())
        if before["commit"] == commit and not commit.endswith("+"):
            return before["result"]
    with tempfile.TemporaryDirectory() as directory:
        result = measured(command, Path(directory))
    path.write_text(json.dumps({"commit": commit, "command": command, "result": result}))
    return result


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
