"""Lock-in design and the linear maps from samples to phasors, from sample times alone.

They depend on neither samples nor motion, so they are computed once per log and cached.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from magfusion.receiver.admission import Windows
from magfusion.receiver.even_samples import Spacing, spacings_of
from magfusion.receiver.noise import probes_left
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, IntArray

CHUNK = 64  # windows demodulated at once, so that their arrays fit the CPU cache
MAX_BYTES = 2**28  # bytes of the maps of one chunk; many tones in long windows shrink the chunk
KEPT = 256 * 2**20  # bytes of cached maps; others are recomputed
EVEN_KEPT = 64  # maps of evenly spaced samples
MIN_SHARED_WINDOWS = 4  # windows for each of their spacings
GAP = 1.5  # times the shortest step of a window; a longer one misses samples
WORST_CONDITION = 1e8  # of a normal matrix; beyond, its columns are not separable


class Maps(NamedTuple):
    """The maps of n windows, padded to m samples each."""

    sample: IntArray  # (n, m), number of each sample
    weight: BoolArray  # (n, m), False where a row is padding
    elapsed: Array  # (n, m), sample times from the centre of the window (s)
    solver: Array  # (n, 1 + 2 tones, m), to the constant, the cosines and the sines
    variance: Array  # (n, 1 + 2 tones), of these, for samples with a variance of one
    # (n, tones, 4, m), to the residuals of probes next to each tone, scaled to unit variance
    probes: Array
    dimensions: IntArray  # (n, tones), number of independent probe directions of each tone


@dataclass(frozen=True, eq=False)
class Designs:
    """The designs of windows."""

    settings: LockinSettings
    # frequencies_hz, nuisance_hz: tones, and lines that are fitted with them (Hz)
    frequencies_hz: Array
    nuisance_hz: Array
    time: Array  # (samples,) (s)
    windows: Windows
    # maps of single windows by the spacing of their evenly spaced samples: few spacings recur
    even: dict[Spacing, Maps] = field(default_factory=dict)
    kept: dict[int, Maps] = field(default_factory=dict)
    requested: set[int] = field(default_factory=set)

    def pieces(self) -> Iterator[tuple[slice, Maps]]:
        """Yield windows with their maps, as many at once as fit in memory.

        Those of many windows are cached on the second request: most logs are demodulated
        once.
        """
        chunk = self._at_once()
        for begin in range(0, len(self.windows), chunk):
            rows = slice(begin, begin + chunk)
            maps = self.kept.get(begin)
            if maps is None:
                maps, own = self._maps(self.windows.rows(rows))
                few = len(self.windows) <= chunk
                worth = few or (own and begin in self.requested)
                if worth and self._size() + _size(maps) < KEPT:
                    self.kept[begin] = maps
            self.requested.add(begin)
            yield rows, maps

    def _at_once(self) -> int:
        """Return how many windows are demodulated at once."""
        maximum = int(self.windows.count.max(initial=1))
        columns = 6 * len(self.frequencies_hz) + 2
        return min(max(MAX_BYTES // (8 * maximum * columns), 1), CHUNK)

    def _size(self) -> int:
        return sum(map(_size, self.kept.values()))

    def design(self, elapsed: Array, weight: BoolArray) -> Array:
        """Return the columns for windows, shape (n, m, columns)."""
        result = design_of(elapsed, self.settings, self.frequencies_hz, self.nuisance_hz)
        result *= weight[..., None]
        return result

    def separated_design(self, elapsed: Array, weight: BoolArray) -> tuple[Array, Array]:
        """Return the columns fitted to windows, and their normal matrices; see `drop_lines`."""
        design = self.design(elapsed, weight)
        normal = np.swapaxes(design, -1, -2) @ design
        drop_lines(design, normal, elapsed, weight, len(self.frequencies_hz), len(self.nuisance_hz))
        return design, normal

    def _maps(self, windows: Windows) -> tuple[Maps, bool]:
        """Return the maps of some windows, and whether most were computed for them alone."""
        index, weight, elapsed = padded(windows, self.time)
        spacings = spacings_of(elapsed, windows.count, float(np.max(self.frequencies_hz)))
        if len(spacings) == 1 and spacings[0] in self.even:  # the usual case, one by one
            one = self.even[spacings[0]] = self.even.pop(spacings[0])
            return one._replace(sample=index), False
        distinct = dict.fromkeys(own for own in spacings if own is not None)
        known = self._known(distinct)
        new = [own for own in distinct if own not in known]
        uneven = [k for k, own in enumerate(spacings) if own is None]
        rows = [*map(spacings.index, new), *uneven]
        for k, own in zip(rows, new, strict=False):
            elapsed[k, : own.number] = own.times()
        parts: list[Maps] = []
        if rows:
            built = self._build(index[rows], weight[rows], elapsed[rows])
            if rows == list(range(len(windows))) and (uneven or len(windows) > 1):
                return built, True  # all differ, and none was cached
            known |= self._kept(built, new)
            parts = [_rows(built, slice(len(new), None), None)]
        parts = [*map(known.__getitem__, distinct), *parts]
        which = _places(spacings, list(distinct))
        return _chosen(index, weight, parts, which), MIN_SHARED_WINDOWS * len(rows) > len(windows)

    def _known(self, spacings: Iterable[Spacing]) -> dict[Spacing, Maps]:
        """Return the cached maps of spacings and mark them as most recently used."""
        known = {own: self.even.pop(own) for own in spacings if own in self.even}
        self.even.update(known)
        return known

    def _kept(self, simulation: Maps, spacings: Sequence[Spacing]) -> dict[Spacing, Maps]:
        """Cache the maps of spacings, one a row, and drop the least recently used."""
        new = {
            own: _rows(simulation, slice(k, k + 1), own.number) for k, own in enumerate(spacings)
        }
        self.even.update(new)
        while len(self.even) > EVEN_KEPT:
            del self.even[next(iter(self.even))]
        return new

    def _build(self, index: IntArray, weight: BoolArray, elapsed: Array) -> Maps:
        design, normal = self.separated_design(elapsed, weight)
        n, projected = len(self.frequencies_hz), np.swapaxes(design, -1, -2)
        inverse = np.asarray(np.linalg.inv(normal))
        dimensions = np.r_[0, 2 : 2 + 2 * n]
        extra_lines_hz = np.concatenate([self.nuisance_hz, self.settings.lines_hz])
        probes = probes_left(self.frequencies_hz, extra_lines_hz, elapsed, weight, design, inverse)
        return Maps(
            sample=index,
            weight=weight,
            elapsed=elapsed,
            solver=inverse[:, dimensions] @ projected,
            variance=np.einsum("nii->ni", inverse)[:, dimensions],
            probes=probes[0],
            dimensions=probes[1],
        )


def _size(maps: Maps) -> int:
    return sum(part.nbytes for part in maps)


def _rows(maps: Maps, rows: slice, count: int | None) -> Maps:
    """Return copies of the maps of some windows, of their own number of samples.

    A view would keep the maps of all of them in memory.
    """
    return Maps(
        sample=maps.sample[rows, :count].copy(),
        weight=maps.weight[rows, :count].copy(),
        elapsed=maps.elapsed[rows, :count].copy(),
        solver=maps.solver[rows, :, :count].copy(),
        variance=maps.variance[rows].copy(),
        probes=maps.probes[rows, ..., :count].copy(),
        dimensions=maps.dimensions[rows].copy(),
    )


def _places(spacings: Sequence[Spacing | None], distinct: Sequence[Spacing]) -> IntArray:
    """Return the index of each window's maps: of its spacing, or its own after all of these."""
    at: dict[Spacing | None, int] = {own: k for k, own in enumerate(distinct)}
    which = np.array([at.get(own, -1) for own in spacings])
    uneven = which < 0
    which[uneven] = len(at) + np.arange(np.sum(uneven))
    return which


def _chosen(index: IntArray, weight: BoolArray, parts: list[Maps], which: IntArray) -> Maps:
    """Return the maps of windows by their index among those of all parts, padded."""
    size, count = index.shape[1], len(index)
    elapsed, solver, probes = (
        np.concatenate([_longer(own, size) for own in each])
        for each in zip(*((p.elapsed, p.solver, p.probes) for p in parts), strict=True)
    )
    variance = np.concatenate([part.variance for part in parts])
    dimensions = np.concatenate([part.dimensions for part in parts])
    if len(dimensions) == 1:  # all windows have one number
        return Maps(
            index,
            weight,
            np.broadcast_to(elapsed, (count, *elapsed.shape[1:])),
            np.broadcast_to(solver, (count, *solver.shape[1:])),
            np.broadcast_to(variance, (count, *variance.shape[1:])),
            np.broadcast_to(probes, (count, *probes.shape[1:])),
            np.broadcast_to(dimensions, (count, *dimensions.shape[1:])),
        )
    return Maps(
        index,
        weight,
        elapsed[which],
        solver[which],
        variance[which],
        probes[which],
        dimensions[which],
    )


def _longer(part: Array, size: int) -> Array:
    """Pad the last axis, samples, with zeros up to a size."""
    if part.shape[-1] == size:
        return part
    more = np.zeros((*part.shape[:-1], size - part.shape[-1]))
    return np.concatenate([part, more], axis=-1)


def nuisances_hz(settings: LockinSettings, frequencies: Array, nyquist_hz: float) -> Array:
    """Return the harmonics of the mains that are fitted with the tones (Hz).

    None where a tone is faster than the sampling: the samples are those of the tones' bands alone
    (`magfusion.model.bandpass`).
    """
    if settings.mains_hz <= 0 or np.max(frequencies, initial=0.0) > nyquist_hz:
        return np.zeros(0)
    lines = np.arange(settings.mains_hz, 0.95 * nyquist_hz, settings.mains_hz)[:6]
    others = np.concatenate([frequencies, settings.lines_hz])
    separate = np.min(np.abs(lines[:, None] - others), axis=1) * settings.window
    return lines[separate > 0.8]


def padded(windows: Windows, time: Array) -> tuple[IntArray, BoolArray, Array]:
    """Return the sample indices of windows, which are not padding, and their times (s)."""
    reach = np.arange(int(np.max(windows.count)))
    weight = reach < windows.count[:, None]
    index = np.minimum(windows.first[:, None] + reach, len(time) - 1)
    return index, weight, np.where(weight, time[index] - windows.centre[:, None], 0.0)


def separable(step: float, settings: LockinSettings, frequencies_hz: Array) -> bool:
    """Return whether a whole window of samples ``step`` apart (s) separates its columns."""
    elapsed = _whole_window(step, settings)
    design = design_of(
        elapsed, settings, frequencies_hz, nuisances_hz(settings, frequencies_hz, 0.5 / step)
    )[0]
    enough = design.shape[0] > design.shape[1]
    return enough and bool(np.linalg.cond(design.T @ design) < WORST_CONDITION)


def _whole_window(step: float, settings: LockinSettings) -> Array:
    """Return the times of a whole window's samples from its centre, shape (1, samples) (s)."""
    return np.arange(-0.5 * settings.window + 0.5 * step, 0.5 * settings.window, step)[None]


def variance_growth(
    windows: Windows, time: Array, step: float, settings: LockinSettings, frequencies_hz: Array
) -> Array:
    """Return the variance of a window's phasors relative to that of a whole window.

    From the conditioning of the design at the available samples; the worst tone. `time`: times of
    all samples (s). `step`: sampling interval of a whole window (s).
    """
    nuisance_hz = nuisances_hz(settings, frequencies_hz, 0.5 / step)

    tones, lines = len(frequencies_hz), len(nuisance_hz)

    def variance(elapsed: Array, weight: BoolArray) -> Array:
        design = design_of(elapsed, settings, frequencies_hz, nuisance_hz) * weight[..., None]
        normal = np.swapaxes(design, -1, -2) @ design
        good = drop_lines(design, normal, elapsed, weight, tones, lines)
        own = np.diagonal(np.linalg.inv(normal), axis1=-2, axis2=-1)
        return np.where(good[:, None], own[:, 2 : 2 + 2 * len(frequencies_hz)], np.inf)

    whole = _whole_window(step, settings)
    usual, out = variance(whole, np.ones_like(whole, dtype=bool)), []
    for begin in range(0, len(windows), CHUNK):
        _, weight, elapsed = padded(windows.rows(slice(begin, begin + CHUNK)), time)
        out.append(np.max(variance(elapsed, weight) / usual, axis=1))
    return np.concatenate(out)


def drop_lines(
    design: Array, normal: Array, elapsed: Array, weight: BoolArray, tones: int, lines: int
) -> BoolArray:
    """Drop, in place, the mains lines that windows with missing samples do not separate.

    Samples lost in a pattern alias lines below the Nyquist frequency of the others. A dropped
    column is zero, with one on the diagonal of its normal matrix. Lines are kept from the lowest
    on. Returns (n,): whether the remaining columns are separable; if not, `normal` is the identity.
    """
    step = np.where(weight[:, 1:], np.diff(elapsed, axis=1), 0.0)
    shortest = np.min(np.where(weight[:, 1:], step, np.inf), axis=1, initial=np.inf)
    good = np.max(step, axis=1, initial=0.0) < GAP * shortest  # of a stream without losses
    good[~good] = np.linalg.cond(normal[~good]) < WORST_CONDITION
    corrupted = np.flatnonzero(~good)
    if not len(corrupted):
        return good
    kept = np.ones((len(corrupted), normal.shape[-1]), dtype=bool)
    of_lines = 2 + 4 * tones + np.arange(2 * lines).reshape(2, lines)
    kept[:, of_lines] = False

    def reduced() -> Array:
        both = kept[:, :, None] & kept[:, None]
        return np.where(both, normal[corrupted], np.eye(normal.shape[-1]))

    for line in of_lines.T:
        kept[:, line] = True
        kept[np.ix_(np.linalg.cond(reduced()) >= WORST_CONDITION, line)] = False
    good[corrupted] = separable = np.linalg.cond(reduced()) < WORST_CONDITION
    kept[~separable] = False
    normal[corrupted] = reduced()
    design[corrupted] *= kept[:, None]
    return good


def design_of(
    elapsed: Array, settings: LockinSettings, frequencies: Array, nuisances: Array
) -> Array:
    """Return the columns: constant, drift, tones and their ramps, mains, other lines."""
    ramp = elapsed[..., None] * (2.0 / settings.window)
    other = 2.0 * np.pi * elapsed[..., None] * np.array(settings.lines_hz)
    along, across = np.cos(other), np.sin(other)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies
    cosine, sine = np.cos(angle), np.sin(angle)
    mains = 2.0 * np.pi * elapsed[..., None] * nuisances
    return np.concatenate(
        [
            *(np.ones_like(ramp), ramp, cosine, sine, ramp * cosine, ramp * sine),
            *(np.cos(mains), np.sin(mains)),
            *(along, across, ramp * along, ramp * across),
        ],
        axis=-1,
    )
