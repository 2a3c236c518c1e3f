"""Directions and attitudes of paper 004 as printed, and the exact ones beside them."""

from dataclasses import replace

import numpy as np
import pytest
import tilted_attitude
from scipy.spatial.transform import Rotation
from tensor_fix import locate_by_tensor

from magfusion.estimation.snapshot.candidates import beacon_directions
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Coil
from magfusion.papers.p004_fingerprints.direction import attitude_from_vectors
from magfusion.papers.p004_fingerprints.equations import (
    eq_05_normal,
    eq_07_direction,
    eq_21_attitude_as_printed,
    eq_23_angles,
)
from magfusion.receiver.ellipse import plane_normal
from magfusion.units import DEGREE, MU0_OVER_4PI

MOMENT = 65.0  # A m^2


def beacon(*coils):
    """Return a beacon of the paper's two coils, or of others."""
    plain = tilted_attitude.build(MOMENT).beacons[0]
    return replace(plain, coils=coils) if coils else plain


def directions(count=300, seed=1):
    result = np.random.default_rng(seed).standard_normal((count, 3))
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def seen_from(source, offset):
    """Return phasors (n, tones, 3) in beacon axes."""
    coils = dipole_field(offset[:, None], source.moments_beacon)
    return np.swapaxes(source.excitation, 0, 1) @ coils


def upper(direction):
    return np.where(direction[..., 2:] < 0.0, -direction, direction)


def test_a_direction_survives_its_normal() -> None:
    polar, azimuth = np.meshgrid(np.linspace(0.0, 89.99, 200), np.arange(-175.0, 180.0, 10.0))
    rotated = Rotation.from_euler("ZY", np.stack([azimuth, polar], -1).reshape(-1, 2), degrees=True)
    direction = rotated.apply([0.0, 0.0, 1.0])
    result = eq_07_direction(1e-16 * eq_05_normal(direction))
    np.testing.assert_allclose(result, direction, atol=1e-12)


def test_the_printed_angle_belongs_to_a_level_normal() -> None:
    result = eq_07_direction(np.array([2.0, 0.0, 0.0]))
    assert np.arccos(result[2]) / DEGREE == pytest.approx(35.2644, abs=5e-5)


def test_opposite_directions_share_a_normal_and_the_upper_one_is_returned() -> None:
    direction = directions()
    normal = eq_05_normal(direction)
    np.testing.assert_allclose(eq_05_normal(-direction), normal, atol=1e-15)
    np.testing.assert_allclose(np.sum(normal**2, -1), 4.0 - 3.0 * direction[:, 2] ** 2, rtol=1e-12)
    np.testing.assert_allclose(eq_07_direction(normal), upper(direction), atol=1e-11)


def test_the_tensor_locates_any_beacon_of_two_axes_exactly_in_all_directions() -> None:
    uneven = (
        Coil(np.array([70.0, 5.0, -3.0]), 0.3),
        Coil(np.array([2.0, 40.0, 9.0]), -1.1),
    )
    separate = tuple(
        Coil(m, frequency_hz=f)
        for m, f in ((np.array([50.0, 0.0, 0.0]), 20.0), (np.array([0.0, 60.0, 20.0]), 25.0))
    )
    direction = directions()
    distance = np.random.default_rng(2).uniform(1.0, 15.0, len(direction))
    for source in (beacon(), beacon(*uneven), beacon(*separate)):
        phasor = seen_from(source, direction * distance[:, None])
        result = locate_by_tensor(source, phasor)
        np.testing.assert_allclose(result.direction_beacon, upper(direction), atol=1e-9)
        np.testing.assert_allclose(result.distance, distance, rtol=1e-9)
        size = np.linalg.norm(phasor, axis=(-1, -2))
        np.testing.assert_allclose(result.residual / size, 0.0, atol=1e-12)


def test_the_residual_is_the_asymmetry_of_the_tensor_and_tells_a_turned_sensor() -> None:
    first, second = 50.0, 80.0
    source = beacon(
        Coil(np.array([first, 0.0, 0.0])), Coil(np.array([0.0, second, 0.0]), -np.pi / 2.0)
    )
    yaw = Rotation.from_euler("z", 3.0, degrees=True)
    phasor = seen_from(source, 4.0 * directions()) @ yaw.as_matrix()
    result = locate_by_tensor(source, phasor)
    asymmetry = phasor[:, 0, 1].real / first + phasor[:, 0, 0].imag / second  # Bs is -Im
    share = first * second / np.hypot(first, second)
    np.testing.assert_allclose(result.residual * 1e9, np.abs(asymmetry) * share * 1e9, atol=1e-9)
    assert np.median(result.residual / np.linalg.norm(phasor, axis=(-1, -2))) > 0.01


def test_one_axis_is_refused() -> None:
    alone = beacon(Coil(np.array([0.0, 0.0, 65.0])))
    with pytest.raises(ValueError, match="beacon M1: one axis does not determine a direction"):
        locate_by_tensor(alone, np.zeros((1, 3), dtype=complex))


def test_the_gram_matrix_leaves_four_directions_and_one_range_at_any_attitude() -> None:
    direction, source = directions(50), beacon()
    attitude = Rotation.random(50, random_state=3).as_matrix()
    phasor = seen_from(source, 4.0 * direction) @ attitude
    result, distance = beacon_directions(source, phasor)
    half_turn, mirror = np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, 1.0, -1.0])
    group = np.stack([np.eye(3), half_turn, mirror, -np.eye(3)])
    expected = np.einsum("gij,nj->ngi", group, direction)
    gap = np.linalg.norm(result[:, :, None] - expected[:, None], axis=-1)
    assert result.shape == (50, 4, 3)
    np.testing.assert_allclose(gap.min(axis=1), 0.0, atol=1e-7)
    np.testing.assert_allclose(gap.min(axis=2), 0.0, atol=1e-7)
    np.testing.assert_allclose(distance, 4.0, rtol=1e-9)


def direction_variance(source, direction, locate, relative=1e-6):
    """Return the mean square direction error per variance of a component, (K m / r^3)^2 = 1."""
    phasor = seen_from(source, direction[None])
    steps = np.array([*np.eye(3), *(1j * np.eye(3))]) * MU0_OVER_4PI * MOMENT
    ahead, behind = (locate(phasor + sign * relative * steps[:, None]) for sign in (1.0, -1.0))
    return float(np.sum(((ahead - behind) / (2.0 * relative)) ** 2))


@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0])
@pytest.mark.parametrize(
    ("polar_deg", "by_tensor", "by_normal"),
    [(5.0, 0.224, 0.228), (54.7, 0.208, 1.13), (80.0, 0.170, 14.5), (85.0, 0.168, 58.0)],
)
def test_noise_turns_the_directions_as_far_as_expected(
    azimuth_deg: float, polar_deg: float, by_tensor: float, by_normal: float
) -> None:
    source = beacon()
    turn = Rotation.from_euler("ZY", [azimuth_deg, polar_deg], degrees=True)
    direction = turn.apply([0.0, 0.0, 1.0])
    tensor = direction_variance(
        source, direction, lambda y: locate_by_tensor(source, y).direction_beacon
    )
    normal = direction_variance(source, direction, lambda y: eq_07_direction(plane_normal(y[:, 0])))
    assert tensor == pytest.approx(by_tensor, rel=0.05)
    assert normal == pytest.approx(by_normal, rel=0.05)


def test_equation_18_holds_for_turns_about_the_beacons_axis_only() -> None:
    normal = eq_05_normal(directions())
    yaw, tilt = (Rotation.from_euler(axis, 10.0, degrees=True) for axis in "zx")
    direction = eq_07_direction(normal)
    rotated = eq_07_direction(yaw.apply(normal))
    np.testing.assert_allclose(rotated, yaw.apply(direction), atol=1e-12)
    separate = np.linalg.norm(eq_07_direction(tilt.apply(normal)) - tilt.apply(direction), axis=-1)
    assert np.median(separate) > 0.05


def test_least_squares_as_printed_returns_the_rotation_of_true_pseudo_directions() -> None:
    world = directions(40).reshape(10, 4, 3)
    attitude = Rotation.random(10, random_state=4).as_matrix()  # sensor_from_world
    sensor = world @ np.swapaxes(attitude, -1, -2)
    result = eq_21_attitude_as_printed(sensor, world)
    np.testing.assert_allclose(result, attitude, atol=1e-9)
    gamma, psi, lam = Rotation.from_matrix(result).as_euler("ZYX").T
    np.testing.assert_allclose(eq_23_angles(result), np.stack([psi, gamma, lam], -1), atol=1e-7)


def test_the_phasors_of_a_single_beacon_give_the_attitude_exactly() -> None:
    world = seen_from(beacon(), 5.0 * directions())
    attitude = Rotation.random(len(world), random_state=5).as_matrix()  # world_from_sensor
    result = attitude_from_vectors(world @ attitude, world)
    np.testing.assert_allclose(result, attitude, atol=1e-12)


@pytest.mark.slow
def test_the_fix_errs_as_little_at_any_attitude_as_at_none() -> None:
    site = tilted_attitude.build(MOMENT)
    rng = np.random.default_rng(6)
    spots = rng.uniform([0.6, 0.6, 0.5], [5.1, 3.9, 0.5], (900, 3))
    separate = np.linalg.norm(spots[:, None] - tilted_attitude.BEACONS_WORLD, axis=-1)
    spots = spots[np.min(separate, axis=1) > 0.8]
    axis = rng.standard_normal(spots.shape)
    mean_deg = []
    for tilt_deg in (0.0, 10.0, 60.0, 180.0):
        true = tilted_attitude.turns(tilt_deg * DEGREE, axis)
        level = np.broadcast_to(np.eye(3), true.shape)
        samples = tilted_attitude.observe(site, spots, level, 3e-10, seed=7)
        # The same noise in world axes, so that nothing but the attitude differs.
        rotated = samples.phasor_sensor @ np.swapaxes(true, -1, -2)
        samples = replace(samples, phasor_sensor=rotated)
        fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
        result = np.swapaxes(fixes.world_from_body[:, 0], -1, -2)
        mean_deg.append(float(np.mean(tilted_attitude.between_deg(result, true))))
    assert mean_deg[0] == pytest.approx(0.040, rel=0.1)  # deg
    assert np.ptp(mean_deg) < 1e-3  # deg
