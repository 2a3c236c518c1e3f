"""Aiding sensors of a platform whose receiver gives phasors, which arrive after their windows."""

from dataclasses import replace

import numpy as np
import pytest
from aiding_site import aided_site

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.jobs.replay import Replay, feed
from magfusion.model.aiding import AidingSensor
from magfusion.model.samples import Log
from magfusion.simulation.log import SimulationConfig, simulate_fields, simulate_log
from magfusion.simulation.motion import Rests

ROOM = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.2]])  # m
WHEELS = AidingSensor("wheels", "velocity", 0.01, relative_sigma=0.01, constraint_sigma=0.02)
SITE = aided_site(WHEELS)
DURATION = 10.0  # s
STEP = 0.25  # s; between two phasors


def _log(window: float) -> Log:
    """Return a drive with phasors of some window (s) instead of raw samples."""
    rng, rests = np.random.default_rng(3), Rests(2.0, DURATION, 0.0)
    config = SimulationConfig(ROOM, DURATION, motion="drive", rests=rests, perturb=False)
    simulated = simulate_log(SITE, config, rng)
    at = simulated.motion.trajectory(np.arange(STEP, DURATION - STEP, STEP))
    fields = simulate_fields(SITE, at, 1e-9, rng, window=window)
    return replace(simulated.log, waveform=None, fields=fields)


@pytest.mark.parametrize("window", [0.06, 0.4])
def test_phasors_that_arrive_after_their_windows_are_used(window: float) -> None:
    log = _log(window)
    navigator = Navigator(SITE, NavigatorSettings("ekf"))
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
    assert navigator.losses == {}
    assert log.fields is not None
    assert log.fields.time[-1] - navigator.time < STEP


def test_wheels_are_used_while_phasors_are_missing() -> None:
    log = _log(0.4)
    assert log.fields is not None
    log = replace(log, fields=log.fields.rows(log.fields.time < 7.5))
    navigator = Navigator(SITE, NavigatorSettings("ekf"))
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
    assert log.imu.time[-1] - navigator.time < 0.5  # s; half a window, a record, a wheel's period
