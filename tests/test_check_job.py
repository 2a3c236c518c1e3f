"""The check command: figures, verdict and exit code, with a site and without one."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, Worked, change_table, run_command

from magfusion.cli import main

HEAD = {"verdict", "reasons", "remarks", "unverified"}


def checked(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, object]]:
    """Return exit code and report of a check."""
    with pytest.raises(SystemExit) as ended:
        main(["check", *(str(argument) for argument in arguments), "--json"])
    report: dict[str, object] = json.loads(capfd.readouterr().out.splitlines()[-1])
    return int(ended.value.code or 0), report


@pytest.fixture
def spoiled(worked: Worked, tmp_path: Path) -> Path:
    """Return a copy of a good log."""
    shutil.copytree(worked.log, tmp_path / "spoiled")
    return tmp_path / "spoiled"


def test_a_good_log_is_trustworthy_and_nothing_is_written(
    worked: Worked,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, report = checked(capfd, worked.log)
    assert code == 0
    assert report["verdict"] == "trustworthy"
    assert report["reasons"] == []
    assert set(report) >= HEAD
    assert report["imu_rate_hz"] == pytest.approx(200.0)
    assert report["magnetometer_rate_hz"] == pytest.approx(400.0)
    assert report["gravity_m_s2"] == pytest.approx(9.81, abs=0.3)
    assert report["heard_A"] == 1.0
    assert float(str(report["snr_A"])) > 10.0
    assert float(str(report["fix_residual_rms"])) < 2.0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_report_and_picture_are_written_where_that_is_asked(worked: Worked, tmp_path: Path) -> None:
    run_command("check", worked.log, "-o", tmp_path / "look")
    run_command("check", worked.log, "-o", tmp_path / "look")  # an earlier one is replaced
    assert {p.name for p in (tmp_path / "look").iterdir()} == {
        "check.png",
        "report.html",
        "report.json",
    }
    report = json.loads((tmp_path / "look" / "report.json").read_text())
    assert report["job"] == "check"


def test_what_is_in_the_way_is_refused(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    refuse(2, "mine", "check", worked.log, "-o", tmp_path / "mine")


@pytest.mark.parametrize("name", ["corrected.yaml", "corrected_steel.parquet"])
def test_no_file_is_replaced_by_a_corrected_site(
    name: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    (tmp_path / name).write_text("of the user's")
    sentence = refuse("check", worked.log, "--correct", tmp_path / "corrected.yaml")
    assert f"{name}: exists; give --correct another path" in sentence
    assert (tmp_path / name).read_text() == "of the user's"


@pytest.mark.slow
def test_a_failed_log_exits_with_one_and_says_why_first(
    spoiled: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def reverse(columns: dict[str, list[float]]) -> None:
        for axis in "xyz":
            columns[f"gyro_{axis}"] = [-v for v in columns[f"gyro_{axis}"]]

    change_table(spoiled / "imu.parquet", reverse)
    code, report = checked(capfd, spoiled, "-o", tmp_path / "look")
    assert code == 1
    assert report["verdict"] == "failed"
    reasons = report["reasons"]
    assert isinstance(reasons, list)
    assert reasons[0]["code"] == "gyro_sign"
    assert {p.name for p in (tmp_path / "look").iterdir()} == {"failed", "report.json"}
    assert {p.name for p in (tmp_path / "look" / "failed").iterdir()} == {
        "check.png",
        "report.html",
    }


def test_without_a_site_the_recording_alone_is_judged(
    spoiled: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (spoiled / "site.yaml").unlink()
    code, report = checked(capfd, spoiled)
    assert (code, report["verdict"]) == (0, "trustworthy")
    assert "heard_A" not in report
    lines = report["lines"]
    assert isinstance(lines, list)
    result = sorted(float(line.split()[0]) for line in lines[:4])
    assert result == pytest.approx([20.0, 25.0, 30.0, 35.0], abs=0.1)

    def dead(columns: dict[str, list[float]]) -> None:
        columns["accel_y"] = [0.0] * len(columns["accel_y"])

    change_table(spoiled / "imu.parquet", dead)
    code, report = checked(capfd, spoiled)
    reasons = report["reasons"]
    assert isinstance(reasons, list)
    assert (code, reasons[0]["code"]) == (1, "stuck_axis")


def test_phasors_are_checked_too(worked: Worked, capfd: pytest.CaptureFixture[str]) -> None:
    code, report = checked(capfd, worked.phasors)
    assert (code, report["verdict"]) == (0, "trustworthy")
    assert report["heard_D"] == 1.0


def test_gravity_that_was_removed_is_not_called_another_unit(
    spoiled: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of the size of one g in g, and in all directions."""
    rng = np.random.default_rng(7)

    def shaken(columns: dict[str, list[float]]) -> None:
        for axis in "xyz":
            columns[f"accel_{axis}"] = list(rng.normal(0.0, 0.65, len(columns["accel_x"])))

    change_table(spoiled / "imu.parquet", shaken)
    code, report = checked(capfd, spoiled)
    reasons = report["reasons"]
    assert isinstance(reasons, list)
    assert (code, reasons[0]["code"]) == (1, "gravity_missing")
    assert "in g." not in str(reasons)


def test_a_log_of_which_nothing_can_be_demodulated_says_so(
    spoiled: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A magnetometer whose range is half of what it should measure."""

    def limit(columns: dict[str, list[float]]) -> None:
        for axis in "xyz":
            largest = 0.7 * max(abs(v) for v in columns[f"field_{axis}"])
            columns[f"field_{axis}"] = [
                max(-largest, min(largest, v)) for v in columns[f"field_{axis}"]
            ]

    change_table(spoiled / "magnetometer.parquet", limit)
    _, report = checked(capfd, spoiled)
    reasons = report["reasons"]
    assert isinstance(reasons, list)
    assert reasons[0]["code"] == "saturated"
