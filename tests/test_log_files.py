"""Logs survive their files, slices are what they claim, and nothing is half-written."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from example_log import EPOCH_NS, example_fields, example_log, example_trajectory

from magfusion.errors import InputError
from magfusion.files.fields import order_channels
from magfusion.files.log import read_log, write_log
from magfusion.files.open import open_log
from magfusion.files.table import ROWS_PER_GROUP
from magfusion.files.trajectory_table import read_trajectory, write_trajectory
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site

SHARED = Path(__file__).parents[1].parent / "shared"


def _arrays(log: Log) -> dict[str, np.ndarray]:
    assert log.waveform is not None
    assert log.fields is not None
    assert log.truth is not None
    streams: dict[str, Any] = {"imu": log.imu, "waveform": log.waveform}
    streams |= {"fields": log.fields, "truth": log.truth}
    return {
        f"{stream}.{name}": value
        for stream, part in streams.items()
        for name, value in vars(part).items()
        if isinstance(value, np.ndarray)
    }


def _assert_same(result: Log, expected: Log, rtol: float = 0.0) -> None:
    assert (result.name, result.epoch_ns, result.source) == ("walk", EPOCH_NS, "test")
    assert result.fields is not None
    assert expected.fields is not None
    assert result.fields.channels == expected.fields.channels
    arrays = _arrays(expected)
    for name, value in _arrays(result).items():
        # Times are kept to the nanosecond, attitudes as quaternions.
        atol = {"time": 1e-9, "world_from_body": 1e-14}.get(name.split(".")[1], 0.0)
        np.testing.assert_allclose(value, arrays[name], rtol=rtol, atol=atol, err_msg=name)


def _as_csv(directory: Path) -> None:
    for path in directory.glob("*.parquet"):
        pa.csv.write_csv(pa.parquet.read_table(path), path.with_suffix(".csv"))
        path.unlink()


def test_a_log_survives_being_written_and_read(tmp_path: Path) -> None:
    log = example_log()
    write_log(log, tmp_path / "walk")
    _assert_same(read_log(tmp_path / "walk"), log)


def test_a_log_in_csv_is_the_log_in_parquet(tmp_path: Path) -> None:
    log = example_log()
    write_log(log, tmp_path / "walk")
    _as_csv(tmp_path / "walk")
    assert not list((tmp_path / "walk").glob("*.parquet"))
    _assert_same(read_log(tmp_path / "walk"), log, rtol=1e-15)


def test_stamps_of_today_keep_their_nanoseconds(tmp_path: Path) -> None:
    imu = ImuSamples(np.arange(5) * 1e-4 + 3e-9, np.zeros((5, 3)), np.tile([0, 0, 9.8], (5, 1)))
    write_log(replace(example_log(), imu=imu), tmp_path / "walk")
    stamps = pa.parquet.read_table(tmp_path / "walk" / "imu.parquet")["time_ns"].to_pylist()
    assert stamps == [EPOCH_NS + 3 + 100_000 * k for k in range(5)]
    result = read_log(tmp_path / "walk").imu.time
    np.testing.assert_allclose(result, imu.time, rtol=0, atol=1e-18)  # s


def test_slices_share_no_sample_and_lose_none(tmp_path: Path) -> None:
    log = example_log()
    write_log(log, tmp_path / "walk")
    whole = read_log(tmp_path / "walk")
    cut = float(whole.imu.time[123])
    before, after = read_log(tmp_path / "walk", end=cut), read_log(tmp_path / "walk", start=cut)
    assert len(before.imu) == 123
    first, second = _arrays(before), _arrays(after)
    for name, value in _arrays(whole).items():
        np.testing.assert_array_equal(np.concatenate([first[name], second[name]]), value, name)


def test_a_slice_does_not_decode_what_lies_outside(tmp_path: Path) -> None:
    log = example_log()
    path = tmp_path / "walk" / "imu.parquet"
    write_log(log, path.parent)
    table = pa.parquet.read_table(path)
    pa.parquet.write_table(table, path, row_group_size=50, write_page_checksum=True)
    whole = read_log(path.parent).imu
    damaged = pa.parquet.ParquetFile(path).metadata.row_group(1).column(2)
    content = bytearray(path.read_bytes())
    content[damaged.data_page_offset + damaged.total_compressed_size // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"imu\.parquet: cannot be read"):
        read_log(path.parent)
    start, end = float(whole.time[110]), float(whole.time[340])
    part = read_log(path.parent, start, end).imu
    np.testing.assert_array_equal(part.time, whole.time[110:340])
    np.testing.assert_array_equal(part.gyro_body, whole.gyro_body[110:340])


def test_a_slice_needs_no_statistics(tmp_path: Path) -> None:
    write_log(example_log(), tmp_path / "walk")
    path = tmp_path / "walk" / "imu.parquet"
    whole = read_log(path.parent).imu
    table = pa.parquet.read_table(path)
    pa.parquet.write_table(table, path, row_group_size=50, write_statistics=False)
    start = float(whole.time[210])
    np.testing.assert_array_equal(read_log(path.parent, start).imu.time, whole.time[210:])


def test_long_logs_are_written_in_groups_that_can_be_skipped(tmp_path: Path) -> None:
    n = ROWS_PER_GROUP + 10
    imu = ImuSamples(np.arange(n) * 1e-2, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.8], (n, 1)))
    write_log(replace(example_log(), imu=imu, truth=None), tmp_path / "walk")
    assert pa.parquet.ParquetFile(tmp_path / "walk" / "imu.parquet").num_row_groups == 2


def test_a_truth_outside_the_span_is_left_out(tmp_path: Path) -> None:
    log = example_log()
    assert log.truth is not None
    write_log(
        replace(log, truth=example_trajectory(np.random.default_rng(3), np.array([0.1, 0.2]))),
        tmp_path / "walk",
    )
    assert read_log(tmp_path / "walk", start=1.0).truth is None


def test_sigma_alone_stands_for_an_isotropic_covariance(tmp_path: Path) -> None:
    write_log(example_log(), tmp_path / "walk")
    path = tmp_path / "walk" / "fields.parquet"
    table = pa.parquet.read_table(path)
    covs = [name for name in table.column_names if name.startswith("cov_")]
    assert len(covs) == 6
    written = read_log(path.parent).fields
    pa.parquet.write_table(table.drop_columns(covs), path)
    result = read_log(path.parent).fields
    assert written is not None
    assert result is not None
    variance = np.trace(written.phasor_cov, axis1=2, axis2=3) / 3.0
    expected = variance[..., None, None] * np.eye(3)
    np.testing.assert_allclose(
        1e18 * result.phasor_cov, 1e18 * expected, rtol=1e-12, atol=0
    )  # nT^2


def test_a_trajectory_survives_its_table(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    trajectory = example_trajectory(rng, np.arange(30) * 0.01)
    write_trajectory(trajectory, tmp_path / "t.parquet", EPOCH_NS)
    result = read_trajectory(tmp_path / "t.parquet", EPOCH_NS)
    for name, value in vars(trajectory).items():
        np.testing.assert_allclose(getattr(result, name), value, rtol=1e-12, atol=1e-14)
    names = pa.parquet.read_schema(tmp_path / "t.parquet").names
    assert names[-21:][:7] == ["cov_00", "cov_01", "cov_02", "cov_03", "cov_04", "cov_05", "cov_11"]
    poses = Trajectory(trajectory.time, trajectory.world_from_body, trajectory.position_world)
    write_trajectory(poses, tmp_path / "p.parquet", EPOCH_NS)
    bare = read_trajectory(tmp_path / "p.parquet", EPOCH_NS)
    assert bare.velocity_world is bare.gyro_bias_body is bare.accel_bias_body is bare.pose_cov
    assert bare.pose_cov is None


def test_channels_are_arranged_as_the_site_names_them() -> None:
    site = demo_site()
    assert len(site.channels) >= 3
    fields = example_fields(np.random.default_rng(6))
    fields = replace(fields, channels=(site.channels[2], site.channels[0], site.channels[1]))
    ordered = order_channels(fields, site)
    assert ordered.channels == site.channels
    np.testing.assert_array_equal(ordered.phasor_sensor[:, :3], fields.phasor_sensor[:, [1, 2, 0]])
    np.testing.assert_array_equal(ordered.phasor_cov[:, :3], fields.phasor_cov[:, [1, 2, 0]])
    assert not ordered.valid[:, 3:].any()
    part = replace(
        fields,
        channels=fields.channels[:1],
        phasor_sensor=fields.phasor_sensor[:, :1],
        phasor_cov=fields.phasor_cov[:, :1],
    )
    assert set(np.flatnonzero(order_channels(part, site).valid.any(axis=0))) == {2}


def test_a_beacon_unknown_to_the_site_is_named_beside_those_it_knows() -> None:
    site = demo_site()
    fields = replace(
        example_fields(np.random.default_rng(6)), channels=(("X9", 0), *site.channels[:2])
    )
    with pytest.raises(InputError, match=f"X9 tone 0.*{site.channels[0][0]} tone 0"):
        order_channels(fields, site)


def test_a_failed_write_leaves_the_former_log_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError("the disk is full")

    log = example_log()
    write_log(log, tmp_path / "walk")
    monkeypatch.setattr("magfusion.files.log.write_trajectory", fail)
    with pytest.raises(OSError, match="disk is full"):
        write_log(example_log(seed=2), tmp_path / "walk")
    _assert_same(read_log(tmp_path / "walk"), log)
    assert [p.name for p in tmp_path.iterdir()] == ["walk"]


@pytest.mark.parametrize("table", ["magnetometer", "fields"])
def test_tables_without_a_header_are_a_log_whose_time_begins_with_them(
    table: str, tmp_path: Path
) -> None:
    log, directory = example_log(), tmp_path / "walk"
    write_log(log, directory)
    (directory / "log.yaml").unlink()
    (directory / f"{'fields' if table == 'magnetometer' else 'magnetometer'}.parquet").unlink()
    _as_csv(directory)
    result = open_log(directory)
    stream = result.waveform if table == "magnetometer" else result.fields
    assert stream is not None
    assert stream.time[0] == 0.0
    assert result.name == "walk"
    later = 1e-9 * (result.epoch_ns - log.epoch_ns)
    np.testing.assert_allclose(result.imu.time + later, log.imu.time, rtol=0.0, atol=1e-9)  # s
    with pytest.raises(InputError, match="walk: holds other files"):  # nobody's but the user's
        write_log(log, directory)


def test_a_log_replaces_a_log_but_keeps_the_site_beside_it(tmp_path: Path) -> None:
    write_log(example_log(seed=1), tmp_path / "walk")
    _as_csv(tmp_path / "walk")
    (tmp_path / "walk" / "site.yaml").write_text("magfusion_site: 1")
    (tmp_path / "walk" / "run").mkdir()
    newer = replace(example_log(seed=2), fields=None, truth=None)
    write_log(newer, tmp_path / "walk")
    names = {"log.yaml", "imu.parquet", "magnetometer.parquet", "site.yaml", "run"}
    assert {p.name for p in (tmp_path / "walk").iterdir()} == names
    np.testing.assert_array_equal(read_log(tmp_path / "walk").imu.gyro_body, newer.imu.gyro_body)


def test_what_is_no_log_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("four years of work")
    with pytest.raises(InputError, match="thesis: holds other files"):
        write_log(example_log(), tmp_path / "thesis")
    with pytest.raises(InputError, match=r"chapter.txt: is a file"):
        write_log(example_log(), tmp_path / "thesis" / "chapter.txt")
    with pytest.raises(InputError, match="cannot be written"):
        write_log(example_log(), tmp_path / "thesis" / "chapter.txt" / "log")
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "four years of work"
    (tmp_path / "empty").mkdir()
    write_log(example_log(), tmp_path / "empty")
    read_log(tmp_path / "empty")


@pytest.mark.parametrize("name", ["walk_calibrated", "turn_miscalibrated", "walk_unsynchronised"])
def test_the_real_logs_hold_gravity_and_the_earths_field(name: str) -> None:
    path = SHARED / "logs" / name
    if not path.is_dir():
        pytest.skip(f"{path} is not here")
    log = read_log(path)
    assert log.name == name
    assert log.waveform is not None
    assert log.truth is not None
    gravity = np.median(np.linalg.norm(log.imu.accel_body, axis=1))
    assert gravity == pytest.approx(9.81, abs=0.15)  # m/s^2
    earth = np.median(np.linalg.norm(log.waveform.measured_sensor, axis=1))
    assert 1e6 * earth == pytest.approx(49.0, abs=3.0)  # uT, Berlin
    np.testing.assert_allclose(np.linalg.det(log.truth.world_from_body), 1.0, rtol=1e-9)
    part = read_log(path, 10.0, 20.0)
    inside = (log.imu.time >= 10.0) & (log.imu.time < 20.0)
    np.testing.assert_array_equal(part.imu.accel_body, log.imu.accel_body[inside])
