"""magfusion calibrate log: a refined site, what the log could not tell, what motion is missing."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, run_command

from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.site import BeaconSigma, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests
from magfusion.units import DEGREE

RESTLESS = Rests(start=0.0, move=1e3, pause=0.0)


def badly_surveyed(scale: float = 1.0) -> Site:
    plain = demo_site(coil_radius=None)
    sigma = BeaconSigma(
        np.full(3, 0.03 * scale), np.full(3, 1.5 * DEGREE * scale), np.full(2, 0.02 * scale)
    )
    return replace(plain, beacons=tuple(replace(b, sigma=sigma) for b in plain.beacons))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SimulatedLog]:
    """Return the directory of a walk without a stop, and what was true."""
    config = SimulationConfig(DEMO_BOX_WORLD, duration=32.0, rests=RESTLESS)
    built = simulate_log(badly_surveyed(), config, np.random.default_rng(3))
    directory = tmp_path_factory.mktemp("calibrate_log") / "log"
    write_log(built.log, directory)
    save_site(badly_surveyed(), directory / "site.yaml")
    return directory, built


@pytest.fixture(scope="module")
def calibrated(
    recorded: tuple[Path, SimulatedLog], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    output = tmp_path_factory.mktemp("calibrated") / "result"
    run_command("calibrate", "log", recorded[0], "-o", output, "--cross-validate", 2)
    return output


@pytest.fixture(scope="module")
def report(calibrated: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((calibrated / "report.json").read_text())
    return read


@pytest.mark.slow
def test_the_command_writes_its_files_and_no_others(calibrated: Path) -> None:
    names = {path.name for path in calibrated.iterdir()}
    assert names == {
        "site.yaml",
        "site_correlation.parquet",
        "calibration.png",
        "report.html",
        "report.json",
    }
    assert (calibrated / "calibration.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_the_refined_site_is_nearer_the_truth(
    calibrated: Path, recorded: tuple[Path, SimulatedLog]
) -> None:
    def relative(site: Site) -> np.ndarray:
        """Places from each other, which no shift of them all changes."""
        places = np.array([b.position_world for b in site.beacons])
        return np.linalg.norm(places[:, None] - places[None], axis=-1)

    true = relative(recorded[1].true_site)
    before = relative(badly_surveyed()) - true
    after = relative(load_site(calibrated / "site.yaml")) - true
    assert np.linalg.norm(after) < 0.4 * np.linalg.norm(before)


@pytest.mark.slow
def test_the_report_is_flat_and_tells_every_parameter(report: dict[str, Any]) -> None:
    plain = (bool, int, float, str, type(None))
    assert report["verdict"] == "trustworthy"
    for key, value in report.items():
        if key not in ("reasons", "remarks", "unverified"):
            assert isinstance(value, plain) or all(isinstance(one, str) for one in value)
    assert report["job"] == "calibrate log"
    named = [key.removesuffix("_prior_sigma") for key in report if key.endswith("_prior_sigma")]
    assert len(named) == report["directions"]
    for name in named:
        ratio = report[f"{name}_sigma"] / report[f"{name}_prior_sigma"]
        assert report[f"{name}_ratio"] == pytest.approx(ratio, rel=1e-9)
    assert 0 < report["directions_determined"] < report["directions"]


@pytest.mark.slow
def test_the_gauge_is_told(report: dict[str, Any]) -> None:
    assert sum("all beacons shifted together" in text for text in report["gauge"]) == 3
    assert sum("about the vertical" in text for text in report["gauge"]) == 1
    assert "A.position_x_m" in report["undetermined"]
    assert "A.position_x_m" in report["determined_but_for_gauge"]


@pytest.mark.slow
def test_the_missing_stops_are_told(report: dict[str, Any]) -> None:
    assert any("never stationary" in text for text in report["missing_motion"])
    assert report["motion_at_rest"] == 0.0


@pytest.mark.slow
def test_a_calibration_of_one_part_serves_the_other(report: dict[str, Any]) -> None:
    assert report["cross_parts"] == 2
    for key in ("aligned_ate_m", "residual_rms"):
        assert report[f"cross_calibrated_{key}"] < report[f"cross_declared_{key}"]
        for pair, other in (("1_on_2", 2), ("2_on_1", 1)):
            after, before = report[f"cross_part_{pair}_{key}"], f"cross_part_{other}_declared_{key}"
            assert after < report[before]
    assert report["cross_disagreement_sigma"] < 4.0


@pytest.mark.slow
def test_the_screen_tells_what_is_open(
    recorded: tuple[Path, SimulatedLog], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run_command("calibrate", "log", recorded[0], "-o", tmp_path / "out", "--end", 12, "-v")
    shown = capfd.readouterr().out
    assert "directions of the calibration are determined" in shown
    assert "open: all beacons shifted together along x" in shown
    assert "missing motion: The platform was never stationary" in shown
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["job"] == "calibrate log"


def test_what_cannot_be_cross_validated_is_refused(
    recorded: tuple[Path, SimulatedLog], tmp_path: Path, refuse: Refuse
) -> None:
    command = ("calibrate", "log", recorded[0], "-o", tmp_path / "out")
    assert "between 2 and 6" in refuse(*command, "--cross-validate", 1)
    assert "too short for 3 parts" in refuse(*command, "--cross-validate", 3)


@pytest.mark.slow
def test_a_site_without_sigmas_has_nothing_to_calibrate(
    recorded: tuple[Path, SimulatedLog], tmp_path: Path, refuse: Refuse
) -> None:
    known = badly_surveyed(scale=0.0)
    imu = replace(known.platform.imu, time_offset_sigma=0.0)
    save_site(replace(known, platform=replace(known.platform, imu=imu)), tmp_path / "site.yaml")
    findings = refuse(
        *("calibrate", "log", recorded[0], "--site", tmp_path / "site.yaml"),
        *("-o", tmp_path / "out", "--end", 8),
    )
    assert "no parameter can be calibrated" in findings
