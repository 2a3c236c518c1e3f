"""Coils driven in turn, taken together again: a cycle of slots as one epoch."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.receiver.slots import schedule
from magfusion.receiver.turn import Turn, on_clock, turn_of
from magfusion.units import Array, BoolArray, IntArray

# s; from the first to the last slot of an epoch. Half as long after its middle, a head that is
# accelerated by 10 m/s^2 is 0.2 mm from where a steady velocity leads.
LONGEST_EPOCH = 0.012


def joins(site: Site) -> bool:
    """Return whether a cycle is short enough to be one epoch while the platform moves."""
    slots = schedule(site)
    driven = [slot for beacon in site.beacons for _, slot in beacon.tones if slot is not None]
    return bool((max(driven) - min(driven)) * slots.duration <= LONGEST_EPOCH)


def whole_cycles(samples: FieldSamples, imu: ImuSamples, site: Site) -> FieldSamples:
    """Join the slots of each cycle to one row, as if they were simultaneous.

    The fields are turned by the gyro to the mean time of the slots; where the body moves, what it
    moves by within the cycle remains, for which ``ahead`` tells when each was measured.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    site : Site
        With a schedule.

    Returns
    -------
    FieldSamples
        The cycles that hold every channel.

    Raises
    ------
    InputError
        Where there is none.
    """
    found = cycles(samples, turn_of(on_clock(imu, site.platform.imu.time_offset), site), site)
    whole: BoolArray = np.all(found.valid, axis=1)
    if not np.any(whole):
        raise InputError(
            f"no cycle of {schedule(site).count} slots holds all of {len(samples.channels)} coils;"
            " record longer, or give the site in which the log was recorded"
        )
    return found.rows(whole)


def cycles(samples: FieldSamples, measured_from_still: Turn, site: Site) -> FieldSamples:
    """Join the slots of each cycle to one row, whichever of them there are.

    Parameters
    ----------
    samples : FieldSamples
        As of `whole_cycles`; at least one.
    measured_from_still : Turn
        As from `magfusion.receiver.turn.turn_of`.
    """
    slots, cycle = schedule(site), _cycle_of(samples, site)
    row, channel = np.nonzero(samples.valid)
    number = int(cycle[-1]) + 1
    time: Array = np.bincount(cycle, samples.time) / np.bincount(cycle)
    still_from_measured = measured_from_still.back(samples.time[row])
    turn = measured_from_still(time)[cycle[row]] @ still_from_measured
    phasor = np.full((number, *samples.phasor_sensor.shape[1:]), np.nan, dtype=np.complex128)
    phasor[cycle[row], channel] = (turn @ samples.phasor_sensor[row, channel][..., None])[..., 0]
    cov = np.full((number, *samples.phasor_cov.shape[1:]), np.nan)
    cov[cycle[row], channel] = turn @ samples.phasor_cov[row, channel] @ np.swapaxes(turn, 1, 2)
    ahead = np.zeros((number, len(samples.channels)))
    ahead[cycle[row], channel] = samples.time[row] - time[cycle[row]]
    return FieldSamples(
        time=time,
        window=np.full(number, slots.cycle),
        channels=samples.channels,
        phasor_sensor=phasor,
        phasor_cov=cov,
        ahead=ahead,
    )


def _cycle_of(samples: FieldSamples, site: Site) -> IntArray:
    """Return the cycle of each row, counted from the first: by the coils that it holds.

    A source whose clock runs away from the log's keeps no schedule for long.
    """
    slots = schedule(site)
    slot = np.array([slot for beacon in site.beacons for _, slot in beacon.tones], dtype=float)
    count = np.maximum(np.sum(samples.valid, axis=1), 1)
    begin = samples.time - (samples.valid @ slot / count + 0.5) * slots.duration
    return np.cumsum(np.diff(begin, prepend=begin[:1]) > 0.5 * slots.cycle)
