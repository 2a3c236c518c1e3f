"""Guidance while a magnetometer is rotated by hand: processes with a simulated hand at the pipe."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import magnetometer_by_hand as by_hand
import numpy as np
import pytest

from magfusion.calibration.turn_coverage import DIRECTIONS, TurnCoverage, TurnStatus
from magfusion.files.site import save_site
from magfusion.results.turn_guide import sphere_of_dots


@pytest.mark.slow
def test_a_hand_that_follows_ends_with_a_calibration_in_time(tmp_path: Path) -> None:
    hand = by_hand.Hand(by_hand.uncalibrated_site(), np.random.default_rng(45), follows=True)
    turned = by_hand.turn(hand, tmp_path)
    assert turned.code == 0, turned.message
    assert turned.seconds <= 90.0
    assert turned.offset_error_ut <= 0.2
    assert turned.offset_sigma_ut <= 0.1
    output = tmp_path / "magnetometer"
    names = {path.name for path in output.iterdir()}
    assert names == {"site.yaml", "report.html", "report.json", "magnetometer.png", "run.rrd"}
    report = json.loads((output / "report.json").read_text())
    assert report["job"] == "calibrate magnetometer"
    assert report["verdict"] != "failed"
    assert len(report["determined"]) == 12


@pytest.mark.slow
def test_a_hand_that_turns_about_one_axis_is_told_what_is_missing(tmp_path: Path) -> None:
    hand = by_hand.Hand(by_hand.uncalibrated_site(), np.random.default_rng(46), follows=False)
    turned = by_hand.turn(hand, tmp_path, 20.0)
    assert turned.code == 1
    for missing in ("x axis never pointed up or down", "y axis never pointed up or down"):
        assert missing in turned.message
    assert "z axis never pointed down" in turned.message
    assert not (tmp_path / "magnetometer" / "site.yaml").exists()


@pytest.mark.parametrize(("vertical", "way"), [(True, "down"), (False, "against the field")])
def test_the_nearest_missing_axis_is_next_until_it_is_visited(vertical: bool, way: str) -> None:
    coverage = TurnCoverage(vertical)
    coverage.add(np.array([[0.1, -0.2, 9.8]]))
    assert coverage.target == f"y {way}"
    coverage.add(np.eye(3))
    coverage.add(np.array([[0.0, -0.1, -3.0]]))
    assert coverage.target == f"y {way}"
    assert coverage.missing == [f"the sensor's {axis} axis never pointed {way}" for axis in "xy"]
    coverage.add(DIRECTIONS)
    assert coverage.target == ""
    assert coverage.missing == []


def test_the_sphere_shows_each_direction_on_its_side() -> None:
    visited = DIRECTIONS[:, 2] > 0.1
    status = TurnStatus(1.0, np.array([0.0, 0.0, 1.0]), visited, [], "x up")
    text = "\n".join(sphere_of_dots(status))
    # The equator is on both sides; the current direction is one of those with z up.
    assert text.count("\N{BLACK CIRCLE}") == 8
    assert text.count("@") == 1
    assert text.count("o") - 2 * "sensor".count("o") == 9 + 2 * 8
    away = sphere_of_dots(replace(status, now=None))
    assert "@" not in "\n".join(away)


@pytest.mark.slow
def test_without_inertial_samples_the_guidance_is_by_the_field(tmp_path: Path) -> None:
    hand = by_hand.Hand(by_hand.uncalibrated_site(), np.random.default_rng(47), follows=False)
    save_site(hand.site, tmp_path / "site.yaml")
    lines = []
    while hand.time < 10.0:
        lines.append(
            json.dumps({"magnetometer": json.loads(by_hand._record(hand))["magnetometer"]})
        )
    words = ["calibrate", "magnetometer", "-", "--site", "site.yaml", "-o", "out"]
    done = subprocess.run(
        [sys.executable, "-m", "magfusion", *words],
        input="\n".join(lines),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "along the field" in done.stderr
