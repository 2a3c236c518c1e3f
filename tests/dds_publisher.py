"""Publish a log's samples as a driver of ROS 2: ``dds_publisher.py DOMAIN LOG [SPEED]``.

It waits for a reader of both topics, /imu/data and /mag, and keeps to the log's clock.
"""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from magfusion.files.log import read_log
from magfusion.results import ros_messages as ros

# As rclcpp's SensorDataQoS.
SENSOR_DATA = Qos(
    Policy.Reliability.BestEffort, Policy.History.KeepLast(5), Policy.Durability.Volatile
)
MAX_WAIT = 60.0  # s
NS = 1_000_000_000


def messages(log: Any) -> list[tuple[int, str, Any]]:
    """Return stamp, topic and message of all samples, in the order of their stamps."""
    unknown, result = [0.0] * 9, []
    imu, wave = log.imu, log.waveform
    for stamp, gyro, accel in zip(
        _stamps(log, imu.time), imu.gyro_body, imu.accel_body, strict=True
    ):
        turn, force = ros.Vector3(*gyro.tolist()), ros.Vector3(*accel.tolist())
        head, none = ros.Header(ros.Time(*divmod(stamp, NS)), "imu"), ros.Quaternion(0, 0, 0, 1)
        parts = (none, unknown, turn, unknown, force, unknown)
        result.append((stamp, "/imu/data", ros.ImuMessage(head, *parts)))
    for stamp, field in zip(_stamps(log, wave.time), wave.measured_sensor, strict=True):
        head = ros.Header(ros.Time(*divmod(stamp, NS)), "magnetometer")
        message = ros.MagneticFieldMessage(head, ros.Vector3(*field.tolist()), unknown)
        result.append((stamp, "/mag", message))
    return sorted(result, key=lambda one: one[0])


def _stamps(log: Any, seconds: np.ndarray) -> list[int]:
    return [log.epoch_ns + round(1e9 * second) for second in seconds.tolist()]


def main(domain: int, path: Path, speed: float) -> None:
    """Publish the log once both topics have a reader."""
    participant, ready = DomainParticipant(domain), time.monotonic() + MAX_WAIT
    kinds = {"/imu/data": ros.ImuMessage, "/mag": ros.MagneticFieldMessage}
    writers = {
        name: DataWriter(participant, Topic(participant, f"rt{name}", kind), qos=SENSOR_DATA)
        for name, kind in kinds.items()
    }
    while not all(writer.get_matched_subscriptions() for writer in writers.values()):
        if time.monotonic() > ready:
            return
        time.sleep(0.05)
    every = messages(read_log(path))
    begin = time.monotonic()
    for stamp, name, message in every:
        ahead = 1e-9 * (stamp - every[0][0]) / speed - (time.monotonic() - begin)
        if ahead > 0.0:
            time.sleep(ahead)
        writers[name].write(message)
    time.sleep(1.0)  # until they have arrived


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
