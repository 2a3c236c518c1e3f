"""Calibration of a subset of a site's beacons, to avoid computing the many others."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magfusion.model.parameters.parameter import Calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray, IntArray

TOGETHER = 32  # epochs whose beacons are evaluated at once


def channels_of(site: Site, beacons: IntArray) -> IntArray:
    """Return the channels of beacons, given by index in the site."""
    return np.flatnonzero(np.isin(site.owner, beacons))


def beacons_of(site: Site, channels: BoolArray) -> IntArray:
    """Return the beacons with any of the detected channels, shape (channels,)."""
    return np.unique(site.owner[channels])


def of_beacons(calibration: Calibration, beacons: IntArray) -> Calibration:
    """Return the calibration of a subset of the beacons, in the order of the site."""
    site, channels = calibration.site, channels_of(calibration.site, beacons)
    return replace(
        calibration,
        site=replace(site, beacons=tuple(site.beacons[k] for k in beacons.tolist())),
        phase=calibration.phase[..., channels],
        drift=calibration.drift[beacons],
        log_gain=calibration.log_gain[..., channels],
    )


def with_undetected(calibration: Calibration) -> Calibration:
    """Return the calibration including the undetected beacons, as the site declares them.

    For one magnetometer.
    """
    site = calibration.site
    if not site.undetected:
        return calibration
    others = tuple(beacon for _, beacon in site.undetected)
    tones = sum(len(beacon.tones) for beacon in others)

    def longer(values: Array, more: int) -> Array:
        return np.concatenate([values, np.zeros((*values.shape[:-1], more))], axis=-1)

    return replace(
        calibration,
        site=replace(site, beacons=(*site.beacons, *others), undetected=()),
        phase=longer(calibration.phase, tones),
        drift=longer(calibration.drift, len(others)),
        log_gain=longer(calibration.log_gain, tones),
    )


def samples_of(samples: FieldSamples, channels: IntArray) -> FieldSamples:
    """Return the phasors of a subset of the channels."""
    return replace(
        samples,
        channels=tuple(samples.channels[k] for k in channels.tolist()),
        phasor_sensor=samples.phasor_sensor[:, channels],
        phasor_cov=samples.phasor_cov[:, channels],
        ahead=None if samples.ahead is None else samples.ahead[:, channels],
        channel_rotation=None
        if samples.channel_rotation is None
        else samples.channel_rotation[:, channels],
    )


def stretches(site: Site, detected: BoolArray) -> Iterator[tuple[slice, IntArray]]:
    """Yield successive epochs, with the beacons detected at any of them.

    `detected` (n, channels).
    """
    for begin in range(0, len(detected), TOGETHER):
        rows = slice(begin, begin + TOGETHER)
        yield rows, beacons_of(site, np.asarray(np.any(detected[rows], axis=0)))
