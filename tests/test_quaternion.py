"""Rotations of many at once against SciPy's, and some against all."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import State, values_of
from magfusion.model import quaternion
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import MotionModel
from magfusion.model.strapdown import resting
from magfusion.receiver.slot_phasors import _pseudo_inverse
from magfusion.simulation.demo_site import demo_site


@pytest.mark.parametrize("count", [1, 3, 50, 2000])
def test_products_and_matrices_are_those_of_scipy(count: int) -> None:
    rng = np.random.default_rng(1)
    a, b = (Rotation.random(count, rng=rng) for _ in range(2))
    ours = quaternion.product(quaternion.components(a), quaternion.components(b))
    expected = (a * b).as_matrix()
    np.testing.assert_allclose(quaternion.matrices(ours), expected, rtol=0, atol=1e-14)


def test_a_product_of_one_with_many_is_that_of_each() -> None:
    rng = np.random.default_rng(2)
    one, many = rng.standard_normal((4, 1)), rng.standard_normal((4, 20))
    each = np.hstack([quaternion.product(one, many[:, k : k + 1]) for k in range(20)])
    assert np.array_equal(quaternion.product(one, many), each)


def test_no_turn_has_no_turn() -> None:
    assert np.array_equal(quaternion.of_vectors(np.zeros((3, 2)))[:, 0], [1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("rank", [1, 3, 4])
def test_the_inverse_of_a_normal_matrix_is_the_pseudo_inverse(rank: int) -> None:
    rows = np.random.default_rng(3).standard_normal((5, rank, 4))
    normal = np.swapaxes(rows, 1, 2) @ rows
    expected = np.linalg.pinv(normal, hermitian=True)
    assert _pseudo_inverse(normal) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_two_states_have_the_biases_that_were_inserted() -> None:
    rng = np.random.default_rng(4)
    calibration = initial_calibration(demo_site(), 0.0)
    vectors = rng.standard_normal((2, 4, 3))
    states = [State(0.0, np.eye(3), *each, calibration, np.eye(15)) for each in vectors]
    values = values_of(states)
    for k, (_, _, accel, gyro) in enumerate(vectors):
        bias = gtsam.imuBias.ConstantBias(accel, gyro)
        assert np.array_equal(values.atConstantBias(B(k)).vector(), bias.vector())
    assert values.size() == values_of([*states, states[0]]).size() - 3


def test_rest_is_told_of_some_samples_as_of_all() -> None:
    rng = np.random.default_rng(5)
    time = np.arange(900) / 100.0
    still = (np.abs(time - 4.0) < 2.0)[:, None]
    gyro, accel = (rng.standard_normal((900, 3)) * np.where(still, 1e-4, 1.0) for _ in range(2))
    whole = resting(time, gyro, accel, 1.0, motion=MotionModel())
    at = np.array([5, 250, 400, 555, 880])
    assert np.any(whole[at])
    assert not np.all(whole[at])
    some = resting(time, gyro, accel, 1.0, motion=MotionModel(), at=at)
    assert np.array_equal(some, whole[at])
    alone = [resting(time, gyro, accel, 1.0, motion=MotionModel(), at=at[[k]]) for k in range(5)]
    assert np.array_equal(np.concatenate(alone), whole[at])
