"""Selection of the beacons that a log detects, of many: the others remain as declared."""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE_ONLINE, above_noise
from magfusion.model.detection_range import are_many, largest_fields, phasor_sigma, tones_of
from magfusion.model.parameters import beacons_of, channels_of, samples_of
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.cells import way_of
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import IntArray

MAX_START_BEACONS = 16  # beacons; with more, a start takes longer, and sigmas stay
DETECTION_SIGMAS = 1.0  # sigmas of a phasor: a beacon below it everywhere is not detected


def select_detected(
    log: Log, site: Site, settings: LockinSettings | None = None
) -> tuple[Log, Site]:
    """Return a log and its site with the beacons it detects, where the site has many.

    Those that are not detected are kept separately (`Site.undetected`). Raises InputError where no
    beacon is detected.
    """
    known = [beacon.unknown is None for beacon in site.beacons]
    if not are_many(site) or site.undetected or has_schedule(site) or not all(known):
        return log, site
    detected = _detected_beacons(log, site, settings)
    if len(detected) == len(site.beacons):
        return log, site
    if len(detected) == 0:
        raise InputError(
            f"none of the site's {len(site.beacons)} beacons is detected; reduce the distance"
        )
    fields = log.fields
    if fields is not None:
        fields = samples_of(fields, channels_of(site, detected))
    text = (
        f"{len(detected)} of the site's {len(site.beacons)} beacons are detected. The others are"
        " not estimated: they remain as declared."
    )
    findings = Finding("beacons_unheard", text, Verdict.TRUSTWORTHY, 0.0)
    log = replace(log, fields=fields, findings=(*log.findings, findings))
    return log, _with_beacons(site, detected)


def may_wait(site: Site) -> bool:
    """Return whether a start may leave some of many beacons for later.

    Not those of which it must estimate the phase or the place, or choose the owner of a tone.
    """
    ready = all(beacon.synchronised and beacon.unknown is None for beacon in site.beacons)
    alone = not has_schedule(site) and not tones_of(site).reused
    return are_many(site) and not site.undetected and ready and alone


def select_strongest(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log of phasors and its site with the strongest beacons, where others can wait."""
    if log.fields is None or not may_wait(site):
        return log, site
    power = np.nansum(np.abs(log.fields.phasor_sensor) ** 2, axis=(0, 2))
    by_beacon = np.bincount(site.owner, power, len(site.beacons))
    strongest = np.sort(np.argsort(-by_beacon, kind="stable")[:MAX_START_BEACONS])
    fields = samples_of(log.fields, channels_of(site, strongest))
    return replace(log, fields=fields), _with_beacons(site, strongest)


def _with_beacons(site: Site, kept: IntArray) -> Site:
    """Return a site with some of its beacons, given by index; the others as undetected."""
    every, some = dict(enumerate(site.beacons)), set(kept.tolist())
    return replace(
        site,
        beacons=tuple(every[k] for k in sorted(some)),
        undetected=tuple((k, beacon) for k, beacon in every.items() if k not in some),
    )


def _detected_beacons(log: Log, site: Site, settings: LockinSettings | None) -> IntArray:
    """Return the indices of the beacons that a log detects."""
    if log.waveform is None:
        assert log.fields is not None
        strong = above_noise(log.fields, DETECTION_CHI_SQUARE_ONLINE)
        return beacons_of(site, np.any(strong, axis=0))
    receiver = receiver_of(site, settings)
    assert isinstance(receiver, LockinReceiver)
    samples = receiver.sent(log.waveform, log.imu)
    if not tones_of(site).reused:
        strong = above_noise(samples, DETECTION_CHI_SQUARE_ONLINE)
        return beacons_of(site, np.any(strong, axis=0))
    way = way_of(samples, site)
    place, margin = way.at(way.time)
    largest = np.max(largest_fields(site, place, margin[:, None]), axis=0)
    sigma = phasor_sigma(site, float(np.median(samples.window)))
    return beacons_of(site, np.asarray(largest > DETECTION_SIGMAS * sigma))
