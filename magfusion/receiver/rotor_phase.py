"""Estimation of the unmeasured angle of a rotating magnet from its field, through a whole log.

First the speed of each piece of some turns, by the most probable sequence within the declared speed
and its random walk (Viterbi).  Then, in a few passes, the residual phase against the polarisation
of the neighbouring pieces, smoothed under the same random walk.
"""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from magfusion.errors import InputError
from magfusion.model.rotor import Rotor
from magfusion.model.samples import Waveform
from magfusion.units import Array, ComplexArray

TURNS = 6.0  # in a piece
REACH = 3.0  # sigmas of the declared speed that are searched
PER_WIDTH = 8.0  # speeds per inverse length of a piece
BEYOND = np.array([3.0, 4.0, 5.0, 6.0])  # over a piece's length, beyond the search: noise alone
ABOUT = 4  # pieces on either side that share a polarisation
MAX_ITERATIONS = 6
MIN_SNR = 3.0  # of the median piece; below, the magnet is not detected
MAX_SPEEDS = 2000


def followed_angle(waveform: Waveform, frequency_hz: float, rotor: Rotor) -> Array:
    """Estimate the angle at each sample (rad), from an unknown zero.

    Raises InputError where the log is too short, or the magnet is not detected above the noise.
    """
    piece = TURNS / frequency_hz
    time, half = waveform.time, 0.5 * piece
    centres = np.arange(time[0] + half, time[-1] - half, half)
    if len(centres) < 2 * ABOUT:
        raise InputError(
            f"the log is shorter than {(ABOUT + 1) * piece:.3g} s, too short to track the"
            " unmeasured angle of a magnet; record longer, or its angle in a column"
        )
    field = waveform.measured_sensor - _slow(waveform, piece)
    low = max(frequency_hz - REACH * rotor.speed_sigma_hz, 2.0 / piece)
    high = frequency_hz + REACH * rotor.speed_sigma_hz
    count = min(int(np.ceil((high - low) * piece * PER_WIDTH)) + 1, MAX_SPEEDS)
    speeds = np.linspace(low, high, max(count, 3))
    power = _powers(time, field, centres, piece, speeds)
    noise = float(np.mean(_powers(time, field, centres, piece, high + BEYOND / piece)))
    most_probable = _course(power / noise, speeds, rotor.speed_walk_hz_rts * np.sqrt(half))
    snr = np.median(power[np.arange(len(centres)), most_probable] / noise)
    if snr < MIN_SNR**2:
        raise InputError(
            f"a magnet that rotates at {frequency_hz:g} Hz within {high - frequency_hz:.2g} is not"
            " detected above the noise; record its angle, or check its frequency_hz and"
            " speed_sigma_hz"
        )
    course = CubicSpline(centres, 2.0 * np.pi * speeds[most_probable])
    node = course.antiderivative()(centres)
    walk = (2.0 * np.pi * rotor.speed_walk_hz_rts) ** 2 * half**3
    for _ in range(MAX_ITERATIONS):
        spline = CubicSpline(centres, node)
        pieces, sigma = _pieces(time, field, centres, piece, _gone_on(spline, time))
        node = node + _smoothed(_residual_phase(pieces), sigma, node, walk)
    return _gone_on(CubicSpline(centres, node), time)


def _slow(waveform: Waveform, piece: float) -> Array:
    """Return the mean over a piece about each sample: the Earth's field."""
    from scipy.signal import fftconvolve  # takes as long as all else to import

    step = float(np.median(np.diff(waveform.time)))
    width = max(2 * int(0.5 * piece / step) + 1, 3)
    kernel = np.hanning(width + 2)[1:-1, None]
    ones = fftconvolve(np.ones((len(waveform), 1)), kernel, mode="same", axes=0)
    return np.asarray(fftconvolve(waveform.measured_sensor, kernel, "same", axes=0) / ones)


def _gone_on(spline: CubicSpline, time: Array) -> Array:
    """Evaluate a spline, extrapolated beyond its ends at constant speed."""
    first, last = spline.x[0], spline.x[-1]
    inside = np.clip(time, first, last)
    beyond = time - inside
    return np.asarray(spline(inside) + beyond * spline(inside, 1))


def _powers(time: Array, field: Array, centres: Array, piece: float, speeds: Array) -> Array:
    """Return the power of each piece at each speed (pieces, speeds)."""
    out = np.zeros((len(centres), len(speeds)))
    for i, centre in enumerate(centres):
        rows = slice(*np.searchsorted(time, [centre - 0.5 * piece, centre + 0.5 * piece]))
        if rows.stop - rows.start < 8:
            continue
        elapsed = time[rows] - centre
        taper = np.hanning(len(elapsed) + 2)[1:-1]
        waves = np.exp(-2j * np.pi * np.outer(speeds, elapsed)) * taper
        seen = waves @ field[rows] / np.sqrt(np.sum(taper**2))
        out[i] = np.sum(np.abs(seen) ** 2, axis=1)
    return out


def _course(likelihood: Array, speeds: Array, walk: float) -> Array:
    """Return the index of the most probable speed of each piece."""
    step = -0.5 * ((speeds[:, None] - speeds) / max(walk, 0.5 * (speeds[1] - speeds[0]))) ** 2
    best, back = likelihood[0], []
    for own in likelihood[1:]:
        through = best[:, None] + step
        back.append(np.argmax(through, axis=0))
        best = np.max(through, axis=0) + own
    course = [int(np.argmax(best))]
    for came in reversed(back):
        course.append(int(came[course[-1]]))
    return np.array(course[::-1])


def _pieces(
    time: Array, field: Array, centres: Array, piece: float, angle: Array
) -> tuple[ComplexArray, Array]:
    """Return the phasor of each piece about an angle (pieces, 3), and the sigma of its phase."""
    out, sigma = np.zeros((len(centres), 3), dtype=np.complex128), np.full(len(centres), 1e3)
    for i, centre in enumerate(centres):
        rows = slice(*np.searchsorted(time, [centre - 0.5 * piece, centre + 0.5 * piece]))
        if rows.stop - rows.start < 8:
            continue
        taper = np.hanning(rows.stop - rows.start + 2)[1:-1]
        wave = taper * np.exp(-1j * angle[rows])
        out[i] = 2.0 * (wave @ field[rows]) / np.sum(taper)
        residual = field[rows] - np.real(out[i] * np.exp(1j * angle[rows])[:, None])
        noise = np.sum(residual**2) / residual.size * 2.0 * np.sum(taper**2) / np.sum(taper) ** 2
        sigma[i] = np.sqrt(noise) / max(float(np.linalg.norm(out[i])), 1e-300)
    return out, np.maximum(sigma, 1e-4)


def _residual_phase(pieces: ComplexArray) -> Array:
    """Return the phase of each piece against the polarisation of its neighbours (rad)."""
    n = len(pieces)
    out = np.zeros(n)
    for i in range(n):
        near = pieces[max(i - ABOUT, 0) : i + ABOUT + 1]
        # The principal polarisation, independent of each phase.
        _, _, right = np.linalg.svd(near, full_matrices=False)
        out[i] = np.angle(np.vdot(right[0], pieces[i]))
        if i:  # the polarisation's own phase is arbitrary: continue it from piece to piece
            before = np.angle(np.vdot(right[0], pieces[i - 1]))
            step = np.angle(np.exp(1j * (out[i] - before)))
            out[i] = out[i - 1] + step
    return out


def _smoothed(residual: Array, sigma: Array, known: Array, walk: float) -> Array:
    """Smooth the residual phase so that the speed is a random walk."""
    n = len(residual)
    weight = 1.0 / sigma**2
    bend = np.array([1.0, -2.0, 1.0])
    banded, right = np.zeros((3, n)), weight * residual
    banded[2] += weight
    for k in range(3):
        for m in range(k, 3):
            banded[2 - (m - k), m : n - 2 + m] += bend[k] * bend[m] / walk
    curve = known[:-2] - 2.0 * known[1:-1] + known[2:]
    for k in range(3):
        right[k : n - 2 + k] -= bend[k] * curve / walk
    return np.asarray(solveh_banded(banded, right))
