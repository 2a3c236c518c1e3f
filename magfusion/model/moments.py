"""A site whose beacons have larger or smaller moments.

An estimator moves them at every step.  What does not hang on moments is not worked out again.
"""

from collections.abc import Mapping
from typing import Any, TypeVar

from magfusion.model.coil_field import keep_sources
from magfusion.model.site import Beacon, Coil, Site
from magfusion.units import Array

Part = TypeVar("Part", Beacon, Coil, Site)


def with_moments(site: Site, moments_beacon: Mapping[str, Array]) -> Site:
    """Return the site with moments of another size of some beacons.

    Parameters
    ----------
    moments_beacon : mapping of str to ndarray, shape (coils, 3)
        By beacon's name, of the same direction (A m^2).
    """
    beacons = tuple(
        _changed(beacon, moments_beacon[beacon.name]) if beacon.name in moments_beacon else beacon
        for beacon in site.beacons
    )
    other = _keeping_known(site, beacons=beacons)
    keep_sources(site, other)
    return other


def _changed(beacon: Beacon, moments_beacon: Array) -> Beacon:
    pairs = zip(beacon.coils, moments_beacon, strict=True)
    coils = tuple(_keeping_known(coil, moment_beacon=moment) for coil, moment in pairs)
    other = _keeping_known(beacon, coils=coils, moments_beacon=moments_beacon)
    vars(other).pop("tone_moments", None)
    return other


def _keeping_known(part: Part, **changes: Any) -> Part:
    """Return a part of the site with other values, and with all that it has worked out."""
    other = object.__new__(type(part))  # a third of what `copy.copy` takes
    vars(other).update(vars(part), **changes)
    return other
