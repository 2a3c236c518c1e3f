"""Every command does its job, and tells what cannot be known."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import Refuse, Worked, change_table, run_command
from evo.tools import file_interface
from rerun.chunk import RrdReader

from magfusion.cli import main
from magfusion.files.bag_topics import Topics
from magfusion.files.log import read_log
from magfusion.files.site import load_site
from magfusion.jobs.inputs import read_estimate, topics_option

CONSOLE_SCRIPT = Path(sys.executable).parent / "magfusion"


def test_a_job_without_an_output_is_named_after_its_log(
    worked: Worked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_command("fix", worked.log)
    assert (tmp_path / "log_fix" / "fixes.parquet").is_file()


# What cannot be known -------------------------------------------------------------------------


def _site_of_one_beacon(log: Path, path: Path, coils: int, synchronised: bool) -> Path:
    site = yaml.safe_load((log / "site.yaml").read_text())
    beacon = site["beacons"][0]
    beacon["coils"] = beacon["coils"][:coils]
    beacon["synchronised"] = synchronised
    path.write_text(yaml.safe_dump({**site, "beacons": [beacon]}))
    return path


def test_fixes_of_one_beacon_are_told_to_be_ambiguous(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A dipole's field is the same on its other side: no epoch can tell which."""
    site = _site_of_one_beacon(worked.log, tmp_path / "site.yaml", 2, True)
    run_command("simulate", "--site", site, "-o", tmp_path / "log", "--duration", 8)
    run_command("fix", tmp_path / "log", "-o", tmp_path / "run")
    out, figures = capfd.readouterr().out, _report(tmp_path / "run")
    assert figures["ambiguous_epochs"] == figures["epochs"]
    assert "epochs are ambiguous: fixes.parquet has every pose" in out


@pytest.mark.slow
def test_what_one_coil_leaves_open_is_told_and_not_smoothed_over(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = _site_of_one_beacon(worked.log, tmp_path / "site.yaml", 1, True)
    log = tmp_path / "log"
    run_command("simulate", "--site", site, "-o", log, "--duration", 8, "--motion", "static")
    run_command("fix", log, "-o", tmp_path / "fixes")
    out, figures = capfd.readouterr().out, _report(tmp_path / "fixes")
    assert figures["undetermined_epochs"] == figures["epochs"]
    assert "do not determine the pose in one direction" in out
    with pytest.raises(SystemExit) as ended:
        main(["smooth", str(log), "-o", str(tmp_path / "run"), "--window", "0.4"])
    err = capfd.readouterr().err
    assert ended.value.code == 1
    assert err.count("\n") == 1
    assert "add a beacon or a coil" in err
    assert "single-epoch fixes are saved" in err
    assert json.loads((tmp_path / "run" / "report.json").read_text())["failed"] in err
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"report.json", "failed"}
    assert (tmp_path / "run" / "failed" / "fixes.parquet").is_file()


# The good ways --------------------------------------------------------------------------------


def _report(directory: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((directory / "report.json").read_text())
    return report


def _errors_of(figures: Mapping[str, Any]) -> dict[str, float]:
    keys = ("ate_m", "attitude_rmse_deg", "aligned_ate_m", "rpe_translation_m", "nees_mean")
    return {key: figures[key] for key in keys}


def test_smoothing_is_better_than_fixing(worked: Worked) -> None:
    smoothed, fixed = _report(worked.smoothed), _report(worked.fixes)
    assert smoothed["ate_m"] < fixed["ate_m"] < 0.01  # m
    assert smoothed["attitude_rmse_deg"] < 0.5  # deg


def test_with_json_the_report_is_all_that_is_printed(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site.yaml"
    beacon = "A position_m=0,0,1 rpy_deg=0,0,90 frequency_hz=25 moment_a_m2=220 axes=xy"
    parts = ["--imu", "BMI088", "--magnetometer", "RM3100", "--beacon", beacon]
    run_command("init", *parts, "-o", site, "--json")
    assert json.loads(capfd.readouterr().out)["job"] == "init"
    lines = {
        "simulate": ["simulate", "--duration", 2],
        "demodulate": ["demodulate", worked.log],
        "fix": ["fix", worked.log],
        "smooth": ["smooth", worked.log, "--end", 5],
        "demo": ["demo", "--duration", 5, "--no-show"],
        "check": ["check", worked.log, "--end", 5],
        "navigate": ["navigate", worked.log, "--estimator", "ekf"],
    }
    for name, line in lines.items():
        run_command(*line, "-o", tmp_path / name, "--json")
        out, err = capfd.readouterr()
        assert json.loads(out) == _report(tmp_path / name)
        assert err == ""
        assert out.count("\n") == 1


@pytest.mark.slow
def test_the_screen_has_errors_and_sigmas_by_axis_in_a_few_lines(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_command("smooth", worked.log, "-o", tmp_path / "run")
    lines, report = capfd.readouterr().out.splitlines(), _report(tmp_path / "run")
    assert lines[:2] == ["smooth of simulated_walk", "TRUSTWORTHY"]
    assert len(lines) <= 12
    rows = {line.split()[0]: line.split()[1:] for line in lines[2:5]}
    assert " ".join(rows["rms"]) == "x mm y mm z mm rot x ° rot y ° yaw °"
    for row in ("error", "sigma"):
        expected = [1e3 * report[f"{row}_{axis}_m"] for axis in "xyz"]
        expected += [report[f"{row}_{axis}_deg"] for axis in ("rot_x", "rot_y", "yaw")]
        assert [float(value) for value in rows[row]] == pytest.approx(expected, rel=0.05, abs=0.1)
    assert lines[-1] == f"results in {tmp_path / 'run'}"
    assert not any("imu.time_offset" in line for line in lines)


@pytest.mark.slow
def test_with_verbose_the_screen_has_the_calibration_and_with_quiet_the_verdict_alone(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_command("smooth", worked.log, "-o", tmp_path / "run", "-v")
    lines = capfd.readouterr().out.splitlines()
    row = next(line for line in lines if "imu.time_offset (s)" in line).split()
    assert row[-2:] == ["0.01", "yes"]
    run_command("check", worked.log, "--quiet")
    assert capfd.readouterr().out == "check of simulated_walk: trustworthy\n"


def test_verbose_and_quiet_exclude_each_other(worked: Worked, refuse: Refuse) -> None:
    assert "give one of them" in refuse("check", worked.log, "-q", "-v")


def test_evaluate_tells_what_smooth_told(worked: Worked, capfd: pytest.CaptureFixture[str]) -> None:
    run_command("evaluate", worked.smoothed, worked.log, "--json")
    reported = _errors_of(json.loads(capfd.readouterr().out.splitlines()[-1]))
    expected = _errors_of(_report(worked.smoothed))
    assert reported == pytest.approx(expected, rel=1e-5)  # stamps are written to the nanosecond


def test_evaluate_reads_tum_tables_and_directories_alike(
    worked: Worked, capfd: pytest.CaptureFixture[str]
) -> None:
    ate = []
    for estimate in ("", "trajectory.tum", "trajectory.parquet"):
        for truth in ("", "truth.parquet"):
            run_command("evaluate", worked.smoothed / estimate, worked.log / truth, "--json")
            ate.append(json.loads(capfd.readouterr().out.splitlines()[-1])["ate_m"])
    assert ate == pytest.approx([ate[0]] * 6, abs=1e-6)  # m; TUM holds nine digits


def test_evaluate_without_common_time_names_both_files(
    worked: Worked, log: Path, refuse: Refuse
) -> None:
    change_table(
        log / "truth.parquet", lambda c: c.update(time_ns=[t + 10**12 for t in c["time_ns"]])
    )
    sentence = refuse("evaluate", worked.smoothed, log)
    assert str(worked.smoothed) in sentence
    assert str(log) in sentence
    assert "same clock" in sentence


def test_a_truth_elsewhere_costs_the_comparison_and_not_the_trajectory(
    log: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    change_table(
        log / "truth.parquet", lambda c: c.update(time_ns=[t + 10**12 for t in c["time_ns"]])
    )
    run_command("smooth", log, "-o", tmp_path / "run", "--coupling", "loose")
    assert "There is no comparison with the truth" in capfd.readouterr().out
    assert "ate_m" not in _report(tmp_path / "run")


@pytest.mark.slow
def test_phasors_smooth_nearly_as_well_as_the_waveform(worked: Worked, tmp_path: Path) -> None:
    run_command("smooth", worked.phasors, "-o", tmp_path / "run")
    assert _report(tmp_path / "run")["ate_m"] < 2.0 * _report(worked.smoothed)["ate_m"] + 0.002  # m


def test_evo_reads_the_trajectory(worked: Worked) -> None:
    read = file_interface.read_tum_trajectory_file(worked.smoothed / "trajectory.tum")
    result = read_estimate(worked.smoothed)
    assert np.max(np.abs(read.positions_xyz - result.position_world)) < 1e-8  # m; nine digits
    assert np.max(np.abs(read.timestamps - result.time)) < 1e-6  # s; a double at today's date


def test_the_recording_can_be_read_back(worked: Worked) -> None:
    chunks = RrdReader(worked.smoothed / "run.rrd").stream().to_chunks()
    expected = {"/world/estimate/path", "/world/truth/path", "/plots/position_error_mm/x/error"}
    assert expected <= {chunk.entity_path for chunk in chunks}


@pytest.mark.slow
def test_the_refined_site_can_be_fed_back_in(worked: Worked, tmp_path: Path) -> None:
    site = worked.smoothed / "site.yaml"
    record = load_site(site).calibration
    assert record is not None
    assert record["determined"] == _report(worked.smoothed)["determined"]
    run_command("smooth", worked.log, "--site", site, "-o", tmp_path / "again")
    first, again = _report(worked.smoothed), _report(tmp_path / "again")
    assert again["time_offset_s"] == pytest.approx(
        first["time_offset_s"], abs=first["imu.time_offset_s_sigma"]
    )
    assert again["ate_m"] < 2.0 * first["ate_m"]


@pytest.mark.slow
def test_the_rate_of_the_imu_fills_the_gaps_between_epochs(worked: Worked, tmp_path: Path) -> None:
    run_command("smooth", worked.log, "-o", tmp_path / "run", "--rate", "imu")
    dense, truth = read_estimate(tmp_path / "run"), read_log(worked.log).truth
    assert truth is not None
    assert 1.0 / np.median(np.diff(dense.time)) == pytest.approx(200.0, rel=1e-3)  # Hz
    run_command("evaluate", tmp_path / "run", worked.log)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ["--robust", "huber", "--window", "0.3"],
        ["--robust", "cauchy", "--step", "0.3"],
        ["--estimate", "none", "--mains-hz", "60"],
        ["--estimate", "time-offset,magnetometer", "--coupling", "loose"],
    ],
    ids=" ".join,
)
def test_every_way_of_smoothing_finds_the_trajectory(
    options: list[str], worked: Worked, tmp_path: Path
) -> None:
    run_command("smooth", worked.log, "-o", tmp_path / "run", *options)
    figures = _report(tmp_path / "run")
    assert figures["ate_m"] < 0.02  # m
    assert figures["attitude_rmse_deg"] < 1.0  # deg


@pytest.mark.slow
def test_a_part_of_a_log_is_smoothed_alone(worked: Worked, tmp_path: Path) -> None:
    run_command("smooth", worked.log, "-o", tmp_path / "run", "--start", 3, "--end", 9)
    time = read_estimate(tmp_path / "run", read_log(worked.log).epoch_ns).time
    assert 3.0 <= time[0] < 3.5  # s
    assert 8.5 < time[-1] <= 9.0  # s


def test_the_same_seed_gives_the_same_log(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        run_command("simulate", "-o", tmp_path / name, "--duration", 2, "--seed", seed)
    a, b, c = (read_log(tmp_path / name).imu.gyro_body for name in "abc")
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_topics_are_given_by_their_role() -> None:
    result = topics_option("imu=/imu/data, truth=/odom")
    assert result == Topics(imu="/imu/data", magnetometer=None, truth="/odom")


def test_view_opens_the_recording(worked: Worked, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    monkeypatch.setattr("magfusion.results.recording.open_viewer", opened.append)
    run_command("view", worked.smoothed)
    run_command("view", worked.smoothed / "run.rrd")
    assert opened == [worked.smoothed / "run.rrd"] * 2


# The console script ---------------------------------------------------------------------------


def _script(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(CONSOLE_SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_console_script_keeps_the_contract(worked: Worked, tmp_path: Path) -> None:
    good = _script("evaluate", worked.smoothed, worked.log, "--json")
    assert (good.returncode, good.stderr) == (0, "")
    assert json.loads(good.stdout)["job"] == "evaluate"
    bad = _script("fix", tmp_path / "none", "-o", tmp_path / "run")
    assert (bad.returncode, bad.stdout, bad.stderr.count("\n")) == (2, "", 1)
    usage = _script("fix", "--frobnicate")
    assert (usage.returncode, usage.stdout, usage.stderr.count("\n")) == (2, "", 1)


def test_an_earlier_result_is_moved_aside_unless_it_is_to_be_replaced(
    worked: Worked, tmp_path: Path
) -> None:
    run = shutil.copytree(worked.fixes, tmp_path / "run")
    (tmp_path / "run.1").write_text("a user's")
    earlier = (run / "fixes.parquet").read_bytes()
    moved = _script("fix", worked.log, "-o", run, "--end", 5, "--json")
    assert (moved.returncode, json.loads(moved.stdout)["job"]) == (0, "fix")
    assert moved.stderr.count("\n") == 1
    assert "earlier result is now in run.2" in moved.stderr
    assert (tmp_path / "run.2" / "fixes.parquet").read_bytes() == earlier
    assert (run / "fixes.parquet").read_bytes() != earlier
    replaced = _script("fix", worked.log, "-o", run, "--overwrite")
    assert (replaced.returncode, replaced.stderr) == (0, "")
    assert (run / "fixes.parquet").read_bytes() == earlier
    # Nothing moves for invalid input.
    bad = _script("fix", worked.log, "-o", run, "--start", 1e6)
    assert bad.returncode == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.1", "run.2"]


def test_help_and_version_are_told(capfd: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["--help"], ["smooth", "--help"]):
        run_command(*arguments)
        assert "Usage: magfusion" in capfd.readouterr().out
    run_command("--version")
    assert re.fullmatch(r"magfusion \d+\.\d+\.\d+( \(commit .+\))?\n", capfd.readouterr().out)
