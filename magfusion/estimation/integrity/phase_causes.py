"""Faults of clocks and drive phases: each epoch's phases are estimated with its pose."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from magfusion.estimation.integrity.corrected_site import with_magnetometer, with_phases
from magfusion.estimation.integrity.explanation import CLEARLY, MIN_DECREASE, Explanation
from magfusion.estimation.integrity.field_causes import left_handed
from magfusion.estimation.integrity.field_snapshots import Snapshots
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.solve.bounded import minimise_between
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.units import DEGREE, Array

TWO_PI = 2.0 * np.pi
MAX_SHIFT = 0.5  # s; an epoch that is farther off is known up to a common period of the tones
SHIFT_STEP = 2e-4  # s
RATE_REACH = 0.02  # relative; clocks that are farther off are not sought
COMMON = 0.2  # spread of relative rates, of their mean, that is one clock's
STILL = 2e-6  # relative rate that is none
REVERSED = 0.1  # rad, that a phase may be off a half turn
SIMILAR = 0.7  # of the chi square of constant phases, that those of other clocks may leave
MAX_ADVANCE = 60.0 * DEGREE  # rad; beyond, a coil is reversed or in the wrong quadrature
DENSE = 60  # neighbouring epochs that determine a rate


def phase_causes(known: Snapshots, every: FieldSamples) -> Iterator[Explanation]:
    """Yield what another epoch, or another rate of a clock, would explain.

    `known`: all of whose drives are declared to be synchronised. `every`: all epochs of the log.
    """
    if not all(beacon.synchronised for beacon in known.site.beacons):
        return
    loose = fix_epochs(known.samples, known.calibration, free_parameters=("phase",))
    lower = float(np.sum(loose.cost[:, 0]))
    if known.chi_square - lower < MIN_DECREASE or known.chi_square < CLEARLY * lower:
        return
    tones_hz = known.site.tone_frequencies_hz
    rate = _rates(known, every, tones_hz)
    phase = loose.phase[:, 0]
    mean = np.angle(np.nansum(np.exp(1j * phase), axis=0))
    constant = _rotated(known, mean)
    if rate is not None and np.max(np.abs(rate)) > STILL:
        clocks = list(_of_clocks(known, phase, rate, tones_hz))
        if all(one.after < SIMILAR * constant.chi_square - MIN_DECREASE for one in clocks):
            yield from clocks
            return
    shift = _shift(mean, tones_hz)
    turn = -TWO_PI * tones_hz * shift
    shifted = _rotated(known, turn)
    side = "late" if shift > 0.0 else "early"
    by_shift = _explanation(
        known,
        shifted,
        1,
        "epoch_shift",
        f"all stamps are {1e3 * abs(shift):.3g} ms {side} against the epoch of the drive phases"
        " (or that and a whole number of the tones' common periods)",
        "Correct epoch_ns of the log (of a bag or EuRoC folder by magfusion import --epoch NS), or"
        " the delay of the magnetometer's stamps.",
    )
    yield replace(by_shift, site=_in_phase(known, turn), rival=_late(by_shift, known.site, shift))
    if np.all(np.abs(np.abs(mean) - np.pi) < REVERSED):
        yield _explanation(known, _rotated(known, np.full(len(mean), np.pi)), 0, *left_handed())
    elif (
        not _wired(known, mean)
        and constant.chi_square < SIMILAR * shifted.chi_square - MIN_DECREASE
    ):
        yield _of_each(known, constant, mean)


def _of_each(known: Snapshots, constant: Snapshots, phase: Array) -> Explanation:
    """Return what phases (rad) of the channels explain that no shift of the epoch does.

    A short part of a log does not distinguish constant phases from clocks of their own.
    """
    every = [name for name, _ in known.samples.channels]
    names = {n for n, off in zip(every, np.abs(phase) > REVERSED, strict=True) if off}
    is_one = len(names) < 2
    amounts = ", ".join(f"{one:.3g}" for one in phase / DEGREE)
    result = _explanation(
        known,
        constant,
        len(phase),
        "phase" if is_one else "beacon_clock",
        f"the drive phases are ({amounts}) degrees beyond the declared"
        + ("" if is_one else ": the drives have no common clock"),
        "Check phase_deg, or declare synchronised: false for the beacons.",
    )
    rates = dict.fromkeys(names or every, 0.0)
    return replace(result, site=_at_rates(known.site, rates, synchronised=False))


def _wired(known: Snapshots, phase: Array) -> bool:
    """Return whether phases are those of one beacon's wires, which are tried for themselves."""
    over = np.abs(np.abs(phase) - np.pi) < REVERSED
    names = {known.samples.channels[k][0] for k in np.flatnonzero(over).tolist()}
    return len(names) == 1 and bool(np.all(over | (np.abs(phase) < REVERSED)))


def _explanation(
    known: Snapshots, tried: Snapshots, count: int, code: str, cause: str, remedy: str
) -> Explanation:
    return Explanation(
        code, cause, remedy, known.chi_square, tried.chi_square, known.freedom, count
    )


def _late(by_shift: Explanation, site: Site, shift: float) -> Explanation | None:
    """Return the delay of the magnetometer alone that shifts the phases; None without an IMU."""
    if site.platform.further or not site.platform.inertial:
        return None
    side = "late" if shift > 0.0 else "early"
    offset = site.platform.magnetometer.clock_offset - shift
    return replace(
        by_shift,
        cause=f"the magnetometer's stamps are {1e3 * abs(shift):.3g} ms {side} against the IMU and"
        " the drive phases",
        remedy="Correct the delay of the magnetometer's stamps, or declare its clock_offset_s.",
        site=with_magnetometer(site, clock_offset=offset),
    )


def _in_phase(known: Snapshots, phase: Array) -> Site | None:
    """Return a site with phases (rad) of its channels added; None where one is unknown."""
    steps: dict[str, list[float]] = {}
    within_turn = np.angle(np.exp(1j * phase))  # which the fields do not distinguish
    for (name, _), step in zip(known.samples.channels, within_turn.tolist(), strict=True):
        steps.setdefault(name, []).append(step)
    if not np.all(np.isfinite(phase)):
        return None
    return with_phases(known.site, {name: np.array(step) for name, step in steps.items()})


def _rotated(known: Snapshots, turn: Array) -> Snapshots:
    """Return epochs whose phasors have gone ahead by so much as is taken off here (rad)."""
    phasor = known.samples.phasor_sensor * np.exp(-1j * turn)[..., None]
    return replace(known, samples=replace(known.samples, phasor_sensor=phasor))


def _rates(known: Snapshots, every: FieldSamples, tones_hz: Array) -> Array | None:
    """Return how fast each channel's phase runs away, relative to its frequency."""
    first = max(0, (len(every) - DENSE) // 2)
    chosen = np.zeros(len(every), dtype=bool)
    chosen[first : first + DENSE] = True
    some = every.rows(chosen)
    if len(some) < 8:
        return None
    loose = fix_epochs(some, known.calibration, free_parameters=("phase",))
    phase, elapsed = loose.phase[:, 0], some.time - some.time[0]
    trial = np.arange(-RATE_REACH, RATE_REACH, 0.25 / (elapsed[-1] * np.max(tones_hz)))
    out = []
    for k, tone in enumerate(tones_hz):
        rotated = np.exp(1j * (phase[:, k] - TWO_PI * tone * trial[:, None] * elapsed))
        best = float(trial[np.argmax(np.abs(np.sum(rotated, axis=1)))])
        remaining = np.angle(
            np.exp(1j * phase[:, k])
            * np.exp(-1j * TWO_PI * tone * best * elapsed)
            * np.exp(
                -1j * np.angle(np.sum(np.exp(1j * (phase[:, k] - TWO_PI * tone * best * elapsed))))
            )
        )
        out.append(best + float(np.polyfit(elapsed, remaining, 1)[0]) / (TWO_PI * tone))
    return np.array(out)


def _of_clocks(
    known: Snapshots, phase: Array, rate: Array, tones_hz: Array
) -> Iterator[Explanation]:
    time, common = known.samples.time, float(np.median(rate))
    is_common = np.abs(rate - common) < max(COMMON * abs(common), STILL)
    turn, count = TWO_PI * tones_hz * rate * time[:, None], len(rate)
    remaining = np.angle(np.nansum(np.exp(1j * (phase - turn)), axis=0))
    tried = _rotated(known, turn + remaining)
    names = [name for name, _ in known.samples.channels]
    usual = max(float(np.median(np.abs(rate))), STILL)
    strays = [n for n, r in zip(names, rate, strict=True) if abs(r) > 10.0 * usual]
    beacon, site, rival = "", None, None
    explained = known.chi_square, tried.chi_square, known.freedom
    if np.all(is_common):
        code, count = "sample_rate", 2
        rival = Explanation(
            "beacon_clock",
            f"the drives run {1e6 * common:+.4g} ppm off their declared frequencies",
            "Correct frequency_hz of the beacons.",
            *explained,
            count,
            site=_at_rates(known.site, dict.fromkeys(names, common), synchronised=True),
        )
        slower = (1.0 + known.site.platform.magnetometer.clock_rate) * (1.0 + common) - 1.0
        if not known.site.platform.further:
            site = with_magnetometer(known.site, clock_rate=slower)
        cause = f"the magnetometer's stamps run {1e6 * -common:.4g} ppm fast against the drives"
        remedy = "Check the sample rate with which the stamps were made."
    elif len(set(strays)) == 1:
        code, count = "beacon_clock", 2
        beacon, k = strays[0], names.index(strays[0])
        cause = f"beacon {strays[0]} runs at {tones_hz[k] * (1.0 + rate[k]):.6g} Hz"
        remedy = "Correct its frequency_hz, or declare synchronised: false."
        site = _at_rates(known.site, {beacon: float(rate[k])}, synchronised=False)
    else:
        code, count = "beacon_clock", 2 * len(rate)
        cause = "the drives run on clocks of their own"
        remedy = "Declare synchronised: false for the beacons."
        site = _at_rates(known.site, dict.fromkeys(names, 0.0), synchronised=False)
    yield Explanation(code, cause, remedy, *explained, count, beacon, site=site, rival=rival)


def _at_rates(site: Site, rates: Mapping[str, float], *, synchronised: bool) -> Site:
    """Return a site with frequencies of beacons off by relative rates, by name."""

    def at_rate(beacon: Beacon) -> Beacon:
        faster = 1.0 + rates[beacon.name]
        coils = (
            coil
            if coil.frequency_hz is None
            else replace(coil, frequency_hz=faster * coil.frequency_hz)
            for coil in beacon.coils
        )
        frequency_hz = faster * beacon.frequency_hz
        return replace(
            beacon,
            synchronised=synchronised and beacon.synchronised,
            frequency_hz=frequency_hz,
            coils=tuple(coils),
        )

    beacons = (at_rate(beacon) if beacon.name in rates else beacon for beacon in site.beacons)
    return replace(site, beacons=tuple(beacons))


def _shift(phase: Array, tones_hz: Array) -> float:
    """Return the delay (s) that phases show, the shortest of those that explain them equally."""
    trial = np.arange(-MAX_SHIFT, MAX_SHIFT, SHIFT_STEP)
    rotated = np.exp(1j * (phase + TWO_PI * tones_hz * trial[:, None]))
    agreement = np.real(np.sum(rotated, axis=1))
    near = np.flatnonzero(agreement > np.max(agreement) - 0.02)
    best = float(trial[near[np.argmin(np.abs(trial[near]))]])
    remaining = np.angle(np.exp(1j * (phase + TWO_PI * tones_hz * best)))
    return best - float(np.sum(remaining * tones_hz) / np.sum(TWO_PI * tones_hz**2))


def coil_phase(
    known: Snapshots, beacon: Beacon, trial: Callable[[Beacon], Snapshots]
) -> Iterator[Explanation]:
    """Yield the phase of one of several coils at one tone, against the others.

    `trial`: returns the snapshots with the beacon replaced.
    """
    tones = Counter((coil.frequency_hz, coil.slot) for coil in beacon.coils)

    def advanced(k: int, angle: float) -> Beacon:
        coils = list(beacon.coils)
        coils[k] = replace(coils[k], phase=coils[k].phase + angle)
        return replace(beacon, coils=tuple(coils))

    def cost(k: int, angle: float) -> float:
        return trial(advanced(k, angle)).chi_square

    for k, coil in enumerate(beacon.coils):
        if tones[coil.frequency_hz, coil.slot] < 2:
            continue
        angle, _ = minimise_between(partial(cost, k), -MAX_ADVANCE, MAX_ADVANCE, 0.1 * DEGREE)
        after = trial(advanced(k, angle))
        result = _explanation(
            known,
            after,
            1,
            "phase",
            f"the phase of coil {k} of beacon {beacon.name} is {angle / DEGREE:+.3g} degrees"
            " beyond the declared",
            "Check its phase_deg, and the phase between the channels of its drive.",
        )
        yield replace(result, site=after.site)
