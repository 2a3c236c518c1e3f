"""MicroPython: inertial samples (MPU-6050) and a magnetometer (RM3100) as binary frames by UDP.

Save as main.py, with a boot.py that joins the network; on the computer
magfusion listen udp:9000 --encoding frames --counts imu.gyro=1.332e-4
  --counts imu.accel=5.986e-4 --counts magnetometer=1.333e-8
"""

import socket
import struct
import time
from binascii import crc32

from machine import I2C

IMU, MAG = 0x68, 0x20
COMPUTER = ("192.168.1.10", 9000)
INTERVAL = 2500  # microseconds: 400 Hz


def cobs(body):
    """Return bytes without zeros: each zero becomes the distance to the next one."""
    parts = bytes(body).split(b"\0")
    return b"".join(bytes((len(part) + 1,)) + part for part in parts)


def frame(kind, letter, count, micros, values):
    """Return a frame; values are as the letter of struct has them, little-endian."""
    body = struct.pack("<2sHI", kind + letter, count & 0xFFFF, micros & 0xFFFFFFFF)
    body += struct.pack("<" + len(values) * letter.decode(), *values)
    return cobs(body + struct.pack("<I", crc32(body) & 0xFFFFFFFF)) + b"\0"


def main(samples=None):
    """Send samples, endlessly if no number of them is given."""
    bus = I2C(0, freq=400000)
    for device, address, value in (
        (IMU, 0x6B, 0x01),  # awake, by the clock of the gyroscope
        (IMU, 0x1A, 0x01),  # filter of 184 Hz
        (IMU, 0x1B, 0x00),  # 250 deg/s
        (IMU, 0x1C, 0x00),  # 2 g
        (MAG, 0x0B, 0x92),  # 600 Hz at most
        (MAG, 0x01, 0x71),  # continuously
    ):
        bus.writeto_mem(device, address, bytes((value,)))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    imu_count = mag_count = micros = 0
    last = due = time.ticks_us()
    while samples is None or imu_count < samples:
        now = time.ticks_us()
        if time.ticks_diff(now, due) < 0:
            continue
        due = time.ticks_add(due, INTERVAL)
        # Its ticks wrap after 30 bits or fewer, those of a frame after 32.
        micros, last = micros + time.ticks_diff(now, last), now
        raw = struct.unpack(">7h", bus.readfrom_mem(IMU, 0x3B, 14))
        message = frame(b"i", b"h", imu_count, micros, raw[4:] + raw[:3])
        imu_count += 1
        if bus.readfrom_mem(MAG, 0x34, 1)[0] & 0x80:  # a new measurement
            bits = bus.readfrom_mem(MAG, 0x24, 9)
            field = [struct.unpack(">i", bits[k : k + 3] + b"\0")[0] >> 8 for k in (0, 3, 6)]
            message += frame(b"m", b"i", mag_count, micros, field)
            mag_count += 1
        sender.sendto(message, COMPUTER)


if __name__ == "__main__":
    main()
