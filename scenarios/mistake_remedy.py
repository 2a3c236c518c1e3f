"""A remedy of a report, followed: keys of the site's file are set to its values."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml


def set_key(entry: Any, key: str, value: object) -> None:
    """Set a key such as ``beacons[0].position_m`` of a site's content; None removes it."""
    *path, last = re.findall(r"[^.\[\]]+", key)
    for name in path:
        entry = entry[int(name)] if isinstance(entry, list) else entry.setdefault(name, {})
    if value is None:
        del entry[last]
    else:
        entry[int(last) if isinstance(entry, list) else last] = value


def follow_remedy(site: Path, remedy: Mapping[str, object], place: Path) -> None:
    """Write the site's file with a remedy to another place."""
    entry = yaml.safe_load(site.read_text(encoding="utf-8"))
    for key, value in remedy.items():
        set_key(entry, key, value)
    place.write_text(yaml.safe_dump(entry), encoding="utf-8")
