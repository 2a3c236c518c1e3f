"""Errors that go together: what a log told is remembered whole, in files and in estimators."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import yaml
from example_site import mixed_site
from nees import average_nees_bounds

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.site import load_site, save_site
from magfusion.model.correlation import Component, Correlation, joined
from magfusion.model.parameters import (
    GROUPS,
    choose_blocks,
    dimension,
    initial_calibration,
    prior_sigma,
)
from magfusion.model.prior import parameters_of, prior_sqrt_covariance, prior_sqrt_information
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.results.coverage import coverage
from magfusion.results.errors import trajectory_errors
from magfusion.results.refinement import parameter_estimates, refined_site, result_site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    SimulationConfig,
    draw_drives,
    perturb_site,
    simulate_fields,
    simulate_log,
)
from magfusion.simulation.motion import random_walk_motion
from magfusion.units import DEGREE

RUNS = 40
CHAINS = 12
COMMON, OWN = 0.05, 0.002  # m; where all beacons stand, and where each stands among them
FILE = "site_correlation.parquet"


def moved_together(site: Site) -> Site:
    """Return a site whose beacons are off by centimetres together, by millimetres apart."""
    exact = BeaconSigma(np.full(3, np.hypot(COMMON, OWN)), np.zeros(3), np.zeros(2))
    beacons = tuple(replace(b, sigma=exact) for b in site.beacons)
    names = [b.name for b in beacons]
    share = COMMON**2 / (COMMON**2 + OWN**2)
    between = np.where(np.eye(len(names), dtype=bool), 1.0, share)
    correlation = Correlation(
        tuple(Component("beacons", name, "position", i) for name in names for i in range(3)),
        np.kron(between, np.eye(3)),
    )
    sensor = site.platform.magnetometer
    known = MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3))
    return replace(
        site,
        beacons=beacons,
        correlation=correlation,
        model_error=1e-6,
        platform=replace(site.platform, magnetometer=replace(sensor, sigma=known)),
    )


def some_cov(site: Site, seed: int = 3) -> tuple[tuple, np.ndarray]:
    blocks = choose_blocks(site, GROUPS)
    rng = np.random.default_rng(seed)
    root = 0.3 * rng.standard_normal((dimension(blocks), dimension(blocks)))
    sigma = prior_sigma(blocks)
    return blocks, sigma[:, None] * (root @ root.T + 0.1 * np.eye(len(root))) * sigma


def refined(site: Site) -> tuple[Site, tuple, np.ndarray]:
    declared = initial_calibration(site, 0.0)
    blocks, cov = some_cov(site)
    reported = parameter_estimates(declared, declared, blocks, cov)
    return refined_site(declared, blocks, cov, reported, "a log"), blocks, cov


def test_a_refined_site_remembers_the_whole_covariance(tmp_path: Path) -> None:
    site, blocks, cov = refined(mixed_site())
    save_site(site, tmp_path / "site.yaml")
    again = load_site(tmp_path / "site.yaml")
    rows = [p.group != "phase" for p in parameters_of(blocks)]
    spread = prior_sqrt_covariance(again, choose_blocks(again, GROUPS))[rows]
    sigma = np.sqrt(np.diagonal(cov))[rows]
    result, expected = (spread @ spread.T) / sigma / sigma[:, None], cov[np.ix_(rows, rows)]
    np.testing.assert_allclose(result, expected / sigma / sigma[:, None], rtol=0.0, atol=1e-9)


def test_the_root_whitens_what_the_spread_draws() -> None:
    site, _, _ = refined(mixed_site())
    blocks = choose_blocks(site, GROUPS)
    both = prior_sqrt_information(site, blocks) @ prior_sqrt_covariance(site, blocks)
    np.testing.assert_allclose(both, np.eye(len(both)), rtol=0.0, atol=1e-9)


def test_what_is_not_estimated_again_keeps_its_correlation() -> None:
    first, _, _ = refined(mixed_site())
    blocks = choose_blocks(first, ("moments",))
    cov = np.diag(prior_sigma(blocks) ** 2)
    second = refined_site(initial_calibration(first, 0.0), blocks, cov, [], "another log")
    for groups, same in ((("beacons", "magnetometer"), True), (("beacons", "moments"), False)):
        own = choose_blocks(first, groups)
        spread = [prior_sqrt_covariance(site, own) for site in (first, second)]
        assert np.allclose(spread[0], spread[1], rtol=1e-12, atol=0.0) == same


def test_a_sigma_changed_by_hand_is_independent_from_then_on(tmp_path: Path) -> None:
    site, _, _ = refined(mixed_site())
    path = tmp_path / "site.yaml"
    save_site(site, path)
    content = yaml.safe_load(path.read_text())
    content["beacons"][0]["sigma"]["position_m"] = [0.5, 0.5, 0.5]
    del content["beacons"][3]
    path.write_text(yaml.safe_dump(content))
    remaining = load_site(path).correlation
    assert remaining is not None
    owners = {(p.owner, p.kind) for p in remaining.parameters}
    names = [b.name for b in site.beacons]
    assert (names[0], "position") not in owners
    assert (names[0], "rotation") in owners
    assert not any(owner == names[3] for owner, _ in owners)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def _without_column(path: Path) -> None:
    pa.parquet.write_table(pa.parquet.read_table(path).drop_columns(["sigma"]), path)


def _changed(path: Path, change: dict[tuple[int, int], float]) -> None:
    table = pa.parquet.read_table(path)
    rows = table["correlation"].to_pylist()
    for (i, j), value in change.items():
        rows[i][j] = value
    index = table.column_names.index("correlation")
    pa.parquet.write_table(table.set_column(index, "correlation", [rows]), path)


@pytest.mark.parametrize(
    ("spoil", "findings"),
    [
        (Path.unlink, "there is no such correlation"),
        (_cut, "is no correlation"),
        (_without_column, "column sigma is missing"),
        (lambda path: _changed(path, {(0, 1): float("nan")}), "what no correlation is"),
        (lambda path: _changed(path, {(0, 1): 0.9, (1, 0): -0.9}), "what no correlation is"),
        (lambda path: _changed(path, {(0, 1): 2.0, (1, 0): 2.0}), "what no correlation is"),
    ],
)
def test_a_spoilt_file_is_refused_with_its_name_and_a_remedy(tmp_path, spoil, findings) -> None:
    site, _, _ = refined(mixed_site())
    save_site(site, tmp_path / "site.yaml")
    spoil(tmp_path / FILE)
    with pytest.raises(InputError, match=findings) as refusal:
        load_site(tmp_path / "site.yaml")
    assert FILE in str(refusal.value)
    assert "take the correlation out of it" in str(refusal.value)


def test_correlations_of_two_calibrations_stand_side_by_side() -> None:
    names = tuple(Component("beacons", "A", "position", i) for i in range(3))
    one = Correlation(names[:2], np.array([[1.0, 0.5], [0.5, 1.0]]))
    two = Correlation(names[2:], np.eye(1))
    both = joined([one, None, two])
    assert both is not None
    assert both.parameters == names
    assert both.coefficients.tolist() == [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert joined([None]) is None
    assert one.without(("beacons",), ["A"]) is None


@pytest.mark.slow
def test_the_simulator_draws_together_what_goes_together() -> None:
    site = moved_together(demo_site(coil_radius=None))
    rng = np.random.default_rng(0)
    draws = [perturb_site(site, rng) for _ in range(2000)]
    moved = np.array(
        [
            [
                b.position_world - a.position_world
                for a, b in zip(site.beacons, d.beacons, strict=True)
            ]
            for d in draws
        ]
    )
    middle = moved.mean(axis=1)
    assert np.std(middle) == pytest.approx(np.hypot(COMMON, OWN / 2.0), rel=0.05)
    separate = np.sqrt(np.mean((moved - middle[:, None]) ** 2) * 4.0 / 3.0)
    assert separate == pytest.approx(OWN, rel=0.05)


def nees_of_fixes(drawn: Site, reported: Site) -> float:
    """Return the mean NEES of one fix in each of many worlds."""
    result = []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        motion = random_walk_motion(rng, 20.0, DEMO_BOX_WORLD)
        truth = motion.trajectory(np.array([6.0, 9.0, 12.0]))
        samples = simulate_fields(
            perturb_site(drawn, rng), truth, 1e-9, rng, draw_drives(drawn, rng)
        )
        fixes = fix_epochs(samples, initial_calibration(reported, 0.0), survey_error=True)
        nees = trajectory_errors(fixes.best(), truth, max_gap=10.0).nees
        assert nees is not None
        result.append(nees[1])
    return float(np.mean(result))


@pytest.mark.slow
def test_a_fix_among_beacons_that_are_off_together_is_off_with_them() -> None:
    site = moved_together(demo_site(coil_radius=None))
    low, high = average_nees_bounds(6, RUNS, 0.999)
    assert low < nees_of_fixes(site, site) < high
    # Taken for independent, their errors would mostly cancel in a fix.
    assert nees_of_fixes(site, replace(site, correlation=None)) > high


@pytest.mark.slow
def test_the_smoother_is_as_unsure_of_the_world_as_its_beacons_are_together() -> None:
    """Four independent beacons would tell twice as well where they all stand."""
    site = moved_together(demo_site(coil_radius=None))
    config = SimulationConfig(DEMO_BOX_WORLD, duration=12.0)
    log = simulate_log(site, config, np.random.default_rng(1)).log
    for estimate in (None, ("time-offset",)):  # estimated, and considered
        for reported, sigma in ((site, COMMON), (replace(site, correlation=None), 0.5 * COMMON)):
            result = smooth(
                log, reported, SmootherSettings(estimate=estimate, loss=None, tune=False)
            )
            assert result.states.pose_cov is not None
            middle = result.states.pose_cov[len(result.states) // 2]
            horizontal = np.sqrt(0.5 * np.trace(middle[3:5, 3:5]))
            if estimate is None or reported is site:
                assert horizontal == pytest.approx(sigma, rel=0.15)


def roughly(site: Site) -> Site:
    """Return a site surveyed by eye, so that a log tells far more than the survey."""
    sigma = BeaconSigma(np.full(3, 0.05), np.full(3, 2.0 * DEGREE), np.full(2, 0.03))
    return replace(site, beacons=tuple(replace(b, sigma=sigma) for b in site.beacons))


def test_the_bound_of_the_coverage_knows_what_goes_together() -> None:
    site = moved_together(demo_site(coil_radius=None))
    points = np.array([[2.0, 1.5, 1.0], [1.0, 2.0, 1.5]])
    together = coverage(site, points, 1.0).position_sigma
    np.testing.assert_allclose(together, np.sqrt(3.0) * COMMON, rtol=0.05, atol=0.0)
    assert np.all(
        coverage(replace(site, correlation=None), points, 1.0).position_sigma < 0.8 * together
    )


def exactly(site: Site) -> Site:
    """Return a site that is what it says."""
    none = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    sensor = site.platform.magnetometer
    known = MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3))
    return replace(
        site,
        beacons=tuple(replace(b, sigma=none) for b in site.beacons),
        platform=replace(site.platform, magnetometer=replace(sensor, sigma=known)),
    )


def again(result: Smoothed) -> Site:
    """Return the site that a log refined, as the next log is smoothed with."""
    return result_site(result, "first")


@pytest.mark.slow
def test_the_second_log_is_as_honest_as_the_first() -> None:
    """Calibrated by one log, the next is consistent; by sigmas alone it is not."""
    site = roughly(replace(demo_site(coil_radius=None), model_error=1e-5))
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, motion="turn", time_offset=0.0)
    nees: dict[str, list[float]] = {"whole": [], "sigmas": []}
    for seed in range(CHAINS):
        rng = np.random.default_rng(seed)
        first = simulate_log(site, config, rng)
        second = simulate_log(exactly(first.true_site), config, rng)
        calibrated = again(smooth(first.log, site))
        for name, reported in (
            ("whole", calibrated),
            ("sigmas", replace(calibrated, correlation=None)),
        ):
            assert second.log.truth is not None
            result = trajectory_errors(smooth(second.log, reported).states, second.log.truth).nees
            assert result is not None
            nees[name].append(float(result[len(result) // 2]))
    low, high = average_nees_bounds(6, CHAINS, 0.999)
    assert low < np.mean(nees["whole"]) < high
    assert np.mean(nees["sigmas"]) > high
