"""Relative position of two wells in drilling terms, with the sigma of each."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.ranging.ranging import Ranged
from magfusion.estimation.ranging.ranging_data import FIRST, RangingWindows
from magfusion.model.field import skew
from magfusion.units import Array

LATERAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])  # to the right and to the high side


@dataclass(frozen=True, eq=False)
class Places:
    """Position of the magnet relative to the sensor at some depths of both."""

    # (n, 3), ahead (down the sensor's hole), to the right looking down it, and up to its high side
    # (m)
    place: Array
    cov: Array  # (n, 3, 3) (m^2)


@dataclass(frozen=True)
class WellPair:
    """The two wells at the depth of the sensor."""

    # distance, distance_sigma: from the sensor to the line of the magnet's path, centre to centre
    # (m)
    distance: float
    distance_sigma: float
    # direction, direction_sigma: of its nearest point from the high side, clockwise looking down
    # the hole (rad)
    direction: float
    direction_sigma: float
    # depth, depth_sigma: measured depth of the magnet where it is nearest (m)
    depth: float
    depth_sigma: float


@dataclass(frozen=True)
class Divergence:
    """Angles of the magnet's well to the sensor's, to the right and up, with sigma (rad)."""

    right: float
    right_sigma: float
    up: float
    up_sigma: float


class Wells:
    """Relative position of two wells from a range.

    `axis` (3,): of the magnet, along its path. `excess`: factor by which the covariance is too
    small.
    """

    def __init__(
        self, result: Ranged, windows: RangingWindows, axis: Array, excess: float = 1.0
    ) -> None:
        self._windows, self._back = windows, result.world_from_body.T
        self._along, self._place = self._back @ axis, self._back @ result.position_world
        names = result.names
        self._scale = names.index("depth_scale") if "depth_scale" in names else None
        self._factor = 1.0 if self._scale is None else 1.0 + float(result.values[self._scale])
        self._cov = excess * result.cov

    def _side(self, magnet: float, sensor: float) -> tuple[Array, Array]:
        """Return the magnet in the high side's frame (3,) (m), and its derivatives (3, n)."""
        travel = magnet - self._windows.magnet_from
        rotated = self._factor * travel * self._along - self._place
        by = np.zeros((3, len(self._cov)))
        by[:, :3], by[:, 3:POSE] = skew(rotated), -np.eye(3)
        if self._scale is not None:
            by[:, POSE + self._scale] = travel * self._along
        return rotated - (sensor - self._windows.sensor_from) * FIRST, by

    def places(self, magnet: Array, sensor: Array) -> Places:
        """Return the magnet relative to the sensor at measured depths of both (n,) (m)."""
        words = np.concatenate([FIRST[None], LATERAL])
        each = [self._side(float(m), float(s)) for m, s in zip(magnet, sensor, strict=True)]
        slopes = np.array([words @ by for _, by in each])
        return Places(
            np.array([words @ place for place, _ in each]),
            slopes @ self._cov @ np.swapaxes(slopes, 1, 2),
        )

    def wells_at(self, sensor: float) -> WellPair:
        """Return the wells at a depth of the sensor."""
        start, _ = self._side(self._windows.magnet_from, sensor)
        travel = -float(start @ self._along)
        magnet = self._windows.magnet_from + travel / self._factor
        place, by = self._side(magnet, sensor)
        rotated = np.zeros_like(by)
        rotated[:, :3] = skew(self._along)
        distance = float(np.linalg.norm(place))
        right, up = LATERAL @ place
        across = float(np.hypot(right, up))
        slope = (place / distance) @ by
        # The nearest point moves along the line as that rotates and shifts.
        along = self._along @ by + place @ rotated
        moved = by - np.outer(self._along, along)
        turning = (np.array([up, -right]) @ LATERAL / across**2) @ moved
        depth = -along / self._factor
        if self._scale is not None:
            depth[POSE + self._scale] = -travel / self._factor**2
        return WellPair(
            distance,
            self._sigma(slope),
            float(np.arctan2(right, up) % (2.0 * np.pi)),
            self._sigma(turning),
            magnet,
            self._sigma(depth),
        )

    def divergence(self) -> Divergence:
        """Return the divergence of the wells, down the magnet's."""
        by = np.zeros((3, len(self._cov)))
        by[:, :3] = skew(self._along)
        forward = float(FIRST @ self._along)
        right, up = LATERAL @ self._along
        slopes = [
            (forward * row - value * FIRST) @ by / (forward**2 + value**2)
            for row, value in zip(LATERAL, (right, up), strict=True)
        ]
        return Divergence(
            float(np.arctan2(right, forward)),
            self._sigma(slopes[0]),
            float(np.arctan2(up, forward)),
            self._sigma(slopes[1]),
        )

    def _sigma(self, slope: Array) -> float:
        return float(np.sqrt(max(float(slope @ self._cov @ slope), 0.0)))
