"""Sites with scaled beacon moments, which an estimator creates at every step."""

from collections.abc import Mapping
from dataclasses import replace

from magfusion.model.coil_field import keep_sources
from magfusion.model.site import Beacon, Site
from magfusion.units import Array


def with_moments(site: Site, moments_beacon: Mapping[str, Array]) -> Site:
    """Return the site with scaled moments of some beacons.

    Parameters
    ----------
    moments_beacon : mapping of str to ndarray, shape (coils, 3)
        By beacon name, in the same direction (A m^2).
    """
    beacons = tuple(
        _changed(beacon, moments_beacon[beacon.name]) if beacon.name in moments_beacon else beacon
        for beacon in site.beacons
    )
    other = replace(site, beacons=beacons)
    keep_sources(site, other)
    return other


def _changed(beacon: Beacon, moments_beacon: Array) -> Beacon:
    pairs = zip(beacon.coils, moments_beacon, strict=True)
    return replace(
        beacon, coils=tuple(replace(coil, moment_beacon=moment) for coil, moment in pairs)
    )
