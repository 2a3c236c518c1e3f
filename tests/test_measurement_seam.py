"""A measurement and a calibration parameter from outside the package: one class each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pytest
from online_log import OnlineLog, epoch, online_log
from small_problem import small_log
from test_ekf import a_site, a_state, an_imu

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.state import State, States, between
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.parameters import (
    PARAMETERS,
    PHASOR_PARAMETERS,
    Block,
    Calibration,
    Parameter,
    choose_blocks,
    difference,
    dimension,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.results.errors import trajectory_errors
from magfusion.units import Array

Estimator = Literal["smoother", "ekf"]
BOTH: tuple[Estimator, ...] = ("smoother", "ekf")
ANCHORS = np.array([[0.0, 0.0, 0.5], [5.0, 0.0, 2.0], [2.0, 5.0, 1.0]])  # m
TRUE_SCALE = 0.01


@dataclass(frozen=True, eq=False)
class Range(Measurement):
    """Distances to known points (m)."""

    distance: Array
    point_world: Array
    sigma: float = 1e-3

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        away = states.position_world - self.point_world
        length = np.linalg.norm(away, axis=1, keepdims=True)
        by_pose = np.zeros((len(away), 1, 1, 6))
        by_pose[:, 0, 0, 3:] = np.einsum("ni,nij->nj", away / length, states.world_from_body)
        error = (length - self.distance[:, None])[:, None]
        return Rows(error / self.sigma, by_pose / self.sigma)


@dataclass(frozen=True, eq=False)
class Mixture(Measurement):
    """One number of everything that a state holds, as no sensor would give it."""

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        bias = states.read_bias()
        value = np.sum(states.velocity_world, axis=1) + 10.0 * np.sum(bias, axis=1)
        shape = (len(states), 1, 1)
        return Rows(
            100.0 * (value + calibration.time_offset)[:, None, None],
            by_velocity=np.full((*shape, 3), 100.0),
            by_bias=np.full((*shape, 6), 1000.0),
            by_calibration=np.full((*shape, dimension(blocks)), 100.0),
        )


class GyroScale(Parameter):
    """The gyro reads more than it should, by a factor."""

    group, owner, kind = "gyro-scale", "imu", "gyro_scale"
    inertial = True

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([0.03])

    def corrected_imu(self, calibration: Calibration, owner: str, imu: ImuSamples) -> ImuSamples:
        scale = calibration.others.get("imu.gyro_scale", np.zeros(1))
        return replace(imu, gyro_body=imu.gyro_body / (1.0 + scale))


KINDS = (*PARAMETERS, GyroScale())


# --- one EKF update is one Gauss-Newton step ---


def one_update(
    groups: tuple[str, ...], kinds: tuple[Parameter, ...], measured: Sequence[Measurement]
) -> tuple[State, State, Propagated, tuple[Block, ...]]:
    """Return filter and window after one interval from the same start."""
    rng, site = np.random.default_rng(7), a_site()
    blocks = choose_blocks(site, groups, parameters=kinds)
    start = a_state(site, blocks, rng)
    later, offset = start.time + 0.4, site.platform.imu.time_offset
    imu = an_imu(start.time, later, rng)
    predicted = propagate(start, imu, later, site, offset, blocks=blocks)
    light, still = (
        ErrorStateFilter(start, blocks),
        ProcessNoise(blocks, np.zeros(dimension(blocks))),
    )
    window = SlidingWindow(start, blocks, 10.0, still)
    light.absorb(predicted, measured)
    window.absorb(predicted, measured)
    return light.state, window.state, predicted, blocks


def a_range(count: int = 1) -> Range:
    now = np.zeros(count, dtype=np.int64)
    return Range(now, np.array([2.0, 3.0, 4.0])[:count], ANCHORS[:count])


NOW = np.zeros(1, dtype=np.int64)
CASES = {
    "a range": (("beacons",), PHASOR_PARAMETERS, [a_range()]),
    "everything in one number": (("time-offset",), PHASOR_PARAMETERS, [Mixture(NOW)]),
    "a range and a scale of the gyro": (("gyro-scale", "moments"), KINDS, [a_range()]),
    "two kinds and a scale of the gyro": (
        ("gyro-scale", "time-offset"),
        KINDS,
        [a_range(), Mixture(NOW)],
    ),
}


@pytest.mark.parametrize(("groups", "kinds", "measured"), CASES.values(), ids=CASES)
def test_one_update_of_the_filter_is_one_gauss_newton_step(
    groups: tuple[str, ...], kinds: tuple[Parameter, ...], measured: list[Measurement]
) -> None:
    light, window, predicted, blocks = one_update(groups, kinds, measured)
    sigma = np.sqrt(np.diag(light.cov))
    went = np.max(np.abs(between(predicted.state, light, blocks) / sigma))
    assert went > 0.1
    assert np.max(np.abs(between(light, window, blocks) / sigma)) < 1e-9 * max(1.0, went)
    scaled = (window.cov - light.cov) / np.outer(sigma, sigma)
    assert np.max(np.abs(scaled)) < 1e-9


# --- a range to a known point ---


def test_the_batch_fuses_ranges_at_times_of_their_own() -> None:
    small = small_log(5, sigma=4e-8, perturb=False)
    time = np.sort(np.repeat(small.truth.time[:-1] + 0.25, len(ANCHORS)))
    points = np.tile(ANCHORS, (len(small.truth) - 1, 1))
    true = np.stack([np.interp(time, small.truth.time, p) for p in small.truth.position_world.T], 1)
    alone = smooth(small.log, small.site, SmootherSettings(estimate=()))
    # The truth at those times is the IMU's, through states that are known.
    exact = smooth(
        small_log(5, sigma=1e-11, perturb=False).log,
        small.site,
        SmootherSettings(estimate=(), measurements=((time, _weightless(time, points, true)),)),
    )
    rows = np.searchsorted(exact.states.time, time)
    distance = np.linalg.norm(exact.states.position_world[rows] - points, axis=1)
    measured = Range(np.arange(len(time)), distance, points)
    settings = SmootherSettings(estimate=(), measurements=((time, measured),))
    fused = smooth(small.log, small.site, settings)
    assert set(time) <= set(fused.states.time.tolist())
    np.testing.assert_array_equal(fused.states.time[fused.epoch], fused.fields.time)
    ate = [
        trajectory_errors(result.states, small.truth, max_gap=1.0).ate for result in (alone, fused)
    ]
    assert ate[1] < 0.5 * ate[0]


def _weightless(time: Array, points: Array, true: Array) -> Range:
    """Return ranges without any weight: states are made at their times."""
    distance = np.linalg.norm(true - points, axis=1)
    return Range(np.arange(len(time)), distance, points, sigma=1e6)


def navigated(
    log: OnlineLog, settings: NavigatorSettings, *, ranges: bool
) -> tuple[Navigator, list[State]]:
    """Feed a log whose beacons fall silent at 15 s, with ranges or without."""
    navigator, states = Navigator(log.site, settings), []
    fed = 0
    for k, end in enumerate(np.arange(0.25, 30.0, 0.25)):
        now = (log.imu.time >= end - 0.25) & (log.imu.time < end)
        navigator.add_imu(log.imu.time[now], log.imu.gyro_body[now], log.imu.accel_body[now])
        while fed < len(log.fields) and log.fields.time[fed] < min(end, 15.0):
            navigator.add_fields(epoch(log.fields, fed))
            fed += 1
        if ranges and navigator.started and end > 15.0:
            when = end - 0.1
            truth = log.motion.trajectory(np.array([when])).position_world
            anchor = ANCHORS[[k % len(ANCHORS)]]
            distance = np.linalg.norm(truth - anchor, axis=1)
            navigator.add_measurement(when, Range(NOW, distance, anchor))
        states += navigator.take()
    return navigator, states


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_online_ranges_hold_the_platform_where_no_beacon_is(estimator: Estimator) -> None:
    log = online_log(6, 31.0)
    settings = NavigatorSettings(estimator)
    worst = {}
    for ranges in (False, True):
        navigator, states = navigated(log, settings, ranges=ranges)
        assert navigator.counts["measurement too late"] == 0
        errors = log.errors(states)
        worst[ranges] = np.max(np.linalg.norm(errors.position_world[errors.time > 15.0], axis=1))
    assert worst[True] < 0.02  # m
    assert worst[True] < 0.2 * worst[False]


# --- a scale factor of the gyro ---


def scaled(log: OnlineLog) -> OnlineLog:
    imu = replace(log.imu, gyro_body=(1.0 + TRUE_SCALE) * log.imu.gyro_body)
    return replace(log, imu=imu)


def scale_of(calibration: Calibration, declared: Calibration, blocks: tuple[Block, ...]) -> float:
    own = next(b for b in blocks if isinstance(b.parameter, GyroScale))
    return float(difference(declared, calibration, blocks)[own.columns][0])


def test_the_batch_finds_a_scale_factor_of_the_gyro() -> None:
    small = small_log(9, epochs=60, perturb=False)
    imu = replace(small.imu, gyro_body=(1.0 + TRUE_SCALE) * small.imu.gyro_body)
    log = replace(small.log, imu=imu)
    settings = SmootherSettings(estimate=("gyro-scale",), parameters=KINDS)
    result = smooth(log, small.site, settings)
    sigma = float(np.sqrt(result.calibration_cov[-1, -1]))
    assert result.converged
    assert sigma < 0.1 * TRUE_SCALE
    scale = scale_of(result.calibration, result.declared, result.blocks)
    assert scale == pytest.approx(TRUE_SCALE, abs=4.0 * sigma)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", BOTH)
def test_online_the_scale_factor_of_the_gyro_is_found(estimator: Estimator) -> None:
    log = scaled(online_log(8, 31.0))
    settings = NavigatorSettings(estimator, estimate=("gyro-scale",), parameters=KINDS)
    navigator = Navigator(log.site, settings)
    for k in range(len(log.fields)):
        end = log.fields.time[k] + 0.02
        begin = -np.inf if k == 0 else log.fields.time[k - 1] + 0.02
        now = (log.imu.time >= begin) & (log.imu.time < end)
        navigator.add_imu(log.imu.time[now], log.imu.gyro_body[now], log.imu.accel_body[now])
        navigator.add_fields(epoch(log.fields, k))
    state = navigator.take()[-1]
    assert state.time > 25.0
    own = next(b for b in navigator.blocks if isinstance(b.parameter, GyroScale))
    sigma = float(np.sqrt(state.cov[15:, 15:][own.columns, own.columns][0, 0]))
    assert sigma < 0.1 * TRUE_SCALE
    result = float(state.calibration.others["imu.gyro_scale"][0])
    assert result == pytest.approx(TRUE_SCALE, abs=4.0 * sigma)
