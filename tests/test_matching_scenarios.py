"""Figures 4 and 6 of paper 001: what they claim, and where the claim ends."""

import json
import sys
from pathlib import Path

import attitude_matching
import numpy as np
import pytest
import roll_matching
from scipy.spatial.transform import Rotation

from magfusion.papers.register import paper


@pytest.fixture(scope="module")
def rolls() -> dict[tuple[str, float, float], roll_matching.Row]:
    result = roll_matching.run(roll_matching.Config())
    return {(row.axis, row.step_deg, row.noise_mg): row for row in result}


@pytest.fixture(scope="module")
def attitudes() -> attitude_matching.Result:
    return attitude_matching.run(attitude_matching.Config())


@pytest.mark.slow
def test_the_printed_three_degrees_are_a_database_of_one_degree_and_3_mg(
    rolls: dict[tuple[str, float, float], roll_matching.Row],
) -> None:
    row = rolls["vertical", 1, 3]
    assert row.rms["nearest"] == pytest.approx(0.79, abs=0.08)  # deg
    assert row.median_max["nearest"] < roll_matching.PAPER_DEG
    assert rolls["vertical", 1, 5].median_max["nearest"] > roll_matching.PAPER_DEG


@pytest.mark.slow
def test_interpolation_in_a_coarse_database_equals_the_closed_form(
    rolls: dict[tuple[str, float, float], roll_matching.Row],
) -> None:
    coarse = rolls["vertical", 10, 3]
    assert coarse.rms["interpolated"] < 0.8  # deg
    assert coarse.rms["interpolated"] == pytest.approx(coarse.rms["closed form"], rel=0.03)
    assert coarse.rms["nearest"] == pytest.approx(2.98, abs=0.3)


def test_the_error_of_the_nearest_entry_is_that_of_the_closed_form_and_of_the_step(
    rolls: dict[tuple[str, float, float], roll_matching.Row],
) -> None:
    for step in (5, 10):
        row = rolls["vertical", step, 3]
        expected = np.hypot(row.rms["closed form"], step / np.sqrt(12.0))
        assert row.rms["nearest"] == pytest.approx(expected, rel=0.03)


def test_a_roll_at_twenty_turns_a_second_errs_as_at_rest() -> None:
    result = roll_matching.spin(roll_matching.Config())
    assert result.spin_rms_deg == pytest.approx(result.rest_rms_deg, rel=0.15)
    assert result.clipped_gyro_deg > 360.0
    reported = paper("001").select("claim 13")[0].entry.figures
    for value in (result.spin_rms_deg, result.rest_rms_deg):
        assert f"{value:.2f}" in reported


@pytest.mark.slow
def test_the_register_has_the_figures_of_the_scenarios(
    rolls: dict[tuple[str, float, float], roll_matching.Row], attitudes: attitude_matching.Result
) -> None:
    figure_4, figure_6, yaw, coarse = (
        paper("001").select(words)[0].entry.figures
        for words in ("fig 4", "fig 6", "claim 2", "claim 9")
    )
    fine, step_10 = rolls["vertical", 1, 3], rolls["vertical", 10, 3]
    assert f"largest error of 2000 rolls {fine.median_max['nearest']:.2f}" in figure_4
    assert f"rms {fine.rms['nearest']:.2f}" in figure_4
    within = {row.yaw_deg: row.within_paper for row in attitudes.free_yaw}
    for angle, share in (("10 degrees", within[10.0]), ("a half turn", within[180.0])):
        assert f"by {angle} {100.0 * share:.1f} %" in figure_6
    assert f"median {attitudes.all_attitudes_median_deg:.1f} degrees" in yaw
    assert f"{step_10.rms['interpolated']:.2f} degrees rms interpolated" in coarse
    assert f"{step_10.rms['nearest']:.2f} by the nearest" in coarse


def test_a_level_axis_has_more_field_across_it(
    rolls: dict[tuple[str, float, float], roll_matching.Row],
) -> None:
    ratio = rolls["north", 1, 3].rms["closed form"] / rolls["vertical", 1, 3].rms["closed form"]
    assert ratio == pytest.approx(0.58, abs=0.06)


def test_the_calibrated_magnetometer_errs_as_twelve_positions_let_it() -> None:
    rng = np.random.default_rng(7)
    axis = rng.standard_normal((2000, 3))
    size = np.linalg.norm(roll_matching.FIELD_NED)
    true = size * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    angles = []
    for _ in range(200):
        matrix, offset = roll_matching.calibrated_error(roll_matching.Config(), rng)
        result = true @ matrix.T + offset
        sine = np.linalg.norm(np.cross(result, true), axis=1)
        angles.append(np.arctan2(sine, np.sum(result * true, axis=1)))
    assert np.rad2deg(np.sqrt(np.mean(np.square(angles)))) == pytest.approx(0.225, abs=0.02)


@pytest.mark.slow
def test_the_printed_five_degrees_need_a_step_of_five_or_interpolation(
    attitudes: attitude_matching.Result,
) -> None:
    steps = {row.step_deg: row for row in attitudes.steps}
    assert [steps[s].entries for s in (1.0, 2.0, 5.0, 10.0)] == [28_800, 7_560, 1_440, 432]
    assert steps[5.0].rms["nearest"] == pytest.approx(1.51, abs=0.08)  # deg
    assert steps[5.0].median_max["nearest"] < attitude_matching.PAPER_DEG
    assert steps[5.0].rms["interpolated"] <= 0.45
    assert steps[10.0].median_max["nearest"] > attitude_matching.PAPER_DEG
    assert steps[10.0].median_max["interpolated"] < attitude_matching.PAPER_DEG


def test_the_claim_ends_where_the_yaw_is_free(attitudes: attitude_matching.Result) -> None:
    within = {row.yaw_deg: row.within_paper for row in attitudes.free_yaw}
    assert within[2.0] == 1.0
    assert within[10.0] < 0.55
    assert within[180.0] < 0.1
    assert attitudes.all_attitudes_median_deg > 80.0
    assert attitudes.all_attitudes_vector_deg < 0.3  # it is not the matching that fails


def test_the_fold_lies_sixty_degrees_nose_down_and_is_refused(
    attitudes: attitude_matching.Result,
) -> None:
    folds = {fold.pitch_deg: fold for fold in attitudes.folds}
    assert not folds[-59.0].determined
    assert folds[-55.0].determined
    assert [p for p in folds[0.0].found_deg if p is not None] == [pytest.approx(0.0, abs=1e-6)]
    fold = np.mean([p for p in folds[-45.0].found_deg if p is not None])
    assert fold == pytest.approx(-60.1, abs=0.1)
    sigmas = [(f.pitch_sigma_deg, f.roll_sigma_deg) for f in attitudes.folds[:3]]
    assert np.min(sigmas) > 0.10  # deg for a milligauss
    assert np.max(sigmas) < 0.22


def test_gravity_is_what_was_lacking(attitudes: attitude_matching.Result) -> None:
    assert attitudes.with_gravity_rms_deg == pytest.approx(0.87, abs=0.05)


def test_the_papers_angles_are_converted_as_its_axes_are() -> None:
    rng = np.random.default_rng(8)
    ned_deg = rng.uniform((-180.0, -89.0, -180.0), (180.0, 89.0, 180.0), (100, 3))
    ours = Rotation.from_euler("xyz", attitude_matching.from_ned(ned_deg)).as_matrix()
    ned_from_frd = Rotation.from_euler("xyz", ned_deg, degrees=True).as_matrix()
    frd_from_body = np.diag([1.0, -1.0, -1.0])  # forward, right, down; forward, left, up
    by_axes = roll_matching.WORLD_FROM_NED @ ned_from_frd @ frd_from_body
    np.testing.assert_allclose(ours, by_axes, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [roll_matching, attitude_matching])
def test_a_scenario_draws_and_ends_with_one_json_line(
    scenario: object,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = getattr(scenario, "__name__", "")
    monkeypatch.setattr(sys, "argv", [name, "--seed", "2", "-o", str(tmp_path)])
    small = {"roll_matching": {"seeds": 1}, "attitude_matching": {"seeds": 1, "entries": 2000}}
    usual = getattr(scenario, "Config")  # noqa: B009 - the module is a parameter
    monkeypatch.setattr(scenario, "Config", _with(usual, small[name]))
    getattr(scenario, "main")()  # noqa: B009
    last = capsys.readouterr().out.splitlines()[-1]
    assert json.loads(last)["paper_max_deg"] in (3.0, 5.0)
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def _with(usual: type, changes: dict[str, int]) -> type:
    class Small(usual):  # type: ignore[misc]
        def __init__(self, seed: int) -> None:
            super().__init__(seed=seed, **changes)

    return Small
