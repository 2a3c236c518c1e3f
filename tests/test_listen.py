"""Records of a microcontroller by a serial port and UDP, and the clock of what arrives late."""

import json
import os
import pty
import queue
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Literal
from zlib import crc32

import numpy as np
import pytest
from cobs import cobs

from magfusion.errors import InputError
from magfusion.jobs.listen_lines import LineSource, scales_of
from magfusion.receiver.host_clock import SETTLING, HostClock

RATE_HZ = 400
LINES = 1200
BEGIN_COUNT, BEGIN_MICROS = (1 << 16) - 100, (1 << 32) - 500_000  # both wrap
LOST, DOUBLED, GARBLED = (*range(200, 207), 900), (300, 301), (500, 777)


def line(number: int) -> bytes:
    """Return a line of a magnetometer with the number in its counts."""
    count = (BEGIN_COUNT + number) % (1 << 16)
    micros = (BEGIN_MICROS + number * 1_000_000 // RATE_HZ) % (1 << 32)
    body = f"mag,{count},{micros},{100 + number},-20,4000".encode()
    return body + f"*{reduce(xor, body):02X}\n".encode()


def frame(number: int) -> bytes:
    """Return the same as a binary frame."""
    count = (BEGIN_COUNT + number) % (1 << 16)
    micros = (BEGIN_MICROS + number * 1_000_000 // RATE_HZ) % (1 << 32)
    body = struct.pack("<ccHI3h", b"m", b"h", count, micros, 100 + number, -20, 4000)
    return cobs.encode(body + struct.pack("<I", crc32(body))) + b"\0"


RECORDS = {"lines": line, "frames": frame}


def sent(encoding: str) -> list[bytes]:
    """Return records of which some are lost, doubled or garbled."""
    result = []
    for number in range(LINES):
        own = RECORDS[encoding](number)
        if number in GARBLED:
            own = own[:9] + bytes([own[9] ^ 0x81 or 1]) + own[10:]
        result += [] if number in LOST else [own] * (1 + (number in DOUBLED))
    return result


def check_stamps(times: np.ndarray) -> None:
    """Check that the stamps go on evenly over losses and over counters that wrap."""
    kept = np.setdiff1d(np.arange(LINES), [*LOST, *GARBLED])
    assert len(times) == len(kept)
    off = times - times[0] - kept / RATE_HZ
    assert np.max(np.abs(off)) < 1e-3  # the rate of the clock is hardly known yet
    assert np.max(np.abs(np.diff(off))) < 1e-5


FAULTS = {("mag", "lost"): len(LOST) + len(GARBLED), ("mag", "doubled"): 2, ("", "garbled"): 2}


def listened(source: LineSource, send: threading.Thread) -> list[dict[str, dict[str, list[float]]]]:
    """Return the records of what another thread sends."""
    arrivals: queue.Queue = queue.Queue()
    source.open(arrivals, time.monotonic())
    send.start()
    result = []
    while True:
        try:
            own, content, arrival = arrivals.get(timeout=1.5)
        except queue.Empty:
            break
        result += own.records(content, arrival)
    send.join()
    assert sorted(source.close()) == sorted(
        f"{source.place}: {count} {name or 'records'} {fault}."
        for (name, fault), count in FAULTS.items()
    )
    return result


def paced(write: Callable[[list[bytes]], object], encoding: str) -> threading.Thread:
    """Return a thread that writes the records at their rate, a few at once."""

    def run() -> None:
        lines, begin = sent(encoding), time.monotonic()
        for k in range(0, len(lines), 8):
            time.sleep(max(begin + k / RATE_HZ - time.monotonic(), 0.0))
            write(lines[k : k + 8])

    return threading.Thread(target=run)


@pytest.mark.parametrize("encoding", ["lines", "frames"])
def test_records_by_udp(encoding: Literal["lines", "frames"]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    source = LineSource(f"udp:{port}", scales_of(("magnetometer=1e-8,100,0,0",)), encoding)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def write(lines: list[bytes]) -> None:
            for one in lines:
                sender.sendto(one, ("127.0.0.1", port))

        records = listened(source, paced(write, encoding))
    check_stamps(np.array([r["magnetometer"]["time"][0] for r in records]))
    assert records[150]["magnetometer"]["field"] == [pytest.approx([1.5e-6, -2e-7, 4e-5])]


@pytest.mark.parametrize("encoding", ["lines", "frames"])
def test_records_by_a_serial_port(encoding: Literal["lines", "frames"]) -> None:
    """The first record is lost: where it began is unknown."""
    pytest.importorskip("serial")
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    source = LineSource(f"serial:{os.ttyname(theirs)}", {}, encoding)

    def write(lines: list[bytes]) -> None:
        first = RECORDS[encoding](0)
        text = first[7:] * (lines[0] == first) + b"".join(lines)
        os.write(ours, text[:37])  # a record in two parts
        os.write(ours, text[37:])

    records = listened(source, paced(write, encoding))
    check_stamps(np.array([r["magnetometer"]["time"][0] for r in records]))
    os.close(ours)
    os.close(theirs)


def test_a_device_that_restarts_is_followed() -> None:
    """Its counters begin again: eight records later the host's clock goes on."""
    source, times = LineSource("udp:9000", {}), []
    for number in range(200):
        again = number if number < 100 else number - 100
        for one in source.records(line(again), 5.0 + number / RATE_HZ):
            times += one["magnetometer"]["time"]
    assert +source.faults == {("mag", "late"): 7, ("mag", "restarted"): 1}
    kept = np.setdiff1d(np.arange(200), np.arange(100, 107))
    assert np.max(np.abs(np.diff(times) - np.diff(kept) / RATE_HZ)) < 1e-4


@pytest.mark.slow
def test_the_command_prints_records_until_its_time_is_over(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "magfusion", "listen", f"udp:{port}", "--duration", "4"]
    with (
        (tmp_path / "records").open("wb") as output,
        subprocess.Popen(command, stdout=output) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        number = 0
        while process.poll() is None:
            sender.sendto(line(number), ("127.0.0.1", port))
            number += 1
            time.sleep(0.02)
    assert process.returncode == 0
    records = [json.loads(text) for text in (tmp_path / "records").read_text().splitlines()]
    assert len(records) > 20
    assert set(records[0]) == {"magnetometer"}


@pytest.mark.parametrize("ppm", [0.0, 50.0, -80.0])
def test_stamps_follow_the_rate_of_the_counter(ppm: float) -> None:
    """The lateness of the first is made up slowly; the rate is found within 200 s, to 5 ppm."""
    rng, clock = np.random.default_rng(3), HostClock(1.0 / 48_000)
    counts = 2400.0 * np.arange(1.0, 12001.0)
    true = counts / 48_000 * (1.0 + 1e-6 * ppm)
    late = np.abs(rng.normal(0.0, 3e-3, len(true)))
    stamps = np.concatenate(
        [clock.stamps(np.array([c]), t) for c, t in zip(counts, true + late, strict=True)]
    )
    off = stamps - true
    assert np.ptp(off) < late[0] + 200.0 * 1e-6 * abs(ppm)
    assert np.abs(np.polyfit(true[8000:], off[8000:], 1)[0]) < late[0] / SETTLING + 5e-6


@pytest.mark.parametrize("place", ["udp:0", "udp:x", "serial:", "tcp:1", "file"])
def test_a_place_that_is_none_is_refused(place: str) -> None:
    with pytest.raises(InputError, match=r"give serial:PORT, serial:PORT@BAUD or udp:PORT"):
        LineSource(place, {})


@pytest.mark.parametrize("given", ["gyro=1", "imu.gyro=x", "magnetometer=1,2"])
def test_counts_are_checked(given: str) -> None:
    with pytest.raises(InputError, match="write TABLE=UNIT"):
        scales_of((given,))
