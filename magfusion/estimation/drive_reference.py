"""Phasors referred to drive currents that were recorded beside the field."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magfusion.model.channel_effects import driven
from magfusion.model.drive import LEAST_ON, DriveSamples, DriveShares
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.drive import DriveReceiver
from magfusion.receiver.sampling_clock import sampling_clock

FAR = 3.0  # times the declared current; more is a mistake of its unit


def with_drives(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a site that knows the currents of a log's coils, and the log with what is said of it.

    Raises
    ------
    InputError
        As `magfusion.receiver.drive.drive_channels`.
    """
    if log.drive is None or not site.beacons:
        return log, site
    samples = log.drive
    clock = log.clocks.get("magnetometer")
    if clock is not None and clock.replaced:
        even = sampling_clock(samples.time)
        samples = samples if even is None else DriveSamples(even.time, samples.current)
    receiver = DriveReceiver(site, DriveShares())
    receiver.push(samples)
    noticed = (*log.noticed, *drive_findings(receiver, site))
    return replace(log, noticed=noticed), replace(site, drives=receiver.shares)


def drive_findings(receiver: DriveReceiver, site: Site) -> Iterator[Finding]:
    """Yield what is wrong with currents."""
    for beacon in site.beacons:
        limit = site.model_error if beacon.model_error is None else beacon.model_error
        for tone in range(len(beacon.tones)):
            key = DriveShares.key(beacon.name, tone)
            known = receiver.shares.readings.get(key)
            if known is None:
                continue
            times, noise = float(np.exp(np.median(known[1]))), receiver.noise.get(key, 0.0)
            if not 1.0 / FAR < times < FAR:
                yield Finding(
                    "drive_current",
                    f"The recorded current of beacon {beacon.name} is {times:.3g} times the one for"
                    " which its moments are declared. Give the column in A, and current_a as its"
                    " peak.",
                    Verdict.DOUBTFUL,
                )
            elif noise > limit:
                yield Finding(
                    "drive_current",
                    f"The recorded current of beacon {beacon.name} is known to no better than"
                    f" {100.0 * noise:.2g} % in a window, and its field model to"
                    f" {100.0 * limit:.2g} %. Record it with less noise, or leave it out.",
                    Verdict.DOUBTFUL,
                )


def referred(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return phasors as they would be measured at the declared currents.

    Where a coil was off there is none.
    """
    known = driven(site, fields.time)
    if known is None:
        return fields
    share = np.exp(known[0] + 1j * known[1])
    phasor = fields.phasor_sensor / share[..., None]
    phasor[known[0] < np.log(LEAST_ON)] = np.nan
    cov = fields.phasor_cov * np.exp(-2.0 * known[0])[..., None, None]
    return replace(fields, phasor_sensor=phasor, phasor_cov=cov)
