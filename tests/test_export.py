"""What is handed on is read by those who take it: rosbags, evo, pandas; not a pose goes astray."""

import dataclasses
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gtsam
import numpy as np
import pandas
import pytest
from conftest import Refuse, run_command
from evo.tools import file_interface
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from magfusion.files.odometry_bag import UNKNOWN_VARIANCE
from magfusion.files.trajectory_table import write_trajectory
from magfusion.jobs.inputs import read_estimate
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Verdict

LAYOUTS = Path(__file__).parents[1] / "docs" / "layouts"
EPOCH_NS = 1_790_000_000_123_456_789
FAILED = 2  # of the states, which has no pose
N = 5


def _states() -> Trajectory:
    rng = np.random.default_rng(7)
    root = rng.standard_normal((N, 6, 6)) * np.array([0.02] * 3 + [0.1] * 3)[:, None]
    return Trajectory(
        time=np.array([0, 7_000_001, 200_000_000, 400_000_003, 10_000_000_000]) * 1e-9,
        world_from_body=Rotation.random(N, random_state=rng).as_matrix(),
        position_world=10.0 * rng.standard_normal((N, 3)),
        velocity_world=rng.standard_normal((N, 3)),
        pose_cov=root @ root.swapaxes(1, 2),
    )


STATES = _states()
KEPT = [k for k in range(N) if k != FAILED]
STAMPS = [EPOCH_NS + round(1e9 * STATES.time[k]) for k in KEPT]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    verdict = tuple(Verdict.FAILED if k == FAILED else Verdict.DOUBTFUL for k in range(N))
    excluded = tuple((("A", "B.2") if k == 0 else ()) for k in range(N))
    trust = StateTrust(verdict, np.full(N, np.nan), np.full(N, 2.0), excluded)
    place = tmp_path / "run"
    place.mkdir()
    write_trajectory(STATES, place / "trajectory.parquet", EPOCH_NS, trust)
    reported = {"job": "navigate", "verdict": "doubtful", "lost_epochs": 3}
    (place / "report.json").write_text(json.dumps(reported))
    return place


def _read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    result: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:  # with the types that the file itself tells
        for topic, stamp, raw in reader.messages():
            message = reader.deserialize(raw, topic.msgtype)
            result.setdefault(topic.topic, []).append((stamp, message))
    return result


def _xyz(value: Any) -> list[float]:
    return [value.x, value.y, value.z]


@pytest.mark.parametrize("form", ["mcap", "db3"])
def test_a_bag_has_odometry_and_pose_of_every_state(
    form: str, result: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"run.{form}"
    run_command("export", result, "-o", path, "--frame", "map", "--child", "imu")
    topics = _read(path)
    assert set(topics) == {"/magfusion/odometry", "/magfusion/pose"}
    for messages in topics.values():
        assert [stamp for stamp, _ in messages] == STAMPS
        for k, (stamp, message) in zip(KEPT, messages, strict=True):
            header, pose = message.header, message.pose.pose
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
            assert header.frame_id == "map"
            assert _xyz(pose.position) == list(STATES.position_world[k])
            rotated = Rotation.from_quat([*_xyz(pose.orientation), pose.orientation.w])
            np.testing.assert_allclose(
                rotated.as_matrix(), STATES.world_from_body[k], rtol=0, atol=1e-14
            )
    for k, (_, odometry) in zip(KEPT, topics["/magfusion/odometry"], strict=True):
        assert odometry.child_frame_id == "imu"
        speed_world = STATES.world_from_body[k] @ _xyz(odometry.twist.twist.linear)
        assert STATES.velocity_world is not None
        np.testing.assert_allclose(speed_world, STATES.velocity_world[k], rtol=0, atol=1e-13)
        assert np.all(odometry.twist.covariance.reshape(6, 6).diagonal() == UNKNOWN_VARIANCE)


def _moved(k: int, step_body: np.ndarray) -> np.ndarray:
    """Return by how much a small step moves x, y, z, and turns about the fixed axes X, Y, Z."""
    pose = gtsam.Pose3(gtsam.Rot3(STATES.world_from_body[k]), STATES.position_world[k])
    moved = pose.retract(step_body)
    turn = Rotation.from_matrix(moved.rotation().matrix() @ STATES.world_from_body[k].T)
    return np.concatenate([moved.translation() - pose.translation(), turn.as_rotvec()])


def test_covariances_are_those_of_ros(result: Path, tmp_path: Path) -> None:
    """Position first, both about the fixed axes of the header's frame (geometry_msgs)."""
    run_command("export", result, "-o", tmp_path / "run.mcap")
    messages = _read(tmp_path / "run.mcap")["/magfusion/pose"]
    small = 1e-6
    assert STATES.pose_cov is not None
    for k, (_, message) in zip(KEPT, messages, strict=True):
        steps = small * np.eye(6)
        by_step = np.array([(_moved(k, s) - _moved(k, -s)) / (2.0 * small) for s in steps]).T
        expected = by_step @ STATES.pose_cov[k] @ by_step.T
        estimate = message.pose.covariance.reshape(6, 6)
        scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
        np.testing.assert_allclose(estimate / scale, expected / scale, rtol=0, atol=1e-7)
        assert np.array_equal(estimate, estimate.T)


def test_what_is_not_known_has_no_small_variance(tmp_path: Path) -> None:
    """A fix by paper 004 has neither covariance nor velocity."""
    bare = dataclasses.replace(STATES, pose_cov=None, velocity_world=None)
    write_trajectory(bare, tmp_path / "t.parquet", EPOCH_NS)
    run_command("export", tmp_path / "t.parquet", "-o", tmp_path / "t.mcap")
    for _, message in _read(tmp_path / "t.mcap")["/magfusion/odometry"]:
        for part in (message.pose, message.twist):
            assert np.array_equal(part.covariance.reshape(6, 6), UNKNOWN_VARIANCE * np.eye(6))


def test_evo_reads_tum_and_kitti(result: Path, tmp_path: Path) -> None:
    run_command("export", result, "-o", tmp_path / "run.tum")
    run_command("export", result, "-o", tmp_path / "run.txt", "--format", "kitti")
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "run.tum"))
    np.testing.assert_allclose(tum.timestamps, np.array(STAMPS) * 1e-9, rtol=0, atol=1e-6)
    for estimate in (tum, file_interface.read_kitti_poses_file(str(tmp_path / "run.txt"))):
        poses = np.array(estimate.poses_se3)
        np.testing.assert_allclose(poses[:, :3, 3], STATES.position_world[KEPT], rtol=0, atol=1e-8)
        np.testing.assert_allclose(
            poses[:, :3, :3], STATES.world_from_body[KEPT], rtol=0, atol=1e-8
        )


def test_pandas_reads_csv_and_so_do_we(result: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    run_command("export", result, "-o", path)
    estimate = pandas.read_csv(path)
    assert estimate["time_ns"].tolist() == STAMPS
    assert estimate["verdict"].tolist() == ["doubtful"] * len(KEPT)
    assert estimate["excluded"][0] == "A B.2"
    assert STATES.pose_cov is not None
    assert estimate["cov_35"].tolist() == STATES.pose_cov[KEPT, 3, 5].tolist()
    assert estimate["protection_level_m"].isna().all()
    again = read_estimate(path, EPOCH_NS)
    np.testing.assert_allclose(again.time, STATES.time[KEPT], rtol=0, atol=1e-12)
    np.testing.assert_allclose(again.pose_cov, STATES.pose_cov[KEPT], rtol=1e-15)


def test_the_layout_of_foxglove_shows_what_a_bag_has(result: Path, tmp_path: Path) -> None:
    run_command("export", result, "-o", tmp_path / "run.mcap")
    topics = _read(tmp_path / "run.mcap")
    panels = json.loads((LAYOUTS / "foxglove.json").read_text())["configById"].values()
    paths = [path["value"] for panel in panels for path in panel.get("paths", ())]
    assert paths
    for path in paths:
        topic, *fields = path.split(".")
        value = topics[topic][0][1]
        for name in fields:
            name, _, number = name.partition("[")
            value = getattr(value, name)
            value = value[int(number.rstrip("]"))] if number else value
        assert np.isfinite(value)
    assert {topic for panel in panels for topic in panel.get("topics", ())} <= set(topics)


def test_the_layout_of_plotjuggler_shows_what_a_table_has(tmp_path: Path) -> None:
    zero = np.zeros((N, 3))
    states = dataclasses.replace(STATES, gyro_bias_body=zero, accel_bias_body=zero)
    trust = StateTrust((Verdict.TRUSTWORTHY,) * N, np.full(N, 0.1), np.full(N, 2.0), ((),) * N)
    write_trajectory(states, tmp_path / "t.parquet", EPOCH_NS, trust)
    run_command("export", tmp_path / "t.parquet", "-o", tmp_path / "run.csv")
    columns = set(pandas.read_csv(tmp_path / "run.csv").columns)
    layout = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    computed = {snippet.get("name") for snippet in layout.iter("snippet")}
    for snippet in layout.iter("snippet"):
        sources = [snippet.find("linked_source"), *snippet.findall("additional_sources/*")]
        assert {source.text for source in sources if source is not None} <= columns
    curves = list(layout.iter("curve"))
    assert curves
    for curve in curves:
        names = {curve.get(key) for key in ("curve_x", "curve_y") if key in curve.attrib}
        assert (names or {curve.get("name")}) <= columns | computed


def test_what_is_left_out_is_counted(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_command("export", result, "-o", tmp_path / "run.csv", "--json")
    reported = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (reported["states"], reported["states_failed"], reported["lost_epochs"]) == (
        len(KEPT),
        1,
        3,
    )
    assert reported["result_verdict"] == "doubtful"


def test_an_export_that_cannot_be_is_refused(result: Path, tmp_path: Path, refuse: Refuse) -> None:
    out = tmp_path / "run.mcap"
    assert "unknown file extension" in refuse("export", result, "-o", tmp_path / "run")
    assert "must differ" in refuse("export", result, "-o", out, "--child", "world")
    assert "/robot/nav" in refuse("export", result, "-o", out, "--namespace", "a b")
    assert "no such directory" in refuse("export", result, "-o", tmp_path / "no" / "a.csv")
    (result / "trajectory.parquet").unlink()
    assert "has no trajectory.parquet" in refuse("export", result, "-o", out)
    (result / "report.json").write_text('{"verdict": "failed"}')
    assert "its verdict is failed" in refuse("export", result, "-o", out)
    lost_epochs = StateTrust(
        (Verdict.FAILED,) * N, np.full(N, np.nan), np.full(N, np.nan), ((),) * N
    )
    table = tmp_path / "lost.parquet"
    write_trajectory(STATES, table, EPOCH_NS, lost_epochs)
    assert "none has a pose" in refuse("export", table, "-o", out)
    write_trajectory(STATES, table, -(10**10))
    assert "1970 to 2038" in refuse("export", table, "-o", out)
    assert str(table) in refuse("export", table, "-o", table, "--format", "csv")
