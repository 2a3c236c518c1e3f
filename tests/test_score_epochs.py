"""Epochs that the online score hears together: as one by one, and as the estimate really moves."""

from dataclasses import replace

import numpy as np
import pytest
from test_online_separation import NAVIGATOR, _feed
from test_smoothed_separation import EPOCHS, _walk

from magfusion.estimation.graph.state import between
from magfusion.estimation.measurements.zero_velocity import zero_velocity
from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online_integrity import recent_steps
from magfusion.estimation.online_integrity.score_epochs import (
    Epoch,
    EpochTransition,
    Sums,
    add_epochs,
)
from magfusion.estimation.online_integrity.score_online import MAX_WAITING
from magfusion.estimation.solve import sparse_rows
from magfusion.model.parameters import BEACON_POSITION

LAST = EPOCHS // 2


def _waiting() -> tuple[Navigator, Sums, list[Epoch]]:
    """Return a navigator on its way, what its score has heard, and the epochs that wait."""
    small = _walk(21)
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, LAST)
    score = navigator._loop.running.update.score
    score.settle()
    score._scored_at = np.inf
    with pytest.MonkeyPatch.context() as patch:  # a new onset would not let them wait
        patch.setattr(recent_steps, "ONSET_INTERVAL", np.inf)
        _feed(navigator, small, LAST, LAST + MAX_WAITING - 1)
    assert score._sums is not None
    return navigator, score._sums, list(score._waiting)


def _assert_alike(result: Sums, expected: Sums) -> None:
    size = np.max(np.abs(expected.information))
    np.testing.assert_allclose(result.information, expected.information, atol=1e-9 * size)
    scale = np.max(np.abs(expected.gradient))
    np.testing.assert_allclose(result.gradient, expected.gradient, atol=1e-9 * scale)
    np.testing.assert_allclose(result.response, expected.response, rtol=1e-6, atol=1e-12)
    assert result.time == expected.time


def test_epochs_together_tell_what_they_tell_one_by_one() -> None:
    navigator, sums, waiting = _waiting()
    requested = navigator._loop.running.update.score.targets
    assert len(waiting) == MAX_WAITING - 1
    offsets = {epoch.predicted.calibration.time_offset for epoch in waiting}
    assert len(offsets) > 1  # what an epoch is linearised with changes from one to the next
    rest = zero_velocity(np.zeros(1, dtype=np.int64), 0.01)
    waiting[3] = waiting[3]._replace(measurements=(*waiting[3].measurements, rest))
    waiting[5] = waiting[5]._replace(measurements=())
    one_by_one = sums
    for epoch in waiting:
        one_by_one = add_epochs(one_by_one, [epoch], requested)
    together = add_epochs(sums, waiting, requested)
    _assert_alike(together, one_by_one)
    learnt = np.abs(together.information - sums.information)
    assert np.max(learnt) > 0.01 * np.max(np.abs(sums.information))


def test_sparse_rows_of_many_parameters_tell_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    navigator, sums, waiting = _waiting()
    requested = navigator._loop.running.update.score.targets
    dense = add_epochs(sums, waiting, requested)
    monkeypatch.setattr(sparse_rows, "SPARSE_COLUMNS", 1)
    _assert_alike(add_epochs(sums, waiting, requested), dense)


def test_an_epoch_that_measured_nothing_only_carries_the_response_on() -> None:
    navigator, sums, waiting = _waiting()
    requested, last = navigator._loop.running.update.score.targets, waiting[0]
    turns, none = (np.eye(3), np.eye(3)), np.zeros(3)
    size = len(last.predicted.cov)
    transition = np.eye(size)
    transition[3:6, 6:9] = 0.5 * np.eye(3)
    led = EpochTransition(transition, turns, none, none, np.zeros((size, size)))
    result = add_epochs(sums, [Epoch(last.predicted, led)], requested)
    own = transition[: requested.size, : requested.size]
    gravity = next(b.columns for b in requested.fixed_blocks if b.owner == "site")
    others = np.setdiff1d(np.arange(len(requested.unit)), np.arange(gravity.start, gravity.stop))
    expected = own @ sums.response
    np.testing.assert_allclose(result.response[:, others], expected[:, others], atol=1e-15)
    kept = np.exp(-(last.predicted.time - sums.time) / 60.0)
    np.testing.assert_allclose(result.information, kept * sums.information, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 2])
def test_the_response_is_how_the_estimate_moves_with_what_it_holds(axis: int) -> None:
    """The same data, with a beacon elsewhere in the site, against what the score carries on."""
    small, shift = _walk(22), 1e-3 * np.eye(3)[axis]
    first = small.site.beacons[0]
    moved = replace(first, position_world=first.position_world + shift)
    other = replace(small.site, beacons=(moved, *small.site.beacons[1:]))
    runs = [Navigator(site, NAVIGATOR) for site in (small.site, other)]
    for navigator in runs:
        _feed(navigator, small, 0, EPOCHS)
    states = [navigator.take()[-1] for navigator in runs]
    score = runs[0]._loop.running.update.score
    sums, requested = score.settle(), score.targets
    assert sums is not None
    (block,) = (b for b in requested.fixed_blocks if b.key == (BEACON_POSITION, first.name))
    unit = requested.unit[block.columns][axis]
    expected = -sums.response[:6, block.columns][:, axis] * 1e-3 / unit
    result = between(states[0], states[1], ())[:6]
    size = np.linalg.norm(expected[3:])
    assert size > 1e-4  # m
    np.testing.assert_allclose(result[3:], expected[3:], atol=0.05 * size)
    np.testing.assert_allclose(result[:3], expected[:3], atol=0.05 * size)  # as much at a metre
