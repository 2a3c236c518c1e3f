"""Reference-noise cancellation: the pieces of a rest without the noise common to a reference."""

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
    ReferenceNormalEquations,
    Relation,
    lag_of,
    probes_hz,
    reference_at,
    relation,
)
from magfusion.receiver.reference_clock import ReferenceClock, lag_in
from magfusion.units import Array, BoolArray

MIN_COVERED_SHARE = 0.8  # share of a rest's pieces that the reference must cover
MAX_HIDDEN_SIGMA = 0.5  # sigmas of a phasor
CONTRADICTED = 2.0  # detected over predicted field of a beacon at the reference
P_FALSE_ALARM = 1e-6  # false-alarm probability below which a detection contradicts the site
HIGHEST = 0.45  # of the sampling rate; maximum frequency of the probes


@dataclass(frozen=True, eq=False)
class AlignedReference:
    """Samples of a reference sensor at the sample times of a rest."""

    measured: Array  # (n, 3) (T)
    there: BoolArray  # (n,)
    lag: Lag
    clock: ReferenceClock = field(default_factory=ReferenceClock)


@dataclass(frozen=True, eq=False)
class ReferenceHistory:
    """Results of earlier segments of a stream for a reference."""

    clock: ReferenceClock = field(default_factory=ReferenceClock)
    lag: Lag = NO_LAG  # by which the newest of them was resampled
    normals: tuple[ReferenceNormalEquations | None, ...] = ()  # one per tone

    def at(
        self, lag: Lag, time: float, tones_hz: Array
    ) -> tuple[ReferenceNormalEquations | None, ...]:
        """Return the normal equations propagated to a time (s), for another lag."""
        if not self.normals:
            return (None,) * len(tones_hz)
        late = float(lag.of(np.array(time)) - self.lag.of(np.array(time)))
        return tuple(
            None if one is None else one.later(2.0 * np.pi * tone * late)
            for one, tone in zip(self.normals, tones_hz.tolist(), strict=True)
        )


def align_reference(
    wave: Waveform,
    reference: Waveform | None,
    tones_hz: Array,
    hum: Hum | None,
    known: ReferenceHistory | None = None,
) -> AlignedReference | None:
    """Return a reference on the clock of a rest; None where it covers too little of it.

    `known`: from earlier parts of a stream; by default the rest alone is used.
    """
    if reference is None:
        return None
    margin = 10.0  # s; exceeds the offset of its clock
    rows = slice(*np.searchsorted(reference.time, wave.time[[0, -1]] + [-margin, margin]))
    own = Waveform(reference.time[rows], reference.measured_sensor[rows])
    if len(own) < len(tones_hz) + 2:
        return None
    lines = tones_hz if hum is None else np.append(tones_hz, hum.orders * hum.frequency_hz)
    clock = ReferenceClock()
    if known is None:
        lag = lag_of(wave, own, lines)
    else:
        seen = lag_in(wave, own, lines)
        clock = known.clock if seen is None else known.clock.updated(*seen)
        lag = clock.line or NO_LAG
    measured, there = reference_at(wave, own, lag)
    return (
        AlignedReference(measured, there, lag, clock)
        if np.mean(there) > MIN_COVERED_SHARE
        else None
    )


@dataclass(frozen=True, eq=False)
class CleanedPieces:
    """Pieces of a rest with and without cancellation of the reference's noise."""

    raw: Pieces
    # cleaned, reference: with the common noise removed, and those of the reference; where the
    # reference has samples
    cleaned: Pieces | None
    reference: Pieces | None
    relations: tuple[Relation | None, ...]  # one per tone

    def best(self) -> Pieces:
        """Return the pieces, with noise cancelled at each tone of significant relation.

        Pieces without a reference are NaN at such tones.
        """
        if self.cleaned is None:
            return self.raw
        phasor = self.raw.phasor.copy()
        rows = np.searchsorted(self.raw.centre, self.cleaned.centre)
        for c, one in enumerate(self.relations):
            if one is not None and one.is_effective:
                phasor[:, c] = np.nan
                phasor[rows, c] = self.cleaned.phasor[:, c]
        return replace(self.raw, phasor=phasor)


def clean_pieces(
    wave: Waveform,
    span: tuple[float, float],
    tones_hz: Array,
    length: float,
    hum: Hum | None,
    reference: AlignedReference | None,
    known: ReferenceHistory | None = None,
) -> CleanedPieces:
    """Return the pieces of a rest, with and without reference-noise cancellation.

    `known`: as of `align_reference`.
    """
    none: tuple[Relation | None, ...] = (None,) * len(tones_hz)
    if reference is None:
        return CleanedPieces(pieces(wave, span, tones_hz, length, hum), None, None, none)
    highest = HIGHEST / float(np.median(np.diff(wave.time)))
    lines = tones_hz if hum is None else np.append(tones_hz, hum.orders * hum.frequency_hz)
    probes = [probes_hz(tone, lines, length, highest) for tone in tones_hz.tolist()]
    ends = np.cumsum([0, *(len(own) for own in probes)])
    both = Waveform(wave.time, np.concatenate([wave.measured_sensor, reference.measured], axis=1))
    result = pieces(both, span, tones_hz, length, hum, np.concatenate(probes))
    raw = replace(result, phasor=result.phasor[..., :3])
    first = np.searchsorted(wave.time, result.centre - 0.5 * length)
    last = np.searchsorted(wave.time, result.centre + 0.5 * length)
    missing = np.concatenate([[0], np.cumsum(~reference.there)])
    there = missing[last] == missing[first]
    if np.mean(there) < MIN_COVERED_SHARE:
        return CleanedPieces(raw, None, None, none)
    middle = 0.5 * (span[0] + span[1])
    before = (known or ReferenceHistory()).at(reference.lag, middle, tones_hz)
    relations = tuple(
        relation(result, there, slice(int(ends[c]), int(ends[c + 1])), before[c])
        if ends[c + 1] > ends[c]
        else None
        for c in range(len(tones_hz))
    )
    own, other = result.phasor[there][..., :3], result.phasor[there][..., 3:]
    phasor = own.copy()
    for c, one in enumerate(relations):
        if one is not None:
            phasor[:, c] -= other[:, c] @ one.matrix.T
    some = result.rows(there)
    return CleanedPieces(raw, replace(some, phasor=phasor), replace(some, phasor=other), relations)


@dataclass(frozen=True, eq=False)
class JudgedTone:
    """One tone of a rest, by the most precise pieces."""

    tone: Integrated
    gain: float  # ratio by which the reference reduces the sigma; NaN where it is not used
    detects: bool  # whether the reference detects the beacon, and is not used for this reason
    # bound of the beacon's undetected part in the reference, in sigmas of the phasor; zero where
    # the reference's position is declared
    hidden: float


def judge_tone(
    cleaned: CleanedPieces, best: Pieces, tone: int, time: float, site: Site, false_alarm: float
) -> JudgedTone:
    """Return a tone of a rest, with the reference where it reduces the sigma.

    `best`: as from `Freed.best`, at the drive currents of the rest's middle.
    """
    one, result = integrated(best, tone, time), cleaned.relations[tone]
    if result is None or not result.is_effective:
        return JudgedTone(one, np.nan, detects=False, hidden=0.0)
    raw = integrated(cleaned.raw, tone, time)
    assert cleaned.reference is not None
    other = integrated(cleaned.reference, tone, time)
    size, selected = float(np.linalg.norm(other.phasor)), float(np.linalg.norm(result.matrix, 2))
    detects, hidden, sent = other.chance < false_alarm, 0.0, _sent_there(tone, site)
    if sent is None:
        maximum = size + 2.0 * float(np.sqrt(np.trace(other.cov)))
        hidden = selected * maximum / float(np.sqrt(np.trace(one.cov) / 3.0))
    else:
        one = replace(one, cov=one.cov + (selected * sent) ** 2 * np.eye(3))
        # A predicted part that is small is included in the covariance.
        small = 6.0 * (selected * sent) ** 2 < float(np.trace(one.cov))
        detects = not small or (other.chance < P_FALSE_ALARM and size > CONTRADICTED * sent)
    gain = float(np.sqrt(np.trace(raw.cov) / np.trace(one.cov)))
    if detects or gain <= 1.0:
        return JudgedTone(raw, np.nan, detects, hidden=0.0)
    return JudgedTone(one, gain, detects=False, hidden=hidden)


def _sent_there(tone: int, site: Site) -> float | None:
    """Return the predicted field of a beacon at the reference (T); None without its position."""
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


def reference_findings(rests: list[list[JudgedTone]], site: Site) -> tuple[Finding, ...]:
    """Return the findings of a reference: tones it is not used for, and what it may hide.

    `rests`: each tone of each rest.
    """

    def where(chosen: Callable[[JudgedTone], bool]) -> str:
        result = [any(chosen(rest[c]) for rest in rests) for c in range(len(site.channels))]
        names = [name for (name, _), one in zip(site.channels, result, strict=True) if one]
        return ", ".join(dict.fromkeys(names))

    out = []
    detects, unused = (
        where(lambda one: one.detects),
        where(lambda one: np.isnan(one.gain) and not one.detects),
    )
    if detects:
        text = (
            f"The reference sensor detects beacons, or is near enough to remove a part of them:"
            f" {detects}. It is not used for these. Place it farther from them."
        )
        out.append(Finding("reference_hears", text, Verdict.TRUSTWORTHY))
    if unused:
        text = (
            f"The reference sensor does not measure the noise at the tones of {unused}, or has too"
            " few samples there; it is not used for these. Check that it runs, and place it where"
            " it receives the same storms and mains."
        )
        out.append(Finding("reference_unused", text, Verdict.TRUSTWORTHY))
    hidden = max(one.hidden for rest in rests for one in rest)
    if hidden > MAX_HIDDEN_SIGMA:
        text = (
            "The site does not declare the position of the reference sensor: it is assumed out of"
            " reach of the beacons. What it may receive of them unnoticed would change phasors by"
            f" up to {hidden:.2g} sigmas. Declare reference.position_m."
        )
        out.append(Finding("reference_hears", text, Verdict.DOUBTFUL, hidden))
    return tuple(out)
