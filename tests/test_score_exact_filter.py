"""The online score of Schmidt's filter, whose innovations are correlated, against one batch."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.linalg import block_diag

from magfusion.estimation.online_integrity import score_epochs
from magfusion.estimation.online_integrity.score_epochs import (
    Epoch,
    EpochTransition,
    Sums,
    add_epochs,
    new_sums,
)
from magfusion.units import Array

EPOCHS, STATES, ROWS, PARAMETERS = 40, 2, 3, 3
TRANSITION = np.array([[1.0, 0.1], [0.0, 1.0]])
NOISE = np.diag([1e-4, 1e-3])  # of the state, in an interval
CONSIDERED = 4.0  # variance of the first parameter, which the filter considers
RNG = np.random.default_rng(3)
BY_STATE = RNG.standard_normal((EPOCHS, ROWS, STATES))
BY_PARAMETER = RNG.standard_normal((EPOCHS, ROWS, PARAMETERS))


def _measured(rng: np.random.Generator, parameters: Array) -> Array:
    """Return whitened measurements (epochs, rows) of a state that moves at random."""
    true, result = rng.standard_normal(STATES), []
    for by_state, by_parameter in zip(BY_STATE, BY_PARAMETER, strict=True):
        true = TRANSITION @ true + rng.multivariate_normal(np.zeros(STATES), NOISE)
        result.append(by_state @ true + by_parameter @ parameters + rng.standard_normal(ROWS))
    return np.array(result)


def _filtered(measured: Array, monkeypatch: pytest.MonkeyPatch) -> tuple[Sums, Array]:
    """Return the sums beside Schmidt's filter, and its last state."""
    whole = np.eye(STATES + 1)
    whole[:STATES, :STATES] = TRANSITION
    noise = block_diag(NOISE, np.zeros((1, 1)))
    joint, estimate = np.diag([1.0, 1.0, CONSIDERED]), np.zeros(STATES)
    targets = SimpleNamespace(
        size=STATES, whole=STATES + 1, unit=np.ones(PARAMETERS), columns=STATES + np.arange(3)
    )
    none = np.zeros((STATES, PARAMETERS))
    sums = new_sums(np.zeros((3, 3)), np.zeros(3), none, 0.0, np.eye(STATES))
    monkeypatch.setattr(score_epochs, "MEMORY", 1e12)  # s; the batch forgets nothing
    monkeypatch.setattr(score_epochs, "_pushed", lambda *_: np.zeros((1, STATES, PARAMETERS)))
    turn, still = (np.eye(3), np.eye(3)), np.zeros(3)
    for k in range(EPOCHS):
        joint, estimate = whole @ joint @ whole.T + noise, TRANSITION @ estimate
        jacobian = np.hstack([BY_STATE[k], BY_PARAMETER[k]])
        error = BY_STATE[k] @ estimate - measured[k]
        rows = error[None], jacobian[None], np.ones((1, ROWS), dtype=bool)
        monkeypatch.setattr(score_epochs, "_rows", lambda *_, rows=rows: rows)
        passed = EpochTransition(whole, turn, still, still, noise)
        predicted = SimpleNamespace(cov=joint, time=float(k))
        sums = add_epochs(sums, [Epoch(cast(Any, predicted), passed)], cast(Any, targets))
        by = jacobian[:, : STATES + 1]
        gain = joint @ by.T @ np.linalg.inv(by @ joint @ by.T + np.eye(ROWS))
        gain[STATES:] = 0.0
        estimate = estimate - gain[:STATES] @ error
        kept = np.eye(STATES + 1) - gain @ by
        joint = kept @ joint @ kept.T + gain @ gain.T
    return sums, estimate


def _in_batch(measured: Array) -> tuple[Array, Array, Array]:
    """Return information and gradient of the parameters, and the last state without them."""
    size = STATES * EPOCHS
    rows, right = np.zeros((0, size + PARAMETERS)), np.zeros(0)
    first = np.linalg.inv(np.linalg.cholesky(TRANSITION @ TRANSITION.T + NOISE))
    move = np.linalg.inv(np.linalg.cholesky(NOISE))
    for k in range(EPOCHS):
        own, step = slice(STATES * k, STATES * k + STATES), np.zeros((STATES, rows.shape[1]))
        step[:, own] = move if k else first
        if k:
            step[:, STATES * (k - 1) : STATES * k] = -move @ TRANSITION
        seen = np.zeros((ROWS, rows.shape[1]))
        seen[:, own], seen[:, size:] = BY_STATE[k], BY_PARAMETER[k]
        rows = np.vstack([rows, step, seen])
        right = np.concatenate([right, np.zeros(STATES), measured[k]])
    of_states, of_parameters = rows[:, :size], rows[:, size:]
    orthonormal = np.linalg.qr(of_states)[0]
    rest = of_parameters - orthonormal @ (orthonormal.T @ of_parameters)
    states = np.linalg.lstsq(of_states, right, rcond=None)[0]
    return rest.T @ rest, rest.T @ right, states[-STATES:]


def test_sums_are_those_of_a_batch_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    true = np.array([2.0, 0.1, -0.3])
    measured = _measured(np.random.default_rng(1), true)
    sums, estimate = _filtered(measured, monkeypatch)
    information, gradient, last = _in_batch(measured)
    np.testing.assert_allclose(sums.information, information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(sums.gradient, gradient, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(estimate + sums.exact_offset, last, rtol=1e-9, atol=1e-9)
    step = np.linalg.solve(information, gradient)
    assert np.all(np.abs(step - true) < 4.0 * np.sqrt(np.diagonal(np.linalg.inv(information))))


def test_both_states_move_by_their_responses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same noise, with other parameters."""
    zero, unit = np.zeros(PARAMETERS), np.eye(PARAMETERS)
    before = _filtered(_measured(np.random.default_rng(2), zero), monkeypatch)
    assert not np.allclose(before[0].response, before[0].exact_response, rtol=0.01, atol=0.01)
    for k in range(PARAMETERS):
        after = _filtered(_measured(np.random.default_rng(2), unit[k]), monkeypatch)
        moved = after[1] - before[1]
        np.testing.assert_allclose(before[0].response[:, k], moved, rtol=1e-9, atol=1e-9)
        exact = moved + after[0].exact_offset - before[0].exact_offset
        np.testing.assert_allclose(before[0].exact_response[:, k], exact, rtol=1e-9, atol=1e-9)
