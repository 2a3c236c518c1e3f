"""Steady movements of beacons, seen from a platform at rest."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.settlement import (
    AVERAGED,
    MAX_AVERAGES,
    Movement,
    Rest,
    movements,
)
from magfusion.jobs.drift_conditions import declared_site, endurance_config
from magfusion.jobs.drift_world import Reported, first_findings, navigate
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.endurance import draw_endurance
from magfusion.simulation.events import Events, Settlement
from magfusion.simulation.log import simulate_fields
from magfusion.units import DAY, HOUR, Array, ComplexArray

SITE = demo_site(synchronised=False)
ATTITUDE, POSITION = Rotation.from_euler("xyz", [0.2, -0.1, 0.7]), np.array([2.4, 2.1, 1.0])
NOISE = 0.01e-9  # T, of the mean of 15 minutes
SINKING = np.array([0.0, 0.0, -1e-3])  # m a day


@cache
def _at_rest(site: Site) -> ComplexArray:
    return _phasors(site, np.zeros(3), np.zeros(3))


def _phasors(site: Site, turn: Array, shift: Array) -> ComplexArray:
    attitude = ATTITUDE * Rotation.from_rotvec(turn)
    pose = Trajectory(np.zeros(1), attitude.as_matrix()[None], (POSITION + shift)[None])
    return simulate_fields(site, pose, 0.0, np.random.default_rng(0)).phasor_sensor[0]


def _moved(beacon: int, turn: Array, shift: Array) -> Site:
    one = SITE.beacons[beacon]
    new = replace(
        one,
        world_from_beacon=one.world_from_beacon @ Rotation.from_rotvec(turn).as_matrix(),
        position_world=one.position_world + shift,
    )
    return replace(SITE, beacons=(*SITE.beacons[:beacon], new, *SITE.beacons[beacon + 1 :]))


def _whitened(phasor: ComplexArray) -> Array:
    return np.concatenate([phasor.real, phasor.imag], axis=1).reshape(-1) / NOISE


def _rest() -> Rest:
    """Return a rest whose columns are central differences of the simulated fields."""
    none, step = np.zeros(3), 1e-6

    def difference(ahead: ComplexArray, behind: ComplexArray) -> Array:
        return _whitened(ahead - behind) / (2.0 * step)

    unit = step * np.eye(3)
    nominal = _phasors(SITE, none, none)
    by_pose = [difference(_phasors(SITE, u, none), _phasors(SITE, -u, none)) for u in unit]
    by_pose += [difference(_phasors(SITE, none, u), _phasors(SITE, none, -u)) for u in unit]
    by_drive = [
        _whitened(f * nominal * (np.arange(4) == k)[:, None]) for k in range(4) for f in (1.0, 1j)
    ]
    explained, _ = np.linalg.qr(np.array(by_pose + by_drive).T)
    columns = []
    for beacon in range(4):
        for kind in range(2):
            for u in unit:
                ahead = _moved(beacon, *((u, none) if kind == 0 else (none, u)))
                behind = _moved(beacon, *((-u, none) if kind == 0 else (none, -u)))
                both = (_phasors(one, none, none) for one in (ahead, behind))
                columns.append(difference(*both))
    by_movement = np.array(columns).T
    by_movement -= explained @ (explained.T @ by_movement)
    predicted = np.concatenate([nominal.real, nominal.imag], axis=1)
    whitening = np.broadcast_to(np.eye(6) / NOISE, (4, 6, 6))
    place = ATTITUDE.as_matrix(), POSITION, 0.0, 0.0, np.ones((4, 3), dtype=bool), NOISE**2
    none_yet = np.zeros(0), np.zeros(0), np.zeros((0, 24))
    return Rest(*place, predicted, whitening, explained, by_movement, *none_yet)


BEGUN = _rest()


def _observed(sites: list[Site], rng: np.random.Generator) -> list[Movement]:
    """Return the movements after a rest with two epochs an average, and clocks that advance."""
    rest = BEGUN
    gain = np.exp(np.cumsum(1e-3 * rng.standard_normal((len(sites), 4)), axis=0))
    for k, site in enumerate(sites):
        clock = np.exp(2j * np.pi * 0.13 * k * np.arange(1.0, 5.0))
        seen = (gain[k] * clock)[:, None] * _at_rest(site)
        noise = NOISE * rng.standard_normal((2, *seen.shape))
        seen = seen + noise[0] + 1j * noise[1]
        measured = np.concatenate([seen.real, seen.imag], axis=1)
        rest = rest.with_epoch(0.5 * AVERAGED * k, measured)
    return movements(rest, 4)


@cache
def _sinking(beacon: int, epochs: int) -> list[Site]:
    days = 0.5 * AVERAGED * np.arange(epochs) / DAY
    return [_moved(beacon, np.zeros(3), t * SINKING) for t in days]


@pytest.mark.parametrize("beacon", range(4))
def test_a_beacon_that_sinks_is_identified(beacon: int) -> None:
    (movement,) = _observed(_sinking(beacon, 96), np.random.default_rng(beacon))
    assert movement.beacon == beacon
    assert _chi_square(movement) < 18.5  # of three components, 0.03 %


def _chi_square(movement: Movement) -> float:
    """Return the squared error of what is observable: no shift that looks like a gain."""
    columns = BEGUN.by_movement[:, 6 * movement.beacon + 3 : 6 * movement.beacon + 6]
    observed = np.linalg.pinv(columns, rcond=1e-2) @ columns
    error = movement.per_day[3:] - observed @ SINKING
    assert not np.any(movement.per_day[:3])  # it does not turn
    return float(error @ np.linalg.pinv(movement.cov[3:, 3:], rcond=1e-6, hermitian=True) @ error)


def test_the_rates_are_consistent() -> None:
    squares = []
    for seed in range(40):
        squares += [_chi_square(m) for m in _observed(_sinking(1, 96), np.random.default_rng(seed))]
    assert len(squares) == 40
    assert 1.3 < np.mean(squares) < 2.8  # two components: one is not observable


def test_beacons_at_rest_are_not_named() -> None:
    for seed in range(100):
        assert not _observed([SITE] * 64, np.random.default_rng(seed))


def test_a_movement_of_all_beacons_is_not_observable() -> None:
    sites = []
    for t in 0.5 * AVERAGED * np.arange(96) / DAY:
        beacons = (replace(b, position_world=b.position_world + t * SINKING) for b in SITE.beacons)
        sites.append(replace(SITE, beacons=tuple(beacons)))
    assert not _observed(sites, np.random.default_rng(1))


def test_a_step_is_no_steady_movement() -> None:
    after = _moved(2, np.zeros(3), 3.0 * SINKING)
    assert not _observed([*[SITE] * 48, *[after] * 48], np.random.default_rng(2))


def test_a_rest_of_weeks_keeps_its_size() -> None:
    rest, phasor = BEGUN, BEGUN.predicted
    for k in range(5 * MAX_AVERAGES):
        rest = rest.with_epoch(AVERAGED * k, phasor)
    assert len(rest.count) <= MAX_AVERAGES
    assert rest.count.sum() == 5 * MAX_AVERAGES
    assert np.all(np.diff(rest.time) > 0.0)


def test_a_movement_within_the_declared_sigma_is_a_remark() -> None:
    cov = np.diag(np.repeat([1e-10, 1e-10], 3))
    small, large = (
        Movement(1, np.concatenate([np.zeros(3), SINKING]), cov, days, 2.0).finding(SITE)
        for days in (1.0, 5.0)
    )
    assert small.verdict is Verdict.TRUSTWORTHY  # 1 mm of 1 mm an axis
    assert large.verdict is Verdict.DOUBTFUL
    assert "Beacon B moves steadily against the others by at least 1 ±" in large.text
    assert large.remedy is not None
    (sigma,) = large.remedy.values()
    assert sigma[2] == pytest.approx(5.1e-3, abs=1e-4)


def test_a_beacon_that_turns_is_reported_to_turn() -> None:
    days = 0.5 * AVERAGED * np.arange(96) / DAY
    sites = [_moved(0, t * np.array([2e-3, 0.0, 0.0]), t * SINKING) for t in days]
    (movement,) = _observed(sites, np.random.default_rng(4))
    assert np.linalg.norm(movement.per_day[:3]) > 1e-3
    assert "and turns by 0.1" in movement.finding(SITE).text


@pytest.mark.slow
def test_a_static_platform_reports_a_settlement() -> None:
    usual = endurance_config("settlement", 8.0, "current", 0.0)
    config = replace(usual, events=Events(settlement=Settlement(per_day=2e-3)))
    world = draw_endurance(declared_site("settlement", "current", False), config, (3, 0))
    navigator, before = Navigator(world.site, NavigatorSettings(estimator="ekf")), world.start()
    reported: tuple[Reported, ...] = ()
    for first in range(0, config.blocks, 10):
        stretch = world.stretch(first, 10, before)
        *_, states = navigate(navigator, world, stretch)
        before, reported = stretch.after, first_findings(states, reported)
    assert len(reported) == 1, reported
    (one,) = reported
    assert one.code == "settlement"
    assert one.beacons == (world.site.beacons[world.events.beacon].name,)
    assert one.time < 8.0 * HOUR
