"""What a sound card plays for the coils of a site: tones that repeat without a step.

A file that is repeated has whole periods of all its tones, of the cycles of its time slots and of
its sampling, so its length is a multiple of their least common multiple.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import gcd, lcm

import numpy as np

from magfusion.errors import InputError
from magfusion.model.site import Beacon, MarkedSlots, Site, Slots
from magfusion.units import Array

LOWEST_HZ = 10.0  # below, the coupling of a sound card's output attenuates and shifts a tone
HIGHEST_SHARE = 0.45  # of the sampling rate, for the filter of the converter
PULSE = 0.01  # s; of each whole second, short for outputs without a steady voltage


@dataclass(frozen=True)
class DriveChannel:
    """Signal of one coil, ``level cos(2 pi f t + phase)`` in its time slot."""

    beacon: str
    coil: int  # of the beacon, counted from 0
    frequency_hz: float
    phase: float  # (rad)
    level: float  # amplitude relative to full scale
    slots: Slots | None = None  # schedule of the coil if it is driven in turn
    slot: int | None = None  # its slot

    def samples(self, time: Array) -> Array:
        """Return the signal at times (s), shape (n,)."""
        signal = self.level * np.cos(2.0 * np.pi * self.frequency_hz * time + self.phase)
        if self.slots is None or self.slot is None:
            return np.asarray(signal)
        return np.where(self.slots.running(time) % self.slots.count == self.slot, signal, 0.0)


def drive_channels(site: Site, rate_hz: float, level: float) -> tuple[DriveChannel, ...]:
    """Return a channel for each coil of a site, in its order.

    `level`: amplitude of the strongest relative to full scale. Others are lower in proportion to
    their currents if all are declared, else to their moments: as of equal coils. Raises InputError
    where a sound card cannot play what drives a coil.
    """
    for beacon in site.beacons:
        _check(beacon, rate_hz)
    coils = [coil for beacon in site.beacons for coil in beacon.coils]
    if not coils:
        raise InputError("the site has no beacons; give one with at least one")
    sizes = [coil.current for coil in coils]
    if None in sizes:
        sizes = [float(np.linalg.norm(coil.moment_beacon)) for coil in coils]
    share = np.array(sizes, dtype=np.float64) / np.max(np.array(sizes, dtype=np.float64))
    owners = [(beacon, k) for beacon in site.beacons for k in range(len(beacon.coils))]
    return tuple(
        DriveChannel(
            beacon.name,
            k,
            coil.frequency_hz or beacon.frequency_hz,
            coil.phase,
            level * float(part),
            beacon.slots if isinstance(beacon.slots, Slots) else None,
            coil.slot,
        )
        for (beacon, k), coil, part in zip(owners, coils, share, strict=True)
    )


def _check(beacon: Beacon, rate_hz: float) -> None:
    place = f"beacon {beacon.name}"
    if beacon.rotor is not None:
        raise InputError(f"{place}: a magnet on a shaft has no drive; leave it out of the site")
    if isinstance(beacon.slots, MarkedSlots):
        raise InputError(
            f"{place}: bursts that a host marks follow no clock; give slots: {{duration_s, count}}"
        )
    lowest, highest = float(np.min(beacon.tone_frequencies_hz)), HIGHEST_SHARE * rate_hz
    if lowest < LOWEST_HZ:
        what = "direct current" if lowest == 0.0 else f"a tone of {lowest:g} Hz"
        raise InputError(
            f"{place}: a sound card does not play {what}; choose {LOWEST_HZ:g} Hz or more"
        )
    if np.max(beacon.tone_frequencies_hz) > highest:
        raise InputError(
            f"{place}: a tone of {np.max(beacon.tone_frequencies_hz):g} Hz is above {highest:g} Hz,"
            f" which is what a sound card plays at {rate_hz:g} Hz; raise --rate, or lower the tone"
        )


def common_period(channels: tuple[DriveChannel, ...], rate_hz: int, pulses: bool) -> Fraction:
    """Return the time after which all channels, and pulses at whole seconds, repeat (s)."""
    periods = [Fraction(1, rate_hz), *[Fraction(1)] * pulses]
    for channel in channels:
        periods.append(1 / Fraction(repr(channel.frequency_hz)))
        if channel.slots is not None:
            periods.append(Fraction(repr(channel.slots.duration)) * channel.slots.count)
    return reduce(_least_common_multiple, periods)


def _least_common_multiple(one: Fraction, other: Fraction) -> Fraction:
    return Fraction(lcm(one.numerator, other.numerator), gcd(one.denominator, other.denominator))


def drive_samples(
    channels: tuple[DriveChannel, ...], rate_hz: int, duration: float, pulses: bool
) -> Array:
    """Return what a file has that repeats without a step, shape (n, channels) or one column more.

    `duration`: longest length (s); the length is the largest multiple of the common period within
    it. `pulses`: whether a last column has a pulse that rises at each whole second. Raises
    InputError where the channels do not repeat within the duration.
    """
    period = common_period(channels, rate_hz, pulses)
    if period > duration:
        raise InputError(
            f"the tones and slots repeat together only after {float(period):.6g} s; choose"
            " frequencies that are multiples of 1 Hz, or a longer --duration"
        )
    count = int(period * rate_hz) * int(Fraction(repr(duration)) // period)
    time = np.arange(count) / rate_hz
    columns = [channel.samples(time) for channel in channels]
    if pulses:
        level = max(channel.level for channel in channels)
        columns.append(np.where(np.arange(count) % rate_hz < PULSE * rate_hz, level, 0.0))
    return np.column_stack(columns)
