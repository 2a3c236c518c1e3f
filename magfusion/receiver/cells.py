"""Coarse track of a log from tone amplitudes, to assign shared frequencies before any fix.

A map of the amplitudes at the nodes of a grid is compared with those of about every second.  The
track is the most probable path at no more than the speed of a vehicle indoors.  Amplitudes depend
neither on the attitude nor on the drive phases; their change between nodes is the model error.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from magfusion.errors import InputError
from magfusion.model.detection_range import only_owned, owned_at, tones_of
from magfusion.model.field import predict
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trajectory import interpolated
from magfusion.units import Array, IntArray

PITCH = 2.0  # m; of the grid in the plane
MAX_NODES = 20_000  # in the plane; a larger site has a coarser grid
LEVELS = 3  # of height
OUTSIDE = 4.0  # m; by which the grid exceeds the extent of the beacons
LOWEST_SPAN = 3.0  # m; of heights, where all beacons are at one
EVERY = 0.8  # s
FASTEST = 4.0  # m/s
NOT_AS_DECLARED = 0.1  # of an amplitude, in addition to its change between nodes
MAX_FALSE_CHI_SQUARE = (
    30.0  # largest chi square of one epoch, which bounds the effect of a faulty beacon
)
AS_LIKELY = 16.0  # of chi square, within which another position is possible
MARGIN = 2.0  # m; position error of the track


class SensorPath(NamedTuple):
    """Coarse track of the magnetometer, accurate to about one grid pitch."""

    time: Array  # (n,) (s)
    position_world: Array  # (n, 3) (m)
    spread: Array  # (n,), distance of the farthest position that is nearly as probable (m)

    def at(self, time: Array) -> tuple[Array, Array]:
        """Return the positions at times and their possible errors, (n, 3) and (n,) (m)."""
        place = interpolated(time, self.time, self.position_world)
        return place, MARGIN + np.interp(time, self.time, self.spread)


class _Grid(NamedTuple):
    """Grid nodes, and the amplitude of every tone there."""

    axes: tuple[Array, Array, Array]
    strength: Array  # (nodes, tones) (T)
    change: Array  # (nodes, tones), of each between nodes, one sigma (T)

    @property
    def shape(self) -> tuple[int, int, int]:
        x, y, z = (len(axis) for axis in self.axes)
        return x, y, z

    @property
    def pitch(self) -> float:
        return float(self.axes[0][1] - self.axes[0][0])

    def position_world(self, node: IntArray) -> Array:
        index = np.unravel_index(node, self.shape)
        return np.stack([axis[i] for axis, i in zip(self.axes, index, strict=True)], axis=-1)


def way_of(samples: FieldSamples, site: Site) -> SensorPath:
    """Return the most probable track of a log through its site.

    `samples`: of all channels: several on one frequency have the same phasor.
    """
    tones, grid = tones_of(site), _grid_of(site)
    rows = _thinned(samples.time, EVERY)
    first = np.array([np.argmax(tones.of_channel == k) for k in range(len(tones.frequencies_hz))])
    phasor = np.nan_to_num(samples.phasor_sensor[rows][:, first])
    strength = np.sqrt(np.sum(np.abs(phasor) ** 2, axis=-1))
    noise = np.trace(samples.phasor_cov[rows][:, first], axis1=-2, axis2=-1)
    time = samples.time[rows]
    cost = _cost(grid, strength, noise).reshape(len(time), *grid.shape)
    total = _both_ways(cost, time, grid.pitch).reshape(len(time), -1)
    best = np.argmin(total, axis=1)
    position = grid.position_world(best)
    every = grid.position_world(np.arange(total.shape[1]))
    spread = np.zeros(len(time))
    for k in range(len(time)):
        likely = every[total[k] < total[k, best[k]] + AS_LIKELY]
        spread[k] = np.max(np.linalg.norm((likely - position[k])[:, :2], axis=1))
    return SensorPath(time, position, spread)


def _thinned(time: Array, step: float) -> IntArray:
    """Return rows at least one step apart."""
    number = np.floor((time - time[0]) / step)
    return np.unique(number, return_index=True)[1]


def _grid_of(site: Site) -> _Grid:
    places = np.array([beacon.position_world for beacon in site.beacons])
    low, high = places.min(axis=0), places.max(axis=0)
    low[:2], high[:2] = low[:2] - OUTSIDE, high[:2] + OUTSIDE
    if high[2] - low[2] < LOWEST_SPAN:
        middle = 0.5 * (high[2] + low[2])
        low[2], high[2] = middle - 0.5 * LOWEST_SPAN, middle + 0.5 * LOWEST_SPAN
    pitch = max(PITCH, float(np.sqrt(np.prod(high[:2] - low[:2]) / MAX_NODES)))
    x, y = (np.arange(low[i], high[i] + pitch, pitch) for i in range(2))
    axes = x, y, np.linspace(low[2], high[2], LEVELS)
    node = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tones = tones_of(site)
    power, change = (np.zeros((len(node), len(tones.frequencies_hz))) for _ in range(2))
    separate = 0.5 * np.array([pitch, pitch, axes[2][1] - axes[2][0]])
    missed = float(np.linalg.norm(separate) / np.sqrt(3.0))
    start = 0
    for beacon in site.beacons:
        phasor = predict(beacon, _plain(site), np.broadcast_to(np.eye(3), (len(node), 3, 3)), node)
        own = np.sum(np.abs(phasor) ** 2, axis=-1)
        distance = np.linalg.norm(node - beacon.position_world, axis=1)
        share = np.minimum(3.0 * missed / np.maximum(distance, missed), 2.0)
        for k in range(own.shape[1]):
            tone = tones.of_channel[start + k]
            power[:, tone] += own[:, k]
            change[:, tone] += own[:, k] * (share**2 + NOT_AS_DECLARED**2)
        start += own.shape[1]
    return _Grid(axes, np.sqrt(power), np.sqrt(change))


def _plain(site: Site) -> Magnetometer:
    """Return an ideal magnetometer at the origin of the body."""
    sensor = site.platform.magnetometer
    return replace(
        sensor,
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        coil_centres_sensor=None,
        coil_kappa=0.0,
    )


def _cost(grid: _Grid, strength: Array, noise: Array) -> Array:
    """Return chi square of every node at every epoch, shape (n, nodes)."""
    out = np.empty((len(strength), len(grid.strength)))
    own = grid.change**2
    for k in range(len(strength)):
        variance = own + noise[k]
        square = (np.hypot(grid.strength, np.sqrt(2.0 * noise[k])) - strength[k]) ** 2 / variance
        out[k] = np.sum(
            np.minimum(square, MAX_FALSE_CHI_SQUARE) + np.log(variance / noise[k]), axis=1
        )
    return out


def _both_ways(cost: Array, time: Array, pitch: float) -> Array:
    """Return the least chi square of any path through each node at each epoch."""
    reach = np.maximum(np.ceil(FASTEST * np.diff(time) / pitch), 1).astype(int)

    def towards(order: range, steps: Array) -> Array:
        out = cost.copy()
        previous = order[0]
        for k, step in zip(order[1:], steps, strict=True):
            size = np.minimum(2 * int(step) + 1, 2 * np.array(cost.shape[1:]) + 1)
            out[k] += minimum_filter(out[previous], size=size.tolist(), mode="nearest")
            previous = k
        return out

    n = len(cost)
    forth, back = towards(range(n), reach), towards(range(n - 1, -1, -1), reach[::-1])
    return forth + back - cost


def owned_by(samples: FieldSamples, site: Site) -> FieldSamples:
    """Assign phasors to beacons where several share a frequency.

    Raises InputError where the amplitudes do not determine which beacons are received.
    """
    if not tones_of(site).reused or len(samples) == 0:
        return samples
    place, margin = way_of(samples, site).at(samples.time)
    result = only_owned(samples, owned_at(site, place, margin=margin[:, None]))
    if not np.any(result.valid):
        raise InputError(
            "beacons share frequencies, and the received amplitudes do not identify them:"
            " several positions are equally probable (ambiguous); record longer, or in range of"
            " more beacons"
        )
    return result
