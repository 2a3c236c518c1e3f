"""Paper 004, equation by equation: field, direction, range and fingerprint of a rotating beacon.

A direction ``(u, v, e)``, shape (..., 3), is the unit vector from the beacon to the sensor and an
offset the same with its length (m), both in beacon axes; its polar angle phi counts from the axis
of rotation z, its azimuth theta from x (rad).  A phase is ``w t`` (rad), an amplitude the root of
the mean square over time (T).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p004_fingerprints.direction import attitude_from_vectors
from magfusion.receiver.ellipse import plane_normal, rms_amplitude
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

NOT_FUNCTIONS = {
    10: "states that Eq 8 gives one normal from all pairs; Right of pairs equally far apart",
    22: "names the matrices of Eq 21, whose columns are the directions of Eq 19",
}


# 2.1 The beacon ---------------------------------------------------------------------------------


def eq_01_coil_fields(offset: Array, moments: Array, phase: Array) -> tuple[Array, Array]:
    """Return Bc and Bs (..., 3) (T) of two coils of peak moments (2,) (A m^2) at a phase (...).

    Right.
    """
    along_x, along_y = eq_03_currents(moments, phase)
    x, y, _ = np.eye(3)
    return dipole_field(offset, along_x[..., None] * x), dipole_field(
        offset, along_y[..., None] * y
    )


def eq_02_direction(polar: Array, azimuth: Array) -> Array:
    """Return the direction (u, v, e) of polar angle and azimuth (...).  Right."""
    flat = np.sin(polar)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)], axis=-1)


def eq_03_currents(amplitude: Array, phase: Array) -> tuple[Array, Array]:
    """Return both coils' currents, or proportional quantities, of amplitudes (2,).

    Corrected: cosine and sine, as in Eq 1.
    """
    return amplitude[0] * np.cos(phase), amplitude[1] * np.sin(phase)


def eq_03_currents_as_printed(amplitude: Array, phase: Array) -> tuple[Array, Array]:
    """Return both currents.  Misprint: two sines make a field that oscillates along a line."""
    return amplitude[0] * np.sin(phase), amplitude[1] * np.sin(phase)


def eq_04_field(offset: Array, moments: Array, phase: Array) -> Array:
    """Return B = Bc + Bs; arguments as in `eq_01_coil_fields`.  Right, of unequal moments too."""
    return np.add(*eq_01_coil_fields(offset, moments, phase))


def eq_05_normal(direction_beacon: Array) -> Array:
    """Return the normal ``3 e n - 2 z`` of the field's plane in direction n = (u, v, e).

    Right, here without its factor.  The normal of the phasors is ``mc ms K^2 / r^6`` times it, for
    any two moments in the plane of the coils; its square is ``4 - 3 e^2``, hence never zero.
    """
    height = direction_beacon[..., 2:]
    return 3.0 * height * direction_beacon - [0.0, 0.0, 2.0]


def eq_05_normal_at(offset: Array, moments: Array, phase: Array) -> Array:
    """Return ``Bc(t) x Bs(t)`` (T^2).

    Right: it stays on one line; its sign alternates, so that its mean over a period is zero.
    """
    return np.cross(*eq_01_coil_fields(offset, moments, phase))


def eq_06_polar_of_normal(normal_beacon: Array) -> Array:
    """Return the angle (rad, 0 to pi) of a normal (..., 3) from z.  Corrected: arctan of two."""
    x, y, z = np.moveaxis(normal_beacon, -1, 0)
    return np.arctan2(np.hypot(x, y), z)


def eq_06_tangent_as_printed(normal_beacon: Array) -> Array:
    """Return the tangent of that angle.  Misprint: the denominator is the z component, not x."""
    x, y, _ = np.moveaxis(normal_beacon, -1, 0)
    return np.hypot(x, y) / x


def eq_06_tangent_of_polar(polar: Array) -> Array:
    """Return the tangent of the normal's angle seen at a polar angle to 90 degrees.  Right."""
    return 3.0 * np.sin(2.0 * polar) / (3.0 * np.cos(2.0 * polar) - 1.0)


def eq_07_direction(normal_beacon: Array) -> Array:
    """Return the direction, z >= 0, whose plane has a normal (..., 3) of any length.

    Right: the branches of `eq_07_angles` in one formula.  The opposite direction has the same
    normal.  In a sensor's axes the normal is meaningless unless the sensor is rotated about z
    alone: see Eq 18.
    """
    polar_of_normal = eq_06_polar_of_normal(normal_beacon)
    polar = 0.5 * (polar_of_normal - np.arcsin(np.sin(polar_of_normal) / 3.0))
    return eq_02_direction(polar, np.arctan2(normal_beacon[..., 1], normal_beacon[..., 0]))


def eq_07_angles(polar_of_normal: Array, normal_beacon: Array) -> tuple[Array, Array]:
    """Return polar angle and azimuth (rad) by the printed branches.

    Right: of the angle between normal and z, 0 to 180 degrees, and a two-argument arctangent.
    """
    tangent = np.tan(polar_of_normal)
    share = np.arcsin(tangent / (3.0 * np.sqrt(1.0 + tangent**2)))
    below, level = polar_of_normal < 0.5 * np.pi, polar_of_normal == 0.5 * np.pi
    polar = 0.5 * (polar_of_normal + np.where(below, -share, share))
    azimuth = np.arctan2(normal_beacon[..., 1], normal_beacon[..., 0])
    return np.where(level, np.deg2rad(35.2644), polar), azimuth


def eq_08_normal(earlier: Array, later: Array) -> Array:
    """Return ``B(t2) x B(t1)`` of fields (..., 3).  Misprint: Eq 7 requires B(t1) x B(t2)."""
    return np.cross(later, earlier)


eq_09_normal_as_printed = eq_08_normal
"""Misprint: the factors are interchanged, as in Eq 8."""

eq_11_normal = plane_normal
"""Corrected: the phasors, fitted by least squares, use the samples better than pairs of them."""


def eq_11_mean_as_printed(samples: Array) -> Array:
    """Return the constant (..., 3) that best fits samples (..., n, 3).

    Right for the normals of Eq 8.  False for the field: its mean over a period is zero.
    """
    return np.mean(samples, axis=-2)


# 2.2 Ranges and attitude ------------------------------------------------------------------------

eq_12_field = dipole_field
"""Right.  The moment rotates, so that its magnitude is constant only for equal coils."""


def eq_13_log_field(offset: Array, moment: Array) -> Array:
    """Return ln |B| (B in T) of a moment (..., 3) (A m^2).  Misprint: ``ln B``; Right else."""
    distance = np.linalg.norm(offset, axis=-1)
    angular = eq_14_angular_term(offset / distance[..., None], moment)
    return eq_15_log_amplitude(distance, -3.0, eq_16_intercept(angular))


def eq_14_angular_term(direction_beacon: Array, moment: Array) -> Array:
    """Return ``ln |3 (n . m) n - m|``.

    False: that ``|ln (mu0 / 4 pi)|`` is large does not make this term constant.  The amplitude
    varies by 1.58 from pole to equator, the range by 1.17.
    """
    return np.log(np.linalg.norm(dipole_field(direction_beacon, moment), axis=-1) / MU0_OVER_4PI)


def eq_15_log_amplitude(distance: Array, slope: Array | float, intercept: Array) -> Array:
    """Return the logarithm of the amplitude (T), linear in that of the distance (m).

    Unclear: right for the minor semi-axis alone, which is ``K m / r^3`` in all directions.
    """
    return slope * np.log(distance) + intercept


def eq_16_intercept(angular: Array) -> Array:
    """Return b of Eq 15, of the term of Eq 14.  Corrected."""
    return np.log(MU0_OVER_4PI) + angular


def eq_16_intercept_as_printed(angular: Array) -> Array:
    """Return b.  Misprint: the logarithm of the absolute value of a logarithm."""
    return np.log(np.abs(np.log(MU0_OVER_4PI))) + angular


def distances(position_world: Array, beacons_world: Array) -> Array:
    """Return the distance of each point (..., 3) from each beacon (m), shape (..., beacons)."""
    return np.linalg.norm(position_world[..., None, :] - beacons_world, axis=-1)


def eq_17_misfit(position_world: Array, beacons_world: Array, ranges: Array) -> Array:
    """Return the sum of the squared errors of ranges (..., beacons) (m^2).

    Right; beacons in one plane leave two mirror positions.
    """
    return np.sum((distances(position_world, beacons_world) - ranges) ** 2, axis=-1)


def eq_18_pseudo_direction_as_printed(sensor_from_world: Array, direction_world: Array) -> Array:
    """Return the result of Eq 7, according to the paper, for a normal in sensor axes: a direction.

    False: Eq 7 depends on the beacon's z axis and commutes with rotations about it alone.  Among
    the points of Table 1 one degree of tilt gives two to three degrees of attitude error.
    """
    return (sensor_from_world @ direction_world[..., None])[..., 0]


def eq_19_direction(position_world: Array, beacons_world: Array) -> Array:
    """Return the directions (..., beacons, 3) from beacons to positions (..., 3).

    Right.  Its second line, for the measured angles, is `eq_02_direction`.
    """
    offset = position_world[..., None, :] - beacons_world
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def eq_20_attitude(angles: Array) -> Array:
    """Return ``Rz(gamma) Ry(psi) Rx(lambda)`` of psi, gamma, lambda (..., 3) (rad).  Right."""
    turn = Rotation.from_euler("ZYX", angles[..., [1, 0, 2]].reshape(-1, 3))
    return turn.as_matrix().reshape(*angles.shape, 3)


eq_21_attitude = attitude_from_vectors
"""Corrected: the nearest rotation; exact for phasors, but no remedy for Eq 18."""


def eq_21_attitude_as_printed(direction_sensor: Array, direction_world: Array) -> Array:
    """Return sensor_from_world (..., 3, 3) by least squares from directions (..., beacons, 3).

    False: in general no rotation, and for three beacons it averages nothing. Raises
    numpy.linalg.LinAlgError where the directions lie exactly in one plane; close to one the matrix
    means little.
    """
    seen, known = np.swapaxes(direction_sensor, -1, -2), np.swapaxes(direction_world, -1, -2)
    return seen @ direction_world @ np.linalg.inv(known @ direction_world)


def eq_23_angles(sensor_from_world: Array) -> Array:
    """Return psi, gamma, lambda (..., 3) (rad) of Eq 20.  Right: two-argument arctangents.

    No scipy Rotation, because the matrix of Eq 21 is none.
    """
    c = sensor_from_world
    psi = -np.arcsin(np.clip(c[..., 2, 0], -1.0, 1.0))
    gamma = np.arctan2(c[..., 1, 0], c[..., 0, 0])
    return np.stack([psi, gamma, np.arctan2(c[..., 2, 1], c[..., 2, 2])], axis=-1)


# 2.3 Disturbances -------------------------------------------------------------------------------


def eq_24_ring_moment(turns: float, area: float, resistance: float, field_rate: Array) -> Array:
    """Return the moment (A m^2) of a ring of an area (m^2) in a field's rate of change (T/s).

    Corrected: against the change (Lenz), and turns in series: each adds to the voltage as well.  A
    ring has no inductance; a body is
    `magfusion.model.physics.disturbance.sphere_polarizability`.
    """
    return -turns * eq_24_moment_of_closed_rings(turns, area, resistance, field_rate)


def eq_24_moment_of_closed_rings(
    turns: float, area: float, resistance: float, field_rate: Array
) -> Array:
    """Return ``N S^2 / R dB/dt``.

    Unclear: right for N closed rings of R each and n against the field.
    """
    return turns * area**2 / resistance * field_rate


# 2.4 Fingerprints -------------------------------------------------------------------------------


def eq_25_fingerprint(phasor: ComplexArray) -> Array:
    """Return the amplitude (...) of one beacon from the phasors of its tones (..., tones, 3).

    Unclear: the paper does not specify which amplitude; this is the root of the mean square.
    """
    return np.linalg.norm(rms_amplitude(phasor), axis=-1)


eq_26_fingerprint_of_survey = eq_25_fingerprint
"""Unclear as Eq 25, for the points of the survey."""


def eq_27_position(difference: Array, position_world: Array) -> Array:
    """Return the mean of points (n, k, 3) weighted by the inverse of their differences (n, k).

    Right, as a method of large error; the point itself where one matches exactly, for which it is
    0 / 0.  Of logarithms of the fields the error is less than a fifth of that in nT, where the
    nearest beacon outweighs all others.
    """
    met = difference == 0.0
    share = np.where(met.any(axis=1, keepdims=True), met, 1.0 / np.where(met, 1.0, difference))
    share = share / np.sum(share, axis=1, keepdims=True)
    return np.einsum("nj,njx->nx", share, position_world)


def eq_28_range(reach: Array, amplitude: Array, fingerprint: Array, slope: Array) -> Array:
    """Return the range to a beacon from its amplitude at a point at a known distance (m).

    Corrected: the intercept cancels and leaves a ratio of ranges, the right way up.
    """
    return reach * np.exp((np.log(amplitude) - np.log(fingerprint)) / slope)


def eq_28_range_as_printed(
    amplitude: Array, fingerprint: Array, slope: Array, intercept: Array
) -> Array:
    """Return "the distance to the fingerprint".

    False: some 22 m times the ratio of the two ranges to the beacon.
    """
    return np.exp((np.log(fingerprint) - np.log(amplitude) - intercept) / slope)


def eq_29_misfit(position_world: Array, beacons_world: Array, ranges: Array) -> Array:
    """Return Eq 17 of the ranges' (..., k, beacons) means over the fingerprints.  Corrected."""
    return eq_17_misfit(position_world, beacons_world, np.mean(ranges, axis=-2))


def eq_29_misfit_as_printed(position_world: Array, points_world: Array, ranges: Array) -> Array:
    """Return the misfit of distances to fingerprints (k, 3) from ranges (..., k, beacons).

    False: the mean over the beacons of differences in range is no distance to a fingerprint.
    """
    return eq_17_misfit(position_world, points_world, np.mean(ranges, axis=-1))


# 3 Experiments ----------------------------------------------------------------------------------


def eq_30_mean_position_error(true_world: Array, found_world: Array) -> float:
    """Return the mean length of the errors of positions (n, 3) (m).

    Right; the rows of Table 1 have 0.095 m, not the printed 0.108 m.
    """
    return float(np.mean(np.linalg.norm(true_world - found_world, axis=-1)))


def eq_31_mean_angle_error(error: Array) -> Array:
    """Return the mean of the magnitudes of three angles' errors (..., 3) (rad).

    Right for the magnitudes; about half the angle of the rotation between the two attitudes.
    """
    return np.mean(np.abs(error), axis=-1)
