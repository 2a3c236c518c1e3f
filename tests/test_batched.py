"""The one loop for many small problems: each solved as if alone, with what is open recognised."""

import numpy as np
import pytest

from magfusion.estimation.solve.batched import (
    SINGULAR,
    NormalEquations,
    by_differences,
    conditioning,
    minimise,
    normal_equations,
)

TIMES = np.linspace(0.0, 4.0, 20)


def _decay(state: np.ndarray) -> np.ndarray:
    """Return ``a exp(-b t)``, shape (k, times)."""
    return state[:, :1] * np.exp(-state[:, 1:] * TIMES)


def test_every_problem_ends_where_it_would_alone() -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform([0.5, 0.2], [2.0, 1.5], (50, 2))
    measured = _decay(truth) + 1e-3 * rng.standard_normal((50, len(TIMES)))
    requested: list[int] = []

    def model(rows: np.ndarray, state: np.ndarray) -> NormalEquations:
        requested.append(len(rows))
        return normal_equations(*by_differences(lambda s: _error(s, rows), state))

    def _error(state: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return _decay(state) - np.repeat(measured[rows], len(state) // len(rows), axis=0)

    together = minimise(model, np.ones((50, 2)))
    assert np.all(together.converged)
    np.testing.assert_allclose(together.state, truth, rtol=0.0, atol=0.01)
    assert requested[-1] < 50  # those that have ended are not asked again

    def third(rows: np.ndarray, state: np.ndarray) -> NormalEquations:
        return model(np.full(len(rows), 3), state)

    alone = minimise(third, np.ones((1, 2)))
    np.testing.assert_allclose(alone.state[0], together.state[3], rtol=1e-9)
    np.testing.assert_allclose(alone.cost[0], together.cost[3], rtol=1e-9)


def test_passes_that_run_out_are_reported() -> None:
    def model(_: np.ndarray, state: np.ndarray) -> NormalEquations:
        return normal_equations(state**2 - 2.0, 2.0 * state[..., None])

    few, enough = (minimise(model, np.full((1, 1), 50.0), max_iterations=n) for n in (2, 30))
    assert not few.converged[0]
    assert enough.converged[0]
    assert enough.state[0, 0] == pytest.approx(np.sqrt(2.0), rel=1e-12)


def test_a_direction_that_no_residual_feels_stays() -> None:
    def model(_: np.ndarray, state: np.ndarray) -> NormalEquations:
        jacobian = np.zeros((1, 2, 3))
        jacobian[:, :, :2] = np.eye(2)
        return normal_equations(state[:, :2] - 5.0, jacobian)

    result = minimise(model, np.array([[1.0, 1.0, 7.0]]))
    np.testing.assert_allclose(result.state, [[5.0, 5.0, 7.0]], rtol=1e-9)
    assert result.converged[0]


def test_states_may_be_objects_and_units_do_not_matter() -> None:
    def model(_: np.ndarray, state: np.ndarray) -> NormalEquations:
        value = np.array([[one["x"] * 1e6 - 3.0, one["y"] * 1e-6 - 2.0] for one in state])
        return normal_equations(value, np.broadcast_to(np.diag([1e6, 1e-6]), (len(state), 2, 2)))

    def moved(state: np.ndarray, step: np.ndarray) -> np.ndarray:
        pairs = zip(state, step, strict=True)
        return np.array([{"x": one["x"] + dx, "y": one["y"] + dy} for one, (dx, dy) in pairs])

    result = minimise(model, np.array([{"x": 0.0, "y": 0.0}]), moved).state[0]
    assert (result["x"], result["y"]) == (pytest.approx(3e-6), pytest.approx(2e6))


def test_conditioning_knows_no_units_and_has_a_margin() -> None:
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((30, 4)) * [1e-6, 1.0, 1e6, 1e3]
    assert conditioning(jacobian) > 0.2
    open_ = jacobian.copy()
    open_[:, 3] = open_[:, 0] * 1e6 + open_[:, 2] * 1e-6
    assert conditioning(open_) < 1e-3 * SINGULAR
    assert conditioning(jacobian[:3]) == 0.0
    assert conditioning(np.zeros((5, 2))) == 0.0
