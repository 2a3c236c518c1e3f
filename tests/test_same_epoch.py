"""Stamps of several sensors that differ by rounding alone belong to one state."""

from dataclasses import replace

import numpy as np
import pytest
from aiding_site import aided_site, sensors

import magfusion as mf
from magfusion.estimation.graph.same_epoch import SAME_TIME, at_epochs
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.jobs.replay import Replay, feed
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

ROOM = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.2]])  # m
SENSOR = next(s for s in sensors() if s.quantity == "range")
SITE = aided_site(replace(SENSOR, rate_hz=1e3))
ROUNDING = 1e-14  # s


def test_a_time_is_that_of_an_epoch_within_rounding_and_else_its_own() -> None:
    near, far = 0.1 * SAME_TIME, 10.0 * SAME_TIME
    time = np.array([-far, -near, 0.0, near, far, 1.0 - near, 1.0 + near, 2.0])
    expected = [-far, 0.0, 0.0, 0.0, far, 1.0, 1.0, 2.0]
    np.testing.assert_array_equal(at_epochs(time, np.array([1.0, 0.0])), expected)
    np.testing.assert_array_equal(at_epochs(time[:3], np.array([0.0])), expected[:3])


def _log(fields_at: Array | None, rounding: float) -> Log:
    """Return a log whose ranges are at the field epochs but for rounding."""
    config = SimulationConfig(ROOM, 12.0)
    log = simulate_log(SITE, config, np.random.default_rng(4)).log
    (name, ranges), *_ = log.aiding.items()
    if fields_at is None:
        return replace(log, aiding={})
    time = np.sort(fields_at + rounding * np.resize([-1.0, 1.0, 0.0], len(fields_at)))
    value = np.interp(time, ranges.time, ranges.value[:, 0])[:, None]
    return replace(log, aiding={name: replace(ranges, time=time, value=value)})


def _navigated(log: Log, site: Site) -> tuple[Array, Array, Array]:
    navigator = Navigator(site, NavigatorSettings(estimator="smoother"))
    states = []
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
        states += navigator.take()
    return (
        np.array([s.time for s in states]),
        np.array([s.position_world for s in states]),
        np.array([np.diag(s.cov)[3:6] for s in states]),
    )


@pytest.mark.slow
def test_rounding_of_the_stamps_of_a_range_changes_no_state() -> None:
    epochs = mf.smooth(_log(None, 0.0), replace(SITE, aiding=())).states.time
    assert np.any(np.diff(epochs) > 0.0)
    exact, rounded = _log(epochs, 0.0), _log(epochs, ROUNDING)
    smoothed = [mf.smooth(log, SITE).states for log in (exact, rounded)]
    assert len(smoothed[0]) == len(smoothed[1]) == len(epochs)
    moved = np.abs(smoothed[1].position_world - smoothed[0].position_world)
    assert np.max(moved) < 5e-5  # m, where iterations end
    (time, place, variance), (also, there, also_variance) = [
        _navigated(log, SITE) for log in (exact, rounded)
    ]
    assert len(time) == len(also)
    assert np.all(also_variance > 0.0)
    assert np.max(np.abs(there - place)) < 5e-5  # m
    np.testing.assert_allclose(also_variance, variance, rtol=1e-3)
