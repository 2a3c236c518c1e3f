"""The files of an antenna's bench: probe readings, lists of poses, the receiver's boresight."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from antenna_bench import KINDS, Config, Table, passes_check, run_seed, write_csv
from conftest import Refuse
from scipy.spatial.transform import Rotation
from test_antenna_job import make_survey, nominal
from tracker_coils import loop_field
from tracker_site import body_poses, tracker_site

from magfusion.files.plain_table import ANGLES, POSITION
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, read_survey, write_survey
from magfusion.jobs.antenna_settings import AntennaSettings
from magfusion.jobs.calibrate_antenna import run_calibrate_antenna
from magfusion.model.field import predict
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Site
from magfusion.units import DEGREE, Array

DISTANCE, NOISE = 0.3, 1e-13  # m, T
AXIS = ("axis_x", "axis_y", "axis_z")


def points(coil: int, *, on_axis: bool) -> Array:
    """Return the paper's four points about a coil, or six."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return DISTANCE * axes[[on_axis or k % 3 != coil for k in range(6)]]


def probe_table(
    moments: Array, centres: Array, *, on_axis: bool, three: bool, side: str = "transmitter"
) -> Table:
    """Return readings of a probe of one axis, that of the coil, or of all three."""
    rows: list[tuple[int, Array, Array, float]] = []
    for coil in range(3):
        for place in points(coil, on_axis=on_axis):
            field = dipole_field(place - centres[coil], moments[coil])
            for axis in np.eye(3) if three else np.eye(3)[[coil]]:
                rows.append((coil, place, axis, float(field @ axis)))
    coil, place, axis, reading = (np.array(part) for part in zip(*rows, strict=True))
    return (
        {"antenna": [side] * len(coil), "coil": coil, "reading": reading}
        | dict(zip(POSITION, place.T, strict=True))
        | dict(zip(AXIS, axis.T, strict=True))
        | {"sigma": np.full(len(coil), NOISE)}
    )


@pytest.fixture(scope="module")
def true_site() -> Site:
    return tracker_site(np.random.default_rng(31))


@pytest.fixture
def bench(tmp_path: Path, true_site: Site) -> Path:
    save_site(nominal(true_site), tmp_path / "site.yaml")
    return tmp_path


def calibrated(
    bench: Path, *probes: str, survey: bool = False, boresight: bool = False, sizes: bool = False
) -> tuple[Site, dict[str, object]]:
    """Return the site that is written, and the report; poses of a survey are exact."""
    settings = AntennaSettings(
        site=bench / "site.yaml",
        probe=tuple(bench / name for name in probes),
        probe_position_m=0.0,
        probe_tilt_deg=0.0,
        pose_rotation_deg=0.0,
        pose_position_m=0.0,
        survey=bench / "survey.parquet" if survey else None,
        boresight=boresight,
        sizes=sizes,
    )
    run_calibrate_antenna(settings, bench / "out")
    reported = json.loads((bench / "out" / "report.json").read_text())
    return load_site(bench / "out" / "site.yaml"), reported


def test_six_points_of_one_axis_after_the_other_find_all_of_a_source(
    bench: Path, true_site: Site
) -> None:
    beacon = true_site.beacons[0]
    table = probe_table(beacon.moments_beacon, beacon.centres_beacon, on_axis=True, three=True)
    write_csv(bench / "probe.csv", table)
    site, reported = calibrated(bench, "probe.csv")
    result = site.beacons[0]
    np.testing.assert_allclose(result.moments_beacon, beacon.moments_beacon, atol=1e-5)
    np.testing.assert_allclose(result.centres_beacon, beacon.centres_beacon, atol=2e-6)
    assert float(str(reported["transmitter_field_error_before"])) > 0.005
    assert float(str(reported["transmitter_field_error_after"])) < 1e-4
    assert reported["verdict"] == "trustworthy"
    assert "few_data" in str(reported["remarks"])  # no pose was tried
    undetermined = reported["undetermined"]
    assert isinstance(undetermined, list)
    assert not any(name.startswith("transmitter") for name in undetermined)


def test_four_points_along_the_coils_axis_do_not_tell_what_they_do_not_see(
    bench: Path, true_site: Site
) -> None:
    """Paper 000's bench: a probe along each coil's axis at four points across it."""
    beacon = true_site.beacons[0]
    table = probe_table(beacon.moments_beacon, beacon.centres_beacon, on_axis=False, three=False)
    write_csv(bench / "probe.csv", table)
    site, reported = calibrated(bench, "probe.csv")
    undetermined = reported["undetermined"]
    assert isinstance(undetermined, list)
    own = {name for name in undetermined if name.startswith("transmitter")}
    axial = {f"transmitter.centre_{c}{c}" for c in "xyz"}
    tilts = {f"transmitter.moment_{c}{a}" for c in "xyz" for a in "xyz" if a != c}
    assert own == axial | tilts
    assert "transmitter.centre_xx" in str(reported["remarks"])
    for coil, true in zip(site.beacons[0].coils, beacon.coils, strict=True):
        across = np.abs(true.moment_beacon) < 0.5
        assert np.max(np.abs(coil.centre_beacon - true.centre_beacon)[across]) < 1e-4
        assert np.max(np.abs(coil.centre_beacon[~across])) < 1e-4  # as declared


def test_a_receiver_is_driven_with_whatever_current(bench: Path, true_site: Site) -> None:
    """Its coils' shape and centres are found, and its mean gain is as declared."""
    sensor = true_site.platform.magnetometer
    assert sensor.coil_centres_sensor is not None
    driven = 0.37 * sensor.matrix
    table = probe_table(
        driven, sensor.coil_centres_sensor, on_axis=True, three=True, side="receiver"
    )
    write_csv(bench / "probe.csv", table)
    result = calibrated(bench, "probe.csv")[0].platform.magnetometer
    gain = np.exp(np.mean(np.log(np.linalg.norm(sensor.matrix, axis=1))))
    np.testing.assert_allclose(result.matrix, sensor.matrix / gain, atol=1e-4)
    assert result.coil_centres_sensor is not None
    np.testing.assert_allclose(result.coil_centres_sensor, sensor.coil_centres_sensor, atol=1e-5)


def test_windings_of_different_size_are_found_by_six_points(bench: Path) -> None:
    """Loops of 3, 4 and 5 cm, read by elliptic integrals of other code than the model's."""
    radii = (0.03, 0.04, 0.05)
    rows: dict[str, list[object]] = {n: [] for n in ("coil", *POSITION, "sigma")}
    rows |= {f"field_{a}": [] for a in "xyz"}
    for coil, radius in enumerate(radii):
        for place in points(coil, on_axis=True) * (0.5 + 0.25 * coil):
            own = np.roll(place, 2 - coil)
            field = loop_field(radius, own[None])[0] / (np.pi * radius**2)
            for name, value in zip(POSITION, place, strict=True):
                rows[name].append(float(value))
            for name, value in zip("xyz", np.roll(field, coil - 2), strict=True):
                rows[f"field_{name}"].append(float(value))
            rows["coil"].append(coil)
            rows["sigma"].append(1e-12)
    write_csv(bench / "probe.csv", rows)
    result = calibrated(bench, "probe.csv", sizes=True)[0].beacons[0]
    for coil, radius in zip(result.coils, radii, strict=True):
        assert coil.radius == pytest.approx(radius, rel=0.02)


def _split(survey: Survey, bench: Path) -> None:
    """Write a survey as readings without poses, and a turntable's list of angles."""
    write_survey(survey, bench / "readings.csv")
    angles = Rotation.from_matrix(survey.world_from_body).as_euler("xyz", degrees=True)
    listed = {"point": survey.point} | dict(zip(POSITION, survey.position_world.T, strict=True))
    write_csv(bench / "turntable.csv", listed | dict(zip(ANGLES, angles.T, strict=True)))


def test_a_list_of_angles_is_the_same_as_quaternions_in_every_row(
    bench: Path, true_site: Site
) -> None:
    survey = make_survey(true_site, 12, 3)
    _split(survey, bench)
    result = read_survey(bench / "readings.csv", bench / "turntable.csv")
    np.testing.assert_allclose(result.world_from_body, survey.world_from_body, atol=1e-12)
    np.testing.assert_allclose(result.position_world, survey.position_world, atol=1e-15)


def test_the_boresight_is_found_whatever_the_site_says_of_it(bench: Path, true_site: Site) -> None:
    declared = nominal(true_site)
    sensor = declared.platform.magnetometer
    wrong = replace(sensor, body_from_sensor=np.eye(3), position_body=np.zeros(3))
    save_site(
        replace(declared, platform=replace(declared.platform, magnetometer=wrong)),
        bench / "site.yaml",
    )
    write_survey(make_survey(true_site, 25, 4, exact=True), bench / "survey.parquet")
    site, reported = calibrated(bench, survey=True, boresight=True)
    true, result = true_site.platform.magnetometer, site.platform.magnetometer
    turn = Rotation.from_matrix(true.body_from_sensor.T @ result.body_from_sensor).magnitude()
    # What of three coils is a turn and what a shape is told by the matrix that was declared.
    remaining, _, right = np.linalg.svd(true.matrix.T)
    convention = Rotation.from_matrix(remaining @ right).magnitude()
    assert turn < convention + 0.1 * DEGREE
    assert turn < 1.0 * DEGREE
    assert true.coil_centres_sensor is not None
    middle = true.position_body + true.body_from_sensor @ np.mean(true.coil_centres_sensor, axis=0)
    assert np.linalg.norm(result.position_body - middle) < 5e-4
    assert float(str(reported["attitude_deg_after"])) < 0.02 * float(
        str(reported["attitude_deg_before"])
    )
    sensed = result.matrix @ result.body_from_sensor.T
    expected = true.matrix @ true.body_from_sensor.T
    gain = np.linalg.norm(sensed) / np.linalg.norm(expected)
    np.testing.assert_allclose(sensed, gain * expected, atol=2e-3)


def test_poses_turned_alike_are_said_not_to_tell_of_others(bench: Path, true_site: Site) -> None:
    rng = np.random.default_rng(6)
    _, place = body_poses(true_site, 20, rng)
    attitude = Rotation.from_rotvec(1e-5 * rng.standard_normal((20, 3))).as_matrix()
    phasor = predict(true_site.beacons[0], true_site.platform.magnetometer, attitude, place)
    sigma = np.full((20, 3), 1e-5 * float(np.max(np.abs(phasor))))
    noise = rng.standard_normal((2, *phasor.shape))
    phasor = phasor + sigma[..., None] * (noise[0] + 1j * noise[1])
    survey = Survey(np.arange(20), place, attitude, true_site.channels, sigma, phasor)
    write_survey(survey, bench / "survey.parquet")
    _, reported = calibrated(bench, survey=True)
    expected, after = (float(str(reported[f"position_m_{n}"])) for n in ("any_attitude", "after"))
    assert expected > 2.0 * after
    assert "transfer" in str(reported["reasons"])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"coil": 3.0}, "column coil, row 0: found 3; write 0, 1 or 2"),
        ({"sigma": 0.0}, "column sigma, row 0: found 0.0; write a positive number"),
        ({"axis_x": 0.0, "axis_y": 0.0, "axis_z": 0.0}, "row 0: found 0.0; write a direction"),
        ({"reading": float("nan")}, "column reading, row 0: found nan; write a finite number"),
        ({"antenna": "both"}, "found both; write transmitter or receiver"),
        ({"field_x": 1.0}, "has reading and field_x to field_z; keep the one that was read"),
        ({"axis_z": None}, "column axis_z is missing"),
    ],
    ids=lambda value: "" if isinstance(value, str) else "-".join(value),
)
def test_bad_readings_are_refused_by_the_row(
    bench: Path,
    true_site: Site,
    refuse: Refuse,
    change: dict[str, float | str | None],
    sentence: str,
) -> None:
    beacon = true_site.beacons[0]
    table = probe_table(beacon.moments_beacon, beacon.centres_beacon, on_axis=True, three=False)
    for name, value in change.items():
        if value is None:
            del table[name]
            continue
        column: list[object] = list(table.get(name, [1.0] * len(table["coil"])))
        column[0] = int(value) if name == "coil" else value
        table[name] = column
    write_csv(bench / "probe.csv", table)
    out = ["--site", bench / "site.yaml", "--probe", bench / "probe.csv", "-o", bench / "out"]
    assert sentence in refuse("calibrate", "antenna", *out)


def test_a_point_without_a_pose_is_refused(bench: Path, true_site: Site, refuse: Refuse) -> None:
    _split(make_survey(true_site, 6, 5), bench)
    lines = (bench / "turntable.csv").read_text().splitlines()
    (bench / "turntable.csv").write_text("\n".join(lines[:-1]) + "\n")
    given = [bench / "readings.csv", "--poses", bench / "turntable.csv"]
    reported = refuse(
        "calibrate", "antenna", *given, "--site", bench / "site.yaml", "-o", bench / "o"
    )
    assert "readings.csv: column point, row 15: found 5; write a point that" in reported
    assert "give a survey of known poses" in refuse(
        "calibrate", "antenna", "--site", bench / "site.yaml", "-o", bench / "o"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_what_is_reported_is_what_fixes_err_by_elsewhere(name: str) -> None:
    """The rule of the scenario, on two trackers of each kind."""
    kind = vars(KINDS[name])
    outcomes = [run_seed(Config(**kind | {"seed": seed})) for seed in range(2)]
    assert passes_check(outcomes), outcomes
