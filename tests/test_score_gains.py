"""What every candidate fault would explain, evaluated together."""

import numpy as np
import pytest

from magfusion.estimation.integrity.released_fault import gains, release_fault
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.online_integrity.score_targets import ScoreTargets
from magfusion.estimation.solve import sparse_rows
from magfusion.simulation.demo_site import demo_site

KNOWN, UNKNOWN = 50.0, 1e-4  # by how many typical errors a direction is told of, squared


def test_all_at_once_gain_what_each_alone_does() -> None:
    rng, score = np.random.default_rng(4), ScoreTargets(demo_site(), (), (), static=False)
    size = len(score.unit)
    root = rng.standard_normal((size, size)) / np.sqrt(size)
    axes = np.linalg.qr(rng.standard_normal((size, size)))[0]
    reported = np.where(np.arange(size) < size // 2, KNOWN, UNKNOWN)  # half of it is not told of
    information = (axes * reported) @ axes.T + 1e-9 * root @ root.T
    gradient = information @ rng.standard_normal(size) * 3.0
    nothing = np.zeros((size, 0))
    known = Score(
        score.fixed_blocks, information, gradient, nothing, np.zeros((1, 6, size)), nothing.T
    )
    alone = [
        release_fault(np.eye(6)[None], known, s, information, gradient)
        for s in score.fault_candidates
    ]
    combine = np.zeros((len(alone), size, max(s.combine.shape[1] for s in score.fault_candidates)))
    for room, fault in zip(combine, score.fault_candidates, strict=True):
        room[:, : fault.combine.shape[1]] = fault.combine
    expected = [0.0 if one is None else one.gain for one in alone]
    assert np.ptp(expected) > 100.0  # chi square; they differ
    np.testing.assert_allclose(gains(combine, information, gradient), expected, atol=1e-6)
    np.testing.assert_allclose(score.gains(information, gradient), expected, atol=1e-6)
    nobody = gains(combine, 1e-6 * np.eye(size), gradient)
    np.testing.assert_array_equal(nobody, 0.0)


@pytest.mark.parametrize("sparse_from", [1, sparse_rows.SPARSE_COLUMNS])
def test_beyond_declared_errors_is_what_a_marginal_knows(
    monkeypatch: pytest.MonkeyPatch, sparse_from: int
) -> None:
    """Of an error and a declared one that acts as it does, by inverting the information on both."""
    monkeypatch.setattr(sparse_rows, "SPARSE_COLUMNS", sparse_from)
    rng, targets = np.random.default_rng(5), ScoreTargets(demo_site(), (), (), static=False)
    size = len(targets.unit)
    root = rng.standard_normal((size, 2 * size))
    information, gradient = root @ root.T, rng.standard_normal(size)
    spread = np.diag(rng.uniform(0.05, 0.2, size))[:, ::2]
    nothing = np.zeros((1, 6, size)), np.zeros((0, size))
    score = Score(targets.fixed_blocks, information, gradient, spread, *nothing)
    both = np.hstack([np.eye(size), spread])
    prior = np.diag((np.arange(both.shape[1]) >= size).astype(np.float64))
    cov = np.linalg.inv(both.T @ information @ both + prior)
    expected = np.linalg.inv(cov[:size, :size])
    result, slope = score.with_declared(tolerance=False)
    np.testing.assert_allclose(result, expected, atol=1e-9 * np.max(expected))
    step = (cov @ both.T @ gradient)[:size]
    np.testing.assert_allclose(slope, expected @ step, atol=1e-9 * np.max(np.abs(gradient)))
