"""Exact attitude among rotating beacons, which paper 004 lacks.

Where the attitude is unknown, `magfusion.estimation.snapshot.candidates.beacon_directions` gives
range and four directions from the Gram matrix of the phasors.
"""

import numpy as np

from magfusion.estimation.snapshot.candidates import wahba
from magfusion.units import Array, ComplexArray


def attitude_from_vectors(
    vector_sensor: Array | ComplexArray, vector_world: Array | ComplexArray
) -> Array:
    """Return the rotation that best fits vectors in two frames (Wahba's problem).

    For phasors, which both must have the same drive phase, it is the maximum of the likelihood in
    white noise and exact at any attitude; two coils of a single beacon suffice.  For the directions
    of paper 004, Eq 18-19, it is only the rotation nearest to a wrong equation. `vector_sensor`,
    `vector_world` (..., vectors, 3): of any one unit. Returns (..., 3, 3), world_from_sensor.
    """
    outer = vector_world[..., :, None] * np.conj(vector_sensor[..., None, :])
    return wahba(np.sum(outer.real, axis=-3))
