"""Navigation as the data arrive: a start, a walk, and everything that may go wrong meanwhile."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from online_log import (
    OnlineLog,
    epoch,
    navigate,
    online_log,
    silent,
    spoiled,
    surveyed_site,
    without_imu,
)

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

Estimator = Literal["smoother", "ekf"]
BOTH: tuple[Estimator, ...] = ("smoother", "ekf")


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(0, 70.0)


@pytest.fixture(scope="module")
def raw() -> SimulatedLog:
    rests = Rests(start=2.0, move=12.0, pause=2.0)
    config = SimulationConfig(DEMO_BOX_WORLD, 14.0, rests=rests, perturb=False)
    return simulate_log(surveyed_site(), config, np.random.default_rng(3))


def distance(log: OnlineLog, states: list[State]) -> tuple[np.ndarray, np.ndarray]:
    errors = log.errors(states)
    return errors.time, np.linalg.norm(errors.position_world, axis=1)


def nominal(log: OnlineLog, settings: NavigatorSettings) -> float:
    """Return the root mean square of the position error (m) where nothing is disturbed."""
    time, error = distance(log, navigate(log, settings)[1])
    return float(np.sqrt(np.mean(error[time > 12.0] ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_a_users_loop(raw: SimulatedLog, estimator: Estimator) -> None:
    imu, field, states = raw.log.imu, raw.log.waveform, []
    assert field is not None
    navigator = Navigator(surveyed_site(), NavigatorSettings(estimator=estimator))
    edges = np.arange(0.0, 14.1, 0.1)
    for begin, end in pairwise(edges):
        i = (imu.time >= begin) & (imu.time < end)
        m = (field.time >= begin) & (field.time < end)
        navigator.add_imu(imu.time[i], imu.gyro_body[i], imu.accel_body[i])
        navigator.add_magnetometer(field.time[m], field.measured_sensor[m])
        states += navigator.take()
    assert raw.log.truth is not None
    errors = trajectory_errors(as_trajectory(states), raw.log.truth)
    assert len(states) >= 40
    assert np.diff(errors.time) == pytest.approx(0.2, abs=0.001)
    assert errors.ate < 0.003  # m
    assert errors.attitude_rmse_deg < 0.1
    assert navigator.losses == {}


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_the_claimed_covariance_is_that_of_the_errors(estimator: Estimator) -> None:
    nees = []
    for seed in range(3):
        log = online_log(seed, 40.0)
        errors = log.errors(navigate(log, NavigatorSettings(estimator))[1])
        assert errors.ate < 0.003  # m
        assert errors.attitude_rmse_deg < 0.06
        assert errors.nees is not None
        nees.append(np.mean(errors.nees))
    assert 4.5 < np.mean(nees) < 8.0  # six degrees of freedom


@pytest.mark.parametrize("estimator", BOTH)
@pytest.mark.parametrize("rests", [Rests(0.0, 20.0, 0.0), Rests(20.0, 1.0, 0.0)])
@pytest.mark.parametrize("seed", [11, 12])
def test_it_starts_moving_or_at_rest_with_any_heading(
    estimator: Estimator, rests: Rests, seed: int
) -> None:
    log = online_log(seed, 14.0, rests=rests)
    errors = log.errors(navigate(log, NavigatorSettings(estimator))[1])
    assert 6.0 < errors.time[0] < 7.0
    assert np.max(errors.attitude) < np.deg2rad(0.2)
    assert np.max(np.linalg.norm(errors.position_world, axis=1)) < 0.008  # m


def test_there_is_no_state_before_the_start(walk: OnlineLog) -> None:
    navigator = Navigator(walk.site)
    assert not navigator.started
    assert navigator.take() == []
    with pytest.raises(EstimationError, match="still gathering"):
        navigator.state()


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_the_state_between_epochs_is_carried_on_by_the_imu(
    walk: OnlineLog, estimator: Estimator
) -> None:
    separate, ahead = [], []

    def watch(navigator: Navigator, now: float) -> None:
        if navigator.started and now > 12.0:
            state = navigator.state()
            truth = walk.motion.trajectory(np.array([state.time]))
            separate.append(np.linalg.norm(state.position_world - truth.position_world[0]))
            ahead.append(now - state.time)

    navigate(walk, NavigatorSettings(estimator), watch=watch)
    assert np.max(ahead) < 0.03  # s; an IMU sample
    assert np.sqrt(np.mean(np.square(separate))) < 0.004  # m


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
@pytest.mark.parametrize(
    ("missing", "during", "fixes"), [([1], 0.006, 0), ([0, 1, 3], 0.05, 0), ([0, 1, 2, 3], 3.0, 1)]
)
def test_beacons_vanish_and_come_back(
    walk: OnlineLog, estimator: Estimator, missing: list[int], during: float, fixes: int
) -> None:
    holed = replace(walk, fields=silent(walk.fields, missing, 25.0, 50.0))
    navigator, states = navigate(holed, NavigatorSettings(estimator))
    time, error = distance(walk, states)
    assert np.max(error[(time > 25.0) & (time < 50.0)]) < during  # m
    assert np.max(error[time > 52.0]) < 0.005  # m
    assert navigator.counts["found by a fix"] <= fixes
    assert states[-1].reset_counter == navigator.counts["found by a fix"]
    assert set(navigator.losses) <= {"found by a fix", "lost and found again"}


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_without_any_field_the_clock_goes_on(walk: OnlineLog, estimator: Estimator) -> None:
    fields, gap = walk.fields, (walk.fields.time > 25.0) & (walk.fields.time < 60.0)
    kept = np.flatnonzero(~gap)
    holed = replace(walk, fields=_rows(fields, kept))
    _, states = navigate(holed, NavigatorSettings(estimator))
    times = np.array([s.time for s in states])
    longest = NavigatorSettings().longest_step
    assert np.max(np.diff(times)) == pytest.approx(longest, abs=0.05 * longest)
    sigma = [s.position_sigma for s in states if 25.0 < s.time < 60.0]
    known = [s.position_sigma for s in states if 20.0 < s.time < 25.0]
    # Not ever larger: where the walk pauses, the velocity is told.
    assert np.min(sigma) > 5.0 * np.max(known)
    assert np.max(sigma) > 5.0 * np.min(sigma)
    time, error = distance(walk, states)
    assert np.max(error[time > 62.0]) < 0.005  # m


def _rows(fields: FieldSamples, kept: np.ndarray) -> FieldSamples:
    return FieldSamples(
        fields.time[kept],
        fields.window[kept],
        fields.channels,
        fields.phasor_sensor[kept],
        fields.phasor_cov[kept],
    )


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_through_a_gap_of_the_imu_the_fields_carry_the_state(
    walk: OnlineLog, estimator: Estimator
) -> None:
    holed = replace(walk, imu=without_imu(walk.imu, 25.0, 55.0))
    behind = [0.0]

    def watch(navigator: Navigator, now: float) -> None:
        if navigator.started:
            behind.append(now - navigator.state().time)

    navigator, states = navigate(holed, NavigatorSettings(estimator), watch=watch)
    time, error = distance(walk, states)
    assert np.max(error[(time > 25.0) & (time < 55.0)]) < 0.01  # m
    assert np.max(error[time > 56.0]) < 0.005  # m
    assert navigator.counts["inertial gap bridged"] >= 60
    assert "lost and found again" not in navigator.counts
    assert max(behind) < 6.5  # s; it does not wait for the gap's end


def arriving(
    log: OnlineLog, settings: NavigatorSettings, lateness: float, seed: int | None
) -> tuple[Navigator, list[State]]:
    """Feed every sample on its own, each late by a random time up to the given."""
    rng = np.random.default_rng(seed)
    imu, fields = log.imu, log.fields
    due = np.concatenate([imu.time, fields.time])
    if seed is not None:
        due = due + rng.uniform(0.0, lateness, len(due))
    navigator, states = Navigator(log.site, settings), []
    for k in np.argsort(due, kind="stable"):
        if k < len(imu):
            navigator.add_imu(imu.time[k], imu.gyro_body[k], imu.accel_body[k])
        else:
            navigator.add_fields(epoch(fields, int(k) - len(imu)))
        states += navigator.take()
    return navigator, states


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_late_and_disordered_samples_change_nothing_within_the_delay(estimator: Estimator) -> None:
    log = online_log(4, 16.0)
    settings = NavigatorSettings(estimator, delay=0.5)
    _, ordered = arriving(log, settings, 0.0, None)
    navigator, disordered = arriving(log, settings, 0.45, 1)
    assert navigator.losses == {}
    times = [s.time for s in disordered]
    assert times == sorted(times)
    by_time = {s.time: s for s in ordered}
    # The start takes what has come by then; a few epochs on, it is forgotten.
    late = [s for s in disordered if s.time in by_time]
    assert len(late) >= len(disordered) - 2
    for state in late[-6:]:
        separate = state.position_world - by_time[state.time].position_world
        assert np.linalg.norm(separate) < 0.1 * state.position_sigma


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_what_comes_after_the_delay_is_counted_and_does_no_harm(estimator: Estimator) -> None:
    log = online_log(4, 24.0)
    navigator, states = arriving(log, NavigatorSettings(estimator, delay=0.1), 1.2, 1)
    assert navigator.losses["field too late"] > 0
    _, error = distance(log, states)
    assert np.max(error) < 0.05  # m


@pytest.mark.parametrize("ahead", [3600.0, -3600.0])
@pytest.mark.parametrize("stream", ["imu", "magnetometer", "fields"])
def test_a_clock_that_jumped_is_refused_and_the_state_stays(
    walk: OnlineLog, ahead: float, stream: str
) -> None:
    short = replace(walk, imu=without_imu(walk.imu, 12.0, 1e9))
    navigator, _ = navigate(short, NavigatorSettings("ekf"))
    before = navigator.state()
    time = np.array([navigator.state().time + ahead])
    way = "ahead" if ahead > 0 else "back"
    none = np.zeros((1, 3))
    give: dict[str, Callable[[], None]] = {
        "imu": lambda: navigator.add_imu(time, none, none),
        "magnetometer": lambda: navigator.add_magnetometer(time, none),
        "fields": lambda: navigator.add_fields(replace(epoch(walk.fields, 0), time=time)),
    }
    with pytest.raises(
        InputError, match=rf"^{stream}: its clock jumped {way} by 3\d\d\d(\.\d+)? s"
    ):
        give[stream]()
    assert navigator.take() == []
    assert np.array_equal(navigator.state().position_world, before.position_world)
    rest = walk.imu.time > 12.0
    navigator.add_imu(walk.imu.time[rest][:50], *(v[rest][:50] for v in _motion(walk.imu)))
    assert navigator.state().time > before.time


def _motion(imu: ImuSamples) -> tuple[np.ndarray, np.ndarray]:
    return imu.gyro_body, imu.accel_body


def test_samples_that_are_no_numbers_are_refused(walk: OnlineLog) -> None:
    navigator = Navigator(walk.site)
    with pytest.raises(InputError, match="imu: a sample is not finite"):
        navigator.add_imu(np.zeros(1), np.full((1, 3), np.nan), np.zeros((1, 3)))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_outliers_are_refused_one_by_one(walk: OnlineLog, estimator: Estimator) -> None:
    settings = NavigatorSettings(estimator)
    fields, count = spoiled(walk.fields, 0.2, 20.0, 60.0)
    navigator, states = navigate(replace(walk, fields=fields), settings)
    time, error = distance(walk, states)
    refused = sum(v for k, v in navigator.counts.items() if k.startswith("outlier of"))
    assert refused == count
    assert count > 50
    during = error[(time > 20.0) & (time < 60.0)]
    assert np.sqrt(np.mean(during**2)) < 1.5 * nominal(walk, settings)


@pytest.mark.parametrize("estimator", BOTH)
def test_a_platform_that_was_carried_away_is_found_again(estimator: Estimator) -> None:
    log, moved = online_log(21, 30.0), []

    def propagate_passage(navigator: Navigator, now: float) -> None:
        if now == 15.0:
            inner = (
                navigator._loop.running.estimator
            )  # nothing that arrives could tell it so much nonsense
            assert inner is not None
            wrong = inner.state.position_world + np.array([1.0, -0.5, 0.3])
            inner.replace_state(replace(inner.state, position_world=wrong))
            moved.append(inner.state.time)

    navigator, states = navigate(log, NavigatorSettings(estimator), watch=propagate_passage)
    assert navigator.counts["lost and found again"] == 1
    time, error = distance(log, states)
    lost_epochs = time[error > 0.3]
    assert len(lost_epochs) >= 3
    assert np.max(lost_epochs) - moved[0] < 3.0  # s; five epochs
    assert np.max(error[time > moved[0] + 5.0]) < 0.006  # m


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_an_update_that_fails_keeps_the_last_good_state(
    walk: OnlineLog, estimator: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = ErrorStateFilter if estimator == "ekf" else SlidingWindow
    whole, failed = kind.absorb, []

    def absorb(self, predicted, *rest) -> None:  # type: ignore[no-untyped-def]
        if 20.0 < predicted.state.time < 21.4:
            failed.append(predicted.state)
            raise EstimationError("singular")
        whole(self, predicted, *rest)

    monkeypatch.setattr(kind, "absorb", absorb)
    navigator, states = navigate(walk, NavigatorSettings(estimator))
    assert navigator.counts["update failed"] == len(failed) == 3
    kept = [s for s in states if 20.0 < s.time < 21.4]
    for state, predicted in zip(kept, failed, strict=True):
        assert np.array_equal(state.position_world, predicted.position_world)
        assert np.array_equal(state.cov, predicted.cov)
    time, error = distance(walk, states)
    assert np.max(error[(time > 12.0) & (time < 22.0)]) < 0.02  # m
    assert np.max(error[time > 22.0]) < 0.005  # m


def test_a_singular_update_of_the_filter_is_an_estimation_error(
    walk: OnlineLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr("magfusion.estimation.online.ekf.ErrorStateFilter.update_linear", singular)
    short = replace(walk, imu=without_imu(walk.imu, 9.0, 1e9))
    navigator, _ = navigate(short, NavigatorSettings("ekf"))
    assert navigator.counts["update failed"] > 0


def navigate_lagged(log: OnlineLog, lag: float) -> tuple[list[State], list[State]]:
    """Return the lagged states and those of now."""
    lagged: list[State] = []
    _, states = navigate(
        log,
        NavigatorSettings("smoother", lag=lag),
        watch=lambda navigator, _: lagged.extend(navigator.take_lagged()),
    )
    return lagged, list(states)


@pytest.mark.slow
def test_the_lagged_states_are_every_epoch_once_and_better() -> None:
    nees = []
    for seed in range(3):
        log = online_log(seed, 70.0)
        lagged, states = navigate_lagged(log, 3.0)
        assert [s.time for s in lagged] == [s.time for s in states[: len(lagged)]]
        assert states[-1].time - lagged[-1].time == pytest.approx(3.0, abs=0.6)
        own, later = (log.errors(part) for part in (states[: len(lagged)], lagged))
        assert later.ate < 0.8 * own.ate
        assert later.nees is not None
        nees.append(np.mean(later.nees))
    assert 3.5 < np.mean(nees) < 9.0


def recovers(
    estimator: Estimator, log: OnlineLog, missing: tuple[float, float], gap: tuple[float, float]
) -> None:
    """Outliers, a lost beacon, a gap of the IMU, late fields; ten epochs after, all is as before.

    The position error returns below three times its nominal value.
    """
    begin, end = missing
    fields, _ = spoiled(silent(log.fields, [1], begin, end), 0.2, begin, end)
    disturbed = replace(log, imu=without_imu(log.imu, *gap), fields=fields)
    usual = nominal(log, NavigatorSettings(estimator))
    for delay in (0.0, 0.6):
        settings = NavigatorSettings(estimator, delay=delay)
        _, states = navigate(disturbed, settings, late=0.5)
        time, error = distance(log, states)
        after = error[time > max(end, gap[1])]
        assert np.max(after[10:]) < 3.0 * usual
        assert np.min(after[:10]) < 3.0 * usual
        assert np.max(error[(time > 12.0) & (time <= end)]) < 1.0  # m


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_it_recovers_from_all_at_once(estimator: Estimator) -> None:
    recovers(estimator, online_log(5, 70.0, every=1.0), (20.0, 50.0), (38.0, 50.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "gap"), [("ekf", (400.0, 430.0)), ("smoother", (650.0, 680.0))]
)
def test_it_recovers_from_ten_minutes_without_a_beacon(
    estimator: Estimator, gap: tuple[float, float]
) -> None:
    recovers(estimator, online_log(5, 740.0, every=1.0), (80.0, 680.0), gap)
