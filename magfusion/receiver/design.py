"""What a lock-in makes of sample times alone: its design, and the maps from samples to phasors.

No sample and no motion is in it, so that it is made once of a log, and kept while it fits memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from magfusion.receiver.admission import Windows
from magfusion.receiver.noise import probes_left
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, IntArray

CHUNK = 64  # windows demodulated at once: what is made of them stays in the cache
LARGEST = 2**28  # bytes of the maps of so many; of many tones in long windows fewer are at once
KEPT = 256 * 2**20  # bytes of maps that are kept; what is more is made anew
ALIKE = 1e-6  # rad; of the fastest tone, by which times are off that pass for evenly spaced
WITHIN = 1.5  # small steps in which spacings are told; each of its two numbers is half of one off
EVEN_KEPT = 64  # maps of evenly spaced samples
FEWEST_ALIKE = 4  # windows for each of their spacings
WORST_CONDITION = 1e8  # of a normal matrix; beyond, the samples do not tell its columns apart


class Maps(NamedTuple):
    """The maps of n windows, padded to m samples each.

    Parameters
    ----------
    sample : int ndarray, shape (n, m)
        Number of each sample.
    weight : bool ndarray, shape (n, m)
        False where a row is padding.
    elapsed : ndarray, shape (n, m)
        Sample times from the centre of the window (s).
    solver : ndarray, shape (n, 1 + 2 tones, m)
        To the constant, the cosines and the sines.
    variance : ndarray, shape (n, 1 + 2 tones)
        Of these, for samples with a variance of one.
    probes : ndarray, shape (n, tones, 4, m)
        To what is left beside each tone, of a variance of one.
    told : int ndarray, shape (n, tones)
        How many of those the window tells of.
    """

    sample: IntArray
    weight: BoolArray
    elapsed: Array
    solver: Array
    variance: Array
    probes: Array
    told: IntArray


Spacing = tuple[int, int, int]  # samples, their middle and half of their span, in small steps


@dataclass(frozen=True, eq=False)
class Designs:
    """The designs of windows.

    Parameters
    ----------
    frequencies_hz, nuisance_hz : ndarray
        Tones, and lines that are fitted beside them (Hz).
    time : ndarray, shape (samples,)
        (s)
    even : dict
        Maps of single windows by the spacing of their samples, which are evenly spaced: few
        spacings come again and again.
    """

    settings: LockinSettings
    frequencies_hz: Array
    nuisance_hz: Array
    time: Array
    windows: Windows
    even: dict[Spacing, Maps] = field(default_factory=dict)
    kept: dict[int, Maps] = field(default_factory=dict)
    asked: set[int] = field(default_factory=set)

    def pieces(self) -> Iterator[tuple[slice, Maps]]:
        """Yield windows with their maps, as many at once as fit in memory.

        Those of many windows are kept when they are asked for again: most logs are demodulated
        once.
        """
        chunk = self._at_once()
        for begin in range(0, len(self.windows), chunk):
            rows = slice(begin, begin + chunk)
            maps = self.kept.get(begin)
            if maps is None:
                index, weight, elapsed = padded(self.windows.rows(rows), self.time)
                maps = self._of_even(self.windows.count[rows], index, weight, elapsed)
                if maps is None:
                    maps = self._made(index, weight, elapsed)
                    again = begin in self.asked or len(self.windows) <= chunk
                    if again and self._size() + _size(maps) < KEPT:
                        self.kept[begin] = maps
            self.asked.add(begin)
            yield rows, maps

    def _at_once(self) -> int:
        """Return how many windows are demodulated at once."""
        most = int(self.windows.count.max(initial=1))
        columns = 6 * len(self.frequencies_hz) + 2
        return min(max(LARGEST // (8 * most * columns), 1), CHUNK)

    def _size(self) -> int:
        return sum(map(_size, self.kept.values()))

    def design(self, elapsed: Array, weight: BoolArray) -> Array:
        """Return the columns that are fitted to windows, shape (n, m, columns)."""
        found = design_of(elapsed, self.settings, self.frequencies_hz, self.nuisance_hz)
        found *= weight[..., None]
        return found

    def _of_even(
        self, count: IntArray, index: IntArray, weight: BoolArray, elapsed: Array
    ) -> Maps | None:
        """Return the maps of windows of evenly spaced samples; None where they are not.

        Or where there are so many spacings that to look for known ones does not pay.
        """
        spacings = evenly_spaced(elapsed, count, self._step)
        if spacings is None:
            return None
        few, which = np.unique(spacings, axis=0, return_inverse=True)
        if len(few) > EVEN_KEPT or 1 < len(count) < FEWEST_ALIKE * len(few):
            return None
        maps = [self._of_spacing(*own) for own in few.tolist()]
        if len(maps) == 1:
            shared = (np.broadcast_to(p, (len(count), *p.shape[1:])) for p in maps[0][2:])
            return Maps(index, weight, *shared)
        size = index.shape[1]
        solver, probes, times = (
            np.concatenate([_longer(part, size) for part in parts])[which]
            for parts in zip(*((m.solver, m.probes, m.elapsed) for m in maps), strict=True)
        )
        variance, told = (
            np.concatenate(parts)[which]
            for parts in zip(*((m.variance, m.told) for m in maps), strict=True)
        )
        return Maps(index, weight, times, solver, variance, probes, told)

    def _of_spacing(self, count: int, middle: int, half: int) -> Maps:
        """Return the maps of one window of evenly spaced samples."""
        spacing = count, middle, half
        known = self.even.pop(spacing, None)
        if known is None:
            times = self._step * (middle + half * np.linspace(-1.0, 1.0, count))[None]
            whole = np.ones(times.shape, dtype=bool)
            known = self._made(np.zeros(times.shape, dtype=np.int64), whole, times)
        self.even[spacing] = known  # the newest is the last
        if len(self.even) > EVEN_KEPT:
            del self.even[next(iter(self.even))]
        return known

    @property
    def _step(self) -> float:
        """The step of times (s) in which spacings are told."""
        return ALIKE / (2.0 * np.pi * WITHIN * float(np.max(self.frequencies_hz)))

    def _made(self, index: IntArray, weight: BoolArray, elapsed: Array) -> Maps:
        design, n = self.design(elapsed, weight), len(self.frequencies_hz)
        projected = np.swapaxes(design, -1, -2)
        inverse = np.asarray(np.linalg.inv(projected @ design))
        told = np.r_[0, 2 : 2 + 2 * n]
        beside_hz = np.concatenate([self.nuisance_hz, self.settings.lines_hz])
        probes = probes_left(self.frequencies_hz, beside_hz, elapsed, weight, design, inverse)
        return Maps(
            sample=index,
            weight=weight,
            elapsed=elapsed,
            solver=inverse[:, told] @ projected,
            variance=np.einsum("nii->ni", inverse)[:, told],
            probes=probes[0],
            told=probes[1],
        )


def _size(maps: Maps) -> int:
    return sum(part.nbytes for part in maps)


def evenly_spaced(time: Array, count: IntArray, step: float) -> IntArray | None:
    """Return the spacing of the samples of windows; None where they are not even.

    Of times (n, m) the first ``count`` (n,) of each window are asked; these it rounds to `WITHIN`
    steps (s) or less, whatever was asked before.

    Returns
    -------
    int ndarray, shape (n, 3)
        Samples, their middle and half of their span, in steps.
    """
    if np.min(count) < 3:
        return None
    first, last = time[:, 0], time[np.arange(len(count)), count - 1]
    middle = np.rint(0.5 * (first + last) / step)
    half = np.rint(0.5 * (last - first) / step)
    reach = np.arange(time.shape[1])
    share = reach * (2.0 / (count - 1))[:, None] - 1.0
    off = np.abs(time - step * (middle[:, None] + half[:, None] * share))
    if np.max(off, where=reach < count[:, None], initial=0.0) > WITHIN * step:
        return None
    return np.stack([count, middle.astype(np.int64), half.astype(np.int64)], axis=1)


def _longer(part: Array, size: int) -> Array:
    """Return an array of samples, the last axis, with zeros up to a size."""
    more = np.zeros((*part.shape[:-1], size - part.shape[-1]))
    return np.concatenate([part, more], axis=-1)


def nuisances_hz(settings: LockinSettings, frequencies: Array, nyquist_hz: float) -> Array:
    """Return the harmonics of the mains that are fitted beside the tones (Hz)."""
    if settings.mains_hz <= 0:
        return np.zeros(0)
    lines = np.arange(settings.mains_hz, 0.95 * nyquist_hz, settings.mains_hz)[:6]
    others = np.concatenate([frequencies, settings.lines_hz])
    apart = np.min(np.abs(lines[:, None] - others), axis=1) * settings.window
    return lines[apart > 0.8]


def padded(windows: Windows, time: Array) -> tuple[IntArray, BoolArray, Array]:
    """Return the samples of windows, which of them are no padding, and their times (s)."""
    reach = np.arange(int(np.max(windows.count)))
    weight = reach < windows.count[:, None]
    index = np.minimum(windows.first[:, None] + reach, len(time) - 1)
    return index, weight, np.where(weight, time[index] - windows.centre[:, None], 0.0)


def separable(step: float, settings: LockinSettings, frequencies_hz: Array) -> bool:
    """Return whether the samples of a whole window, ``step`` apart (s), tell its columns apart."""
    elapsed = _whole_window(step, settings)
    design = design_of(
        elapsed,
        settings,
        frequencies_hz,
        nuisances_hz(settings, frequencies_hz, 0.5 / step),
    )[0]
    enough = design.shape[0] > design.shape[1]
    return enough and bool(np.linalg.cond(design.T @ design) < WORST_CONDITION)


def _whole_window(step: float, settings: LockinSettings) -> Array:
    """Return the times of a whole window's samples from its centre, shape (1, samples) (s)."""
    return np.arange(-0.5 * settings.window + 0.5 * step, 0.5 * settings.window, step)[None]


def variance_growth(
    windows: Windows, time: Array, step: float, settings: LockinSettings, frequencies_hz: Array
) -> Array:
    """Return how many times the variance of a window's phasors is that of a whole window.

    By the conditioning of the design at the samples that are there, the worst tone.

    Parameters
    ----------
    time : ndarray
        Of all samples (s).
    step : float
        Between two samples of a whole window (s).
    """
    nuisance_hz = nuisances_hz(settings, frequencies_hz, 0.5 / step)

    def variance(elapsed: Array, weight: BoolArray) -> Array:
        design = design_of(elapsed, settings, frequencies_hz, nuisance_hz) * weight[..., None]
        normal = np.swapaxes(design, -1, -2) @ design
        good = np.linalg.cond(normal) < WORST_CONDITION
        normal[~good] = np.eye(normal.shape[-1])
        own = np.diagonal(np.linalg.inv(normal), axis1=-2, axis2=-1)
        return np.where(good[:, None], own[:, 2 : 2 + 2 * len(frequencies_hz)], np.inf)

    whole = _whole_window(step, settings)
    usual, out = variance(whole, np.ones_like(whole, dtype=bool)), []
    for begin in range(0, len(windows), CHUNK):
        _, weight, elapsed = padded(windows.rows(slice(begin, begin + CHUNK)), time)
        out.append(np.max(variance(elapsed, weight) / usual, axis=1))
    return np.concatenate(out)


def design_of(
    elapsed: Array, settings: LockinSettings, frequencies: Array, nuisances: Array
) -> Array:
    """Columns: constant, drift, each tone's cosines, sines and their ramps, mains, other lines."""
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
