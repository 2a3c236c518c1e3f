"""A survey from a log, and the paper's algorithms on a log with a survey, through real files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import yaml
from conftest import Refuse, Worked, change_table, run_command
from scipy.spatial.transform import Rotation

from magfusion.files.log import read_log
from magfusion.files.survey import Survey, read_survey
from magfusion.jobs.inputs import known_poses, read_estimate
from magfusion.jobs.survey import make_survey
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.field import Drives, phasors_world
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

PAPER = ("paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint")
STOPS_WORLD = np.array([[2.0, 2.0, 1.0], [3.0, 2.0, 1.2], [3.1, 2.0, 1.2], [4.0, 3.0, 0.8]])  # m
REST, WALK = 6.0, 2.0  # s


def _report(directory: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((directory / "report.json").read_text())
    return report


# Stops ----------------------------------------------------------------------------------------


def _stop_and_go() -> tuple[Trajectory, Log]:
    """Return poses at 10 Hz, resting at each stop, and an IMU that feels when they move."""
    arrival = (REST + WALK) * np.arange(len(STOPS_WORLD))
    knots = np.stack([arrival, arrival + REST], axis=1).ravel()
    time = np.arange(0.0, knots[-1], 0.1)
    path = np.repeat(STOPS_WORLD, 2, axis=0)
    position = np.stack([np.interp(time, knots, p) for p in path.T], axis=1)
    turn = np.interp(time, knots, np.repeat(np.arange(4.0), 2))
    heading = Rotation.from_euler("z", turn[:, None])
    poses = Trajectory(time, heading.as_matrix(), position)
    stamps = np.arange(0.0, knots[-1], 0.01)
    moving = (stamps % (REST + WALK)) > REST
    accel = np.array([0.0, 0.0, 9.81]) + moving[:, None] * np.sin(20.0 * stamps)[:, None]
    imu = ImuSamples(stamps, np.zeros((len(stamps), 3)), accel)
    return poses, Log("stop and go", 0, "test", imu, truth=poses)


def _survey(
    site: Site, sigma: float = 1e-9, drives: Drives | None = None, **settings: Any
) -> tuple[Survey, dict[str, int]]:
    poses, log = _stop_and_go()
    samples = simulate_fields(site, poses, sigma, np.random.default_rng(1), drives)
    return make_survey(samples, poses, log, site, **settings)


def _expected(site: Site, survey: Survey) -> Array:
    sensor = site.platform.magnetometer
    point = survey.position_world + survey.world_from_body @ sensor.position_body
    world = np.concatenate([phasors_world(b, point) for b in site.beacons], axis=1)
    return np.asarray(world @ survey.world_from_body @ sensor.body_from_sensor @ sensor.matrix.T)


def test_each_stop_is_a_point_with_the_mean_phasor_and_its_sigma() -> None:
    site = demo_site()
    survey, dropped = _survey(site)
    np.testing.assert_allclose(survey.position_world, STOPS_WORLD, rtol=0, atol=1e-9)
    assert set(dropped) == {"moving"}
    assert survey.phasor_sensor is not None
    error = (survey.phasor_sensor - _expected(site, survey)) / survey.sigma[..., None]
    parts = np.concatenate([error.real, error.imag])
    # Windows of 0.4 s every 0.1 s, here with independent noise: four times what sigma counts.
    assert np.sqrt(np.mean(parts**2)) == pytest.approx(0.5, abs=0.1)


def test_points_too_close_are_dropped_with_their_reason() -> None:
    survey, dropped = _survey(demo_site(), spacing=0.2)
    np.testing.assert_allclose(survey.position_world, STOPS_WORLD[[0, 1, 3]], rtol=0, atol=1e-9)
    assert dropped["too close to another point"] > 30  # epochs


def test_moving_epochs_are_points_where_that_is_asked() -> None:
    survey, dropped = _survey(demo_site(), points="epochs", spacing=0.1)
    between = np.linalg.norm(survey.position_world[:, None] - survey.position_world, axis=-1)
    assert len(survey) > 15
    assert np.min(between + np.eye(len(survey))) >= 0.1 - 1e-6  # m
    assert "moving" not in dropped


def test_what_glides_is_not_one_stop() -> None:
    """At constant speed an IMU feels as if at rest; the poses tell."""
    poses, log = _stop_and_go()
    glide = np.linspace([2.0, 2.0, 1.0], [4.0, 2.0, 1.0], len(poses))
    poses = replace(poses, position_world=glide)
    site = demo_site()
    samples = simulate_fields(site, poses, 1e-9, np.random.default_rng(2))
    survey, _ = make_survey(samples, poses, log, site)
    assert len(survey) > 30
    assert survey.phasor_sensor is not None
    error = np.abs(survey.phasor_sensor - _expected(site, survey)) / np.abs(survey.phasor_sensor)
    assert np.median(error) < 0.01


def test_a_drifting_phase_costs_no_amplitude() -> None:
    site = demo_site(synchronised=False)
    drives = Drives(np.array([0.3, 1.0, 2.0, -1.0]), np.full(4, 2e-3))  # 4 rad in a stop
    survey, _ = _survey(site, 1e-11, drives)
    assert survey.phasor_sensor is not None
    size = np.linalg.norm(survey.phasor_sensor, axis=2)
    np.testing.assert_allclose(size, np.linalg.norm(_expected(site, survey), axis=2), rtol=1e-3)


# Files ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a log of a minute, and a survey made of its moving epochs."""
    root = tmp_path_factory.mktemp("surveyed")
    run_command("simulate", "-o", root / "log", "--duration", 60, "--seed", 1)
    points = ("--points", "epochs", "--spacing", 0.3)
    for _ in range(2):  # an earlier result is replaced
        run_command("survey", root / "log", "-o", root / "survey", *points)
    return root / "log", root / "survey"


@pytest.mark.slow
def test_the_command_writes_survey_picture_and_report(surveyed: tuple[Path, Path]) -> None:
    log, place = surveyed
    assert {p.name for p in place.iterdir()} == {
        "survey.parquet",
        "survey.png",
        "report.html",
        "report.json",
    }
    assert (place / "survey.png").read_bytes().startswith(b"\x89PNG")
    survey, report = read_survey(place / "survey.parquet"), _report(place)
    assert report["points"] == len(survey) > 20
    assert report["beacons_per_point_least"] == 4
    assert report["points_hearing_C"] == len(survey)
    assert report["epochs_dropped"] == report["epochs_dropped_too_close_to_another_point"]
    truth = read_log(log).truth
    assert truth is not None
    separate = np.linalg.norm(truth.position_world[:, None] - survey.position_world, axis=2)
    assert np.max(np.min(separate, axis=0)) < 0.01  # m


@pytest.mark.slow
def test_the_poses_may_come_from_a_smoothed_result(worked: Worked, tmp_path: Path) -> None:
    by_truth, by_result = tmp_path / "truth", tmp_path / "result"
    points = ("--points", "epochs", "--spacing", 0.2)
    run_command("survey", worked.log, "-o", by_truth, *points)
    run_command("survey", worked.log, "-o", by_result, *points, "--trajectory", worked.smoothed)
    first, second = (read_survey(p / "survey.parquet") for p in (by_truth, by_result))
    distance = np.linalg.norm(first.position_world[0] - second.position_world[0])
    assert 0.0 < distance < 0.02  # m; the smoother's error


@pytest.mark.slow
def test_a_demodulated_log_can_be_surveyed_at_its_rests(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_command("survey", worked.phasors, "-o", tmp_path / "survey")
    assert _report(tmp_path / "survey")["points"] >= 1
    assert "epochs dropped moving" in capfd.readouterr().out


# The paper's algorithms -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def fixed(
    surveyed: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, dict[str, Any]]:
    """Return the report of every method, and that of the blocks."""
    log, survey = surveyed
    root, reports = tmp_path_factory.mktemp("fixed"), {}
    for method in PAPER:
        run_command("fix", log, "-o", root / method, "--method", method, "--survey", survey)
        reports[method] = _report(root / method)
        assert not (root / method / "trajectory.tum").exists()
        table = pyarrow.parquet.read_table(root / method / "positions.parquet")
        assert table.column_names == ["time_ns", "position_x", "position_y", "position_z"]
        assert len(table) == reports[method]["epochs"]
    run_command("fix", log, "-o", root / "ours")
    reports["ours"] = _report(root / "ours")
    return reports


@pytest.mark.slow
def test_every_method_locates_a_users_log(fixed: dict[str, dict[str, Any]]) -> None:
    for method in PAPER:
        report = fixed[method]
        assert (report["job"], report["method"]) == ("fix", method)
        assert report["epochs"] == fixed["ours"]["epochs"]
        assert report["magnetometer_position_rmse_m"] < 0.3  # m
        assert "nees_mean" not in report
    best = min(fixed[m]["magnetometer_position_rmse_m"] for m in PAPER)
    assert fixed["ours"]["ate_m"] < 0.2 * best


@pytest.mark.slow
def test_among_beacons_of_all_axes_no_attitude_is_given(fixed: dict[str, dict[str, Any]]) -> None:
    """Eq 18 would err by a right angle and more there."""
    for method in PAPER:
        report = fixed[method]
        assert report["epochs_without_attitude"] == report["epochs"]
        assert "attitude_rmse_deg" not in report
        (refused,) = [r for r in report["reasons"] if r["code"] == "attitude_refused"]
        assert "rotation axes differ by" in refused["text"]
    assert fixed["ours"]["attitude_rmse_deg"] < 0.5


def test_a_tilt_that_the_accelerometer_shows_has_no_attitude(
    surveyed: tuple[Path, Path], tmp_path: Path
) -> None:
    """Beacons declared level: the axes are parallel, and the body's tilt alone decides."""
    log = shutil.copytree(surveyed[0], tmp_path / "log")
    site = yaml.safe_load((log / "site.yaml").read_text())
    for beacon in site["beacons"]:
        beacon["rpy_deg"] = [0.0, 0.0, 0.0]
    (log / "site.yaml").write_text(yaml.safe_dump(site))
    options = ("--method", "paper-fingerprint", "--survey", surveyed[1])
    run_command("fix", log, "-o", tmp_path / "fix", *options)
    report = _report(tmp_path / "fix")
    assert 0 < report["epochs_without_attitude"] < report["epochs"]
    assert "accelerometer shows a tilt" in json.dumps(report["reasons"])
    rows = pyarrow.parquet.read_table(tmp_path / "fix" / "trajectory.parquet")
    assert len(rows) == report["epochs"] - report["epochs_without_attitude"]
    assert not [name for name in rows.column_names if name.startswith("cov")]
    original = read_log(log)
    assert original.truth is not None
    estimate = read_estimate(tmp_path / "fix" / "trajectory.tum", original.epoch_ns)
    kept, all_epochs = (
        np.arccos(interpolate(original.truth, time, 0.1)[0].world_from_body[:, 2, 2])
        for time in (estimate.time, original.truth.time)
    )
    assert np.median(kept) < 0.75 * np.median(all_epochs)


def test_blocks_are_fitted_where_they_are_asked(
    surveyed: tuple[Path, Path], tmp_path: Path, fixed: dict[str, dict[str, Any]]
) -> None:
    log, survey = surveyed
    options = ("--method", "paper-lines", "--survey", survey / "survey.parquet", "--block", 2)
    run_command("fix", log, "-o", tmp_path / "fix", *options)
    error = _report(tmp_path / "fix")["magnetometer_position_rmse_m"]
    assert error != fixed["paper-lines"]["magnetometer_position_rmse_m"]
    assert error < 0.1  # m


# Refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", PAPER)
def test_a_method_of_the_paper_asks_for_a_survey(
    method: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    assert "--survey" in refuse("fix", worked.log, "-o", tmp_path / "fix", "--method", method)


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--survey", "x"), "--method"),
        (("--method", "paper-knn", "--survey", "x", "--block", "2"), "paper-lines"),
        (("--method", "paper-lines", "--survey", "x", "--block", "0"), "--block"),
        (("--method", "paper-lines", "--survey", "x", "--block", "nan"), "--block"),
        (("--method", "paper-knn", "--survey", "nowhere"), "nowhere"),
        (("--method", "paper"), "--method"),
    ],
)
def test_options_of_fix_that_do_not_fit_are_refused(
    options: tuple[str, ...], reported: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    assert reported in refuse("fix", worked.log, "-o", tmp_path / "fix", *options)


def _refused_fix(log: Path, survey: Path, tmp_path: Path, refuse: Refuse) -> str:
    options = ("--method", "paper-fingerprint", "--survey", survey)
    return refuse("fix", log, "-o", tmp_path / "fix", *options)


def test_a_survey_of_another_site_is_refused(
    surveyed: tuple[Path, Path], tmp_path: Path, refuse: Refuse
) -> None:
    survey = shutil.copytree(surveyed[1], tmp_path / "survey")
    change_table(
        survey / "survey.parquet",
        lambda c: c.update(beacon=[name.replace("A", "E") for name in c["beacon"]]),
    )
    sentence = _refused_fix(surveyed[0], survey, tmp_path, refuse)
    assert str(survey / "survey.parquet") in sentence
    assert "beacon E tone 0" in sentence


def _without(columns: dict[str, Any], dropped: set[str], points: int = 1000) -> None:
    rows = [
        i
        for i, (name, point) in enumerate(zip(columns["beacon"], columns["point"], strict=True))
        if name not in dropped and point < points
    ]
    columns.update({key: [values[i] for i in rows] for key, values in columns.items()})


@pytest.mark.parametrize(
    ("dropped", "points", "reported"),
    [({"A", "B"}, 1000, "require 3 rotating beacons"), (set(), 3, "has 3 points")],
)
def test_a_survey_of_too_few_beacons_or_points_is_refused(
    dropped: set[str],
    points: int,
    reported: str,
    surveyed: tuple[Path, Path],
    tmp_path: Path,
    refuse: Refuse,
) -> None:
    survey = shutil.copytree(surveyed[1], tmp_path / "survey")
    change_table(survey / "survey.parquet", lambda c: _without(c, dropped, points))
    sentence = _refused_fix(surveyed[0], survey, tmp_path, refuse)
    assert reported in sentence
    assert str(survey) in sentence


def test_beacons_that_do_not_rotate_are_refused(
    surveyed: tuple[Path, Path], tmp_path: Path, refuse: Refuse
) -> None:
    log = shutil.copytree(surveyed[0], tmp_path / "log")
    site = yaml.safe_load((log / "site.yaml").read_text())
    for beacon in site["beacons"][:2]:
        beacon["coils"] = beacon["coils"][:1]
    (log / "site.yaml").write_text(yaml.safe_dump(site))
    assert "share 2" in _refused_fix(log, surveyed[1], tmp_path, refuse)


def test_epochs_that_hear_too_little_are_refused_with_the_reason(
    worked: Worked, surveyed: tuple[Path, Path], tmp_path: Path, refuse: Refuse
) -> None:
    log = shutil.copytree(worked.phasors, tmp_path / "log")
    change_table(
        log / "fields.parquet",
        lambda c: c.update(
            {k: [x for x, b in zip(v, c["beacon"], strict=True) if b in "AB"] for k, v in c.items()}
        ),
    )
    sentence = _refused_fix(log, surveyed[1], tmp_path, refuse)
    assert "fewer than three beacons detected" in sentence


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--spacing", "-1"), "--spacing"),
        (("--spacing", "nan"), "--spacing"),
        (("--points", "some"), "--points"),
        (("--trajectory", "nowhere.tum"), "nowhere.tum"),
        (("--start", "6", "--end", "9"), "--points epochs"),
    ],
)
def test_options_of_survey_that_do_not_fit_are_refused(
    options: tuple[str, ...], reported: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    assert reported in refuse("survey", worked.log, "-o", tmp_path / "survey", *options)


def test_a_log_without_truth_asks_for_a_trajectory(
    log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    (log / "truth.parquet").unlink()
    assert "--trajectory" in refuse("survey", log, "-o", tmp_path / "survey")


def test_a_row_of_the_trajectory_that_is_lost_or_double_is_a_finding(tmp_path: Path) -> None:
    poses, log = _stop_and_go()
    rows = [*range(10), *range(9, len(poses.time))]  # one is double
    quaternion = Rotation.from_matrix(poses.world_from_body[rows]).as_quat(scalar_first=True)
    columns = np.column_stack([poses.position_world[rows], quaternion])
    columns[20, 0] = np.nan
    names = ("position_x", "position_y", "position_z", "qw", "qx", "qy", "qz")
    stamps = np.round(1e9 * poses.time[rows]).astype(np.int64)
    table = {"time_ns": stamps} | dict(zip(names, columns.T, strict=True))
    path = tmp_path / "trajectory.parquet"
    pyarrow.parquet.write_table(pyarrow.table(table), path)
    result, told = known_poses(log, tmp_path, path)
    assert len(result.time) == len(poses.time) - 1
    texts = [finding.text for finding in told.findings]
    assert any("1 sample is an exact copy of another" in text for text in texts)
    assert any("1 without a pose" in text for text in texts)


def test_other_files_are_not_replaced(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    refuse("survey", worked.log, "-o", tmp_path / "mine")
