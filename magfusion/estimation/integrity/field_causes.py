"""What people get wrong of beacons and magnetometer, tried on snapshots of the fields."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.corrected_site import with_magnetometer
from magfusion.estimation.integrity.explanation import Explanation
from magfusion.estimation.integrity.field_snapshots import Snapshots
from magfusion.estimation.solve.bounded import minimise_bounded
from magfusion.model.response import FrequencyResponse
from magfusion.model.site import Beacon, Coil, Site
from magfusion.units import DEGREE, Array

GROSS = 4.0  # chi square over its freedom, below which no mistake in all beacons is sought
SCREENED = 6  # epochs on which each is tried
KEPT = 4  # of them, tried on all epochs
MAX_PERMUTED = 5  # beacons, of which three may be permuted in 20 ways
CORNERS = 12  # corner frequencies of a low-pass that are tried
REACH = 1.0  # of the logarithm of a corner frequency, and of a delay in its radians
REFINED = 1e-4  # of the logarithm of chi square; a step that decreases it by less is the last
# What the declared moments are too large by: a unit or a convention.
MOMENT_FACTORS = {
    "amplitudes were declared as rms values": np.sqrt(0.5),
    "rms values were declared as amplitudes times the root of two": np.sqrt(2.0),
    "peak-to-peak values were declared as amplitudes": 2.0,
    "half of the amplitudes was declared": 0.5,
    "their unit is larger by a thousand": 1e-3,
    "their unit is smaller by a thousand (mA m^2)": 1e3,
    "their unit is smaller by ten thousand (A cm^2)": 1e4,
    "a tenth of the moments was declared": 0.1,
    "ten times the moments were declared": 10.0,
    "a hundredth of the moments was declared (turns?)": 0.01,
    "a hundred times the moments were declared": 100.0,
}
LENGTH_FACTORS = {
    "they are in feet": 0.3048,
    "they are in metres and were taken for feet": 1.0 / 0.3048,
    "they are in centimetres": 0.01,
    "they are in millimetres": 0.001,
    "they are in metres and were divided by a hundred": 100.0,
    "they are in inches": 0.0254,
}


class Way(NamedTuple):
    """A site in which a mistake is corrected."""

    code: str
    cause: str
    remedy: str
    site: Site
    # the same for another size (2,) of the mistake, relative to this one
    by_size: "Callable[[Array], Way] | None" = None


def global_causes(known: Snapshots) -> Iterator[Explanation]:
    """Yield what a mistake in all beacons at once would explain.

    All of them are tried on a few epochs, and the best on all.
    """
    if known.chi_square < GROSS * known.freedom:
        return  # such mistakes leave more
    few = known.some(SCREENED)
    inverted = replace(few.samples, phasor_sensor=-few.samples.phasor_sensor)
    tried = [(few.of(way.site), way) for way in _ways(known.site)]
    tried.append((replace(few, samples=inverted), Way(*left_handed(), known.site)))
    for one, way in sorted(tried, key=lambda pair: pair[0].chi_square)[:KEPT]:
        if one.chi_square >= few.chi_square:
            return  # even at the nearest size tried, a true mistake explains more than none
        way = _refined(few, way)
        whole = known.of(way.site)
        if one.samples is inverted:
            whole = replace(
                one, samples=replace(known.samples, phasor_sensor=-known.samples.phasor_sensor)
            )
        yield Explanation(
            way.code,
            way.cause,
            way.remedy,
            known.chi_square,
            whole.chi_square,
            known.freedom,
            0 if way.by_size is None else 2,
            site=None if one.samples is inverted else way.site,
        )


def _refined(few: Snapshots, way: Way) -> Way:
    """Return a mistake of the size that explains some epochs best."""
    if way.by_size is None:
        return way
    by_size = way.by_size

    def cost(size: Array) -> float:
        return float(np.log(few.of(by_size(size).site).chi_square))

    limits = np.array([[-REACH, REACH]] * 2)
    return by_size(minimise_bounded(cost, np.zeros(2), limits, decrease=REFINED))


def length_cause(words: str) -> tuple[str, str, str]:
    """Return code, cause and remedy of another unit of lengths."""
    return (
        "length_units",
        f"the positions of the beacons have another unit: {words}",
        "Give position_m in metres.",
    )


def in_other_unit(site: Site, words: str) -> Site:
    """Return a site whose positions were in one of `LENGTH_FACTORS`."""
    return _every(site, partial(_placed, axes=LENGTH_FACTORS[words] * np.eye(3)))


def left_handed() -> tuple[str, str, str]:
    """Return code, cause and remedy of axes of which one has the wrong sign."""
    return (
        "magnetometer_axes",
        "the magnetometer's axes are left-handed (one has the wrong sign, or two are exchanged)"
        " or every coil is wired in reverse",
        "Check the sign and the order of the magnetometer's axes.",
    )


def _ways(site: Site) -> Iterator[Way]:
    yield Way(
        "phase_sign",
        "the sign of the drive phases is wrong in every beacon",
        "Change the sign of phase_deg of all coils.",
        _every(site, partial(_phases, factor=-1.0)),
    )
    if any(len(beacon.coils) > 1 for beacon in site.beacons):
        yield Way(
            "coils_swapped",
            "the coils of every beacon are exchanged",
            "Exchange the moments of the coils of each beacon.",
            _every(site, coils_exchanged),
        )
    for words, factor in (
        ("degrees were declared that are radians", 1.0 / DEGREE),
        ("radians were declared in the place of degrees", DEGREE),
    ):
        yield Way(
            "phase_units",
            f"the drive phases have another unit: {words}",
            "Give phase_deg in degrees.",
            _every(site, partial(_phases, factor=1.0 / factor)),
        )
        yield Way(
            "angle_units",
            f"the attitudes of the beacons have another unit: {words}",
            "Give rpy_deg in degrees.",
            _every(site, partial(_angles, factor=1.0 / factor)),
        )
    yield Way(
        "angle_convention",
        "the attitudes of the beacons are inverted (beacon from world)",
        "Give rpy_deg as of world_from_beacon.",
        _every(site, lambda b: replace(b, world_from_beacon=b.world_from_beacon.T)),
    )
    yield Way(
        "angle_convention",
        "the angles of the beacons are applied in the other order",
        "Give rpy_deg as R = Rz(yaw) Ry(pitch) Rx(roll).",
        _every(site, _other_order),
    )
    for words, factor in MOMENT_FACTORS.items():
        yield Way(
            "moment_units",
            f"the moments are wrong by a factor of {1.0 / factor:.4g}: {words}",
            "Give moment_a_m2 as amplitudes in A m^2.",
            _every(site, partial(scaled, factor=1.0 / factor)),
        )
    for words in LENGTH_FACTORS:
        yield Way(*length_cause(words), in_other_unit(site, words))
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        yield Way(
            "angle_convention",
            f"the sign of the {name} of all beacons is reversed",
            "Give rpy_deg as R = Rz(yaw) Ry(pitch) Rx(roll), right-handed angles.",
            _every(site, partial(_sign_changed, axis=axis)),
        )
    yield from _low_passes(site)
    for name, change in _other_axes():
        yield Way(
            "survey_axes",
            f"the survey's axes are others: {name}",
            "Give positions in right-handed axes with z up, the same as of the attitudes.",
            _every(site, partial(_placed, axes=change)),
        )
    yield from _exchanges(site)


def _low_passes(site: Site) -> Iterator[Way]:
    """Yield sites whose magnetometer has a low-pass of first order."""
    platform = site.platform
    if platform.further or platform.magnetometer.response is not None:
        return
    tones_hz = np.unique(site.tone_frequencies_hz)
    tones_hz = tones_hz[tones_hz > 0.0]
    if not len(tones_hz):
        return
    for corner_hz in np.geomspace(0.2 * tones_hz[0], 10.0 * tones_hz[-1], CORNERS).tolist():
        yield low_pass(site, tones_hz, corner_hz, np.zeros(2))


def low_pass(site: Site, tones_hz: Array, near_hz: float, size: Array) -> Way:
    """Return a site whose magnetometer has a low-pass of first order, and a delay.

    `near_hz`: corner frequency (Hz) that the size refers to. `size` (2,): logarithm of the corner's
    ratio to that, and the delay in its radians.
    """
    corner_hz = near_hz * float(np.exp(size[0]))
    share = tones_hz / corner_hz
    phase = -np.arctan(share) - float(size[1]) * tones_hz / near_hz
    response = FrequencyResponse(tones_hz, 1.0 / np.hypot(1.0, share), phase)
    return Way(
        "low_pass",
        f"the magnetometer has a low-pass filter with a corner at {corner_hz:.3g} Hz",
        "Declare platform.magnetometer.response, or record without the filter.",
        with_magnetometer(site, response=response),
        partial(low_pass, site, tones_hz, near_hz),
    )


def _other_axes() -> Iterator[tuple[str, Array]]:
    for i, axis in enumerate("xyz"):
        flip = np.eye(3)
        flip[i, i] = -1.0
        yield f"{axis} points the other way", flip
    for i, j in combinations(range(3), 2):
        order = [0, 1, 2]
        order[i], order[j] = j, i
        yield f"{'xyz'[i]} and {'xyz'[j]} are exchanged", np.eye(3)[order]


def _exchanges(site: Site) -> Iterator[Way]:
    """Yield sites in which two beacons, or three in turn, are taken for each other."""
    count = len(site.beacons)
    orders: list[tuple[int, ...]] = [*combinations(range(count), 2)]
    if count <= MAX_PERMUTED:
        for i, j, k in combinations(range(count), 3):
            orders += [(i, j, k), (i, k, j)]
    pose: tuple[str, ...] = ("position_world", "world_from_beacon")
    for order in orders:
        names = _listed([site.beacons[k].name for k in order])
        ways = {f"beacons {names} are exchanged (or their frequencies are)": pose}
        if _differ_in_moments([site.beacons[k] for k in order]):
            ways[f"the frequencies of beacons {names} are exchanged"] = (*pose, "coils")
        if len(order) == 2:
            ways[f"the positions of beacons {names} are exchanged"] = pose[:1]
            ways[f"the attitudes of beacons {names} are exchanged"] = pose[1:]
        for cause, fields in ways.items():
            beacons = list(site.beacons)
            for here, there in zip(order, (*order[1:], order[0]), strict=True):
                other = site.beacons[there]
                beacons[here] = replace(
                    beacons[here], **{name: getattr(other, name) for name in fields}
                )
            yield Way(
                "beacons_swapped",
                cause,
                "Check which beacon is where, and at which frequency.",
                replace(site, beacons=tuple(beacons)),
            )


def _differ_in_moments(beacons: Sequence[Beacon]) -> bool:
    """Return whether coils of beacons have other moments, at tones that differ in the same way."""
    kinds = {tuple((coil.frequency_hz, coil.slot) for coil in one.coils) for one in beacons}
    first, *others = beacons
    return len(kinds) == 1 and any(
        not np.array_equal(first.moments_beacon, other.moments_beacon) for other in others
    )


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _every(site: Site, change: Callable[[Beacon], Beacon]) -> Site:
    return replace(site, beacons=tuple(change(beacon) for beacon in site.beacons))


def _coils(beacon: Beacon, change: Callable[[Coil], Coil]) -> Beacon:
    return replace(beacon, coils=tuple(change(coil) for coil in beacon.coils))


def _phases(beacon: Beacon, factor: float) -> Beacon:
    return _coils(beacon, lambda coil: replace(coil, phase=factor * coil.phase))


def _placed(beacon: Beacon, axes: Array) -> Beacon:
    return replace(beacon, position_world=axes @ beacon.position_world)


def scaled(beacon: Beacon, factor: float) -> Beacon:
    """Return a beacon of other strength."""
    return _coils(beacon, lambda c: replace(c, moment_beacon=factor * c.moment_beacon))


def coils_exchanged(beacon: Beacon) -> Beacon:
    """Return a beacon whose first two coils have each other's moment."""
    if len(beacon.coils) < 2:
        return beacon
    first, second, *rest = beacon.coils
    return replace(
        beacon,
        coils=(
            replace(first, moment_beacon=second.moment_beacon),
            replace(second, moment_beacon=first.moment_beacon),
            *rest,
        ),
    )


def _angles(beacon: Beacon, factor: float) -> Beacon:
    """Return a beacon whose roll, pitch and yaw are multiplied."""
    angles = Rotation.from_matrix(beacon.world_from_beacon).as_euler("xyz")
    rotated = Rotation.from_euler("xyz", factor * angles).as_matrix()
    return replace(beacon, world_from_beacon=rotated)


def _sign_changed(beacon: Beacon, axis: int) -> Beacon:
    angles = Rotation.from_matrix(beacon.world_from_beacon).as_euler("xyz")
    angles[axis] = -angles[axis]
    return replace(beacon, world_from_beacon=Rotation.from_euler("xyz", angles).as_matrix())


def _other_order(beacon: Beacon) -> Beacon:
    angles = Rotation.from_matrix(beacon.world_from_beacon).as_euler("xyz")
    return replace(beacon, world_from_beacon=Rotation.from_euler("XYZ", angles).as_matrix())
