"""The user's constraint on the magnetometer's position, as on the command line."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.model.region import Region
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.model.site import Site

MAX_COORDINATE = 1e6  # m


@dataclass(frozen=True)
class Where:
    """The user's constraint on the position, in addition to the site's."""

    hemisphere: tuple[str, ...] = ()  # ``[BEACON=]DIRECTION`` each
    region: str | None = None  # ``xmin,xmax,ymin,ymax,zmin,zmax``

    def bounded(self, site: Site) -> Site:
        """Return the site with the constraints."""
        for text in self.hemisphere:
            site = _in_front(site, text)
        if self.region is None:
            return site
        box, earlier = _box(self.region), site.region or Region()
        return dataclasses.replace(site, region=dataclasses.replace(earlier, box_world=box))


ANYWHERE = Where()


def _in_front(site: Site, text: str) -> Site:
    name, equals, direction = text.rpartition("=")
    known = [beacon.name for beacon in site.beacons]
    if equals and name not in known:
        raise InputError(
            f"--hemisphere {text!r}: the site has no beacon {name!r}; it has {', '.join(known)}"
        )
    if not equals and len(known) != 1:
        raise InputError(
            f"--hemisphere {text!r}: the site has {len(known)} beacons; specify one, e.g."
            f" --hemisphere {known[0] if known else 'A'}={text}"
        )
    side = _direction(direction, text)
    beacons = tuple(
        dataclasses.replace(beacon, hemisphere_beacon=side)
        if beacon.name == (name if equals else known[0])
        else beacon
        for beacon in site.beacons
    )
    return dataclasses.replace(site, beacons=beacons)


def _direction(direction: str, text: str) -> Array:
    if len(direction) == 2 and direction[0] in "+-" and direction[1] in "xyz":
        sign = 1.0 if direction[0] == "+" else -1.0
        return np.asarray(sign * np.eye(3)["xyz".index(direction[1])])
    try:
        numbers = np.array([float(part) for part in direction.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers)) or not numbers.any():
        raise InputError(
            f"--hemisphere {text!r}: a direction is one of +x, -x, +y, -y, +z, -z, or three numbers"
            " in the beacon's axes, separated by commas"
        )
    return numbers


def _box(text: str) -> Array:
    try:
        box = np.array([float(part) for part in text.split(",")]).reshape(3, 2).T
    except ValueError:
        raise InputError(
            f"--region {text!r}: give six numbers in metres, the limits of x, y and z; inf for no"
            " limit"
        ) from None
    limits = box[np.isfinite(box)]
    if np.any(np.isnan(box)) or not np.all(box[0] < box[1]) or not len(limits):
        raise InputError(
            f"--region {text!r}: each lower limit must be below its upper limit, and one finite"
        )
    if np.max(np.abs(limits)) > MAX_COORDINATE:
        raise InputError(
            f"--region {text!r}: limits must lie within {MAX_COORDINATE:g} m of the origin"
        )
    return box
