"""Beacons that were never surveyed are placed by the log."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import self_survey
import yaml
from conftest import Refuse, run_command
from example_site import mixed_site
from scipy.spatial.transform import Rotation
from self_survey import Config, turn_deg, without_survey

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.batch.beacon_placement import detected_along, places
from magfusion.estimation.batch.self_survey import Hypothesis, Placement, decide, smooth_and_place
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.parameters import initial_calibration
from magfusion.model.progress import quiet
from magfusion.model.site import Site, Unknown
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_fields, simulate_log

NOISE = 1e-13  # T; next to nothing


def path_of(count: int, extent: float = 1.0) -> Trajectory:
    """Return poses along a curve through the box; all at one place where the extent is zero."""
    time = np.linspace(0.0, 60.0, count)
    middle, half = np.mean(DEMO_BOX_WORLD, axis=0), 0.4 * np.ptp(DEMO_BOX_WORLD, axis=0)
    swing = np.stack([np.sin(0.21 * time), np.sin(0.34 * time + 1.0), np.sin(0.5 * time)], axis=1)
    angles = extent * np.stack([0.3 * swing[:, 0], 0.2 * swing[:, 1], time], axis=1)
    rotated = Rotation.from_euler("xyz", angles)
    return Trajectory(time, rotated.as_matrix(), middle + extent * half * swing)


def drives(site: Site) -> Drives:
    """Return phases and clock errors for the beacons that are not synchronised."""
    free_parameters = np.array([not b.synchronised for b in site.beacons])
    tones = [len(b.tones) for b in site.beacons]
    phase = np.linspace(-2.0, 2.5, sum(tones)) * np.repeat(free_parameters, tones)
    return Drives(phase, np.linspace(2.5e-5, -3e-5, len(free_parameters)) * free_parameters)


@pytest.mark.parametrize("unknown", ["pose", "position", "attitude"])
@pytest.mark.parametrize("index", range(4))
def test_exact_fields_along_a_known_path_place_any_beacon(index: int, unknown: Unknown) -> None:
    """Two coils, three by frequency with free phases, one with a free phase, two again."""
    site = mixed_site()
    path = path_of(150)
    samples = simulate_fields(site, path, NOISE, np.random.default_rng(1), drives(site))
    lost_epochs = without_survey(site.beacons[index], unknown)
    detected = detected_along(lost_epochs, initial_calibration(site, 0.0), samples, path, 1.0)
    chi_square, result = places(detected)[0]
    true = site.beacons[index]
    assert np.linalg.norm(result.position_world - true.position_world) < 1e-4
    if len(true.coils) == 1:  # its attitude is that of its axis, of either sign
        axis = [b.world_from_beacon @ b.coils[0].moment_beacon for b in (result, true)]
        sine = np.linalg.norm(np.cross(*axis)) / np.prod(np.linalg.norm(axis, axis=1))
        assert sine < 1e-4
    else:
        between = Rotation.from_matrix(result.world_from_beacon.T @ true.world_from_beacon)
        if true.synchronised:
            assert between.magnitude() < 1e-4
    assert chi_square < 1.0  # weighed by the trajectory's errors, of which there are none


def test_a_platform_at_rest_leaves_more_than_one_place() -> None:
    site = demo_site(coil_radius=None)
    path = path_of(60, extent=0.0)
    samples = simulate_fields(site, path, NOISE, np.random.default_rng(1))
    lost_epochs = without_survey(site.beacons[1], "position")
    detected = detected_along(lost_epochs, initial_calibration(site, 0.0), samples, path, 1.0)
    result = [(chi, beacon.position_world) for chi, beacon in places(detected) if chi < 1.0]
    true = site.beacons[1].position_world
    mirror = 2.0 * detected.sensor_world[0] - true
    for place in (true, mirror):
        assert min(np.linalg.norm(position - place) for _, position in result) < 1e-3


@pytest.fixture(scope="module")
def walk() -> SimulatedLog:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=25.0)
    return simulate_log(demo_site(), config, np.random.default_rng(5))


def with_unknown(*names: str, synchronised: bool = True) -> Site:
    site = demo_site(synchronised=synchronised)
    beacons = tuple(without_survey(b, "pose") if b.name in names else b for b in site.beacons)
    return replace(site, beacons=beacons)


@pytest.mark.slow
def test_a_beacon_is_placed_by_a_short_walk_and_its_sigma_covers_the_error(
    walk: SimulatedLog,
) -> None:
    result, placed = smooth_and_place(walk.log, with_unknown("B"), SmootherSettings(), quiet)
    estimate, true = (s.beacons[1] for s in (result.calibration.site, walk.true_site))
    error = estimate.position_world - true.position_world
    assert np.linalg.norm(error) < 0.03  # m
    assert turn_deg(estimate, true) < 1.0
    own = next(block.columns for block in result.blocks if block.name == "B.position")
    sigma = np.sqrt(np.diagonal(result.calibration_cov)[own])
    assert np.all(np.abs(error) < 4.0 * sigma)
    assert np.all(sigma < 0.02)
    assert estimate.unknown is None
    assert placed[0].name == "B"
    assert placed[0].hypotheses[0].smoothed
    assert placed[0].hypotheses[0].chi_square == 0.0


@pytest.mark.slow
def test_the_whole_log_decides_between_places(walk: SimulatedLog) -> None:
    """Even against what the first trajectory said: the wrong place comes first here."""
    lost_epochs, surveyed = with_unknown("B"), demo_site().beacons[1]
    sigma = replace(surveyed.sigma, position_world=np.full(3, 0.02))
    right = replace(surveyed, sigma=sigma)
    wrong = replace(right, position_world=right.position_world + np.array([0.0, 0.4, 0.0]))
    reported = Placement("B", (Hypothesis(wrong, 0.0), Hypothesis(right, 50.0)))
    result, placed = decide(
        walk.log, lost_epochs, SmootherSettings(max_iterations=1), quiet, [reported]
    )
    first, second = placed[0].hypotheses
    assert first.beacon is right
    assert (first.chi_square, first.smoothed) == (0.0, True)
    assert second.chi_square > 20.0
    estimate = result.calibration.site.beacons[1].position_world
    assert np.linalg.norm(estimate - walk.true_site.beacons[1].position_world) < 0.03


@pytest.mark.slow
def test_a_site_without_unknown_beacons_is_smoothed_as_ever(walk: SimulatedLog) -> None:
    site = demo_site()
    result, placed = smooth_and_place(walk.log, site, SmootherSettings(max_iterations=1), quiet)
    plain = smooth(walk.log, site, SmootherSettings(max_iterations=1))
    assert placed == ()
    np.testing.assert_array_equal(result.states.position_world, plain.states.position_world)


def test_what_cannot_place_a_beacon_is_refused(walk: SimulatedLog) -> None:
    with pytest.raises(InputError, match="2 are needed"):
        smooth_and_place(walk.log, with_unknown("A", "B", "C"), SmootherSettings(), quiet)
    for settings in (SmootherSettings(coupling="loose"), SmootherSettings(estimate=("phase",))):
        with pytest.raises(InputError, match="tight coupling"):
            smooth_and_place(walk.log, with_unknown("A"), settings, quiet)
    with pytest.raises(InputError, match="place it by"):
        smooth(walk.log, with_unknown("A"))


def test_a_beacon_that_was_not_heard_is_not_placed() -> None:
    site = demo_site()
    path = path_of(30)
    samples = simulate_fields(site, path, NOISE, np.random.default_rng(1))
    silent = samples.phasor_sensor.copy()
    silent[3:, 0] = np.nan
    samples = replace(samples, phasor_sensor=silent)
    lost_epochs = without_survey(site.beacons[0], "pose")
    with pytest.raises(EstimationError, match="beacon A was detected at 3 epochs"):
        detected_along(lost_epochs, initial_calibration(site, 0.0), samples, path, 1.0)


@pytest.mark.parametrize("unknown", ["pose", "position", "attitude"])
def test_a_site_keeps_what_is_unknown_of_a_beacon(tmp_path: Path, unknown: Unknown) -> None:
    site = demo_site()
    lost_epochs = without_survey(site.beacons[2], unknown)
    declared = replace(site, beacons=(*site.beacons[:2], lost_epochs, site.beacons[3]))
    save_site(declared, tmp_path / "site.yaml")
    read = load_site(tmp_path / "site.yaml", unknown=True).beacons[2]
    assert read.unknown == unknown
    assert np.all(np.isnan(read.position_world)) == (unknown != "attitude")
    assert np.all(np.isnan(read.world_from_beacon)) == (unknown != "position")
    with pytest.raises(InputError, match=rf"beacons\[2\]\.unknown: .*the {unknown} of beacon C"):
        load_site(tmp_path / "site.yaml")


def test_a_place_is_either_given_or_unknown(tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    content = yaml.safe_load((tmp_path / "site.yaml").read_text())
    content["beacons"][1]["unknown"] = "position"
    (tmp_path / "both.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=r"beacons\[1\]\.position_m: .*remove it or unknown"):
        load_site(tmp_path / "both.yaml", unknown=True)
    del content["beacons"][1]["unknown"], content["beacons"][1]["position_m"]
    (tmp_path / "neither.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=r"beacons\[1\]\.position_m: is missing"):
        load_site(tmp_path / "neither.yaml", unknown=True)


@pytest.mark.slow
def test_the_command_places_a_beacon_and_writes_a_whole_site(
    walk: SimulatedLog, tmp_path: Path, refuse: Refuse, capfd: pytest.CaptureFixture[str]
) -> None:
    write_log(walk.log, tmp_path / "log")
    save_site(with_unknown("D"), tmp_path / "log" / "site.yaml")
    findings = refuse("fix", tmp_path / "log", "-o", tmp_path / "fixes")
    assert "beacons[3].unknown" in findings
    run_command("smooth", tmp_path / "log", "-o", tmp_path / "run")
    assert "beacon D was placed at" in capfd.readouterr().out
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    result = load_site(tmp_path / "run" / "site.yaml").beacons[3]
    true = walk.true_site.beacons[3].position_world
    assert np.linalg.norm(result.position_world - true) < 0.03
    assert report["placed"] == ["D"]
    assert report["placed_D_x_m"] == pytest.approx(result.position_world[0], abs=1e-9)
    assert len(report["hypotheses_D"]) >= 1
    run_command(
        "fix", tmp_path / "log", "--site", tmp_path / "run" / "site.yaml", "-o", tmp_path / "f"
    )


@pytest.mark.slow
def test_two_minutes_place_every_beacon_to_3_cm_and_1_degree() -> None:
    rows = self_survey.run_walk(Config(), np.random.default_rng(1))
    assert [row.beacon for row in rows] == ["A", "B", "C", "D"]
    assert max(row.position_m for row in rows) < 0.03
    assert max(row.rotation_deg for row in rows) < 1.0


@pytest.mark.slow
def test_free_drive_phases_leave_the_place_and_the_axis() -> None:
    config = Config(synchronised=False, duration=60.0)
    rows = self_survey.run_walk(config, np.random.default_rng(3))
    assert max(row.position_m for row in rows) < 0.03
    assert max(row.rotation_deg for row in rows) < 1.0


@pytest.mark.slow
def test_the_scenario_ends_with_its_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["self_survey", "--quick", "--workers", "1", "-o", str(tmp_path)]
    )
    self_survey.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures["position_worst_m"] < 0.03
    assert figures["rotation_worst_deg"] < 1.0
    assert (tmp_path / "self_survey.png").stat().st_size > 10_000
