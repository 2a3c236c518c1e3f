"""Input checks for beacons that are magnets on shafts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from magfusion.errors import InputError
from magfusion.files.drive_columns import beacon_of
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site

if TYPE_CHECKING:
    from magfusion.files.records import Record

MAX_WAIT = 2.0  # s of samples in a stream, after which the angle of a rotor is missed
ALL = ""  # as the name of a current that flows through the coils of all


def is_for_ranging(site: Site) -> bool:
    """Return whether a site has a magnet on a shaft to be located from another well."""
    return (
        len(site.beacons) == 1
        and site.beacons[0].rotor is not None
        and site.beacons[0].unknown == "pose"
    )


def check_rotors(place: Path, log_path: Path, log: Log, site: Site, *, separately: bool) -> None:
    """Reject rotors without a required angle, and sites for ranging only.

    `place`: file of the site. `separately`: whether each epoch may have a separate phase.
    """
    if is_for_ranging(site):
        raise InputError(
            f"{place}: beacons[0]: the pose of rotor {site.beacons[0].name} is unknown, and it is"
            " the only beacon; use magfusion range to locate the sensor's well relative to the"
            " magnet's"
        )
    if site.platform.magnetometer.casing is not None:
        raise InputError(
            f"{place}: platform.magnetometer.casing: only magfusion range supports a sensor in"
            " steel casing; omit it for other commands"
        )
    raw = log.waveform is not None or bool(log.waveforms)
    recorded = set[str]() if log.rotation is None else set(log.rotation.angle)
    recorded |= set[str]() if log.drive is None else set(log.drive.current)
    for beacon in _wandering(site):
        if beacon.name in recorded or ALL in recorded:
            continue
        remedy = (
            f"add the angle of its shaft as rotor_{beacon.name} to magnetometer.parquet, declare"
            " speed_sigma_hz of a clocked shaft"
        )
        if beacon.synchronised and raw:
            raise InputError(
                f"{place}: rotor of beacon {beacon.name}: is synchronised, but {log_path} has no"
                f" rotor angle; {remedy}, or write synchronised: false for magfusion fix"
            )
        if not beacon.synchronised and not separately:
            raise InputError(
                f"{place}: rotor of beacon {beacon.name}: its angle is not measured, and its speed"
                f" drifts more than a clock's; {remedy}, or fix each epoch on its own with"
                " magfusion fix"
            )


def check_streamed_rotors(place: Path, site: Site) -> None:
    """Reject rotors whose angle cannot be known from a stream."""
    for beacon in _wandering(site):
        if not beacon.synchronised:
            raise InputError(
                f"{place}: rotor of beacon {beacon.name}: online its angle must be measured; write"
                " synchronised: true, and send the cosine of its angle in records of drive"
            )


class AwaitedAngles:
    """Monitor of missing rotor angles in a stream."""

    def __init__(self, site: Site) -> None:
        self._awaited = {beacon.name for beacon in _wandering(site)}
        self._first: float | None = None

    def see(self, record: Record | None) -> None:
        """Check a record.

        Raises InputError where samples have arrived for some time without an angle.
        """
        if record is None or not self._awaited:
            return
        if record.drive is not None:
            names = {beacon_of(column) for column in record.drive.current}
            self._awaited = set() if ALL in names else self._awaited - names
        if record.magnetometer is None or not len(record.magnetometer.time):
            return
        if self._first is None:
            self._first = float(record.magnetometer.time[0])
        if self._awaited and float(record.magnetometer.time[-1]) > self._first + MAX_WAIT:
            name = min(self._awaited)
            raise InputError(
                f"standard input: {MAX_WAIT:g} s of samples without a record of drive with"
                f" drive_{name}: beacon {name} is a rotor; send the cosine of its angle with the"
                " samples"
            )


def _wandering(site: Site) -> list[Beacon]:
    """Return the rotors whose speed drifts more than the search range of a clock."""
    return [
        beacon
        for beacon in site.beacons
        if beacon.rotor is not None
        and beacon.rotor.speed_sigma_hz > site.relative_clock.drift_largest * beacon.frequency_hz
    ]
