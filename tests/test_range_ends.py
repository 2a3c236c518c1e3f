"""What is known of an instrument's range does not hang on how many samples it is judged with."""

import numpy as np
import pytest

from magfusion.model.samples import Waveform
from magfusion.receiver.range_ends import RangeEnds, saturated

LENGTH, STEP = 60, 25  # samples of a window, and from one to the next


def _stream(seed: int) -> Waveform:
    """Return a field that wanders beyond the range, in steps; of some seeds each read thrice."""
    random, count = np.random.default_rng(seed), 900
    field = np.cumsum(random.normal(size=(count, 3)), axis=0)
    step = (0.01, 0.3, 1.0)[seed % 3]
    field = np.clip(step * np.round(field / step), -9.0, 9.0)
    if seed % 4 == 0:
        field = np.repeat(field[::3], 3, axis=0)
    return Waveform(np.linspace(0.0, 3.15, count, endpoint=False), field)


@pytest.mark.parametrize("before", [30, 300])
def test_windows_one_by_one_are_judged_as_all_at_once(before: int) -> None:
    corrupted = 0
    for seed in range(24):
        waveform, one_by_one, at_once = _stream(seed), _unknown(), _unknown()
        first = np.arange(0, len(waveform) - LENGTH, STEP)
        whole = saturated(waveform, first, first + LENGTH, at_once)
        single = []
        for begin in first.tolist():
            start_time = max(begin - before, 0)
            samples = waveform.rows(slice(start_time, begin + LENGTH))
            own = np.array([begin - start_time])
            single.append(bool(saturated(samples, own, own + LENGTH, one_by_one)[0]))
        assert single == whole.tolist()
        for one, other in zip(one_by_one, at_once, strict=True):
            assert (one.low, one.high, one.finest) == (other.low, other.high, other.finest)
            assert one.kept == other.kept
        corrupted += int(np.sum(whole))
    assert 24 < corrupted < 24 * len(first) - 24  # it is no question of none, or of all


def _unknown() -> tuple[RangeEnds, ...]:
    return tuple(RangeEnds() for _ in "xyz")
