"""Filters without each beacon beside the running one: exact, levels that hold, slow faults seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from small_problem import SmallLog
from test_smoothed_separation import EPOCHS, STEP, _false, _walk

from magfusion.errors import InputError
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.bank import SLACK, WIDE, SubsetBank
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.model.trust import Risk, Verdict
from magfusion.units import Array

NAVIGATOR = NavigatorSettings(estimator="ekf", risk=Risk())


@dataclass(frozen=True, eq=False)
class Run:
    """States of a run with their errors and levels (m)."""

    states: Sequence[JudgedState]
    error: Array
    level: Array
    alarm: Array


def _feed(navigator: Navigator, small: SmallLog, first: int, last: int) -> None:
    imu, fields = small.imu, small.fields
    before = -np.inf if first == 0 else fields.time[first - 1] + STEP
    for i in range(first, last):
        until = fields.time[i] + STEP
        some = (imu.time > before) & (imu.time <= until)
        navigator.add_imu(imu.time[some], imu.gyro_body[some], imu.accel_body[some])
        navigator.add_fields(fields.rows(slice(i, i + 1)))
        before = until


def _run(small: SmallLog, settings: NavigatorSettings = NAVIGATOR) -> Run:
    navigator = Navigator(small.site, settings)
    _feed(navigator, small, 0, EPOCHS)
    states = navigator.take()
    true = np.stack(
        [
            np.interp([s.time for s in states], small.truth.time, axis)
            for axis in small.truth.position_world.T
        ],
        axis=1,
    )
    error = np.linalg.norm([s.position_world for s in states] - true, axis=1)
    levels = [s.judgement.protection_level_m for s in states]
    codes = [{finding.code for finding in s.judgement.findings} for s in states]
    return Run(
        states,
        error,
        np.array([np.nan if level is None else level for level in levels]),
        np.array(
            [
                s.verdict is not Verdict.TRUSTWORTHY or "separation" in c
                for s, c in zip(states, codes, strict=True)
            ]
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_clean_states_have_a_level_that_holds_and_is_of_use(estimator: str) -> None:
    small = _walk(11)
    run = _run(small, NavigatorSettings(estimator=estimator, risk=Risk()))  # type: ignore[arg-type]
    later = np.arange(len(run.states)) >= 20  # after filters that began without a pose found one
    assert not np.any([s.judgement.reasons for s in run.states])
    assert np.mean(np.isfinite(run.level[later])) >= 0.99
    assert np.all(run.error[later] < run.level[later])
    sigma = np.sqrt([np.trace(s.cov[3:6, 3:6]) for s in run.states])
    assert np.median(run.level[later] / (3.0 * sigma[later])) <= 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("size", "ramp"), [(0.2, False), (0.03, False), (0.15, True)])
def test_a_false_beacon_is_noticed_or_does_not_matter(size: float, ramp: bool) -> None:
    epoch = np.arange(EPOCHS)
    share = size * np.clip((epoch - 50) / 60.0, 0.0, 1.0) if ramp else size * (epoch >= 50)
    run = _run(_false(_walk(12), share))
    beyond = (run.error > run.level) & ~run.alarm
    assert not np.any(beyond)
    refused = any("B" in state.judgement.excluded for state in run.states)
    assert refused or np.any(run.alarm) or np.nanmax(run.error / run.level) < 1.0


@pytest.mark.slow
def test_a_slow_fault_that_the_gate_takes_in_is_seen_by_the_filter_without_it() -> None:
    """Of three beacons a false one has much say."""
    share = 0.3 * np.clip((np.arange(EPOCHS) - 40) / 60.0, 0.0, 1.0)
    run = _run(_false(_walk(13, beacons=3), share))
    later = np.arange(len(run.states)) >= 20
    assert not np.any((run.error > run.level) & ~run.alarm & later)


@pytest.mark.slow
def test_without_a_risk_there_are_no_levels() -> None:
    run = _run(_walk(14), NavigatorSettings(estimator="ekf"))
    assert np.all(np.isnan(run.level))


@pytest.mark.slow
def test_one_beacon_has_no_level_and_that_is_no_reason() -> None:
    run = _run(_walk(15, beacons=1))
    codes = {f.code for s in run.states for f in s.judgement.reasons}
    assert "separation" not in codes
    assert np.mean(np.isnan(run.level[20:])) > 0.9


@pytest.mark.slow
def test_a_run_from_a_checkpoint_is_the_same() -> None:
    small = _walk(16)
    whole, first = Navigator(small.site, NAVIGATOR), Navigator(small.site, NAVIGATOR)
    _feed(whole, small, 0, EPOCHS)
    _feed(first, small, 0, 70)
    kept = first.checkpoint()
    second = restored(small.site, NAVIGATOR, kept)
    _feed(second, small, 70, EPOCHS)
    expected, result = (n.judgement.protection_level_m for n in (whole, second))
    assert expected is not None
    assert result == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_a_checkpoint_with_filters_of_another_shape_is_refused() -> None:
    small = _walk(17)
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, 60)
    kept = navigator.checkpoint()
    kept["parts"]["_loop"]["running"]["update"]["bank"]["_step"] = np.zeros((1, 3))
    with pytest.raises(InputError, match="filters of another shape"):
        restored(small.site, NAVIGATOR, kept)


def test_a_bank_begins_without_the_pose_that_all_beacons_made() -> None:
    small = _walk(18)
    navigator = Navigator(small.site, NAVIGATOR)
    _feed(navigator, small, 0, 60)
    state = navigator.take()[-1]
    bank = SubsetBank(small.site, navigator.blocks, 0)
    assert bank.separation(state) is None
    bank._begin(state)
    result = bank.separation(state)
    assert result is not None
    np.testing.assert_allclose(result.step, 0.0, atol=0.0)
    least = np.diagonal(result.separation_cov[0, 0])
    np.testing.assert_allclose(least, WIDE[:6] ** 2, rtol=1e-6)
    assert np.max(result.excess(Risk(), SLACK)) == 0.0
