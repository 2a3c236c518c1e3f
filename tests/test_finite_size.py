"""The first term of the coils' size, against exact fluxes and difference quotients."""

import numpy as np
import pytest
from derivatives import central_difference

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.finite_size import coil_coupling, disc_kappa, square_kappa
from magfusion.model.physics.solenoid import loop_field

OFFSET = np.array([0.31, -0.22, 0.4])  # m
MOMENT = np.array([0.4, 1.1, -0.7])  # A m^2
SENSITIVITY = np.array([-0.6, 0.3, 0.9])
KAPPAS = (np.array(2e-3), np.array(1e-3))  # m^2


def test_points_couple_as_dipoles() -> None:
    expected = SENSITIVITY @ dipole_field(OFFSET, MOMENT)
    result = coil_coupling(OFFSET, MOMENT, SENSITIVITY).value
    assert result == pytest.approx(expected, rel=1e-14)
    sized = coil_coupling(OFFSET, MOMENT, SENSITIVITY, np.array(0.0), np.array(0.0)).value
    assert sized == pytest.approx(expected, rel=1e-14)


def test_the_term_is_the_second_derivative_along_the_axis() -> None:
    step, axis = 1e-3, MOMENT / np.linalg.norm(MOMENT)  # m
    fields = [
        SENSITIVITY @ dipole_field(OFFSET + k * step * axis, MOMENT) for k in (-1.0, 0.0, 1.0)
    ]
    expected = fields[1] - KAPPAS[0] * (fields[0] - 2.0 * fields[1] + fields[2]) / step**2
    result = coil_coupling(OFFSET, MOMENT, SENSITIVITY, KAPPAS[0]).value
    assert result == pytest.approx(expected, rel=1e-6)


def test_reciprocity() -> None:
    there = coil_coupling(OFFSET, MOMENT, SENSITIVITY, *KAPPAS).value
    back = coil_coupling(-OFFSET, SENSITIVITY, MOMENT, *KAPPAS[::-1]).value
    assert there == pytest.approx(back, rel=1e-13)


@pytest.mark.parametrize("transmits", [True, False])
def test_a_loop_is_met_to_the_next_order(transmits: bool) -> None:
    """Against Biot and Savart: what is left falls with the fourth power of size over distance."""
    remaining, plain = [], []
    for radius in (0.04, 0.02):
        kappa = np.array(disc_kappa(radius))
        if transmits:
            exact = float(SENSITIVITY @ loop_field(OFFSET[None], MOMENT, radius)[0])
            result = coil_coupling(OFFSET, MOMENT, SENSITIVITY, kappa).value
        else:  # by reciprocity the flux of a dipole's field through the loop
            exact = float(MOMENT @ loop_field(-OFFSET[None], SENSITIVITY, radius)[0])
            result = coil_coupling(OFFSET, MOMENT, SENSITIVITY, None, kappa).value
        remaining.append(abs(result / exact - 1.0))
        plain.append(abs(coil_coupling(OFFSET, MOMENT, SENSITIVITY).value / exact - 1.0))
    assert plain[0] / plain[1] == pytest.approx(4.0, rel=0.1)
    assert remaining[0] / remaining[1] == pytest.approx(16.0, rel=0.1)
    assert remaining[1] < 0.02 * plain[1]


def test_the_mean_over_a_square() -> None:
    """Of the field of a dipole, by Gauss-Legendre nodes over the square."""
    side, axis = 0.08, SENSITIVITY / np.linalg.norm(SENSITIVITY)  # m
    across = np.linalg.svd(axis[None])[2][1:]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    places = OFFSET + 0.5 * side * (
        nodes[:, None, None] * across[0] + nodes[None, :, None] * across[1]
    )
    mean = np.einsum("i,j,ijk,k", weights, weights, dipole_field(places, MOMENT), SENSITIVITY) / 4.0
    kappa = np.array(square_kappa(side))
    result = coil_coupling(OFFSET, MOMENT, SENSITIVITY, None, kappa).value
    plain = coil_coupling(OFFSET, MOMENT, SENSITIVITY).value
    assert abs(result - mean) < 0.03 * abs(plain - mean)


def test_derivatives() -> None:
    result = coil_coupling(OFFSET, MOMENT, SENSITIVITY, *KAPPAS)

    def moved(step: np.ndarray) -> np.ndarray:
        return coil_coupling(
            OFFSET + step[:3],
            MOMENT + step[3:6],
            SENSITIVITY + step[6:9],
            KAPPAS[0] + 1e-3 * step[9],
            KAPPAS[1] + 1e-3 * step[10],
        ).value

    by_kappa = 1e-3 * np.array([result.by_kappa_moment, result.by_kappa_sensitivity])
    parts = (result.by_offset, result.by_moment, result.by_sensitivity, by_kappa)
    expected = central_difference(moved, 11, 1e-5)
    for columns, part in zip(np.split(expected, [3, 6, 9]), parts, strict=True):
        np.testing.assert_allclose(part, columns, rtol=0, atol=1e-7 * np.max(np.abs(columns)))
