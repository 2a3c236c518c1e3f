"""Flight logs of autopilots become the log that they were made of, in our axes and units."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from example_flight import (
    Flight,
    dataflash_messages,
    flight_of,
    integrals,
    px4_messages,
    raw_fields,
    write_dataflash,
    write_ulog,
)

from magfusion.files.log import read_log
from magfusion.jobs.simulate import run_simulate
from magfusion.model.samples import Log
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig

SINGLE = 1e-6  # relative; a ULog has floats of four bytes
WITHOUT = (
    "import sys; sys.modules[sys.argv.pop(1)] = None; from magfusion.__main__ import run; run()"
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of twenty seconds, in our axes."""
    path = tmp_path_factory.mktemp("flown") / "log"
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=20.0, magnetometer_rate_hz=100.0, perturb=False
    )
    run_simulate(replace(demo_site(), beacons=()), config, path, seed=11)
    return path


@pytest.fixture(scope="module")
def flight(flown: Path) -> Flight:
    return flight_of(read_log(flown))


def magfusion(*arguments: object, without: str = "") -> subprocess.CompletedProcess[str]:
    start = ["-c", WITHOUT, without] if without else ["-m", "magfusion"]
    command = [sys.executable, *start, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def imported(path: Path, output: Path, *options: str) -> tuple[Log, str]:
    done = magfusion("import", path, "-o", output, *options)
    assert done.returncode == 0, done.stderr
    return read_log(output), done.stdout


def assert_same(own: Log, log: Log, field: float = SINGLE * 5e-5) -> None:
    """Assert that samples are those of a log, on a clock that begins with the inertial ones."""
    begin = log.imu.time[0]
    np.testing.assert_allclose(own.imu.time, log.imu.time - begin, rtol=0, atol=1.1e-6)  # s
    np.testing.assert_allclose(own.imu.gyro_body, log.imu.gyro_body, rtol=SINGLE, atol=1e-7)
    np.testing.assert_allclose(own.imu.accel_body, log.imu.accel_body, rtol=SINGLE, atol=1e-6)
    assert own.waveform is not None
    assert log.waveform is not None
    np.testing.assert_allclose(own.waveform.time, log.waveform.time - begin, rtol=0, atol=1.1e-6)
    measured = log.waveform.measured_sensor
    np.testing.assert_allclose(own.waveform.measured_sensor, measured, rtol=0, atol=field)  # T


def turned(own: Log, log: Log) -> float:
    """Return the largest angle between the attitudes of two logs (rad)."""
    assert own.truth is not None
    assert log.truth is not None
    rows = np.searchsorted(log.truth.time - log.imu.time[0], own.truth.time - 1e-5)
    true = log.truth.world_from_body[rows]
    cosine = 0.5 * (np.einsum("nij,nij->n", own.truth.world_from_body, true) - 1.0)
    return float(np.sqrt(2.0 * np.max(1.0 - cosine)))


@pytest.mark.slow
def test_a_ulog_gives_its_samples_and_poses(flown: Path, flight: Flight, tmp_path: Path) -> None:
    path = write_ulog(tmp_path / "flight.ulg", px4_messages(flight))
    own, shown = imported(path, tmp_path / "log", "--site", str(flown / "site.yaml"))
    log = read_log(flown)
    assert_same(own, log)
    assert turned(own, log) < 1e-5
    assert own.truth is not None
    assert log.truth is not None
    rows = np.searchsorted(log.truth.time - log.imu.time[0], own.truth.time - 1e-5)
    assert len(rows) > 0.98 * len(log.truth.time)
    # Interpolated over .1 s, at accelerations of the walk.
    position = log.truth.position_world[rows]
    np.testing.assert_allclose(own.truth.position_world, position, rtol=0, atol=5e-3)  # m
    assert own.truth.velocity_world is not None
    assert log.truth.velocity_world is not None
    velocity = log.truth.velocity_world[rows]
    np.testing.assert_allclose(own.truth.velocity_world, velocity, rtol=0, atol=0.05)  # m/s
    assert "imu.gyro=gyro_rad[0],-gyro_rad[1],-gyro_rad[2][rad/s]" in shown
    report = json.loads((tmp_path / "log" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"


@pytest.mark.slow
def test_integrals_and_a_second_raw_magnetometer(
    flown: Path, flight: Flight, tmp_path: Path
) -> None:
    messages = px4_messages(flight)
    del messages["sensor_combined"], messages["vehicle_local_position"]
    messages |= {"vehicle_imu": integrals(flight), "sensor_mag:1": raw_fields(flight)}
    path = write_ulog(tmp_path / "flight.ulg", messages)
    own, shown = imported(path, tmp_path / "log", "--map", "magnetometer=sensor_mag:1")
    assert_same(own, read_log(flown))
    assert turned(own, read_log(flown)) < 1e-5
    assert own.truth is not None
    assert np.isnan(own.truth.position_world).all()
    assert "attitudes alone" in " ".join(shown.split())
    done = magfusion("import", path, "-o", tmp_path / "none", "--map", "magnetometer=sensor_mag")
    assert done.returncode == 2
    assert "found vehicle_magnetometer, sensor_mag:1" in " ".join(done.stderr.split())


@pytest.mark.slow
def test_a_position_that_is_not_valid_is_left_out(flight: Flight, tmp_path: Path) -> None:
    messages = px4_messages(flight)
    local = messages["vehicle_local_position"][1]
    local["xy_valid"] = np.arange(len(local["x"])) < len(local["x"]) // 2
    own, _ = imported(write_ulog(tmp_path / "flight.ulg", messages), tmp_path / "log")
    assert own.truth is not None
    assert own.truth.time[-1] == pytest.approx(10.0, abs=0.3)
    assert np.isfinite(own.truth.position_world).all()


@pytest.mark.slow
def test_a_ulog_without_its_package_or_contents_is_refused(flight: Flight, tmp_path: Path) -> None:
    messages = px4_messages(flight)
    path = write_ulog(tmp_path / "flight.ulg", messages)
    done = magfusion("import", path, "-o", tmp_path / "log", without="pyulog")
    assert done.returncode == 2
    assert "pip install 'magfusion[ulog]'" in " ".join(done.stderr.split())
    del messages["vehicle_magnetometer"]
    path = write_ulog(tmp_path / "blind.ulg", messages)
    done = magfusion("import", path, "-o", tmp_path / "log")
    assert done.returncode == 2
    assert "has no message vehicle_magnetometer or sensor_mag" in " ".join(done.stderr.split())
    (tmp_path / "none.ulg").write_bytes(b"no flight")
    done = magfusion("import", tmp_path / "none.ulg", "-o", tmp_path / "log")
    assert done.returncode == 2
    assert "is no PX4 ULog" in " ".join(done.stderr.split())


@pytest.mark.slow
def test_a_dataflash_log_gives_its_samples_and_poses(
    flown: Path, flight: Flight, tmp_path: Path
) -> None:
    messages = dataflash_messages(flight)
    form, names, rows = messages["MAG"]
    second = np.hstack([rows[:, :1], np.ones((len(rows), 1)), rows[:, 2:] + 30.0])
    messages["MAG"] = form, names, np.vstack([rows, second])
    path = write_dataflash(tmp_path / "flight.BIN", messages)
    own, shown = imported(path, tmp_path / "log", "--site", str(flown / "site.yaml"))
    log = read_log(flown)
    assert_same(own, log, field=0.5001e-7)  # half a milligauss
    assert turned(own, log) < np.radians(0.0051 * np.sqrt(3.0))  # of hundredths of a degree
    assert own.truth is not None
    assert log.truth is not None
    np.testing.assert_allclose(own.truth.position_world, log.truth.position_world, atol=1e-6)
    assert own.truth.velocity_world is not None
    np.testing.assert_allclose(own.truth.velocity_world, log.truth.velocity_world, atol=1e-6)
    assert "magnetometer=MAG:1" in " ".join(shown.split())
    report = json.loads((tmp_path / "log" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    other, _ = imported(path, tmp_path / "other", "--map", "magnetometer=MAG:1")
    assert other.waveform is not None
    assert own.waveform is not None
    moved = other.waveform.measured_sensor - own.waveform.measured_sensor
    np.testing.assert_allclose(moved, np.tile([3e-6, -3e-6, -3e-6], (len(moved), 1)), atol=1e-12)


@pytest.mark.slow
def test_attitudes_of_a_dataflash_log_without_an_ekf(
    flown: Path, flight: Flight, tmp_path: Path
) -> None:
    messages = dataflash_messages(flight)
    _, _, rows = messages.pop("XKF1")
    angles = np.hstack([rows[:, :1], rows[:, 2:5]])
    messages["ATT"] = "QccC", "TimeUS,Roll,Pitch,Yaw", angles
    own, _ = imported(write_dataflash(tmp_path / "flight.bin", messages), tmp_path / "log")
    assert turned(own, read_log(flown)) < np.radians(0.0051 * np.sqrt(3.0))
    assert own.truth is not None
    assert np.isnan(own.truth.position_world).all()


@pytest.mark.slow
def test_a_dataflash_log_without_its_package_or_contents_is_refused(
    flight: Flight, tmp_path: Path
) -> None:
    messages = dataflash_messages(flight)
    path = write_dataflash(tmp_path / "flight.bin", messages)
    done = magfusion("import", path, "-o", tmp_path / "log", without="pymavlink")
    assert done.returncode == 2
    assert "pip install 'magfusion[mavlink]'" in " ".join(done.stderr.split())
    del messages["MAG"]
    path = write_dataflash(tmp_path / "blind.bin", messages)
    done = magfusion("import", path, "-o", tmp_path / "log")
    assert done.returncode == 2
    assert "has no message MAG" in " ".join(done.stderr.split())
    (tmp_path / "none.bin").write_bytes(b"no flight")
    done = magfusion("import", tmp_path / "none.bin", "-o", tmp_path / "log")
    assert done.returncode == 2
    assert "is no ArduPilot DataFlash log" in " ".join(done.stderr.split())
