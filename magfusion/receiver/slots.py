"""Time division: from the raw waveform of coils driven in turn to one phasor a slot.

Every slot is stamped with its own time, a row of its own with one channel: what is measured one
after the other is not simultaneous, and at 100 deg/s slots of 5 ms make 0.7 deg of that.  All
samples are turned by the gyro into axes that do not turn with the body, in which the Earth's field
of a silent slot is the one of its neighbours, and back into those of the slot's own time.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site, Slots
from magfusion.receiver.admission import Windows
from magfusion.receiver.ambient import STRETCH, Removal, ambient_weights, removed
from magfusion.receiver.noise import smoothed_over_windows
from magfusion.receiver.turn import turn_of
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

LEAST_SAMPLES = 8  # in a slot; its noise is measured three cycles a slot beside the carrier
LEAST_CYCLES = 1.0  # of a carrier in a slot
NOISE_CYCLES = 16  # over which the noise is averaged


@dataclass(frozen=True)
class SlotSettings:
    """How the slots of a waveform are demodulated.

    Parameters
    ----------
    removal : {"none", "subtract", "interpolate", "state"}
        How the silent slots free the others of the ambient field, see
        `magfusion.receiver.ambient.ambient_weights`.
    taper : {"rectangular", "hann"}
        Weight of the samples within a slot.
    cycles : int
        Over which the ambient state reaches.
    mains_hz : float
        Fitted in the ambient state of pulsed direct current; 0 for none.
    """

    removal: Removal
    taper: Literal["rectangular", "hann"]
    cycles: int = 8
    mains_hz: float = 50.0


@dataclass(frozen=True, eq=False)
class _Sums:
    """What least squares makes of each slot."""

    time: Array  # (n,) weighted mean of the sample times
    value: ComplexArray  # (n, 3) non-turning axes
    variance: Array  # (n,) of a component, for samples of unit variance


def has_schedule(site: Site) -> bool:
    """Return whether a beacon of the site declares time slots."""
    return any(beacon.slots is not None for beacon in site.beacons)


def schedule(site: Site) -> Slots:
    """Return the schedule that all beacons of the site keep.

    Raises
    ------
    InputError
        Where a beacon keeps none or another one, or two coils that do not belong together are
        driven in one slot.
    """
    first = next(beacon for beacon in site.beacons if beacon.slots is not None)
    assert first.slots is not None
    for beacon in site.beacons:
        if beacon.slots != first.slots:
            kept = "none" if beacon.slots is None else "another one"
            raise InputError(
                f"beacon {first.name} keeps a schedule of time slots and beacon {beacon.name}"
                f" {kept}; give both the same slots, in which each coil has its own"
            )
    taken: dict[int, str] = {}
    for beacon in site.beacons:
        for _, slot in beacon.tones:
            if slot is None:
                raise InputError(
                    f"beacon {beacon.name} keeps a schedule of time slots and has a coil without"
                    " one; give every coil its slot"
                )
            if slot in taken:
                raise InputError(
                    f"beacons {taken[slot]} and {beacon.name} are both driven in slot {slot};"
                    " give every coil a slot of its own"
                )
            taken[slot] = beacon.name
    return first.slots


def default_slot_settings(site: Site, mains_hz: float = 50.0) -> SlotSettings:
    """Choose how to demodulate: the ambient state for pulses, tapered carriers without it.

    Beside a carrier the silent slots determine nothing and cost noise.
    """
    pulsed = any(np.any(beacon.tone_frequencies_hz == 0.0) for beacon in site.beacons)
    if pulsed:
        return SlotSettings("state", "rectangular", mains_hz=mains_hz)
    return SlotSettings("none", "hann", mains_hz=mains_hz)


def slot_lockin(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Return window and step for a site with a schedule: its slots.

    Raises
    ------
    InputError
        As `schedule`.
    """
    duration = schedule(site).duration
    return LockinSettings(duration, duration, mains_hz)


def slot_settings_of(site: Site, lockin: LockinSettings | None) -> SlotSettings:
    """Return the settings for what the options of a lock-in ask.

    Raises
    ------
    InputError
        Where they ask for a window that is no slot.
    """
    if lockin is None:
        return default_slot_settings(site)
    duration = schedule(site).duration
    if abs(lockin.window - duration) > 1e-9 * duration:
        raise InputError(
            f"--window {lockin.window:g} s: the time slots of {duration:g} s are the windows;"
            " leave the option out"
        )
    return default_slot_settings(site, lockin.mains_hz)


def is_pulsed(site: Site) -> bool:
    """Return whether the coils are driven by pulses of direct current, without a carrier."""
    return all(np.all(beacon.tone_frequencies_hz == 0.0) for beacon in site.beacons)


def history_of(site: Site, settings: SlotSettings) -> int:
    """Return for how many cycles a slot tells later ones of the noise and the ambient field."""
    return max(NOISE_CYCLES, settings.cycles * (STRETCH if is_pulsed(site) else 1))


def driven_slots(site: Site, number: IntArray) -> BoolArray:
    """Tell in which slots, counted on, a coil is driven."""
    slots = schedule(site)
    return _owners(site, slots)[number % slots.count] >= 0


def demodulate_slots(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: SlotSettings,
    windows: Windows,
    rate_hz: float,
) -> tuple[FieldSamples, IntArray]:
    """Turn the raw samples of a slotted tracker into one phasor for each slot.

    Pulses of direct current give a real phasor, the field itself.

    Parameters
    ----------
    imu : ImuSamples
        As from `magfusion.receiver.turn.on_clock`.
    site : Site
        Whose beacons share one schedule.
    windows : Windows
        The slots that were admitted, numbered from the start of the schedule.
    rate_hz : float
        Usual sampling rate.

    Returns
    -------
    samples : FieldSamples
        A row for each driven slot with silent ones beside it, at the mean time of its samples, with
        one channel.  The covariance holds the noise of the slot and of what was taken off, not what
        hum leaves.
    number : int ndarray, shape (n,)
        The slot of each row.
    """
    slots = schedule(site)
    carrier, pulsed = _carriers_hz(site, slots), is_pulsed(site)
    measured_from_still = turn_of(imu, site)
    clean = waveform.measured_sensor - site.platform.magnetometer.offset
    turned = np.linalg.solve(measured_from_still(waveform.time), clean[..., None])
    still = np.asarray(turned[..., 0])

    place = windows.number % slots.count
    sums = _slot_sums(waveform.time, still, windows, slots, carrier[place], settings, rate_hz)
    noise = _noise(waveform.time, still, windows, slots, carrier[place], rate_hz)
    owner = _owners(site, slots)
    driven, silent = np.flatnonzero(owner[place] >= 0), np.flatnonzero(owner[place] < 0)
    index, weight = ambient_weights(
        windows.number[driven],
        windows.number[silent],
        slots.count,
        settings.removal,
        cycles=settings.cycles,
        mains_turns=settings.mains_hz * slots.duration if pulsed else 0.0,
    )
    value = removed(sums.value[driven], sums.value[silent], index, weight)
    usable = np.isfinite(value).all(axis=1)
    kept, weight = driven[usable], weight[usable]
    # Slots share what was taken off them, and no number of slots averages that out.
    shared = 0.0 if settings.removal == "none" else 1.0 / max(len(np.unique(place[silent])), 1)
    variance = sums.variance[kept] * (1.0 + np.maximum(np.sum(weight**2, axis=1), shared))
    turn = measured_from_still(sums.time[kept])
    phasor = (turn @ value[usable][..., None])[..., 0]
    found = _rows(site, slots, sums.time[kept], owner[place[kept]], phasor)
    cov = variance[:, None, None] * (turn @ noise[kept] @ np.swapaxes(turn, 1, 2))
    found.phasor_cov[np.arange(len(kept)), owner[place[kept]]] = cov
    return found, windows.number[kept]


def _carriers_hz(site: Site, slots: Slots) -> Array:
    """Return the carrier of each slot of a cycle (Hz); that of the first coil in silent ones."""
    tones = [(slot, f) for beacon in site.beacons for f, slot in beacon.tones]
    carrier = np.full(slots.count, tones[0][1])
    for slot, frequency in tones:
        assert slot is not None
        carrier[slot] = frequency
    return carrier


def check_carriers(site: Site, rate_hz: float, settings: SlotSettings) -> None:
    """Refuse slots and carriers that the sampling rate or the settings do not suit.

    Raises
    ------
    InputError
    """
    slots = schedule(site)
    carrier = _carriers_hz(site, slots)
    if slots.duration * rate_hz < LEAST_SAMPLES * (1.0 - 1e-6):
        raise InputError(
            f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for slots of"
            f" {slots.duration:g} s; at least {LEAST_SAMPLES / slots.duration:.4g} Hz are needed"
        )
    highest, lowest = float(np.max(carrier)), float(np.min(carrier))
    if highest > 0.45 * rate_hz:
        raise InputError(
            f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for the carrier at {highest:g}"
            f" Hz; at least {highest / 0.45:.4g} Hz are needed"
        )
    if highest > 0.0 and lowest * slots.duration < LEAST_CYCLES:
        raise InputError(
            f"a carrier of {lowest:g} Hz has less than {LEAST_CYCLES:g} cycles in a slot of"
            f" {slots.duration:g} s; give longer slots, a faster carrier, or frequency_hz: 0"
            " in all coils for pulses of direct current"
        )
    apart = settings.removal != "none"
    if apart and highest > lowest:
        raise InputError(
            "silent slots cannot determine the ambient field at several carriers; demodulate"
            " without them, or drive all coils at one frequency"
        )
    if (apart or highest == 0.0) and np.all(_owners(site, slots) >= 0):
        raise InputError(
            f"all {slots.count} time slots are driven and none determines the ambient field; leave"
            " one silent, or drive the coils with a carrier"
        )


def _samples_of(windows: Windows) -> tuple[IntArray, IntArray, IntArray]:
    """Return all samples in slots, the slot of each, and where each slot begins among them."""
    owner = np.repeat(np.arange(len(windows.count)), windows.count)
    begins = np.concatenate([[0], np.cumsum(windows.count)[:-1]])
    sample = np.arange(len(owner)) - begins[owner] + windows.first[owner]
    return sample, owner, begins


def _hann(time: Array, begin: Array, slots: Slots, rate_hz: float) -> Array:
    return 1.0 - np.cos(2.0 * np.pi * (time - begin + 0.5 / rate_hz) / slots.duration)


def _slot_sums(
    time: Array,
    still: Array,
    windows: Windows,
    slots: Slots,
    carrier_hz: Array,
    settings: SlotSettings,
    rate_hz: float,
) -> _Sums:
    """Fit a constant, and beside a carrier its two quadratures, to each slot."""
    sample, owner, begins = _samples_of(windows)
    slot_begin = windows.centre - 0.5 * slots.duration
    begin, at = slot_begin[owner], time[sample]
    weight = np.ones(len(at))
    if settings.taper == "hann":
        weight = _hann(at, begin, slots, rate_hz)
    columns = [np.ones(len(at))]
    if np.any(carrier_hz):
        angle = 2.0 * np.pi * carrier_hz[owner] * (at - begin)
        columns += [np.cos(angle), np.sin(angle)]

    def total(values: Array) -> Array:
        return np.add.reduceat(values, begins, axis=0)

    size = len(columns)
    normal, spread = np.empty((2, len(begins), size, size))
    right = np.empty((len(begins), size, 3))
    for i, a in enumerate(columns):
        right[:, i] = total((weight * a)[:, None] * still[sample])
        for j, b in enumerate(columns):
            normal[:, i, j] = total(weight * a * b)
            spread[:, i, j] = total(weight**2 * a * b)
    inverse = np.linalg.inv(normal)
    fitted = inverse @ right
    cov = inverse @ spread @ inverse
    centre = total(weight * at) / total(weight)
    if size == 1:
        return _Sums(centre, fitted[:, 0].astype(np.complex128), cov[:, 0, 0])
    reference = np.exp(-2j * np.pi * carrier_hz * slot_begin)
    value = (fitted[:, 1] - 1j * fitted[:, 2]) * reference[:, None]
    return _Sums(centre, value, 0.5 * (cov[:, 1, 1] + cov[:, 2, 2]))


def _noise(
    time: Array, still: Array, windows: Windows, slots: Slots, carrier_hz: Array, rate_hz: float
) -> Array:
    """Return the covariance per sample of the noise beside the carrier, (n, 3, 3), still axes.

    It is the power three cycles a slot away, tapered so that neither carrier nor hum leaks there.
    """
    sample, owner, begins = _samples_of(windows)
    slot_begin = windows.centre - 0.5 * slots.duration
    at = time[sample] - slot_begin[owner]
    weight = _hann(time[sample], slot_begin[owner], slots, rate_hz)
    away = 3.0 / slots.duration
    above = carrier_hz + away < 0.5 * rate_hz
    probe = np.where(above, carrier_hz + away, carrier_hz - away)
    turned = weight * np.exp(-2j * np.pi * probe[owner] * at)
    seen = np.add.reduceat(turned[:, None] * still[sample], begins, axis=0)
    power = np.add.reduceat(weight**2, begins)
    cov = np.einsum("nx,ny->nxy", seen, np.conj(seen)).real / power[:, None, None]
    number = NOISE_CYCLES * slots.count
    smooth = smoothed_over_windows(cov[:, None], windows.centre, slots.cycle, number, None)[:, 0]
    least = 1e-12 * np.max(np.abs(still))
    return smooth + least**2 * np.eye(3)


def _owners(site: Site, slots: Slots) -> IntArray:
    """Return the channel that each slot of a cycle drives; -1 where it is silent."""
    owner = np.full(slots.count, -1)
    tones = [slot for beacon in site.beacons for _, slot in beacon.tones]
    owner[np.array(tones)] = np.arange(len(tones))
    return owner


def _rows(
    site: Site, slots: Slots, time: Array, channel: IntArray, phasor: ComplexArray
) -> FieldSamples:
    shape = (len(time), len(site.channels), 3)
    every = np.full(shape, np.nan, dtype=np.complex128)
    every[np.arange(len(time)), channel] = phasor
    return FieldSamples(
        time=time,
        window=np.full(len(time), slots.duration),
        channels=site.channels,
        phasor_sensor=every,
        phasor_cov=np.full((*shape, 3), np.nan),
    )
