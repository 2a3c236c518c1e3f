"""Mistakes of the world: something is there, or happens, that the site's file does not declare."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import Case, Change, Mistake, again, beacon_waveform, of_waveform
from scipy.spatial.transform import Rotation

from magfusion.model.site import Beacon
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.disturbance import Ambient, FieldDrift, Spheres
from magfusion.simulation.rails import laid, rails_option
from magfusion.simulation.waveform import Mains
from magfusion.units import Array

_PLACES = np.array([[1.9, 0.2, 0.9], [4.4, 4.6, 1.1], [0.3, 3.0, 1.2], [5.6, 2.2, 0.8]])  # m

_TRACK = "0.05:-3,0.6,0.3:12,0.6,0.3;0.05:-3,0.6,1.8:12,0.6,1.8"
_CASING = "0.1/0.008:3,4.3,-4:3,4.3,4"


def _iron(radius: float) -> Change:
    """Return steel spheres around the room, a half metre from where the platform moves."""
    count = len(_PLACES)
    spheres = Spheres(_PLACES, np.full(count, radius), np.full(count, 100.0), np.full(count, 5e6))
    return lambda case: again(case, ambient=Ambient(spheres=spheres))


def _rails(text: str) -> Change:
    """Return bars and tubes of steel, as `magfusion simulate --rails` takes them."""

    def changed(case: Case) -> Case:
        beacons_world = np.array([beacon.position_world for beacon in case.site.beacons])
        return again(
            case, ambient=Ambient(rails=laid(rails_option(text), DEMO_BOX_WORLD, beacons_world))
        )

    return changed


def _false(name: str, gain: Callable[[Array], Array]) -> Change:
    """Return a beacon whose field is false by a share that changes in time."""

    def changed(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        return time, measured + gain(time)[:, None] * beacon_waveform(case, name)

    return of_waveform(changed)


def _during(share: float, begin: float = 12.0, end: float = 27.0) -> Callable[[Array], Array]:
    return lambda time: share * ((time >= begin) & (time < end))


def _line(frequency_hz: float, amplitude: float) -> Change:
    direction = Rotation.from_rotvec([0.3, 0.5, 0.0]).apply([0.0, 0.0, 1.0])
    mains = Mains(amplitude, frequency_hz, (), direction)
    return lambda case: again(case, mains=mains)


def _magnet_transits(_: Case, time: Array, measured: Array) -> tuple[Array, Array]:
    """Return the static field of a lift or a car that comes and goes."""
    pulse = 1e-5 * np.exp(-0.5 * ((time - 20.0) / 3.0) ** 2)
    return time, measured + pulse[:, None] * np.array([0.6, -0.5, 0.6])


def _free_running(case: Case) -> Case:
    """Return drives that run on crystals of their own, where the file declares that they do not."""
    beacons = tuple(replace(b, synchronised=False) for b in case.site.beacons)
    return again(case, replace(case.site, beacons=beacons))


def _far_away(case: Case) -> Case:
    """Return a platform 100 m from the beacons."""
    return again(case, box_world=case.config.box_world + np.array([100.0, 0.0, 0.0]))


def _at_a_coil(case: Case) -> Case:
    """Return a platform that works next to one coil, whose size is not declared."""
    first, *rest = case.site.beacons
    coils = tuple(replace(coil, radius=0.15) for coil in first.coils)
    box = first.position_world + np.array([[0.15, 0.15, 0.15], [0.6, 0.6, 0.6]])
    sized = replace(case.site, beacons=(replace(first, coils=coils), *rest))
    return again(case, sized, box_world=box)


def _all_silent(case: Case) -> Case:
    """Return beacons that are not switched on."""

    def off(beacon: Beacon) -> Beacon:
        coils = (replace(coil, moment_beacon=1e-9 * coil.moment_beacon) for coil in beacon.coils)
        return replace(beacon, coils=tuple(coils))

    return again(case, replace(case.site, beacons=tuple(map(off, case.site.beacons))))


def _earth_drifts(case: Case) -> Case:
    return again(case, ambient=Ambient(drift=FieldDrift(1e-6, 10.0)))


def _noisy(case: Case) -> Case:
    """Return a magnetometer in noise larger than all beacons' fields."""
    wave = case.waveform
    noise = case.rng.normal(0.0, 2e-5, wave.measured_sensor.shape)
    noisy = replace(wave, measured_sensor=wave.measured_sensor + noise)
    return replace(case, log=replace(case.log, waveform=noisy))


_FAULT = ("beacon_fault", "field_residuals", "beacon_excluded")
_LINE = ("undeclared_line", "mains")

MISTAKES = (
    Mistake("iron_4pct", "world", _iron(0.3), ("steel", "iron", "field_residuals")),
    Mistake("iron_10pct", "world", _iron(0.4), ("steel", "iron", "field_residuals")),
    Mistake("rails", "world", _rails(_TRACK), ("steel", "iron", "field_residuals")),
    Mistake("casing_beside", "world", _rails(_CASING), ("steel", "iron", "field_residuals")),
    Mistake("false_1pct_15s", "world", _false("B", _during(0.01)), _FAULT),
    Mistake("false_5pct_15s", "world", _false("B", _during(0.05)), _FAULT),
    Mistake("false_20pct_15s", "world", _false("B", _during(0.2)), _FAULT),
    Mistake("ramp_5pct", "world", _false("C", lambda t: 0.05 * t / 40.0), _FAULT),
    Mistake("reversed_10s", "world", _false("D", _during(-2.0, 20.0, 30.0)), _FAULT),
    Mistake(
        "silent_from_15s",
        "world",
        _false("A", _during(-1.0, 15.0, 99.0)),
        ("silent_beacon",),
        harmless=True,
    ),
    Mistake(
        "silent_always",
        "world",
        _false("A", _during(-1.0, 0.0, 99.0)),
        ("silent_beacon",),
        harmless=True,
    ),
    Mistake("all_silent", "world", _all_silent, ("silent_beacon", "low_signal")),
    Mistake("line_beside_tone", "world", _line(20.9, 2e-8), _LINE),
    Mistake("line_on_tone", "world", _line(25.05, 2e-8), (*_LINE, *_FAULT)),
    Mistake("mains_strong", "world", _line(49.7, 2e-6), _LINE, harmless=True),
    Mistake("snr_below_1", "world", _noisy, ("field_noise", "low_signal")),
    Mistake("far_away_100m", "world", _far_away, ("low_signal", "geometry")),
    Mistake("beside_a_coil", "world", _at_a_coil, ("near_field", "field_residuals", "coil_size")),
    Mistake("drives_free_running", "world", _free_running, ("beacon_clock",)),
    Mistake("earth_drifts", "world", _earth_drifts, harmless=True),
    Mistake("magnet_passes", "world", of_waveform(_magnet_transits), harmless=True),
)
