"""Running combination of the segments of a rest to one set of phasors, in constant memory.

Information is additive, so that only sums over the segments are stored.  Where phases and clocks
may drift, older segments are weighted less.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.rests.rest_lengths import walk
from magfusion.estimation.rests.stationary_integration import Rest
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.receiver.integration import trace_chance
from magfusion.receiver.windows import sent_frequencies_hz
from magfusion.units import Array, ComplexArray

MIN_FREEDOM = 8.0  # of a covariance that is estimated from few readings
LOOKS = 6.0 / np.pi**2  # share of the first look in the false alarms; then a fourth, a ninth


@dataclass(frozen=True, eq=False)
class RunningMean:
    """Sums over all segments of a rest."""

    # begin, end: of the rest so far (s)
    begin: float
    end: float
    # (channels, 3, 3), of a phasor's real part, equal to that of its imaginary part (1/T^2)
    information: Array
    weighted: ComplexArray  # (channels, 3), phasors multiplied by their information (1/T)
    squares: Array  # (channels,), sum of the squares of the segments' shares, by their traces
    freedom: Array  # (channels,), degrees of freedom of the covariances
    # (channels,), least false-alarm probability of all segments, of beacons without synchronisation
    least_chance: Array
    looks: int = 0  # number of segments

    @staticmethod
    def begun(begin: float, channels: int) -> "RunningMean":
        """Return an empty rest."""
        return RunningMean(
            begin,
            begin,
            np.zeros((channels, 3, 3)),
            np.zeros((channels, 3), dtype=np.complex128),
            np.zeros(channels),
            np.zeros(channels),
            np.ones(channels),
        )

    @property
    def duration(self) -> float:
        """Duration so far (s)."""
        return self.end - self.begin

    def with_stretch(
        self, rest: Rest, site: Site, end: float, longest: float, requested: float
    ) -> "RunningMean":
        """Return the sums with one more segment.

        `longest`: coherence time of the phases (s): in a longer rest older segments are weighted
        less. `requested`: false-alarm probability below which a segment determines the phase of a
        beacon without synchronisation.
        """
        window = float(rest.fields.window[0])
        kept = max(1.0 - window / longest, 0.0) if self.duration + window > longest else 1.0
        phasor, cov = rest.fields.phasor_sensor[0], rest.fields.phasor_cov[0]
        known, weighted = kept * self.information, kept * self.weighted
        squares, freedom = kept**2 * self.squares, kept * self.freedom
        for c, (name, _) in enumerate(site.channels):
            own, value = np.linalg.inv(cov[c]), phasor[c]
            if not _synchronised(site, name):
                if rest.chance[c] >= requested:
                    continue
                value = value * _onto(weighted[c], value)
            known[c] += own
            weighted[c] += own @ value
            squares[c] += float(np.trace(own)) ** 2
            freedom[c] += rest.tones[c].tone.freedom
        return RunningMean(
            self.begin,
            end,
            known,
            weighted,
            squares,
            freedom,
            np.minimum(self.least_chance, rest.chance),
            self.looks + 1,
        )

    def fields(self, site: Site, longest: float) -> FieldSamples:
        """Return the rest so far as one epoch, with the time of its end."""
        channels, sent_hz = len(site.channels), sent_frequencies_hz(site)
        phasor = np.full((channels, 3), np.nan, dtype=np.complex128)
        cov = np.tile(np.eye(3), (channels, 1, 1))
        is_stationary = min(self.duration, longest)
        for c in range(channels):
            total = float(np.trace(self.information[c]))
            if total == 0.0:
                continue
            cov[c] = self._widened(c, np.linalg.inv(self.information[c]))
            phasor[c] = np.linalg.solve(self.information[c], self.weighted[c])
            square = np.real(np.outer(phasor[c], np.conj(phasor[c])))
            cov[c] += walk(site, float(sent_hz[c]), is_stationary) * square
        return FieldSamples(
            np.array([self.end]),
            np.array([max(self.duration, 1e-3)]),
            site.channels,
            phasor[None],
            cov[None],
        )

    def _widened(self, channel: int, cov: Array) -> Array:
        """Return a covariance inflated for weights by estimated covariances (Meier, 1953)."""
        total = float(np.trace(self.information[channel]))
        spread = 1.0 - float(self.squares[channel]) / total**2
        each = max(float(self.freedom[channel]) / max(self.looks, 1) - 4.0, 4.0)
        return np.asarray(cov * (1.0 + 2.0 * spread / each))

    def chance(self, site: Site) -> Array:
        """Return the false-alarm probability of the amplitudes over all looks, (channels,).

        That of the k-th look is multiplied by k^2, which bounds the false-alarm rate of all looks
        together.
        """
        out = np.ones(len(site.channels))
        for c, (name, _) in enumerate(site.channels):
            if not _synchronised(site, name):
                out[c] = min(1.0, self.looks * float(self.least_chance[c]))
                continue
            if float(np.trace(self.information[c])) == 0.0:
                continue
            phasor = np.linalg.solve(self.information[c], self.weighted[c])
            cov = self._widened(c, np.linalg.inv(self.information[c]))
            freedom = max(float(self.freedom[c]), MIN_FREEDOM)
            trace = float(np.real(np.conj(phasor) @ np.linalg.solve(cov, phasor)))
            alone = trace_chance(trace * freedom / (freedom - 4.0), int(freedom))
            out[c] = min(1.0, alone * max(self.looks, 1) ** 2 / LOOKS)
        return out


def _synchronised(site: Site, name: str) -> bool:
    return next(b for b in site.beacons if b.name == name).synchronised


def _onto(known: ComplexArray, value: ComplexArray) -> complex:
    """Return the rotation of a phasor's phase onto the known one; unity without a known one."""
    along = complex(np.vdot(value, known))
    return along / abs(along) if abs(along) > 0.0 else 1.0 + 0.0j
