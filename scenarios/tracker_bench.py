"""The bench of paper 000, section 4: an antenna measured by a probe at four or six points.

Each coil is driven alone; the probe goes to points at one distance from the antenna's mechanical
centre, two on either of the axes across the coil, and (which the paper lacks) two on its own axis.
The four measure a coil's offset across its axis, but not along it.  A receiving antenna is
measured as a small transmitting one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.antenna import Antenna
from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p000_tracker.equations import (
    bursa_wolf_matrix,
    mean_shift,
    shift_as_printed,
)
from magfusion.units import Array


def bench_points(distance: float) -> Array:
    """Return the probe's points, shape (3 axes, 2 sides, 3) (m): at ``[a, 0]`` axis a, plus side.

    Of coil j the points ``a != j`` are the paper's four, those of ``a = j`` the two on its axis.
    """
    axes = distance * np.eye(3)
    return np.stack([axes, -axes], axis=1)


@dataclass(frozen=True, eq=False)
class BenchEstimate:
    """An antenna measured on the bench.

    Parameters
    ----------
    moments : ndarray, shape (..., 3, 3)
        Of each coil, antenna axes (A m^2 where the probe reads tesla).
    centres : ndarray, shape (..., 3, 3)
        Of each coil (m); the component along its own axis is zero where the bench has four points.
    """

    moments: Array
    centres: Array


def measure(field: Array, distance: float, *, on_axis: bool) -> BenchEstimate:
    """Estimate moments and centres of an antenna's coils from readings at `bench_points`.

    The moments are estimated by least squares over all points: a centre's offset is odd in the side
    and cancels.  An offset d along axis a scales the field at the two points of that axis by
    ``1 +- 3 d / distance``, in the component along the coil's axis, which is what the paper's
    single-axis probe reads.

    Parameters
    ----------
    field : ndarray, shape (..., 3 coils, 3 axes, 2 sides, 3)
        Antenna axes (T).
    on_axis : bool
        Use the two points on each coil's axis as well (six points); False is the paper's four.
    """
    points = bench_points(distance)
    design = np.swapaxes(dipole_field(points[..., None, :], np.eye(3)), -1, -2)  # (3, 2, 3, 3)
    lead = field.shape[:-4]
    moments, centres = np.zeros((*lead, 3, 3)), np.zeros((*lead, 3, 3))
    for coil in range(3):
        axes = [a for a in range(3) if on_axis or a != coil]
        seen = field[..., coil, axes, :, :]
        flat = design[axes].reshape(-1, 3)
        moments[..., coil, :] = seen.reshape(*lead, -1) @ np.linalg.pinv(flat).T
        strength = np.abs(seen[..., coil])
        near, far = strength[..., 0], strength[..., 1]
        centres[..., coil, axes] = distance / 3.0 * (near - far) / (near + far)
    return BenchEstimate(moments=moments, centres=centres)


def helmert(moments: Array) -> Array:
    """Return the small rotation (..., 3) (rad) of Eq 18 at scale one for coils (..., 3, 3).

    Least squares over the coils' axes.  Gains, and every change of the angles between the coils,
    are symmetric and remain: no rotation removes them.
    """
    unit = moments / np.linalg.norm(moments, axis=-1, keepdims=True)
    turn = 0.5 * (np.swapaxes(unit, -1, -2) - unit)  # columns are where the axes went
    return np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)


def rigid_antenna(
    nominal: Antenna, transmitter: BenchEstimate, receiver: BenchEstimate, *, printed: bool
) -> Antenna:
    """Return the nominal antenna rotated and shifted as a whole: the paper's calibration.

    As printed it uses the sum of the offsets (Eq 15-17) and ``1 + [w]x`` (Eq 18), otherwise their
    mean and the rotation itself.
    """
    parts: list[Array] = []
    for coils, bench in (
        (nominal.moments_beacon, transmitter),
        (nominal.sensitivities_sensor, receiver),
    ):
        angle = helmert(bench.moments)
        turn = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(*angle.shape, 3)
        turn = bursa_wolf_matrix(angle) if printed else turn
        shift = shift_as_printed(bench.centres) if printed else mean_shift(bench.centres)
        parts += [coils @ np.swapaxes(turn, -1, -2)]
        parts += [np.broadcast_to(shift[..., None, :], bench.centres.shape)]
    return Antenna(*parts)


def general_antenna(
    transmitter: BenchEstimate, receiver: BenchEstimate, *, coil_centres: bool
) -> Antenna:
    """Return the antenna of general T and Q, with one centre per coil or their common mean."""
    parts: list[Array] = []
    for bench in (transmitter, receiver):
        common = np.broadcast_to(mean_shift(bench.centres)[..., None, :], bench.centres.shape)
        parts += [bench.moments, bench.centres if coil_centres else common]
    return Antenna(*parts)
