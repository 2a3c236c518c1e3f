"""Lines of a microcontroller by a serial port and UDP, and the clock of what arrives late."""

import json
import os
import pty
import queue
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

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


def sent() -> list[bytes]:
    """Return lines of which some are lost, doubled or garbled."""
    result = []
    for number in range(LINES):
        own = line(number)
        if number in GARBLED:
            own = own.replace(b"-20", b"-2\xff")
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
        f"{source.place}: {count} {name or 'lines'} {fault}."
        for (name, fault), count in FAULTS.items()
    )
    return result


def paced(write: Callable[[list[bytes]], object]) -> threading.Thread:
    """Return a thread that writes the lines at their rate, a few at once."""

    def run() -> None:
        lines, begin = sent(), time.monotonic()
        for k in range(0, len(lines), 8):
            time.sleep(max(begin + k / RATE_HZ - time.monotonic(), 0.0))
            write(lines[k : k + 8])

    return threading.Thread(target=run)


def test_lines_by_udp() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    source = LineSource(f"udp:{port}", scales_of(("magnetometer=1e-8,100,0,0",)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def write(lines: list[bytes]) -> None:
            for one in lines:
                sender.sendto(one, ("127.0.0.1", port))

        records = listened(source, paced(write))
    check_stamps(np.array([r["magnetometer"]["time"][0] for r in records]))
    assert records[150]["magnetometer"]["field"] == [pytest.approx([1.5e-6, -2e-7, 4e-5])]


def test_lines_by_a_serial_port() -> None:
    """The first line is lost: where it began is unknown."""
    pytest.importorskip("serial")
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    source = LineSource(f"serial:{os.ttyname(theirs)}", {})

    def write(lines: list[bytes]) -> None:
        begins = lines[0] == line(0)
        text = b"20,4000*77\n" * begins + b"".join(lines)
        os.write(ours, text[:37])  # a line in two parts
        os.write(ours, text[37:])

    records = listened(source, paced(write))
    check_stamps(np.array([r["magnetometer"]["time"][0] for r in records]))
    os.close(ours)
    os.close(theirs)


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
