"""Two days at rest: heat moves a fix and leaves it there, a clock turns it, a free phase does not.

Six worlds with a fix each five minutes are slow; one world with one each half hour is not.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import static_48h
from paper_rooms import F1, S0, draw_world
from static_48h import CASES, HOUR, METHODS, Config, Errors, Row

from magfusion.simulation.drift import Drift, DriveClock
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.waveform import Mains

TONES_HZ = np.array([25.0, 20.0, 30.0])
COARSE = Config(worlds=1, interval=1800.0)
CONVERGED_STEP = COARSE.time > COARSE.settled_hours * HOUR
World = dict[tuple[str, str], Errors]


@pytest.fixture(scope="module")
def world() -> World:
    return static_48h.run_world(COARSE, np.random.default_rng(3))


@pytest.fixture(scope="module")
def rows() -> dict[tuple[str, str], Row]:
    config = Config(worlds=6, interval=300.0)
    worlds = run_many(static_48h.run_world, [config] * config.worlds, seed=config.seed, workers=1)
    return {(row.case, row.method): row for row in static_48h.summarise(config, worlds)}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", ["current drive", "voltage drive"])
def test_the_error_does_not_grow(rows: dict[tuple[str, str], Row], case: str, method: str) -> None:
    row = rows[case, method]
    assert abs(row.position_slope) < 3.0 * row.position_slope_se
    assert abs(row.attitude_slope) < 3.0 * row.attitude_slope_se
    # Of a test that could not tell a drift from none nothing would follow.
    assert row.position_slope_se < (0.005 if method == "A3" else 0.002)  # m / 24 h
    assert row.attitude_slope_se < 0.05  # deg / 24 h


@pytest.mark.slow
def test_a_slow_clock_turns_the_attitude_where_the_phase_is_believed(
    rows: dict[tuple[str, str], Row],
) -> None:
    assert rows["0.01 ppm clock", "ML+map"].attitude_slope == pytest.approx(6.4, rel=0.05)
    for method in ("A3", "ML+map, phase free"):
        ours, without = rows["0.01 ppm clock", method], rows["current drive", method]
        assert abs(ours.attitude_slope) < 3.0 * ours.attitude_slope_se
        assert abs(ours.position_slope) < 3.0 * ours.position_slope_se
        assert ours.position_mean == pytest.approx(without.position_mean, rel=0.01)


@pytest.mark.slow
def test_one_world_shows_the_clock_and_its_remedy(world: World) -> None:
    case = "0.01 ppm clock"
    rotated = static_48h.slopes(COARSE, world[case, "ML+map"].attitude[None])
    assert rotated == pytest.approx(6.4, rel=0.07)  # deg / 24 h
    free_parameters, paper = world[case, "ML+map, phase free"], world[case, "A3"]
    for result, method in ((free_parameters, "ML+map, phase free"), (paper, "A3")):
        unharmed = world["current drive", method]
        # The noise meets another phase: alike, not equal.
        assert np.mean(result.attitude) == pytest.approx(np.mean(unharmed.attitude), rel=0.1)
        assert np.mean(result.position) == pytest.approx(np.mean(unharmed.position), rel=0.1)


@pytest.mark.slow
def test_heat_moves_fixes_within_hours_and_a_free_gain_moves_them_back(world: World) -> None:
    for method in ("A3", "ML+map"):
        cold, warm = (world[case, method].position for case in ("current drive", "voltage drive"))
        assert np.mean(warm[CONVERGED_STEP]) > 3.0 * np.mean(cold[CONVERGED_STEP])
        assert warm[0] < 0.7 * np.mean(warm[CONVERGED_STEP])
    warm, released = (world["voltage drive", m].position for m in ("ML+map", "ML+map, gain free"))
    assert np.mean(released[CONVERGED_STEP]) < 0.3 * np.mean(warm[CONVERGED_STEP])


def test_the_map_beats_the_paper(world: World) -> None:
    for case in CASES:
        ours, paper = world[case, "ML+map, phase free"], world[case, "A3"]
        assert np.mean(ours.position) < 0.5 * np.mean(paper.position)
        assert np.mean(ours.attitude) < 0.5 * np.mean(paper.attitude)


def test_hum_at_exactly_its_frequency_leaves_nothing_and_leaks_in_proportion() -> None:
    exact = replace(COARSE, mains_wander_hz=0.0)
    none = static_48h.hum(exact, TONES_HZ, np.random.default_rng(1))
    assert np.max(np.abs(none)) < 1e-12 * exact.mains.amplitude
    once, twice = (
        static_48h.hum(replace(Config(), mains=m), TONES_HZ, np.random.default_rng(1))
        for m in (Mains(5e-8), Mains(1e-7))
    )
    np.testing.assert_allclose(twice, 2.0 * once, rtol=1e-9, atol=1e-20)
    # A line 20 Hz away, off by 0.02 Hz in a window of a second: about sin(0.02 pi) / (20 pi).
    leaked = np.sqrt(np.mean(np.abs(once[:, 2, 2]) ** 2))
    assert leaked == pytest.approx(5e-8 * np.sin(0.02 * np.pi) / (20.0 * np.pi), rel=0.5)


def test_the_day_is_twice_as_loud_and_the_weights_say_so() -> None:
    config = Config(mains=Mains(0.0))
    drawn = static_48h.draw_surroundings(
        draw_world(S0, np.random.default_rng(0)), config, np.random.default_rng(1)
    )
    hour = config.time % (24.0 * HOUR) / HOUR
    day, night = (np.abs(hour - at) < 1.0 for at in (14.0, 2.0))
    rms = [np.sqrt(np.mean(drawn.added.real[part] ** 2)) for part in (day, night)]
    findings = [np.sqrt(np.mean(drawn.sigma[part] ** 2)) for part in (day, night)]
    np.testing.assert_allclose(rms, findings, rtol=0.05)
    assert rms[0] / rms[1] == pytest.approx(2.0, rel=0.08)
    # 0.4 nT / sqrt(Hz) in a window of a second.
    assert findings[0] == pytest.approx(0.4e-9, rel=0.02)


def test_a_clock_turns_the_phasors_and_nothing_else() -> None:
    config = replace(COARSE, mains=Mains(0.0), night_density=0.0, day_density=0.0)
    config = replace(config, receiver=replace(config.receiver, quantisation=0.0))
    world = draw_world(F1, np.random.default_rng(0))
    around = static_48h.draw_surroundings(world, config, np.random.default_rng(1))
    still, fast = (
        around.measure(world, drift, config, seed=1).phasor_sensor
        for drift in (Drift(), Drift(clock=DriveClock(rate=1e-8)))
    )
    rotated = np.angle(np.sum(np.conj(still) * fast, axis=-1))
    expected = 2.0 * np.pi * TONES_HZ * 1e-8 * config.time[:, None]
    np.testing.assert_allclose(rotated, expected, rtol=1e-9)
    np.testing.assert_allclose(np.abs(fast), np.abs(still), rtol=1e-9)


def test_a_drift_across_a_larger_constant_error_shows_in_its_component_alone() -> None:
    days, rng = COARSE.time / 86_400.0, np.random.default_rng(4)
    worlds = []
    for _ in range(8):
        off = 0.05 * rng.standard_normal((len(days), 3)) * [0.01, 0.01, 0.01] + [0.1, 0.0, 0.0]
        off[:, 2] += 0.005 * days
        turn = 0.2 * rng.standard_normal((len(days), 3))
        worlds.append({("case", "method"): Errors(off, turn)})
    (row,) = static_48h.summarise(COARSE, worlds)
    assert row.position_components is not None
    assert row.attitude_components is not None
    assert row.position_components.per_day[2] == pytest.approx(0.005, rel=0.1)
    assert row.position_slope < 0.1 * row.position_components.per_day[2]
    assert row.position_components.drifts(2)
    assert not row.attitude_components.drifts(2)
    assert "position DRIFTS" in static_48h.report(COARSE, (row,))
    few = static_48h.summarise(COARSE, worlds[:2])
    assert "no verdict" in static_48h.report(COARSE, few)


def test_slopes_are_those_of_the_settled_part() -> None:
    days = COARSE.time / 86_400.0
    error = np.where(CONVERGED_STEP, 0.3 + np.array([[0.02], [-0.5]]) * days, 99.0)
    np.testing.assert_allclose(static_48h.slopes(COARSE, error), [0.02, -0.5], rtol=1e-9)


@pytest.mark.slow
def test_the_scenario_draws_and_ends_with_one_json_line(
    world: World,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(static_48h, "run_many", lambda *_, **__: [world, world])
    given = ["static_48h.py", "--quick", "--workers", "1", "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", given)
    static_48h.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(json.loads(lines[-1])["rows"]) == len(CASES) * len(METHODS)
    assert sum("ML+map, phase free" in line for line in lines[:-1]) == len(CASES)
    assert (tmp_path / "static_48h.png").stat().st_size > 10_000
