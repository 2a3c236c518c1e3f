"""Parameters of a beacon: pose, moment, and drive."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np

from magfusion.model.coil_field import keep_sources
from magfusion.model.parameters.parameter import (
    AXES,
    CENTIMETRE,
    DEGREES,
    METRE,
    PERCENT,
    PPM,
    Calibration,
    Parameter,
    PhasorView,
    SiteParameter,
)
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, BoolArray, ComplexArray

PHASE_SIGMA = 1e2  # rad; wide enough to be no information


class BeaconParameter(Parameter):
    """A parameter of every beacon; its owners are the beacons' names."""

    def part(self, site: Site, owner: str) -> Beacon:
        """Return the beacon."""
        return next(b for b in site.beacons if b.name == owner)

    def with_part(self, site: Site, part: Beacon) -> Site:
        """Return the site with the beacon of that name replaced."""
        return replace(
            site, beacons=tuple(part if b.name == part.name else b for b in site.beacons)
        )

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return the columns of the owner's phasors; it does not affect the others'."""
        return self.own_jacobian(view) if view.beacon.name == owner else None

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        """Return the columns of the owner's phasors."""
        raise NotImplementedError


class _Rotation(BeaconParameter, SiteParameter):
    group, kind, components = "beacons", "rotation", AXES
    attribute, sigma_attribute, is_rotation = "world_from_beacon", "rotation_beacon", True
    unit = display_unit = DEGREES
    words = "the turn of beacon {owner} about its {axis}"
    negligible = 1.75e-3
    field_error = 2.0

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        return view.whole.beacon_pose[..., :3]


class _Position(BeaconParameter, SiteParameter):
    group, kind, components = "beacons", "position", AXES
    attribute = sigma_attribute = "position_world"
    unit, display_unit = METRE, CENTIMETRE
    words = ("x of beacon {owner}", "y of beacon {owner}", "the height of beacon {owner}")
    negligible = 2e-3
    field_error, falls = 9.0, 2  # the field falls with the cube of the distance

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        return view.whole.beacon_pose[..., 3:] @ view.beacon.world_from_beacon.T


class _LogMoment(BeaconParameter, SiteParameter):
    group, kind, sigma_attribute = "moments", "log_moment", "log_moment"
    display_unit = PERCENT
    negligible = 2e-3
    field_error = 1.0
    walk = "clock.log_moment_walk"

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        return self.all_moved(calibration, {owner: step})

    def all_moved(self, calibration: Calibration, steps: Mapping[str, Array]) -> Calibration:
        site = calibration.site
        moments = {
            beacon.name: beacon.moments_beacon * np.exp(steps[beacon.name])[:, None]
            for beacon in site.beacons
            if beacon.name in steps
        }
        return replace(calibration, site=with_moments(site, moments))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        (step,) = self.all_differences(old, new, [owner])
        return step

    def all_differences(
        self, old: Calibration, new: Calibration, owners: Sequence[str]
    ) -> list[Array]:
        was, now = ({b.name: b.moments_beacon for b in c.site.beacons} for c in (old, new))
        before = [was[owner] for owner in owners]
        sizes = (
            np.sqrt(np.einsum("ij,ij->i", each, each))
            for each in (np.concatenate([now[owner] for owner in owners]), np.concatenate(before))
        )
        steps = np.log(np.divide(*sizes))
        ends = np.cumsum([len(own) for own in before]).tolist()
        return [steps[end - len(own) : end] for own, end in zip(before, ends, strict=True)]

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        return view.whole.log_moments

    def called(self, site: Site, owner: str, i: int) -> str:
        coil = f"coil {i} of " if len(self.part(site, owner).coils) > 1 else ""
        return f"the moment of {coil}beacon {owner}"


def with_moments(site: Site, moments_beacon: Mapping[str, Array]) -> Site:
    """Return the site with scaled moments of some beacons, as an estimator does at every step.

    `moments_beacon` (coils, 3) each: by beacon name, in the same direction (A m^2).
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


class _OfDrive(BeaconParameter):
    """A parameter of the log: some entries of an array of the calibration."""

    of_log = each_log = factor_of_phasor = True
    attribute: ClassVar[str]

    def names(self, site: Site) -> tuple[str, ...]:
        """Return the owner of each entry; here one per channel."""
        return tuple([name for name, _ in site.channels])

    def copies(self, site: Site) -> int:
        """Return how often the array repeats it: once per magnetometer for channels."""
        return len(site.platform.magnetometers)

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        return self.all_moved(calibration, {owner: step})

    def all_moved(self, calibration: Calibration, steps: Mapping[str, Array]) -> Calibration:
        value, names = getattr(calibration, self.attribute).copy(), self.names(calibration.site)
        for owner, step in steps.items():
            mine = _named(names, owner)
            value[mine] += step if len(step) == 1 else np.resize(step, np.count_nonzero(mine))
        return replace(calibration, **{self.attribute: value})

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        (step,) = self.all_differences(old, new, [owner])
        return step

    def all_differences(
        self, old: Calibration, new: Calibration, owners: Sequence[str]
    ) -> list[Array]:
        change = getattr(new, self.attribute) - getattr(old, self.attribute)
        copies, names = self.copies(old.site), self.names(old.site)
        every = (change[_named(names, owner)] for owner in owners)
        return [mine[: len(mine) // copies] for mine in every]


class _Phase(_OfDrive):
    group = kind = attribute = "phase"
    unit = display_unit = DEGREES
    words = "the drive phase of beacon {owner}"
    walk = "clock.phase_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        beacon = self.part(site, owner)
        return np.full(len(beacon.tones), 0.0 if beacon.synchronised else PHASE_SIGMA)

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        return 1j * view.phasor[..., None] * np.eye(len(view.beacon.tones))[:, None, :]


class _Drift(_OfDrive):
    group, kind, attribute = "phase", "drift", "drift"
    unit = display_unit = PPM
    words = "the clock of beacon {owner}"
    walk = "clock.drift_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array(
            [0.0 if self.part(site, owner).synchronised else site.relative_clock.drift_sigma]
        )

    def names(self, site: Site) -> tuple[str, ...]:
        return tuple([beacon.name for beacon in site.beacons])

    def copies(self, site: Site) -> int:
        return 1

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        turns = 2.0 * np.pi * view.beacon.tone_frequencies_hz[:, None]
        return (1j * view.phasor * (turns * view.elapsed[:, None, None]))[..., None]

    def drags(
        self, calibration: Calibration, owner: str, time: float
    ) -> tuple[Parameter, Array] | None:
        # A change of frequency now does not change the phase accumulated so far: the phase at the
        # reference time is reduced by what the new frequency would have added.
        tones = self.part(calibration.site, owner).tone_frequencies_hz
        return PHASE, -2.0 * np.pi * tones[:, None] * (time - calibration.reference_time)


class _Gain(_OfDrive):
    """Factor of all phasors of a beacon; estimated with a pose, never part of a site."""

    group, kind, attribute = "gain", "gain", "log_gain"

    def all_differences(
        self, old: Calibration, new: Calibration, owners: Sequence[str]
    ) -> list[Array]:
        return [step[:1] for step in super().all_differences(old, new, owners)]

    def own_jacobian(self, view: PhasorView) -> ComplexArray:
        return view.phasor[..., None]


@lru_cache(maxsize=1024)
def _named(names: tuple[str, ...], owner: str) -> BoolArray:
    """Return which names are the owner's; sites that differ in numbers only share names."""
    mine = np.array([name == owner for name in names], dtype=bool)
    mine.flags.writeable = False
    return mine


BEACON_ROTATION, BEACON_POSITION, LOG_MOMENT = _Rotation(), _Position(), _LogMoment()
PHASE, DRIFT, GAIN = _Phase(), _Drift(), _Gain()
