"""Phasors referred to drive currents recorded with the field."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.channel_effects import driven
from magfusion.model.drive import MIN_CURRENT_SHARE, DriveSamples, DriveShares
from magfusion.model.samples import FieldSamples, Log, RotorAngles
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.drive import DriveReceiver
from magfusion.receiver.sampling_clock import sampling_clock

FAR = 3.0  # times the declared current; more is an error of its unit


def cosines(rotation: RotorAngles) -> DriveSamples:
    """Return shaft angles as equivalent currents: their cosine, with one ampere peak."""
    own = {name: np.cos(angle) for name, angle in rotation.angle.items()}
    return DriveSamples(rotation.time, own)


def turning_currents(log: Log, site: Site) -> Log:
    """Return a log in which an encoder's angle is a current: its cosine, of one ampere.

    It is used like a current: phasors are referred to it, and the speed may drift within the
    lock-in's width. Raises InputError where an angle is of no rotor of the site, or of one with
    harmonics, which is no current.
    """
    if log.rotation is None:
        return log
    rotors = {beacon.name: beacon for beacon in site.beacons if beacon.rotor is not None}
    for name in log.rotation.angle:
        if name not in rotors:
            raise InputError(
                f"rotor_{name}: the site has no rotor of this name; declare beacon {name} with"
                " rotor, or omit the column"
            )
        if len(rotors[name].tones) > 1:
            raise InputError(
                f"rotor_{name}: only magfusion range uses the angle of a rotor with harmonics;"
                " omit harmonics from the site"
            )
    rotated, known = cosines(log.rotation), log.drive
    if known is not None:
        if not np.array_equal(known.time, rotated.time):
            raise InputError(
                "magnetometer: currents and angles are missing at different samples; give both"
            )
        rotated = DriveSamples(rotated.time, dict(known.current) | dict(rotated.current))
    return replace(log, drive=rotated, rotation=None)


def with_drives(log: Log, site: Site) -> tuple[Log, Site]:
    """Return the log with its findings on drive currents, and a site with these currents.

    Raises InputError as `magfusion.receiver.drive.drive_channels`.
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
    findings = (*log.findings, *drive_findings(receiver, site))
    return replace(log, findings=findings), replace(site, drives=receiver.shares)


def drive_findings(receiver: DriveReceiver, site: Site) -> Iterator[Finding]:
    """Yield the findings of implausible or noisy currents."""
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
                    f"The recorded current of beacon {beacon.name} is {times:.3g} times that of"
                    " its declared moments. Give the column in A, and current_a as its peak.",
                    Verdict.DOUBTFUL,
                )
            elif noise > limit:
                yield Finding(
                    "drive_current",
                    f"The recorded current of beacon {beacon.name} has a noise of"
                    f" {100.0 * noise:.2g} % in a window, above its model error of"
                    f" {100.0 * limit:.2g} %. Record it with less noise, or omit it.",
                    Verdict.DOUBTFUL,
                )


def referred(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return phasors as they would be measured at the declared currents.

    NaN where a coil was off.
    """
    known = driven(site, fields.time)
    if known is None:
        return fields
    share = np.exp(known[0] + 1j * known[1])
    phasor = fields.phasor_sensor / share[..., None]
    phasor[known[0] < np.log(MIN_CURRENT_SHARE)] = np.nan
    cov = fields.phasor_cov * np.exp(-2.0 * known[0])[..., None, None]
    return replace(fields, phasor_sensor=phasor, phasor_cov=cov)
