"""Logs too long to be held: read in parts, with what the whole gives."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from example_bag import (
    FIELD,
    IMU,
    ODOMETRY,
    POSE,
    STORE,
    field_message,
    imu_message,
    odometry_message,
    pose_message,
    write_bag,
)
from example_log import example_log

from magfusion.errors import InputError
from magfusion.files import bag_rows, long_log, table_stream
from magfusion.files.bag import read_bag
from magfusion.files.bag_topics import Topics
from magfusion.files.foreign import bag_table
from magfusion.files.foreign.bag_table import plan_bag
from magfusion.files.foreign.convert import write_stream
from magfusion.files.foreign.plan import Findings
from magfusion.files.inertial_tables import FIELD_LAYOUT
from magfusion.files.log import read_log, write_log
from magfusion.files.open import open_log
from magfusion.files.table import Span
from magfusion.jobs.replay import ReplaySettings, run, run_replay
from magfusion.model.samples import ImuSamples, Log, Waveform

TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def _named(make: Any, k: int) -> Any:
    """Return a message whose frame's name is longer at some samples than at others."""
    message = make(k)
    message.header.frame_id = "x" * (k % 7)
    return message


def _transform(k: int) -> Any:
    pose = pose_message(k).pose
    turn = STORE.types["geometry_msgs/msg/Transform"](
        STORE.types["geometry_msgs/msg/Vector3"](pose.position.x, pose.position.y, pose.position.z),
        pose.orientation,
    )
    return STORE.types[TRANSFORM](pose_message(k).header, "imu" * (k % 3), turn)


def _sure_pose(k: int) -> Any:
    pose = STORE.types["geometry_msgs/msg/PoseWithCovariance"](
        pose_message(k).pose, np.arange(36.0)
    )
    return STORE.types[POSE_WITH_COVARIANCE](pose_message(k).header, pose)


TOPICS = {
    "/imu/data": (IMU, lambda k: _named(imu_message, k)),
    "/imu/mag": (FIELD, lambda k: _named(field_message, k)),
    "/pose": (POSE, lambda k: _named(pose_message, k)),
    "/odom": (ODOMETRY, lambda k: _named(odometry_message, k)),
    "/tf": (TRANSFORM, _transform),
    "/sure": (POSE_WITH_COVARIANCE, _sure_pose),
}


def _columns(bag: Path, truth: str) -> list[np.ndarray]:
    log = read_bag(bag, topics=Topics(truth=truth))
    assert log.waveform is not None
    assert log.truth is not None
    arrays = [log.imu.time, log.imu.gyro_body, log.imu.accel_body, log.waveform.time]
    arrays += [log.waveform.measured_sensor, log.truth.time, log.truth.position_world]
    speed = log.truth.velocity_world
    return [*arrays, log.truth.world_from_body, np.zeros(0) if speed is None else speed]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bag") / "run", TOPICS)


@pytest.mark.parametrize("truth", ["/pose", "/odom", "/tf", "/sure"])
@pytest.mark.parametrize("part", [7, 1 << 14])
def test_numbers_cut_from_messages_are_those_that_the_library_reads(
    bag: Path, truth: str, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_rows, "PART", part)
    cut = _columns(bag, truth)
    monkeypatch.setattr(bag_rows, "TAILS", {})
    for result, expected in zip(cut, _columns(bag, truth), strict=True):
        np.testing.assert_array_equal(result, expected)


def test_messages_that_end_otherwise_are_left_to_the_library(
    bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = _columns(bag, "/pose")
    off = bag_rows.TAILS[IMU]._replace(read_rows=(14, 15, 16, 25, 26, 27))
    monkeypatch.setattr(bag_rows, "TAILS", {IMU: off})
    for result, known in zip(_columns(bag, "/pose"), expected, strict=True):
        np.testing.assert_array_equal(result, known)


def test_one_message_that_was_not_measured_is_found_among_all(tmp_path: Path) -> None:
    topics = {"/imu": (IMU, lambda k: imu_message(k, absent=-1.0 if k == 23 else 0.0))}
    with pytest.raises(InputError, match="topic /imu: angular_velocity is marked as not measured"):
        open_log(write_bag(tmp_path / "run", topics))


def test_reading_and_importing_a_bag_tell_how_far_they_are(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_rows, "PART", 8)
    reported: list[tuple[str, int, int]] = []
    read_bag(bag, topics=Topics(truth="/pose"), report=lambda *one: reported.append(one))
    assert [done for _, done, _ in reported] == sorted(done for _, done, _ in reported)
    assert {(stage, total) for stage, _, total in reported} == {("reading", 120)}
    reported.clear()
    monkeypatch.setattr(bag_table, "ROWS", 16)
    plans = plan_bag([bag], {}, {}, ("truth",), Findings())
    rows: list[int] = []
    assert plans[0].source.count == 40
    write_stream(plans[0], tmp_path / "imu.parquet", report=rows.append)
    assert rows == [16, 32, 40]


@pytest.fixture
def short_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_log, "LONG", 100)
    monkeypatch.setattr(table_stream, "BATCH", 37)


def _replayed(path: Path, **part: float) -> bytes:
    log, sink = long_log.long_log(path, **part), io.BytesIO()
    assert log is not None
    run_replay(log, sink, "msgpack", realtime=False)
    return sink.getvalue()


def _whole(path: Path, **part: float) -> bytes:
    sink = io.BytesIO()
    run_replay(read_log(path, **part), sink, "msgpack", realtime=False)
    return sink.getvalue()


@pytest.mark.usefixtures("short_parts")
@pytest.mark.parametrize("part", [{}, {"start": 0.31, "end": 1.53}])
def test_a_long_log_is_replayed_as_a_whole_one(tmp_path: Path, part: dict[str, float]) -> None:
    log = example_log()
    write_log(log, tmp_path / "log")
    assert _replayed(tmp_path / "log", **part) == _whole(tmp_path / "log", **part)
    bare = replace(log, fields=None, waveform=_shifted(log))
    write_log(bare, tmp_path / "bare")
    assert _replayed(tmp_path / "bare", **part) == _whole(tmp_path / "bare", **part)


def _shifted(log: Log) -> Waveform:
    """Return a magnetometer that began later than the IMU and ended later."""
    assert log.waveform is not None
    return Waveform(log.waveform.time + 0.7, log.waveform.measured_sensor)


@pytest.mark.usefixtures("short_parts")
def test_what_is_no_sample_is_left_out_of_a_long_log(tmp_path: Path) -> None:
    log = example_log()
    gyro, time = log.imu.gyro_body.copy(), log.imu.time.copy()
    gyro[[5, 36, 37, 200]] = np.nan
    time[[74, 112]] = time[[73, 111]]  # the first of a batch, and one within
    write_log(replace(log, imu=ImuSamples(time, gyro, log.imu.accel_body)), tmp_path / "log")
    assert len(read_log(tmp_path / "log").imu) == 394
    assert _replayed(tmp_path / "log") == _whole(tmp_path / "log")


@pytest.mark.usefixtures("short_parts")
def test_a_long_log_is_refused_as_a_short_one(tmp_path: Path) -> None:
    path, log = tmp_path / "log", example_log()
    imu = log.imu
    for spoiled, sentence in (
        (ImuSamples(imu.time, imu.gyro_body, imu.accel_body / 9.81), r"imu.parquet: .* in g"),
        (
            ImuSamples(imu.time + 4000.0 * (imu.time > 1.0), imu.gyro_body, imu.accel_body),
            r"imu.parquet: .*more than an hour after the row above",
        ),
    ):
        write_log(replace(log, imu=spoiled), path)
        for replayed in (_replayed, _whole):
            with pytest.raises(InputError, match=sentence):
                replayed(path)
    write_log(log, path)
    (path / "magnetometer.parquet").unlink()
    (path / "fields.parquet").unlink()
    with pytest.raises(InputError, match=r"holds no magnetometer.parquet and no fields.parquet"):
        run(ReplaySettings(log=path))


def test_a_table_is_read_in_the_memory_of_a_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table_stream, "BATCH", 1 << 14)
    count = 300_000
    columns = {f"field_{axis}": np.random.default_rng(3).standard_normal(count) for axis in "xyz"}
    table = pa.table({"time_ns": np.arange(count) * 10**7, **columns})
    pyarrow.parquet.write_table(table, tmp_path / "magnetometer.parquet", row_group_size=6000)
    whole, before = table.nbytes, pa.total_allocated_bytes()
    maximum = read = 0
    for part in table_stream.table_pieces(tmp_path / "magnetometer.parquet", FIELD_LAYOUT, Span(0)):
        read += len(part)
        maximum = max(maximum, pa.total_allocated_bytes() - before)
    assert read == count
    assert maximum < 0.5 * whole  # Arrow reads ahead all there is, unless it is told not to
