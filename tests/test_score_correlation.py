"""Correlated innovations of Schmidt's filter, in the online score test."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.online_integrity.score_epochs import (
    Sums,
    _correlation,
    new_sums,
)
from magfusion.units import Array

EPOCHS, STATES, ROWS = 40, 2, 3
TRANSITION = np.array([[1.0, 0.1], [0.0, 1.0]])
NOISE = np.diag([1e-4, 1e-3])  # of the state, in an interval
CONSIDERED = 4.0  # variance of a parameter that is considered, and zero in truth
BY_STATE = np.random.default_rng(3).standard_normal((ROWS, STATES))
BY_CONSIDERED = np.random.default_rng(4).standard_normal((ROWS, 1))
BY_FIXED = np.random.default_rng(5).standard_normal((ROWS, 2))


def _filtered(rng: np.random.Generator) -> tuple[Array, Sums]:
    """Return gradient, information and excess of a filter whose gain considers a parameter."""
    joint = np.diag([1.0, 1.0, CONSIDERED])
    true, estimate = rng.multivariate_normal(np.zeros(2), np.eye(2)), np.zeros(2)
    sums = new_sums(np.zeros((2, 2)), np.zeros(2), np.zeros((STATES, 2)), 0.0)
    by = np.hstack([BY_STATE, BY_CONSIDERED])
    for _ in range(EPOCHS):
        true = TRANSITION @ true + rng.multivariate_normal(np.zeros(2), NOISE)
        estimate = TRANSITION @ estimate
        whole = np.eye(3)
        whole[:2, :2] = TRANSITION
        joint = whole @ joint @ whole.T
        joint[:2, :2] += NOISE
        given = joint[:2, :2] - np.outer(joint[:2, 2], joint[2, :2]) / joint[2, 2]
        gain = joint[:2] @ by.T @ np.linalg.inv(by @ joint @ by.T + np.eye(ROWS))
        error = BY_STATE @ (estimate - true) + rng.standard_normal(ROWS)
        response = TRANSITION @ sums.response
        shown = BY_STATE @ response - BY_FIXED
        inverse = np.linalg.inv(BY_STATE @ given @ BY_STATE.T + np.eye(ROWS))
        parts = BY_STATE[None], given[None], gain[None], shown[None], (inverse @ shown)[None]
        cross_cov, excess = _correlation(sums, [TRANSITION], *parts, np.ones(2))
        sums = replace(
            sums,
            information=sums.information + shown.T @ inverse @ shown,
            gradient=sums.gradient + shown.T @ inverse @ error,
            response=response - gain @ shown,
            cross_cov=cross_cov,
            excess=excess,
        )
        estimate = estimate - gain @ error
        kept = np.eye(3) - np.vstack([gain, np.zeros(ROWS)]) @ by
        noise = np.vstack([gain, np.zeros(ROWS)])
        joint = kept @ joint @ kept.T + noise @ noise.T
    return sums.gradient, sums


def test_the_gradient_varies_as_predicted() -> None:
    rng = np.random.default_rng(1)
    drawn = [_filtered(rng) for _ in range(1500)]
    cov = np.cov(np.array([gradient for gradient, _ in drawn]).T)
    sums = drawn[0][1]
    assert np.trace(sums.excess) > 0.3 * np.trace(sums.information)  # not white
    ratio = np.linalg.eigvals(np.linalg.solve(sums.information + sums.excess, cov)).real
    assert np.all((ratio > 0.85) & (ratio < 1.15))  # a standard error of 0.037
    scaled = []
    for gradient, _ in drawn:
        information, allowed = sums.with_correlation(sums.information, gradient)
        scaled.append(allowed @ np.linalg.solve(information, allowed))
    assert 1.85 < np.mean(scaled) < 2.15  # two components


def test_without_excess_nothing_changes() -> None:
    information, gradient = np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([0.3, -1.0])
    sums = new_sums(information, gradient, np.zeros((STATES, 2)), 0.0)
    same, also = sums.with_correlation(information, gradient)
    np.testing.assert_allclose(same, information, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(also, gradient, rtol=1e-12, atol=1e-12)
