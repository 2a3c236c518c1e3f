"""Eq 18 of paper 004 fails with the tilt; all phasors, and a whole fix, do not."""

import json
import sys

import numpy as np
import pytest
import tilted_attitude
from tilted_attitude import Config, Row


@pytest.fixture(scope="module")
def rows() -> dict[float, Row]:
    return {row.tilt_deg: row for row in tilted_attitude.run(Config(random_axes=100))}


@pytest.mark.slow
def test_a_level_sensor_hides_it(rows: dict[float, Row]) -> None:
    level = rows[0.0]
    pairs = [level.about_x, level.about_y, level.about_z, *level.about_random]
    np.testing.assert_allclose(pairs, 0.0, atol=1e-9)  # deg


@pytest.mark.parametrize(
    ("tilt_deg", "about_x", "about_y"),
    [  # deg
        (1.0, (2.0, 3.1), (1.0, 1.8)),
        (5.0, (9.0, 15.0), (3.9, 8.6)),
        (10.0, (15.4, 29.5), (6.5, 16.4)),
        (20.0, (24.0, 50.0), (9.3, 28.5)),
        (30.0, (31.0, 60.0), (11.0, 37.0)),
    ],
)
def test_tilts_give_the_errors_that_are_expected(
    rows: dict[float, Row],
    tilt_deg: float,
    about_x: tuple[float, float],
    about_y: tuple[float, float],
) -> None:
    assert rows[tilt_deg].about_x == pytest.approx(about_x, abs=0.5)
    assert rows[tilt_deg].about_y == pytest.approx(about_y, abs=0.5)


def test_height_helps_but_does_not_heal(rows: dict[float, Row]) -> None:
    errors = [nearest for _, nearest in rows[10.0].about_random]
    assert errors[0] > errors[1] > errors[2] > 5.0  # deg


def test_turns_about_the_beacons_axis_do_no_harm(rows: dict[float, Row]) -> None:
    np.testing.assert_allclose([row.about_z for row in rows.values()], 0.0, atol=1e-9)  # deg


def test_all_phasors_are_exact_and_a_fix_errs_alike_at_every_tilt(rows: dict[float, Row]) -> None:
    assert max(row.wahba_max for row in rows.values()) < 1e-9  # deg
    errors = [row.likelihood for row in rows.values()]
    assert max(errors) < 0.06  # deg
    assert np.ptp(errors) < 0.1 * np.mean(errors)  # 210 draws of noise, in sensor axes


@pytest.mark.slow
def test_the_scenario_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["tilted_attitude.py", "--seed", "2"])
    tilted_attitude.main()
    lines = capsys.readouterr().out.splitlines()
    assert [row["tilt_deg"] for row in json.loads(lines[-1])["rows"]] == list(Config().tilts_deg)
    assert any(line.split()[:3] == ["10", "15.4;", "29.5"] for line in lines[:-1])
