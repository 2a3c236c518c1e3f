"""What is wrong with a log is said in one sentence: file, place, what was found, remedy."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from example_log import EPOCH_NS, example_log

from magfusion.errors import InputError
from magfusion.files.fields import read_fields, write_fields
from magfusion.files.log import read_log, write_log
from magfusion.files.parquet_bounds import MAX_ROWS
from magfusion.files.plausible import check_imu
from magfusion.files.table import Span
from magfusion.files.trajectory_table import QUATERNION, read_trajectory
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.units import Array


def _rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a table's columns, as lists, in place."""
    columns = pa.parquet.read_table(path).to_pydict()
    change(columns)
    pa.parquet.write_table(pa.table(columns), path)


def _set(column: str, row: int, value: object) -> Callable[[dict[str, Any]], object]:
    def change(columns: dict[str, Any]) -> None:
        columns[column][row] = value

    return change


def _scale(names: Sequence[str], factor: float) -> Callable[[dict[str, Any]], object]:
    def change(columns: dict[str, Any]) -> None:
        for name in names:
            columns[name] = [factor * value for value in columns[name]]

    return change


def _twice(row: int) -> Callable[[dict[str, Any]], object]:
    def change(columns: dict[str, Any]) -> None:
        for values in columns.values():
            values.insert(row, values[row])

    return change


def _upper_percentile(column: str, row: int, value: object) -> Callable[[dict[str, Any]], object]:
    """Write a value, or that of the row, into most rows from there on."""

    def change(columns: dict[str, Any]) -> None:
        count = 4 * (len(columns[column]) - row) // 5
        result = columns[column][row] if value is None else value
        columns[column][row : row + count] = [result] * count

    return change


def _hours_later(row: int) -> Callable[[dict[str, Any]], object]:
    def change(columns: dict[str, Any]) -> None:
        columns["time_ns"][row:] = [t + 7200 * 10**9 for t in columns["time_ns"][row:]]

    return change


def _microseconds(columns: dict[str, Any]) -> None:
    columns["time_ns"] = [EPOCH_NS + (t - EPOCH_NS) // 1000 for t in columns["time_ns"]]


def _axes(stem: str) -> list[str]:
    return [f"{stem}_{axis}" for axis in "xyz"]


BAD_TABLES = [
    ("imu", lambda c: c.pop("gyro_y"), r"column gyro_y is missing \(found time_ns, gyro_x, "),
    ("imu", lambda c: (c.pop("gyro_y"), c.pop("accel_x")), "columns gyro_y, accel_x are missing"),
    ("imu", lambda c: c.pop("time_ns"), "column time_ns is missing"),
    ("imu", lambda c: c.update(gyro_x=["a"] * 400), "column gyro_x holds string; write numbers"),
    ("imu", lambda c: c.update(time_ns=[t * 1e-9 for t in c["time_ns"]]), "time_ns holds double"),
    (
        "imu",
        _upper_percentile("accel_z", 17, float("nan")),
        r"column accel_z, row 17 .*: found nan",
    ),
    ("imu", _set("time_ns", 3, None), r"column time_ns, row 3 .*: found no value"),
    ("imu", _set("time_ns", 40, EPOCH_NS), r"column time_ns, row 40 .*sort the rows"),
    (
        "imu",
        lambda c: c["time_ns"].__setitem__(slice(390, 400), [2**63 - 1] * 10),
        r"column time_ns, row 390 .*write nanoseconds",
    ),
    ("imu", _upper_percentile("time_ns", 8, None), "312 of 400 rows have the stamp of another"),
    ("imu", _hours_later(40), r"column time_ns, row 40 .*the clock jumped"),
    ("imu", lambda c: [v.clear() for v in c.values()], "holds no rows"),
    ("imu", _scale(_axes("accel"), 1 / 9.80665), "probably in g"),
    ("imu", _scale(_axes("gyro"), 180 / np.pi), "probably in deg/s"),
    ("imu", _microseconds, "not in nanoseconds"),
    (
        "magnetometer",
        lambda c: [c.pop(name) for name in _axes("field")],
        "columns field_x, field_y, field_z are missing",
    ),
    ("magnetometer", _scale(_axes("field"), 1e9), "divide nanotesla by 1e9"),
    ("magnetometer", _scale(_axes("field"), 1e4), "gauss by 1e4"),
    (
        "magnetometer",
        _upper_percentile("time_ns", 0, None),
        "319 of 400 rows have the stamp of another",
    ),
    ("fields", lambda c: c.pop("sigma"), "column sigma is missing"),
    ("fields", lambda c: c.pop("cov_yz"), "column cov_yz is missing"),
    ("fields", lambda c: c.update(beacon=[1] * len(c["tone"])), "beacon holds int64; write text"),
    ("fields", lambda c: c.update(tone=[0.5] * len(c["tone"])), "tone holds double; write int"),
    ("fields", _set("tone", 2, -1), r"column tone, row 2 .*found -1"),
    ("fields", _set("sigma", 4, 0.0), r"column sigma, row 4 .*positive"),
    ("fields", _set("window", 4, -0.4), r"column window, row 4 .*positive"),
    ("fields", _set("window", 1, 0.3), r"column window, row 1 .*same in all rows"),
    ("fields", _set("cov_xx", 5, -1e-18), r"cov_xx to cov_zz, row 5 .*eigenvalues"),
    ("fields", _set("beacon", 5, None), r"column beacon, row 5 .*found no value"),
    ("fields", _twice(1), r"row 2 .*the channel has two rows"),
    ("fields", _scale([*_axes("re"), *_axes("im")], 1e9), "divide nanotesla by 1e9"),
    ("truth", _scale(["qw", "qx", "qy", "qz"], 1.02), r"qw to qz, row 0 .*found 1.02"),
    ("truth", lambda c: c.pop("qw"), "column qw is missing"),
    ("truth", lambda c: c.pop("velocity_y"), "column velocity_y is missing"),
]


@pytest.mark.parametrize(("stem", "change", "sentence"), BAD_TABLES)
def test_a_bad_table_is_refused_by_name_and_place(
    tmp_path: Path, stem: str, change: Callable[[dict[str, Any]], object], sentence: str
) -> None:
    write_log(example_log(), tmp_path / "walk")
    _rewrite(tmp_path / "walk" / f"{stem}.parquet", change)
    with pytest.raises(InputError, match=rf"walk.{stem}\.parquet: .*{sentence}") as caught:
        read_log(tmp_path / "walk")
    assert str(caught.value).count("\n") == 0


def _header(**change: object) -> Callable[[Path], object]:
    header = {"magfusion_log": 1, "name": "walk", "epoch_ns": 5, "source": "test"} | change
    text = "\n".join(f"{key}: {value}" for key, value in header.items() if value is not None)
    return lambda log: (log / "log.yaml").write_text(text)


def _truncated(log: Path) -> None:
    content = (log / "imu.parquet").read_bytes()
    (log / "imu.parquet").write_bytes(content[: len(content) // 2])


def _flipped(log: Path) -> None:
    content = bytearray((log / "imu.parquet").read_bytes())
    content[len(content) // 2] ^= 0x10
    (log / "imu.parquet").write_bytes(content)


def _csv(text: str) -> Callable[[Path], None]:
    def write(log: Path) -> None:
        (log / "imu.parquet").unlink()
        (log / "imu.csv").write_text(text)

    return write


def _no_field(log: Path) -> None:
    (log / "magnetometer.parquet").unlink()
    (log / "fields.parquet").unlink()


def _nothing_of_ours(log: Path) -> None:
    _no_field(log)
    (log / "log.yaml").unlink()


IMU = "time_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"

BAD_DIRECTORIES: list[tuple[Callable[[Path], object], str]] = [
    (_nothing_of_ours, "holds no log.yaml, nor a table magnetometer or fields"),
    (_no_field, "holds no magnetometer.parquet and no fields.parquet"),
    (lambda log: (log / "imu.csv").write_text(IMU), "holds imu.parquet and imu.csv; keep one"),
    (_header(magfusion_log=2), r"log.yaml: magfusion_log: found 2"),
    (_header(magfusion_log=None), r"log.yaml: magfusion_log: is missing"),
    (_header(colour="red"), r"log.yaml: colour: is not a known key"),
    (_header(epoch_ns=1.5), r"log.yaml: epoch_ns: found 1.5"),
    (_header(epoch_ns=2**63), r"log.yaml: epoch_ns: found 9223372036854775808"),
    (_csv(f"{IMU}\n1,2,3,4,5,6,9\n2,2,3,4,5,6,9"), r"imu.csv: .*row 1 .*set epoch_ns near"),
    (lambda log: (log / "log.yaml").write_text("a: ["), r"log.yaml: line 1"),
    (_truncated, r"imu.parquet: cannot be read"),
    (_flipped, r"imu.parquet: cannot be read .*CRC"),
    (lambda log: (log / "imu.parquet").write_bytes(b""), r"imu.parquet: cannot be read"),
    (_csv(""), r"imu.csv: .*missing"),
    (_csv(IMU), r"imu.csv: .*(holds no rows|cannot be read)"),
    (_csv(f"{IMU}\n1,2,3,4,5,6,abc"), r"imu.csv: cannot be read .*abc"),
    (_csv(f"{IMU}\n1.5,2,3,4,5,6,7"), r"imu.csv: cannot be read .*1\.5"),
    (_csv(f"{IMU}\n1,2,3,4"), r"imu.csv: cannot be read .*Expected 7 columns, got 4"),
    (
        _csv(f"{IMU}\n0,2,3,4,5,6,9\n5000000,2,,4,5,6,9\n10000000,2,,4,5,6,9"),
        r"imu.csv: column gyro_y, row 1 .*found nan",
    ),
    (_csv(f"{IMU},gyro_x\n1,2,3,4,5,6,9,8"), r"imu.csv: column gyro_x is repeated"),
    (_csv("\xff\xfe\x00"), r"imu.csv: "),
]


@pytest.mark.parametrize(("spoil", "sentence"), BAD_DIRECTORIES)
def test_a_bad_directory_is_refused_by_name(
    tmp_path: Path, spoil: Callable[[Path], object], sentence: str
) -> None:
    write_log(example_log(), tmp_path / "walk")
    spoil(tmp_path / "walk")
    with pytest.raises(InputError, match=rf"walk.*{sentence}") as caught:
        read_log(tmp_path / "walk")
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_a_component_that_measured_nothing_is_no_zero(tmp_path: Path, value: float) -> None:
    """The receive coil of one axis: what it leaves open must not be taken for a field."""
    log = example_log()
    assert log.fields is not None
    phasor = np.resize(log.fields.phasor_sensor.ravel(), (20, 1, 3)) + (1.0 + 2.0j) * 1e-9
    cov = np.broadcast_to(1e-20 * np.eye(3), (20, 1, 3, 3)).copy()
    time, window, channels = np.arange(20.0), np.full(20, 0.5), (("A", 0),)
    fields = FieldSamples(time, window, channels, np.nan_to_num(phasor, nan=1e-9), cov)
    write_fields(fields, tmp_path / "fields.parquet", 0)
    assert len(read_fields(tmp_path / "fields.parquet", Span(0))) == 20

    def one_axis(columns: dict[str, Any]) -> None:
        for name in ("re_y", "re_z", "im_y", "im_z"):
            columns[name] = [value] * 20

    _rewrite(tmp_path / "fields.parquet", one_axis)
    with pytest.raises(InputError, match="re_y, im_y, re_z, im_z measured nothing"):
        read_fields(tmp_path / "fields.parquet", Span(0))


def test_a_path_that_is_no_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: there is no such directory"):
        read_log(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: is a file"):
        read_log(tmp_path / "file")


@pytest.mark.parametrize(
    ("start", "end", "sentence"),
    [
        (5.0, 5.0, "start: found 5.0 s, which is not before end"),
        (float("nan"), None, "start: found nan"),
        (None, float("inf"), "end: found inf"),
        (100.0, None, r"imu.parquet: holds no row from 100.0 s to the end"),
        (None, -1e30, r"imu.parquet: holds no row from the start to -1e\+30 s"),
    ],
)
def test_a_span_without_samples_is_refused(
    tmp_path: Path, start: float | None, end: float | None, sentence: str
) -> None:
    write_log(example_log(), tmp_path / "walk")
    with pytest.raises(InputError, match=sentence):
        read_log(tmp_path / "walk", start, end)


def test_a_span_without_a_field_is_refused(tmp_path: Path) -> None:
    log = example_log()
    write_log(log, tmp_path / "walk")
    assert log.waveform is not None
    late = float(log.imu.time[-1])
    for stem in ("magnetometer", "fields"):
        path = tmp_path / "walk" / f"{stem}.parquet"
        pa.parquet.write_table(pa.parquet.read_table(path).slice(0, 5), path)
    with pytest.raises(InputError, match="walk: holds no field from"):
        read_log(tmp_path / "walk", start=late)


def test_any_damage_to_a_table_is_noticed(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    write_log(example_log(), tmp_path / "walk")
    path = tmp_path / "walk" / "imu.parquet"
    content, expected = path.read_bytes(), read_log(tmp_path / "walk").imu
    refused = 0
    for place in rng.integers(len(content), size=60):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            result = read_log(tmp_path / "walk").imu
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(result.time, expected.time)
            np.testing.assert_array_equal(result.gyro_body, expected.gyro_body)
            np.testing.assert_array_equal(result.accel_body, expected.accel_body)
    assert refused > 30


# What is no reason to refuse a log ------------------------------------------------------------


@pytest.mark.parametrize("absent", [float("nan"), None])
@pytest.mark.parametrize("stem", ["imu", "magnetometer"])
def test_samples_without_a_number_or_a_time_of_their_own_are_left_out_and_counted(
    tmp_path: Path, stem: str, absent: float | None
) -> None:
    walk = tmp_path / "walk"
    write_log(example_log(), walk)
    whole = read_log(walk)
    column = "gyro_x" if stem == "imu" else "field_z"
    _rewrite(walk / f"{stem}.parquet", _set(column, 9, absent))
    _rewrite(walk / f"{stem}.parquet", _twice(7))
    result = read_log(walk)
    before, after = (
        (log.imu.time if stem == "imu" else log.waveform.time)  # type: ignore[union-attr]
        for log in (whole, result)
    )
    assert np.array_equal(after, np.delete(before, 9))
    assert [finding.code for finding in result.findings] == ["repeated_stamps", "missing_samples"]
    assert all("1 samples" in finding.text for finding in result.findings)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ([_set("position_x", 9, None)], "truth: left out 1 of 100 rows: 1 without a pose."),
        ([_set(q, 9, float("nan")) for q in QUATERNION], "truth: left out 1 of 100 rows"),
        ([_set(q, 9, 0.0) for q in QUATERNION], "1 with a quaternion of zeros."),
        ([_set("qw", 9, 3.0)], "1 with a quaternion not of unit length."),
    ],
)
def test_rows_of_a_truth_without_a_pose_are_left_out_and_counted(
    tmp_path: Path, changes: list[Callable[[dict[str, Any]], object]], text: str
) -> None:
    write_log(example_log(), tmp_path / "walk")
    whole = read_log(tmp_path / "walk").truth
    for change in changes:
        _rewrite(tmp_path / "walk" / "truth.parquet", change)
    log = read_log(tmp_path / "walk")
    assert whole is not None
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.time, np.delete(whole.time, 9))
    (finding,) = log.findings
    assert text in finding.text
    every = read_trajectory(tmp_path / "walk" / "truth.parquet", log.epoch_ns, findings=[])
    assert len(every) == len(whole) - 1


def test_quaternions_that_are_rounded_are_scaled_and_reported(tmp_path: Path) -> None:
    write_log(example_log(), tmp_path / "walk")
    _rewrite(tmp_path / "walk" / "truth.parquet", _scale([*QUATERNION], 1.002))
    log = read_log(tmp_path / "walk")
    assert log.truth is not None
    np.testing.assert_allclose(np.linalg.det(log.truth.world_from_body), 1.0)
    assert [f.text for f in log.findings] == [
        "truth: quaternions up to 0.2 % off were scaled to unit length."
    ]


def _imu(gyro_body: Array, accel_body: Array) -> ImuSamples:
    return ImuSamples(0.01 * np.arange(len(gyro_body)), gyro_body, accel_body)


def test_a_spike_or_a_stuck_gyroscope_is_not_told_to_be_in_degrees() -> None:
    rng = np.random.default_rng(5)
    gyro, accel = 0.1 * rng.normal(size=(1000, 3)), np.tile([0.0, 0.0, 9.81], (1000, 1))
    gyro[[100, 500]] = 1e5
    check_imu(_imu(gyro, accel), "imu")
    with pytest.raises(InputError, match="no gyroscope measures"):
        check_imu(_imu(np.full((1000, 3), 100.0), accel), "imu")


def test_an_acceleration_of_one_is_in_g_only_if_it_keeps_its_direction() -> None:
    """On a circle without gravity the acceleration turns with the body, and gravity does not."""
    angle = 0.02 * np.arange(1000)
    gyro = np.tile([0.0, 0.0, 2.0], (1000, 1))
    check_imu(_imu(gyro, np.tile([1.0, 0.0, 0.0], (1000, 1))), "imu")
    still = np.stack([np.cos(angle), -np.sin(angle), np.zeros(1000)], axis=1)
    with pytest.raises(InputError, match="probably in g"):
        check_imu(_imu(gyro, still), "imu")


@pytest.mark.slow
def test_a_small_file_of_many_rows_is_refused_and_a_part_of_it_read(tmp_path: Path) -> None:
    walk, rows = tmp_path / "walk", MAX_ROWS + 1
    write_log(example_log(), walk)
    names = pa.parquet.read_schema(walk / "imu.parquet").names
    zeros = pa.array(np.zeros(rows, dtype=np.float32))
    columns = {name: zeros for name in names}
    columns["time_ns"] = pa.array(EPOCH_NS + 1_000_000 * np.arange(rows))
    encoded = {"time_ns": "DELTA_BINARY_PACKED"}
    pa.parquet.write_table(
        pa.table(columns),
        walk / "imu.parquet",
        use_dictionary=names[1:],
        column_encoding=encoded,
        compression="zstd",
    )
    assert (walk / "imu.parquet").stat().st_size < 1 << 20
    with pytest.raises(InputError, match=r"imu\.parquet: holds more than 10000000 rows"):
        read_log(walk)
    part = read_log(walk, 0.2, 0.8)
    assert len(part.imu) == 600
    assert part.imu.time[0] == pytest.approx(0.2)
