"""Differences between sites: by the keys of their files, and as the content of a checkpoint."""

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

    The values are those of the second site; None for a key that it does not have.
    """
    old, new = (_flat(site_content(site)) for site in (before, after))
    return {key: new.get(key) for key in {**old, **new} if old.get(key) != new.get(key)}


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


def _flat(entry: Any, key: str = "") -> dict[str, Any]:
    """Return the values of nested mappings, and of lists of mappings, by their key."""
    if isinstance(entry, dict):
        parts = {f"{key}.{name}" if key else name: value for name, value in entry.items()}
    elif isinstance(entry, list) and entry and isinstance(entry[0], dict):
        parts = {f"{key}[{i}]": value for i, value in enumerate(entry)}
    else:
        return {key: entry}
    return {
        name: value for part, inner in parts.items() for name, value in _flat(inner, part).items()
    }
