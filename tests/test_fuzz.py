"""The command line survives what nobody would write; what once broke it is kept beside."""

import json
from pathlib import Path

import pytest

pytest.importorskip("hypothesis")

from fuzz import CORPUS, Case, fuzz, run_case
from fuzz_cases import PIPE
from fuzz_inputs import example_inputs

KEPT = sorted(CORPUS.glob("*.json"))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return example_inputs(tmp_path_factory.mktemp("inputs") / "inputs")


@pytest.mark.slow
def test_what_breaks_is_found(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fuzzer that finds nothing proves nothing unless it would find something."""

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a fault")

    case: Case = {"kind": "yaml", "changes": [], "command": PIPE, "file": "log/site.yaml"}
    assert run_case(case, inputs, tmp_path / "good") is None
    monkeypatch.setattr("magfusion.jobs.stream.navigate_records", broken)
    result = run_case(case, inputs, tmp_path / "bad")
    assert result is not None
    assert "ZeroDivisionError: a fault" in result


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_what_once_broke_is_answered(path: Path, inputs: Path, tmp_path: Path) -> None:
    assert run_case(json.loads(path.read_text()), inputs, tmp_path / "place") is None


@pytest.mark.slow
def test_two_hundred_inputs_break_nothing(tmp_path: Path) -> None:
    """The same ones each time; ``tools/fuzz.py`` makes as many others as there is time for."""
    ran, finds = fuzz(200, 900.0, 0, tmp_path)
    assert ran >= 200
    assert not finds, finds
