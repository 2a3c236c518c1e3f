"""When a lone tracker is started whose side nobody told."""

from dataclasses import replace

import numpy as np
import pytest
from time_slots_and_mains import tracker

from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.early import (
    first_try,
    is_clear,
    is_open,
    next_try,
    open_start,
)
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.estimation.integrity.correction import Correction
from magfusion.estimation.integrity.fault_candidates import fault_candidates, fixed_blocks
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site, Slots
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.simulation.demo_site import demo_site

LONE = tracker(6e3, Slots(2e-3, 4))


def _front(site: Site) -> Site:
    beacon = replace(site.beacons[0], hemisphere_beacon=np.array([1.0, 0.0, 0.0]))
    return replace(site, beacons=(beacon,))


@pytest.mark.parametrize(
    ("site", "first"),
    [
        (LONE, 2.0),
        (_front(LONE), 6.0),  # whose start is the one it was
        (tracker(6e3, None), 6.0),
        (demo_site(), 6.0),
    ],
)
def test_only_a_start_that_motion_decides_is_tried_early(site: Site, first: float) -> None:
    assert first_try(site, 6.0) == pytest.approx(first)


def test_what_is_not_clear_early_waits_as_long_as_others_do() -> None:
    tried = [first_try(LONE, 6.0)]
    while tried[-1] < 6.0:
        tried.append(next_try(tried[-1], 6.0))
    assert tried == pytest.approx([2.0, 2.8, 3.92, 6.0])


def _start(rival: float | None, *findings: Finding) -> OnlineStart:
    zero = np.zeros(3)
    state = State(0.0, np.eye(3), *[zero] * 4, initial_calibration(LONE, 0.0), np.eye(15))
    return OnlineStart(state, None, rival, Trust(findings))


@pytest.mark.parametrize(
    ("start", "clear"),
    [
        (_start(1e4), True),
        (_start(100.0), False),  # not ambiguous, and not beyond doubt
        (_start(None), False),  # no rival was looked at
        (_start(1e4, Finding("inertial_residuals", "They err.", Verdict.DOUBTFUL)), False),
        (NoStart(), False),
    ],
)
def test_an_early_start_is_beyond_doubt(start: OnlineStart | NoStart, clear: bool) -> None:
    assert is_clear(start) is clear


def test_a_card_and_several_beacons_start_early() -> None:
    site = demo_site()
    magnetometer = replace(site.platform.magnetometer, ac_coupled=True)
    site = replace(site, platform=replace(site.platform, magnetometer=magnetometer))
    assert first_try(site, 6.0) == pytest.approx(2.0)
    assert is_clear(_start(None), several=True)
    doubt = Finding("inertial_residuals", "They err.", Verdict.DOUBTFUL)
    assert not is_clear(_start(None, doubt), several=True)


def test_a_later_try_may_be_doubtful() -> None:
    doubt = Finding("inertial_residuals", "They err.", Verdict.DOUBTFUL)
    assert is_clear(_start(100.0, doubt), last=True)
    assert not is_clear(_start(15.0), last=True)
    failed = Finding("no_solution", "There is none.", Verdict.FAILED)
    assert not is_clear(_start(1e4, failed), last=True)


@pytest.mark.parametrize(("rival", "waits"), [(None, False), (3.0, True), (12.0, False)])
def test_a_pose_is_given_once_a_hypothesis_leads(rival: float | None, *, waits: bool) -> None:
    assert is_open(_start(rival)) is waits


def test_what_stays_open_is_said_to_be_ambiguous() -> None:
    assert [reason.code for reason in open_start(_start(5.0)).trust.reasons] == ["ambiguous"]


def _summary(code: str, bad_s: float, end_s: float) -> Verdict:
    """Return the verdict of a run with a doubt at its 5th second."""
    summary, doubt = Summary(), Finding(code, "They err.", Verdict.DOUBTFUL)
    for time in np.arange(0.0, end_s, 0.1):
        is_bad = 5.0 <= time <= 5.0 + bad_s
        summary.note(float(time), Judgement((doubt,) if is_bad else ()))
    return summary.trust.verdict


def test_one_bad_second_is_no_doubt_of_a_run() -> None:
    assert _summary("inertial_residuals", 0.8, 20.0) is Verdict.TRUSTWORTHY
    assert _summary("inertial_residuals", 0.8, 9.0) is Verdict.DOUBTFUL  # not long ago
    assert _summary("inertial_residuals", 2.0, 20.0) is Verdict.DOUBTFUL
    assert _summary("beacon_pose", 0.8, 20.0) is Verdict.DOUBTFUL


def test_a_checkpoint_before_a_start_has_the_reason_and_no_corrections() -> None:
    """Which were tried when they were found."""
    site, settings = demo_site(), NavigatorSettings()
    navigator = Navigator(site, settings)
    finding = Finding("mounting", "It is turned.", Verdict.FAILED)
    fault = next(fault_candidates(site, fixed_blocks(site, (), static=True)))
    wrong = NoStart("It is turned.", Trust((finding,)), (Correction(finding, site, fault),))
    loop = navigator._loop
    assert loop.search.accepted(wrong, loop.arrived) is None
    again = restored(site, settings, navigator.checkpoint())
    assert again.why_no_start == replace(wrong, corrections=())
