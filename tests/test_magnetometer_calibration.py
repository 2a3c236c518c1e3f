"""Magnetometer calibrations against exact cases, Monte Carlo and the figures of the analysis."""

import json
import sys
from pathlib import Path

import gtsam
import magnetometer_calibrations_compared as compared
import numpy as np
import pytest
import twelve_positions
from derivatives import central_difference
from magnetometer_calibrations_compared import (
    FIELD_LEVEL,
    FIELD_NED,
    HAND_NOISE,
    MILLIGAUSS,
    PRIOR_COV,
    Config,
    draw_sensors,
    read,
)
from scipy.spatial.transform import Rotation

from magfusion.calibration.ellipsoid import fit_ellipsoid, fit_ellipsoid_gravity
from magfusion.calibration.graph import CalibrationEstimate
from magfusion.calibration.magnetometer import (
    MagnetometerFit,
    field_from_measured,
    from_paper,
    missing_orientations,
    prior_cov,
    refined,
    to_paper,
)
from magfusion.calibration.magnetometer_graph import (
    MagnetometerEpochs,
    MagnetometerPrior,
    Readings,
    fit_graph,
)
from magfusion.errors import EstimationError
from magfusion.papers.p001_magnetometer.equations import SENSOR_FROM_NED
from magfusion.papers.p001_magnetometer.twelve_positions import (
    closed_form,
    least_squares,
    positions,
)
from magfusion.simulation.demo_site import demo_site

SIZE = float(np.linalg.norm(FIELD_NED))


def errors_of(fit: MagnetometerFit, sensors: compared.Sensors) -> np.ndarray:
    matrix = (fit.matrix - sensors.matrix).reshape(-1, 9)
    return np.concatenate([matrix, fit.offset - sensors.offset], axis=1)


def nees(fit: MagnetometerFit, sensors: compared.Sensors) -> float:
    error = errors_of(fit, sensors)
    return float(np.mean(np.sum(error * np.linalg.solve(fit.cov, error[..., None])[..., 0], 1)))


@pytest.fixture(scope="module")
def sensors() -> compared.Sensors:
    return draw_sensors(200, np.random.default_rng(3))


@pytest.fixture(scope="module")
def table(sensors: compared.Sensors) -> dict[str, dict[str, float]]:
    rng = np.random.default_rng(4)
    return {
        "noise": compared.on_table(sensors, rng, noise=MILLIGAUSS),
        "tilt": compared.on_table(sensors, rng, tilt_deg=1.0),
        "small tilt": compared.on_table(sensors, rng, tilt_deg=0.1),
        "both": compared.on_table(sensors, rng, 2.0 * MILLIGAUSS, 0.2),
    }


def test_the_papers_model_is_the_one_of_logs_and_sites() -> None:
    rng = np.random.default_rng(1)
    bias, scale, field = rng.standard_normal((3, 3))
    e = 0.1 * rng.standard_normal((3, 3))
    eyx, ezx, exy, ezy, exz, eyz = e[0, 1], e[0, 2], e[1, 0], e[1, 2], e[2, 0], e[2, 1]
    np.fill_diagonal(e, 0.0)
    bx, by, bz = field
    voltage = [
        bias[0] + scale[0] * (bx + eyx * by + ezx * bz),
        bias[1] + scale[1] * (by + exy * bx + ezy * bz),
        bias[2] + scale[2] * (bz + exz * bx + eyz * by),
    ]
    matrix, offset = from_paper(bias, scale, e)
    np.testing.assert_allclose(matrix @ field + offset, voltage, rtol=1e-14, atol=1e-14)
    for back, given in zip(to_paper(matrix, offset), (bias, scale, e), strict=True):
        np.testing.assert_allclose(back, given, rtol=1e-14, atol=1e-15)


def test_the_positions_are_rotations_with_each_axis_twice_up_and_down() -> None:
    np.testing.assert_allclose(np.linalg.det(SENSOR_FROM_NED), 1.0, rtol=1e-15, atol=0.0)
    down = SENSOR_FROM_NED[:, :, 2]
    assert sorted(map(tuple, down)) == sorted(
        tuple(sign * axis) for axis in np.eye(3) for sign in (1.0, -1.0) for _ in range(2)
    )


@pytest.mark.parametrize("heading_deg", [0.0, 10.0, 45.0, 133.0])
def test_closed_formulas_are_exact_at_any_heading(
    heading_deg: float, sensors: compared.Sensors
) -> None:
    field_sensor = positions(np.deg2rad(heading_deg)) @ FIELD_NED
    measured = read(sensors, field_sensor, 0.0, np.random.default_rng(1))
    for fit in (closed_form(measured, FIELD_NED[2]), least_squares(measured, field_sensor)):
        error = errors_of(fit, sensors) / np.repeat([1.0, SIZE], [9, 3])
        assert np.max(np.abs(error)) < 1e-10


def test_a_wrong_reference_field_or_heading_is_a_pure_scale(sensors: compared.Sensors) -> None:
    rng = np.random.default_rng(2)
    for wrong in ({"down_error": 20.0 * MILLIGAUSS}, {"heading_deg": 8.8}):
        for angle_deg in compared.on_table(sensors, rng, **wrong).values():
            assert angle_deg < 1e-9
    measured = read(sensors, positions(0.0) @ FIELD_NED, 0.0, rng)
    fit = closed_form(measured, FIELD_NED[2] + 20.0 * MILLIGAUSS)
    ratio = FIELD_NED[2] / (FIELD_NED[2] + 20.0 * MILLIGAUSS)
    np.testing.assert_allclose(fit.matrix, ratio * sensors.matrix, rtol=1e-9, atol=1e-12)


def test_noise_and_tilt_cost_what_the_analysis_found(table: dict[str, dict[str, float]]) -> None:
    assert table["noise"]["paper"] == pytest.approx(0.099, abs=0.006)  # deg per mG
    assert table["tilt"]["paper"] == pytest.approx(0.74, abs=0.05)  # deg per deg
    assert table["small tilt"]["paper"] == pytest.approx(0.074, abs=0.005)
    ratio = table["noise"]["least_squares"] / table["noise"]["paper"]
    assert ratio == pytest.approx(0.90, abs=0.02)
    assert table["both"]["paper"] == pytest.approx(0.250, abs=0.015)
    assert table["both"]["least_squares"] == pytest.approx(0.225, abs=0.015)


def test_twelve_position_fits_know_how_good_they_are(sensors: compared.Sensors) -> None:
    field_sensor = positions(0.3) @ FIELD_NED
    rng = np.random.default_rng(5)
    measured = read(sensors, field_sensor, HAND_NOISE, rng)

    def closed(sigma: float | None) -> MagnetometerFit:
        return closed_form(measured, FIELD_NED[2], sigma)

    def squares(sigma: float | None) -> MagnetometerFit:
        return least_squares(measured, field_sensor, sigma)

    for method in (closed, squares):
        # 200 draws of chi square with 12 degrees of freedom: sigma 0.35.
        assert nees(method(HAND_NOISE), sensors) == pytest.approx(12.0, abs=1.1)
    for method, degrees in ((closed, 6), (squares, 24)):
        ratio = method(None).cov[:, 9, 9] / method(HAND_NOISE).cov[:, 9, 9]
        assert np.mean(ratio) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / degrees / 200))


def turned_by_hand(
    sensors: compared.Sensors, readings: int, noise: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    count = len(sensors.matrix)
    attitude = Rotation.random(count * readings, rng=rng).as_matrix()
    sensor_from_level = attitude.reshape(count, readings, 3, 3)
    measured = read(sensors, sensor_from_level @ FIELD_LEVEL, noise, rng)
    return measured, sensor_from_level[..., 2]


def test_without_noise_the_ellipsoid_finds_shape_and_centre_and_gravity_the_rest() -> None:
    sensors = draw_sensors(20, np.random.default_rng(6))
    measured, up = turned_by_hand(sensors, 30, 0.0, 7)
    shape = fit_ellipsoid(measured, SIZE)
    np.testing.assert_allclose(shape.offset, sensors.offset, rtol=0.0, atol=1e-9 * SIZE)
    gram = sensors.matrix @ np.swapaxes(sensors.matrix, 1, 2)
    np.testing.assert_allclose(shape.matrix @ shape.matrix, gram, rtol=0.0, atol=1e-9)
    full = fit_ellipsoid_gravity(measured, 3.0 * up, SIZE)
    np.testing.assert_allclose(full.matrix, sensors.matrix, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(full.offset, sensors.offset, rtol=0.0, atol=1e-9 * SIZE)


def test_what_the_ellipsoid_leaves_is_a_rotation_and_gravity_takes_it_off() -> None:
    sensors = draw_sensors(200, np.random.default_rng(8))
    measured, up = turned_by_hand(sensors, 200, HAND_NOISE, 9)
    alone = compared.angle_deg(sensors, fit_ellipsoid(measured, SIZE))
    with_gravity = fit_ellipsoid_gravity(measured, up, SIZE)
    assert alone == pytest.approx(1.1, abs=0.15)
    assert compared.angle_deg(sensors, with_gravity) == pytest.approx(0.10, abs=0.02)
    assert nees(with_gravity, sensors) == pytest.approx(12.0, abs=1.2)


def _cap(half_angle: float, noise: float, seed: int) -> np.ndarray:
    """Return readings of a unit field on a cap of the sphere."""
    rng = np.random.default_rng(seed)
    height = rng.uniform(np.cos(half_angle), 1.0, 60)
    turn = rng.uniform(0.0, 2.0 * np.pi, 60)
    flat = np.sqrt(1.0 - height**2)
    points = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=-1)
    return points + noise * rng.standard_normal(points.shape)


def test_readings_on_one_side_are_no_ellipsoid() -> None:
    readings = np.array([[1.0, 0.0, 0.0]]) + 1e-3 * np.random.default_rng(1).normal(size=(20, 3))
    with pytest.raises(EstimationError, match="ellipsoid"):
        fit_ellipsoid(readings, 1.0)
    with pytest.raises(EstimationError, match="determine"):
        fit_ellipsoid(readings[:5], 1.0)


@pytest.mark.parametrize("seed", range(10))
def test_what_is_no_ellipsoid_is_recognised_by_a_margin(seed: int) -> None:
    """Whichever way the processor rounds: no singular matrix has to come about for it."""
    blob = np.array([1.0, 0.0, 0.0]) + 1e-3 * np.random.default_rng(seed).normal(size=(20, 3))
    for readings in (blob, _cap(np.radians(20.0), 1e-3, seed), _cap(np.radians(40.0), 1e-2, seed)):
        with pytest.raises(EstimationError, match="ellipsoid"):
            fit_ellipsoid(readings, 1.0)
    half = fit_ellipsoid(_cap(np.radians(90.0), 1e-3, seed), 1.0)
    np.testing.assert_allclose(half.matrix, np.eye(3), rtol=0.0, atol=0.02)


def test_readings_in_planes_leave_the_ellipsoid_open() -> None:
    angle = np.linspace(0.0, 6.2, 40)
    zero, circle = np.zeros(40), (np.cos(angle), np.sin(angle))
    level = np.stack([*circle, zero], axis=-1)
    two = np.concatenate([level, np.stack([circle[0], zero, circle[1]], axis=-1)])
    for readings in (level, two):
        with pytest.raises(EstimationError, match="ellipsoid"):
            fit_ellipsoid(readings, 1.0)
    three = np.concatenate([two, np.stack([zero, *circle], axis=-1)])
    np.testing.assert_allclose(fit_ellipsoid(three, 1.0).matrix, np.eye(3), rtol=0.0, atol=1e-9)


def hand_graph(
    sensors: compared.Sensors, readings: int, seed: int
) -> tuple[MagnetometerFit, float]:
    measured, up = turned_by_hand(sensors, readings, HAND_NOISE, seed)
    rng = np.random.default_rng(seed + 1)
    force = compared.GRAVITY * (up + compared.ACCEL_NOISE * rng.standard_normal(up.shape))
    sigma = np.full(readings, compared.GRAVITY * compared.ACCEL_NOISE)
    epochs = [
        MagnetometerEpochs(m, HAND_NOISE, f, sigma) for m, f in zip(measured, force, strict=True)
    ]
    return compared.graphs(sensors, epochs, 0.3)


def test_the_graph_weighs_size_and_angle_by_the_noise_they_share() -> None:
    sensors = draw_sensors(40, np.random.default_rng(10))
    fit, result = hand_graph(sensors, 50, 11)
    measured, up = turned_by_hand(sensors, 50, HAND_NOISE, 11)
    ellipsoid = compared.angle_deg(sensors, fit_ellipsoid_gravity(measured, up, SIZE))
    assert compared.angle_deg(sensors, fit) < 0.85 * ellipsoid
    assert result == pytest.approx(12.0, abs=3.0 * np.sqrt(24.0 / 40))


@pytest.mark.slow
def test_the_graph_reaches_what_the_analysis_reached() -> None:
    sensors = draw_sensors(200, np.random.default_rng(12))
    fit, result = hand_graph(sensors, 200, 13)
    assert compared.angle_deg(sensors, fit) == pytest.approx(0.057, abs=0.01)
    assert result == pytest.approx(12.0, abs=1.1)


@pytest.mark.slow
def test_on_a_tilting_table_the_graph_finds_the_tilts() -> None:
    rng = np.random.default_rng(14)
    sensors = draw_sensors(200, rng)
    for tilt_deg, paper, squares, plain, accel in (
        (0.5, 0.436, 0.397, 0.328, 0.218),
        (1.0, 0.79, 0.73, 0.52, 0.24),
    ):
        row = compared.on_table_graph(sensors, rng, tilt_deg)
        assert row["paper"] == pytest.approx(paper, rel=0.1)
        assert row["least_squares"] == pytest.approx(squares, rel=0.1)
        assert row["graph"] == pytest.approx(plain, rel=0.1)
        assert row["graph_accel"] == pytest.approx(accel, rel=0.1)
        assert row["graph_nees"] == pytest.approx(12.0, abs=1.1)


def test_the_rows_of_the_graph_are_the_derivatives_of_their_residuals() -> None:
    rng = np.random.default_rng(15)
    attitudes = Rotation.random(3, rng=rng).as_matrix()
    epochs = MagnetometerEpochs(
        measured_sensor=1e-5 * rng.standard_normal((3, 3)),
        field_sigma=1e-6,
        accel_body=9.0 * rng.standard_normal((3, 3)),
        accel_sigma=np.array([0.5, 1.0, 2.0]),
    )
    mounting = Rotation.random(rng=rng).as_matrix()
    matrix = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    offset = 1e-6 * rng.standard_normal(3)
    prior = MagnetometerPrior(
        mounting, matrix, offset, PRIOR_COV, FIELD_LEVEL, 0.1, 9.8, 0.1, size_sigma=1.0
    )
    problem = Readings(epochs, prior)
    calibration = problem.declared + 0.1 * rng.standard_normal(17)

    def state(turn: np.ndarray, step: np.ndarray) -> CalibrationEstimate:
        values = gtsam.Values()
        for i, attitude in enumerate(attitudes):
            moved = gtsam.Rot3(attitude).retract(turn)
            values.insert(gtsam.symbol("x", i), moved)
        return CalibrationEstimate(values, calibration + step)

    still, no_step = np.zeros(3), np.zeros(17)
    _, by_attitude, by_calibration = problem.rows(state(still, no_step))
    rotated = central_difference(lambda w: problem.rows(state(w, no_step))[0], 3, 1e-5)
    np.testing.assert_allclose(by_attitude, rotated, rtol=1e-6, atol=1e-6)
    stepped = central_difference(lambda s: problem.rows(state(still, s))[0], 17, 1e-5)
    np.testing.assert_allclose(by_calibration, stepped, rtol=1e-6, atol=1e-6)


def test_a_graph_without_any_attitude_says_so() -> None:
    prior = MagnetometerPrior(np.eye(3), np.eye(3), np.zeros(3), PRIOR_COV, FIELD_LEVEL)
    with pytest.raises(EstimationError, match="attitudes"):
        fit_graph(MagnetometerEpochs(np.tile(FIELD_LEVEL, (4, 1)), 1e-9), prior)


def test_missing_orientations_are_told_in_words() -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    assert missing_orientations(9.8 * axes) == []
    assert missing_orientations(np.delete(axes, 1, axis=0)) == [
        "the sensor's y axis never pointed up"
    ]
    assert missing_orientations(axes[2:3]) == [
        "the sensor's x axis never pointed up or down",
        "the sensor's y axis never pointed up or down",
        "the sensor's z axis never pointed down",
    ]


def test_a_refined_sensor_keeps_what_is_known_of_either_part_of_the_matrix() -> None:
    plain = demo_site().platform.magnetometer
    root = np.random.default_rng(16).standard_normal((12, 12))
    scale = np.diag(np.repeat([1e-3, 1e-9], [9, 3]))
    cov = scale @ (root @ root.T + 3.0 * np.eye(12)) @ scale
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    cov += 0.05**2 * np.outer(turn, turn)  # the mounting about x is hardly known
    result = refined(plain, MagnetometerFit(np.eye(3), np.zeros(3), cov))
    sum_yz, less_yz = np.eye(12)[5] + np.eye(12)[7], np.eye(12)[7] - np.eye(12)[5]
    reported = prior_cov(result)
    assert sum_yz @ reported @ sum_yz == pytest.approx(sum_yz @ cov @ sum_yz, rel=1e-9)
    assert less_yz @ reported @ less_yz == pytest.approx(less_yz @ cov @ less_yz, rel=1e-9)
    assert result.sigma.rotation_sensor[0] > 0.04
    np.testing.assert_allclose(
        result.sigma.offset, np.sqrt(np.diagonal(cov))[9:], rtol=1e-12, atol=0.0
    )


def test_the_calibrated_field_is_what_made_the_readings() -> None:
    sensors = draw_sensors(4, np.random.default_rng(17))
    field = np.random.default_rng(18).standard_normal((4, 5, 3)) * SIZE
    measured = read(sensors, field, 0.0, np.random.default_rng(19))
    back = field_from_measured(measured, sensors.matrix, sensors.offset)
    np.testing.assert_allclose(back, field, rtol=0.0, atol=1e-12 * SIZE)


def test_eq_2_cannot_be_meant_as_printed() -> None:
    printed, cleaned = twelve_positions.misprint(0.02)
    assert printed == pytest.approx(0.0, abs=1e-12)
    assert cleaned == pytest.approx(0.02, abs=1e-12)


def test_the_comparison_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = Config(sensors=10, graph_sensors=3, readings=(30, 40))
    rows = compared.run(few)
    monkeypatch.setattr(compared, "run", lambda _: rows)
    monkeypatch.setattr(sys, "argv", ["magnetometer_calibrations_compared.py", "--quick"])
    compared.main()
    out = capsys.readouterr().out.splitlines()
    assert json.loads(out[-1])["rows"].keys() == rows.keys()
    for name, row in rows.items():
        shown = next(line for line in out if line.startswith(name))
        assert (
            f"{row['graph' if 'graph' in row else 'paper']:.3f}"[:4] in shown
            or min(row.values()) < 1e-6
        )


@pytest.mark.slow
def test_twelve_stops_in_a_stream_end_with_one_json_line_and_a_picture(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = ["twelve_positions.py", "--quick", "--seed", "2", "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", given)
    twelve_positions.main()
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert max(result["exactness"]) < 1e-10
    # A degree of tilt stays in the formulas; the graph finds it by gyro and accelerometer.
    assert result["session_deg"]["formulas"] > 0.4
    assert result["session_deg"]["graph"] < 0.05
    assert (tmp_path / "twelve_positions.png").read_bytes().startswith(b"\x89PNG")
