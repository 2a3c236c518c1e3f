"""What the calibration of the beacons is worth to who navigates by them."""

import json
import sys
from pathlib import Path

import calibrated_navigation
import numpy as np
import pytest
from calibrated_navigation import PAPER, Config, means, report, taken_off

Table = dict[str, dict[str, list[float]]]


@pytest.fixture(scope="module")
def reported() -> Table:
    return means(calibrated_navigation.run(Config(worlds=4, targets=60), workers=1))


@pytest.mark.slow
def test_what_calibration_takes_off_stands_beside_the_papers_share(reported: Table) -> None:
    printed = taken_off(PAPER["geometric"], PAPER["calibrated"])
    assert printed == pytest.approx((28.6, 62.8), abs=0.1)  # per cent
    ours = taken_off(
        reported["geometric"]["trilateration"], reported["calibrated"]["trilateration"]
    )
    assert min(ours) > max(printed)  # of exact amplitudes
    last = report(reported).splitlines()[-1].split()
    assert last[:2] == ["taken", "off"]
    assert [float(cell) for cell in last[2::2][-2:]] == pytest.approx([-28.6, -62.9])
    assert [float(cell) for cell in last[2:6:2]] == pytest.approx([-s for s in ours], abs=0.05)


@pytest.mark.slow
def test_calibration_leaves_nearly_what_exact_beacons_leave(reported: Table) -> None:
    for method in ("trilateration", "likelihood"):
        geometric, calibrated, true = (reported[s][method] for s in calibrated_navigation.SITES)
        assert calibrated[0] < 0.4 * geometric[0]  # m
        assert calibrated[1] < 0.4 * geometric[1]  # deg
        assert calibrated[0] - true[0] < 0.01
        assert calibrated[1] - true[1] < 0.3
    for own in reported.values():
        assert own["likelihood"][0] < own["trilateration"][0]
        assert own["likelihood"][1] < own["trilateration"][1]


@pytest.mark.slow
def test_an_amplitude_error_that_gives_the_papers_calibrated_gives_its_uncalibrated_figures() -> (
    None
):
    worlds = 40
    errors = calibrated_navigation.run(
        Config(worlds=worlds, amplitude_error=0.0275, seed=2), workers=1
    )
    reported = means(errors)
    position, angle, spread, spread_deg = reported["geometric"]["trilateration"]
    paper_m, paper_deg = PAPER["geometric"]
    # Selected to match.
    assert reported["calibrated"]["trilateration"][0] == pytest.approx(0.110, abs=0.008)
    position_share, attitude_share = taken_off(
        reported["geometric"]["trilateration"], reported["calibrated"]["trilateration"]
    )
    assert position_share == pytest.approx(28.6, abs=6.0)  # per cent
    assert attitude_share == pytest.approx(45.0, abs=6.0)  # 62.8 printed
    # Predicted.
    assert abs(position - paper_m) < 3.0 * spread / np.sqrt(worlds)
    assert abs(angle - paper_deg) < 3.0 * spread_deg / np.sqrt(worlds)
    assert (
        reported["calibrated"]["likelihood"][0] < 0.3 * reported["calibrated"]["trilateration"][0]
    )


def test_the_scenario_draws_and_ends_with_one_json_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options = ["--worlds", "1", "--targets", "20", "--workers", "1", "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["calibrated_navigation.py", *options])
    calibrated_navigation.main()
    reported = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(reported["0"]) == set(calibrated_navigation.SITES)
    assert (tmp_path / "calibrated_navigation.png").read_bytes().startswith(b"\x89PNG")
