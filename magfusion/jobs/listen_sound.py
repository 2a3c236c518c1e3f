"""Samples of a sound card: the bands of the beacons' tones as records."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from magfusion.errors import InputError
from magfusion.files.audio import channels_of, slip_remarks
from magfusion.files.stream_contents import baseband_content
from magfusion.model.bandpass import MIN_SPACING_HZ, BandFilter
from magfusion.model.response import NOMINAL_T_PER_V
from magfusion.model.site import Site
from magfusion.model.slip_sampler import SlipSampler
from magfusion.model.slips import Slip
from magfusion.receiver.host_clock import HostClock
from magfusion.units import Array

if TYPE_CHECKING:
    import queue


BLOCK = 6e-3  # s
WARM_UP = 2.0  # s; in which the buffers of a sound server fill, and blocks arrive unevenly
# Devices of PortAudio that are a sound server, which would remix and resample in silence.
SERVERS = ("pulse", "default")


class SoundSource:
    """A sound card whose channels are volts of a receiver.

    Raises InputError where the channels are not those of the site's receiver, or its tones are too
    close.

    Parameters
    ----------
    device : str
        Its name, or a part that only one has.
    channels : str
        Names of all its channels.
    full_scale_v : float
        Voltage of a sample of 1 (V).
    site : Site
        With the tones.

    Attributes
    ----------
    shift : float
        Time by its own clock, that of the log, less that of the host (s).
    """

    def __init__(
        self, device: str, rate_hz: int, channels: str, full_scale_v: float, site: Site
    ) -> None:
        self._device, self._rate_hz = device, rate_hz
        self._channels, self._count = channels_of(channels)
        self._scale = full_scale_v * NOMINAL_T_PER_V
        sensor = site.platform.magnetometer
        if not sensor.ac_coupled or "".join(sorted(self._channels)) != sensor.axes:
            raise InputError(
                f"--channels {channels}: the site's magnetometer should be ac_coupled and have"
                f" these axes (it has {sensor.axes}); describe the receiver by coil, or response"
            )
        band = BandFilter.of_site(site, rate_hz)
        if band is None:
            raise InputError(
                f"the tones of the site are not separable at {rate_hz} Hz: set them at least"
                f" {MIN_SPACING_HZ:g} Hz apart and below half of the rate"
            )
        self._band, self._sampler = band, SlipSampler(band, site)
        self._clock, self._received, self._overflows = HostClock(1.0 / rate_hz), 0, 0
        self._reported = 0  # slips
        self._begin: float | None = None
        self.shift = 0.0
        self._stream: Any = None

    def open(self, arrivals: queue.Queue[tuple[Any, Any, float]], begin: float) -> None:
        """Begin to record.

        Raises InputError where there is no such device, or it cannot record so.
        """
        try:
            import sounddevice
        except ImportError as error:
            raise InputError(
                "--device: sounddevice is not installed; pip install 'magfusion[audio]'"
            ) from error
        except OSError as error:
            raise InputError(
                f"--device: {error}; install PortAudio (Debian: apt install libportaudio2)"
            ) from error
        own = {"device": self._device, "channels": self._count, "samplerate": self._rate_hz}

        def arrived(block: Array, _frames: int, _time: object, status: Any) -> None:
            self._overflows += bool(status.input_overflow)
            arrivals.put((self, block.copy(), time.monotonic() - begin))

        try:
            self._check(sounddevice.query_devices(self._device, "input"))
            self._stream = sounddevice.InputStream(
                **own, dtype="float32", blocksize=int(BLOCK * self._rate_hz), callback=arrived
            )
            self._stream.start()
        except (ValueError, sounddevice.PortAudioError) as error:
            names = ", ".join(d["name"] for d in sounddevice.query_devices())
            reason = " ".join(str(error).split())
            raise InputError(
                f"--device {self._device}: cannot record {self._count} channels at"
                f" {self._rate_hz} Hz ({reason}); the devices are {names or 'none'}"
            ) from error

    def _check(self, device: dict[str, Any]) -> None:
        """Refuse a device of other channels and rate: it would remix and resample."""
        given, what = (device["max_input_channels"], self._rate_hz), device["name"]
        if what in SERVERS:
            given, what = served(what)
        if given != (self._count, self._rate_hz):
            raise InputError(
                f"--device {self._device}: {what} has {given[0]} channels at {given[1]} Hz, not"
                f" {self._count} at {self._rate_hz} Hz; name all its channels, - for those not used"
            )

    def records(self, content: Array, arrival: float) -> Iterator[dict[str, Any]]:
        """Yield the bands of a block of samples (n, channels)."""
        field = np.zeros((len(content), 3))
        for axis, channel in self._channels.items():
            field[:, "xyz".index(axis)] = content[:, channel]
        place, baseband = self._sampler.push(field * self._scale)
        self._received += len(content)
        if self._received < WARM_UP * self._rate_hz:
            return
        # The phases of the tones need an even clock, so that the others are brought to this one.
        newest = (self._received + self._sampler.missing) / self._rate_hz
        host = float(self._clock.stamps(np.array([newest * self._rate_hz]), arrival)[0])
        self._begin = host - newest if self._begin is None else self._begin
        self.shift = self._begin + newest - host
        stamps = self._begin + place / self._rate_hz
        if len(stamps):
            turn = np.exp(-2j * np.pi * stamps[:, None] * self._band.tones_hz)
            yield baseband_content(stamps, baseband * turn[..., None], self._band.tones_hz)

    @property
    def slips(self) -> list[Slip]:
        """Lost samples, as far as they are found."""
        return self._sampler.slips

    def remarks(self) -> Iterator[str]:
        """Report the slips that were found since the last call."""
        first, self._reported = self._reported, len(self.slips)
        for sentence in slip_remarks(self.slips, 0, self._rate_hz, first):
            yield f"{self._device}: {sentence}"

    def close(self) -> Iterator[str]:
        """End the recording, and report blocks that were lost."""
        if self._stream is not None:
            self._stream.close()
        yield from self.remarks()
        for sentence in slip_remarks((), self._sampler.unexplained, self._rate_hz):
            yield f"{self._device}: {sentence}"
        if self._overflows > len(self.slips):
            yield (
                f"{self._device}: {self._overflows} times samples were lost, as the computer was"
                f" busy; {len(self.slips)} of them are corrected."
            )


def served(device: str) -> tuple[tuple[int, int], str]:
    """Return channels and rate (Hz) of the source that PulseAudio would record, and its name.

    Raises InputError where they are unknown.
    """
    try:
        source = _pactl("get-default-source").strip()
        rows = [line.split("\t") for line in _pactl("list", "short", "sources").splitlines()]
        form = next(row[3].split() for row in rows if row[1] == source)
        return (int(form[1].removesuffix("ch")), int(form[2].removesuffix("Hz"))), source
    except (OSError, subprocess.SubprocessError, StopIteration, IndexError, ValueError) as error:
        raise InputError(
            f"--device {device}: is a sound server that may remix and resample, and pactl does not"
            " report its source; give the card itself, e.g. hw:1"
        ) from error


def _pactl(*words: str) -> str:
    command = ["pactl", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5.0).stdout
