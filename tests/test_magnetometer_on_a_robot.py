"""A magnetometer on a robot: jittered stamps, 90 uT of hard iron, little turning, no IMU."""

import re
from pathlib import Path

import magnetometer_on_a_robot as scenario
import numpy as np
import pytest
from conftest import run_command

from magfusion.calibration.magnetometer_size import calibrate_alone
from magfusion.calibration.static_field import static_field
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.calibrate_magnetometer import run_calibrate_magnetometer
from magfusion.jobs.inputs import Job
from magfusion.receiver.bursts import spread_bursts
from magfusion.receiver.even_clocks import on_even_clocks

LIMIT = scenario.LIMIT


def written(case: scenario.Case, place: Path) -> tuple[Path, np.ndarray]:
    log, site, true = scenario.recorded(case)
    write_log(log, place / "log")
    save_site(site, place / "log" / "site.yaml")
    return place / "log", true


@pytest.mark.parametrize("host", [pytest.param("jitter", marks=pytest.mark.slow), "bursts"])
def test_stamps_of_a_host_give_way_to_the_clock_of_the_sensor(host: scenario.Host) -> None:
    log, site, _ = scenario.recorded(
        scenario.Case(90.0, 3, host, "as declared", "nothing", duration=20.0)
    )
    even = on_even_clocks(log, site)
    for name, step in (("imu", 0.9999 / 200.0), ("magnetometer", 1.0001 / 100.0)):
        stream = even.imu if name == "imu" else even.waveform
        assert stream is not None
        off = stream.time - step * np.round((stream.time - stream.time[0]) / step)
        # Arrival is later than the sample; by how much only the stream's beginning tells.
        assert np.std(off) < 0.1 * step
        assert even.clocks[name].replaced
    readings = static_field(even.waveform, even.imu, site)
    assert len(readings) > 80


def test_bursts_are_spread_and_nothing_else_is() -> None:
    selected = 0.01 * np.arange(400)
    assert spread_bursts(selected) is None
    assert spread_bursts(selected + 0.003 * np.random.default_rng(1).random(400)) is None
    arrived = 0.04 * np.ceil(selected / 0.04 + 1e-9) + 1e-4 * (np.arange(400) % 4)
    spread = spread_bursts(arrived)
    assert spread is not None
    late = spread - selected
    assert np.ptp(late) < 0.011
    switched = (selected + 0.96 * np.repeat(np.arange(4), 100)).copy()
    assert spread_bursts(switched) is None


def test_a_robots_hard_iron_is_found_by_turning_as_far_as_a_wrist_does() -> None:
    case = scenario.Case(90.0, 2, "jitter", "as declared", "nothing", duration=20.0)
    row = scenario.judge_run(case)
    assert (row.verdict, row.determined, row.wrong) == ("trustworthy", 3, False)


@pytest.mark.parametrize("imu", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_field_that_is_not_the_sites_is_named_as_the_cause(imu: bool) -> None:
    given = ("jitter", "30 uT indoors", "room for iron")
    row = scenario.judge_run(scenario.Case(180.0, 2, *given, imu, duration=20.0))
    reported = r"field of (29|30|31)[.\d]* uT.* the site declares 47.9 uT: steel is near"
    assert row.verdict == "failed"
    assert re.search(reported, row.findings), row.findings


def test_without_an_imu_the_size_of_the_field_tells_shape_and_offset() -> None:
    case = scenario.Case(120.0, 3, "bursts", "as declared", "nothing", False, duration=20.0)
    row = scenario.judge_run(case)
    assert (row.verdict, row.determined, row.wrong) == ("trustworthy", 3, False)


@pytest.mark.slow
def test_a_log_without_an_imu_makes_a_site_and_says_what_it_lacks(tmp_path: Path) -> None:
    case = scenario.Case(120.0, 3, "jitter", "as declared", "nothing", False, duration=30.0)
    log, true = written(case, tmp_path)
    report = run_calibrate_magnetometer(Job(log, None, tmp_path / "out"))
    result = load_site(tmp_path / "out" / "site.yaml", without=True).platform.magnetometer
    assert np.max(np.abs(result.offset - true)) < LIMIT
    assert np.max(np.abs(result.offset - true) / result.sigma.offset) < scenario.SIGMAS
    notes = report["notes"]
    assert isinstance(notes, list)
    assert any("no IMU" in note for note in notes)
    # Which rotation made a sphere of it the size does not tell: that stays as it was declared.
    remaining, _, right = np.linalg.svd(result.matrix)
    assert np.max(np.abs(remaining @ right - np.eye(3))) < 0.02


@pytest.mark.slow
def test_of_one_axis_the_mirror_image_is_not_taken_for_the_offset() -> None:
    case = scenario.Case(180.0, 1, "jitter", "as declared", "room for iron", False, seed=2)
    log, site, true = scenario.recorded(case)
    log = clean_log(log, site)
    assert log.waveform is not None
    result = calibrate_alone(log.waveform, site)
    own = np.abs(result.graph.fit.offset - true) < 3.5 * result.magnetometer.sigma.offset
    assert result.rival is not None or np.all(own)


@pytest.mark.slow
@pytest.mark.parametrize("host", scenario.HOSTS)
def test_one_command_makes_a_site_that_the_other_jobs_take(
    host: scenario.Host, tmp_path: Path
) -> None:
    case = scenario.Case(90.0, 3, host, "as declared", "nothing", duration=30.0)
    log, _ = written(case, tmp_path)
    run_command("calibrate", "magnetometer", log, "-o", tmp_path / "found")
    given = (log, "--site", tmp_path / "found" / "site.yaml")
    run_command("check", *given)
    run_command("smooth", *given, "-o", tmp_path / "smoothed")
    run_command("navigate", *given, "-o", tmp_path / "navigated")
    angles = ("--gravity", "--angles", "roll-pitch-yaw")
    run_command("match", *given, *angles, "-o", tmp_path / "matched")


@pytest.mark.slow
@pytest.mark.parametrize("imu", [True, False])
def test_nothing_is_called_determined_and_wrong(imu: bool) -> None:
    rows = [
        scenario.judge_run(scenario.Case(turn, axes, "jitter", field, declared, imu, duration=40.0))
        for turn, axes in ((45.0, 2), (180.0, 1))
        for field in scenario.FIELDS
        for declared in ("sheet", "nothing")
    ]
    assert not [scenario.line(row) for row in rows if row.wrong]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.slow), 5])
def test_one_axis_and_a_field_of_unknown_size_determine_no_offset(seed: int) -> None:
    case = scenario.Case(90.0, 1, "bursts", "not declared", "room for iron", seed=seed)
    row = scenario.judge_run(case)
    assert row.verdict in ("refused", "failed")
    assert "earth_field_t" in row.findings
