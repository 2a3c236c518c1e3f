"""The dipole's field and gradient against physical laws, magpylib and difference quotients."""

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model.physics.dipole import dipole_field, dipole_field_and_gradient
from magfusion.units import MU0_OVER_4PI

EXACT = 1e-13  # relative; rounding of a few dozen operations


def dipole_gradient(offset: np.ndarray, moment: np.ndarray) -> np.ndarray:
    field, gradient = dipole_field_and_gradient(offset, moment)
    np.testing.assert_array_equal(field, dipole_field(offset, moment))
    return gradient


def offsets_and_moments(seed=1, count=300):
    """Offsets of 0.3 m to 30 m in all directions, moments of 1 to 1000 A m^2."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(2, count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    distance = 10.0 ** rng.uniform(-0.5, 1.5, (count, 1))
    size = 10.0 ** rng.uniform(0.0, 3.0, (count, 1))
    return directions[0] * distance, directions[1] * size


def relative(result, expected):
    """Return the largest error of a row in units of the size of that row."""
    error = np.linalg.norm((result - expected).reshape(len(result), -1), axis=1)
    return np.max(error / np.linalg.norm(np.reshape(expected, (len(result), -1)), axis=1))


def test_on_the_axis_the_field_is_twice_the_moment_over_the_cube_and_along_it():
    offset, moment = offsets_and_moments()
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    along = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    for side in (1.0, -1.0):
        result = dipole_field(side * distance * along, moment)
        assert relative(result, 2.0 * MU0_OVER_4PI * moment / distance**3) < EXACT


def test_on_the_equator_the_field_is_the_moment_over_the_cube_and_against_it():
    offset, moment = offsets_and_moments()
    across = np.cross(offset, moment)
    distance = np.linalg.norm(across, axis=1, keepdims=True)
    result = dipole_field(across, moment)
    assert relative(result, -MU0_OVER_4PI * moment / distance**3) < EXACT


def test_one_ampere_square_metre_makes_200_nanotesla_a_metre_up_its_axis():
    result = dipole_field(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(result, [0.0, 0.0, 2e-7], rtol=1e-15)


def test_the_field_is_the_same_on_opposite_sides():
    offset, moment = offsets_and_moments()
    assert np.array_equal(dipole_field(-offset, moment), dipole_field(offset, moment))


def test_twice_as_far_the_field_is_an_eighth_and_its_gradient_a_sixteenth():
    offset, moment = offsets_and_moments()
    assert relative(8.0 * dipole_field(2.0 * offset, moment), dipole_field(offset, moment)) < EXACT
    far, near = dipole_gradient(2.0 * offset, moment), dipole_gradient(offset, moment)
    assert relative(16.0 * far, near) < EXACT


def test_the_field_is_linear_in_the_moment():
    offset, moment = offsets_and_moments()
    other = moment[::-1]
    summed = 2.0 * dipole_field(offset, moment) - 3.0 * dipole_field(offset, other)
    assert relative(dipole_field(offset, 2.0 * moment - 3.0 * other), summed) < 1e-11


def test_the_field_turns_with_its_source():
    offset, moment = offsets_and_moments()
    turn = Rotation.random(len(offset), random_state=2)
    field, gradient = dipole_field(offset, moment), dipole_gradient(offset, moment)
    args = turn.apply(offset), turn.apply(moment)
    matrix = turn.as_matrix()
    assert relative(dipole_field(*args), turn.apply(field)) < EXACT
    expected = matrix @ gradient @ np.swapaxes(matrix, 1, 2)
    assert relative(dipole_gradient(*args), expected) < EXACT


def test_the_field_has_neither_curl_nor_divergence():
    offset, moment = offsets_and_moments()
    gradient = dipole_gradient(offset, moment)
    size = np.linalg.norm(gradient, axis=(1, 2))
    assert np.array_equal(gradient, np.swapaxes(gradient, 1, 2))
    assert np.max(np.abs(np.trace(gradient, axis1=1, axis2=2)) / size) < EXACT


def test_the_gradient_is_the_difference_quotient_of_the_field():
    offset, moment = offsets_and_moments()
    step = 1e-5 * np.linalg.norm(offset, axis=1)  # its square is the error of the quotient
    quotient = np.empty((len(offset), 3, 3))
    for j, axis in enumerate(np.eye(3)):
        ahead, behind = (dipole_field(offset + s * step[:, None] * axis, moment) for s in (1, -1))
        quotient[:, :, j] = (ahead - behind) / (2.0 * step[:, None])
    assert relative(dipole_gradient(offset, moment), quotient) < 1e-8


def test_a_batch_is_what_its_rows_are_and_arguments_broadcast():
    offset, moment = offsets_and_moments(count=12)
    for function in (dipole_field, dipole_gradient):
        rows = np.array([function(o, m) for o, m in zip(offset, moment, strict=True)])
        np.testing.assert_allclose(function(offset, moment), rows, rtol=1e-14)
        table = function(offset[:, None], moment)
        assert table.shape[:2] == (12, 12)
        np.testing.assert_allclose(table[3, 7], function(offset[3], moment[7]), rtol=1e-14)


@pytest.mark.parametrize("seed", [3, 4])
def test_the_field_is_that_of_magpylib(seed):
    offset, moment = offsets_and_moments(seed, count=40)
    expected = [magpylib.misc.Dipole(moment=m).getB(o) for o, m in zip(offset, moment, strict=True)]
    # magpylib takes mu0 as measured, which is 4 pi 1e-7 within 1e-9.
    assert relative(dipole_field(offset, moment), np.array(expected)) < 1e-9
