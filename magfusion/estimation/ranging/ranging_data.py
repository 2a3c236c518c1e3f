"""Windows of a sensor at rest while a rotating magnet passes."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.model.samples import FieldSamples
from magfusion.units import Array

# Gauss-Legendre points of a window, relative to its middle and length, for the motion within it.
WITHIN, SHARE = np.sqrt(0.6) * np.array([-0.5, 0.0, 0.5]), np.array([5.0, 8.0, 5.0]) / 18.0
FIRST = np.array([1.0, 0.0, 0.0])  # axis of the sensor's body, down its hole
SAME_PLACE_M = 1.0  # m; places of the sensor that are closer count as one


@dataclass(frozen=True, eq=False)
class RangingWindows:
    """Measurements while a magnet passes."""

    fields: FieldSamples  # of one rotor, by its angle
    # whether the angle was measured; otherwise each window has a phase of its own
    angle_known: bool
    # (n, 3), depth of the magnet at the points `WITHIN` each window (m), from ``magnet_from``
    magnet: Array
    sensor: Array  # (n,), depth of the sensor (m), from ``sensor_from``
    roll: Array  # (n,), of the sensor about its hole, from its high side (rad)
    magnet_from: float
    sensor_from: float
    depth_sigma: float = 0.0  # of a window's depth, independently (m)
    depth_scale_sigma: float = 1e-3  # of all, relative

    def rows(self, kept: slice) -> "RangingWindows":
        """Return some windows."""
        return replace(
            self,
            fields=self.fields.rows(kept),
            magnet=self.magnet[kept],
            sensor=self.sensor[kept],
            roll=self.roll[kept],
        )

    def spread(self, length: float) -> "RangingWindows":
        """Return the same for a magnet of this length (m), distributed along its path.

        A window measures the mean over motion and length, approximated by the sum of their second
        moments.
        """
        half = 0.5 * (self.magnet[:, 2] - self.magnet[:, 0])
        wider = np.hypot(half, WITHIN[2] * length) - np.abs(half)
        lateral = np.where(half < 0.0, -wider, wider)[:, None] * np.sign(WITHIN)
        return replace(self, magnet=self.magnet + lateral) if length else self

    @property
    def seen(self) -> Array:
        """Size of each phasor, zero where it is not valid, shape (n, tones) (T)."""
        size = np.linalg.norm(self.fields.phasor_sensor, axis=-1)
        return np.where(self.fields.valid, size, 0.0)

    @property
    def reach(self) -> Array:
        """Path of the magnet within half of the maximum strength, shape (tones,) (m).

        In one pass; for a dipole that is about twice the distance.
        """
        size, out = self.seen, []
        for own in size.T:
            strongest = int(np.argmax(own))
            others = np.abs(self.sensor - self.sensor[strongest]) < SAME_PLACE_M
            detected = self.magnet[others & (own > 0.5 * own[strongest]), 1]
            out.append(max(float(np.ptp(detected)) if len(detected) else 0.0, 0.1))
        return np.array(out)
