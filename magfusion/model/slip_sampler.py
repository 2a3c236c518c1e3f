"""Bands of a recording over samples that are lost, block by block."""

from collections.abc import Iterator

import numpy as np

from magfusion.model.bandpass import BandFilter, BandSampler
from magfusion.model.site import Site
from magfusion.model.slips import (
    INDEPENDENT,
    LIKELIHOOD_RATIO,
    MIN_SNR,
    NEAR,
    POOR,
    SIDE,
    Slip,
    choose_length,
    locate_slip,
    log_likelihoods,
)
from magfusion.units import Array, ComplexArray

LAG = 4e-3  # s; between the amplitudes from which the next is extrapolated
JUMP = 0.01  # part of an amplitude; motion of 20 rad/s is 0.05 % off in its extrapolation
NOISE_FACTOR = 36.0  # six sigma, squared
MEMORY = 0.5  # s; of the noise of the extrapolation
MIN_AMPLITUDES = 5  # amplitudes on each side
MARGIN = 8  # samples; by which a slip may be elsewhere
EXTRAPOLATION = 20.0  # variance of 3 a - 3 b + c - d

# Place in the recording, analytic signal, and the amplitude that is referred to the place.
Kept = tuple[Array, ComplexArray, ComplexArray]


def can_slip(site: Site) -> bool:
    """Return whether slips are found by a site's tones: all are transmitted all the time."""
    return all(slot is None for beacon in site.beacons for _, slot in beacon.tones)


class SlipSampler:
    """Reduces a recording, as `BandSampler`, to samples numbered on the true clock.

    Samples are withheld from a step of the tones' amplitudes on, until those after it determine
    what it is. `slips`: as far as they are found. `unexplained`: steps of the tones' phases that no
    number of lost samples explains.
    """

    def __init__(self, band: BandFilter, site: Site) -> None:
        self._band, self._watched = band, can_slip(site)
        self._sampler, self._begin = BandSampler(band), 0  # and the number of its first sample
        self.slips: list[Slip] = []
        self.unexplained = 0
        self._raw, self._raw_begin = np.zeros((0, 0)), 0
        self._kept: Kept = _empty(band, 0)
        self._returned = self._checked = 0  # of those kept
        self._noise: Array | None = None  # variance of the extrapolation, of each tone
        self._step: int | None = None  # place of the first amplitude about a step
        self._quiet = 0

    @property
    def missing(self) -> int:
        """Number of all samples lost so far."""
        return sum(slip.missing for slip in self.slips)

    def push(self, block: Array) -> tuple[Array, ComplexArray]:
        """Return numbers on the true clock and analytic signals, as `BandSampler.push`."""
        self._raw = np.concatenate([self._raw, block]) if len(self._raw) else block
        self._reduce(block)
        return _joined(self._band, block.shape[1], list(self._advance(last=False)))

    def finish(self) -> tuple[Array, ComplexArray]:
        """Return samples that are still withheld at the end of the recording."""
        return _joined(self._band, self._raw.shape[1], list(self._advance(last=True)))

    def _reduce(self, block: Array) -> None:
        place, tones = self._sampler.push(block)
        place += self._begin
        band = self._band
        turn = np.exp(-2j * np.pi * place[:, None] * band.tones_hz / band.rate_hz)
        own = place, tones, tones * turn[..., None]
        self._kept = own if not len(self._kept[0]) else _appended(self._kept, own)

    def _advance(self, *, last: bool) -> Iterator[tuple[Array, ComplexArray]]:
        """Yield what is sure to be before a step, or after one that is understood."""
        side = round(SIDE * self._band.rate_hz)
        while True:
            if self._step is None and self._watched:
                self._step = self._find_step()
            if self._step is None:
                yield self._release(np.inf)
                break
            yield self._release(self._step)
            newest = self._kept[0][-1]
            if newest < self._step + 2 * self._band.middle + (side if not last else side // 3):
                break
            yield self._resolve(self._step, side)
            self._step = None
        self._trim(side)

    def _release(self, before: float) -> tuple[Array, ComplexArray]:
        end = int(np.searchsorted(self._kept[0], before))
        rows = slice(self._returned, max(end, self._returned))
        self._returned = rows.stop
        return self._kept[0][rows] + self.missing, self._kept[1][rows]

    def _find_step(self) -> int | None:
        """Return the place of the first amplitude that those before do not predict."""
        band = self._band
        lag = max(round(LAG * band.rate_hz / band.decimation), 1)
        first, end = max(self._checked, 3 * lag), len(self._kept[0])
        self._checked = end
        if first >= end:
            return None
        z = [self._kept[2][first - k * lag : end - k * lag] for k in range(4)]
        off = _power(z[0] - 3.0 * z[1] + 3.0 * z[2] - z[3])
        if self._noise is None:
            self._noise = np.median(off, axis=0) / np.log(2.0)
        limit = JUMP**2 * _power(z[1]) + NOISE_FACTOR * self._noise
        place = self._kept[0][first:end]
        wrong = np.flatnonzero(np.any(off > limit, axis=1) & (place >= self._quiet))
        calm = off[: wrong[0]] if len(wrong) else off
        if len(calm):
            part = min(len(calm) * band.decimation / (MEMORY * band.rate_hz), 1.0)
            self._noise = self._noise + part * (np.mean(calm, axis=0) - self._noise)
        return int(place[wrong[0]]) if len(wrong) else None

    def _resolve(self, step: int, side: int) -> tuple[Array, ComplexArray]:
        """Return samples before a step if it is a slip, and begin again after it."""
        band, noise = self._band, self._noise
        assert noise is not None
        middle = band.middle
        columns = self._raw.shape[1]
        sigma = np.sqrt(noise / (2.0 * EXTRAPOLATION))
        first = step - self._raw_begin
        near = self._raw[first : first + middle + 1]
        slip = self._slip(step - middle // 4, step + 2 * middle, side, sigma, (step, near))
        if slip is not None and slip.missing:
            # With what the filter did not mix, which is known by now.
            begin, end = slip.place - middle - MARGIN, slip.place + middle + MARGIN
            slip = self._slip(begin, end, side, sigma, (step, near)) or slip
        if slip is None or not slip.missing:
            self.unexplained += slip is None
            self._quiet = step + 2 * middle + side
            self._checked = int(np.searchsorted(self._kept[0], self._quiet))
            return _nothing(band, columns)
        released = self._release(slip.place - middle - MARGIN + 1)
        self.slips.append(slip)
        self._begin = slip.place + MARGIN
        self._raw, self._raw_begin = self._raw[self._begin - self._raw_begin :], self._begin
        self._sampler, self._kept = BandSampler(band), _empty(band, columns)
        self._returned = self._checked = 0
        self._reduce(self._raw)
        return released

    def _slip(
        self, begin: int, end: int, side: int, sigma: Array, near: tuple[int, Array]
    ) -> Slip | None:
        """Return the slip between two places, with none lost if it is no slip; None if unclear."""
        place, band = self._kept[0], self._band
        every = max(int(INDEPENDENT * band.rate_hz / band.decimation), 1)
        before = np.flatnonzero((place > begin - side) & (place <= begin))[::-every][::-1]
        after = np.flatnonzero((place >= end) & (place < end + side))[::every]
        if min(len(before), len(after)) < MIN_AMPLITUDES:
            return None
        z = self._kept[2][before], self._kept[2][after]
        detected = [np.mean(np.abs(part) ** 2, axis=(0, 2)) > (MIN_SNR * sigma) ** 2 for part in z]
        tones = detected[0] & detected[1]
        if not np.any(tones):
            return None
        hz, one, other = band.tones_hz[tones], z[0][:, tones], z[1][:, tones]
        likelihoods = log_likelihoods(
            (place[before], one), (place[after], other), sigma[tones], hz, band.rate_hz
        )
        missing, others = choose_length(likelihoods)
        turn = np.exp(-2j * np.pi * hz[:, None] * missing / band.rate_hz)
        true = np.r_[place[before], place[after] + missing]
        amplitude = np.concatenate([one, other * turn])
        at, poor = locate_slip(near[1], near[0], missing, true, amplitude, hz, band.rate_hz)
        if missing <= NEAR or likelihoods[missing] < likelihoods[0] + LIKELIHOOD_RATIO:
            return Slip(at, 0)
        return None if poor > POOR else Slip(at, missing, others)

    def _trim(self, side: int) -> None:
        """Discard what no step that comes can need."""
        band, place = self._band, self._kept[0]
        if not len(place):
            return
        oldest = int(place[-1]) if self._step is None else self._step
        if oldest - place[0] < 2 * (side + band.middle) and self._watched:
            return  # seldom is cheaper
        first = int(np.searchsorted(place, oldest - side - band.middle))
        first = min(first, self._returned)
        place, tones, amplitude = self._kept
        self._kept = place[first:], tones[first:], amplitude[first:]
        self._returned, self._checked = self._returned - first, max(self._checked - first, 0)
        self._raw, self._raw_begin = self._raw[oldest - self._raw_begin :], oldest


def _power(amplitude: ComplexArray) -> Array:
    """Return the mean square of the axes' amplitudes (n, tones, axes), shape (n, tones)."""
    square = amplitude.real**2 + amplitude.imag**2
    return np.asarray(np.sum(square, axis=2)) / amplitude.shape[2]


def _nothing(band: BandFilter, columns: int) -> tuple[Array, ComplexArray]:
    return np.zeros(0), np.zeros((0, len(band.tones_hz), columns), dtype=np.complex128)


def _empty(band: BandFilter, columns: int) -> Kept:
    place, tones = _nothing(band, columns)
    return place, tones, tones


def _appended(kept: Kept, own: Kept) -> Kept:
    place, tones, amplitude = (np.concatenate(pair) for pair in zip(kept, own, strict=True))
    return place, tones, amplitude


def _joined(
    band: BandFilter, columns: int, parts: list[tuple[Array, ComplexArray]]
) -> tuple[Array, ComplexArray]:
    parts = [_nothing(band, columns), *(part for part in parts if len(part[0]))]
    return np.concatenate([p for p, _ in parts]), np.concatenate([z for _, z in parts])
