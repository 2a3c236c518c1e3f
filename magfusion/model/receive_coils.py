"""Magnetometer axes with separate coils: each at its centre, and of finite size.

The flux through a coil is the mean over it of a field without divergence and curl, the field at its
centre and its second derivative along the axis: ``(1 - kappa d^2/dn^2) n . B``, for a flat coil
``radius^2 / 8``, for a long one ``-length^2 / 24`` (`magfusion.model.physics.finite_size`).  It is
computed as a sum over three points on the axis, for a long coil by the Gauss-Legendre rule.  The
error is of fourth order in size over distance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magfusion.model.site import Magnetometer
from magfusion.units import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class Observation:
    """Predicted phasors of one beacon with their Jacobian blocks.

    Every block has the shape of ``phasor_sensor`` with one axis more, of the length given.
    """

    phasor_sensor: ComplexArray  # (..., tones, 3) (T), measured axes
    # 6, right perturbation of world_from_body: rotation, translation, body axes (T/rad, T/m)
    platform_pose: ComplexArray
    # 6, right perturbation of world_from_beacon: rotation, translation, beacon axes (T/rad, T/m)
    beacon_pose: ComplexArray
    log_moments: ComplexArray  # logarithm of each coil's moment (T)
    phase: ComplexArray  # drive phase of the phasor's own tone; no further axis (T/rad)
    matrix: ComplexArray  # 9, magnetometer matrix, row by row (T)
    # 6, right perturbation of the sensor's pose in the body: rotation, translation, sensor axes
    # (T/rad, T/m)
    body_from_sensor: ComplexArray
    # IMU time offset; no further axis (T/s). None where no twist was given
    time_offset: ComplexArray | None
    # logarithm of the ground's conductivity; no further axis (T). None without conduction
    log_conductivity: ComplexArray | None = None


def is_apart(magnetometer: Magnetometer) -> bool:
    """Return whether the axes measure the field at different points."""
    return magnetometer.coil_centres_sensor is not None or magnetometer.coil_kappa != 0.0


def _centres_sensor(magnetometer: Magnetometer) -> Array:
    centres = magnetometer.coil_centres_sensor
    return np.zeros((3, 3)) if centres is None else centres


def _along(magnetometer: Magnetometer) -> tuple[Array, Array]:
    """Return positions along a coil's axis (m), and their weights, which sum to one."""
    kappa = magnetometer.coil_kappa
    if kappa == 0.0:
        return np.zeros(1), np.ones(1)
    reach = np.sqrt(2.0 * abs(kappa))
    side = -0.5 * np.sign(kappa)
    return reach * np.array([-1.0, 0.0, 1.0]), np.array([side, 1.0 - 2.0 * side, side])


def points_apart(magnetometer: Magnetometer) -> list[Magnetometer]:
    """Return a magnetometer at each point, axis by axis, of which only that axis is valid."""
    centres, (places, _) = _centres_sensor(magnetometer), _along(magnetometer)
    axes = magnetometer.matrix / np.linalg.norm(magnetometer.matrix, axis=1, keepdims=True)
    return [
        replace(
            magnetometer,
            position_body=magnetometer.position_body
            + magnetometer.body_from_sensor @ (centre + place * axis),
            coil_centres_sensor=None,
            coil_kappa=0.0,
        )
        for centre, axis in zip(centres, axes, strict=True)
        for place in places
    ]


def joined_phasors(separately: list[ComplexArray], magnetometer: Magnetometer) -> ComplexArray:
    """Return the phasors of the coils from those (..., tones, 3) at `points_apart`."""
    return joined_axes(separately, magnetometer)


def joined_axes(separately: Sequence[Any], magnetometer: Magnetometer) -> Any:
    """Return the values (..., 3) of the coils from those at `points_apart`."""
    weights = _along(magnetometer)[1]
    count = len(weights)
    rows = [
        sum(w * separately[i * count + k][..., i] for k, w in enumerate(weights)) for i in range(3)
    ]
    return np.stack(rows, axis=-1)


def joined(separately: list[Observation], magnetometer: Magnetometer) -> Observation:
    """Return the observation of the coils from those at `points_apart`."""
    centres, (places, weights) = _centres_sensor(magnetometer), _along(magnetometer)
    count, names = len(weights), ("platform_pose", "beacon_pose", "log_moments")
    blocks: dict[str, list[ComplexArray]] = {n: [] for n in (*names, "matrix", "body_from_sensor")}
    for i, (row, centre) in enumerate(zip(magnetometer.matrix, centres, strict=True)):
        size = np.linalg.norm(row)
        axis = row / size
        across = (np.eye(3) - np.outer(axis, axis)) / size
        own: dict[str, ComplexArray] = {}
        for k, (place, weight) in enumerate(zip(places, weights, strict=True)):
            seen = separately[i * count + k]
            parts = {name: getattr(seen, name)[..., i, :] for name in names}
            mounting = seen.body_from_sensor[..., i, :].copy()
            matrix = seen.matrix[..., i, :].copy()
            # The mounting rotates the coil's points; the row of the matrix rotates its axis.
            mounting[..., :3] -= np.cross(mounting[..., 3:], centre + place * axis)
            matrix[..., 3 * i : 3 * i + 3] += place * mounting[..., 3:] @ across
            parts |= {"matrix": matrix, "body_from_sensor": mounting}
            own = {name: own.get(name, 0.0) + weight * part for name, part in parts.items()}
        for name, part in own.items():
            blocks[name].append(part)
    return Observation(
        **{name: np.stack(rows, axis=-2) for name, rows in blocks.items()},
        phasor_sensor=joined_phasors([o.phasor_sensor for o in separately], magnetometer),
        phase=joined_phasors([o.phase for o in separately], magnetometer),
        time_offset=_joined_if_there([o.time_offset for o in separately], magnetometer),
        log_conductivity=_joined_if_there([o.log_conductivity for o in separately], magnetometer),
    )


def _joined_if_there(
    parts: list[ComplexArray | None], magnetometer: Magnetometer
) -> ComplexArray | None:
    """Return the derivatives of the coils from those at `points_apart`, if available."""
    there = [part for part in parts if part is not None]
    return joined_phasors(there, magnetometer) if there else None
