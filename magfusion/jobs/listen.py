"""The job that prints the samples of sound cards, serial lines and UDP as records of a pipe."""

from __future__ import annotations

import queue
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from magfusion.errors import InputError
from magfusion.files.site import load_site
from magfusion.files.standard_streams import binary_output, until_closed, write_message
from magfusion.files.stream_contents import write_record
from magfusion.jobs.listen_lines import LineSource, scales_of
from magfusion.jobs.listen_sound import SoundSource
from magfusion.jobs.settings import Command, Settings, option

POLL = 0.1  # s; within which the process answers a signal


class Source(Protocol):
    """Samples of an instrument as they arrive."""

    def open(self, arrivals: queue.Queue[tuple[Source, Any, float]], begin: float) -> None:
        """Begin to put what arrives into a queue: source, content, and time since begin (s)."""

    def records(self, content: Any, arrival: float) -> Iterator[dict[str, Any]]:
        """Yield what arrived as records."""

    def close(self) -> Iterator[str]:
        """End, and yield sentences on what was lost."""


@dataclass(frozen=True, kw_only=True)
class ListenSettings(Settings):
    """Instruments, and the format of the records."""

    sources: tuple[str, ...] = option((), "Ports: serial:PORT[@BAUD], udp:PORT", positional=True)
    device: str | None = option(
        None, "Sound card, by its name or a part of it", note="magfusion[audio]", metavar="NAME"
    )
    rate: int | None = option(None, "Sampling rate of the sound card, Hz", least=1, most=10_000_000)
    channels: str | None = option(
        None, "Its channels in their order: x, y, z, or - for others", metavar="NAME,..."
    )
    full_scale: float = option(1.0, "Voltage of its full-scale sample, V", least=1e-9, most=1e6)
    site: Path | None = option(None, "Site file, for the tones of the beacons")
    counts: tuple[str, ...] = option(
        (),
        "Unit of a count of serial and UDP records, and the counts at zero",
        note="of imu.gyro (rad/s), imu.accel (m/s^2), magnetometer (T)",
        metavar="TABLE=UNIT[,X,Y,Z]",
    )
    encoding: Literal["lines", "frames"] = option(
        "lines", "Serial and UDP records: lines of text, or binary frames"
    )
    duration: float | None = option(None, "Time after which to end, s", least=0.0, most=1e9)
    form: Literal["json", "msgpack"] = option("json", "Records in the pipe", name="format")

    def instruments(self) -> list[Source]:
        """Return what is to be listened to."""
        scales = scales_of(self.counts)
        result: list[Source] = [LineSource(one, scales, self.encoding) for one in self.sources]
        if self.device is not None:
            if self.rate is None or self.channels is None or self.site is None:
                raise InputError("--device: give its --rate and --channels, and the --site")
            site = load_site(self.site)
            sound = SoundSource(self.device, self.rate, self.channels, self.full_scale, site)
            result.append(sound)
        if not result:
            raise InputError("nothing to listen to; give --device, serial:PORT or udp:PORT")
        return result


def run(settings: ListenSettings) -> None:
    """Print what arrives as records; times are seconds since the beginning.

    They are by the clock of the sound card, if there is one, else by that of the host.
    """
    sink, messages, instruments = binary_output(), sys.stderr, settings.instruments()
    arrivals: queue.Queue[tuple[Source, Any, float]] = queue.Queue()
    begin = time.monotonic()
    end = begin + (float("inf") if settings.duration is None else settings.duration)

    def report(sentences: Iterable[str]) -> None:
        for sentence in sentences:
            write_message(messages, sentence)

    with until_closed(), ExitStack() as stack:
        for instrument in instruments:
            instrument.open(arrivals, begin)
            stack.callback(lambda one: report(one.close()), instrument)
        while time.monotonic() < end:
            try:
                source, content, arrival = arrivals.get(timeout=POLL)
            except queue.Empty:
                continue
            if isinstance(content, InputError):
                raise content
            if not isinstance(source, SoundSource):
                arrival += sum(s.shift for s in instruments if isinstance(s, SoundSource))
            for record in source.records(content, arrival):
                write_record(record, sink, settings.form)
            report(source.remarks() if isinstance(source, SoundSource) else ())
            if arrivals.empty():
                sink.flush()


COMMAND = Command(
    ListenSettings,
    run,
    reports=False,
    example="magfusion listen udp:9000 --counts imu.gyro=1.33e-4 --counts imu.accel=5.98e-4"
    " --counts magnetometer=7.5e-8 | magfusion navigate - --site site.yaml",
)
