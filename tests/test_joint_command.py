"""magfusion smooth LOGS, calibrate log LOGS: one site by several logs, its table, its refusals."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, run_command
from test_joint import log_of, surveyed

from magfusion.cli import main
from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.integrity.logs_agree import LogAgreement
from magfusion.files.kept import digest_of_files
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_run import tasks_of, trust_of_all
from magfusion.model.steel_field import SteelField
from magfusion.model.trust import Finding
from magfusion.simulation.log import perturb_site


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory of two logs of one site, and its file."""
    root = tmp_path_factory.mktemp("recorded")
    true = perturb_site(surveyed(), np.random.default_rng(5))
    save_site(surveyed(), root / "site.yaml")
    for which in range(2):
        write_log(log_of(true, which), root / f"log{which}")
    return root


def given(recorded: Path, *names: str) -> list[Path | str]:
    return [*(recorded / name for name in names), "--site", recorded / "site.yaml"]


@pytest.fixture(scope="module")
def calibrated(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("calibrated") / "out"
    run_command(
        *("calibrate", "log", *given(recorded, "log0", "log1")), "-o", output, "--workers", 1
    )
    return output


@pytest.mark.slow
def test_two_logs_make_one_site_and_one_table(calibrated: Path) -> None:
    names = {path.name for path in calibrated.iterdir()}
    assert names == {
        *("site.yaml", "site_correlation.parquet", "calibration.png"),
        *("report.json", "report.html", "logs.csv", "kept"),
    }
    report: dict[str, Any] = json.loads((calibrated / "report.json").read_text())
    assert report["job"] == "calibrate log"
    assert report["log"] == "log0, log1"
    assert report["verdict"] in ("trustworthy", "doubtful")
    assert report["logs_used"] == 2
    with (calibrated / "logs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, reported in zip(rows, report["logs"], strict=True):
        assert {key: "" if value is None else str(value) for key, value in reported.items()} == row
        assert reported["position_sigma_m"] > 0.0
        assert reported["verdict"] in ("trustworthy", "doubtful")
        assert (reported["reason"] == "") == (reported["verdict"] == "trustworthy")
    assert "log1" in (calibrated / "report.html").read_text()
    before, after = surveyed(), load_site(calibrated / "site.yaml")
    assert after.calibration is not None
    assert after.beacons[1].sigma.log_moment[0] < before.beacons[1].sigma.log_moment[0]
    # Of the IMU's clock each log has its own, and the site keeps what it declared.
    assert after.platform.imu.time_offset == before.platform.imu.time_offset
    assert after.platform.imu.time_offset_sigma == before.platform.imu.time_offset_sigma


@pytest.mark.slow
def test_a_rerun_takes_up_what_is_done_and_what_made_it(
    recorded: Path,
    calibrated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    output = shutil.copytree(calibrated, tmp_path / "out")
    before = json.loads((output / "report.json").read_text())

    def never(*_arguments: object, **_others: object) -> None:
        raise AssertionError("smoothed again")

    monkeypatch.setattr("magfusion.jobs.joint_tasks.smooth", never)
    again = ("calibrate", "log", *given(recorded, "log0", "log1"), "-o", output, "--workers", 1)
    run_command(*again)
    after = json.loads((output / "report.json").read_text())
    assert after.pop("elapsed_s") != before.pop("elapsed_s")
    assert after == before
    capfd.readouterr()
    with pytest.raises(SystemExit) as ended:
        main([str(part) for part in (*again, "--end", 2.9)])
    assert ended.value.code == 1
    assert "smoothed again" in capfd.readouterr().err


def test_logs_that_cannot_be_refined_together_are_refused(
    recorded: Path, tmp_path: Path, refuse: Refuse
) -> None:
    out = ("-o", tmp_path / "out")
    command = ("calibrate", "log", *given(recorded, "log0", "log1"), *out)
    twice = refuse("smooth", *given(recorded, "log0", "log0"), *out)
    assert "is the same log as" in twice
    copied = shutil.copytree(recorded / "log0", tmp_path / "another")
    assert "is the same log as" in refuse(
        "smooth", recorded / "log0", copied, "--site", recorded / "site.yaml", *out
    )
    for which in range(2):
        shutil.copytree(recorded / f"log{which}", tmp_path / f"log{which}")
        site = surveyed()
        save_site(
            replace(site, gravity=site.gravity + 0.001 * which), tmp_path / f"log{which}/site.yaml"
        )
    other = refuse("calibrate", "log", tmp_path / "log0", tmp_path / "log1", *out)
    assert "share its file but for the platform: give it with --site" in other
    assert "splits one log" in refuse(*command, "--cross-validate", 2)
    assert "nothing to refine together" in refuse(*command, "--estimate", "none")
    assert "nothing to refine together" in refuse(*command, "--estimate", "phase,time-offset")
    loose = ("smooth", *given(recorded, "log0", "log1"), "--coupling", "loose", *out)
    assert "nothing to refine together" in refuse(*loose)
    one = ("smooth", *given(recorded, "log0"), *out)
    assert "one log was given" in refuse(*one, "--workers", 2)
    assert "none" in refuse("smooth", *given(recorded, "log0", "none"), *out)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert "holds other files" in refuse(*command[:-1], tmp_path / "full")


def test_a_solution_is_kept_for_one_map_whatever_its_name(recorded: Path, tmp_path: Path) -> None:
    """Steel with other moments is another model of the fields."""
    keys = []
    for moment in (1.0, 1.0, 2.0):  # A m^2
        steel = SteelField(np.zeros((1, 3)), np.ones(1), np.full((1, 2, 3), moment))
        first, *others = surveyed().beacons
        mapped = (replace(first, steel=steel), *others)
        save_site(replace(surveyed(), beacons=mapped), tmp_path / "room.yaml")
        jobs = [Job(recorded / f"log{i}", tmp_path / "room.yaml", tmp_path) for i in range(2)]
        keys.append([task.key for task in tasks_of(jobs, SmootherSettings(), tmp_path / "out")])
    assert keys[0] == keys[1]
    assert not set(keys[0]) & set(keys[2])


def test_a_digest_sees_content_and_names_but_not_places(tmp_path: Path) -> None:
    for place, names in (("a", "xy"), ("b", "xy"), ("c", "xz")):
        (tmp_path / place).mkdir()
        for name in names:
            (tmp_path / place / name).write_text(name.replace("z", "y"))
    a, b, c = (digest_of_files([tmp_path / place]) for place in "abc")
    assert a == b != c
    x = frozenset("x")
    assert digest_of_files([tmp_path / "a"], without=x) != a
    (tmp_path / "b" / "x").write_text("other")
    assert digest_of_files([tmp_path / "b"]) != a
    assert digest_of_files([tmp_path / "b"], without=x) == digest_of_files(
        [tmp_path / "a"], without=x
    )


def row(name: str, **facts: str) -> dict[str, Any]:
    return {"log": name, "used": "yes", "verdict": "trustworthy", "code": "", "reason": ""} | facts


def test_nothing_is_left_out_in_silence() -> None:
    agreed = LogAgreement(((), ()), 1.0, np.zeros(2))
    good = [row("a"), row("b")]
    assert trust_of_all(good, agreed, [], 0.0).findings == ()
    failed = row("c", used="no", verdict="failed", code="no_solution", reason="No start.")
    result = trust_of_all([*good, failed], agreed, [], 0.0)
    assert [(f.code, f.verdict) for f in result.findings] == [("log_left_out", "doubtful")]
    assert "Log c is not used, as it failed alone: No start." in result.findings[0].text
    (undetected,) = trust_of_all(good, agreed, ["D"], 0.0).findings
    assert undetected.code == "silent_beacon"
    assert "Beacon D is not detected in any log" in undetected.text
    (unsettled,) = trust_of_all(good, agreed, [], 0.2).findings
    assert unsettled.code == "not_converged"
    findings = Finding("logs_disagree", "Log a contradicts log b: it takes all elsewhere.")
    doubtful = [row("a", verdict="doubtful", code=findings.code, reason=findings.text), row("b")]
    once = trust_of_all(doubtful, LogAgreement(((findings,), ()), 3.0, np.zeros(2)), [], 0.0)
    assert once.findings == (findings,)
