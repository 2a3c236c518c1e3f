"""What a field map learns from a survey or a log, what it is worth, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, Worked, run_command
from paper_rooms import ROOM, S1, SimulatedWorld, draw_world
from scipy.spatial.transform import Rotation

from magfusion.calibration.fieldmap import MapFit, MapPoints, learn_field_map, thinned
from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, write_survey
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient, Spheres, draw_spheres
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

SEED = 5
NAMES = ("M1", "M2", "M3")
SURVEYED = replace(ROOM, spacing=0.75)


def _world() -> SimulatedWorld:
    return draw_world(S1, np.random.default_rng(SEED), SURVEYED)


def _points(survey: Survey) -> MapPoints:
    assert survey.phasor_sensor is not None
    return MapPoints(
        survey.world_from_body, survey.position_world, survey.phasor_sensor, survey.sigma
    )


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return _world()


@pytest.fixture(scope="module")
def survey(world: SimulatedWorld) -> Survey:
    return world.survey(np.random.default_rng(6))


@pytest.fixture(scope="module")
def fit(world: SimulatedWorld, survey: Survey) -> MapFit:
    return learn_field_map(world.site, _points(survey))


@pytest.fixture(scope="module")
def targets() -> Array:
    return SURVEYED.draw_targets(np.random.default_rng(7), 100)


# A room of smooth gain errors ------------------------------------------------------------------


@pytest.mark.slow
def test_the_cross_validated_error_falls_fivefold(fit: MapFit) -> None:
    for name in NAMES:
        assert fit.points[name] == len(SURVEYED.grid_world())
        assert fit.error_with[name] < fit.error_without[name] / 5.0


@pytest.mark.slow
def test_the_error_without_the_map_is_that_of_the_world(
    world: SimulatedWorld, survey: Survey, fit: MapFit
) -> None:
    gain = world.log_gain(survey.position_world)
    for c, name in enumerate(NAMES):
        expected = np.sqrt(np.mean(np.expm1(-gain[:, c]) ** 2))
        assert fit.error_without[name] == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_the_map_is_the_gain_of_the_world_and_claims_its_own_error(
    world: SimulatedWorld, fit: MapFit, targets: Array
) -> None:
    truth = world.log_gain(targets)
    for c, beacon in enumerate(fit.site.beacons):
        assert beacon.field_map is not None
        value, _ = beacon.field_map.mean(targets)
        error = value[:, 0] - truth[:, c]
        assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(truth[:, c] ** 2))
        claimed = beacon.field_map.variance(targets)[:, 0] + beacon.field_map.residual**2
        # One draw of a smooth function: a handful of independent errors, not a hundred.
        assert 0.1 < np.mean(error**2 / claimed) < 4.0


def _position_error(site: Site, world: SimulatedWorld, targets: Array) -> Array:
    turn = Rotation.random(len(targets), random_state=8).as_matrix()
    samples = world.measure(targets, turn, np.random.default_rng(9))
    best = fix_epochs(samples, initial_calibration(site, 0.0)).best()
    return np.asarray(np.linalg.norm(best.position_world - targets, axis=1))


@pytest.mark.slow
def test_a_fix_with_the_map_is_better_than_without(
    world: SimulatedWorld, fit: MapFit, targets: Array
) -> None:
    """At places and in attitudes that the survey did not have."""
    without = np.sqrt(np.mean(_position_error(world.site, world, targets) ** 2))
    remaining = np.sqrt(np.mean(_position_error(fit.site, world, targets) ** 2))
    assert remaining < without / 3.0


@pytest.mark.slow
def test_attitudes_and_unknown_phases_of_the_survey_make_no_difference(
    world: SimulatedWorld, survey: Survey, fit: MapFit, targets: Array
) -> None:
    """The map belongs to the place; a phase is no gain and no turn."""
    points = _points(survey)
    turn = Rotation.random(len(points), random_state=10).as_matrix()
    lag = np.random.default_rng(11).uniform(-np.pi, np.pi, points.sigma.shape)
    late = np.exp(1j * lag)[..., None] * (points.phasor_sensor @ turn)
    loose = tuple(replace(b, synchronised=False) for b in world.site.beacons)
    other = learn_field_map(
        replace(world.site, beacons=loose),
        replace(points, world_from_body=turn, phasor_sensor=late),
    ).site
    for result, wanted in zip(other.beacons, fit.site.beacons, strict=True):
        assert result.field_map is not None
        assert wanted.field_map is not None
        gain = wanted.field_map.mean(targets)[0][:, 0]
        separate = result.field_map.mean(targets)[0][:, 0] - gain
        assert np.sqrt(np.mean(separate**2)) < 0.05 * np.sqrt(np.mean(gain**2))


def test_a_beacon_that_was_hardly_heard_is_named(world: SimulatedWorld, survey: Survey) -> None:
    points = _points(survey)
    phasor = points.phasor_sensor.copy()
    phasor[7:, 1] = np.nan
    with pytest.raises(
        EstimationError, match="beacon M2 was detected at 7 points; a map requires 8"
    ):
        learn_field_map(world.site, replace(points, phasor_sensor=phasor))


def test_thinning_keeps_the_quietest_point_of_each_cube(
    world: SimulatedWorld, survey: Survey
) -> None:
    points = _points(survey)
    rng = np.random.default_rng(12)
    doubled = points.rows(np.repeat(np.arange(len(points)), 2))
    noisy = replace(doubled, sigma=doubled.sigma * rng.uniform(1.0, 2.0, (len(doubled), 1)))
    kept = thinned(noisy, world.site, 0.1)
    assert len(kept) == len(points)
    np.testing.assert_array_equal(kept.position_world, points.position_world)
    np.testing.assert_array_equal(
        kept.sigma[:, 0], np.min(noisy.sigma[:, 0].reshape(-1, 2), axis=1)
    )


# Through the command line ----------------------------------------------------------------------


@pytest.fixture
def surveyed(world: SimulatedWorld, survey: Survey, tmp_path: Path) -> Path:
    """Return a directory with a survey and its site, as a user has them."""
    directory = tmp_path / "survey"
    directory.mkdir()
    write_survey(survey, directory / "survey.parquet")
    save_site(world.site, directory / "site.yaml")
    return directory


def _figures(directory: Path) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads((directory / "report.json").read_text())
    return figures


@pytest.mark.slow
def test_a_survey_becomes_a_site_with_its_map(
    world: SimulatedWorld, fit: MapFit, surveyed: Path, targets: Array, tmp_path: Path
) -> None:
    output = tmp_path / "mapped"
    run_command("calibrate", "fieldmap", surveyed, "-o", output)
    names = {"site.yaml", "site_field_map.parquet", "field_map.png", "report.html", "report.json"}
    assert {p.name for p in output.iterdir()} == names
    figures = _figures(output)
    assert figures["job"] == "calibrate fieldmap"
    assert figures["points"] == len(SURVEYED.grid_world())
    for name in NAMES:
        assert figures[f"relative_error_with_{name}"] == pytest.approx(
            fit.error_with[name], rel=0.1
        )
    site = load_site(output / "site.yaml")
    assert np.median(_position_error(site, world, targets)) < np.median(
        _position_error(world.site, world, targets) / 3.0
    )


IRON = 30
SECONDS = 30.0


def _among_iron(site: Site, spheres: Spheres, seed: int, path: Path) -> Path:
    """Write a log of a walk in a room that holds iron, with everything else as declared."""
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=SECONDS,
        perturb=False,
        ambient=Ambient(spheres=spheres),
    )
    path.mkdir()
    write_log(simulate_log(site, config, np.random.default_rng(seed)).log, path)
    save_site(site, path / "site.yaml")
    return path


@pytest.mark.slow
def test_a_map_learnt_along_true_poses_mends_another_walk_among_the_same_iron(
    tmp_path: Path,
) -> None:
    site = demo_site()
    beacons_world = np.array([b.position_world for b in site.beacons])
    spheres = draw_spheres(np.random.default_rng(4), IRON, DEMO_BOX_WORLD, beacons_world)
    first = _among_iron(site, spheres, 14, tmp_path / "first")
    second = _among_iron(site, spheres, 24, tmp_path / "second")
    mapped, walked = tmp_path / "mapped", tmp_path / "walked"
    run_command("calibrate", "fieldmap", first, "-o", mapped)
    run_command("smooth", first, "-o", walked)
    run_command(
        *("calibrate", "fieldmap", first, "--trajectory", walked, "-o", tmp_path / "again"),
        *("--spacing", 0.5),
    )
    coarse = _figures(tmp_path / "again")
    assert 8 <= coarse["points"] < _figures(mapped)["points"]
    for name, options in {"plain": (), "with_map": ("--site", mapped / "site.yaml")}.items():
        run_command("fix", second, "-o", tmp_path / name, *options)
    plain, better = _figures(tmp_path / "plain"), _figures(tmp_path / "with_map")
    assert better["ate_m"] < 0.7 * plain["ate_m"]
    assert better["attitude_rmse_deg"] < 0.7 * plain["attitude_rmse_deg"]
    # Without the map the fixes are doubted, and their covariance is enlarged until it covers.
    assert plain["verdict"] == "doubtful"
    assert any("median epoch" in reason["text"] for reason in plain["reasons"])
    # With it only single epochs, close to iron that the map's points did not see, stick out.
    assert not any("median epoch" in reason["text"] for reason in better["reasons"])
    assert better["nees_mean"] < 6.0


# Refusals --------------------------------------------------------------------------------------


def test_a_survey_of_amplitudes_is_refused(
    survey: Survey, surveyed: Path, refuse: Refuse, tmp_path: Path
) -> None:
    assert survey.phasor_sensor is not None
    amplitude = np.linalg.norm(survey.phasor_sensor, axis=-1) / np.sqrt(2.0)
    path = surveyed / "survey.parquet"
    write_survey(replace(survey, phasor_sensor=None, amplitude=amplitude), path)
    findings = refuse("calibrate", "fieldmap", path, "-o", tmp_path / "out")
    assert f"{path}: has amplitudes, but a field map requires phasors" in findings


def test_a_beacon_that_the_site_does_not_have_is_refused(
    world: SimulatedWorld, surveyed: Path, refuse: Refuse, tmp_path: Path
) -> None:
    save_site(replace(world.site, beacons=world.site.beacons[:2]), surveyed / "site.yaml")
    findings = refuse("calibrate", "fieldmap", surveyed, "-o", tmp_path / "out")
    assert "tone 0 of beacon M3 is not in the site (it has M1, M2)" in findings


def test_too_few_points_are_refused(
    survey: Survey, surveyed: Path, refuse: Refuse, tmp_path: Path
) -> None:
    assert survey.phasor_sensor is not None
    few = Survey(
        survey.point[:7],
        survey.position_world[:7],
        survey.world_from_body[:7],
        survey.channels,
        survey.sigma[:7],
        survey.phasor_sensor[:7],
    )
    write_survey(few, surveyed / "survey.parquet")
    findings = refuse("calibrate", "fieldmap", surveyed, "-o", tmp_path / "out")
    assert f"{surveyed}: beacon M1 was detected at 7 points; a map requires 8" in findings


def test_a_survey_has_no_use_for_a_trajectory(
    worked: Worked, surveyed: Path, refuse: Refuse, tmp_path: Path
) -> None:
    options = ("--trajectory", worked.smoothed, "-o", tmp_path / "out")
    findings = refuse("calibrate", "fieldmap", surveyed, *options)
    assert "a survey has its own poses; omit --trajectory" in findings


def test_a_survey_without_a_site_is_refused(surveyed: Path, refuse: Refuse, tmp_path: Path) -> None:
    (surveyed / "site.yaml").unlink()
    findings = refuse("calibrate", "fieldmap", surveyed, "-o", tmp_path / "out")
    assert "has no site.yaml next to it; give it with --site SITE.yaml" in findings


def test_a_log_without_poses_is_refused(log: Path, refuse: Refuse, tmp_path: Path) -> None:
    (log / "truth.parquet").unlink()
    findings = refuse("calibrate", "fieldmap", log, "-o", tmp_path / "out")
    assert f"{log}: has no truth" in findings
    assert "--trajectory" in findings


@pytest.mark.parametrize("spacing", [0.0, -1.0, "nan"])
def test_a_spacing_that_is_none_is_refused(
    worked: Worked, refuse: Refuse, tmp_path: Path, spacing: float | str
) -> None:
    options = ("--spacing", spacing, "-o", tmp_path / "out")
    assert "--spacing must be above 0 m" in refuse("calibrate", "fieldmap", worked.log, *options)


def test_more_points_than_a_map_takes_are_refused(
    surveyed: Path, refuse: Refuse, tmp_path: Path
) -> None:
    dense = draw_world(S1, np.random.default_rng(SEED), replace(ROOM, spacing=0.15))
    write_survey(dense.survey(np.random.default_rng(6)), surveyed / "survey.parquet")
    findings = refuse("calibrate", "fieldmap", surveyed, "-o", tmp_path / "out")
    assert "points; a map has at most 600" in findings
