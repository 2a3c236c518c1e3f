"""Coils driven in turn, taken together again: a cycle of slots as one epoch."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.receiver.slots import schedule
from magfusion.receiver.turn import on_clock, turn_of


def whole_cycles(samples: FieldSamples, imu: ImuSamples, site: Site) -> FieldSamples:
    """Join the slots of each cycle to one row, as if they were simultaneous.

    The fields are turned by the gyro to the mean time of the slots; where the body moves, what it
    moves by within the cycle remains.

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
    slots = schedule(site)
    _, cycle = np.unique(slots.running(samples.time) // slots.count, return_inverse=True)
    row, channel = np.nonzero(samples.valid)
    number = int(cycle[-1]) + 1
    seen = np.zeros((number, len(samples.channels)), dtype=bool)
    seen[cycle[row], channel] = True
    whole = seen.all(axis=1)
    if not np.any(whole):
        raise InputError(
            f"no cycle of {slots.count} slots holds all of {len(samples.channels)} coils; record"
            " longer, or give the site in which the log was recorded"
        )
    time = np.bincount(cycle, samples.time) / np.bincount(cycle)
    measured_from_still = turn_of(on_clock(imu, site.platform.imu.time_offset), site)
    still_from_measured = np.linalg.inv(measured_from_still(samples.time[row]))
    turn = measured_from_still(time[cycle[row]]) @ still_from_measured
    phasor = np.full((number, *samples.phasor_sensor.shape[1:]), np.nan, dtype=np.complex128)
    phasor[cycle[row], channel] = (turn @ samples.phasor_sensor[row, channel][..., None])[..., 0]
    cov = np.full((number, *samples.phasor_cov.shape[1:]), np.nan)
    cov[cycle[row], channel] = turn @ samples.phasor_cov[row, channel] @ np.swapaxes(turn, 1, 2)
    return FieldSamples(
        time=time[whole],
        window=np.full(int(np.sum(whole)), slots.cycle),
        channels=samples.channels,
        phasor_sensor=phasor[whole],
        phasor_cov=cov[whole],
    )
