"""Every help ends with a command that the program takes, options, choices and bounds included."""

import importlib
import shlex

import pytest
from typer.main import get_command

from magfusion.cli import application
from magfusion.jobs import GROUPS, JOBS
from magfusion.jobs.settings import Command


def _example(path: str) -> str:
    command: Command = importlib.import_module(f"magfusion.jobs.{JOBS[path][0]}").COMMAND
    return command.example


def _parsed(line: str) -> list[str]:
    """Return the commands that the parts of a pipe name, as far as their own parser takes them."""
    named = []
    for part in line.split(" | "):
        program, *words = shlex.split(part)
        assert program == "magfusion"
        result, path = get_command(application()), []
        context = result.make_context("magfusion", words)
        while hasattr(result, "resolve_command"):
            name, result, rest = result.resolve_command(
                context, [*context._protected_args, *context.args]
            )
            path.append(name)
            context = result.make_context(name, rest, parent=context)
        named.append(" ".join(path))
    return named


@pytest.mark.parametrize("path", JOBS)
def test_the_example_of_a_command_is_one_of_its_own(path: str) -> None:
    assert path in _parsed(_example(path))


@pytest.mark.parametrize(
    "line",
    [
        "magfusion smooth log --windows 2",
        "magfusion smooth --window 2",
        "magfusion smooth log --coupling loosely",
        "magfusion smoothe log",
    ],
)
def test_what_is_no_command_is_refused_by_the_same_parser(line: str) -> None:
    with pytest.raises(Exception, match=r"No such|Missing|is not one of"):
        _parsed(line)


@pytest.mark.parametrize("path", ["", *GROUPS, *JOBS])
def test_the_help_ends_with_the_example(
    path: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as ended:
        application()(args=[*path.split(), "--help"], prog_name="magfusion")
    assert not ended.value.code
    last = capsys.readouterr().out.strip().splitlines()[-1].strip()
    expected = f"Example: {_example(path)}" if path in JOBS else f"Example: magfusion {path}"
    assert last.startswith(expected)
