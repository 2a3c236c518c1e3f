"""From a site's file to the range of two wells, by the command line alone."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from conftest import Refuse, run_command
from scipy.spatial.transform import Rotation

from magfusion.model.rotor import Harmonic, Rotor
from magfusion.simulation.shaft import Shaft, turned_moment
from magfusion.simulation.wells import TwoWells, lean_of

SITE = """magfusion_site: 1
world: {model_error: 0.001}
beacons:
- name: bit
  unknown: pose
  frequency_hz: 3.0
  synchronised: true
  rotor: {moment_a_m2: 300.0, length_m: 0.3, axis: [0, 0, 1], zero: [1, 0, 0]}
  sigma: {log_moment: 0.02}
platform:
  magnetometer: {noise_density_t_rthz: 2.0e-11, body_from_sensor: {position_m: [0.3, 0.0, 0.0]}}
  imu: {gyro_noise: 3.0e-4, accel_noise: 3.0e-3, gyro_bias_walk: 1.0e-5, accel_bias_walk: 1.0e-4,
        gyro_bias_sigma: 5.0e-3, accel_bias_sigma: 0.05}
"""
WELLS = "{distance_m: 8.0, apart_m: 4.0, reach_m: 8.0, speed_m_s: 0.2, high_side_deg: 200.0}"


def _site(directory: Path, text: str = SITE) -> Path:
    (directory / "bit.yaml").write_text(text)
    (directory / "wells.yaml").write_text(WELLS)
    return directory / "bit.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [True, False])
def test_a_site_alone_is_simulated_and_ranged(encoder: bool, tmp_path: Path) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    reported = () if encoder else ("--no-encoder",)
    wells = ("--wells", tmp_path / "wells.yaml")
    run_command("simulate", "--site", _site(tmp_path), *wells, "-o", log, "--seed", 7, *reported)
    names = pyarrow.parquet.read_schema(log / "magnetometer.parquet").names
    assert ("rotor_bit" in names) == encoder
    run_command("range", log, "-o", out)
    true, result = (json.loads((path / "report.json").read_text()) for path in (log, out))
    assert result["verdict"] == "trustworthy"
    assert (out / "range.png").read_bytes()[1:4] == b"PNG"
    assert "down the hole and by depth" in (out / "report.html").read_text()
    for k in (1, 2):
        for name in ("distance", "high_side", "abreast_depth"):
            unit = "deg" if name == "high_side" else "m"
            error = result[f"place_{k}_{name}_{unit}"] - true[f"place_{k}_{name}_{unit}"]
            assert abs(error) < 4.0 * result[f"place_{k}_{name}_sigma_{unit}"], name
    for name in ("leads_right", "leads_up"):
        error = result[f"{name}_deg"] - true[f"{name}_deg"]
        assert abs(error) < 4.0 * result[f"{name}_sigma_deg"], name


def test_wells_lead_apart_as_their_file_says() -> None:
    rng = np.random.default_rng(1)
    for right, up in rng.uniform(-0.7, 0.7, (20, 2)):
        wells = TwoWells(9.0, 1.0, 0.3, lean_of(right, up), 0.2, 1.0, 4.0, 8.0, 0.1)
        np.testing.assert_allclose(wells.leads(), (right, up), atol=1e-12)
        axis = Rotation.random(random_state=rng).as_matrix()[0]
        for one in wells.transits_of(np.zeros(2), axis_beacon=axis):
            np.testing.assert_allclose(one.world_from_rotor @ axis, wells.along_world, atol=1e-12)
            assert np.linalg.det(one.world_from_rotor) == pytest.approx(1.0)


def test_a_harmonic_turns_as_often_as_it_says() -> None:
    part = Harmonic(5, np.array([0.0, 2.0, 1.0]), 0.4)
    rotor = Rotor(200.0, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), harmonics=(part,))
    angle = np.linspace(0.0, 6.0, 30)
    plain = Rotor(200.0, rotor.axis_beacon, rotor.zero_beacon)
    more = turned_moment(rotor, Shaft(), angle) - turned_moment(plain, Shaft(), angle)
    wave = np.cos(5.0 * angle + 0.4)[:, None] * part.moment_beacon
    np.testing.assert_allclose(more, wave, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "findings"),
    [
        (("--iron", 3), "--iron"),
        (("--motion", "turn"), "--motion"),
        (("--rate", 10.0, "--wells", "nowhere.yaml"), "nowhere.yaml"),
    ],
)
def test_what_does_not_go_with_a_well_is_refused(
    given: tuple[object, ...], findings: str, tmp_path: Path, refuse: Refuse
) -> None:
    assert findings in refuse("simulate", "--site", _site(tmp_path), *given, "-o", tmp_path / "log")


def test_wells_and_casings_are_of_a_rotor_that_is_to_be_found(
    tmp_path: Path, refuse: Refuse
) -> None:
    where = ("-o", tmp_path / "log")
    assert "--wells" in refuse("simulate", "--wells", tmp_path / "wells.yaml", *where)
    text = SITE.replace("unknown: pose", "position_m: [0, 0, 0]\n  rpy_deg: [0, 0, 0]")
    cased = text.replace("2.0e-11,", "2.0e-11, casing: {radius_m: 0.09, wall_m: 0.01},")
    assert "casing" in refuse("simulate", "--site", _site(tmp_path, cased), *where)
