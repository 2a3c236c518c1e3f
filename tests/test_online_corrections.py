"""Online, too, what is wrong with a site is found, undone and used."""

from dataclasses import replace

import numpy as np
import pytest
from online_log import OnlineLog, online_log
from test_online import BOTH, Estimator

from magfusion.estimation.online.corrected import corrected
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.model.site import Site
from magfusion.model.trust import Verdict

SECONDS = 24.0
STEP = 0.1  # s; of what arrives together


def reversed_coil(site: Site) -> Site:
    """Return a site in which a coil of the first beacon is wired backwards."""
    first, *others = site.beacons
    coil, *rest = first.coils
    turned = replace(coil, moment_beacon=-coil.moment_beacon)
    return replace(site, beacons=(replace(first, coils=(turned, *rest)), *others))


def walk(
    log: OnlineLog, navigator: Navigator, begin: float = 0.0, end: float = SECONDS
) -> tuple[Navigator, list[JudgedState]]:
    """Feed a part of a log to a navigator, corrected after each piece; return it and its states."""
    states: list[JudgedState] = []
    arrival = log.fields.time + log.fields.window / 2.0
    for now in np.arange(begin, end, STEP):
        own = (log.imu.time >= now) & (log.imu.time < now + STEP)
        navigator.add_imu(log.imu.time[own], log.imu.gyro_body[own], log.imu.accel_body[own])
        due = np.flatnonzero((arrival >= now) & (arrival < now + STEP))
        for k in due.tolist():
            navigator.add_fields(log.fields.rows(slice(k, k + 1)))
        navigator = corrected(navigator)
        states += navigator.take()
    return navigator, states


@pytest.fixture(scope="module")
def log() -> OnlineLog:
    return online_log(4, SECONDS, every=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_a_reversed_coil_is_undone_before_the_first_state(
    log: OnlineLog, estimator: Estimator
) -> None:
    settings = NavigatorSettings(estimator)
    navigator, states = walk(log, Navigator(reversed_coil(log.site), settings))
    (finding,) = navigator.corrected
    assert finding.code == "coil_reversed"
    assert finding.remedy
    assert all("beacons[0].coils[0]" in key for key in finding.remedy)
    found, right = (one.beacons[0].coils[0].moment_beacon for one in (navigator.site, log.site))
    np.testing.assert_allclose(found, right)
    assert all([f.code for f in s.judgement.reasons] == ["coil_reversed"] for s in states)
    errors = log.errors([*states])
    assert errors.ate < 0.02  # m
    assert errors.nees is not None
    assert 1.0 < np.mean(errors.nees) < 12.0


def test_a_clean_log_is_not_corrected(log: OnlineLog) -> None:
    before = Navigator(log.site, NavigatorSettings("ekf"))
    navigator, states = walk(log, before)
    assert navigator is before
    assert all(s.verdict is Verdict.TRUSTWORTHY for s in states)


@pytest.mark.slow
def test_a_lever_arm_is_undone_where_motion_shows_it(log: OnlineLog) -> None:
    """States of before are not given again, and the jump is counted."""
    platform = log.site.platform
    moved = platform.magnetometer.position_body + np.array([0.06, 0.0, 0.0])  # m
    magnetometer = replace(platform.magnetometer, position_body=moved)
    wrong = replace(log.site, platform=replace(platform, magnetometer=magnetometer))
    navigator, states = walk(log, Navigator(wrong, NavigatorSettings("ekf")))
    assert [f.code for f in navigator.corrected] == ["lever_arm"]
    assert np.all(np.diff([s.time for s in states]) > 0.0)
    left = navigator.site.platform.magnetometer.position_body - platform.magnetometer.position_body
    assert np.linalg.norm(left) < 0.015  # m
    late = [s for s in states if s.time > SECONDS - 4.0]
    nees = log.errors([*late]).nees
    assert nees is not None
    assert 0.5 < np.mean(nees) < 20.0


@pytest.mark.slow
def test_a_corrected_navigator_goes_on_from_its_checkpoint(log: OnlineLog) -> None:
    declared, settings = reversed_coil(log.site), NavigatorSettings("ekf")
    navigator, _ = walk(log, Navigator(declared, settings), end=15.0)
    assert navigator.corrected
    twin = restored(declared, settings, navigator.checkpoint())
    (_, expected), (_, found) = (walk(log, one, 15.0, 18.0) for one in (navigator, twin))
    assert len(found) == len(expected) > 0
    assert twin.corrected == navigator.corrected
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.position_world, other.position_world, atol=1e-9)  # m


@pytest.mark.slow
def test_after_a_step_of_the_clock_the_declared_site_and_its_temperatures_remain(
    log: OnlineLog,
) -> None:
    navigator, _ = walk(log, Navigator(reversed_coil(log.site), NavigatorSettings("ekf")), end=8.0)
    navigator.add_temperature("A", 7.5, 31.0)
    again = navigator.restarted()
    assert again.corrected == ()
    coils = (one.beacons[0].coils[0].moment_beacon for one in (again.site, log.site))
    np.testing.assert_allclose(next(coils), -next(coils))
    assert again.site.temperatures is not None
    assert list(again.site.temperatures.each()) == [(7.5, "A", 31.0)]
