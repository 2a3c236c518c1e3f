"""Demodulation of the drive currents recorded with the field, the reference of its phasors.

Windows lie on the log's clock, independent of how the samples are pushed.  They have the length of
the lock-in's windows or the time slots.  In a slot, field and current are averaged in the same way.
In a long window the current changes, and the phasor is that at the centre: the field is predicted
sample by sample.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.model.drive import MIN_CURRENT_SHARE, DriveSamples, DriveShares
from magfusion.model.site import Beacon, MarkedSlots, Site
from magfusion.receiver.slots import has_schedule, schedule
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.units import Array, ComplexArray

MIN_SAMPLES = 0.9  # of a whole window
A_STEP = 4  # windows that begin within a step of the lock-in: shares are linear in between
EDGE = 0.05  # of a slot, at each end: there the current rises and falls
LEARNT = 0.02  # weight of a window in the noise estimate
SILENT = 0.2  # of the current; a larger noise makes the reading invalid


class Channel(NamedTuple):
    """A tone in a current's column.

    `declared`: phasor of the current for which the moment is declared (A).
    """

    column: str
    beacon: str
    tone: int
    frequency_hz: float
    slot: int | None
    declared: complex


def drive_channels(site: Site, columns: Mapping[str, object]) -> tuple[Channel, ...]:
    """Return the tones whose currents are recorded in columns.

    Raises InputError where a column names no beacon, a coil has no current declared, or the
    beginning of the time slots is not known.
    """
    names = {beacon.name for beacon in site.beacons}
    for column in columns:
        if column and column not in names:
            raise InputError(
                f"drive_{column}: the site has no beacon {column}; name one of"
                f" {', '.join(sorted(names))}, or write drive for one current through all"
            )
    result = []
    for beacon in site.beacons:
        column = beacon.name if beacon.name in columns else ""
        if column in columns:
            result += list(_of_beacon(beacon, column))
    return tuple(result)


def _of_beacon(beacon: Beacon, column: str) -> Iterator[Channel]:
    if isinstance(beacon.slots, MarkedSlots):
        raise InputError(
            f"beacon {beacon.name}: its current is recorded, but marked bursts are not referred"
            " to a current; leave the drive column out"
        )
    if beacon.slots is not None and not beacon.synchronised:
        raise InputError(
            f"beacon {beacon.name}: its current is recorded, but the start of its slots is unknown;"
            " write synchronised: true with slots.start_s, or leave the drive column out"
        )
    for k, (frequency_hz, slot) in enumerate(beacon.tones):
        coil = next(
            c
            for c in beacon.coils
            if (c.frequency_hz or beacon.frequency_hz, c.slot) == (frequency_hz, slot)
        )
        if coil.current is None:
            raise InputError(
                f"beacon {beacon.name}: its current is recorded, but the current for its declared"
                " moments is missing; give current_a of its coils, or a winding"
            )
        declared = coil.current * np.exp(1j * coil.phase)
        yield Channel(column, beacon.name, k, frequency_hz, slot, complex(declared))


class DriveReceiver:
    """Windows of currents, demodulated as they become complete.

    `shares`: drive shares to which windows are added.
    """

    # What a checkpoint holds.
    time: Array
    values: Array
    columns: tuple[str, ...]
    next_number: int | None
    step: float
    noise: dict[str, float]

    def __init__(
        self, site: Site, shares: DriveShares, settings: LockinSettings | None = None
    ) -> None:
        self._site, self.shares, self._given = site, shares, settings
        self.time, self.values, self.columns = np.zeros(0), np.zeros((0, 0)), ()
        self.next_number, self.step, self.noise = None, 0.0, {}

    def push(self, samples: DriveSamples) -> None:
        """Add samples after the earlier ones; the columns must not change."""
        columns = tuple(samples.current)
        if not self.columns:
            drive_channels(self._site, samples.current)
            self.columns, self.values = columns, np.zeros((0, len(columns)))
        if columns != self.columns:
            raise InputError(
                "magnetometer: the columns of recorded currents differ between records; give"
                f" those of {', '.join(f'drive_{c}' if c else 'drive' for c in self.columns)}"
                " in each"
            )
        rows = np.stack(list(samples.current.values()), axis=1)
        newest = self.time[-1] if len(self.time) else -np.inf
        kept = (samples.time > newest) & np.all(np.isfinite(rows), axis=1)
        self.time = np.append(self.time, samples.time[kept])
        self.values = np.concatenate([self.values, rows[kept]])
        self._demodulate()

    def _demodulate(self) -> None:
        """Demodulate the windows that have become complete, and discard their samples."""
        if len(self.time) < 2:
            return
        if not self.step:
            self.step = float(np.median(np.diff(self.time)))
        hop, length, begin = self._grid()
        if self.next_number is None:
            self.next_number = int(np.ceil((self.time[0] - begin) / hop - 1e-6))
        result: dict[Channel, list[tuple[float, complex]]] = {}
        channels = drive_channels(self._site, dict.fromkeys(self.columns))
        while begin + self.next_number * hop + length <= self.time[-1] + 0.6 * self.step:
            first = begin + self.next_number * hop
            for channel, share in self._window(channels, first, length):
                result.setdefault(channel, []).append((first + 0.5 * length, share))
            self.next_number += 1
        for channel, readings in result.items():
            time, shares = np.array([t for t, _ in readings]), np.array([s for _, s in readings])
            self.shares.add_readings(channel.beacon, channel.tone, time, shares)
        kept = self.time > begin + self.next_number * hop - self.step
        self.time, self.values = self.time[kept], self.values[kept]

    def _grid(self) -> tuple[float, float, float]:
        """Return hop and length of windows, and where window 0 begins (s)."""
        if has_schedule(self._site):
            slots = schedule(self._site)
            return slots.duration, slots.duration, slots.start
        settings = default_settings(self._site) if self._given is None else self._given
        return settings.step / A_STEP, settings.window, 0.0

    def _window(
        self, channels: tuple[Channel, ...], first: float, length: float
    ) -> Iterator[tuple[Channel, complex]]:
        if has_schedule(self._site):
            assert self.next_number is not None
            slot = self.next_number % schedule(self._site).count
            channels = tuple(c for c in channels if c.slot == slot)
            first, length = first + EDGE * length, (1.0 - 2.0 * EDGE) * length
        rows = slice(*np.searchsorted(self.time, [first, first + length]))
        if rows.stop - rows.start < MIN_SAMPLES * length / self.step - 1.0:
            return
        elapsed = self.time[rows] - (first + 0.5 * length)
        for k, column in enumerate(self.columns):
            own = tuple(c for c in channels if c.column == column)
            if own:
                bends = 0 if has_schedule(self._site) else 2
                result = _currents(elapsed, self.values[rows, k], own, bends)
                yield from self._shares(own, *result, first + 0.5 * length)

    def _shares(
        self, channels: tuple[Channel, ...], current: ComplexArray, sigma: float, centre: float
    ) -> Iterator[tuple[Channel, complex]]:
        for channel, value in zip(channels, current, strict=True):
            size = abs(value) / abs(channel.declared)
            if size < MIN_CURRENT_SHARE:
                yield channel, 0.0  # off: no phase
                continue
            noise = sigma / abs(value)
            if noise > SILENT:
                continue
            key = DriveShares.key(channel.beacon, channel.tone)
            known = self.noise.get(key, float(noise))
            self.noise[key] = known + LEARNT * (float(noise) - known)
            turn = np.exp(-2j * np.pi * channel.frequency_hz * centre)
            yield channel, complex(value * turn / channel.declared)


def _currents(
    elapsed: Array, values: Array, channels: tuple[Channel, ...], bends: int
) -> tuple[ComplexArray, float]:
    """Return the phasors of tones at a window's centre (A), and the noise of one component.

    `bends`: power of time up to which phasors change within the window.
    """
    direct = all(channel.frequency_hz == 0.0 for channel in channels)
    ones = np.ones_like(elapsed)
    angle = 2.0 * np.pi * np.outer([c.frequency_hz for c in channels], elapsed)
    waves = (
        np.zeros((0, len(elapsed))) if direct else np.concatenate([np.cos(angle), np.sin(angle)])
    )
    late = elapsed / np.max(np.abs(elapsed))
    design = np.concatenate([ones[None], *(late**k * waves for k in range(bends + 1))]).T
    inverse = np.linalg.pinv(design)
    fitted = inverse @ values
    spread = len(values) - design.shape[1]
    residual = np.sqrt(np.sum((values - design @ fitted) ** 2) / max(spread, 1))
    n, noise = len(channels), residual * np.linalg.norm(inverse[: len(waves) + 1], axis=1)
    if direct:
        return np.full(n, fitted[0], dtype=complex), float(noise[0])
    return fitted[1 : 1 + n] - 1j * fitted[1 + n : 1 + 2 * n], float(np.max(noise[1:]))
