"""Exact pose from one three-axis beacon in closed form, which paper 000 lacks.

Frames: the paper's transmitter is the beacon, its receiver the sensor, its H sensor_from_beacon.
One singular value decomposition gives range, bearing and attitude at once.  The dipole is even, so
that the opposite position fits as well; the attitude is the same for both.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import EstimationError
from magfusion.units import MU0_OVER_4PI, Array


@dataclass(frozen=True, eq=False)
class TrackerFix:
    """Pose of a sensor relative to one beacon."""

    sensor_from_beacon: Array  # (..., 3, 3), the paper's H
    # (..., 2, 3), the two positions that fit, opposite each other (m), in arbitrary order until
    # `nearest` puts the wanted hemisphere first
    position_beacon: Array
    distance: Array  # (...) (m)
    # (...), unmodelled part relative to the coupling: singular values that are not 2 : 1 : 1
    residual: Array

    def nearest(self, guess_beacon: Array) -> "TrackerFix":
        """Return the fix with the position on the side of a guess (..., 3) first.

        The hemisphere is known from a prior or the last position; the coils' centres determine it
        only where the antenna is known far more accurately than the noise.
        """
        towards = np.einsum("...hi,...i", self.position_beacon, guess_beacon)
        swap = (towards[..., 1] > towards[..., 0])[..., None, None]
        ordered = np.where(swap, self.position_beacon[..., ::-1, :], self.position_beacon)
        return TrackerFix(self.sensor_from_beacon, ordered, self.distance, self.residual)


def locate_by_svd(unit: Array) -> TrackerFix:
    """Compute range, bearing and attitude from one singular value decomposition.

    The field of unit moments, sensor axes by beacon axes (..., 3, 3), is
    ``U = (K/R^3) H (3 u u^T - 1)`` and has singular values 2 : 1 : 1, the first along the bearing;
    H is the remaining factor: the solution of Wahba's problem and also the polar factor of Eq 11.
    Raises EstimationError where a determinant is not positive, which no pose of a right-handed
    tracker gives.
    """
    _refuse_mirrored(unit)
    residual, size, right = np.linalg.svd(unit)
    power = np.sum(size**2, axis=-1)
    distance = (6.0 * MU0_OVER_4PI**2 / power) ** (1.0 / 6.0)
    along = right[..., 0, :] * distance[..., None]
    ideal = np.sqrt(power / 6.0)[..., None] * [2.0, 1.0, 1.0]
    return TrackerFix(
        sensor_from_beacon=(residual * [1.0, -1.0, -1.0]) @ right,
        position_beacon=np.stack([along, -along], axis=-2),
        distance=distance,
        residual=np.linalg.norm(size - ideal, axis=-1) / np.sqrt(power),
    )


def _refuse_mirrored(unit: Array) -> None:
    finite = np.isfinite(unit).all(axis=(-2, -1))
    if not finite.all():
        raise EstimationError(f"coupling {np.argmin(finite.ravel())} is not finite")
    size = np.linalg.svd(unit, compute_uv=False)
    flat = size[..., 2] < 1e-6 * size[..., 0]
    if flat.any():
        raise EstimationError(
            f"coupling {np.argmax(flat.ravel())} is singular: a coil is silent or its wire broken"
        )
    # det U = 2 (K/R^3)^3; noise changes its sign only if it is as large as the signal.
    wrong = np.linalg.det(unit) < 0.0
    if wrong.any():
        raise EstimationError(
            f"coupling {np.argmax(wrong.ravel())} has a negative determinant, which no pose"
            " explains: the wires of one coil, or two coils, are swapped, or the sign of one axis"
            " or of Eq 1 is wrong (M = 1 - 3 u u^T takes a minus)"
        )
