"""The pieces of a rest, freed of the noise that a reference sensor heard too."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.model.field import predict
from magfusion.model.samples import Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.hum import Hum
from magfusion.receiver.integration import Integrated, integrated
from magfusion.receiver.pieces import Pieces, pieces
from magfusion.receiver.reference import (
    NO_LAG,
    Lag,
    Normal,
    Relation,
    beside,
    lag_of,
    probes_hz,
    relation,
)
from magfusion.receiver.reference_clock import Clock, lag_in
from magfusion.units import Array, BoolArray

LEAST_COVERED = 0.8  # of the pieces of a rest, a reference has
MOST_HIDDEN = 0.5  # sigmas of a phasor
CONTRADICTED = 2.0  # times what the site says of a beacon at the reference, it hears
SURE = 1e-6  # chance of noise, below which what is heard contradicts the site
HIGHEST = 0.45  # of the sampling rate, up to which probes are


@dataclass(frozen=True, eq=False)
class Witness:
    """A reference at the samples of a rest.

    Parameters
    ----------
    measured : ndarray, shape (n, 3)
        (T)
    there : bool ndarray, shape (n,)
    """

    measured: Array
    there: BoolArray
    lag: Lag
    clock: Clock = field(default_factory=Clock)


@dataclass(frozen=True, eq=False)
class Known:
    """What earlier stretches of a stream tell of a reference.

    Parameters
    ----------
    clock : Clock
    lag : Lag
        By which the latest of them was read.
    normals : tuple of Normal or None
        Of each tone.
    """

    clock: Clock = field(default_factory=Clock)
    lag: Lag = NO_LAG
    normals: tuple[Normal | None, ...] = ()

    def at(self, lag: Lag, time: float, tones_hz: Array) -> tuple[Normal | None, ...]:
        """Return the normal equations as they count about a time (s), read by another lag."""
        if not self.normals:
            return (None,) * len(tones_hz)
        late = float(lag.of(np.array(time)) - self.lag.of(np.array(time)))
        return tuple(
            None if one is None else one.later(2.0 * np.pi * tone * late)
            for one, tone in zip(self.normals, tones_hz.tolist(), strict=True)
        )


def witness_of(
    wave: Waveform,
    reference: Waveform | None,
    tones_hz: Array,
    hum: Hum | None,
    known: Known | None = None,
) -> Witness | None:
    """Return a reference on the clock of a rest; None where it has too little of it.

    Parameters
    ----------
    known : Known, optional
        From earlier parts of a stream; without it the rest is all that there is.
    """
    if reference is None:
        return None
    margin = 10.0  # s; more than its clock may be off
    rows = slice(*np.searchsorted(reference.time, wave.time[[0, -1]] + [-margin, margin]))
    own = Waveform(reference.time[rows], reference.measured_sensor[rows])
    if len(own) < len(tones_hz) + 2:
        return None
    lines = tones_hz if hum is None else np.append(tones_hz, hum.orders * hum.frequency_hz)
    clock = Clock()
    if known is None:
        lag = lag_of(wave, own, lines)
    else:
        seen = lag_in(wave, own, lines)
        clock = known.clock if seen is None else known.clock.heard(*seen)
        lag = clock.line or NO_LAG
    measured, there = beside(wave, own, lag)
    return Witness(measured, there, lag, clock) if np.mean(there) > LEAST_COVERED else None


@dataclass(frozen=True, eq=False)
class Freed:
    """The pieces of a rest with and without what its reference tells.

    Parameters
    ----------
    raw : Pieces
    freed, heard : Pieces, optional
        Without the noise in common, and of the reference itself; those that have one.
    relations : tuple of Relation or None
        Of each tone.
    """

    raw: Pieces
    freed: Pieces | None
    heard: Pieces | None
    relations: tuple[Relation | None, ...]

    def best(self) -> Pieces:
        """Return pieces of which each tone is freed where its relation tells anything.

        A piece without a reference is none of a tone that is freed: NaN.
        """
        if self.freed is None:
            return self.raw
        phasor = self.raw.phasor.copy()
        rows = np.searchsorted(self.raw.centre, self.freed.centre)
        for c, one in enumerate(self.relations):
            if one is not None and one.tells:
                phasor[:, c] = np.nan
                phasor[rows, c] = self.freed.phasor[:, c]
        return replace(self.raw, phasor=phasor)


def freed_pieces(
    wave: Waveform,
    span: tuple[float, float],
    tones_hz: Array,
    length: float,
    hum: Hum | None,
    witness: Witness | None,
    known: Known | None = None,
) -> Freed:
    """Return the pieces of a rest, and what the reference makes of them.

    Parameters
    ----------
    known : Known, optional
        As of `witness_of`.
    """
    none: tuple[Relation | None, ...] = (None,) * len(tones_hz)
    if witness is None:
        return Freed(pieces(wave, span, tones_hz, length, hum), None, None, none)
    highest = HIGHEST / float(np.median(np.diff(wave.time)))
    lines = tones_hz if hum is None else np.append(tones_hz, hum.orders * hum.frequency_hz)
    probes = [probes_hz(tone, lines, length, highest) for tone in tones_hz.tolist()]
    ends = np.cumsum([0, *(len(own) for own in probes)])
    both = Waveform(wave.time, np.concatenate([wave.measured_sensor, witness.measured], axis=1))
    found = pieces(both, span, tones_hz, length, hum, np.concatenate(probes))
    raw = replace(found, phasor=found.phasor[..., :3])
    first = np.searchsorted(wave.time, found.centre - 0.5 * length)
    last = np.searchsorted(wave.time, found.centre + 0.5 * length)
    missing = np.concatenate([[0], np.cumsum(~witness.there)])
    there = missing[last] == missing[first]
    if np.mean(there) < LEAST_COVERED:
        return Freed(raw, None, None, none)
    middle = 0.5 * (span[0] + span[1])
    before = (known or Known()).at(witness.lag, middle, tones_hz)
    relations = tuple(
        relation(found, there, slice(int(ends[c]), int(ends[c + 1])), before[c])
        if ends[c + 1] > ends[c]
        else None
        for c in range(len(tones_hz))
    )
    own, other = found.phasor[there][..., :3], found.phasor[there][..., 3:]
    phasor = own.copy()
    for c, one in enumerate(relations):
        if one is not None:
            phasor[:, c] -= other[:, c] @ one.matrix.T
    some = found.rows(there)
    return Freed(raw, replace(some, phasor=phasor), replace(some, phasor=other), relations)


@dataclass(frozen=True, eq=False)
class Judged:
    """One tone of a rest, by the pieces that tell most of it.

    Parameters
    ----------
    gain : float
        Of the reference: how many times smaller it makes the sigma; NaN where it is not used.
    hears : bool
        Whether the reference hears the beacon, and is not used for that.
    hidden : float
        What it may hear of the beacon unnoticed, in sigmas of the phasor; zero where its place is
        declared.
    """

    tone: Integrated
    gain: float
    hears: bool
    hidden: float


def judged(
    freed: Freed, best: Pieces, tone: int, time: float, site: Site, false_alarm: float
) -> Judged:
    """Return a tone of a rest, with the reference where that makes it better.

    Parameters
    ----------
    best : Pieces
        As from `Freed.best`, at the currents of the rest's middle.
    """
    one, found = integrated(best, tone, time), freed.relations[tone]
    if found is None or not found.tells:
        return Judged(one, np.nan, hears=False, hidden=0.0)
    raw = integrated(freed.raw, tone, time)
    assert freed.heard is not None
    other = integrated(freed.heard, tone, time)
    size, taken = float(np.linalg.norm(other.phasor)), float(np.linalg.norm(found.matrix, 2))
    hears, hidden, sent = other.chance < false_alarm, 0.0, _sent_there(tone, site)
    if sent is None:
        most = size + 2.0 * float(np.sqrt(np.trace(other.cov)))
        hidden = taken * most / float(np.sqrt(np.trace(one.cov) / 3.0))
    else:
        one = replace(one, cov=one.cov + (taken * sent) ** 2 * np.eye(3))
        # What is known to be small is in the covariance.
        small = 6.0 * (taken * sent) ** 2 < float(np.trace(one.cov))
        hears = not small or (other.chance < SURE and size > CONTRADICTED * sent)
    gain = float(np.sqrt(np.trace(raw.cov) / np.trace(one.cov)))
    if hears or gain <= 1.0:
        return Judged(raw, np.nan, hears, hidden=0.0)
    return Judged(one, gain, hears=False, hidden=hidden)


def _sent_there(tone: int, site: Site) -> float | None:
    """Return how loud a beacon is at the reference (T), by the site; None where it has no place."""
    if site.reference_world is None:
        return None
    name, own = site.channels[tone]
    beacon = next(b for b in site.beacons if b.name == name)
    plain = replace(
        site.platform.magnetometer,
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        matrix=np.eye(3),
        coil_centres_sensor=None,
    )
    return float(np.linalg.norm(predict(beacon, plain, np.eye(3), site.reference_world)[own]))


def witnessed(rests: list[list[Judged]], site: Site) -> tuple[Finding, ...]:
    """Return what is to be said of a reference: where it has no part, and what it may hide.

    Parameters
    ----------
    rests : list of list of Judged
        Each tone of each rest.
    """

    def where(chosen: Callable[[Judged], bool]) -> str:
        found = [any(chosen(rest[c]) for rest in rests) for c in range(len(site.channels))]
        names = [name for (name, _), one in zip(site.channels, found, strict=True) if one]
        return ", ".join(dict.fromkeys(names))

    out = []
    hears, unused = (
        where(lambda one: one.hears),
        where(lambda one: np.isnan(one.gain) and not one.hears),
    )
    if hears:
        text = (
            f"The reference sensor hears beacons, or is so near that it takes something off them:"
            f" {hears}. It is not used for these. Place it farther from them."
        )
        out.append(Finding("reference_hears", text, Verdict.TRUSTWORTHY))
    if unused:
        text = (
            f"The reference sensor tells nothing of the noise at the tones of {unused}, or has too"
            " few samples there; it is not used for these. See that it runs, and stands where it"
            " hears the same storms and mains."
        )
        out.append(Finding("reference_unused", text, Verdict.TRUSTWORTHY))
    hidden = max(one.hidden for rest in rests for one in rest)
    if hidden > MOST_HIDDEN:
        text = (
            "The site does not say where the reference sensor stands: that it is out of reach of"
            " the beacons is assumed. What it may hear of them unnoticed would change phasors by"
            f" up to {hidden:.2g} sigmas. Give its place: reference.position_m."
        )
        out.append(Finding("reference_hears", text, Verdict.DOUBTFUL, hidden))
    return tuple(out)
