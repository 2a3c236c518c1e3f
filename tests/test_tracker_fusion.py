"""A tracker in time slots with an IMU: smoothed, filtered, and by the ordinary commands."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tracker_motion_skew as moving
from conftest import run_command
from time_slots_and_mains import tracker

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.files.tum import read_tum
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.field import phasors_world, synchronised_drives
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import Rests, turning_motion
from magfusion.simulation.waveform import simulate_waveform

SLOTS = Slots(5e-3, 4)


def _check(fused: moving.Fused) -> None:
    assert fused.smoothed_deg < fused.snapshot_deg / 3.0
    assert fused.filtered_deg < fused.snapshot_deg / 3.0
    assert fused.smoothed_mm < fused.snapshot_mm / 3.0
    assert fused.filtered_mm < fused.snapshot_mm / 3.0


@pytest.mark.slow
def test_with_an_imu_a_turning_head_is_known_three_times_better_than_by_the_closed_form() -> None:
    fused = moving.fuse(moving.Config(duration=4.5), 500.0)
    assert fused.rate_deg_s > 70.0
    _check(fused)


@pytest.mark.slow
def test_so_it_is_at_another_rate_of_the_imu() -> None:
    fused = moving.fuse(moving.Config(duration=8.0, seed=3), imu_rate_hz=1000.0)
    assert fused.rate_deg_s > 85.0
    _check(fused)


def _noiseless(duration: float, rate_hz: float = 1000.0) -> tuple[Site, Log, Any]:
    """Return slots without noise, of a head that turns at up to 100 deg/s, and its motion."""
    site = tracker(1e4, SLOTS)
    rests = Rests(start=0.3, move=duration)
    rng = np.random.default_rng(5)
    motion = turning_motion(rng, duration, moving.BOX_WORLD, 0.3, rate_rms=1.8, rests=rests)
    quiet = replace(
        site.platform.imu,
        gyro_noise=1e-12,
        accel_noise=1e-12,
        gyro_bias_sigma=0.0,
        accel_bias_sigma=0.0,
        gyro_bias_walk=0.0,
        accel_bias_walk=0.0,
    )
    imu = simulate_imu(motion, quiet, site.gravity, rate_hz, duration, rng).samples
    number = np.arange(int(duration / SLOTS.duration) - 1)
    number = number[number % SLOTS.count != 3]
    time = (number + 0.5) * SLOTS.duration
    at, rows, channel = motion.trajectory(time), np.arange(len(time)), number % SLOTS.count
    field_world = phasors_world(site.beacons[0], at.position_world)[rows, channel]
    phasor = np.full((len(time), 3, 3), np.nan, dtype=np.complex128)
    phasor[rows, channel] = (field_world[:, None] @ at.world_from_body)[:, 0]
    cov = np.full((len(time), 3, 3, 3), np.nan)
    cov[rows, channel] = 1e-22 * np.eye(3)  # (10 fT)^2: the fields are exact
    fields = FieldSamples(time, np.full(len(time), SLOTS.duration), site.channels, phasor, cov)
    return (
        site,
        Log("exact", 0, "simulation", imu, None, fields, motion.trajectory(imu.time)),
        motion,
    )


@pytest.mark.parametrize(("imu_rate_hz", "left_deg"), [(1e3, 1e-4), (4e3, 1e-6)])
def test_the_smoother_has_no_skew(imu_rate_hz: float, left_deg: float) -> None:
    """What is left is of the inertial stream, which is sampled where the motion is smooth."""
    site, log, motion = _noiseless(2.0, imu_rate_hz)
    rate_deg_s = np.rad2deg(np.linalg.norm(motion.rate_body(log.imu.time), axis=1))
    assert np.max(rate_deg_s) > 90.0
    result = smooth(log, replace(site, model_error=0.0)).states
    assert log.fields is not None
    assert len(result) == len(log.fields)
    assert log.truth is not None
    errors = trajectory_errors(result, log.truth)
    assert errors.attitude_rmse_deg < left_deg
    assert errors.ate < 1e-6


def test_loose_coupling_takes_a_cycle_for_an_epoch() -> None:
    site, log, _ = _noiseless(2.0)
    loose = smooth(log, site, SmootherSettings(coupling="loose"))
    assert log.fields is not None
    assert len(loose.states) == len(log.fields) // 3
    assert log.truth is not None
    assert trajectory_errors(loose.states, log.truth).attitude_rmse_deg < 0.2


def _recorded(path: Path, carrier_hz: float, duration: float = 3.0) -> Path:
    """Write a log of a slotted tracker, with its waveform and site."""
    site = tracker(carrier_hz, SLOTS, density=1e-10)
    site = replace(site, earth_field_world=np.array([0.0, 2e-5, -5e-5]))
    rng = np.random.default_rng(8)
    motion = turning_motion(rng, duration, moving.BOX_WORLD, 0.2, rate_rms=0.5, rests=Rests(0.5))
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 500.0, duration, rng).samples
    drives = synchronised_drives(site)
    waveform = simulate_waveform(motion, site, drives, 8e3, duration, rng)
    truth = motion.trajectory(imu.time)
    write_log(
        Log("tracker", 1_700_000_000_000_000_000, "simulation", imu, waveform, None, truth), path
    )
    save_site(site, path / "site.yaml")
    return path


def _figures(directory: Path) -> dict[str, Any]:
    result = json.loads((directory / "report.json").read_text())
    assert isinstance(result, dict)
    return result


@pytest.mark.slow
@pytest.mark.parametrize("carrier_hz", [0.0, 2e3])
def test_the_ordinary_commands_read_a_slotted_tracker(tmp_path: Path, carrier_hz: float) -> None:
    log = _recorded(tmp_path / "log", carrier_hz)
    run_command("demodulate", log, "-o", tmp_path / "phasors")
    fields = read_log(tmp_path / "phasors").fields
    assert fields is not None
    assert len(fields) == 450
    assert np.all(np.sum(fields.valid, axis=1) == 1)
    run_command("fix", log, "-o", tmp_path / "fixes")
    run_command("smooth", log, "-o", tmp_path / "run")
    run_command("smooth", tmp_path / "phasors", "-o", tmp_path / "again")
    fixed, smoothed, again = (_figures(tmp_path / name) for name in ("fixes", "run", "again"))
    assert fixed["epochs"] == 150
    assert smoothed["epochs"] == again["epochs"] == 450
    assert smoothed["attitude_rmse_deg"] < 0.5 * fixed["attitude_rmse_deg"]
    assert again["attitude_rmse_deg"] < 0.5 * fixed["attitude_rmse_deg"]
    assert smoothed["inside_3_sigma"] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("carrier_hz", [0.0, 2e3])
def test_raw_slots_navigate_as_well_as_the_phasors_of_the_whole_log(
    tmp_path: Path, carrier_hz: float
) -> None:
    log = _recorded(tmp_path / "log", carrier_hz, 8.0)
    run_command("demodulate", log, "-o", tmp_path / "phasors")
    run_command("smooth", log, "-o", tmp_path / "smoothed")
    for built, name in ((log, "raw"), (tmp_path / "phasors", "known")):
        run_command("navigate", built, "--estimator", "ekf", "-o", tmp_path / name)
    recorded = read_log(log)
    assert recorded.truth is not None
    # The two may begin at other times, and settle from there.
    result = []
    for name in ("raw", "known"):
        states = read_tum(tmp_path / name / "trajectory.tum", recorded.epoch_ns)
        late = states.time > 5.0
        parts = states.time, states.world_from_body, states.position_world
        result.append(trajectory_errors(Trajectory(*(p[late] for p in parts)), recorded.truth))
    raw, known = result
    # A state comes with the end of a cycle, of all its slots.
    assert 3 * len(raw.time) > 0.9 * len(known.time)
    assert raw.attitude_rmse_deg < 1.15 * known.attitude_rmse_deg
    assert raw.ate < 1.15 * known.ate
    assert _figures(tmp_path / "raw")["inside_3_sigma"] > 0.97
    assert raw.attitude_rmse_deg < 4.0 * _figures(tmp_path / "smoothed")["attitude_rmse_deg"]
