"""When a lone tracker is started whose side nobody told."""

from dataclasses import replace

import numpy as np
import pytest
from time_slots_and_mains import tracker

from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.early import first_try, is_clear, next_try, open_start
from magfusion.estimation.initialization.online import NoStart, OnlineStart
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
    assert tried == pytest.approx([2.0, 4.0, 6.0])


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


def test_what_stays_open_is_said_to_be_ambiguous() -> None:
    assert [reason.code for reason in open_start(_start(5.0)).trust.reasons] == ["ambiguous"]
