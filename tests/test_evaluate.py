"""What users of evo have as a truth: positions or attitudes alone, other frames, clocks, points."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from conftest import Refuse, run_command
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.files.trajectory_table import read_trajectory, trajectory_columns, write_trajectory
from magfusion.files.tum import read_tum, write_tum
from magfusion.jobs.inputs import read_any_poses
from magfusion.model.trajectory import Trajectory
from magfusion.model.truth_poses import truth_poses
from magfusion.results.alignment import clock_offset
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

NOISE = 0.005  # m, of the estimate
LEVER = np.array([0.1, -0.05, 1.2])  # m, from the body to a prism on a pole
QUATERNION = ["qw", "qx", "qy", "qz"]
POSITION = ["position_x", "position_y", "position_z"]


@pytest.fixture(scope="module")
def walked() -> Trajectory:
    """Return the poses of a walk, at the rate of its IMU."""
    config = SimulationConfig(DEMO_BOX_WORLD, duration=30.0)
    truth = simulate_log(demo_site(), config, np.random.default_rng(3)).log.truth
    assert truth is not None
    return Trajectory(truth.time, truth.world_from_body, truth.position_world)


def rows(poses: Trajectory, chosen: Any) -> Trajectory:
    return Trajectory(
        poses.time[chosen], poses.world_from_body[chosen], poses.position_world[chosen]
    )


def positions(poses: Trajectory, place: np.ndarray) -> Trajectory:
    return Trajectory(poses.time, np.full((len(poses), 3, 3), np.nan), place)


@pytest.fixture(scope="module")
def estimate(walked: Trajectory) -> Trajectory:
    """Return an estimate at 20 Hz, with noise and its covariance."""
    own = rows(walked, slice(3, -3, 10))
    noise = NOISE * np.random.default_rng(1).standard_normal((len(own), 3))
    cov = np.tile(np.diag([1e-6] * 3 + [NOISE**2] * 3), (len(own), 1, 1))
    return Trajectory(own.time, own.world_from_body, own.position_world + noise, pose_cov=cov)


@pytest.fixture
def report(estimate: Trajectory, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Any:
    """Return a function that evaluates the estimate against a truth: its report."""

    def run(truth: Trajectory, *options: str, name: str = "truth.parquet") -> dict[str, Any]:
        write_trajectory(estimate, tmp_path / "estimate.parquet", 0)
        if name.endswith("tum"):
            write_tum(truth, tmp_path / name, 0)
        else:
            write_trajectory(truth, tmp_path / name, 0)
        capfd.readouterr()
        run_command("evaluate", tmp_path / "estimate.parquet", tmp_path / name, "--json", *options)
        result: dict[str, Any] = json.loads(capfd.readouterr().out.splitlines()[-1])
        return result

    return run


@pytest.mark.parametrize("name", ["prism.parquet", "prism.tum"])
def test_positions_of_a_prism_are_compared_at_its_place(
    walked: Trajectory, report: Any, name: str
) -> None:
    prism = positions(walked, walked.position_world + walked.world_from_body @ LEVER)
    shown = report(prism, "--lever-arm", ",".join(map(str, LEVER)), name=name)
    assert shown["ate_m"] == pytest.approx(np.sqrt(3.0) * NOISE, rel=0.05)
    assert shown["nees_mean"] == pytest.approx(3.0, rel=0.1)  # of three degrees of freedom
    assert shown["inside_3_sigma"] > 0.99
    assert not {"attitude_rmse_deg", "rpe_rotation_deg"} & shown.keys()
    assert report(prism, name=name)["ate_m"] > 1.0  # without the lever arm


def test_attitudes_alone_are_compared(walked: Trajectory, report: Any) -> None:
    nowhere = np.full_like(walked.position_world, np.nan)
    shown = report(Trajectory(walked.time, walked.world_from_body, nowhere))
    assert shown["attitude_rmse_deg"] < 0.01
    assert not {"ate_m", "rpe_translation_m"} & shown.keys()


def test_the_parts_of_a_truth_survive_its_files(walked: Trajectory, tmp_path: Path) -> None:
    prism = positions(walked, walked.position_world)
    columns = trajectory_columns(prism, 0)
    assert [*columns] == ["time_ns", *POSITION]
    write_trajectory(prism, tmp_path / "t.parquet", 0)
    write_tum(prism, tmp_path / "t.tum", 0)
    for read in (read_trajectory(tmp_path / "t.parquet", 0), read_tum(tmp_path / "t.tum")):
        assert read.has_position
        assert not read.has_attitude
        np.testing.assert_allclose(read.position_world, prism.position_world, atol=1e-9)


def test_half_a_position_is_refused(walked: Trajectory, tmp_path: Path, refuse: Refuse) -> None:
    table = pyarrow.table({**trajectory_columns(walked, 0)}).drop_columns(["position_z"])
    pyarrow.csv.write_csv(table, tmp_path / "t.csv")
    assert "position_z is missing" in refuse("evaluate", tmp_path / "t.csv", tmp_path / "t.csv")


@pytest.mark.parametrize("poses", [None, 400])
def test_the_alignment_is_that_of_evo(
    walked: Trajectory, estimate: Trajectory, report: Any, poses: int | None
) -> None:
    tilt = Rotation.from_rotvec([0.2, -0.1, 0.4])
    moved = Trajectory(
        walked.time,
        (tilt * walked.rotation).as_matrix(),
        tilt.apply(walked.position_world) + np.array([1.0, -2.0, 0.5]),
    )
    count = () if poses is None else ("--align-poses", str(poses))
    shown = report(moved, "--align", "se3", *count)
    own, true = _evo(estimate), _evo(rows(moved, slice(3, -3, 10)))
    own.align(true, n=-1 if poses is None else poses)
    for key, relation in (
        ("ate_m", PoseRelation.translation_part),
        ("attitude_rmse_deg", PoseRelation.rotation_angle_deg),
    ):
        metric = APE(relation)
        metric.process_data((true, own))
        assert shown[key] == pytest.approx(np.sqrt(np.mean(metric.error**2)), rel=1e-5)
    assert shown["alignment_poses"] == (poses or len(estimate))


def test_an_alignment_with_poses_at_rest_is_refused(
    walked: Trajectory, estimate: Trajectory, tmp_path: Path, refuse: Refuse
) -> None:
    write_tum(estimate, tmp_path / "e.tum", 0)
    write_tum(walked, tmp_path / "t.tum", 0)
    options = ("--align", "se3", "--align-poses", "20")  # in the second before the first step
    text = refuse("evaluate", tmp_path / "e.tum", tmp_path / "t.tum", *options)
    assert "--align se3: the 20 poses of the truth" in text
    text = refuse("evaluate", tmp_path / "e.tum", tmp_path / "t.tum", *options[2:])
    assert "--align-poses requires --align se3 or --align yaw" in text


def _evo(trajectory: Trajectory) -> PosePath3D:
    poses = np.tile(np.eye(4), (len(trajectory), 1, 1))
    poses[:, :3, :3] = trajectory.world_from_body
    poses[:, :3, 3] = trajectory.position_world
    return PosePath3D(poses_se3=list(poses))


def _turned(walked: Trajectory, world: Rotation, shift: list[float]) -> Trajectory:
    return Trajectory(
        walked.time,
        (world * walked.rotation).as_matrix(),
        world.apply(walked.position_world) + shift,
    )


def test_a_world_that_is_turned_is_recognised_with_the_option(
    walked: Trajectory, report: Any
) -> None:
    heading = _turned(walked, Rotation.from_euler("z", 40.0, degrees=True), [3.0, 1.0, 0.2])
    assert "by 40 deg about the vertical" in str(report(heading)["notes"])
    shown = report(heading, "--align", "yaw")
    assert "notes" not in shown
    assert shown["ate_m"] == pytest.approx(np.sqrt(3.0) * NOISE, rel=0.05)
    tilted = _turned(walked, Rotation.from_euler("xyz", [20.0, 5.0, 40.0], degrees=True), [0] * 3)
    assert "give --align se3" in str(report(tilted)["notes"])
    assert "give --align se3" in str(report(tilted, "--align", "yaw")["notes"])
    assert "notes" not in report(tilted, "--align", "se3")


def test_a_truth_in_ned_is_recognised(walked: Trajectory, report: Any) -> None:
    ned_from_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    flu_from_frd = np.diag([1.0, -1.0, -1.0])
    ned = Trajectory(
        walked.time,
        ned_from_enu @ walked.world_from_body @ flu_from_frd,
        walked.position_world @ ned_from_enu.T,
    )
    notes = str(report(ned)["notes"])
    assert "z down, as NED: give --truth-axes ned" in notes
    assert "forward, right, down" in notes
    shown = report(ned, "--truth-axes", "ned")
    assert "notes" not in shown
    assert shown["ate_m"] == pytest.approx(np.sqrt(3.0) * NOISE, rel=0.05)
    assert shown["attitude_rmse_deg"] < 0.01


def test_a_mounting_of_the_tracked_body_is_recognised(walked: Trajectory, report: Any) -> None:
    body = Rotation.from_euler("xyz", [5.0, -10.0, 80.0], degrees=True)
    other = Trajectory(walked.time, (walked.rotation * body).as_matrix(), walked.position_world)
    notes = str(report(other)["notes"])
    assert "give --mounting=5.0,-10.0,80.0" in notes
    shown = report(other, "--mounting=5,-10,80")
    assert "notes" not in shown
    assert shown["attitude_rmse_deg"] < 0.01
    assert shown["nees_mean"] == pytest.approx(3.0, rel=0.1)  # its attitudes have no errors


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("offset", [0.137, -4.2, 1.7e3])
def test_the_offset_of_the_clocks_is_estimated(
    walked: Trajectory, report: Any, offset: float, alone: bool
) -> None:
    slow = rows(walked, slice(0, None, 10))
    late = Trajectory(slow.time + offset, slow.world_from_body, slow.position_world)
    shown = report(positions(late, late.position_world) if alone else late, "--align-time")
    assert shown["time_offset_s"] == pytest.approx(offset, abs=2e-3)  # 2 mm at 1 m/s
    assert shown["ate_m"] == pytest.approx(np.sqrt(3.0) * NOISE, rel=0.1)


def test_the_clock_of_a_quiet_part_of_a_coarse_estimate_is_that_of_its_own_part(
    walked: Trajectory,
) -> None:
    """At 5 Hz, and before ten times as fast a motion: the whole truth is no scale for the part."""
    faster = walked.time[-1] + 0.1 * (walked.time[1:] - walked.time[0])
    truth = Trajectory(
        np.concatenate([walked.time, faster]),
        np.concatenate([walked.world_from_body, walked.world_from_body[1:]]),
        np.concatenate([walked.position_world, walked.position_world[1:]]),
    )
    part = rows(walked, slice(7, 5000, 40))
    late = Trajectory(part.time + 0.3, part.world_from_body, part.position_world)
    assert clock_offset(late, truth) == pytest.approx(-0.3, abs=2e-3)
    prism = positions(truth, truth.position_world)
    assert clock_offset(late, prism) == pytest.approx(-0.3, abs=2e-3)


def test_clocks_of_different_motions_are_refused(
    walked: Trajectory, estimate: Trajectory, tmp_path: Path, refuse: Refuse
) -> None:
    write_tum(estimate, tmp_path / "e.tum", 0)
    still = Trajectory(
        walked.time, np.tile(np.eye(3), (len(walked), 1, 1)), np.ones((len(walked), 3))
    )
    write_tum(still, tmp_path / "t.tum", 0)
    text = refuse("evaluate", tmp_path / "e.tum", tmp_path / "t.tum", "--align-time")
    assert "--align-time: the motions of estimate and truth correlate by" in text


def test_a_coarse_truth_of_a_fast_motion_is_compared_at_its_samples(
    walked: Trajectory, report: Any
) -> None:
    coarse = rows(walked, slice(0, None, 400))  # every 2 s
    shown = report(coarse)
    inside = (coarse.time >= walked.time[3]) & (coarse.time <= walked.time[-13])
    assert shown["compared_epochs"] == np.sum(inside)
    assert shown["ate_m"] < 3.0 * NOISE


@pytest.mark.parametrize("mistake", ["order", "inverse", "late", "mm"])
def test_order_direction_clock_and_unit_of_a_truth_are_recognised_with_the_option(
    walked: Trajectory, report: Any, mistake: str
) -> None:
    quaternion = walked.rotation.as_quat(scalar_first=True)
    attitude = {
        "order": Rotation.from_quat(quaternion, scalar_first=False).as_matrix(),
        "inverse": walked.rotation.inv().as_matrix(),
    }.get(mistake, walked.world_from_body)
    time = walked.time + (0.3 if mistake == "late" else 0.0)
    place = walked.position_world * (1e3 if mistake == "mm" else 1.0)
    notes = report(Trajectory(time, attitude, place))["notes"]
    (note,) = [one for one in notes if one.startswith("The truth's")]
    expected = {
        "order": r"--map 'truth.quaternion=NAMES\[wxyz\]'",
        "inverse": r"body_from_world.*--map 'truth.quaternion=-QX,-QY,-QZ,QW\[xyzw\]'",
        "late": r"about (2[6-9]|3[0-4])\d ms late .* give --align-time",
        "mm": r"positions are 1e\+03 times .* in mm. .*truth.position=NAMES\[mm\]",
    }
    assert re.search(expected[mistake], note)


def test_a_lever_arm_along_the_motion_is_no_delay_of_a_clock(
    walked: Trajectory, report: Any
) -> None:
    ahead = walked.position_world + walked.world_from_body @ [0.3, 0.0, 0.0]
    text = str(report(replace(walked, position_world=ahead)).get("notes", ""))
    assert "clock" not in text
    late = positions(replace(walked, time=walked.time + 0.2), walked.position_world)
    assert "ms late" in str(report(late)["notes"])
    assert "--align-time, or --lever-arm" in str(report(late)["notes"])


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_truth_at_rest_or_on_a_line_is_compared(
    walked: Trajectory, report: Any, speed: float
) -> None:
    place = np.outer(speed * walked.time, [1.0, 0.0, 0.0])
    still = np.tile(np.eye(3), (len(walked), 1, 1))
    assert report(Trajectory(walked.time, still, place))["ate_m"] > 1.0


def test_a_coarse_truth_in_millimetres_is_named_and_not_its_rate(
    walked: Trajectory, refuse: Refuse, tmp_path: Path
) -> None:
    coarse = rows(walked, slice(None, None, 41))
    write_trajectory(rows(walked, slice(1001, 5000, 200)), tmp_path / "e.parquet", 0)
    away = Trajectory(coarse.time, coarse.world_from_body, 1e3 * coarse.position_world)
    write_trajectory(away, tmp_path / "t.parquet", 0)
    assert "they are in mm" in refuse("evaluate", tmp_path / "e.parquet", tmp_path / "t.parquet")


@pytest.mark.parametrize(
    "head",
    [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [],"
        " q_RS_z []",
        "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z",
    ],
)
def test_the_truth_of_euroc_is_read_and_other_heads_are_for_import(
    walked: Trajectory, estimate: Trajectory, tmp_path: Path, refuse: Refuse, head: str
) -> None:
    write_trajectory(estimate, tmp_path / "e.parquet", 0)
    stamps = np.rint(walked.time * 1e9).astype(np.int64)
    poses = np.hstack([walked.position_world, walked.rotation.as_quat(scalar_first=True)])
    lines = [f"{t},{','.join(map(str, row))}" for t, row in zip(stamps, poses, strict=True)]
    lines[5] = f"{stamps[5]},nan,nan,nan,nan,nan,nan,nan"
    (tmp_path / "t.csv").write_text("\n".join([head, *lines]))
    read = read_any_poses(tmp_path / "t.csv", findings=[])
    np.testing.assert_allclose(read.position_world, np.delete(walked.position_world, 5, axis=0))
    np.testing.assert_allclose(read.world_from_body[0], walked.world_from_body[0], atol=1e-12)
    (tmp_path / "t.csv").write_text("\n".join(["a,b,c,d,e,f,g,h", *lines]))
    sentence = refuse("evaluate", tmp_path / "e.parquet", tmp_path / "t.csv")
    assert "convert it by magfusion import --truth" in sentence


def test_dates_are_shown_to_the_millisecond(walked: Trajectory) -> None:
    late = replace(walked, time=walked.time + 1.7e9)
    _, covered, reason = truth_poses(late, late.time[::100] - 10.0)
    assert not covered.all()
    assert "outside of its 1700000000 to 17000000" in reason


def test_a_truth_that_stands_is_reported(walked: Trajectory, report: Any) -> None:
    held = np.arange(len(walked))
    held[2000:4000] = 2000
    frozen = Trajectory(walked.time, walked.world_from_body[held], walked.position_world[held])
    assert "The truth is frozen in 33 %" in str(report(frozen)["notes"])
    assert "frozen" in str(report(positions(frozen, frozen.position_world))["notes"])


@pytest.mark.slow
@pytest.mark.parametrize("part", ["positions", "attitudes"])
def test_a_log_with_a_part_of_a_truth_is_smoothed_and_checked(
    part: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0)
    simulated = simulate_log(demo_site(), config, np.random.default_rng(5))
    write_log(simulated.log, tmp_path / "log")
    save_site(demo_site(), tmp_path / "log" / "site.yaml")
    path = tmp_path / "log" / "truth.parquet"
    dropped = QUATERNION if part == "positions" else POSITION
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(path).drop_columns(dropped), path)
    for command in ("check", "smooth", "navigate"):
        capfd.readouterr()
        run_command(command, tmp_path / "log", "-o", tmp_path / command, "--json")
        shown = json.loads(capfd.readouterr().out.splitlines()[-1])
        keys = {"ate_m", "attitude_rmse_deg"} & shown.keys()
        own = "ate_m" if part == "positions" else "attitude_rmse_deg"
        assert keys == (set() if command == "check" else {own})
        if keys:
            assert shown[own] < 0.2  # m, deg; the survey is exact
            assert 0.2 < shown["nees_mean"] < 9.0  # of three degrees of freedom
            assert "nan" not in (tmp_path / command / "report.html").read_text().casefold()


def test_a_prism_is_imported_from_a_table(
    walked: Trajectory, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    simulated = simulate_log(
        demo_site(), SimulationConfig(DEMO_BOX_WORLD, duration=30.0), np.random.default_rng(3)
    )
    write_log(simulated.log, tmp_path / "log")
    prism = pyarrow.table(
        {
            "time [s]": walked.time[::40],
            **{f"{a} [m]": walked.position_world[::40, k] for k, a in enumerate("xyz")},
        }
    )
    pyarrow.csv.write_csv(prism, tmp_path / "prism.csv")
    run_command(
        "import", "--imu", tmp_path / "log" / "imu.parquet", "--magnetometer",
        tmp_path / "log" / "magnetometer.parquet", "--truth", tmp_path / "prism.csv",
        "-o", tmp_path / "imported", "--offset", "truth=1700000000",
        *("--map", "imu.gyro=gyro_x,gyro_y,gyro_z[rad/s]"),
        *("--map", "imu.accel=accel_x,accel_y,accel_z[m/s^2]"),
        *("--map", "magnetometer.field=field_x,field_y,field_z[T]"),
    )  # fmt: skip
    assert "the truth has positions alone" in capfd.readouterr().out
    truth = read_log(tmp_path / "imported").truth
    assert truth is not None
    assert not truth.has_attitude
    np.testing.assert_allclose(truth.position_world, walked.position_world[::40], atol=1e-9)


def test_a_mean_of_the_parts_alone_agrees_with_whole_poses(
    walked: Trajectory, estimate: Trajectory
) -> None:
    whole = trajectory_errors(estimate, walked)
    alone = trajectory_errors(estimate, positions(walked, walked.position_world))
    assert alone.ate == pytest.approx(whole.ate, rel=1e-9)
    assert alone.aligned_ate == pytest.approx(whole.aligned_ate, rel=1e-9)
    assert alone.degrees_of_freedom == 3
    assert whole.degrees_of_freedom == 6
