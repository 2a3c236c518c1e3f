"""Phasors of a rotating magnet by its angle instead of time, so that a speed drift does not smear.

The design of a window has the cosine and sine of each order of the angle, each with a ramp as the
magnet passes, a constant with a slope, and mains.  Noise is measured some turns per window away.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import FieldSamples, Waveform
from magfusion.model.site import Beacon, Site
from magfusion.units import AnyArray, Array

MIN_SAMPLES = 0.8  # of a whole window
MIN_TURNS = 4.0  # in a window
PROBE_TURNS = (3.0, 4.0, 5.0, 6.0)  # offset of the probes from a tone (turns in a window)
POOLED = 4  # windows on either side with which noise is averaged
MAINS = 3  # number of harmonics


@dataclass(frozen=True, eq=False)
class RotorPhasors:
    """Demodulated windows of a rotor."""

    fields: FieldSamples  # phasors about the angle; their channels are the rotor's tones
    speed_hz: Array  # (n,), mean of each window
    dropped: int  # windows that lack samples, or in which the magnet hardly rotates


def demodulate_rotor(
    waveform: Waveform,
    angle: Array,
    beacon: Beacon,
    site: Site,
    window: float,
    mains_hz: float = 50.0,
) -> RotorPhasors:
    """Return phasors of contiguous windows.

    `angle` (n,): shaft angle at each sample, unwrapped (rad); NaN where it is unknown. `window`
    (s).
    """
    time, step = waveform.time, float(np.median(np.diff(waveform.time)))
    edges = np.arange(time[0], time[-1] + step, window)
    orders = np.rint(beacon.tone_frequencies_hz / beacon.frequency_hz)
    calm = waveform.measured_sensor - site.platform.magnetometer.offset
    centres, speeds = list[float](), list[float]()
    parts: tuple[list[AnyArray], ...] = ([], [], [])
    for first in edges:
        rows = slice(*np.searchsorted(time, [first, first + window]))
        known = np.isfinite(angle[rows])
        if np.sum(known) < MIN_SAMPLES * window / step:
            continue
        own, rotated = time[rows][known], angle[rows][known]
        if np.max(np.diff(own)) > (1.0 - MIN_SAMPLES) * window:
            continue
        turns = abs(rotated[-1] - rotated[0]) / (2.0 * np.pi)
        if turns < MIN_TURNS or turns > 0.4 * len(own) / max(orders):
            continue
        result = _of_window(
            own - first - 0.5 * window, rotated, calm[rows][known], orders, mains_hz
        )
        centres.append(first + 0.5 * window)
        speeds.append(turns / (own[-1] - own[0]))
        for known_parts, part in zip(parts, result, strict=True):
            known_parts.append(part)
    n, tones = len(centres), len(orders)
    phasors, noises, units = (np.array(part) for part in parts)
    noise = noises.reshape(n, tones, 3, 3)
    least = site.platform.magnetometer.noise_density**2 / (2.0 * step)
    cov = units.reshape(n, tones)[..., None, None] * _pooled(noise, least)
    fields = FieldSamples(
        time=np.array(centres),
        window=np.full(n, window),
        channels=tuple((beacon.name, k) for k in range(tones)),
        phasor_sensor=phasors.reshape(n, tones, 3).astype(np.complex128),
        phasor_cov=cov,
    )
    whole = int(np.floor((time[-1] - time[0]) / window + 1e-6))
    return RotorPhasors(fields, np.array(speeds), max(whole - n, 0))


def _of_window(
    elapsed: Array, angle: Array, field: Array, orders: Array, mains_hz: float
) -> tuple[AnyArray, Array, Array]:
    """Return phasors (tones, 3), sample covariance (tones, 3, 3), unit variance (tones,)."""
    late = elapsed / np.max(np.abs(elapsed))
    waves = np.exp(1j * orders[:, None] * angle)
    nyquist_hz = 0.5 * (len(elapsed) - 1) / (elapsed[-1] - elapsed[0])
    hum = [k * mains_hz for k in range(1, MAINS + 1) if 0.0 < k * mains_hz < 0.9 * nyquist_hz]
    others = np.exp(2j * np.pi * np.array(hum)[:, None] * elapsed)
    parts = np.concatenate([waves, late * waves, others])
    design = np.concatenate([[np.ones_like(late), late], parts.real, -parts.imag]).T
    gram = np.linalg.inv(design.T @ design)
    fitted = gram @ (design.T @ field)
    count, n = len(parts), len(orders)
    real, imaginary = fitted[2 : 2 + n], fitted[2 + count : 2 + count + n]
    unit = np.diagonal(gram)
    residual = field - design @ fitted
    span = elapsed[-1] - elapsed[0]
    neighbours = np.array([sign * k for k in PROBE_TURNS for sign in (-1.0, 1.0)])
    noises = []
    for order in orders:
        probe = np.exp(-1j * (order * angle + 2.0 * np.pi * np.outer(neighbours, elapsed) / span))
        seen = probe @ residual  # (probes, 3)
        noises.append(np.real(seen.T @ seen.conj()) / (len(neighbours) * len(elapsed)))
    variance = 0.5 * (unit[2 : 2 + n] + unit[2 + count : 2 + count + n])
    return real + 1j * imaginary, np.array(noises), variance


def _pooled(noise: Array, least: float) -> Array:
    """Average the noise of windows with their neighbours', not below the declared."""
    out = np.empty_like(noise)
    for i in range(len(noise)):
        mean = np.mean(noise[max(i - POOLED, 0) : i + POOLED + 1], axis=0)
        value, vector = np.linalg.eigh(mean)
        value = np.maximum(value, least)
        out[i] = (vector * value[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return out
