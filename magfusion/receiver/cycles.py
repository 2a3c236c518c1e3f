"""Combination of a cycle of time slots into one epoch."""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.marks import SILENT, Marks
from magfusion.model.quaternion import matrices
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.receiver.marked_bursts import MAX_EPOCH
from magfusion.receiver.slots import is_marked, schedule
from magfusion.receiver.turn import Turn, on_clock, turn_of
from magfusion.units import Array, BoolArray, IntArray

MAX_PAUSE = 4.0  # usual ones; a longer one ends a marked cycle


def joins(site: Site, marks: Marks | None = None) -> bool:
    """Return whether a cycle is short enough to be one epoch while the platform moves.

    `marks`: of slots without a schedule: whether most of their cycles are short enough.
    """
    if is_marked(site):
        if marks is None:
            return False
        own = marks.rows(marks.slot != SILENT)
        epoch = _marked(0.5 * (own.begin + own.end), own.slot, longest=MAX_EPOCH)
        whole = np.bincount(epoch) == len(site.channels)
        return bool(len(epoch) and np.mean(whole) > 0.5)
    slots = schedule(site)
    driven = [slot for beacon in site.beacons for _, slot in beacon.tones if slot is not None]
    return bool((max(driven) - min(driven)) * slots.duration <= MAX_EPOCH)


def whole_cycles(samples: FieldSamples, imu: ImuSamples, site: Site) -> FieldSamples:
    """Join the slots of each cycle to one row, as if they were simultaneous.

    The gyro rotates the fields to the mean time of the slots.  For a receiver that lacks axes,
    ``turned`` has that rotation instead.  The translation of the body within the cycle remains;
    ``ahead`` has the time of each measurement. `samples`: channels in the site's order. `site`:
    with a schedule. Raises InputError where there is no such cycle. Returns the cycles that hold
    every channel.
    """
    result = cycles(samples, turn_of(on_clock(imu, site.platform.imu.time_offset), site), site)
    whole: BoolArray = np.all(result.valid, axis=1)
    if not np.any(whole):
        raise InputError(
            f"no cycle of slots holds all of {len(samples.channels)} coils;"
            " record longer, or give the site in which the log was recorded"
        )
    return result.rows(whole)


def cycles(
    samples: FieldSamples, measured_from_still: Turn, site: Site, epoch: IntArray | None = None
) -> FieldSamples:
    """Join the available slots of each cycle to one row.

    `samples`: as of `whole_cycles`; at least one. `measured_from_still`: as from
    `magfusion.receiver.turn.turn_of`. `epoch` (n,): the cycle of each row, increasing, where that
    is known.
    """
    cycle = cycle_of(samples, site) if epoch is None else np.unique(epoch, return_inverse=True)[1]
    row, channel = np.nonzero(samples.valid)
    number = int(cycle[-1]) + 1
    time: Array = np.bincount(cycle, samples.time) / np.bincount(cycle)
    phasor = np.full((number, *samples.phasor_sensor.shape[1:]), np.nan, dtype=np.complex128)
    cov = np.full((number, *samples.phasor_cov.shape[1:]), np.nan)
    rotated = None
    if site.platform.magnetometer.lacking:
        # The field along the other axes is unknown: no field can be rotated.
        still_from_body = matrices(measured_from_still.still_from_body(samples.time[row]))
        still_from_epoch = matrices(measured_from_still.still_from_body(time))[cycle[row]]
        rotated = np.broadcast_to(np.eye(3), cov.shape).copy()
        rotated[cycle[row], channel] = np.swapaxes(still_from_epoch, 1, 2) @ still_from_body
        phasor[cycle[row], channel] = samples.phasor_sensor[row, channel]
        cov[cycle[row], channel] = samples.phasor_cov[row, channel]
    else:
        both = np.concatenate([time, samples.time[row]])
        measured_from, still_from_measured = measured_from_still.both(both)
        turn = measured_from[:number][cycle[row]] @ still_from_measured[number:]
        phasor[cycle[row], channel] = (turn @ samples.phasor_sensor[row, channel][..., None])[
            ..., 0
        ]
        own = samples.phasor_cov[row, channel]
        cov[cycle[row], channel] = turn @ own @ np.swapaxes(turn, 1, 2)
    ahead = np.zeros((number, len(samples.channels)))
    ahead[cycle[row], channel] = samples.time[row] - time[cycle[row]]
    return replace(
        samples,
        time=time,
        window=_lengths(samples, cycle, site),
        phasor_sensor=phasor,
        phasor_cov=cov,
        ahead=ahead,
        channel_rotation=rotated,
    )


def _lengths(samples: FieldSamples, cycle: IntArray, site: Site) -> Array:
    """Return the length of each cycle (s); of marked slots, to the end of the last."""
    number = int(cycle[-1]) + 1
    if not is_marked(site):
        return np.full(number, schedule(site).cycle)
    begin, end = np.full(number, np.inf), np.full(number, -np.inf)
    np.minimum.at(begin, cycle, samples.time - 0.5 * samples.window)
    np.maximum.at(end, cycle, samples.time + 0.5 * samples.window)
    return np.asarray(end - begin)


def cycle_of(samples: FieldSamples, site: Site) -> IntArray:
    """Return the cycle of each row, counted from the first, from the coils in it.

    A source whose clock drifts against the log's does not keep a schedule for long.
    """
    if is_marked(site):
        usual = float(np.median(np.diff(samples.time))) if len(samples) > 1 else 0.0
        return _marked(samples.time, np.argmax(samples.valid, axis=1), pause=MAX_PAUSE * usual)
    slots = schedule(site)
    slot = np.array([slot for beacon in site.beacons for _, slot in beacon.tones], dtype=float)
    count = np.maximum(np.sum(samples.valid, axis=1), 1)
    begin = samples.time - (samples.valid @ slot / count + 0.5) * slots.duration
    later = begin[1:] - begin[:-1] > 0.5 * slots.cycle
    return np.concatenate([[0], np.cumsum(later)])


def _marked(
    time: Array, slot: IntArray, *, longest: float = np.inf, pause: float = np.inf
) -> IntArray:
    """Return the cycle of each burst: a repeated coil begins a new one.

    `longest`, `pause`: longest time from the first to the last burst of a cycle, and between two
    (s).
    """
    cycle = np.zeros(len(time), dtype=np.int64)
    selected: set[int] = set()
    first = before = -np.inf
    newest = -1
    for k, (when, one) in enumerate(zip(time.tolist(), slot.tolist(), strict=True)):
        if newest < 0 or one in selected or when - first > longest or when - before > pause:
            newest, selected, first = newest + 1, set(), when
        cycle[k], before = newest, when
        selected.add(one)
    return cycle
