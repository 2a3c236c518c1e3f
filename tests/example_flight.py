"""Flight logs as autopilots write them, by the own writers of pyulog and pymavlink.

Sensors go to forward-right-down axes, the truth to north-east-down, by matrices.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.DFReader import DFFormat, DFReader_binary
from pyulog import ULog
from scipy.spatial.transform import Rotation

from magfusion.model.samples import Log

FRD = np.diag([1.0, -1.0, -1.0])  # to or from forward-left-up
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # to or from east-north-up
START_US = 41_000_000  # of the autopilot's clock
IMU_STEP_US = 4000  # length of the means of a PX4 sample


class Flight(NamedTuple):
    """A log in an autopilot's axes: stamps in us, gauss."""

    imu_us: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    mag_us: np.ndarray
    gauss: np.ndarray
    truth_us: np.ndarray
    attitude: Rotation
    position: np.ndarray
    velocity: np.ndarray


def flight_of(log: Log) -> Flight:
    """Return what the autopilot on the body of a log would write."""
    stamps = [
        START_US + np.rint(time * 1e6).astype(np.int64)
        for time in (log.imu.time, log.waveform.time, log.truth.time)
    ]
    return Flight(
        stamps[0],
        log.imu.gyro_body @ FRD,
        log.imu.accel_body @ FRD,
        stamps[1],
        log.waveform.measured_sensor @ FRD * 1e4,
        stamps[2],
        Rotation.from_matrix(NED @ log.truth.world_from_body @ FRD),
        log.truth.position_world @ NED,
        log.truth.velocity_world @ NED,
    )


def px4_messages(flight: Flight) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """Return messages of PX4: their formats, and their columns."""
    half = IMU_STEP_US // 2
    step = np.full(len(flight.imu_us), IMU_STEP_US)
    local = slice(None, None, 20)  # slower than the attitude, as PX4 logs them
    quaternion = flight.attitude.as_quat(scalar_first=True)
    flags = np.ones(len(flight.truth_us[local]))
    delay = 700  # us, from a sample to its message
    return {
        "sensor_combined": (
            "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
            "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
            "uint32_t accelerometer_integral_dt;",
            {
                "timestamp": flight.imu_us + half,
                **_array("gyro_rad", flight.gyro),
                "gyro_integral_dt": step,
                "accelerometer_timestamp_relative": 0 * step,
                **_array("accelerometer_m_s2", flight.accel),
                "accelerometer_integral_dt": step,
            },
        ),
        "vehicle_magnetometer": (
            "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;"
            "float[3] magnetometer_ga;uint8_t calibration_count;uint8_t[3] _padding0;",
            {
                "timestamp": flight.mag_us + delay,
                "timestamp_sample": flight.mag_us,
                "device_id": np.full(len(flight.mag_us), 197388),
                **_array("magnetometer_ga", flight.gauss),
                "calibration_count": np.zeros(len(flight.mag_us)),
            },
        ),
        "vehicle_attitude": (
            "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;float[4] delta_q_reset;"
            "uint8_t quat_reset_counter;uint8_t[7] _padding0;",
            {
                "timestamp": flight.truth_us + delay,
                "timestamp_sample": flight.truth_us,
                **_array("q", quaternion),
                **_array("delta_q_reset", 0.0 * quaternion),
                "quat_reset_counter": np.zeros(len(flight.truth_us)),
            },
        ),
        "vehicle_local_position": (
            "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float vx;"
            "float vy;float vz;bool xy_valid;bool z_valid;uint8_t[6] _padding0;",
            {
                "timestamp": flight.truth_us[local] + delay,
                "timestamp_sample": flight.truth_us[local],
                **dict(zip("xyz", flight.position[local].T, strict=True)),
                **dict(zip(("vx", "vy", "vz"), flight.velocity[local].T, strict=True)),
                "xy_valid": flags,
                "z_valid": flags,
            },
        ),
    }


def integrals(flight: Flight) -> tuple[str, dict[str, np.ndarray]]:
    """Return ``vehicle_imu``: the same samples, integrated over their interval."""
    seconds = IMU_STEP_US * 1e-6
    step = np.full(len(flight.imu_us), IMU_STEP_US)
    return (
        "uint64_t timestamp;uint64_t timestamp_sample;float[3] delta_angle;"
        "float[3] delta_velocity;uint32_t delta_angle_dt;uint32_t delta_velocity_dt;",
        {
            "timestamp": flight.imu_us + IMU_STEP_US,
            "timestamp_sample": flight.imu_us + IMU_STEP_US // 2,
            **_array("delta_angle", flight.gyro * seconds),
            **_array("delta_velocity", flight.accel * seconds),
            "delta_angle_dt": step,
            "delta_velocity_dt": step,
        },
    )


def raw_fields(flight: Flight) -> tuple[str, dict[str, np.ndarray]]:
    """Return ``sensor_mag``, whose components are x, y and z."""
    return (
        "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;",
        {
            "timestamp": flight.mag_us,
            "timestamp_sample": 0 * flight.mag_us,
            "device_id": np.full(len(flight.mag_us), 197388),
            **dict(zip("xyz", flight.gauss.T, strict=True)),
        },
    )


def write_ulog(path: Path, messages: dict[str, tuple[str, dict[str, np.ndarray]]]) -> Path:
    """Write messages, NAME or NAME:INSTANCE, by pyulog's writer."""
    log = ULog(None)
    log._start_timestamp = START_US
    for number, (key, (form, columns)) in enumerate(messages.items()):
        name, _, instance = key.partition(":")
        log._message_formats[name] = ULog.MessageFormat(f"{name}:{form}".encode(), None)
        header = struct.pack("<BH", int(instance or 0), number) + name.encode()
        added = ULog._MessageAddLogged(header, None, log._message_formats)
        rows = np.zeros(len(columns["timestamp"]), dtype=added.dtype)
        for column, values in columns.items():
            rows[column] = values
        added.buffer = bytearray(rows.tobytes())
        log._data_list.append(ULog.Data(added))
    log.write_ulog(str(path))
    return path


def dataflash_messages(flight: Flight) -> dict[str, tuple[str, str, np.ndarray]]:
    """Return messages of ArduPilot: format, names, and rows with the stamp first."""
    euler = np.degrees(flight.attitude.as_euler("ZYX")[:, ::-1])
    euler[:, 2] %= 360.0
    inertial = [np.zeros(len(flight.imu_us)), *flight.gyro.T, *flight.accel.T]
    milligauss = np.rint(flight.gauss * 1e3)
    zero = np.zeros(len(flight.truth_us))
    state = [zero, *euler.T, *flight.velocity.T, zero, *flight.position.T]
    return {
        "IMU": (
            "QBffffff",
            "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
            np.column_stack([flight.imu_us, *inertial]),
        ),
        "MAG": (
            "QBhhh",
            "TimeUS,I,MagX,MagY,MagZ",
            np.column_stack([flight.mag_us, 0 * flight.mag_us, *milligauss.T]),
        ),
        "XKF1": (
            "QBccCfffffff",
            "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD",
            np.column_stack([flight.truth_us, *state]),
        ),
    }


def write_dataflash(path: Path, messages: dict[str, tuple[str, str, np.ndarray]]) -> Path:
    """Write messages in the order of their stamps, by pymavlink's packing."""
    empty = path.with_suffix(".empty")
    empty.write_bytes(b"\xa3\x95\x80")
    with DFReader_binary(str(empty)) as writer:
        formats = [DFFormat(0x80, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")]
        packed = []
        for number, (name, (form, columns, rows)) in enumerate(messages.items(), start=0x81):
            one = DFFormat(number, name, 0, form, columns)
            formats.append(one)
            scale = [multiple or 1.0 for multiple in one.msg_mults]
            for row in rows:
                values = [
                    kind(round(value / step)) if step != 1.0 or kind is int else float(value)
                    for value, step, kind in zip(row, scale, map(_packed, form), strict=True)
                ]
                packed.append((row[0], writer.make_msgbuf(one, values)))
        head = b"".join(map(writer.make_format_msgbuf, formats))
    path.write_bytes(head + b"".join(body for _, body in sorted(packed, key=lambda one: one[0])))
    return path


def _packed(letter: str) -> type:
    return float if letter in "fd" else int


def _array(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}[{k}]": values[:, k] for k in range(values.shape[1])}
