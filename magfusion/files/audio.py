"""Recordings of a sound card as the magnetometer of a log: the log refers to the file."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magfusion.errors import InputError
from magfusion.files.table import MAX_TIME_NS, Span
from magfusion.files.yaml_files import StrictModel
from magfusion.model.bandpass import BandFilter, BandSampler
from magfusion.model.response import NOMINAL_T_PER_V
from magfusion.model.samples import Waveform
from magfusion.model.site import Site
from magfusion.model.slip_sampler import SlipSampler, can_slip
from magfusion.model.slips import Slip
from magfusion.model.trust import Finding, Verdict
from magfusion.units import NANOSECOND, Array

if TYPE_CHECKING:
    from soundfile import SoundFile

AXES: tuple[Literal["x", "y", "z"], ...] = ("x", "y", "z")
SYNC = "sync"
SUFFIXES = (".wav", ".flac", ".w64", ".caf", ".aiff")
PIECE = 1 << 14  # samples of every channel; 0.4 MB of three
MAX_LISTED = 8  # slips in a sentence
MIN_PULSES = 3
RATE_TOLERANCE = 1e-7  # of rounding
EDGE_TOLERANCE = 1e-3  # s; of a pulse about the even clock: a GNSS receiver has 1e-7
Count = Annotated[int, Field(ge=1)]
Channel = Annotated[int, Field(ge=0, le=1023)]


class AudioEntry(StrictModel):
    """Key ``audio`` of ``log.yaml``."""

    file: str  # path, from the log's directory if relative
    # channel of each axis of the receiver, counted from 0
    channels: dict[Literal["x", "y", "z"], Channel] = Field(min_length=1)
    full_scale_v: float = Field(gt=0.0, le=1e6)  # voltage of a sample of 1 (V)
    rate_hz: float = Field(ge=1.0, le=1e7)  # of the samples on the log's clock
    begin_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)  # stamp of the first sample
    # of each place where samples are lost: number of the first sample after it, and of the lost
    slips: list[Annotated[list[Count], Field(min_length=2, max_length=2)]] = Field(
        default_factory=list
    )

    def parts(self, frames: int) -> Iterator[tuple[int, int, int]]:
        """Yield begin and end of each part without a slip, and the samples lost before it."""
        begin = missing = 0
        for place, count in self.slips:
            yield begin, place, missing
            begin, missing = place, missing + count
        yield begin, frames, missing


@contextmanager
def open_audio(path: Path) -> Iterator["SoundFile"]:
    """Open a recording.

    Raises InputError where the package that reads it is missing, or the file is no recording.
    """
    soundfile = _soundfile(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such recording; restore it, or import it again")
    try:
        with soundfile.SoundFile(path) as recording:
            yield recording
    except soundfile.LibsndfileError as error:
        reason = str(error).rpartition(": ")[2].rstrip(".")
        raise InputError(
            f"{path}: is no readable recording ({reason}); give WAV or FLAC"
        ) from error


def write_audio(path: Path, samples: Array, rate_hz: int) -> None:
    """Write samples (n, channels) from -1 to 1 as 24 bit.

    Raises InputError where the package that writes it is missing.
    """
    soundfile = _soundfile(path)
    soundfile.write(path, samples, rate_hz, subtype="PCM_24")


def as_recording(
    waveform: Waveform, name: str, full_scale_v: float, epoch_ns: int
) -> tuple[AudioEntry, Array]:
    """Return the entry of a receiver's recording, and its samples as a sound card has them.

    Raises InputError where they exceed full scale, or their rate is no whole number.
    """
    volts = waveform.measured_sensor / NOMINAL_T_PER_V
    highest = float(np.max(np.abs(volts), initial=0.0))
    if highest >= full_scale_v:
        raise InputError(
            f"the receiver's voltage reaches {highest:.3g} V, beyond the full scale of"
            f" {full_scale_v:g} V; set a larger one, or a lower amplifier_gain in the site"
        )
    measured_hz = (len(waveform) - 1) / float(waveform.time[-1] - waveform.time[0])
    rate_hz = round(measured_hz)
    if abs(measured_hz - rate_hz) > RATE_TOLERANCE * rate_hz:
        raise InputError(
            f"a sound card has a whole number of samples a second, not {measured_hz:.9g}; give one"
        )
    used = [k for k, axis in enumerate(AXES) if axis in waveform.axes]
    entry = AudioEntry(
        file=name,
        channels={AXES[k]: number for number, k in enumerate(used)},
        full_scale_v=full_scale_v,
        rate_hz=float(rate_hz),
        begin_ns=epoch_ns + round(float(waveform.time[0]) / NANOSECOND),
    )
    return entry, volts[:, used] / full_scale_v


def _soundfile(path: Path) -> Any:
    try:
        import soundfile
    except (ImportError, OSError) as error:  # the latter without the library of libsndfile
        raise InputError(
            f"{path}: soundfile is not installed; pip install 'magfusion[audio]'"
        ) from error
    return soundfile


def read_audio(
    directory: Path, entry: AudioEntry, span: Span, site: Site | None = None
) -> Waveform | None:
    """Return the samples of a recording within a span; None where there is none.

    Volts are read as `magfusion.model.response.NOMINAL_T_PER_V`. `site`: only the bands of its
    tones are kept, where they are far enough apart.
    """
    path, begin = directory / entry.file, (entry.begin_ns - span.epoch_ns) * NANOSECOND
    band = None if site is None else BandFilter.of_site(site, entry.rate_hz)
    places, parts = [np.zeros(0)], [np.zeros((0, 3))]
    with open_audio(path) as recording:
        limits = (
            begin if span.start is None else span.start,
            np.inf if span.end is None else span.end,
        )
        for lowest, highest, missing in entry.parts(recording.frames):
            first, last = (
                int(
                    np.clip(np.ceil((at - begin) * entry.rate_hz - missing - 1e-6), lowest, highest)
                )
                for at in limits
            )
            sampler = None if band is None else BandSampler(band)
            for at, field in _blocks(path, recording, entry, first, last):
                if sampler is None:
                    place = np.arange(float(at), float(at + len(field)))
                else:
                    place, tones = sampler.push(field)
                    place, field = first + place, np.sum(tones.real, axis=1)
                places.append(place + missing)
                parts.append(field)
    time = begin + np.concatenate(places) / entry.rate_hz
    if not len(time):
        return None
    axes = "".join(axis for axis in AXES if axis in entry.channels)
    return Waveform(time, np.concatenate(parts), axes=axes, ac_coupled=True)


def _blocks(
    path: Path, recording: "SoundFile", entry: AudioEntry, first: int, last: int
) -> Iterator[tuple[int, Array]]:
    """Yield parts of a recording: number of the first sample, and fields (n, 3) (T)."""
    highest = max(entry.channels.values())
    if highest >= recording.channels:
        raise InputError(
            f"{path}: has {recording.channels} channels, not a channel {highest}; import it again"
        )
    recording.seek(first)
    for block in recording.blocks(PIECE, frames=max(last - first, 0), always_2d=True):
        field = np.zeros((len(block), 3))
        for axis, channel in entry.channels.items():
            field[:, AXES.index(axis)] = block[:, channel]
        yield first, field * (entry.full_scale_v * NOMINAL_T_PER_V)
        first += len(block)


def lost_finding(entry: AudioEntry | None) -> tuple[Finding, ...]:
    """Return where samples of a recording are lost, if any are."""
    if entry is None or not entry.slips:
        return ()
    text = f"audio: {slip_text(entry.slips, entry.rate_hz)}. The stamps after them are corrected."
    return (Finding("samples_lost", text, Verdict.TRUSTWORTHY),)


def slip_text(slips: Sequence[Sequence[int]], rate_hz: float, first: int = 0) -> str:
    """Return lengths, times (s after the first sample) and places of slips from one on as words."""
    before_each = np.cumsum([0, *(count for _, count in slips)])
    words = [
        f"{count} samples ({1e3 * count / rate_hz:.4g} ms) are lost at"
        f" {(place + before) / rate_hz:.3f} s (sample {place})"
        for (place, count), before in zip(slips, before_each[:-1].tolist(), strict=True)
    ][first:]
    return ", ".join(words[:MAX_LISTED]) + f", and at {len(words) - MAX_LISTED} more places" * (
        len(words) > MAX_LISTED
    )


def _slips(path: Path, recording: "SoundFile", entry: AudioEntry, site: Site) -> SlipSampler | None:
    """Find lost samples by the phases of a site's tones; None where these do not allow it."""
    band = BandFilter.of_site(site, entry.rate_hz) if can_slip(site) else None
    if band is None:
        return None
    sampler = SlipSampler(band, site)
    for _, field in _blocks(path, recording, entry, 0, recording.frames):
        sampler.push(field)
    sampler.finish()
    return sampler


def describe_recording(
    path: Path, names: str, full_scale_v: float, begin_ns: int, site: Site | None = None
) -> tuple[AudioEntry, tuple[str, ...]]:
    """Return the entry of a recording for the header of a log, and remarks on lost samples.

    `names`: of its channels, in their order: x, y, z, sync (pulses at whole seconds, by which the
    rate of the samples is measured), or - for one that is not used. `site`: by whose tones lost
    samples are found.
    """
    named, count = channels_of(names)
    with open_audio(path) as recording:
        if count != recording.channels:
            raise InputError(
                f"--channels {names!r}: {path} has {recording.channels} channels; name each of them"
            )
        entry = AudioEntry(
            file=str(path.resolve()),
            channels={axis: named[axis] for axis in AXES if axis in named},
            full_scale_v=full_scale_v,
            rate_hz=float(recording.samplerate),
            begin_ns=begin_ns,
        )
        search = None if site is None else _slips(path, recording, entry, site)
        slips = () if search is None else tuple(search.slips)
        if SYNC in named:
            edges = _edges(recording, named[SYNC])
            slips = tuple(_by_pulses(slip, edges, entry.rate_hz) for slip in slips)
        entry = entry.model_copy(update={"slips": [[s.place, s.missing] for s in slips]})
        if SYNC in named:
            rate_hz = _rate_by_pulses(path, entry, edges, named[SYNC])
            entry = entry.model_copy(update={"rate_hz": rate_hz})
    return entry, () if search is None else slip_remarks(
        slips, search.unexplained, float(recording.samplerate)
    )


def slip_remarks(
    slips: Sequence[Slip], unexplained: int, rate_hz: float, first: int = 0
) -> tuple[str, ...]:
    """Return sentences on slips from one on, on ambiguous ones, and on steps that are none."""
    result = []
    if slips[first:]:
        places = [[s.place, s.missing] for s in slips]
        result.append(f"{slip_text(places, rate_hz, first)}.")
    result += [
        f"The slip after sample {slip.place} is ambiguous: {slip.missing} or"
        f" {' or '.join(map(str, slip.others))} samples explain the phases of the tones."
        for slip in slips[first:]
        if slip.others
    ]
    if unexplained:
        result.append(
            f"The tones step {unexplained} times in a way that no number of lost samples explains:"
            " a beacon that is switched, a loose contact, or several losses within 0.4 s."
        )
    return tuple(result)


def _by_pulses(slip: Slip, edges: Array, rate_hz: float) -> Slip:
    """Decide among the lengths of a slip by pulses at whole seconds, if they are there."""
    at = int(np.searchsorted(edges, slip.place))
    if not 0 < at < len(edges):
        return slip
    interval = edges[at] - edges[at - 1]
    missing = np.array([slip.missing, *slip.others])
    off = np.abs((interval + missing + 0.5 * rate_hz) % rate_hz - 0.5 * rate_hz)
    best = int(np.argmin(off))
    return Slip(slip.place, int(missing[best])) if off[best] < EDGE_TOLERANCE * rate_hz else slip


def channels_of(names: str) -> tuple[dict[str, int], int]:
    """Return the channels that are used by their names, and the number of all.

    Raises InputError where a name is unknown or given twice, or no axis is named.
    """
    listed = [name.strip() for name in names.split(",")]
    used = {name: k for k, name in enumerate(listed) if name != "-"}
    twice = len(used) < len(listed) - listed.count("-")
    if not set(used) <= {*AXES, SYNC} or twice or not set(used) & set(AXES):
        raise InputError(
            f"--channels {names!r}: name each channel x, y, z, sync, or - where it is not used;"
            " each once, and at least one axis"
        )
    return used, len(listed)


def _edges(recording: "SoundFile", channel: int) -> Array:
    """Return the rising edges of pulses, as numbers of samples."""
    recording.seek(0)
    level = max(np.max(b[:, channel]) for b in recording.blocks(PIECE, always_2d=True))
    recording.seek(0)
    rising, at, before = [], 0, np.inf
    for block in recording.blocks(PIECE, always_2d=True):
        pulse = np.concatenate([[before], block[:, channel]])
        edge = np.flatnonzero((pulse[:-1] < 0.5 * level) & (pulse[1:] >= 0.5 * level))
        # Between two samples, where the edge crosses half of the height.
        rising.append(at + edge - (pulse[edge + 1] - 0.5 * level) / (pulse[edge + 1] - pulse[edge]))
        at, before = at + len(block), pulse[-1]
    return np.concatenate(rising)


def _rate_by_pulses(path: Path, entry: AudioEntry, edges: Array, channel: int) -> float:
    """Return the samples per second (Hz) from rising edges at whole seconds."""
    for place, missing in entry.slips[::-1]:
        edges = edges + missing * (edges >= place)
    second = np.round((edges - edges[:1]) / entry.rate_hz)
    if len(edges) >= MIN_PULSES and np.ptp(second) > 0:
        rate_hz, first = np.polyfit(second, edges, 1)
        if np.max(np.abs(edges - first - rate_hz * second)) < EDGE_TOLERANCE * rate_hz:
            return float(rate_hz)
    raise InputError(
        f"{path}: channel {channel} (sync) has {len(edges)} edges that are not a second apart;"
        " give pulses at whole seconds, or - for this channel; where samples are lost, --site"
    )
