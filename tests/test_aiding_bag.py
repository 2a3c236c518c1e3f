"""Aiding sensors in a bag: topics by the names of the site's sensors, of every type."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from aiding_site import aided_site
from example_bag import (
    ODOMETRY,
    POSE,
    POSITION,
    SENSORS,
    STAMPS,
    STORE,
    VELOCITY_BODY,
    N,
    header,
    odometry_message,
    pose_message,
    write_bag,
    xyz,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.aiding_messages import SensorMessages
from magfusion.files.bag import read_bag
from magfusion.files.site import save_site
from magfusion.model.aiding import AidingSensor, Quantity
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
RANGE = "sensor_msgs/msg/Range"
PRESSURE = "sensor_msgs/msg/FluidPressure"


def _twist(k: int) -> Any:
    twist = STORE.types["geometry_msgs/msg/Twist"](
        xyz("Vector3", VELOCITY_BODY[k]), xyz("Vector3", np.zeros(3))
    )
    with_cov = STORE.types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
    return STORE.types[TWIST](header(int(STAMPS[k])), with_cov)


def _range(k: int) -> Any:
    return STORE.types[RANGE](header(int(STAMPS[k])), 0, 0.1, 0.0, 50.0, 2.0 + 0.5 * k)


def _pressure(k: int) -> Any:
    return STORE.types[PRESSURE](header(int(STAMPS[k])), 1e5 + k, 0.0)


def _sensors(quantities: dict[str, Quantity]) -> tuple[AidingSensor, ...]:
    return tuple(AidingSensor(name, quantity, 0.1) for name, quantity in quantities.items())


def test_topics_are_read_by_the_names_of_the_sensors(tmp_path):
    topics = SENSORS | {
        "/wheels/odom": (ODOMETRY, odometry_message),
        "/truth": (ODOMETRY, odometry_message),
        "/visual": (TWIST, _twist),
        "/uwb": (RANGE, _range),
        "/air": (PRESSURE, _pressure),
        "/prism": (POSE, pose_message),
    }
    bag = write_bag(tmp_path / "bag", topics)
    log = read_bag(
        bag,
        aiding=_sensors(
            {
                "odom": "velocity",
                "/visual": "velocity",
                "uwb": "range",
                "air": "pressure",
                "prism": "position",
                "absent": "height",
            }
        ),
    )
    assert log.aiding.keys() == {"odom", "/visual", "uwb", "air", "prism"}
    assert np.array_equal(log.aiding["odom"].value, VELOCITY_BODY)
    assert np.array_equal(log.aiding["/visual"].value, VELOCITY_BODY)
    assert np.array_equal(log.aiding["uwb"].value[:, 0], 2.0 + 0.5 * np.arange(N))
    assert np.array_equal(log.aiding["air"].value[:, 0], 1e5 + np.arange(N))
    assert np.array_equal(log.aiding["prism"].value, POSITION)
    assert np.allclose(log.aiding["odom"].time, log.imu.time, rtol=0.0, atol=1e-9)
    assert log.truth is not None  # the odometry that is no sensor


def test_the_odometry_of_a_sensor_is_no_truth(tmp_path):
    bag = write_bag(tmp_path / "bag", SENSORS | {"/odom": (ODOMETRY, odometry_message)})
    assert read_bag(bag).truth is not None
    assert read_bag(bag, aiding=_sensors({"odom": "velocity"})).truth is None


def test_a_topic_of_another_type_is_refused(tmp_path):
    bag = write_bag(tmp_path / "bag", SENSORS | {"/uwb": (PRESSURE, _pressure)})
    with pytest.raises(InputError, match="aiding sensor uwb measures range"):
        read_bag(bag, aiding=_sensors({"uwb": "range"}))


def test_two_topics_of_a_short_name_are_refused(tmp_path):
    two = {f"/{side}/uwb": (RANGE, _range) for side in ("left", "right")}
    bag = write_bag(tmp_path / "bag", SENSORS | two)
    with pytest.raises(InputError, match="/left/uwb and /right/uwb"):
        read_bag(bag, aiding=_sensors({"uwb": "range"}))
    assert read_bag(bag, aiding=_sensors({"left/uwb": "range"})).aiding.keys() == {"left/uwb"}


def _write_drive(path: Any, simulated: SimulatedLog) -> None:
    """Write what a vehicle records: IMU, magnetometer and odometry, no truth."""
    log, types = simulated.log, STORE.types
    wheels = log.aiding["odom"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def write(topic: str, msgtype: str, time: np.ndarray, make: Any) -> None:
            connection = writer.add_connection(topic, msgtype, typestore=STORE)
            for k, stamp in enumerate((log.epoch_ns + np.rint(time * 1e9)).astype(int).tolist()):
                raw = STORE.serialize_cdr(make(k, header(stamp)), msgtype)
                writer.write(connection, stamp, raw)

        def inertial(k: int, head: Any) -> Any:
            gyro, accel = (
                xyz("Vector3", log.imu.gyro_body[k]),
                xyz("Vector3", log.imu.accel_body[k]),
            )
            none = np.zeros(9)
            turn = xyz("Quaternion", np.array([0, 0, 0, 1]))
            return types["sensor_msgs/msg/Imu"](head, turn, none, gyro, none, accel, none)

        def field(k: int, head: Any) -> Any:
            measured = xyz("Vector3", log.waveform.measured_sensor[k])
            return types["sensor_msgs/msg/MagneticField"](head, measured, np.zeros(9))

        def odometry(k: int, head: Any) -> Any:
            message = odometry_message(0)
            linear = xyz("Vector3", np.nan_to_num(wheels.value[k]))
            twist = types["geometry_msgs/msg/Twist"](linear, xyz("Vector3", np.zeros(3)))
            message.twist.twist, message.header = twist, head
            return message

        write("/imu", "sensor_msgs/msg/Imu", log.imu.time, inertial)
        write("/mag", "sensor_msgs/msg/MagneticField", log.waveform.time, field)
        write("/odom", ODOMETRY, wheels.time, odometry)


@pytest.mark.slow
def test_a_vehicles_bag_is_smoothed_and_navigated_without_a_mapping(tmp_path):
    wheels = AidingSensor("odom", "velocity", 0.02)
    site = aided_site(wheels)
    room = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.2]])  # m
    config = SimulationConfig(
        room, 9.0, motion="drive", speed=1.0, rests=Rests(2.0, 9.0, 0.0), perturb=False
    )
    _write_drive(tmp_path / "bag", simulate_log(site, config, np.random.default_rng(3)))
    save_site(replace(site, aiding=(wheels,)), tmp_path / "site.yaml")
    for job in ("smooth", "navigate"):
        command = [sys.executable, "-m", "magfusion", job, "bag", "--site", "site.yaml", "-o", job]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "TRUSTWORTHY" in done.stdout
    command = [sys.executable, "-m", "magfusion", "replay", "bag", "--site", "site.yaml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert '"aiding":{"odom":{"time"' in done.stdout


def _fix(k: int, status: int) -> Any:
    """Return a fix 100 m north and k metres above the origin, by a degree of the meridian."""
    types = STORE.types
    flattened = 6.69437999014e-3
    sine = np.sin(np.deg2rad(ORIGIN[0]))
    meridian = 6378137.0 * (1.0 - flattened) / (1.0 - flattened * sine**2) ** 1.5  # m
    latitude = ORIGIN[0] + np.rad2deg(100.0 / meridian)
    satellites = types["sensor_msgs/msg/NavSatStatus"](status, 1)
    place = latitude, ORIGIN[1], ORIGIN[2] + float(k)
    return types[FIX](header(int(STAMPS[k])), satellites, *place, np.zeros(9), 0)


FIX = "sensor_msgs/msg/NavSatFix"
ORIGIN = (60.5, 25.25, 30.0)


def test_fixes_of_gnss_are_positions_in_the_tangent_plane(tmp_path):
    """The plane leaves the ellipsoid by 0.8 mm in 100 m; where there is no fix there is none."""
    bag = write_bag(tmp_path / "bag", SENSORS | {"/gnss": (FIX, lambda k: _fix(k, k % 2 - 1))})
    sensor = AidingSensor("gnss", "position", 1.0, origin=ORIGIN)
    log = read_bag(bag, aiding=(sensor,))
    assert f"gnss: {N // 2} of {N} messages have no value (no fix)." in log.findings[0].text
    samples = log.aiding["gnss"]
    assert np.allclose(samples.value[:, 0], 0.0, rtol=0.0, atol=1e-9)
    assert np.allclose(samples.value[:, 1], 100.0, rtol=0.0, atol=2e-3)
    assert np.allclose(samples.value[:, 2], np.arange(1, N, 2) - 0.8e-3, rtol=0.0, atol=1e-4)
    with pytest.raises(InputError, match="add the origin of the world"):
        read_bag(bag, aiding=(replace(sensor, origin=None),))
    bag = write_bag(tmp_path / "without", SENSORS | {"/gnss": (FIX, lambda k: _fix(k, -1))})
    with pytest.raises(InputError, match=r"none of its .* messages has a value .*leave gnss out"):
        read_bag(bag, aiding=(sensor,))


def test_poses_without_a_twist_give_velocities():
    """Of a circle; in parts as they arrive as well as at once."""
    sensor, rate, speed = AidingSensor("visual", "velocity", 0.02), 0.5, 1.2
    time = 3.0 + np.arange(0.0, 10.0, 1.0 / 30.0)
    angle = rate * time
    position = speed / rate * np.stack([np.sin(angle), -np.cos(angle), 0.0 * angle], axis=1)
    attitude = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_quat()
    rows = np.hstack([position, attitude, np.zeros((len(time), 3))])
    stamps, velocity = SensorMessages(sensor).samples(time, rows)
    assert np.allclose(np.diff(stamps), 0.1, rtol=0.0, atol=1e-6)
    # The chord of 0.05 rad is shorter than its arc by 1 in 9,600.
    assert np.allclose(velocity, [speed, 0.0, 0.0], rtol=0.0, atol=2e-4)
    online = SensorMessages(sensor)
    parts = [online.samples(time[k : k + 4], rows[k : k + 4]) for k in range(0, len(time), 4)]
    assert np.allclose(np.concatenate([one for one, _ in parts]), stamps, rtol=0.0, atol=1e-12)
    assert np.allclose(np.concatenate([one for _, one in parts]), velocity, rtol=0.0, atol=1e-9)
    rows[:, 7] = speed
    assert len(SensorMessages(sensor).samples(time, rows)[0]) == len(time)
