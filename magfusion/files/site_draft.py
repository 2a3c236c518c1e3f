"""A site that is being described: values given by its author, without assumptions for the rest."""

import math
from dataclasses import dataclass
from itertools import permutations

from magfusion.errors import InputError

KEYS = ("position_m", "rpy_deg", "frequency_hz", "moment_a_m2", "axes", "radius_m", "synchronised")
EXAMPLE = "'A position_m=0,0,1 rpy_deg=0,0,90 frequency_hz=25 moment_a_m2=220 axes=xy'"
_TRUTHS = {"yes": True, "true": True, "no": False, "false": False}
# Of one coil, two or three, each with an axis of its own.
_COILS = {"".join(axes) for n in (1, 2, 3) for axes in permutations("xyz", n)}
UNKNOWN = "unknown"

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class BeaconDraft:
    """Given values of a beacon; None for others."""

    name: str
    position_m: Numbers | None = None
    rpy_deg: Numbers | None = None
    # frequency_hz, moment_a_m2: one for all coils, or one a coil
    frequency_hz: Numbers | None = None
    moment_a_m2: Numbers | None = None
    # beacon axis of each coil, as ``xy``; the second of two runs a quarter period behind
    axes: str | None = None
    radius_m: float | None = None  # of every coil
    synchronised: bool | None = None

    @property
    def unknown(self) -> str | None:
        """What of its pose was not surveyed, as a site has it."""
        if self.position_m is None:
            return "pose" if self.rpy_deg is None else "position"
        return "attitude" if self.rpy_deg is None else None


@dataclass(frozen=True)
class Place:
    """Where and when, for gravity and the Earth's field; the height is above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    date: str


def beacon_draft(text: str) -> BeaconDraft:
    """Read the given values of a beacon: its name, and ``key=value`` with the keys of a site.

    Raises InputError where a key is unknown or its value is none, with an example.
    """
    named, *parts = text.split() or [""]
    name = named.removeprefix("name=")
    where = f"--beacon {text!r}"
    if not name or "=" in name:
        raise InputError(f"{where}: begin with the beacon's name, as in {EXAMPLE}")
    declared: dict[str, str] = {}
    for part in parts:
        key, equals, value = part.partition("=")
        if not equals or not value:
            raise InputError(
                f"{where}: {part!r} is no key=value; write no blanks about = and commas, as in"
                f" {EXAMPLE}"
            )
        if key not in KEYS:
            raise InputError(f"{where}: {key} is not a known key; write one of {', '.join(KEYS)}")
        if key in declared:
            raise InputError(f"{where}: {key} is given twice; keep one")
        declared[key] = value
    draft = BeaconDraft(
        name,
        position_m=_vector(where, "position_m", declared),
        rpy_deg=_vector(where, "rpy_deg", declared),
        frequency_hz=_numbers(where, "frequency_hz", declared),
        moment_a_m2=_numbers(where, "moment_a_m2", declared),
        axes=declared.get("axes"),
        radius_m=None
        if "radius_m" not in declared
        else numbers(where, declared["radius_m"], (1,))[0],
        synchronised=_truth(where, declared.get("synchronised")),
    )
    _check_coils(where, draft)
    return draft


def _check_coils(where: str, draft: BeaconDraft) -> None:
    axes = draft.axes
    if axes is not None and axes not in _COILS:
        raise InputError(
            f"{where}: axes={axes}: write the beacon axis of each coil once: x for a single coil,"
            " xy for two that rotate the field, xyz for three"
        )
    for key in ("frequency_hz", "moment_a_m2"):
        count = len(getattr(draft, key) or (0,))
        if count > 1 and count != len(axes or ""):
            raise InputError(
                f"{where}: {key} holds {count} numbers for {len(axes or '')} axes; give one for"
                " all, or one for each of axes"
            )
    if axes is not None and len(axes) == 3 and len(draft.frequency_hz or (0,)) == 1:
        raise InputError(
            f"{where}: three coils of one frequency cannot be separated; give frequency_hz for"
            " each, as in frequency_hz=20,25,30"
        )


def _vector(where: str, key: str, text: dict[str, str]) -> Numbers | None:
    if text.get(key, UNKNOWN) == UNKNOWN:
        return None
    return numbers(f"{where}: {key}", text[key], (3,))


def _numbers(where: str, key: str, text: dict[str, str]) -> Numbers | None:
    if key not in text:
        return None
    result = numbers(f"{where}: {key}", text[key], (1, 2, 3))
    if min(result) <= 0.0:
        raise InputError(f"{where}: {key}={text[key]}: it must be above zero")
    return result


def _truth(where: str, value: str | None) -> bool | None:
    if value is None:
        return None
    if value.lower() not in _TRUTHS:
        raise InputError(f"{where}: synchronised={value}: write yes or no")
    return _TRUTHS[value.lower()]


def numbers(where: str, text: str, counts: tuple[int, ...]) -> Numbers:
    """Read numbers between commas.

    Raises InputError where one is none, or their count is not among those wanted.
    """
    try:
        result = tuple(float(part) for part in text.strip("[]()").split(","))
    except ValueError:
        result = ()
    if len(result) not in counts or not all(map(math.isfinite, result)):
        wanted = " or ".join(map(str, counts))
        raise InputError(
            f"{where}: found {text!r}; write {wanted} number{'s' if counts != (1,) else ''},"
            " separated by commas without blanks"
        )
    return result


def place_of(text: str) -> Place:
    """Read ``LAT,LON,HEIGHT,DATE``."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 4:
        raise InputError(
            f"--location {text!r}: write LATITUDE,LONGITUDE,HEIGHT,DATE in degrees, metres and"
            " YYYY-MM-DD, as in 47.37,8.55,408,2026-03-01"
        )
    latitude, longitude, height = numbers("--location", ",".join(parts[:3]), (3,))
    return Place(latitude, longitude, height, parts[3])
