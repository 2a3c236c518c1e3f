"""Tones of undeclared beacons in a recording.

The frequency of a tone follows from the phase rate of ``P . P``, the sum of the squares of a
phasor's components: it is invariant to rotation of the sensor, and its phase is twice the drive's
where the field oscillates along a line.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.data_checks.spectrum import (
    HARMONICS,
    MIN_SEPARATION,
    SpectralLine,
    Spectrum,
    aliased,
    is_sideband,
    lines,
    mains_of,
    spectrum,
    still_field,
)
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.receiver.ellipse import semi_axes
from magfusion.receiver.host_clock import CRYSTAL
from magfusion.units import Array, ComplexArray

MIN_RELATIVE_STRENGTH = 3e-3  # of the strongest line; a weaker one is not considered a beacon
DISTORTION = 0.3  # of a tone, below which its multiple is a harmonic
MAX_WINDOW, MIN_WINDOW = 1.0, 0.25  # s, of a window
CYCLES_APART = 4.0  # periods of the beat with the nearest line in a window
# Two equal coils in quadrature draw an ellipse with axes from 1:1 to 1:2, a single one a line.
ROTATING = 0.25  # ratio of the axes, above which there are two coils
ROUND = (1.0, 0.5, 0.1, 0.01)  # Hz; a nominal frequency is a multiple of one of these


@dataclass(frozen=True)
class Tone:
    """A tone that is probably a beacon's."""

    # frequency_hz, sigma_hz: measured value and its sigma
    frequency_hz: float
    sigma_hz: float
    amplitude: float  # (T)
    # median axis ratio of the field's ellipse: 0 for a single coil, 0.5 to 1 for two in quadrature
    roundness: float

    @property
    def rotating(self) -> bool:
        """Whether two coils in quadrature drive it."""
        return self.roundness > ROTATING

    @property
    def meant_hz(self) -> float:
        """The probable round nominal frequency, or the measured one to a tenth of its sigma."""
        near = 3.0 * self.sigma_hz + CRYSTAL * self.frequency_hz
        for unit in ROUND:
            meant = round(self.frequency_hz / unit) * unit
            if abs(meant - self.frequency_hz) < min(near, 0.2 * unit):
                return round(meant, 2)
        return round(self.frequency_hz, 5)


@dataclass(frozen=True)
class Transmitted:
    """Lines of a recording: beacons, and others."""

    tones: tuple[Tone, ...]
    others: tuple[str, ...]


def transmitted(log: Log, site: Site | None) -> Transmitted | None:
    """Return the tones of a waveform; None if it is too short for a spectrum.

    `site`: only for the magnetometer's mounting; its beacons are ignored.
    """
    result = spectrum(log, site)
    if result is None or log.waveform is None:
        return None
    selected: list[SpectralLine] = []
    others: list[str] = []
    for line in lines(result):
        mains = mains_of(line.frequency_hz, result.rate_hz)
        if mains is not None:
            others.append(f"{line.frequency_hz:.2f} Hz is mains of {mains[0]:g} Hz")
        elif (
            selected and line.amplitude < MIN_RELATIVE_STRENGTH * selected[0].amplitude
        ) or is_sideband(result, line, [one.frequency_hz for one in selected]):
            continue
        elif (base := _distorted(line, selected, result)) is not None:
            others.append(f"{line.frequency_hz:.2f} Hz is a multiple of {base:.2f} Hz")
        else:
            selected.append(line)
    field = still_field(log, site)
    every = np.array([line.frequency_hz for line in lines(result)])
    tones = [_tone(line, every, log.waveform.time, field) for line in selected]
    tones.sort(key=lambda tone: tone.frequency_hz)
    return Transmitted(tuple(tones), tuple(others))


def _distorted(line: SpectralLine, selected: list[SpectralLine], result: Spectrum) -> float | None:
    """Return the tone of which a line is a harmonic."""
    for one in selected:
        for order in range(2, HARMONICS + 1):
            off = line.frequency_hz - aliased(order * one.frequency_hz, result.rate_hz)
            near = abs(off) < MIN_SEPARATION * result.resolution_hz
            if near and line.amplitude < DISTORTION * one.amplitude:
                return one.frequency_hz
    return None


def _tone(line: SpectralLine, every: Array, time: Array, field: Array) -> Tone:
    separate = np.abs(every[every != line.frequency_hz] - line.frequency_hz)
    nearest = float(np.min(separate, initial=line.frequency_hz))
    window = float(np.clip(CYCLES_APART / nearest, MIN_WINDOW, MAX_WINDOW))
    frequency, sigma = line.frequency_hz, 1.0 / float(time[-1] - time[0])
    for _ in range(2):
        centre, phasor = _phasors(time, field, frequency, window)
        step, sigma = _turning(centre, phasor)
        frequency += step
    axes = semi_axes(phasor)
    strong = axes[:, 1] >= np.median(axes[:, 1])
    roundness = float(np.median(axes[strong, 0] / axes[strong, 1]))
    return Tone(frequency, sigma, line.amplitude, roundness)


def _phasors(
    time: Array, field: Array, frequency_hz: float, window: float
) -> tuple[Array, ComplexArray]:
    """Return centres (n,) and phasors (n, 3) of Hann windows with half overlap."""
    length = max(8, round(window / float(np.median(np.diff(time)))))
    first = np.arange(0, len(time) - length + 1, max(1, length // 2))
    whole = time[first + length - 1] - time[first] < 1.5 * window  # without gap
    rows = first[whole, None] + np.arange(length)
    weight = np.hanning(length + 2)[1:-1]
    piece = field[rows]
    piece = piece - np.mean(piece, axis=1, keepdims=True)
    turn = np.exp(-2j * np.pi * frequency_hz * time[rows]) * weight
    phasor = 2.0 / np.sum(weight) * np.einsum("nk,nkc->nc", turn, piece)
    return np.mean(time[rows], axis=1), phasor


def _turning(centre: Array, phasor: ComplexArray) -> tuple[float, float]:
    """Return the frequency error and its sigma (Hz)."""
    square = np.sum(phasor**2, axis=1)
    pair = square[1:] * np.conj(square[:-1])
    # A coarse step by the mean rotation between neighbours, a fine one over the full length.
    step = np.diff(centre)
    usual = float(np.median(step))
    even = np.abs(step - usual) < 0.1 * usual
    coarse = float(np.angle(np.sum(pair[even])) / usual)
    phase = np.unwrap(np.angle(square * np.exp(-1j * coarse * centre)))
    weight = np.abs(square)
    mean = float(np.average(centre, weights=weight))
    away = centre - mean
    spread = float(np.sum(weight * away**2))
    fine = float(np.sum(weight * away * phase)) / spread
    residual = phase - float(np.average(phase, weights=weight)) - fine * away
    # The residual varies slowly with the motion: ten consecutive windows count as one.
    sigma = float(np.sqrt(10.0 * np.sum((weight * away * residual) ** 2)) / spread)
    return (coarse + fine) / (4.0 * np.pi), sigma / (4.0 * np.pi)
