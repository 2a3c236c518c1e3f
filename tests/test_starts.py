"""Starts that are found where single epochs and their links lead astray."""

from dataclasses import replace

import numpy as np
import pytest
import random_starts
from random_starts import Case, recorded, single
from scipy.stats import binom, chi2

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.batch.chain import choose_chains
from magfusion.estimation.batch.search import differ, search, thinned
from magfusion.estimation.demodulation.demodulation import first_fixes
from magfusion.model.parameters import initial_calibration
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import demo_site


@pytest.fixture(scope="module")
def unknown_phase() -> Case:
    """Return a log of which no epoch alone tells the azimuth."""
    return single(1, 8.0, synchronised=False, rpy_deg=(-85, 4, 20))


@pytest.mark.slow
def test_a_lone_beacon_of_unknown_phase_is_found_by_tracks_alone(unknown_phase: Case) -> None:
    case = unknown_phase
    calibration = initial_calibration(case.site, float(np.mean(case.samples.time)))
    fixes = first_fixes(case.samples, case.simulated.log, calibration)
    chains = choose_chains(fixes, case.simulated.log.imu, 0.0, case.site)
    assert min(case.wrong(chain.states) for chain in chains) > 0.5
    result = search(case.samples, fixes, case.simulated.log.imu, calibration)
    assert case.wrong(result[0].states) < 0.02
    assert all(differ(result[0].states, other.states) for other in result[1:])
    np.testing.assert_array_equal(result[0].states.time, case.samples.time[thinned(case.samples)])


@pytest.mark.slow
def test_the_drive_phase_goes_with_the_start(unknown_phase: Case) -> None:
    case = unknown_phase
    best = case.starts()
    declared = next(s.declared for s in best if case.wrong(s.states) < 0.02)
    drives, time = case.simulated.drives, np.array(declared.reference_time)
    true = replace(declared, phase=drives.phase, drift=drives.drift, reference_time=0.0)
    lag = np.angle(np.exp(1j * (declared.phase - true.drive_phase(time))))
    assert np.max(np.abs(lag)) < 0.1  # rad


@pytest.mark.slow
def test_the_smoother_takes_it_from_there(unknown_phase: Case) -> None:
    case = unknown_phase
    result = smooth(case.simulated.log, case.site, SmootherSettings(tune=False))
    truth = case.simulated.log.truth
    assert truth is not None
    assert case.wrong(result.states) == 0.0
    assert trajectory_errors(result.states, truth).ate < 0.05  # m


@pytest.mark.slow
def test_starts_of_the_same_trajectory_are_no_rivals() -> None:
    """Two chains that differ at most epochs may lead to one optimum."""
    case = single(2, 8.0)
    result = smooth(case.simulated.log, case.site, SmootherSettings(tune=False))
    assert case.wrong(result.states) == 0.0
    if result.rival is not None:
        assert differ(result.states, result.rival)


def test_four_beacons_need_no_tracks() -> None:
    case = recorded(replace(demo_site(coil_radius=None), model_error=1e-3), 1, 6.0)
    starts = case.starts()
    assert len(starts) == 1
    assert starts[0].start.leaps == 0
    np.testing.assert_array_equal(
        starts[0].states.position_world, starts[0].start.states.position_world
    )


def test_a_swap_of_a_stretch_is_undone() -> None:
    """Fixes in which a mirror is the best hypothesis for two seconds lead no track astray."""
    case = single(5, 10.0)
    calibration = initial_calibration(case.site, float(np.mean(case.samples.time)))
    fixes = first_fixes(case.samples, case.simulated.log, calibration)
    truth = case.simulated.motion.trajectory(fixes.time).position_world
    away = np.linalg.norm(fixes.position_world - truth[:, None], axis=2)
    right = np.argmin(away, axis=1)
    stretch = (fixes.time > 4.0) & (fixes.time < 6.0)
    rows = np.arange(len(fixes))
    cost = fixes.cost.copy()
    cost[rows[stretch], right[stretch]] += 150.0
    result = search(case.samples, replace(fixes, cost=cost), case.simulated.log.imu, calibration)
    assert case.wrong(result[0].states) < 0.02


@pytest.mark.slow
def test_lone_rotating_beacons_are_found_and_honest() -> None:
    """What a survey errs by is the same for a whole log: its NEES is one draw, not many."""
    rows = [random_starts.run_one(seed, alone=True) for seed in range(8)]
    assert all(row.wrong_smoothed == 0.0 for row in rows)
    nees = [row.nees for row in rows if row.verdict == "trustworthy"]
    assert len(nees) >= 6
    assert np.sum(np.array(nees) > 12.0) <= binom.isf(1e-3, len(nees), chi2.sf(12.0, 6))
    assert 3.0 < np.mean(nees) < 8.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_whatever_beacons_there_are_some_start_is_right(seed: int) -> None:
    row = random_starts.run_one(seed, alone=False)
    assert row.success


def test_what_is_trusted_and_wrong_is_told() -> None:
    right = random_starts.Row(1, 1, True, 0.0, "trustworthy", (), 0.0, 13.0)
    mirrored = random_starts.Row(2, 2, True, 1.0, "trustworthy", (), 1.0, 5.0)
    doubted = replace(mirrored, seed=3, verdict="doubtful")
    findings = random_starts.report([right, mirrored, doubted])
    assert "a right start in 1 of 3" in findings
    assert "above 12: 1 of 2, where 0.1 are due" in findings
    assert "trusted and wrong: [2]" in findings
