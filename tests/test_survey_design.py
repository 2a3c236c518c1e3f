"""What neighbours, density and blocks of a survey are worth, by paper 004 and in its rooms."""

import json
import sys

import pytest
import survey_design
from survey_design import Config, run

from magfusion.papers.register import paper

Figures = dict[str, dict[str, float]]


@pytest.fixture(scope="module")
def figures() -> Figures:
    return run(Config())


@pytest.fixture(scope="module")
def other_rooms() -> Figures:
    return run(Config(seed=3))


@pytest.mark.slow
def test_more_than_four_neighbours_worsen_both_algorithms(
    figures: Figures, other_rooms: Figures
) -> None:
    for rooms in (figures, other_rooms):
        for algorithm in ("algorithm_2_by_n", "algorithm_3_by_n"):
            error = rooms[algorithm]
            assert error["16"] > error["8"] > 1.2 * error["4"]


@pytest.mark.slow
def test_a_denser_survey_is_more_accurate(figures: Figures, other_rooms: Figures) -> None:
    for rooms in (figures, other_rooms):
        for algorithm in ("algorithm_2_by_spacing", "algorithm_3_by_spacing"):
            error = rooms[algorithm]
            assert error["0.25"] < 0.7 * error["0.5"] < 0.5 * error["1"]


def test_smaller_blocks_help_until_they_have_too_few_points(
    figures: Figures, other_rooms: Figures
) -> None:
    for rooms in (figures, other_rooms):
        error = rooms["algorithm_1_by_block"]
        assert error["none"] > error["4"] > error["2"] > error["1.5"]
        assert error["1"] > error["1.5"]


def test_algorithm_3_gains_nothing_from_the_third_and_fourth_neighbour() -> None:
    for seed in (0, 3):
        rooms = [survey_design.draw_room(survey_design.Config(seed=seed), i) for i in range(6)]
        error = {
            n: survey_design.mean_error(rooms, survey_design.by_differential_range(0.5, n))
            for n in (1, 2, 4)
        }
        assert error[2] < 0.9 * error[1]
        assert error[4] > 0.97 * error[2]


def test_with_a_denser_survey_still_smaller_blocks_help() -> None:
    """The further work of section 3.3; on a grid of 0.5 m, 1 m is no better than 2 m."""
    rooms = [survey_design.draw_room(Config(), index) for index in range(6)]
    dense, sparse = (
        [
            survey_design.mean_error(rooms, survey_design.by_lines(block, spacing))
            for block in (1, 2)
        ]
        for spacing in (0.25, 0.5)
    )
    assert dense[0] < 0.85 * dense[1]
    assert sparse[0] > 0.85 * sparse[1]


def test_the_register_has_the_figures_of_the_scenario(figures: Figures) -> None:
    (by_block, by_n, by_spacing) = (
        paper("004").select(f"claim {number}")[0].entry.figures for number in (15, 21, 23)
    )
    for name, reported in (
        ("algorithm_1_by_block", by_block),
        ("algorithm_2_by_n", by_n),
        ("algorithm_3_by_n", by_n),
        ("algorithm_2_by_spacing", by_spacing),
        ("algorithm_3_by_spacing", by_spacing),
    ):
        for error in figures[name].values():
            assert f"{error:.3f}" in reported, name


def test_the_scenario_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["survey_design.py", "--quick"])
    survey_design.main()
    assert (
        json.loads(capsys.readouterr().out.splitlines()[-1]).keys()
        == run(Config(rooms=1, targets=5)).keys()
    )
