"""A counter of 16 or 32 bits that wraps goes on; a clock that is set does not."""

import numpy as np
import pytest

from magfusion.model.counters import PERIODS, lost_by_wrapping


@pytest.mark.parametrize("period", PERIODS)
def test_stamps_go_on_where_a_counter_wraps(period: float) -> None:
    true = period + 0.01 * min(1.0, period) * np.arange(-100.0, 100.0)
    raw, last, wrapped = true % period, -np.inf, 0.0
    for part in np.array_split(raw, 37):  # within batches, and between them
        lost = lost_by_wrapping(part, last, wrapped)
        np.testing.assert_allclose(part + lost, true[: len(part)], atol=1e-9 * period)
        true, last, wrapped = true[len(part) :], float(part[-1]), float(lost[-1])


def test_a_late_stamp_is_of_before_the_counter_wrapped() -> None:
    period = PERIODS[1]
    lost = lost_by_wrapping(np.array([period - 0.01, 0.01, period - 0.005, 0.02]), -np.inf, 0.0)
    np.testing.assert_allclose(lost, [0.0, period, 0.0, period])


@pytest.mark.parametrize("step", [-5.0, -60.0, 3600.0, PERIODS[0], PERIODS[1]])
def test_a_step_of_a_clock_is_none_of_a_counter(step: float) -> None:
    raw = 1.7e9 + np.array([0.0, 0.01, 0.02 + step, 0.03 + step])
    assert not np.any(lost_by_wrapping(raw, -np.inf, 0.0))


def test_milliseconds_of_16_bits_wrap_every_minute() -> None:
    true = np.arange(62.0, 200.0, 0.005)
    raw = np.round(true, 3) % 65.536
    np.testing.assert_allclose(raw + lost_by_wrapping(raw, -np.inf, 0.0), true, rtol=0, atol=1e-9)


def test_a_clock_set_back_by_a_period_but_not_from_its_end_is_no_counter() -> None:
    raw = np.array([8.74, 8.75, 8.76 - PERIODS[0], 8.77 - PERIODS[0]])
    assert not np.any(lost_by_wrapping(raw, -np.inf, 0.0))
