"""A magnet on a shaft in the jobs for a platform that moves: used, or refused with the remedy."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command

from magfusion.errors import InputError
from magfusion.files.log import read_log, write_log
from magfusion.jobs.stream import StreamSettings, run_stream

SITE = """magfusion_site: 1
world: {model_error: 0.005}
beacons:
- {name: bit, position_m: [0, 0, 0], rpy_deg: [0, 0, 0], frequency_hz: 8.0, synchronised: true,
   rotor: {moment_a_m2: 300.0}, sigma: {log_moment: 0.01}}
- {name: bot, position_m: [6, 0, 0], rpy_deg: [0, 40, 90], frequency_hz: 13.0, synchronised: true,
   rotor: {moment_a_m2: 300.0, tilt_deg: 3.0}, sigma: {log_moment: 0.01}}
platform:
  magnetometer: {noise_density_t_rthz: 2.0e-11}
  imu: {gyro_noise: 3.0e-4, accel_noise: 3.0e-3, gyro_bias_walk: 1.0e-5, accel_bias_walk: 1.0e-4,
        gyro_bias_sigma: 5.0e-3, accel_bias_sigma: 0.05}
"""
NAMES = ("bit", "bot")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log of six seconds among two magnets that turn, with their encoders."""
    place = tmp_path_factory.mktemp("rotor")
    (place / "site.yaml").write_text(SITE)
    run_command(
        *("simulate", "--site", place / "site.yaml", "-o", place / "log", "--seed", 1),
        *("--duration", 6, "--box=2,4,2,4,1,2"),
    )
    return place / "log"


def _unmeasured(walk: Path, place: Path, *, synchronised: bool) -> Path:
    log = read_log(walk)
    log_without = type(log)(log.name, log.epoch_ns, log.source, log.imu, log.waveform)
    write_log(log_without, place / "log")
    text = SITE if synchronised else SITE.replace("synchronised: true", "synchronised: false")
    (place / "log" / "site.yaml").write_text(text)
    return place / "log"


def test_the_simulators_magnets_turn_at_speeds_that_drift(walk: Path) -> None:
    log = read_log(walk)
    assert log.rotation is not None
    assert set(log.rotation.angle) == set(NAMES)
    for name, nominal_hz in zip(NAMES, (8.0, 13.0), strict=True):
        turns = np.diff(np.unwrap(log.rotation.angle[name])[[0, -1]])[0] / (2.0 * np.pi)
        speed_hz = turns / np.ptp(log.rotation.time)
        assert 1e-3 < abs(speed_hz - nominal_hz) < 0.5  # it drifts


@pytest.mark.slow
def test_by_their_encoders_a_platform_is_smoothed(walk: Path, tmp_path: Path) -> None:
    run_command("smooth", walk, "-o", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["nees_mean"] < 12.0
    assert report["verdict"] != "failed"


@pytest.mark.parametrize("job", ["smooth", "navigate", "fix", "demodulate"])
def test_a_rotor_whose_angle_nobody_tells_is_not_taken_for_a_clock(
    job: str, walk: Path, tmp_path: Path, refuse: Refuse
) -> None:
    log = _unmeasured(walk, tmp_path, synchronised=True)
    assert "rotor_bit" in refuse(job, log, "-o", tmp_path / "out")


@pytest.mark.parametrize("job", ["smooth", "navigate"])
def test_a_phase_that_wanders_is_of_each_epoch_alone(
    job: str, walk: Path, tmp_path: Path, refuse: Refuse
) -> None:
    log = _unmeasured(walk, tmp_path, synchronised=False)
    assert "magfusion fix" in refuse(job, log, "-o", tmp_path / "out")


def test_epochs_alone_are_fixed_without_an_angle(walk: Path, tmp_path: Path) -> None:
    log = _unmeasured(walk, tmp_path, synchronised=False)
    run_command("fix", log, "-o", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] != "failed"


def test_a_stream_without_the_angles_is_refused_when_they_are_missed(tmp_path: Path) -> None:
    (tmp_path / "site.yaml").write_text(SITE)
    times = np.arange(0.0, 3.0, 0.05)
    records = [
        json.dumps({"magnetometer": {"time": [t], "field": [[1e-9, 2e-9, 3e-9]]}}) for t in times
    ]
    source = io.BytesIO("\n".join(records).encode())
    with pytest.raises(InputError, match="drive_bit"):
        run_stream(tmp_path / "site.yaml", StreamSettings(), source, io.BytesIO(), io.StringIO())
    free_parameters = SITE.replace("synchronised: true", "synchronised: false")
    (tmp_path / "site.yaml").write_text(free_parameters)
    with pytest.raises(InputError, match="cosine of its angle"):
        run_stream(tmp_path / "site.yaml", StreamSettings(), source, io.BytesIO(), io.StringIO())


@pytest.mark.parametrize("job", ["smooth", "navigate", "fix", "demodulate", "coverage"])
def test_of_wells_each_job_names_the_one_that_ranges(
    job: str, walk: Path, tmp_path: Path, refuse: Refuse
) -> None:
    first = SITE.index("- {name: bot")
    text = SITE[:first] + SITE[SITE.index("platform:") :]
    text = text.replace("position_m: [0, 0, 0], rpy_deg: [0, 0, 0]", "unknown: pose", 1)
    (tmp_path / "bit.yaml").write_text(text)
    where = (
        (tmp_path / "bit.yaml",) if job == "coverage" else (walk, "--site", tmp_path / "bit.yaml")
    )
    assert "magfusion range" in refuse(job, *where, "-o", tmp_path / "out")
