"""Detectable beacons at a position, and the owner of a phasor on a shared frequency.

A frequency may be reused by beacons that are out of range of each other.  A receiver then measures
one phasor for all of them.  It is assigned to the strongest beacon, or to none where a second one
is detectable as well.
"""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.units import MU0_OVER_4PI, Array, BoolArray, IntArray

MANY = 24  # beacons; with more, a job selects the detectable ones
MAX_INTERFERENCE = (
    0.5  # of a beacon's field: largest contribution of others on its frequency to its phasor
)
NEAREST = 0.1  # m; smallest distance for a predicted field


class Tones(NamedTuple):
    """Distinct transmitted frequencies."""

    frequencies_hz: Array  # (tones,), in the order of the channels
    of_channel: IntArray  # (channels of a magnetometer,)

    @property
    def reused(self) -> bool:
        """Whether any is shared by several beacons."""
        return len(self.frequencies_hz) < len(self.of_channel)


def are_many(site: Site) -> bool:
    """Return whether a site has so many beacons that only detectable ones are computed.

    With several magnetometers all are computed at every epoch.
    """
    return len(site.beacons) > MANY and not site.platform.further


def tones_of(site: Site) -> Tones:
    """Return the tones of a site; those of time slots are distinguished by their slots.

    A planned beacon is assumed to have its own frequencies.
    """
    alone = any(slot is not None for beacon in site.beacons for _, slot in beacon.tones)
    planned = tuple(k if b.planned else -1 for k, b in enumerate(site.beacons) for _ in b.tones)
    return _tones(tuple(site.tone_frequencies_hz.tolist()), planned, alone=alone)


@lru_cache(maxsize=8)
def _tones(hz: tuple[float, ...], planned: tuple[int, ...], *, alone: bool) -> Tones:
    frequencies, separate = np.array(hz), np.array(planned)
    if alone:
        return Tones(frequencies, np.arange(len(frequencies)))
    if np.any(separate >= 0):
        each = np.stack([separate, frequencies], axis=1)
        _, first, of_channel = np.unique(each, axis=0, return_index=True, return_inverse=True)
    else:
        _, first, of_channel = np.unique(frequencies, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return Tones(frequencies[first[order]], rank[of_channel])


def phasor_sigma(site: Site, window: float) -> float:
    """Return the declared noise of a phasor's component in a window (s) (T)."""
    return float(site.platform.magnetometer.noise_density / np.sqrt(window))


def largest_fields(site: Site, sensor_world: Array, margin: Array | float = 0.0) -> Array:
    """Return the upper limit of each phasor of a magnetometer, shape (n, channels) (T).

    `sensor_world` (n, 3) (m). `margin` (n, 1), or float: reduction of the distance to the beacons
    (m); negative for an increase.
    """
    places = np.array([beacon.position_world for beacon in site.beacons])
    owner = [i for i, beacon in enumerate(site.beacons) for _ in beacon.tones]
    moment = np.concatenate([beacon.tone_moments for beacon in site.beacons])
    distance = np.linalg.norm(sensor_world[:, None] - places, axis=-1)
    distance = np.maximum(distance - margin, NEAREST)[:, owner]
    return np.asarray(2.0 * MU0_OVER_4PI * moment / distance**3)


def mutually_undetectable(a: Beacon, b: Beacon, sigma: float) -> bool:
    """Return whether each of two beacons is below the noise (T) at the other's position."""
    distance = float(np.linalg.norm(a.position_world - b.position_world))
    moment = max(float(np.max(beacon.tone_moments)) for beacon in (a, b))
    return 2.0 * MU0_OVER_4PI * moment / max(distance, NEAREST) ** 3 < sigma


class Owned(NamedTuple):
    """Owners of the phasors of each tone."""

    # (n, channels), channels of the strongest beacon on each frequency, if it dominates the others
    channels: BoolArray
    # (n, channels), largest contribution of the others on the frequency to its phasor (T)
    others: Array


def owned_at(
    site: Site, sensor_world: Array, margin: Array | float = 0.0, unknown: Array | float = 1.0
) -> Owned:
    """Return the owners of the phasors of a magnetometer at its positions.

    `sensor_world` (n, 3) (m). `margin` (n, 1), or float: error of the positions (m).
    `unknown` (n, channels), or float: share of each beacon's field that is not predicted, after a
    prediction has been subtracted; undetected beacons last.
    """
    count = len(site.tone_frequencies_hz)
    site = replace(site, beacons=(*site.beacons, *(b for _, b in site.undetected)), undetected=())
    tones = tones_of(site)
    near, far = (largest_fields(site, sensor_world, sign * margin) for sign in (1.0, -1.0))
    missed = np.broadcast_to(unknown, near.shape) * near
    of_tone = np.eye(len(tones.frequencies_hz))[tones.of_channel]
    shared = np.sum(of_tone, axis=0)[tones.of_channel] > 1.0
    neighbours = np.where(shared, (near @ of_tone)[:, tones.of_channel] - near, 0.0)
    others = np.where(shared, (missed @ of_tone)[:, tones.of_channel] - missed, 0.0)
    # The field of a coil is half as strong in its equatorial plane as on its axis.
    channels = neighbours <= MAX_INTERFERENCE * 0.5 * far
    return Owned(channels[:, :count], others[:, :count])


def only_owned(samples: FieldSamples, owned: Owned) -> FieldSamples:
    """Set phasors to missing that do not belong to one beacon."""
    added = np.where(owned.channels, owned.others, 0.0) ** 2 / 3.0
    return replace(
        samples,
        phasor_sensor=np.where(owned.channels[..., None], samples.phasor_sensor, np.nan),
        phasor_cov=samples.phasor_cov + added[..., None, None] * np.eye(3),
    )
