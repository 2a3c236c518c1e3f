"""Calibration of a beacon: the figures of paper 002, why they fail, and the exact fit."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import beacon_calibration
import numpy as np
import pytest
from beacon_calibration import MOMENT, PLACES_WORLD, Block, Config, Errors, run_block
from beacon_methods import calibrate_as_printed
from beacon_readings import PAPER, readings
from nees import average_nees_bounds
from scipy.spatial.transform import Rotation

from magfusion.calibration.beacon import BeaconMeasurements, calibrate_beacon
from magfusion.calibration.beacon_refined import attitudes, calibrate_one, open_axes, refine
from magfusion.errors import InputError
from magfusion.model.field import predict
from magfusion.model.site import Beacon, BeaconSigma, Coil
from magfusion.papers.p002_beacon.equations import (
    eq_30_variance_of_psi,
    eq_31_variance_of_lambda,
    eq_32_variance_of_gamma,
    eq_33_geometric_centre,
)
from magfusion.simulation.field import phasors_world
from magfusion.units import DEGREE, Array


@pytest.fixture(scope="module")
def errors() -> dict[tuple[str, int], Errors]:
    return beacon_calibration.run(Config(noises=("component", "axis")), workers=1)


def mean(errors: Errors, name: str) -> list[float]:
    return errors.summary()[name]


# C1: the printed method with each component off by 1 %, in beacon axes, hemispheres known.
@pytest.mark.slow
@pytest.mark.parametrize(("count", "position", "angle"), [(3, 0.0107, 0.152), (4, 0.0080, 0.119)])
def test_the_figures_of_the_paper_need_the_axes_of_the_beacon(
    errors: dict[tuple[str, int], Errors], count: int, position: float, angle: float
) -> None:
    result = errors["component", count]
    assert mean(result, "position_m")[0] == pytest.approx(position, rel=0.08)
    assert mean(result, "attitude_rms_deg")[0] == pytest.approx(angle, rel=0.08)


# C2: the same with white noise, and the fit of six unknowns.
@pytest.mark.slow
@pytest.mark.parametrize(("count", "printed", "exact"), [(3, 0.0268, 0.0089), (4, 0.0195, 0.0072)])
def test_in_white_noise_the_exact_fit_is_three_times_as_good(
    errors: dict[tuple[str, int], Errors], count: int, printed: float, exact: float
) -> None:
    position = mean(errors["axis", count], "position_m")
    assert position[0] == pytest.approx(printed, rel=0.08)
    assert position[2] == pytest.approx(exact, rel=0.08)


@pytest.mark.slow
def test_many_runs_reach_the_figures_closely_and_the_bound() -> None:
    """C1 and C2 within 4 %, C3 within 5 %."""
    result = beacon_calibration.run(
        Config(runs=2500, noises=("component", "axis"), seed=5), workers=1
    )
    for count, position, angle in ((3, 0.0107, 0.152), (4, 0.0080, 0.119)):
        printed = result["component", count]
        assert mean(printed, "position_m")[0] == pytest.approx(position, rel=0.04)
        assert mean(printed, "attitude_rms_deg")[0] == pytest.approx(angle, rel=0.04)
    for count, printed_m, exact_m in ((3, 0.0268, 0.0089), (4, 0.0195, 0.0072)):
        white = result["axis", count]
        assert mean(white, "position_m")[0] == pytest.approx(printed_m, rel=0.04)
        assert mean(white, "position_m")[2] == pytest.approx(exact_m, rel=0.04)
        rms, bound = (np.array(mean(white, n)) for n in ("position_rms_m", "bound_rms_m"))
        np.testing.assert_allclose(rms[1:] / bound, 1.0, rtol=0.0, atol=0.05)


# C4
def test_the_grid_finds_the_right_minimum(errors: dict[tuple[str, int], Errors]) -> None:
    for result in errors.values():
        assert np.mean(result.position[1] < 10.0 * np.median(result.bound[1])) >= 0.98
    assert beacon_calibration.anywhere(Config()) >= 0.98


# B5
@pytest.mark.parametrize(
    ("tilt_deg", "three", "four"), [(1.0, 0.21, 0.19), (2.0, 0.46, 0.39), (5.0, 1.58, 0.89)]
)
def test_a_tilt_moves_the_printed_centre(tilt_deg: float, three: float, four: float) -> None:
    tilt = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    result = beacon_calibration.printed_from(tilt, np.eye(3))
    assert [one.error_m for one in result] == pytest.approx([three, four], abs=0.02)
    assert result[0].alarm_m2 < 1e-9  # three angles always fit
    assert result[1].alarm_m2 == pytest.approx(0.09 * tilt_deg**2, rel=0.1)


def test_the_printed_method_does_not_see_a_turn_about_the_axis() -> None:
    turn = Rotation.from_euler("z", 30.0, degrees=True).as_matrix()
    for result in beacon_calibration.printed_from(turn, np.eye(3)):
        assert result.error_m == pytest.approx(0.0, abs=1e-9)
        assert result.turn_deg == pytest.approx(0.0, abs=1e-6)


def test_the_papers_own_attitude_gives_nothing_usable() -> None:
    rotation = beacon_calibration.paper_rotation()
    for axes in (np.eye(3), rotation):  # measured axes; beacon axes with all directions upward
        result = beacon_calibration.printed_from(rotation, axes)
        assert result[0].error_m is None
        assert result[1].error_m is None or result[1].alarm_m2 > 1.0


def test_another_centre_fits_the_normals_of_three_magnetometers() -> None:
    assert beacon_calibration.false_centres() == pytest.approx([0.0, 0.174], abs=1e-3)


def test_uneven_coils_do_not_disturb_the_fit_of_nine_unknowns() -> None:
    nine, six = beacon_calibration.uneven_coils()
    assert nine < 1e-9
    assert six > 1e-3


def test_the_printed_variances_are_those_of_their_angles() -> None:
    rng = np.random.default_rng(3)
    psi, gamma, lamda = 0.3, 0.9, 1.2
    true = Rotation.from_euler("ZYX", [gamma, psi, lamda]).as_matrix()
    sigma = 1e-4 * (1.0 + rng.random((3, 3)))
    drawn = true + sigma * rng.standard_normal((20_000, 3, 3))
    # psi, lambda and gamma each from its own element, the rest known.
    upright = np.cos(psi)
    angles = np.stack(
        [
            np.arcsin(-drawn[:, 2, 0]),
            np.arccos(drawn[:, 2, 2] / upright),
            np.arccos(drawn[:, 0, 0] / upright),
        ]
    )
    printed = (eq_30_variance_of_psi, eq_31_variance_of_lambda, eq_32_variance_of_gamma)
    expected = [variance(true, sigma**2) for variance in printed]
    np.testing.assert_allclose(np.var(angles, axis=1), expected, rtol=0.05, atol=0.0)


def test_the_printed_method_is_exact_without_noise_in_beacon_axes() -> None:
    rotation = beacon_calibration.paper_rotation()
    place = np.array([0.3, -0.2, 0.1])
    true = beacon_calibration.beacon(place, rotation)
    phasor = phasors_world(true, PLACES_WORLD)[None, :, 0] @ rotation
    hemisphere = np.sign(((PLACES_WORLD - place) @ rotation)[:, 2])
    result = calibrate_as_printed(phasor, PLACES_WORLD, MOMENT, hemisphere)
    np.testing.assert_allclose(result.centre_world[0], place, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(result.world_from_beacon[0], rotation, rtol=0.0, atol=1e-8)


def test_the_geometric_centre_is_that_of_the_box() -> None:
    corners = np.array([[x, y, z] for x in (0, 0.35) for y in (0, 0.35) for z in (0, 0.15)])
    np.testing.assert_allclose(
        eq_33_geometric_centre(corners + 1.0), [1.175, 1.175, 1.075], rtol=1e-12, atol=0.0
    )


TURNS = Rotation.random(5, random_state=7).as_matrix()
RUNS = 150
POINTS = np.array([[1.5, 1, 0.6], [-1.2, 1.4, -0.3], [1.1, -1.7, 1], [-1, -1, 0.2], [0.2, 2, 2]])
SIGMA = BeaconSigma(np.full(3, 0.3), np.full(3, 0.2), np.full(3, 0.1))
X, Y, Z = 200.0 * np.eye(3)
QUARTER = -np.pi / 2.0
KINDS = {
    "rotating": (Coil(X), Coil(Y, QUARTER)),
    "one coil": (Coil(Z, 0.4),),
    "three tones": (
        Coil(X, 0.3, frequency_hz=20.0, centre_beacon=np.array([0.02, 0.0, 0.01])),
        Coil(Y, 0.1, frequency_hz=22.0),
        Coil(Z, 2.0, frequency_hz=24.0),
    ),
}


def any_beacon(kind: str, *, synchronised: bool) -> Beacon:
    turn = Rotation.from_rotvec([0.1, -0.05, 0.08]).as_matrix()
    coils = KINDS[kind]
    sigma = replace(SIGMA, log_moment=SIGMA.log_moment[: len(coils)])
    return Beacon("A", np.array([0.1, 0.2, 0.0]), turn, 25.0, coils, synchronised, sigma)


def truth_of(declared: Beacon) -> Beacon:
    turn = Rotation.from_rotvec([0.2, 0.15, 0.1]).as_matrix()
    coils = tuple(replace(c, moment_beacon=1.1 * c.moment_beacon) for c in declared.coils)
    return replace(
        declared,
        position_world=np.array([-0.2, 0.1, 0.15]),
        world_from_beacon=declared.world_from_beacon @ turn,
        coils=coils,
    )


def measured_of(declared: Beacon, true: Beacon, runs: int, sigma: float) -> BeaconMeasurements:
    rng = np.random.default_rng(11)
    sensor = beacon_calibration.bare_magnetometer()
    sensor = replace(sensor, position_body=np.array([0.05, 0.0, -0.02]), matrix=1.02 * np.eye(3))
    phase = np.zeros(len(true.tones)) if true.synchronised else rng.uniform(-3, 3, len(true.tones))
    rotated = np.broadcast_to(phase, (len(POINTS), len(phase)))
    exact = predict(true, sensor, TURNS, POINTS, rotated)
    noise = rng.normal(0.0, sigma, (2, runs, *exact.shape))
    phasor = exact + noise[0] + 1j * noise[1]
    return BeaconMeasurements(
        declared, sensor, TURNS, POINTS, phasor, np.full((*exact.shape[:2], 2), sigma)
    )


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("kind", ["rotating", "one coil"])
def test_every_kind_of_beacon_is_found_at_any_attitude(kind: str, synchronised: bool) -> None:
    declared = any_beacon(kind, synchronised=synchronised)
    true = truth_of(declared)
    fits = calibrate_beacon(measured_of(declared, true, RUNS, 1e-9))
    error = fits.centre_world - true.position_world
    nees = np.einsum("ri,rij,rj->r", error, np.linalg.inv(fits.cov[:, :3, :3]), error)
    low, high = average_nees_bounds(3, RUNS, 0.999)
    assert low < np.mean(nees) < high


@pytest.mark.parametrize("synchronised", [True, False])
def test_coils_with_centres_of_their_own_turn_with_the_beacon(synchronised: bool) -> None:
    declared = any_beacon("three tones", synchronised=synchronised)
    true = truth_of(declared)
    fits, refined = calibrate_one(measured_of(declared, true, 1, 1e-15), 1.5)
    np.testing.assert_allclose(fits.centre_world[0], true.position_world, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(
        refined.beacon.world_from_beacon, true.world_from_beacon, rtol=0.0, atol=1e-7
    )
    np.testing.assert_allclose(
        refined.beacon.moments_beacon, true.moments_beacon, rtol=1e-6, atol=1e-4
    )


@pytest.mark.parametrize("kind", ["rotating", "three tones"])
def test_coils_of_true_size_are_fitted_as_such(kind: str) -> None:
    """To a micrometre where points would be wrong by millimetres."""
    points = any_beacon(kind, synchronised=True)
    coils = tuple(replace(coil, radius=0.3) for coil in points.coils)
    declared = replace(points, coils=coils)
    true = truth_of(declared)
    measured = measured_of(declared, true, 1, 1e-15)
    fits, refined = calibrate_one(measured, 1.5)
    np.testing.assert_allclose(fits.centre_world[0], true.position_world, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(
        refined.beacon.world_from_beacon, true.world_from_beacon, rtol=0.0, atol=1e-6
    )
    np.testing.assert_allclose(refined.beacon.moments_beacon, true.moments_beacon, atol=1e-3)
    plain, _ = calibrate_one(replace(measured, beacon=points), 1.5)
    assert np.linalg.norm(plain.centre_world[0] - true.position_world) > 1e-3


def misalignment(result: Array, true: Array) -> Array:
    return np.asarray(Rotation.from_matrix(np.swapaxes(result, -1, -2) @ true).as_rotvec())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rotating", "one coil"])
def test_the_sigmas_of_attitude_and_moments_are_those_of_the_errors(kind: str) -> None:
    declared = any_beacon(kind, synchronised=True)
    true = truth_of(declared)
    measured = measured_of(declared, true, 500, 1e-9)
    fits = calibrate_beacon(measured)
    rotated, _ = attitudes(declared, fits.moments_world)
    sigma = refine(measured, fits).beacon.sigma
    error = np.std(misalignment(rotated, rotated[0]), axis=0)
    free_parameters = open_axes(declared)
    known = (
        np.ones(3, dtype=bool) if len(free_parameters) == 0 else np.abs(free_parameters[0]) < 0.5
    )
    np.testing.assert_allclose(error[known], sigma.rotation_beacon[known], rtol=0.12, atol=0.0)
    size = np.linalg.norm(np.abs(fits.moments_world), axis=-1)
    if kind == "one coil":
        spread = np.std(np.log(size[:, 0]))
        assert spread == pytest.approx(sigma.log_moment[0], rel=0.12)


@pytest.mark.parametrize(
    ("kind", "synchronised", "axes"),
    [
        ("rotating", True, np.zeros((0, 3))),
        ("rotating", False, np.eye(3)[2:]),
        ("one coil", True, np.eye(3)[2:]),
        ("three tones", False, np.zeros((0, 3))),
    ],
)
def test_turns_that_the_field_does_not_tell_are_known(
    kind: str, synchronised: bool, axes: Array
) -> None:
    result = open_axes(any_beacon(kind, synchronised=synchronised))
    assert len(result) == len(axes)
    np.testing.assert_allclose(np.abs(result), axes, rtol=0.0, atol=1e-12)


def test_the_refined_beacon_predicts_what_was_fitted() -> None:
    for synchronised in (True, False):
        declared = any_beacon("rotating", synchronised=synchronised)
        measured = measured_of(declared, truth_of(declared), 1, 1e-9)
        fits = calibrate_beacon(measured)
        refined = refine(measured, fits)
        phase = np.broadcast_to(refined.phase, (len(POINTS), 1))
        model = predict(refined.beacon, measured.magnetometer, TURNS, POINTS, phase)
        error = (measured.phasor_sensor[0] - model) / 1e-9
        assert np.sum(np.abs(error) ** 2) == pytest.approx(fits.chi_square[0], rel=1e-6)


def test_a_missing_phasor_counts_for_nothing() -> None:
    declared = any_beacon("rotating", synchronised=True)
    measured = measured_of(declared, truth_of(declared), 1, 1e-9)
    phasor = measured.phasor_sensor.copy()
    phasor[:, 4] = np.nan
    without = calibrate_beacon(replace(measured, phasor_sensor=phasor))
    fewer = calibrate_beacon(
        replace(
            measured,
            world_from_body=TURNS[:4],
            position_world=POINTS[:4],
            phasor_sensor=measured.phasor_sensor[:, :4],
            sigma=measured.sigma[:4],
        )
    )
    np.testing.assert_allclose(without.centre_world, fewer.centre_world, rtol=0.0, atol=1e-7)


def test_coils_of_one_tone_at_two_places_are_refused() -> None:
    declared = any_beacon("rotating", synchronised=True)
    separate = replace(declared.coils[1], centre_beacon=np.array([0.0, 0.0, 0.1]))
    declared = replace(declared, coils=(declared.coils[0], separate))
    with pytest.raises(InputError, match="separate centres"):
        calibrate_beacon(measured_of(declared, declared, 1, 1e-9))


def test_blocks_draw_from_the_generator_that_they_are_given() -> None:
    block = Block(3, 3, "axis", 0.01)
    first, second = (run_block(block, np.random.default_rng(seed))[0] for seed in (1, 2))
    assert np.all(first != second)


def test_a_reading_is_the_papers_where_all_four_figures_round_to_its_own() -> None:
    rng = np.random.default_rng(1)
    right, wrong = {}, {}
    for count, (place, turn) in PAPER.items():
        angles = rng.standard_normal((20_000, 3)) * np.sqrt(np.pi / 2.0) * turn * DEGREE
        position = rng.uniform(0.5, 1.5, 20_000) * place
        right["so", count] = position, angles
        wrong["so", count] = (1.2 if count == 4 else 1.0) * position, angles
    mean, rms = readings(right)
    assert mean.is_the_papers
    assert not rms.is_the_papers  # the same angles, of which the other mean is printed
    assert rms.ratios[2] == pytest.approx(np.sqrt(np.pi / 2.0), rel=0.03)
    assert not readings(wrong)[0].is_the_papers


@pytest.mark.slow
def test_the_scenario_draws_and_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options = ["--runs", "20", "--workers", "1", "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["beacon_calibration.py", *options])
    beacon_calibration.main()
    reported = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(reported["errors"]) == 6
    assert (tmp_path / "beacon_calibration.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_scenario_gives_the_same_numbers_on_two_processes() -> None:
    config = Config(runs=8, block=4)
    here, there = (beacon_calibration.run(config, workers=n) for n in (1, 2))
    for case, result in here.items():
        np.testing.assert_allclose(result.position, there[case].position, rtol=1e-9, atol=0.0)
