"""Measurement model of a three-axis tracker, coil by coil: all 36 parameters of both antennas.

The same formula as `magfusion.model.field.observe`, whose beacons and magnetometers are poses,
matrices and logarithms.  Here every coil's moment, sensitivity and centre is a vector with its
derivative, many antennas are predicted in one call, and coils may have a size.  It is a separate
function, so that no fix, smoother or map computes the 36 columns that only a calibration needs; a
test compares the two.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.model.physics.finite_size import coil_coupling, coil_kappa
from magfusion.model.site import Beacon, Magnetometer
from magfusion.units import Array

MOMENTS, CENTRES = slice(0, 9), slice(9, 18)  # of the transmitting antenna, coil by coil
SENSITIVITIES, SENSOR_CENTRES = slice(18, 27), slice(27, 36)  # of the receiving one
KAPPAS = slice(36, 40)  # of each transmitting coil, and of the receiving ones


@dataclass(frozen=True, eq=False)
class Antenna:
    """A transmitting and a receiving antenna of three coils each.

    Leading axes, the same in all fields, hold many antennas.
    """

    moments_beacon: Array  # (..., 3, 3), of each transmitting coil, beacon axes (A m^2)
    centres_beacon: Array  # (..., 3, 3), of each transmitting coil (m)
    # (..., 3, 3), of each receiving coil, sensor axes: the rows of the magnetometer's matrix
    sensitivities_sensor: Array
    centres_sensor: Array  # (..., 3, 3), of each receiving coil (m)
    # (..., 3), finite size of each transmitting coil (m^2, `magfusion.model.physics.finite_size`)
    kappa_beacon: Array | None = None
    kappa_sensor: Array | None = None  # (...), of the receiving coils. Both or neither

    def vector(self) -> Array:
        """Return the parameters as one vector, shape (..., 36), or (..., 40) with finite size."""
        lead = self.moments_beacon.shape[:-2]
        parts = [
            v.reshape(*lead, 9)
            for v in (
                self.moments_beacon,
                self.centres_beacon,
                self.sensitivities_sensor,
                self.centres_sensor,
            )
        ]
        if self.kappa_beacon is not None and self.kappa_sensor is not None:
            parts += [np.asarray(self.kappa_beacon)]
            parts += [np.asarray(self.kappa_sensor)[..., None]]
        return np.concatenate(parts, axis=-1)

    def at(self, index: int | tuple[int | slice | None, ...]) -> "Antenna":
        """Return a subset of the antennas, or the same with other leading axes."""
        return antenna_from_vector(self.vector()[index])


def antenna_from_vector(vector: Array) -> Antenna:
    """Return the antenna of an `Antenna.vector`, shape (..., 36) or (..., 40)."""
    lead = vector.shape[:-1]
    blocks = [
        vector[..., columns].reshape(*lead, 3, 3)
        for columns in (MOMENTS, CENTRES, SENSITIVITIES, SENSOR_CENTRES)
    ]
    sizes = [] if vector.shape[-1] == KAPPAS.start else [vector[..., 36:39], vector[..., 39]]
    return Antenna(*blocks, *sizes)


def antenna_of(beacon: Beacon, magnetometer: Magnetometer) -> Antenna:
    """Return the declared antenna of a site; without sizes where no coil has one.

    Raises InputError where the beacon does not have three coils, each alone in its tone or time
    slot.
    """
    if len(beacon.coils) != 3 or len(beacon.tones) != 3:
        raise InputError(
            f"beacon {beacon.name} has {len(beacon.coils)} coils in {len(beacon.tones)} tones or"
            " slots; a tracker needs three coils, each with a frequency or slot of its own"
        )
    kappas = np.array([coil_kappa(coil.radius, coil.length) for coil in beacon.coils])
    sizes = (kappas, np.array(magnetometer.coil_kappa))
    is_sized = bool(np.any(kappas)) or magnetometer.coil_kappa != 0.0
    centres = magnetometer.coil_centres_sensor
    return Antenna(
        moments_beacon=beacon.moments_beacon,
        centres_beacon=beacon.centres_beacon,
        sensitivities_sensor=magnetometer.matrix,
        centres_sensor=np.zeros((3, 3)) if centres is None else centres,
        **dict(zip(("kappa_beacon", "kappa_sensor"), sizes, strict=True) if is_sized else ()),
    )


class Coupling(NamedTuple):
    """Predicted couplings with their Jacobian blocks."""

    value: Array  # (..., 3, 3), rows are receiving coils, columns transmitting ones (T)
    # (..., 3, 3, 6), right perturbation of beacon_from_sensor: rotation, translation, sensor axes
    pose: Array
    antenna: Array  # (..., 3, 3, 36) or (..., 3, 3, 40), with respect to `Antenna.vector`


def observe_antenna(
    antenna: Antenna, beacon_from_sensor: Array, position_beacon: Array
) -> Coupling:
    """Predict the couplings of all pairs of coils, with the Jacobian in the same call.

    ``y_ij = s_i . R^T G(p + R b_i - c_j) m_j`` with R, p the sensor's pose in beacon axes.
    `antenna`: leading axes broadcast against those of the poses. `beacon_from_sensor` (..., 3, 3).
    `position_beacon` (..., 3): origin of the sensor (m).
    """
    turn = np.swapaxes(beacon_from_sensor, -1, -2)  # row vectors: beacon = sensor @ turn
    in_beacon = antenna.sensitivities_sensor @ turn
    place = position_beacon[..., None, :] + antenna.centres_sensor @ turn
    offset = place[..., :, None, :] - antenna.centres_beacon[..., None, :, :]
    sent, detected = antenna.kappa_beacon, antenna.kappa_sensor
    seen = coil_coupling(
        offset,
        np.broadcast_to(antenna.moments_beacon[..., None, :, :], offset.shape),
        np.broadcast_to(in_beacon[..., :, None, :], offset.shape),
        None if sent is None else np.asarray(sent)[..., None, :],
        None if detected is None else np.asarray(detected)[..., None, None],
    )
    back = beacon_from_sensor[..., None, :, :]
    by_offset, by_sensitivity = seen.by_offset @ back, seen.by_sensitivity @ back  # sensor axes
    arm = np.broadcast_to(antenna.centres_sensor[..., :, None, :], by_offset.shape)
    axis = np.broadcast_to(antenna.sensitivities_sensor[..., :, None, :], by_offset.shape)
    rotation = np.cross(arm, by_offset) + np.cross(axis, by_sensitivity)
    columns = np.zeros((*seen.value.shape, antenna.vector().shape[-1]))
    for k in range(3):
        own = slice(3 * k, 3 * k + 3)
        columns[..., :, k, MOMENTS][..., own] = seen.by_moment[..., :, k, :]
        columns[..., :, k, CENTRES][..., own] = -seen.by_offset[..., :, k, :]
        columns[..., k, :, SENSITIVITIES][..., own] = by_sensitivity[..., k, :, :]
        columns[..., k, :, SENSOR_CENTRES][..., own] = by_offset[..., k, :, :]
    if columns.shape[-1] == KAPPAS.stop:
        columns[..., 39] = seen.by_kappa_sensitivity
        for k in range(3):
            columns[..., :, k, 36 + k] = seen.by_kappa_moment[..., :, k]
    pose = np.concatenate([rotation, by_offset], axis=-1)
    return Coupling(value=seen.value, pose=pose, antenna=columns)
