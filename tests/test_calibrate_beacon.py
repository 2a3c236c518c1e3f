"""The command that calibrates beacons from a survey: its files, its truth, what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation

from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, write_survey
from magfusion.model.site import Beacon, BeaconSigma, Site
from magfusion.model.steel_field import SteelField
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import draw_drives, perturb_site, simulate_fields
from magfusion.units import DEGREE, Array

NOISE = 2e-10  # T
ROUND = np.array([[2, 1, 0.5], [-1, 2, -0.4], [-2, -1, 1.5], [1, -2, 0.8], [0.5, 1.5, -1]])


def site_of(*, synchronised: bool = True) -> Site:
    """Return beacons that are known to a decimetre, five degrees and a few percent."""
    plain = demo_site(coil_radius=None, synchronised=synchronised)
    sigma = BeaconSigma(np.full(3, 0.1), np.full(3, 5.0 * DEGREE), np.full(2, 0.03))
    beacons = tuple(replace(b, sigma=sigma) for b in plain.beacons[:2])
    return replace(plain, beacons=beacons, model_error=0.0)


def survey_of(site: Site, true_site: Site, offset: Array, seed: int = 1) -> Survey:
    """Return what magnetometers at any attitude about beacon A measure of both beacons."""
    rng = np.random.default_rng(seed)
    count = len(offset)
    poses = Trajectory(
        1e-6 * np.arange(count),  # at one time, hence at one drive phase
        Rotation.random(count, random_state=seed).as_matrix(),
        site.beacons[0].position_world + offset,
    )
    drives = draw_drives(site, rng)
    samples = simulate_fields(true_site, poses, NOISE, rng, drives)
    return Survey(
        point=np.arange(count),
        position_world=poses.position_world,
        world_from_body=poses.world_from_body,
        channels=samples.channels,
        sigma=np.full((count, len(samples.channels)), NOISE),
        phasor_sensor=samples.phasor_sensor,
    )


def written(root: Path, *, synchronised: bool = True, seed: int = 1) -> tuple[Site, Site]:
    site = site_of(synchronised=synchronised)
    true_site = perturb_site(without_sensor_error(site), np.random.default_rng(seed))
    save_site(site, root / "site.yaml")
    write_survey(survey_of(site, true_site, ROUND, seed), root / "survey.parquet")
    return site, true_site


def without_sensor_error(site: Site) -> Site:
    """Return the site with a magnetometer that is known exactly."""
    magnetometer = site.platform.magnetometer
    zeros = np.zeros(3)
    sigma = replace(
        magnetometer.sigma, matrix=np.zeros((3, 3)), rotation_sensor=zeros, position_body=zeros
    )
    known = replace(magnetometer, sigma=sigma)
    return replace(site, platform=replace(site.platform, magnetometer=known))


def turn_deg(result: Beacon, true: Beacon) -> Array:
    between = Rotation.from_matrix(true.world_from_beacon.T @ result.world_from_beacon)
    return np.asarray(between.as_rotvec() / DEGREE)


@pytest.mark.slow
def test_the_command_finds_what_the_survey_of_the_site_missed(tmp_path: Path) -> None:
    site, true_site = written(tmp_path)
    options = ("--site", tmp_path / "site.yaml", "-o", tmp_path / "out")
    for _ in range(2):  # an earlier result is replaced
        run_command("calibrate", "beacon", tmp_path / "survey.parquet", *options)
    assert (tmp_path / "out" / "beacon.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    refined = load_site(tmp_path / "out" / "site.yaml")
    for declared, result, true in zip(
        site.beacons, refined.beacons, true_site.beacons, strict=True
    ):
        before = np.linalg.norm(declared.position_world - true.position_world)
        error = result.position_world - true.position_world
        assert np.linalg.norm(error) < 0.1 * before
        assert np.all(np.abs(error) < 4.0 * result.sigma.position_world)
        assert np.all(np.abs(turn_deg(result, true)) < 4.0 * result.sigma.rotation_beacon / DEGREE)
        size = [np.linalg.norm(b.moments_beacon, axis=1) for b in (result, true)]
        assert np.all(np.abs(np.log(size[0] / size[1])) < 4.0 * result.sigma.log_moment)
        assert report[f"residual_rms_{result.name}"] == pytest.approx(1.0, abs=0.5)
        assert report[f"other_places_{result.name}"] == 0
    assert report["undetermined"] == []
    assert refined.calibration is not None
    assert refined.calibration["determined"] == report["determined"]


def test_an_unknown_drive_phase_leaves_the_turn_about_the_axis(tmp_path: Path) -> None:
    site, true_site = written(tmp_path, synchronised=False)
    run_command(
        "calibrate", "beacon", tmp_path / "survey.parquet", "--site", tmp_path / "site.yaml",
        "-o", tmp_path / "out", "--beacon", "A",
    )  # fmt: skip
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    refined = load_site(tmp_path / "out" / "site.yaml")
    result, true, declared = (s.beacons[0] for s in (refined, true_site, site))
    assert np.linalg.norm(result.position_world - true.position_world) < 0.01
    assert report["undetermined"] == ["A.rotation_z_deg"]
    assert result.sigma.rotation_beacon[2] == pytest.approx(5.0 * DEGREE, rel=1e-6)
    assert abs(turn_deg(result, declared)[2]) < 0.5  # deg; it keeps what the site declares
    error = turn_deg(result, true)[:2]
    assert np.all(np.abs(error) < 4.0 * result.sigma.rotation_beacon[:2] / DEGREE + 0.1)
    # The other beacon was not asked for.
    np.testing.assert_allclose(
        refined.beacons[1].position_world, site.beacons[1].position_world, rtol=0.0, atol=0.0
    )


@pytest.mark.slow
def test_a_map_of_steel_is_not_of_the_beacon_that_a_survey_refines(tmp_path: Path) -> None:
    """As its field map it goes, and the survey alone decides; another beacon keeps its own."""
    site, _ = written(tmp_path)
    steel = SteelField(np.array([[2.0, 1.0, 1.0]]), np.array([0.2]), np.full((1, 2, 3), 5.0))
    mapped = replace(site, beacons=tuple(replace(b, steel=steel) for b in site.beacons))
    save_site(mapped, tmp_path / "mapped.yaml")
    results = []
    for name in ("site", "mapped"):
        run_command(
            "calibrate", "beacon", tmp_path / "survey.parquet", "--beacon", "A",
            "--site", tmp_path / f"{name}.yaml", "-o", tmp_path / name,
        )  # fmt: skip
        results.append(load_site(tmp_path / name / "site.yaml").beacons)
    (plain, _), (refined, other) = results
    np.testing.assert_array_equal(refined.position_world, plain.position_world)
    assert refined.steel is None
    assert other.steel is not None


def corrupted(root: Path, survey: Survey) -> tuple[object, ...]:
    write_survey(survey, root / "survey.parquet")
    return ("calibrate", "beacon", root / "survey.parquet", "--site", root / "site.yaml")


def selected(survey: Survey, points: list[int]) -> Survey:
    assert survey.phasor_sensor is not None
    return Survey(
        survey.point[points],
        survey.position_world[points],
        survey.world_from_body[points],
        survey.channels,
        survey.sigma[points],
        survey.phasor_sensor[points],
    )


def test_what_a_survey_cannot_tell_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    site, true_site = written(tmp_path)
    survey = survey_of(site, true_site, ROUND)
    assert survey.phasor_sensor is not None
    out = ("-o", tmp_path / "out")
    one = refuse(*corrupted(tmp_path, selected(survey, [0])), *out)
    assert "survey.parquet: beacon A was measured at 1 point;" in one
    amplitude = replace(
        survey, phasor_sensor=None, amplitude=np.linalg.norm(survey.phasor_sensor, axis=2)
    )
    assert "contains amplitudes" in refuse(*corrupted(tmp_path, amplitude), *out)
    same = replace(selected(survey, [0, 0, 0]), point=np.arange(3))
    assert "do not determine" in refuse(*corrupted(tmp_path, same), *out)
    far = survey_of(site, true_site, ROUND + np.array([60.0, 0.0, 0.0]))
    assert "to it" in refuse(*corrupted(tmp_path, far), *out)
    strange = replace(survey, channels=(("A", 0), ("Z", 0)))
    assert "beacon Z is not in the site" in refuse(*corrupted(tmp_path, strange), *out)
    assert "was not surveyed" in refuse(*corrupted(tmp_path, strange), *out, "--beacon", "B")
    assert "--beacon Q" in refuse(*corrupted(tmp_path, survey), *out, "--beacon", "Q")
    tones = replace(survey, channels=(("A", 0), ("A", 1)))
    assert "beacon A has no tone 1" in refuse(*corrupted(tmp_path, tones), *out)


def test_two_magnetometers_suffice(tmp_path: Path) -> None:
    site, true_site = written(tmp_path)
    survey = selected(survey_of(site, true_site, ROUND), [0, 1])
    run_command(*corrupted(tmp_path, survey), "-o", tmp_path / "out", "--beacon", "A")
    refined = load_site(tmp_path / "out" / "site.yaml")
    error = refined.beacons[0].position_world - true_site.beacons[0].position_world
    assert np.all(np.abs(error) < 4.0 * refined.beacons[0].sigma.position_world)
