"""Beacons copied from one of the site: rotated, placed, tuned and scaled."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.site import Beacon, Site
from magfusion.receiver.windows import CLOSEST_TONES_HZ
from magfusion.units import Array

NO_MOMENT = 0.1  # of the largest; a direction with less has none


@dataclass(frozen=True, eq=False)
class ToneBand:
    """Frequency band of tones, and their spacing."""

    # low, high (Hz)
    low: float
    high: float
    # time over which tones must be separated (s): any two are two of its periods apart
    window: float
    mains_hz: float  # mains frequency whose harmonics are avoided; 0 for none

    @property
    def spacing(self) -> float:
        """Minimum distance of tones from each other, from zero and from the mains (Hz)."""
        return max(2.0 / self.window, CLOSEST_TONES_HZ)

    def allowed(self, selected: Array) -> Array:
        """Return tones separable from the used ones and from each other (Hz)."""
        step = self.spacing / 5.0
        wanted = np.arange(self.low, self.high * (1.0 + 1e-9), step)
        result: list[float] = []
        for frequency in np.round(wanted, 6).tolist():
            others = [0.0, *selected.tolist(), *result]
            if self.mains_hz:
                others.append(self.mains_hz * max(round(frequency / self.mains_hz), 1))
            nearest = min(abs(frequency - other) for other in others)
            if nearest >= self.spacing * (1.0 - 1e-9):
                result.append(frequency)
        return np.array(result)


def pattern_axis(beacon: Beacon) -> Array | None:
    """Return the axis that specifies a beacon's direction, beacon axes; None where it has none.

    Of coils in one plane its normal, about which their field rotates; of one coil its own axis; of
    coils in all three directions none.
    """
    _, size, axes = np.linalg.svd(np.vstack([beacon.moments_beacon, np.zeros((3, 3))]))
    strong = int(np.sum(size > NO_MOMENT * size[0]))
    return None if strong == 3 else np.asarray(axes[0] if strong == 1 else axes[2])


def rotated_to(beacon: Beacon, axis_world: Array) -> Beacon:
    """Return a beacon whose axis points along a unit vector, by the smallest rotation."""
    axis = pattern_axis(beacon)
    if axis is None:
        return beacon
    now = beacon.world_from_beacon @ axis
    if now @ axis_world < 0.0:
        now = -now  # the other end of the same axis
    across = np.cross(now, axis_world)
    sine = float(np.linalg.norm(across))
    if sine < 1e-12:
        return beacon
    turn = Rotation.from_rotvec(across / sine * np.arctan2(sine, now @ axis_world))
    return replace(beacon, world_from_beacon=turn.as_matrix() @ beacon.world_from_beacon)


def axes_offered(beacon: Beacon, count: int) -> Array:
    """Return the candidate directions of a beacon, shape (axes, 3), world.

    `count`: the world's axes; and the diagonals of a cube; and those of its faces.
    """
    axis = pattern_axis(beacon)
    if axis is None:
        return np.array([[0.0, 0.0, 1.0]])
    every = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    first = np.array([v[np.flatnonzero(v)[0]] > 0.0 if v.any() else False for v in every])
    half = every[first]  # of two opposite directions one
    kind = np.sum(np.abs(half), axis=1)
    wanted = {3: (1,), 7: (1, 3), 13: (1, 3, 2)}[count]
    rows = np.concatenate([half[kind == k] for k in wanted])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def stronger(beacon: Beacon, factor: float) -> Beacon:
    """Return a beacon with its moments, and currents, scaled by a factor."""
    coils = tuple(
        replace(
            coil,
            moment_beacon=factor * coil.moment_beacon,
            current=None if coil.current is None else factor * coil.current,
        )
        for coil in beacon.coils
    )
    return replace(beacon, coils=coils)


def tuned(beacon: Beacon, frequencies_hz: Array) -> Beacon:
    """Return a beacon with other frequencies, one for each of its tones in their order."""
    tones = beacon.tone_frequencies_hz.tolist()
    new = dict(zip(tones, frequencies_hz.tolist(), strict=True))
    coils = tuple(
        coil if coil.frequency_hz is None else replace(coil, frequency_hz=new[coil.frequency_hz])
        for coil in beacon.coils
    )
    own = new.get(beacon.frequency_hz, frequencies_hz[0])
    return replace(beacon, frequency_hz=float(own), coils=coils)


def peak_moment(beacon: Beacon) -> float:
    """Return the largest moment of a beacon's coils (A m^2)."""
    return float(np.max(np.linalg.norm(beacon.moments_beacon, axis=1)))


def template_of(site: Site, name: str | None) -> Beacon:
    """Return the beacon to copy, without the properties of its own place.

    Raises InputError where there is none of that name.
    """
    names = [beacon.name for beacon in site.beacons]
    if name is not None and name not in names:
        raise InputError(
            f"--template {name}: the site has no such beacon; it has {', '.join(names)}"
        )
    result = site.beacons[0 if name is None else names.index(name)]
    return replace(result, field_map=None, steel=None, hemisphere_beacon=None, unknown=None)


def frequencies_for(
    template: Beacon, count: int, band: ToneBand, kept: tuple[Beacon, ...]
) -> tuple[Array, Array]:
    """Return the frequencies of each new beacon, shape (count, tones), and the free ones.

    Raises InputError where there is no room for so many.
    """
    selected = np.concatenate([np.zeros(0), *(b.tone_frequencies_hz for b in kept)])
    allowed, tones = band.allowed(selected), len(template.tones)
    if len(allowed) < count * tones:
        raise InputError(
            f"--band {band.low:g},{band.high:g} has {len(allowed)} tones {band.spacing:g} Hz apart,"
            f" and {count * tones} are needed; widen it, or give a longer --window"
        )
    return allowed[: count * tones].reshape(count, tones), allowed[count * tones :]
