"""EuRoC folders and ROS 2 bags give the samples that were put into them."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run_command
from example_bag import (
    ACCEL,
    BIASES,
    FIELD,
    GYRO,
    IMU,
    MEASURED,
    ODOMETRY,
    POSE,
    POSITION,
    ROTATION,
    SENSORS,
    STAMPS,
    START_NS,
    VELOCITY_BODY,
    Make,
    N,
    field_message,
    header,
    imu_message,
    odometry_message,
    pose_message,
    write_bag,
    xyz,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from magfusion.errors import InputError
from magfusion.files.bag_topics import Topics
from magfusion.files.log import read_log, write_log
from magfusion.files.open import open_log
from magfusion.model.samples import Log


def _assert_samples(log: Log) -> None:
    assert log.epoch_ns == START_NS
    np.testing.assert_allclose(log.imu.time, 5e-3 * np.arange(N), rtol=0, atol=1e-12)  # s
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
    np.testing.assert_array_equal(log.imu.accel_body, ACCEL)
    assert log.waveform is not None
    np.testing.assert_array_equal(log.waveform.measured_sensor, MEASURED)
    np.testing.assert_array_equal(log.waveform.time, log.imu.time)
    assert log.fields is None


def _assert_truth(log: Log, velocity_world: np.ndarray | None) -> None:
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.position_world, POSITION)
    np.testing.assert_allclose(log.truth.world_from_body, ROTATION.as_matrix(), atol=1e-14)
    if velocity_world is None:
        assert log.truth.velocity_world is None
    else:
        np.testing.assert_allclose(log.truth.velocity_world, velocity_world, rtol=1e-12)  # m/s


# EuRoC


def _csv(path: Path, header: str, values: np.ndarray, stamps: np.ndarray = STAMPS) -> None:
    path.parent.mkdir(parents=True)
    rows = [
        ",".join([str(t), *(repr(float(v)) for v in row)])
        for t, row in zip(stamps, values, strict=True)
    ]
    path.write_text("\r\n".join([header, *rows]) + "\r\n")


def _euroc(path: Path) -> Path:
    motion = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    motion += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    _csv(path / "mav0" / "imu0" / "data.csv", motion, np.hstack([GYRO, ACCEL]))
    field = "#timestamp [ns],x,y,z"
    _csv(path / "mav0" / "mag0" / "data.csv", field, MEASURED)
    poses = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [],"
    poses += " q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1],"
    poses += " b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1],"
    poses += " b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
    quaternion = ROTATION.as_quat(scalar_first=True)
    truth = np.hstack([POSITION, quaternion, ROTATION.apply(VELOCITY_BODY), BIASES])
    _csv(path / "mav0" / "state_groundtruth_estimate0" / "data.csv", poses, truth)
    return path


def test_a_euroc_folder_is_read_by_the_place_of_its_columns(tmp_path: Path) -> None:
    log = open_log(_euroc(tmp_path / "V1_01_easy"))
    assert log.name == "V1_01_easy"
    _assert_samples(log)
    _assert_truth(log, ROTATION.apply(VELOCITY_BODY))
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.gyro_bias_body, BIASES[:, :3])
    np.testing.assert_array_equal(log.truth.accel_bias_body, BIASES[:, 3:])


def test_an_import_written_as_a_log_is_the_same_log(tmp_path: Path) -> None:
    write_log(open_log(_euroc(tmp_path / "euroc")), tmp_path / "log")
    log = open_log(tmp_path / "log")
    _assert_samples(log)
    _assert_truth(log, ROTATION.apply(VELOCITY_BODY))


def test_a_euroc_folder_may_hold_inertial_samples_alone(tmp_path: Path) -> None:
    path = _euroc(tmp_path / "euroc")
    (path / "mav0" / "mag0" / "data.csv").unlink()
    (path / "mav0" / "state_groundtruth_estimate0" / "data.csv").unlink()
    log = open_log(path, 0.1)
    assert log.waveform is None
    assert log.truth is None
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO[20:])


def test_samples_that_were_not_taken_are_left_out_of_a_euroc_folder_and_said(
    tmp_path: Path,
) -> None:
    table = _euroc(tmp_path) / "mav0" / "imu0" / "data.csv"
    head, *rows = table.read_text().splitlines()
    stamp, _, *others = rows[7].split(",")
    rows[7] = ",".join([stamp, "nan", *others])
    table.write_text("\n".join([head, *rows[:12], rows[11], *rows[12:]]) + "\n")
    log = open_log(tmp_path)
    np.testing.assert_array_equal(log.imu.gyro_body, np.delete(GYRO, 7, axis=0))
    assert [f.code for f in log.findings] == ["repeated_stamps", "missing_samples"]


def _rewrite(path: Path, write: Callable[[str], str], header: str | None) -> None:
    """Change the head (None for none) and the stamps of every table of a EuRoC folder."""
    for table in path.glob("mav0/*/data.csv"):
        _, *rows = table.read_text().splitlines()
        parts = (row.split(",", 1) for row in rows)
        lines = [",".join([write(stamp), rest]) for stamp, rest in parts]
        table.write_text("\n".join([*([] if header is None else [header]), *lines]) + "\n")


def test_a_euroc_folder_without_heads_keeps_its_first_rows(tmp_path: Path) -> None:
    path = _euroc(tmp_path / "euroc")
    _rewrite(path, str, None)
    log = open_log(path)
    _assert_samples(log)
    _assert_truth(log, ROTATION.apply(VELOCITY_BODY))
    assert not log.findings
    run_command("import", path, "-o", tmp_path / "log")
    _assert_samples(read_log(tmp_path / "log"))


def _seconds(stamp: str) -> str:
    return f"{stamp[:-9]}.{stamp[-9:-3]}"


@pytest.mark.parametrize("header", [None, "#timestamp,a", "#timestamp [ns],a"])
@pytest.mark.parametrize(
    ("write", "resolution_ns", "told"),
    [
        (lambda stamp: f"{float(stamp):.18e}", 256, "as ns; their resolution is 0.256 us"),
        (_seconds, 1000, "as s; their resolution is 1 us"),
        (lambda stamp: stamp[:-3], 1000, "as us; their resolution is 1 us"),
        (lambda stamp: stamp[:-6], 10**6, "as ms; their resolution is 1 ms"),
    ],
)
def test_stamps_of_a_euroc_folder_are_read_as_what_they_are(
    tmp_path: Path,
    header: str | None,
    write: Callable[[str], str],
    resolution_ns: int,
    told: str,
) -> None:
    path = _euroc(tmp_path / "euroc")
    _rewrite(path, write, header)
    run_command("import", path, "-o", tmp_path / "log")
    for log in (open_log(path), read_log(tmp_path / "log")):
        assert abs(log.epoch_ns - START_NS) <= resolution_ns
        recorded = (STAMPS - START_NS) * 1e-9
        np.testing.assert_allclose(log.imu.time, recorded, rtol=0, atol=1e-9 * resolution_ns)
        np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
        assert log.waveform is not None
        np.testing.assert_array_equal(log.waveform.measured_sensor, MEASURED)
        _assert_truth(log, ROTATION.apply(VELOCITY_BODY))
    findings = [f.text for f in open_log(path).findings if f.code == "stamp_resolution"]
    assert len(findings) == 3
    assert all(told in text for text in findings)


def test_a_row_that_is_cut_off_is_left_out_of_a_euroc_folder_and_counted(tmp_path: Path) -> None:
    table = _euroc(tmp_path) / "mav0" / "imu0" / "data.csv"
    table.write_text(table.read_text()[:-40])
    log = open_log(tmp_path)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO[:-1])
    assert [f.code for f in log.findings] == ["missing_samples"]
    assert "imu: 1 row does not have as many cells" in log.findings[0].text


@pytest.mark.parametrize("kind", ["bag", "EuRoC"])
def test_a_recording_needs_no_inertial_sensor(tmp_path: Path, kind: str) -> None:
    if kind == "bag":
        place = write_bag(tmp_path / "run", {"/mag": (FIELD, field_message)})
    else:
        place = _euroc(tmp_path)
        shutil.rmtree(place / "mav0" / "imu0")
    log = open_log(place)
    assert len(log.imu) == 0
    assert log.waveform is not None
    assert log.epoch_ns == START_NS
    assert log.waveform.time[0] == 0.0
    np.testing.assert_array_equal(log.waveform.measured_sensor, MEASURED)
    run_command("import", place, "-o", tmp_path / "log")
    again = read_log(tmp_path / "log")
    assert len(again.imu) == 0
    assert again.waveform is not None
    np.testing.assert_array_equal(again.waveform.measured_sensor, MEASURED)


def test_a_poses_only_ground_truth_is_read(tmp_path: Path) -> None:
    path = _euroc(tmp_path / "euroc")
    truth = path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    rows = [",".join(line.split(",")[:8]) for line in truth.read_text().splitlines()]
    truth.write_text("\n".join(rows))
    _assert_truth(open_log(path), None)


@pytest.mark.parametrize(
    ("stream", "text", "sentence"),
    [
        ("imu0", "", "is empty; record it again"),
        ("imu0", "#timestamp [ns]\n", "holds no table of numbers"),
        ("imu0", "#timestamp [s],a\n1.5,2\n", "columns gyro_y, gyro_z, accel_x"),
        (
            "imu0",
            "#timestamp [ns],a,b,c\n1,2,3,4\n",
            "columns accel_x, accel_y, accel_z are missing",
        ),
        (
            "imu0",
            "#t,a,b,c,d,e,f\n1,2,3,4,5,6,nine\n",
            "column f, row 0 .*found 'nine'; write a number",
        ),
        (
            "imu0",
            "#t,a,b,c,d,e,f\n1,2,3,4,5,6,7\nabc,2,3,4,5,6,7\n",
            "found 'abc', which is no time in",
        ),
        ("imu0", "#t,a,b,c,d,e,f\n1,2,3,4,5,6,7\n,2,3,4,5,6,7\n", "row 1 .*found no value"),
        (
            "imu0",
            "#t,a,b,c,d,e,f\n1,2,3,4,5,6,7\n1,3,3,4,5,6,7\n2,2,3,4,5,6,7\n",
            "1 of 3 rows have the stamp of another: .*coarser than .*--rate-hz imu=HZ",
        ),
        ("mag0", f"#t,a,b,c\n{START_NS},2e4,3e3,4e4\n", "divide nanotesla by 1e9"),
        ("mag0", f"#t\n{START_NS}\n", "columns field_x, field_y, field_z are missing"),
        ("state_groundtruth_estimate0", "#t,x,y,z,w,x,y,z\n1,0,0,0,2,0,0,0\n", "found 2.0"),
    ],
)
def test_a_bad_euroc_folder_is_refused(
    tmp_path: Path, stream: str, text: str, sentence: str
) -> None:
    path = _euroc(tmp_path / "euroc")
    (path / "mav0" / stream / "data.csv").write_text(text)
    with pytest.raises(InputError, match=rf"{stream}.data\.csv: .*{sentence}"):
        open_log(path)


# ROS 2


@pytest.mark.parametrize(
    ("plugin", "compression"),
    [
        (StoragePlugin.MCAP, None),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
        (StoragePlugin.SQLITE3, None),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
    ],
)
def test_a_bag_is_read_in_all_its_forms(
    tmp_path: Path, plugin: StoragePlugin, compression: CompressionMode | None
) -> None:
    topics = SENSORS | {"/mocap": (POSE, pose_message)}
    log = open_log(write_bag(tmp_path / "run", topics, plugin, compression))
    assert log.name == "run"
    assert "/imu/data" in log.source
    _assert_samples(log)
    _assert_truth(log, None)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_the_file_of_a_bag_stands_alone(tmp_path: Path, plugin: StoragePlugin) -> None:
    bag = write_bag(tmp_path / "run", SENSORS, plugin)
    (bag / "metadata.yaml").unlink()
    (file,) = bag.iterdir()
    log = open_log(file)
    _assert_samples(log)
    assert log.truth is None


def test_an_odometry_gives_velocity_in_the_world(tmp_path: Path) -> None:
    log = open_log(write_bag(tmp_path / "run", SENSORS | {"/odom": (ODOMETRY, odometry_message)}))
    _assert_truth(log, ROTATION.apply(VELOCITY_BODY))
    still = {"/odom": (ODOMETRY, lambda k: odometry_message(k, moving=0.0))}
    _assert_truth(open_log(write_bag(tmp_path / "still", SENSORS | still)), None)


def test_messages_are_put_in_the_order_of_their_headers(tmp_path: Path) -> None:
    shuffled = np.random.default_rng(2).permutation(N)
    _assert_samples(open_log(write_bag(tmp_path / "run", SENSORS, arrival=shuffled)))


def test_a_bag_is_sliced_by_the_log_clock(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", SENSORS | {"/mocap": (POSE, pose_message)})
    log = open_log(bag, 0.05, 0.1)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO[10:20])
    assert log.epoch_ns == START_NS
    assert log.waveform is not None
    assert log.truth is not None
    assert len(log.waveform) == len(log.truth) == 10
    with pytest.raises(InputError, match=r"topic /imu/data: holds no message from 5.0 s"):
        open_log(bag, 5.0)


@pytest.mark.parametrize(
    ("more", "sentence", "choice"),
    [
        (
            {"/imu/raw": (IMU, imu_message)},
            "several topics for imu: /imu/data, /imu/raw; name one",
            Topics(imu="/imu/raw"),
        ),
        (
            {"/mag2": (FIELD, field_message)},
            "several topics for magnetometer: /imu/mag, /mag2;",
            Topics(magnetometer="/mag2"),
        ),
        (
            {"/mocap": (POSE, pose_message), "/odom": (ODOMETRY, odometry_message)},
            "several topics for truth: /mocap, /odom;",
            Topics(truth="/odom"),
        ),
    ],
)
def test_a_choice_between_topics_is_left_to_the_user(
    tmp_path: Path, more: dict[str, tuple[str, Make]], sentence: str, choice: Topics
) -> None:
    bag = write_bag(tmp_path / "run", SENSORS | more)
    with pytest.raises(InputError, match=sentence):
        open_log(bag)
    _assert_samples(open_log(bag, topics=choice))
    with pytest.raises(InputError, match="has no topic /gyro of sensor_msgs/msg/Imu for imu"):
        open_log(bag, topics=Topics(imu="/gyro"))


def _changed(make: Make, change: Callable[[Any], object], row: int = 7) -> Make:
    def changed(k: int) -> Any:
        message = make(k)
        if k == row:
            change(message)
        return message

    return changed


def _spoil(part: str, name: str, value: float) -> Callable[[Any], object]:
    return lambda message: setattr(getattr(message, part), name, value)


@pytest.mark.parametrize(
    ("topics", "sentence"),
    [
        ({}, "has no messages of sensor_msgs/msg/Imu or sensor_msgs/msg/MagneticField"),
        (
            {"/imu": (IMU, lambda k: _stamped(imu_message(k), k // (N - 1)))},
            "topic /imu: 38 of 40 messages have the stamp of another; .*--rate-hz .*first is"
            f" stamped {START_NS} ns",
        ),
        (
            SENSORS | {"/imu/mag": (FIELD, lambda k: _scaled_field(k, np.nan if k % 3 else 1.0))},
            "topic /imu/mag: 26 of 40 messages hold NaN",
        ),
        (
            {"/imu": (IMU, lambda k: imu_message(k, absent=-1.0))},
            "topic /imu: angular_velocity is marked as not measured",
        ),
        (
            SENSORS | {"/mocap": (POSE, lambda k: _twice_as_long(pose_message(k)))},
            f"topic /mocap: the message stamped {STAMPS[0]} ns has a quaternion of length 2",
        ),
        (
            SENSORS | {"/imu/mag": (FIELD, lambda k: _scaled_field(k, 1e4))},
            "topic /imu/mag: the field is .* gauss by 1e4",
        ),
        (
            SENSORS | {"/imu/data": (IMU, lambda k: _scaled_force(k, 1 / 9.81))},
            "topic /imu/data: .* probably in g",
        ),
    ],
)
def test_a_bag_that_no_instrument_gives_is_refused(
    tmp_path: Path, topics: dict[str, tuple[str, Make]], sentence: str
) -> None:
    bag = write_bag(tmp_path / "run", topics)
    with pytest.raises(InputError, match=rf"run.* ?{sentence}") as caught:
        open_log(bag)
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("absent", [float("nan"), float("inf"), -float("inf"), 1e200])
def test_samples_that_were_not_taken_are_left_out_of_a_bag_and_said(
    tmp_path: Path, absent: float
) -> None:
    lost_epochs = _changed(imu_message, _spoil("linear_acceleration", "y", absent))
    again = _changed(field_message, lambda m: _stamped(m, 20), row=21)
    unseen = _changed(pose_message, _spoil("pose", "position", xyz("Point", np.full(3, np.nan))))
    topics = {"/imu": (IMU, lost_epochs), "/mag": (FIELD, again), "/mocap": (POSE, unseen)}
    bag = write_bag(tmp_path / "run", topics)
    log = open_log(bag)
    assert log.waveform is not None
    assert log.truth is not None
    np.testing.assert_array_equal(log.imu.gyro_body, np.delete(GYRO, 7, axis=0))
    np.testing.assert_array_equal(log.waveform.measured_sensor, np.delete(MEASURED, 21, axis=0))
    np.testing.assert_array_equal(log.truth.position_world, np.delete(POSITION, 7, axis=0))
    assert [f"{f.code}: {f.text}" for f in log.findings] == [
        "missing_samples: IMU: 1 samples are NaN. They are left out.",
        "repeated_stamps: magnetometer: 1 samples have the stamp of the one before. They are left"
        " out.",
        "missing_samples: truth: 1 samples are NaN. They are left out.",
    ]
    assert not open_log(bag, 0.11).findings
    untracked = _changed(pose_message, lambda message: _no_turn(message.pose))
    log = open_log(write_bag(tmp_path / "zeros", SENSORS | {"/mocap": (POSE, untracked)}))
    assert log.truth is not None
    assert len(log.truth) == len(POSITION) - 1
    text = f"truth: left out 1 of {len(POSITION)} rows: 1 with a quaternion of zeros."
    assert [finding.text for finding in log.findings] == [text]


def _stamped(message: Any, k: int) -> Any:
    message.header = header(int(STAMPS[k]))
    return message


def _no_turn(pose: Any) -> None:
    pose.orientation = xyz("Quaternion", np.zeros(4))


def _twice_as_long(message: Any) -> Any:
    for axis in "wxyz":
        setattr(message.pose.orientation, axis, 2.0 * getattr(message.pose.orientation, axis))
    return message


def _scaled_field(k: int, factor: float) -> Any:
    message = field_message(k)
    message.magnetic_field = xyz("Vector3", factor * MEASURED[k])
    return message


def _scaled_force(k: int, factor: float) -> Any:
    message = imu_message(k)
    message.linear_acceleration = xyz("Vector3", factor * ACCEL[k])
    return message


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_damaged_bag_is_refused_in_one_sentence(tmp_path: Path, plugin: StoragePlugin) -> None:
    bag = write_bag(tmp_path / "run", SENSORS, plugin)
    (file,) = (p for p in bag.iterdir() if p.suffix != ".yaml")
    content = file.read_bytes()
    parts = [0, 10]  # of an MCAP file more is read as far as it is whole
    parts += [len(content) // 3, len(content) // 2] * (plugin is StoragePlugin.SQLITE3)
    for part in parts:
        file.write_bytes(content[:part])
        with pytest.raises(InputError, match=r"cannot be read .*record the bag again") as caught:
            open_log(bag)
        assert str(caught.value).count("\n") == 0
    file.write_bytes(content)
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: 5")
    with pytest.raises(InputError, match="run: cannot be read"):
        open_log(bag)


# Detection


def test_the_kind_of_a_log_is_seen_from_its_files(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "old.bag").write_text("#ROSBAG V2.0")
    for name, sentence in (
        ("nowhere", "there is no such file or directory"),
        ("photos", "is no log: found neither log.yaml nor the tables of a log"),
        ("old.bag", "cannot be read .*record the bag again"),
    ):
        with pytest.raises(InputError, match=f"{name}: {sentence}"):
            open_log(tmp_path / name)


def test_a_log_opens_as_it_reads(tmp_path: Path) -> None:
    write_log(open_log(_euroc(tmp_path / "euroc")), tmp_path / "log")
    opened, read = open_log(tmp_path / "log", 0.02, 0.1), read_log(tmp_path / "log", 0.02, 0.1)
    np.testing.assert_array_equal(opened.imu.time, read.imu.time)
    assert len(opened.imu) == 16
