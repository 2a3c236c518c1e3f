"""Recordings in parts: gyro and accelerometer apart, sensors below one another, other clocks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.open import open_log
from magfusion.jobs.import_log import ImportSettings, run_import
from magfusion.model.samples import Log
from magfusion.results.figures import Figures
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

FIELD = np.array([2e-5, -1e-6, 4.5e-5])


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def gyro(time: Array) -> Array:
    return np.stack([np.sin(time), 0.2 * time, np.cos(2.0 * time)], axis=1)  # rad/s


def accel(time: Array) -> Array:
    return np.stack([0.5 * time, 1.0 - time, STANDARD_GRAVITY + 0.0 * time], axis=1)  # linear


def table(path: Path, names: str, *columns: Array) -> Path:
    rows = np.column_stack(columns)
    path.write_text("\n".join([names, *(",".join(repr(float(v)) for v in r) for r in rows)]) + "\n")
    return path


def magnetometer(path: Path, begin: float = 0.0) -> Path:
    time = np.arange(100) / 50.0
    return table(
        path, "time (s),x (uT),y (uT),z (uT)", begin + time, np.tile(1e6 * FIELD, (100, 1))
    )


def imported(output: Path, *sources: Path, **options: Any) -> tuple[Log, Figures]:
    settings = ImportSettings(sources=tuple(map(str, sources)), **options)
    figures = run_import(settings, output)
    return open_log(output), figures


def test_gyro_and_accelerometer_of_two_tables_are_one_inertial_sensor(tmp_path: Path) -> None:
    """As telephones write them: a folder of a file for each sensor, each with its own times."""
    folder = tmp_path / "telephone"
    folder.mkdir()
    fast, slow = np.arange(400) / 200.0, 0.013 + np.arange(190) / 100.0
    table(folder / "Gyroscope.csv", "time (s),x (rad/s),y (rad/s),z (rad/s)", fast, gyro(fast))
    table(folder / "Accelerometer.csv", "time (s),x (m/s^2),y (m/s^2),z (m/s^2)", slow, accel(slow))
    magnetometer(folder / "Magnetometer.csv")
    (folder / "Metadata.csv").write_text("version,device name\n3,telephone\n")
    log, figures = imported(tmp_path / "log", folder)
    inside = fast[(fast >= slow[0]) & (fast <= slow[-1])]
    np.testing.assert_allclose(log.imu.time, inside, rtol=0, atol=2e-9)
    np.testing.assert_allclose(log.imu.gyro_body, gyro(inside), rtol=1e-12)
    np.testing.assert_allclose(log.imu.accel_body, accel(inside), rtol=0, atol=1e-7)  # by the ns
    assert figures["imu_rows_written"] == len(inside)
    left_out = "imu_dropped_outside_of_the_other_half's_table"
    assert figures[left_out] == len(fast) - len(inside)
    assert "Metadata.csv: holds no table of numbers" in figures["notes"][0]
    assert "accel was interpolated linearly to the times of the gyro" in figures["notes"][1]
    assert {p.name for p in (tmp_path / "log").glob("*.parquet")} == {
        "imu.parquet",
        "magnetometer.parquet",
    }


def test_halves_of_the_same_times_are_taken_as_they_are(tmp_path: Path) -> None:
    time = 1.7e9 + np.arange(200) / 128.0  # since 1970: a double tells no less than 0.2 us
    one = table(tmp_path / "a.csv", "t,wx,wy,wz", time, gyro(time - time[0]))
    two = table(tmp_path / "b.csv", "t,ax,ay,az", time, accel(time - time[0]))
    two.write_text("\n".join(two.read_text().splitlines()[:-1]))
    maps = (
        *("gyro.time=t[s]", "gyro.gyro=wx,wy,wz[rad/s]"),
        *("accel.time=t[s]", "accel.accel=ax,ay,az[m/s^2]"),
    )
    field = magnetometer(tmp_path / "m.csv", float(time[0]))
    log, figures = imported(
        tmp_path / "log", gyro=one, accel=two, magnetometer=field, map=maps, epoch="first"
    )
    np.testing.assert_allclose(log.imu.accel_body, accel(time - time[0])[:-1], rtol=1e-12)
    assert not any("interpolated" in note for note in figures.get("notes", []))


def test_where_a_half_is_silent_samples_are_missing_and_not_invented(tmp_path: Path) -> None:
    time = np.arange(400) / 200.0
    detected = time[(time < 0.8) | (time > 1.2)]
    one = table(tmp_path / "gyro.csv", "t (s),wx (rad/s),wy (rad/s),wz (rad/s)", time, gyro(time))
    two = table(
        tmp_path / "accel.csv", "t (s),ax (m/s^2),ay (m/s^2),az (m/s^2)", detected, accel(detected)
    )
    log, figures = imported(tmp_path / "log", one, two, magnetometer(tmp_path / "mag.csv"))
    missing = len(time) - len(detected)
    assert figures["imu_missing"] == missing
    assert len(log.imu.time) == len(detected)  # the reader leaves missing samples out


def test_halves_without_a_moment_in_common_are_refused_and_one_alone_is_no_imu(
    tmp_path: Path,
) -> None:
    time = np.arange(200) / 100.0
    one = table(tmp_path / "gyro.csv", "t (s),wx (rad/s),wy (rad/s),wz (rad/s)", time, gyro(time))
    two = table(
        tmp_path / "acc.csv", "t (s),ax (m/s^2),ay (m/s^2),az (m/s^2)", 90.0 + time, accel(time)
    )
    field = magnetometer(tmp_path / "mag.csv")
    with pytest.raises(
        InputError, match=r"gyro and accel have no moment in common.*--offset TABLE"
    ):
        imported(tmp_path / "log", one, two, field)
    log, figures = imported(tmp_path / "half", one, field)
    assert not len(log.imu)
    assert any("the accel, of which no table is given" in note for note in figures["notes"])
    assert (tmp_path / "half" / "gyro.parquet").is_file()
    log, _ = imported(tmp_path / "log", one, two, field, offset=("accel=-90",))
    np.testing.assert_allclose(log.imu.accel_body, accel(time), rtol=0, atol=1e-7)


def test_an_offset_brings_a_table_to_the_clock_of_the_others(tmp_path: Path) -> None:
    time = np.arange(200) / 100.0
    imu = table(
        tmp_path / "imu.csv",
        "t (ms),wx (rad/s),wy (rad/s),wz (rad/s),ax (g),ay (g),az (g)",
        *(1e3 * time, gyro(time), accel(time) / STANDARD_GRAVITY),
    )
    field = magnetometer(tmp_path / "mag.csv", 40.0)
    file = tmp_path / "map.yaml"
    file.write_text("offset: {magnetometer: -40.25}\n")
    log, _ = imported(tmp_path / "log", imu, field, map_file=file)
    assert log.waveform is not None
    assert log.waveform.time[0] == pytest.approx(-0.25, abs=1e-9)
    with pytest.raises(InputError, match="--offset 'mag=1': write TABLE=SECONDS"):
        imported(tmp_path / "other", imu, field, offset=("mag=1",))
    with pytest.raises(InputError, match="--offset truth: no table of truth is read"):
        imported(tmp_path / "other", imu, field, map_file=file, offset=("truth=1",))


def test_rows_of_one_sensor_are_taken_from_a_table_of_several(tmp_path: Path) -> None:
    time = np.arange(150) / 100.0
    lines = ["when,sensor,x,y,z"]
    for k, t in enumerate(time):
        for name, v in (("GYR", gyro(time)[k] / DEGREE), ("ACC", accel(time)[k]), ("MAG", FIELD)):
            lines.append(
                f"{float(1e3 * t)!r},{name},{float(v[0])!r},{float(v[1])!r},{float(v[2])!r}"
            )
    file = tmp_path / "all.csv"
    file.write_text("\n".join(lines))
    maps = (
        *("gyro.time=when[ms]", "accel.time=when[ms]", "magnetometer.time=when[ms]"),
        *("gyro.gyro=x,y,z[deg/s]", "accel.accel=x,y,z[m/s^2]", "magnetometer.field=x,y,z[T]"),
    )
    rows = ("gyro=sensor:GYR", "accel=sensor:ACC", "magnetometer=sensor:MAG")
    options = {"gyro": file, "accel": file, "magnetometer": file, "map": maps}
    log, _ = imported(tmp_path / "log", rows=rows, **options)
    np.testing.assert_allclose(log.imu.gyro_body, gyro(time), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(log.imu.accel_body, accel(time), rtol=1e-12)
    assert log.waveform is not None
    np.testing.assert_allclose(log.waveform.measured_sensor, np.tile(FIELD, (150, 1)), rtol=1e-12)
    report = json.loads((tmp_path / "log" / "report.json").read_text())
    assert report["gyro_rows_read"] == len(time)
    for wrong, words in (
        (("gyro=kind:GYR", *rows[1:]), "no column kind .found when, sensor"),
        (("gyro=sensor:GYRO", *rows[1:]), "rows with GYRO in sensor: no rows for gyro"),
        (("gyro=GYR", *rows[1:]), "write TABLE=COLUMN:VALUE"),
    ):
        with pytest.raises(InputError, match=words):
            imported(tmp_path / "other", rows=wrong, **options)


def test_a_truth_in_angles_is_that_of_its_rotations(tmp_path: Path) -> None:
    time = np.arange(200) / 100.0
    imu = table(
        tmp_path / "imu.csv",
        "t (s),wx (rad/s),wy (rad/s),wz (rad/s),ax (m/s^2),ay (m/s^2),az (m/s^2)",
        *(time, gyro(time), accel(time)),
    )
    roll, pitch, yaw = 30.0 + 5.0 * time, -20.0 + time, 100.0 * time
    truth = table(
        tmp_path / "mocap.csv",
        "t (s),x (m),y (m),z (m),roll (deg),pitch (deg),yaw (deg)",
        *(time, gyro(time), roll, pitch, yaw),
    )
    log, _ = imported(tmp_path / "log", imu, magnetometer(tmp_path / "mag.csv"), truth)
    assert log.truth is not None
    each = [
        Rotation.from_rotvec(np.outer(angle * DEGREE, axis))
        for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)
    ]
    expected = (each[0] * each[1] * each[2]).as_matrix()
    np.testing.assert_allclose(log.truth.world_from_body, expected, atol=1e-12)
