"""The ellipse of a rotating field: the axes of a dipole's, and nothing that a drive phase moves."""

import numpy as np
import pytest

from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p004_fingerprints.equations import eq_05_normal
from magfusion.receiver.ellipse import plane_normal, rms_amplitude, semi_axes
from magfusion.units import MU0_OVER_4PI

MOMENT = 65.0  # A m^2


def rotating(offset, first=MOMENT, second=MOMENT):
    """Return the phasor of moments along x, cosine, and y, sine."""
    along_x = dipole_field(offset, np.array([first, 0.0, 0.0]))
    along_y = dipole_field(offset, np.array([0.0, second, 0.0]))
    return along_x - 1j * along_y


def places(count=200, seed=1):
    """Return directions all around and distances."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction, rng.uniform(1.0, 20.0, count)


def any_phasors(seed=2):
    rng = np.random.default_rng(seed)
    return 1e-8 * (rng.standard_normal((50, 3, 3)) + 1j * rng.standard_normal((50, 3, 3)))


def test_the_axes_of_a_rotating_dipole_are_those_of_theory() -> None:
    direction, distance = places()
    phasor = rotating(direction * distance[:, None])
    unit = MU0_OVER_4PI * MOMENT / distance**3
    sine_square = 1.0 - direction[:, 2] ** 2
    minor, major = semi_axes(phasor).T
    np.testing.assert_allclose(minor / unit, 1.0, rtol=1e-9)
    np.testing.assert_allclose(major / unit, np.sqrt(1.0 + 3.0 * sine_square), rtol=1e-9)
    expected = np.sqrt(0.5 * (2.0 + 3.0 * sine_square))
    np.testing.assert_allclose(rms_amplitude(phasor) / unit, expected, rtol=1e-9)


def test_the_normal_is_that_of_theory_even_of_unequal_coils() -> None:
    direction, distance = places()
    phasor = rotating(direction * distance[:, None], 1.3 * MOMENT, 0.8 * MOMENT)
    scale = 1.3 * 0.8 * (MU0_OVER_4PI * MOMENT / distance**3) ** 2
    expected = eq_05_normal(direction)
    np.testing.assert_allclose(plane_normal(phasor) / scale[:, None], expected, atol=1e-12)


def test_the_normal_is_the_mean_over_pairs_of_samples_a_quarter_period_apart() -> None:
    phasor = any_phasors()[:, 0]
    turn = np.exp(2j * np.pi * np.arange(40) / 40)[:, None, None]
    field, later = np.real(phasor * turn), np.real(phasor * turn * 1j)
    mean = np.mean(np.cross(field, later), axis=0)
    np.testing.assert_allclose(plane_normal(phasor) * 1e16, mean * 1e16, rtol=1e-12, atol=1e-14)


def test_the_axes_are_the_extremes_of_the_amplitude_over_a_period() -> None:
    phasor = any_phasors()[:, 0]
    turn = np.exp(2j * np.pi * np.arange(20_000) / 20_000)[:, None]
    for one, (minor, major) in zip(phasor, semi_axes(phasor), strict=True):
        length = np.linalg.norm(np.real(one * turn), axis=1)
        # A flat minimum between samples: second order in their distance.
        np.testing.assert_allclose([length.min(), length.max()], [minor, major], rtol=1e-5)
        assert rms_amplitude(one) == pytest.approx(np.sqrt(np.mean(length**2)), rel=1e-12)


@pytest.mark.parametrize("phase", [np.pi, 0.3, -2.0])
def test_no_feature_sees_the_drive_phase(phase: float) -> None:
    phasor = any_phasors()
    rotated = phasor * np.exp(1j * phase)
    for feature, size in (
        (plane_normal, 1e16),
        (semi_axes, 1e8),
        (rms_amplitude, 1e8),
    ):
        np.testing.assert_allclose(
            size * feature(rotated), size * feature(phasor), rtol=1e-11, atol=1e-13
        )


def test_reversing_the_rotation_reverses_the_normal_and_nothing_else() -> None:
    phasor = any_phasors()
    reversed_ = np.conj(phasor)
    np.testing.assert_array_equal(plane_normal(reversed_), -plane_normal(phasor))
    np.testing.assert_allclose(semi_axes(reversed_), semi_axes(phasor), rtol=1e-12)


def test_a_field_along_a_line_has_no_normal_and_no_field_no_axes() -> None:
    line = np.exp(0.7j) * np.array([3e-8, 4e-8, 0.0])
    np.testing.assert_allclose(plane_normal(line) * 1e16, 0.0, atol=1e-12)
    np.testing.assert_allclose(semi_axes(line) * 1e8, [0.0, 5.0], rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(semi_axes(np.zeros(3, dtype=complex)), [0.0, 0.0])


def test_a_nearly_flat_ellipse_keeps_its_minor_axis() -> None:
    flat = np.array([1e-6, -1e-16j, 0.0])
    np.testing.assert_allclose(semi_axes(flat), [1e-16, 1e-6], rtol=1e-12)
