"""A plate of aluminium that is brought near a head, kept there, and removed."""

from functools import partial

import numpy as np
from moving_plate import Plate
from tracker_coils import FORMERS, winding_field
from tracker_head import CARRIER_HZ, Head

from magfusion.units import Array, ComplexArray

PLATE_CENTRE, PLATE_FAR = np.array([0.3, 0.16, 0.0]), 1.0  # m; held there, and from how far beside
PLATE_COMES, PLATE_HELD, PLATE_MOVES = 9.5, 4.0, 1.0  # s


def plate_centre(time: Array) -> Array:
    """Return where the plate is (n, 3) (m)."""
    leaves = PLATE_COMES + PLATE_MOVES + PLATE_HELD
    come, elapsed = (
        np.clip((time - begin) / PLATE_MOVES, 0.0, 1.0) for begin in (PLATE_COMES, leaves)
    )
    away = 1.0 - come**2 * (3.0 - 2.0 * come) + elapsed**2 * (3.0 - 2.0 * elapsed)
    return np.asarray(PLATE_CENTRE + away[:, None] * [0.0, PLATE_FAR, 0.0])


def plate_fields(head: Head, time: Array) -> tuple[ComplexArray, Array]:
    """Return what the plate adds to each coil (3, n, 3) (T), and its share of the fields (n,)."""
    place, centre, plate = head.place(time), plate_centre(time), Plate()
    added, whole = [], []
    for axis, former in enumerate(FORMERS):
        coil = partial(winding_field, former, axis)
        added.append(plate.added(coil, centre, place, CARRIER_HZ))
        whole.append(coil(place))
    share = np.linalg.norm(added, axis=(0, 2)) / np.linalg.norm(whole, axis=(0, 2))
    return np.array(added), share
