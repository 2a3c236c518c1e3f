"""Samples of microcontrollers: records with counters and a checksum, from a serial port or UDP.

A line is ``imu,COUNT,MICROS,gx,gy,gz,ax,ay,az*HH`` or ``mag,COUNT,MICROS,bx,by,bz*HH``: a counter
of its samples of at least 16 bits, one of microseconds of 32, both of which may wrap, the counts of
the sensor, and the exclusive or of all bytes before the asterisk, in hexadecimal.  The same as
binary frames: `magfusion.jobs.listen_frames`.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from magfusion.errors import InputError
from magfusion.jobs.listen_frames import Parsed, check_package, parse_frame
from magfusion.receiver.host_clock import HostClock
from magfusion.units import Array

if TYPE_CHECKING:
    import queue


KINDS = {  # columns by the first word of a line: record, key, number of values
    "imu": ("imu", (("gyro", 3), ("accel", 3))),
    "mag": ("magnetometer", (("field", 3),)),
}
TABLES = ("imu.gyro", "imu.accel", "magnetometer")
COUNTER, MICROSECONDS = 1 << 16, 1 << 32
MAX_LINE = 1 << 10  # bytes
POLL = 0.1  # s
RESTARTED = 8  # late samples one after the other: the counters began again
BAUD = 115_200


def scales_of(options: tuple[str, ...]) -> dict[str, tuple[float, Array]]:
    """Return unit of a count, and counts at zero (3,), of each table that is given."""
    result = {}
    for line in options:
        table, _, text = line.partition("=")
        try:
            unit, *zero = (float(part) for part in text.split(","))
        except ValueError:
            unit, zero = np.nan, []
        if table not in TABLES or not np.isfinite([unit, *zero]).all() or len(zero) not in (0, 3):
            raise InputError(
                f"--counts {line!r}: write TABLE=UNIT, or TABLE=UNIT,X,Y,Z with the counts at zero,"
                f" with a table of {', '.join(TABLES)}"
            )
        result[table] = (unit, np.array(zero or [0.0] * 3))
    return result


def parse_line(line: bytes) -> Parsed:
    """Return kind, both counters and values of a line.

    Raises ValueError where it is garbled.
    """
    text, _, check = line.strip().partition(b"*")
    if int(check, 16) != reduce(xor, text, 0) or len(check) != 2:
        raise ValueError("the checksum differs")
    name, count, micros, *values = text.decode("ascii").split(",")
    return name, int(count), int(micros), np.array([float(value) for value in values])


class _Counted:
    """Counters of one kind of record."""

    def __init__(self) -> None:
        self.count: int | None = None
        self.late = 0  # one after the other
        self.micros = 0
        self.elapsed = 0  # microseconds, unwrapped
        self.clock = HostClock(1e-6)


class LineSource:
    """A serial port or UDP socket with records.

    Raises InputError where the place is none. `place`: ``serial:PORT[@BAUD]`` or ``udp:PORT``.
    `scales`: as of `scales_of`. Attribute `faults`: records by kind and fault: lost, doubled, late,
    garbled, restarted.
    """

    def __init__(
        self,
        place: str,
        scales: Mapping[str, tuple[float, Array]],
        encoding: Literal["lines", "frames"] = "lines",
    ) -> None:
        self.place, self._scales = place, scales
        lines = encoding == "lines"
        self._end = b"\n" if lines else b"\0"
        self._parse: Callable[[bytes], Parsed] = parse_line if lines else parse_frame
        if not lines:
            check_package(place)
        way, _, self._port = place.partition(":")
        number = self._port.isdecimal() and 0 < int(self._port) < 1 << 16
        if not self._port or way not in ("serial", "udp") or (way == "udp" and not number):
            raise InputError(f"{place!r}: give serial:PORT, serial:PORT@BAUD or udp:PORT")
        self._is_udp, self._ended = way == "udp", threading.Event()
        self._kinds: dict[str, _Counted] = {}
        self._rest, self._begun = b"", False
        self.faults: Counter[tuple[str, str]] = Counter()
        self._thread: threading.Thread | None = None

    def open(self, arrivals: queue.Queue[tuple[Any, Any, float]], begin: float) -> None:
        """Begin to read.

        Raises InputError where the port cannot be opened.
        """
        read, close = self._socket() if self._is_udp else self._serial()

        def run() -> None:
            try:
                while not self._ended.is_set():
                    if content := read():
                        arrivals.put((self, content, time.monotonic() - begin))
            except OSError as error:
                reason = InputError(f"{self.place}: cannot be read any more ({error}); connect it")
                arrivals.put((self, reason, 0.0))
            finally:
                close()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def _socket(self) -> tuple[Callable[[], bytes], Callable[[], None]]:
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            own.bind(("", int(self._port)))
        except OSError as error:
            own.close()
            raise InputError(f"{self.place}: {error.strerror}; choose another port") from error
        own.settimeout(POLL)

        def read() -> bytes:
            try:
                return own.recv(1 << 16).rstrip(self._end) + self._end
            except TimeoutError:
                return b""

        return read, own.close

    def _serial(self) -> tuple[Callable[[], bytes], Callable[[], None]]:
        try:
            import serial
        except ImportError as error:
            raise InputError(
                f"{self.place}: pyserial is not installed; pip install 'magfusion[serial]'"
            ) from error
        name, _, baud = self._port.partition("@")
        try:
            own = serial.Serial(name, int(baud or BAUD), timeout=POLL)
        except (serial.SerialException, ValueError) as error:
            raise InputError(
                f"{self.place}: cannot be opened ({error}); give port and baud rate, e.g."
                f" serial:/dev/ttyUSB0@{BAUD}"
            ) from error
        return lambda: own.read(max(own.in_waiting, 1)), own.close

    def records(self, content: bytes, arrival: float) -> Iterator[dict[str, Any]]:
        """Yield the samples of what arrived."""
        lines = (self._rest + content).split(self._end)
        self._rest = lines.pop()
        if not self._is_udp and not self._begun and lines:
            del lines[0]  # its beginning was before the port was opened
            self._begun = True
        if len(self._rest) > MAX_LINE:
            self._rest = b""
            self.faults["", "garbled"] += 1
        for line in lines:
            if line.strip():
                yield from self._sample(line, arrival)

    def _sample(self, line: bytes, arrival: float) -> Iterator[dict[str, Any]]:
        try:
            name, count, micros, numbers = self._parse(line)
            record, columns = KINDS[name]
            if len(numbers) != sum(size for _, size in columns) or not np.isfinite(numbers).all():
                raise ValueError
        except (ValueError, KeyError):
            self.faults["", "garbled"] += 1
            return
        stamp = self._stamp(name, count, micros, arrival)
        if stamp is None:
            return
        parts, at = {"time": [stamp]}, 0
        for key, size in columns:
            table = record if record == "magnetometer" else f"{record}.{key}"
            unit, zero = self._scales.get(table, (1.0, np.zeros(size)))
            parts[key] = [((numbers[at : at + size] - zero) * unit).tolist()]
            at += size
        yield {record: parts}

    def _stamp(self, name: str, count: int, micros: int, arrival: float) -> float | None:
        """Return the time of a sample (s); None for one that was there, or comes late."""
        known = self._kinds.setdefault(name, _Counted())
        if known.count is not None:
            ahead = (count - known.count) % COUNTER
            is_late = ahead >= COUNTER // 2
            known.late = known.late + 1 if is_late else 0
            if ahead == 0 or (is_late and known.late < RESTARTED):
                self.faults[name, "late" if ahead else "doubled"] += 1
                return None
            if is_late:  # the host's clock goes on
                self.faults[name, "restarted"] += 1
                known = self._kinds[name] = _Counted()
            else:
                self.faults[name, "lost"] += ahead - 1
                known.elapsed += (micros - known.micros) % MICROSECONDS
        known.count, known.micros = count, micros
        return float(known.clock.stamps(np.array([float(known.elapsed)]), arrival)[0])

    def close(self) -> Iterator[str]:
        """End, and report the records that are missing."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        for (name, fault), count in sorted((+self.faults).items()):
            yield f"{self.place}: {count} {name or 'records'} {fault}."
