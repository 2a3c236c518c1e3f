"""Beacons that are moved during a run, where the survey of all is estimated."""

from dataclasses import replace

import numpy as np
import pytest
from small_problem import SIGMA, SmallLog
from test_online_separation import NAVIGATOR, _feed
from test_smoothed_separation import EPOCHS, STEP, _walk

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.graph.state import between
from magfusion.estimation.integrity.change_detection import StepChange
from magfusion.estimation.integrity.fault_isolation import with_changed_beacons
from magfusion.estimation.integrity.smoothed_exclusion import (
    TOGETHER,
    excluded_to_the_end,
    separated_smooth,
)
from magfusion.estimation.online.navigator import Navigator
from magfusion.jobs.smooth_result import finished
from magfusion.model.parameters import BEACON_POSITION
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.simulation.log import simulate_fields
from magfusion.units import DEGREE, Array

NOISE = 10.0 * SIGMA  # T; a beacon that is moved by centimetres passes the gate


def _walk_with_a_step(seed: int, at: float, shift_world: Array) -> SmallLog:
    """Return a walk among beacons surveyed to 1 cm, the first of which is moved at a time (s)."""
    small, rng = _walk(seed), np.random.default_rng(1000 + seed)
    first, *others = small.site.beacons
    moved = replace(first, position_world=first.position_world + shift_world)
    worlds = (small.site, replace(small.site, beacons=(moved, *others)))
    states = rng.bit_generator.state
    parts = []
    for world in worlds:  # with the same noise
        rng.bit_generator.state = states
        parts.append(simulate_fields(world, small.truth, NOISE, rng, window=STEP))
    before = parts[0].time <= at
    fields = FieldSamples.joined([parts[0].rows(before), parts[1].rows(~before)])
    surveyed = (
        replace(
            b,
            sigma=replace(
                b.sigma,
                position_world=np.full(3, 0.01),
                rotation_beacon=np.full(3, 0.5 * DEGREE),
            ),
        )
        for b in small.site.beacons
    )
    return replace(small, site=replace(small.site, beacons=tuple(surveyed)), fields=fields)


def _navigated(small: SmallLog) -> Navigator:
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, EPOCHS)
    return navigator


@pytest.mark.slow
def test_the_columns_are_how_a_step_moves_the_estimate_and_its_innovations() -> None:
    """Two runs with the same noise, the second with a step of one millimetre."""
    still = _navigated(_walk_with_a_step(40, np.inf, np.zeros(3)))
    sums = still._loop.running.update.score.settle()
    assert sums is not None
    onset, shift = sums.onsets[1], 1e-3 * np.array([1.0, -1.0, 0.5])
    moved = _navigated(_walk_with_a_step(40, onset, shift))
    other = moved._loop.running.update.score.settle()
    assert other is not None
    assert other.onsets == sums.onsets
    score = still._loop.running.update.score
    steps = score._steps.blocks(sums.onsets, len(score.targets.unit))
    kind = StepChange(BEACON_POSITION, onset)
    (own,) = (b.columns for b in steps if b.key == (kind, still.site.beacons[0].name))
    unit = shift / 0.01
    expected = sums.response[:6, own] @ unit
    result = between(still.take()[-1], moved.take()[-1], ())[:6]
    size = float(np.linalg.norm(expected[3:]))
    assert size > 5e-5  # m
    np.testing.assert_allclose(result, expected, atol=0.05 * size)
    gained = other.gradient[own] - sums.gradient[own]
    np.testing.assert_allclose(gained, sums.information[own, own] @ unit, rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40, 42))
def test_a_moved_beacon_is_named_and_one_at_rest_is_not(seed: int) -> None:
    at, shift = 15.0, np.array([0.06, -0.06, 0.0])  # s, m
    moved = _navigated(_walk_with_a_step(seed, at, shift))
    doubted = [s for s in moved.take() if s.verdict is not Verdict.TRUSTWORTHY]
    assert doubted[0].time > at
    reason = doubted[-1].judgement.reasons[0]
    assert reason.code == "changed"
    assert f"the position of beacon {moved.site.beacons[0].name} by" in reason.text
    size = float(reason.text.split(" by ")[1].split(" cm")[0])
    assert size == pytest.approx(100.0 * float(np.linalg.norm(shift)), abs=2.0)  # cm
    still = _navigated(_walk_with_a_step(seed, np.inf, np.zeros(3)))
    assert all(s.verdict is Verdict.TRUSTWORTHY for s in still.take())


@pytest.mark.slow
def test_smoothing_names_a_beacon_moved_for_good_and_nothing_else() -> None:
    at, shift = 0.6 * EPOCHS * STEP, np.array([0.3, -0.3, 0.0])  # s, m
    onsets = []
    for seed in (44, 43, 42, 41):
        small = _walk_with_a_step(seed, at, shift)
        result = smooth(small.log, small.site, SmootherSettings())
        name = small.site.beacons[0].name
        onset = excluded_to_the_end(separated_smooth(result))
        assert list(onset) == [name]
        onsets.append(onset[name])
    # Closer stretches are one; the errors of several worlds have no common sign.
    assert np.max(np.abs(np.array(onsets) - at)) < TOGETHER
    assert np.mean(onsets) == pytest.approx(at, abs=1.5)  # s
    (reason,) = finished(small.log, small.site, SmootherSettings(), result, None).trust.reasons
    assert reason.code == "changed"  # as navigation calls it
    assert f" of beacon {name} by" in reason.text
    size = float(reason.text.split(" by ")[1].split(" cm")[0])
    assert size == pytest.approx(100.0 * float(np.linalg.norm(shift)), abs=4.0)  # cm
    assert "excluded from then on" in reason.text


def test_the_change_of_a_beacon_explains_what_follows_of_it() -> None:
    excluded = Finding("beacon_excluded", "Beacon B contradicts the others from 18 to 40 s.")
    other = Finding("gyro_g_sensitivity", "The log contradicts it.")
    saturated = Finding("saturated", "The gyro is saturated.")
    change = Finding("changed", "A parameter changed: the position of beacon B.")
    before = Trust((excluded, other, saturated))
    assert with_changed_beacons(before, {}) is before
    reasons = with_changed_beacons(before, {"B": change}).reasons
    assert [reason.code for reason in reasons] == ["changed", "saturated"]
    assert reasons[0].explained == ("gyro_g_sensitivity",)
