"""A short simulated log with the results of every job, and what each refusal must keep to."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet
import pytest

from magfusion.cli import main

Refuse = Callable[..., str]


@dataclass(frozen=True)
class Worked:
    """Directories that the commands wrote."""

    log: Path
    smoothed: Path
    fixes: Path
    phasors: Path


def run_command(*arguments: object) -> None:
    """Run a command that must succeed."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert not ended.value.code


@pytest.fixture(scope="session")
def worked(tmp_path_factory: pytest.TempPathFactory) -> Worked:
    root = tmp_path_factory.mktemp("worked")
    built = Worked(root / "log", root / "smoothed", root / "fixes", root / "phasors")
    run_command("simulate", "-o", built.log, "--duration", 12, "--seed", 1)
    run_command("smooth", built.log, "-o", built.smoothed)
    run_command("fix", built.log, "-o", built.fixes)
    run_command("demodulate", built.log, "-o", built.phasors)
    return built


def change_table(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the columns of a table, as lists, in place."""
    columns = pa.parquet.read_table(path).to_pydict()
    change(columns)
    pa.parquet.write_table(pa.table(columns), path)


def _listing(root: Path) -> dict[str, tuple[int, int]]:
    result = {}
    for path in root.rglob("*"):  # hidden names too
        stat = path.lstat()
        result[str(path.relative_to(root))] = (stat.st_size, stat.st_mtime_ns)
    return result


@pytest.fixture
def refuse(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Refuse:
    """Run a command that must be refused in one sentence without a trace; return the sentence."""

    def run(*arguments: object, status: int = 2) -> str:
        before = _listing(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert ended.value.code == status
        assert out == ""
        assert err.startswith("magfusion")
        assert err.count("\n") == 1
        assert err.endswith("\n")
        assert "Traceback" not in err
        assert _listing(tmp_path) == before
        return err

    return run


@pytest.fixture
def log(worked: Worked, tmp_path: Path) -> Path:
    """Return a log that a test may spoil."""
    return shutil.copytree(worked.log, tmp_path / "log")
