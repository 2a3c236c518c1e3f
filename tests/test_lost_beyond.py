"""Without any beacon for longer than the IMU can replace them, a platform is lost."""

import numpy as np
import pytest
from online_log import OnlineLog, epoch, online_log

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.model.trust import Verdict

SECONDS, SILENT = 60.0, (15.0, 50.0)
STEP = 0.25


@pytest.fixture(scope="module")
def log() -> OnlineLog:
    return online_log(3, SECONDS, every=STEP)


def navigated(log: OnlineLog, lost_beyond: float) -> list[JudgedState]:
    navigator = Navigator(log.site, NavigatorSettings("ekf", lost_beyond=lost_beyond))
    states: list[JudgedState] = []
    arrival = log.fields.time + log.fields.window / 2.0
    for now in np.arange(0.0, SECONDS, STEP):
        own = (log.imu.time >= now) & (log.imu.time < now + STEP)
        navigator.add_imu(log.imu.time[own], log.imu.gyro_body[own], log.imu.accel_body[own])
        due = np.flatnonzero((arrival >= now) & (arrival < now + STEP))
        for k in due.tolist() if not SILENT[0] < now < SILENT[1] else ():
            navigator.add_fields(epoch(log.fields, k))
        states += navigator.take()
    return states


@pytest.mark.parametrize("lost_beyond", [0.5, 1.0])
def test_a_long_silence_of_all_beacons_is_a_loss_that_their_return_ends(
    log: OnlineLog, lost_beyond: float
) -> None:
    states = navigated(log, lost_beyond)
    for state in states:
        sigma = np.sqrt(np.linalg.eigvalsh(state.cov[3:6, 3:6])[-1])
        assert not (sigma > lost_beyond and state.verdict is Verdict.TRUSTWORTHY)
    silent = [s for s in states if SILENT[0] + 1.0 < s.time < SILENT[1]]
    assert any(s.is_lost for s in silent)
    assert all(f.code == "lost" for s in silent for f in s.judgement.reasons)
    back = [s for s in states if s.time > SILENT[1] + 5.0]
    assert all(s.verdict is Verdict.TRUSTWORTHY for s in back)
    assert log.errors([*back]).ate < 0.02  # m


def test_a_state_that_may_be_uncertain_is_not_lost(log: OnlineLog) -> None:
    states = navigated(log, 1e3)
    assert not any(s.is_lost for s in states if s.time < SILENT[0] + 15.0)
