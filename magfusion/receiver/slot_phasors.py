"""Time division: the value of each slot, and one phasor of each driven slot.

Every slot is a row at its own time with one channel: successive slots are not simultaneous, and at
100 deg/s slots of 5 ms differ by 0.7 deg.  The gyro rotates all samples into non-rotating axes, in
which a silent slot has the same Earth field as its neighbours, and back into those of the slot's
own time.
"""

from dataclasses import dataclass, replace
from typing import overload

import numpy as np

from magfusion.model.samples import FieldSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import Windows
from magfusion.receiver.ambient import ambient_weights, removed, uneven_weights
from magfusion.receiver.ambient_left import left_by_ambient
from magfusion.receiver.noise import smoothed_over_windows
from magfusion.receiver.slots import (
    NOISE_CYCLES,
    SlotSettings,
    carriers_hz,
    is_marked,
    is_pulsed,
    owners,
    places,
    schedule,
)
from magfusion.receiver.turn import Turn
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

MAX_PAUSE = 1.0  # s; longer pauses separate the noise of marked bursts


@dataclass(frozen=True, eq=False)
class SlotValues:
    """Values of slots, each in the measured axes of its own time."""

    number: IntArray  # (n,), running number from the start of the schedule, increasing
    # centre, time: (n,), middle of the slot, and mean time of its samples (s)
    centre: Array
    time: Array
    value: ComplexArray  # (n, 3), phasor at the carrier, or field of direct current (T)
    variance: Array  # (n,), of a component, for samples of unit variance
    # (n, 3, 3), covariance per sample of the noise near the carrier in this slot alone (T^2)
    noise: Array
    length: Array  # (n,) (s)
    place: IntArray  # (n,), place in its cycle

    @staticmethod
    def none() -> "SlotValues":
        """Return no slots."""
        number, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
        value, noise = np.zeros((0, 3), dtype=np.complex128), np.zeros((0, 3, 3))
        return SlotValues(number, nothing, nothing, value, nothing, noise, nothing, number)

    def rows(self, kept: BoolArray | IntArray) -> "SlotValues":
        """Return a subset of the slots."""
        return SlotValues(*(part[kept] for part in vars(self).values()))

    def joined(self, later: "SlotValues") -> "SlotValues":
        """Return these and later slots."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return SlotValues(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class _Sums:
    """Least-squares result of each slot."""

    time: Array  # (n,) weighted mean of the sample times
    value: ComplexArray  # (n, 3) non-rotating axes
    variance: Array  # (n,) of a component, for samples of unit variance


def slot_values(
    waveform: Waveform,
    measured_from_still: Turn,
    site: Site,
    settings: SlotSettings,
    windows: Windows,
    rate_hz: float,
) -> SlotValues:
    """Fit the value of each slot, driven or silent, to its raw samples.

    Parameters
    ----------
    measured_from_still : Turn
        As from `magfusion.receiver.turn.turn_of`.
    site : Site
        Its beacons share one schedule.
    windows : Windows
        Admitted slots, numbered from the start of the schedule.
    rate_hz : float
        Median sampling rate.
    """
    if len(windows) == 0:
        return SlotValues.none()
    carrier = carriers_hz(site, places(site))
    first, last = int(windows.first[0]), int(windows.first[-1] + windows.count[-1])
    time = waveform.time[first:last]
    own = replace(windows, first=windows.first - first)
    clean = waveform.measured_sensor[first:last] - site.platform.magnetometer.offset
    still = _applied(measured_from_still.back(time), clean)
    own_carrier = carrier[windows.place]
    inside = _inside(time, still, own, rate_hz)
    sums = _slot_sums(inside, own_carrier, settings)
    noise = _noise(inside, own_carrier, windows.length, rate_hz)
    turn = measured_from_still(sums.time)
    return SlotValues(
        windows.number,
        windows.centre,
        sums.time,
        _applied(turn, sums.value),
        sums.variance,
        turn @ noise @ np.swapaxes(turn, 1, 2),
        windows.length,
        windows.place,
    )


@overload
def _applied(turn: Array, vectors: Array) -> Array: ...
@overload
def _applied(turn: Array, vectors: ComplexArray) -> ComplexArray: ...
def _applied(turn: Array, vectors: Array | ComplexArray) -> Array | ComplexArray:
    out = np.empty_like(vectors)
    np.matmul(turn, vectors[..., None], out=out[..., None])
    return out


def demodulate_slots(
    values: SlotValues, measured_from_still: Turn, site: Site, settings: SlotSettings
) -> tuple[FieldSamples, IntArray]:
    """Turn the slots of a tracker into one phasor for each driven slot.

    Pulses of direct current give a real phasor, the field itself. `measured_from_still`: as from
    `magfusion.receiver.turn.turn_of`. Returns `samples`: a row for each driven slot with silent
    ones near it, at the mean time of its samples, with one channel. The covariance contains the
    noise of the slot and of the subtracted field, and for marked pulses the residual hum estimated
    from their silent bursts; `number` (n,): the slot of each row.
    """
    turn, still_from_measured = measured_from_still.both(values.time)
    still = _applied(still_from_measured, values.value)
    noise = _smoothed_noise(values, still_from_measured, still, site)
    place, owner = values.place, owners(site, places(site))
    driven, silent = np.flatnonzero(owner[place] >= 0), np.flatnonzero(owner[place] < 0)
    index, weight = _ambient(values, driven, silent, site, settings)
    value = removed(still[driven], still[silent], index, weight)
    usable = np.isfinite(value).all(axis=1)
    kept, weight = driven[usable], weight[usable]
    # Slots share the subtracted field, whose error does not average out.
    shared = 0.0 if settings.removal == "none" else 1.0 / max(len(np.unique(place[silent])), 1)
    variance = values.variance[kept] * (1.0 + np.maximum(np.sum(weight**2, axis=1), shared))
    phasor = _applied(turn[kept], value[usable])
    result = _rows(site, values.time[kept], values.length[kept], owner[place[kept]], phasor)
    still_cov = variance[:, None, None] * noise[kept]
    if is_marked(site) and is_pulsed(site) and settings.removal != "none":
        hum = _hum(values.rows(silent), still[silent], noise[silent], site, settings)
        others = np.clip(np.searchsorted(silent, kept), 0, max(len(silent) - 1, 0))
        still_cov += (1.0 + np.sum(weight**2, axis=1))[:, None, None] * hum[others]
    cov = turn[kept] @ still_cov @ np.swapaxes(turn[kept], 1, 2)
    result.phasor_cov[np.arange(len(kept)), owner[place[kept]]] = cov
    return result, values.number[kept]


def _ambient(
    values: SlotValues, driven: IntArray, silent: IntArray, site: Site, settings: SlotSettings
) -> tuple[IntArray, Array]:
    """Return the silent slots and weights from which the ambient field is estimated."""
    mains_hz = settings.mains_hz if is_pulsed(site) else 0.0
    if is_marked(site):
        if settings.removal == "none":
            return ambient_weights(driven, silent, 1, "none")
        one, other = values.rows(driven), values.rows(silent)
        where = (one.time, one.length, other.time, other.length)
        return uneven_weights(*where, settings.cycles, mains_hz)
    slots = schedule(site)
    return ambient_weights(
        values.number[driven],
        values.number[silent],
        slots.count,
        settings.removal,
        cycles=settings.cycles,
        mains_turns=mains_hz * slots.duration,
    )


def _hum(
    silent: SlotValues, still: ComplexArray, noise: Array, site: Site, settings: SlotSettings
) -> Array:
    """Return the covariance of each silent burst that its neighbours do not predict."""
    own = silent.variance[:, None, None] * noise
    state = settings.cycles, settings.mains_hz
    spread = MAX_PAUSE, NOISE_CYCLES * places(site)
    return left_by_ambient(silent.time, silent.length, still, own, state, spread)


@dataclass(frozen=True, eq=False)
class _Inside:
    """Samples of some slots, concatenated."""

    owner: IntArray  # (samples,), the slot of each
    begins: IntArray  # (slots,), where each slot begins among them
    time: Array  # (samples,) (s)
    elapsed: Array  # (samples,), since the slot began (s)
    still: Array  # (samples, 3) (T), non-rotating axes
    hann: Array  # (samples,), taper over the slot
    slot_begin: Array  # (slots,) (s)


def _inside(time: Array, still: Array, windows: Windows, rate_hz: float) -> _Inside:
    owner = np.repeat(np.arange(len(windows.count)), windows.count)
    begins = np.concatenate([[0], np.cumsum(windows.count)[:-1]])
    sample = np.arange(len(owner)) + (windows.first - begins)[owner]
    slot_begin, at = windows.centre - 0.5 * windows.length, time[sample]
    elapsed = at - slot_begin[owner]
    hann = 1.0 - np.cos(2.0 * np.pi * (elapsed + 0.5 / rate_hz) / windows.length[owner])
    return _Inside(owner, begins, at, elapsed, still[sample], hann, slot_begin)


def _slot_sums(inside: _Inside, carrier_hz: Array, settings: SlotSettings) -> _Sums:
    """Fit a constant, and with a carrier its two quadratures, to each slot."""
    at, elapsed, begins = inside.time, inside.elapsed, inside.begins
    weight = inside.hann if settings.taper == "hann" else np.ones(len(at))
    columns = [np.ones(len(at))]
    if np.any(carrier_hz):
        angle = 2.0 * np.pi * carrier_hz[inside.owner] * elapsed
        columns += [np.cos(angle), np.sin(angle)]
    size = len(columns)
    design = np.stack(columns, axis=1)
    weighed = weight[:, None] * design
    normal, spread, right, centre = (
        np.add.reduceat(values, begins, axis=0)
        for values in (
            weighed[:, :, None] * design[:, None],
            weighed[:, :, None] * weighed[:, None],
            weighed[:, :, None] * inside.still[:, None],
            weight * at,
        )
    )
    inverse = np.linalg.inv(normal)
    fitted = inverse @ right
    cov = inverse @ spread @ inverse
    centre = centre / normal[:, 0, 0]
    if size == 1:
        return _Sums(centre, fitted[:, 0].astype(np.complex128), cov[:, 0, 0])
    reference = np.exp(-2j * np.pi * carrier_hz * inside.slot_begin)
    value = (fitted[:, 1] - 1j * fitted[:, 2]) * reference[:, None]
    return _Sums(centre, value, 0.5 * (cov[:, 1, 1] + cov[:, 2, 2]))


def _noise(inside: _Inside, carrier_hz: Array, length: Array, rate_hz: float) -> Array:
    """Return the covariance per sample of the noise near the carrier, (n, 3, 3), non-rotating axes.

    It is the power three cycles a slot away, tapered against leakage of hum.  A static field, a
    linear drift and the carrier do not contribute, whatever the slot's length.
    """
    away = 3.0 / length
    above = carrier_hz + away < 0.5 * rate_hz
    probe = np.where(above, carrier_hz + away, carrier_hz - away)
    rotated = np.exp(-2j * np.pi * probe[inside.owner] * inside.elapsed)
    columns = [np.ones(len(rotated)), inside.elapsed / length[inside.owner] - 0.5]
    if np.any(carrier_hz):
        angle = 2.0 * np.pi * carrier_hz[inside.owner] * inside.elapsed
        columns += [np.cos(angle), np.sin(angle)]
    known = np.stack(columns, axis=1)
    weighed = inside.hann[:, None] * known
    normal = np.add.reduceat(weighed[:, :, None] * known[:, None], inside.begins, axis=0)
    right = np.add.reduceat(weighed * rotated[:, None], inside.begins, axis=0)
    share = (_pseudo_inverse(normal) @ right[..., None])[..., 0]
    blind = inside.hann * (rotated - np.sum(known * share[inside.owner], axis=1))
    seen = np.add.reduceat(blind[:, None] * inside.still, inside.begins, axis=0)
    power = np.add.reduceat(np.abs(blind) ** 2, inside.begins)
    cov = seen[:, :, None] * np.conj(seen[:, None])
    return np.asarray(cov.real / power[:, None, None])


def _pseudo_inverse(normal: Array) -> Array:
    """Return `numpy.linalg.pinv` of positive semidefinite normal matrices, at half its cost."""
    value, vector = np.linalg.eigh(normal)
    value, vector = value[..., ::-1], np.ascontiguousarray(vector[..., ::-1])
    dimensions = value > 1e-15 * value.shape[-1] * value[..., :1]
    inverse = np.divide(1.0, value, where=dimensions, out=np.zeros_like(value))
    return np.asarray(vector @ (inverse[..., None] * np.swapaxes(vector, -1, -2)))


def _smoothed_noise(
    values: SlotValues, still_from_measured: Array, still: ComplexArray, site: Site
) -> Array:
    """Return the covariance per sample averaged over many cycles, (n, 3, 3), non-rotating axes."""
    cov = still_from_measured @ values.noise @ np.swapaxes(still_from_measured, 1, 2)
    number = NOISE_CYCLES * places(site)
    cycle = MAX_PAUSE if is_marked(site) else schedule(site).cycle
    smooth = smoothed_over_windows(cov[:, None], values.centre, cycle, number, None)[:, 0]
    least = 1e-12 * float(np.abs(still).max())
    return smooth + least**2 * np.eye(3)


def _rows(
    site: Site, time: Array, length: Array, channel: IntArray, phasor: ComplexArray
) -> FieldSamples:
    shape = (len(time), len(site.channels), 3)
    every = np.full(shape, np.nan, dtype=np.complex128)
    every[np.arange(len(time)), channel] = phasor
    every[..., site.platform.magnetometer.lacking] = np.nan
    return FieldSamples(
        time=time,
        window=length,
        channels=site.channels,
        phasor_sensor=every,
        phasor_cov=np.full((*shape, 3), np.nan),
        axes=site.platform.magnetometer.axes,
    )
