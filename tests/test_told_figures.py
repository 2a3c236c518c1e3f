"""The figures that README and CHANGELOG print are those that their commands give."""

import ast
import json
import os
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any, Self

import pytest
from page_blocks import SCRIPTS
from pydantic import Field, model_validator

from magfusion.files.yaml_files import StrictModel, read_yaml

ROOT = Path(__file__).parents[1]
LOGS = ROOT.parent / "shared" / "logs"


class Figure(StrictModel):
    """One number: by a key of the command's JSON, or held by a test."""

    value: str
    key: list[str | int] = Field(default_factory=list)
    factor: float = 1.0
    within: float | None = None
    test: str | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if bool(self.key) == bool(self.test) or bool(self.key) != bool(self.within):
            raise ValueError("give key and within, or test")
        return self


class Reported(StrictModel):
    """A sentence with figures, and the command that makes them."""

    file: str = Field(alias="in")
    says: str
    command: str | None = None
    slow: bool = False
    by_hand: str | None = None
    figures: list[Figure]

    @model_validator(mode="after")
    def _measured(self) -> Self:
        if (self.command is None) != all(figure.test for figure in self.figures):
            raise ValueError("give a command where a figure has a key, and only there")
        return self


class _Register(StrictModel):
    figures: list[Reported]
    given: list[str]


REGISTER = read_yaml(Path(__file__).with_name("told_figures.yaml"), _Register)


@cache
def _flat(name: str) -> str:
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def test_the_figures_are_printed_and_what_holds_them_is_there() -> None:
    for reported in REGISTER.figures:
        assert reported.says in _flat(reported.file)
        for figure in reported.figures:
            assert figure.value in reported.says
            if figure.test is not None:
                path, _, name = figure.test.partition("::")
                tree = ast.parse((ROOT / path).read_text())
                functions = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
                assert name in functions, f"{reported.says}: {figure.test}"


MEASURED = [
    pytest.param(reported, id=reported.says[:50], marks=[pytest.mark.slow] if reported.slow else [])
    for reported in REGISTER.figures
    if reported.command
]


@pytest.mark.parametrize("reported", MEASURED)
def test_the_command_gives_the_figures(reported: Reported, tmp_path: Path) -> None:
    assert reported.command is not None
    if "{logs}" in reported.command and not LOGS.is_dir():
        pytest.skip("the shared logs are not beside the repository")
    result = _measured(reported.command, tmp_path)
    for figure in reported.figures:
        if figure.key:
            value: Any = result
            for part in figure.key:
                value = value[part]
            assert figure.factor * float(value) == pytest.approx(
                float(figure.value), abs=figure.within
            ), figure.key


def _measured(command: str, directory: Path) -> Any:
    """Run a command; return what its last line has in JSON."""
    line = command.replace("{logs}", str(LOGS)).replace("scenarios/", f"{ROOT}/scenarios/")
    done = subprocess.run(
        line.split(),
        cwd=directory,
        env=os.environ | {"PATH": os.pathsep.join([str(SCRIPTS), os.environ["PATH"]])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.,]*\d|(?<![\w.])\d\b")


# Names with a number, which nobody measures.
NAMED = re.compile(
    r"\b(?:papers?|Eq|figures?|algorithms?|exit(?: code)?|ROS|Python)"
    r" \d[\d.]*(?:(?: to |, | and )\d[\d.]*)*"
)


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md"])
def test_every_number_in_the_prose_is_measured_or_given(name: str) -> None:
    """Outside of blocks, which `test_readme` runs, of code, and of what it points to."""
    prose = re.sub(r"^```.*?^```$", "", (ROOT / name).read_text(), flags=re.M | re.S)
    prose = _plain(re.sub(r"^#+.*$", " ", prose, flags=re.M))
    known = [_plain(reported.says) for reported in REGISTER.figures if reported.file == name]
    for phrase in known + (REGISTER.given if name == "README.md" else []):
        prose = prose.replace(phrase, " ")
    result = NUMBER.findall(NAMED.sub(" ", prose))
    assert not result, "put it into told_figures.yaml with what makes it, or into docs/measured.md"


def _plain(text: str) -> str:
    return " ".join(re.sub(r"\]\([^)]*\)|`[^`]*`", " ", text).split())


def test_what_is_given_is_in_the_readme() -> None:
    assert all(phrase in _flat("README.md") for phrase in REGISTER.given)


def test_the_drift_of_the_readme_is_that_of_its_page() -> None:
    (reported,) = re.findall(
        r"-?[\d.]+ ± [\d.]+ mm and -?[\d.]+ ± [\d.]+° a day", _flat("README.md")
    )
    assert reported in _flat("docs/jobs/drift.md")
