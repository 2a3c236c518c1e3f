"""Protection levels found for many states at once are those of each alone, and only when asked."""

from dataclasses import replace

import numpy as np
import pytest
from test_online_separation import NAVIGATOR, _feed
from test_smoothed_separation import EPOCHS, _walk

from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online_integrity.bank import SLACK
from magfusion.estimation.online_integrity.levels import Levels, find


def _levels() -> list[Levels]:
    small = _walk(31)
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, EPOCHS)
    result = [state.judgement.levels for state in navigator.take()]
    return [one for one in result if one is not None]


@pytest.mark.slow
def test_levels_found_together_are_those_found_alone() -> None:
    together, alone = _levels(), _levels()
    assert len(together) > 50
    assert all(one.query is not None for one in together)
    find(together)
    assert all(one.query is None for one in together)
    for one, other in zip(together, alone, strict=True):
        assert one.values == other.values  # to the last bit, whoever waits with it
    known = [one.values[0] for one in together if one.values[0] is not None]
    assert len(set(known)) > 0.9 * len(known)


@pytest.mark.slow
def test_found_again_nothing_changes() -> None:
    levels = _levels()[-3:]
    before = [one.values for one in levels]
    find(levels)
    assert [one.values for one in levels] == before


def test_none_are_no_levels() -> None:
    assert Levels().values == (None, None)
    assert Levels((None, 1.0)) != Levels((None, 2.0))
    assert Levels((0.5, None)).values == (pytest.approx(0.5, abs=0.0), None)


@pytest.mark.slow
def test_a_state_that_waits_keeps_no_filters() -> None:
    requested = _levels()[-1].query
    assert requested is not None
    kept = [part for part in vars(requested.separation).values() if isinstance(part, np.ndarray)]
    assert all(part.base is None or part.base.nbytes < 1e4 for part in kept)


def test_a_step_that_is_clearly_below_its_threshold_is_no_alarm_by_the_threshold_either() -> None:
    small = _walk(32)
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, EPOCHS // 2)
    bank, state = navigator._loop.running.update.bank, navigator.take()[-1]
    assert bank is not None
    result = bank.separation(state)
    assert result is not None
    assert not np.any(bank._excess(result))
    assert np.max(result.excess(bank.risk, SLACK)) <= 1.0
    far = replace(result, step=result.step + 0.5)
    assert np.max(bank._excess(far)) > 1.0
    np.testing.assert_array_equal(bank._excess(far), far.excess(bank.risk, SLACK)[0])
