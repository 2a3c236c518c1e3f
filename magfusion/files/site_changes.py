"""Differences between sites: by the keys of their files, and as the content of a checkpoint."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from magfusion.errors import InputError
from magfusion.files.site import site_content, site_of_entry
from magfusion.files.site_schema import SiteEntry
from magfusion.model.site import Site
from magfusion.model.without_imu import on_motion_prior


def changed_keys(before: Site, after: Site) -> dict[str, Any]:
    """Return the keys of a site's file whose values differ, as ``beacons[0].position_m``.

    The values are those of the second site; None for a key that it does not have. A list of another
    length is one value.
    """
    old, new = (site_content(site) for site in (before, after))
    return dict(_changed(old, new, ""))


def with_content(site: Site, content: str) -> Site:
    """Return a site with the beacons, platform and gravity of another one's content, as JSON.

    Raises InputError where the content is invalid, or of other beacons.
    """
    try:
        other = site_of_entry(SiteEntry.model_validate_json(content), Path())
    except ValueError as error:
        raise InputError("its site is invalid; run without --resume") from error
    beacons = {beacon.name: beacon for beacon in other.beacons}
    if any(beacon.name not in beacons for beacon in site.beacons):
        raise InputError("its site has other beacons; run without --resume")
    if not site.platform.inertial:
        other = on_motion_prior(other)
    return replace(
        site,
        gravity=other.gravity,
        platform=other.platform,
        beacons=tuple(
            replace(beacons[b.name], field_map=b.field_map, steel=b.steel) for b in site.beacons
        ),
    )


def _changed(old: Any, new: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Yield key and new value of what differs in nested mappings and lists of mappings."""
    if isinstance(new, dict) and isinstance(old, dict | None):
        old = old or {}
        for name in {**old, **new}:
            inner = f"{key}.{name}" if key else name
            yield from _changed(old.get(name), new.get(name), inner)
    elif _is_of_mappings(old) and _is_of_mappings(new) and len(old) == len(new):
        for i, (before, after) in enumerate(zip(old, new, strict=True)):
            yield from _changed(before, after, f"{key}[{i}]")
    elif old != new:
        yield key, new


def _is_of_mappings(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)
