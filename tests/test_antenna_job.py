"""`magfusion calibrate antenna`: a survey of known poses in, a refined site out."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation
from tracker_site import body_poses, in_beacon, tracker_site

from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, write_survey
from magfusion.model.coil_field import as_points
from magfusion.model.field import predict
from magfusion.model.site import Site
from magfusion.model.steel_field import SteelField
from magfusion.units import DEGREE, MU0_OVER_4PI

POSE_SIGMA = 0.1 * DEGREE, 0.5e-3  # rad, m


def nominal(site: Site) -> Site:
    """Return the site as a drawing has it: the same places, ideal antennas."""
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    coils = tuple(
        replace(coil, moment_beacon=axis, centre_beacon=np.zeros(3))
        for coil, axis in zip(beacon.coils, np.eye(3), strict=True)
    )
    ideal = replace(sensor, matrix=np.eye(3), coil_centres_sensor=None)
    return replace(
        site,
        beacons=(replace(beacon, coils=coils),),
        platform=replace(site.platform, magnetometer=ideal),
    )


def make_survey(site: Site, number: int, seed: int, *, exact: bool = False) -> Survey:
    """Return a survey at 60 dB by a turntable that errs by `POSE_SIGMA`, or not at all."""
    rng = np.random.default_rng(seed)
    attitude, place = body_poses(site, number, rng)
    distance = np.linalg.norm(in_beacon(site, attitude, place)[1], axis=1)
    phasor = predict(site.beacons[0], site.platform.magnetometer, attitude, place)
    sigma = np.tile(1e-3 * MU0_OVER_4PI / distance[:, None] ** 3, (1, 3))
    noise = rng.standard_normal((2, *phasor.shape))
    phasor = phasor + sigma[..., None] * (noise[0] + 1j * noise[1])
    if not exact:
        turn = Rotation.from_rotvec(POSE_SIGMA[0] * rng.standard_normal((number, 3)))
        attitude = attitude @ turn.as_matrix()
        place = place + POSE_SIGMA[1] * rng.standard_normal((number, 3))
    return Survey(np.arange(number), place, attitude, site.channels, sigma, phasor)


@pytest.fixture
def true_site() -> Site:
    return tracker_site(np.random.default_rng(21))


@pytest.fixture
def given(tmp_path: Path, true_site: Site) -> Callable[[Survey], list[str]]:
    save_site(nominal(true_site), tmp_path / "site.yaml")

    def write(survey: Survey) -> list[str]:
        write_survey(survey, tmp_path / "survey.parquet")
        paths = [str(tmp_path / name) for name in ("survey.parquet", "site.yaml", "out")]
        return ["calibrate", "antenna", paths[0], "--site", paths[1], "-o", paths[2]]

    return write


def run(arguments: list[str]) -> dict[str, object]:
    run_command(*arguments)
    directory = Path(arguments[arguments.index("-o") + 1])
    return dict(json.loads((directory / "report.json").read_text()))


@pytest.mark.slow
def test_the_refined_site_tracks_better(
    tmp_path: Path, true_site: Site, given: Callable[[Survey], list[str]]
) -> None:
    figures = run(given(make_survey(true_site, 40, 1)))
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "site.yaml",
        "antenna.png",
        "report.html",
        "report.json",
    }
    assert figures["rank"] == 35
    assert figures["not_seen_by_these_poses"] == [
        "the share of moments and sensitivities in their product"
    ]
    assert figures["fewest_of_these_poses"] == 4
    assert figures["chi2_per_dof"] == pytest.approx(0.95, abs=0.15)
    before, after = (figures[f"attitude_deg_{when}"] for when in ("before", "after"))
    assert isinstance(before, float)
    assert isinstance(after, float)
    assert after < before / 3.0  # the turntable's own error is in both
    # And where no turntable tells: the phasors of the true antennas at new poses.
    result = load_site(tmp_path / "out" / "site.yaml")
    rng = np.random.default_rng(2)
    poses = body_poses(true_site, 30, rng)
    errors = []
    truth = predict(true_site.beacons[0], true_site.platform.magnetometer, *poses)
    for site in (nominal(true_site), result):
        seen = predict(site.beacons[0], site.platform.magnetometer, *poses)
        errors.append(np.linalg.norm(seen - truth) / np.linalg.norm(truth))
    assert errors[1] < errors[0] / 8.0


@pytest.mark.slow
def test_a_second_run_starts_where_the_first_ended(
    tmp_path: Path, true_site: Site, given: Callable[[Survey], list[str]]
) -> None:
    arguments = given(make_survey(true_site, 30, 3))
    first = run(arguments)
    arguments[arguments.index("--site") + 1] = str(tmp_path / "out" / "site.yaml")
    arguments[-1] = str(tmp_path / "again")
    second = run(arguments)
    assert second["attitude_deg_before"] == pytest.approx(first["attitude_deg_after"], rel=0.3)
    assert abs(float(str(second["matrix_change_largest"]))) < 2e-3


@pytest.mark.slow
def test_exact_poses_are_exact(true_site: Site, given: Callable[[Survey], list[str]]) -> None:
    arguments = given(make_survey(true_site, 30, 4, exact=True))
    options = ["--pose-rotation-deg", "0", "--pose-position-m", "0", "--beacon", "T"]
    figures = run([*arguments, *options])
    assert figures["poses_taken_as"] == "exact"
    assert figures["chi2_per_dof"] == pytest.approx(0.9, abs=0.15)
    assert float(str(figures["position_m_after"])) < 2e-3
    sized = run([*arguments, *options, "--sizes"])
    assert sized["parameters"] == 40
    kappa, sigma = (float(str(sized[f"receiver_kappa_m2{s}"])) for s in ("", "_sigma"))
    assert abs(kappa) < 4.0 * sigma  # the coils are points


@pytest.mark.slow
def test_sizes_are_written_for_every_estimator(
    tmp_path: Path, true_site: Site, given: Callable[[Survey], list[str]]
) -> None:
    """The refined site predicts what coils of 4 cm measure; one of points cannot."""
    beacon, sensor = true_site.beacons[0], true_site.platform.magnetometer
    coils = tuple(replace(coil, radius=0.04) for coil in beacon.coils)
    sized = replace(
        true_site,
        beacons=(replace(beacon, coils=coils),),
        platform=replace(true_site.platform, magnetometer=replace(sensor, coil_kappa=1e-4)),
    )
    exact = ["--pose-rotation-deg", "0", "--pose-position-m", "0"]
    arguments = [*given(make_survey(sized, 60, 6, exact=True)), *exact]
    poses = body_poses(true_site, 20, np.random.default_rng(8))
    truth = predict(sized.beacons[0], sized.platform.magnetometer, *poses)
    run([*arguments, "--sizes"])
    result = load_site(tmp_path / "out" / "site.yaml")
    seen = predict(result.beacons[0], result.platform.magnetometer, *poses)
    points = replace(result.platform.magnetometer, coil_kappa=0.0)
    without = predict(as_points(result.beacons[0]), points, *poses)
    errors = [np.linalg.norm(phasor - truth) for phasor in (without, seen)]
    assert result.beacons[0].coils[0].radius == pytest.approx(0.04, rel=0.1)
    assert result.platform.magnetometer.coil_kappa == pytest.approx(1e-4, rel=0.3)
    assert errors[1] < 0.3 * errors[0]


def test_a_lost_tone_costs_its_pose(true_site: Site, given: Callable[[Survey], list[str]]) -> None:
    survey = make_survey(true_site, 20, 5)
    assert survey.phasor_sensor is not None
    survey.phasor_sensor[3, 1] = np.nan
    survey.sigma[3, 1] = np.nan
    figures = run(given(survey))
    assert (figures["poses"], figures["poses_dropped"]) == (19, 1)


def _swapped(survey: Survey) -> Survey:
    assert survey.phasor_sensor is not None
    return replace(survey, phasor_sensor=survey.phasor_sensor[:, [1, 0, 2]])


def _amplitudes(survey: Survey) -> Survey:
    assert survey.phasor_sensor is not None
    amplitude = np.linalg.norm(survey.phasor_sensor, axis=2)
    return replace(survey, phasor_sensor=None, amplitude=amplitude)


def _first(survey: Survey, number: int) -> Survey:
    assert survey.phasor_sensor is not None
    return Survey(
        survey.point[:number],
        survey.position_world[:number],
        survey.world_from_body[:number],
        survey.channels,
        survey.sigma[:number],
        survey.phasor_sensor[:number],
    )


def _renamed(survey: Survey) -> Survey:
    return replace(survey, channels=tuple(("Q", tone) for _, tone in survey.channels))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_swapped, "survey.parquet: coupling 0 has a negative determinant"),
        (_amplitudes, "survey.parquet: contains amplitudes"),
        (lambda s: _first(s, 4), "survey.parquet: has 4 poses"),
        (_renamed, "survey.parquet: has no tone 0, 1, 2 of beacon T"),
    ],
    ids=["swapped wires", "amplitudes", "too few", "another beacon"],
)
def test_bad_surveys_are_refused_in_one_sentence(
    refuse: Refuse,
    true_site: Site,
    given: Callable[[Survey], list[str]],
    change: Callable[[Survey], Survey],
    sentence: str,
) -> None:
    assert sentence in refuse(*given(change(make_survey(true_site, 10, 6))))


@pytest.mark.parametrize(
    ("change", "options", "sentence"),
    [
        ({"synchronised": False}, [], "site.yaml: beacon T is not synchronised"),
        ({}, ["--beacon", "Q"], "site.yaml: has no beacon Q (it has T)"),
        ({}, ["--pose-rotation-deg", "0"], "must both be 0"),
        ({}, ["--pose-position-m", "-1"], "--pose-position-m must be at least 0"),
    ],
)
def test_bad_sites_and_options_are_refused_in_one_sentence(
    tmp_path: Path,
    refuse: Refuse,
    true_site: Site,
    given: Callable[[Survey], list[str]],
    change: dict[str, object],
    options: list[str],
    sentence: str,
) -> None:
    arguments = given(make_survey(true_site, 10, 7))
    site = nominal(true_site)
    changed = replace(site.beacons[0], **change)  # type: ignore[arg-type]
    save_site(replace(site, beacons=(changed,)), tmp_path / "site.yaml")
    assert sentence in refuse(*arguments, *options)


@pytest.mark.slow
def test_a_map_of_steel_by_the_old_antennas_is_refused(
    tmp_path: Path, refuse: Refuse, true_site: Site, given: Callable[[Survey], list[str]]
) -> None:
    """A bench is another room; without the map the same command runs."""
    command = given(make_survey(true_site, 10, 6))
    steel = SteelField(np.ones((1, 3)), np.array([0.2]), np.full((1, 3, 3), 1e-3))
    (beacon,) = nominal(true_site).beacons
    mapped = replace(nominal(true_site), beacons=(replace(beacon, steel=steel),))
    save_site(mapped, tmp_path / "site.yaml")
    assert "omit world.field_map and world.steel, calibrate the antennas" in refuse(*command)
    save_site(mapped.without_steel(), tmp_path / "site.yaml")
    run_command(*command)


def test_a_site_without_a_tracker_is_refused(
    tmp_path: Path, refuse: Refuse, true_site: Site, given: Callable[[Survey], list[str]]
) -> None:
    arguments = given(make_survey(true_site, 10, 8))
    flat = replace(true_site.beacons[0], coils=true_site.beacons[0].coils[:2])
    two = replace(flat, sigma=replace(flat.sigma, log_moment=np.zeros(2)))
    save_site(replace(true_site, beacons=(two,)), tmp_path / "site.yaml")
    assert "site.yaml: has no beacon of three coils" in refuse(*arguments)
