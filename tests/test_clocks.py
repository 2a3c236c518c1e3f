"""The shift of the inertial stamps at which the gyroscope explains the turn of the field."""

import numpy as np
import pytest

from magfusion.estimation.data_checks.field_rotation import LAG_STEP, MAX_LAG, Clocks
from magfusion.model.samples import ImuSamples, Log, Waveform

LATE = 0.14  # s


def _recorded() -> tuple[Clocks, np.ndarray]:
    """Return clocks of a body that turns in a field, and how well each shift explains it."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 40.0, LAG_STEP)
    rate = np.stack([np.sin(0.7 * time), np.cos(1.1 * time), np.sin(0.3 * time + 1.0)], axis=1)
    field = 5e-5 * np.stack([np.sin(0.4 * time), np.cos(0.3 * time), 0.5 + 0.0 * time], axis=1)
    nothing = Waveform(time, np.zeros((len(time), 3)))
    imu = ImuSamples(time, rate, np.zeros_like(rate))
    log = Log(name="turn", epoch_ns=0, source="made", imu=imu, waveform=nothing, fields=None)
    clocks = Clocks(log, time, field, 0.0)
    noise = 1e-7 * rng.standard_normal(field.shape)
    clocks.change = -np.cross(np.roll(clocks.rate, round(LATE / LAG_STEP), axis=0), field) + noise
    clocks.field = field
    count = int(MAX_LAG / LAG_STEP)
    explained = []
    for shift in range(-count, count + 1):
        inner = slice(count, len(time) - count)
        selected = clocks.rate[count - shift : len(time) - count - shift]
        rest = clocks.change[inner] + np.cross(selected, field[inner])
        explained.append(1.0 - np.sum(rest**2) / np.sum(clocks.change[inner] ** 2))
    return clocks, np.array(explained)


def test_the_lag_is_the_best_of_all_shifts_one_by_one() -> None:
    clocks, explained = _recorded()
    lag, by_lag = clocks.lag()
    assert lag == pytest.approx(LATE, abs=1e-3)  # s
    assert by_lag == pytest.approx(np.max(explained), abs=1e-9)
    assert by_lag > 0.99
    assert np.sort(explained)[-2] < by_lag - 1e-4  # no other shift does as well
