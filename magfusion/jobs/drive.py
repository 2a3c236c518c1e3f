"""The job that writes a sound file to play for the beacons of a site."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, log10
from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.audio import write_audio
from magfusion.files.site import load_site
from magfusion.jobs.settings import Command, Settings, argument, option
from magfusion.model.drive_signal import DriveChannel, drive_channels, drive_samples
from magfusion.results.figures import Figure, Figures, Section, heading

SOUND = "beacons.wav"


@dataclass(frozen=True, kw_only=True)
class DriveSettings(Settings):
    """A site, and the sound card that plays for its beacons."""

    site: Path = argument("Site file")
    rate: int = option(48_000, "Sampling rate of the card", unit="Hz", least=8000, most=768_000)
    outputs: int | None = option(
        None, "Outputs of the card", least=1, most=1024, note="default: as many as needed"
    )
    level: float = option(
        -3.0,
        "Amplitude of the strongest coil's channel",
        unit="dB of full scale",
        least=-120,
        most=0.0,
    )
    duration: float = option(10.0, "Longest length of the file", unit="s", least=0.01, most=600.0)
    sync: bool = option(False, "Add a channel with a pulse at each whole second")


def run(settings: DriveSettings, output: Path) -> Figures:
    """Write a file that is played again and again without a step.

    Raises InputError where a sound card cannot play it, or ``output`` is in the way.
    """
    from magfusion.jobs.result_directory import claim
    from magfusion.results.report import write_report

    claimed = claim(output, "drive")
    site = load_site(settings.site, unknown=True, several=True)
    try:
        channels = drive_channels(site, settings.rate, 10.0 ** (settings.level / 20.0))
        needed = len(channels) + settings.sync
        if settings.outputs is not None and needed > settings.outputs:
            raise InputError(
                f"its coils{' and pulses' * settings.sync} need {needed} outputs, the card has"
                f" {settings.outputs}; drive coils in time slots by one amplifier, or take a card"
                " with more"
            )
        samples = drive_samples(channels, settings.rate, settings.duration, settings.sync)
    except InputError as error:
        raise InputError(f"{settings.site}: {error}") from error
    figures = heading("drive", settings.site.name) | Figures(
        Figure("rate_hz", settings.rate, "Hz"),
        Figure("duration_s", len(samples) / settings.rate, "s"),
        Figure("outputs", needed),
        Figure("channels", _lines(channels, settings.sync), section=Section.REMARKS),
    )
    with claimed as directory:
        write_audio(directory / SOUND, samples, settings.rate)
        write_report(directory, figures)
    return figures


def _lines(channels: Sequence[DriveChannel], pulses: bool) -> list[str]:
    """Return a line for each channel, counted from 1."""
    lines = [
        f"channel {number}: beacon {one.beacon}, coil {one.coil}, {one.frequency_hz:g} Hz,"
        f" {20.0 * log10(one.level):.1f} dB, {degrees(one.phase):.1f} deg"
        + ("" if one.slot is None else f", slot {one.slot}")
        for number, one in enumerate(channels, 1)
    ]
    return lines + [f"channel {len(channels) + 1}: pulses at whole seconds"] * pulses


COMMAND = Command(
    DriveSettings, run, output_required=True, example="magfusion drive site.yaml -o drive"
)
