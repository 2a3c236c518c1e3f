"""Where an earlier result goes when a job writes to its directory again."""

import json
from pathlib import Path

import pytest

from magfusion.errors import InputError
from magfusion.jobs.result_directory import claim
from magfusion.jobs.written import CHECKPOINT, KEPT


def earlier(place: Path, job: str, *others: str) -> None:
    place.mkdir()
    (place / "report.json").write_text(json.dumps({"job": job}))
    for name in others:
        (place / name).mkdir() if name == KEPT else (place / name).write_bytes(b"")


def again(place: Path, job: str, *, overwrite: bool = False) -> None:
    with claim(place, job, overwrite=overwrite) as whole:
        (whole / "report.json").write_text(json.dumps({"job": job, "again": True}))


def names(place: Path) -> set[str]:
    return {entry.name for entry in place.iterdir()}


def test_a_result_of_several_logs_can_still_be_extended_where_it_is_moved(tmp_path: Path) -> None:
    earlier(tmp_path / "run", "smooth", KEPT)
    again(tmp_path / "run", "smooth")
    assert names(tmp_path / "run") == {"report.json"}
    assert names(tmp_path / "run.1") == {"report.json", KEPT}


def test_a_checkpoint_of_the_run_that_ends_is_not_moved(tmp_path: Path) -> None:
    earlier(tmp_path / "run", "navigate", CHECKPOINT)
    again(tmp_path / "run", "navigate")
    again(tmp_path / "run", "navigate")
    assert [names(tmp_path / name) for name in ("run", "run.1", "run.2")] == [{"report.json"}] * 3
    again(tmp_path / "run", "navigate", overwrite=True)
    assert names(tmp_path) == {"run", "run.1", "run.2"}


def test_a_job_that_fails_leaves_the_earlier_result(tmp_path: Path) -> None:
    earlier(tmp_path / "run", "fix")
    with pytest.raises(RuntimeError), claim(tmp_path / "run", "fix"):
        raise RuntimeError
    with pytest.raises(InputError):
        again(tmp_path / "run", "smooth")
    assert names(tmp_path) == {"run"}
