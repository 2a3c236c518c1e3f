"""The example sketches of microcontrollers send what the computer reads."""

import importlib.util
import itertools
import shutil
import socket
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from magfusion.jobs.listen_lines import LineSource

ROOT = Path(__file__).parents[1]
HARDWARE, STUBS = ROOT / "docs" / "hardware", ROOT / "tests" / "arduino"
SAMPLES, INTERVAL = 300, 2.5e-3  # s
GYRO, ACCEL, FIELD = [3.0, -4.0, 0.0], [16384.0, 1.0, -2.0], [0.0, -2.0, 65536.0]
REGISTERS = {  # of the inertial sensor and of the magnetometer, as in tests/arduino/Wire.h
    (0x68, 0x3B): bytes([0x40, 0, 0, 1, 0xFF, 0xFE, 0, 0, 0, 3, 0xFF, 0xFC, 0, 0]),
    (0x20, 0x34): b"\x80",
    (0x20, 0x24): bytes([0, 0, 0, 0xFF, 0xFF, 0xFE, 1, 0, 0]),
}
MAIN = "\nint main() { setup(); for (int k = 0; k < 50000 && imu_count < 300; k++) loop(); }\n"


def check(content: list[bytes]) -> None:
    """Check that all samples are read, with their values, at their interval."""
    source = LineSource("udp:9000", {}, "frames")
    records = [r for k, part in enumerate(content) for r in source.records(part, k * INTERVAL)]
    assert not +source.faults
    inertial = [r["imu"] for r in records if "imu" in r]
    fields = [r["magnetometer"] for r in records if "magnetometer" in r]
    assert len(inertial) == len(fields) == SAMPLES
    assert all(one["gyro"] == [GYRO] and one["accel"] == [ACCEL] for one in inertial)
    assert all(one["field"] == [FIELD] for one in fields)
    step = np.diff([one["time"][0] for one in inertial])
    assert np.max(np.abs(step - INTERVAL)) < 3e-4  # it polls


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed here")
def test_the_arduino_sketch(tmp_path: Path) -> None:
    source, program = tmp_path / "sketch.cpp", tmp_path / "sketch"
    source.write_text((HARDWARE / "frames.ino").read_text() + MAIN)
    command = ["g++", "-std=c++17", "-Wall", "-Werror", f"-I{STUBS}", source, "-o", program]
    subprocess.run(command, check=True)
    sent = subprocess.run([program], check=True, capture_output=True).stdout
    check([one + b"\0" for one in sent.split(b"\0")[:-1]])


class Bus:
    """An I2C bus of MicroPython whose sensors always measure the same."""

    def __init__(self, _number: int, freq: int) -> None:
        assert freq == 400_000

    def writeto_mem(self, device: int, _address: int, value: bytes) -> None:
        assert (device in (0x68, 0x20), len(value)) == (True, 1)

    def readfrom_mem(self, device: int, address: int, length: int) -> bytes:
        result = REGISTERS[device, address]
        assert len(result) == length
        return result


def test_the_micropython_sketch(monkeypatch: pytest.MonkeyPatch) -> None:
    """By CPython, with ticks that wrap after 30 bits as MicroPython's."""
    period, elapsed, sent = 1 << 30, itertools.count((1 << 30) - 100_000, 100), []
    clock = types.ModuleType("time")
    vars(clock).update(
        ticks_us=lambda: next(elapsed) % period,
        ticks_add=lambda one, more: (one + more) % period,
        ticks_diff=lambda one, other: (one - other + period // 2) % period - period // 2,
    )
    machine = types.ModuleType("machine")
    vars(machine).update(I2C=Bus)
    spec = importlib.util.spec_from_file_location("frames", HARDWARE / "frames.py")
    assert spec is not None
    assert spec.loader is not None
    sketch = importlib.util.module_from_spec(spec)
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "time", clock)
        patched.setitem(sys.modules, "machine", machine)
        spec.loader.exec_module(sketch)
    network = types.SimpleNamespace(sendto=lambda content, _to: sent.append(content))
    monkeypatch.setattr(socket, "socket", lambda *_: network)
    sketch.main(SAMPLES)
    check(sent)
