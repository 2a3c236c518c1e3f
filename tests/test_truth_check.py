"""A truth that is wrong is told from gyroscope and gravity, with the cause; a right one is not."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.truth import truth_findings
from magfusion.files.log import write_log
from magfusion.files.trajectory_table import write_trajectory
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

Change = Callable[[Rotation], Rotation]
NED_FROM_ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
TURN = Rotation.from_euler("xyz", [20.0, 30.0, 40.0], degrees=True)


@pytest.fixture(scope="module", params=["walk", "turn"])
def recorded(request: pytest.FixtureRequest) -> Log:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, motion=request.param)
    return simulate_log(demo_site(), config, np.random.default_rng(3)).log


def _with_attitude(log: Log, change: Change) -> Log:
    truth = log.truth
    assert truth is not None
    attitude = change(truth.rotation).as_matrix()
    return replace(log, truth=Trajectory(truth.time, attitude, truth.position_world))


def _misread(attitude: Rotation) -> Rotation:
    return Rotation.from_quat(attitude.as_quat(scalar_first=True), scalar_first=False)


def _misread_otherwise(attitude: Rotation) -> Rotation:
    return Rotation.from_quat(attitude.as_quat(scalar_first=False), scalar_first=True)


def _frozen(attitude: Rotation) -> Rotation:
    return Rotation.concatenate([attitude[0]] * len(attitude))


def _partly_frozen(attitude: Rotation) -> Rotation:
    half = len(attitude) // 2
    return Rotation.concatenate([attitude[:half], *[attitude[half]] * (len(attitude) - half)])


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (_misread, "w, x, y, z read as x, y, z, w"),
        (_misread_otherwise, "x, y, z, w read as w, x, y, z"),
        (lambda r: r.inv(), "body_from_world"),
        (_frozen, "frozen in 100 %"),
        (_partly_frozen, "is frozen in"),
        (lambda r: NED_FROM_ENU * r * FRD_FROM_FLU, "is north, east, down and its body forward"),
        (lambda r: r * FRD_FROM_FLU, "its body axes are forward, right, down"),
        (lambda r: Rotation.identity(len(r)), "never rotates, .* positions alone"),
        (lambda r: NED_FROM_ENU * r, "points down"),
        (
            lambda r: TURN * r,
            r"vertical of its world is turned by 3[56] deg",
        ),  # acos(cos 20 cos 30)
        (lambda r: r * TURN, "body axes are turned against the IMU's by 49 deg"),
    ],
)
def test_a_wrong_truth_is_reported_with_its_cause(
    recorded: Log, change: Change, cause: str
) -> None:
    (finding,) = truth_findings(_with_attitude(recorded, change))
    assert finding.code == "truth_inconsistent"
    assert re.search(cause, finding.text)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda r: r, ""),
        (lambda r: NED_FROM_ENU * r * FRD_FROM_FLU, "is north, east, down and its body forward"),
        (lambda r: r * FRD_FROM_FLU, "points down"),  # of a body that never turns
        (lambda r: Rotation.from_euler("x", 30.0, degrees=True) * r, "turned by 30 deg"),
    ],
)
def test_a_truth_in_ned_is_recognised_without_a_rotation(
    recorded: Log, change: Change, cause: str
) -> None:
    still = Rotation.from_euler("xyz", [6.0, -9.0, 40.0], degrees=True)
    force = np.tile(still.inv().apply([0.0, 0.0, 9.81]), (len(recorded.imu), 1))
    imu = ImuSamples(recorded.imu.time, np.zeros_like(force), force)
    log = _with_attitude(recorded, lambda r: change(Rotation.concatenate([still] * len(r))))
    assert log.truth is not None
    truth = replace(log.truth, position_world=np.full_like(log.truth.position_world, np.nan))
    texts = [finding.text for finding in truth_findings(replace(log, imu=imu, truth=truth))]
    assert len(texts) == bool(cause)
    assert all(cause in text for text in texts)


@pytest.mark.parametrize("late", [0.15, -0.06, 0.6])
def test_a_late_truth_is_reported_with_its_delay(recorded: Log, late: float) -> None:
    truth = recorded.truth
    assert truth is not None
    poses = replace(truth, time=truth.time + late)
    (finding,) = truth_findings(replace(recorded, truth=poses))
    word = "late" if late > 0.0 else "early"
    found = re.search(rf"(\d+) ms {word}", finding.text)
    assert found is not None
    assert abs(1e-3 * float(found[1]) - abs(late)) < 0.003
    assert f"--offset truth={'-' if late > 0.0 else '0.'}" in finding.text


@pytest.mark.parametrize("axis", range(3))
def test_mirrored_positions_are_reported(recorded: Log, axis: int) -> None:
    truth = recorded.truth
    assert truth is not None
    mirrored = truth.position_world * np.where(np.arange(3) == axis, -1.0, 1.0)
    poses = Trajectory(truth.time, truth.world_from_body, mirrored)
    (finding,) = truth_findings(replace(recorded, truth=poses))
    assert f"mirrored along {'xyz'[axis]}" in finding.text


@pytest.mark.parametrize("every", [1, 20, 40])
def test_a_right_truth_of_any_rate_is_not_reported(recorded: Log, every: int) -> None:
    truth = recorded.truth
    assert truth is not None
    thin = Trajectory(
        truth.time[::every], truth.world_from_body[::every], truth.position_world[::every]
    )
    assert not list(truth_findings(replace(recorded, truth=thin)))


def test_a_gap_of_the_imu_is_no_contradiction(recorded: Log) -> None:
    kept = (recorded.imu.time < 5.0) | (recorded.imu.time > 15.0)
    imu = recorded.imu
    cut = ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept])
    assert not list(truth_findings(replace(recorded, imu=cut)))


def test_a_turn_of_the_world_about_the_vertical_is_not_seen(recorded: Log) -> None:
    heading = Rotation.from_euler("z", 50.0, degrees=True)
    assert not list(truth_findings(_with_attitude(recorded, lambda r: heading * r)))


def test_check_and_evaluate_report_a_wrong_truth(
    recorded: Log, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_log(_with_attitude(recorded, _misread), tmp_path / "log")
    run_command("check", tmp_path / "log")
    shown = capfd.readouterr().out
    assert "TRUSTWORTHY" in shown  # no truth is used for the verdict
    assert "quaternion is in another order" in shown
    run_command("evaluate", tmp_path / "log" / "truth.parquet", tmp_path / "log")
    assert "quaternion is in another order" in capfd.readouterr().out
    assert recorded.truth is not None
    write_trajectory(recorded.truth, tmp_path / "estimate.parquet", recorded.epoch_ns)
    run_command("evaluate", tmp_path / "estimate.parquet", tmp_path / "log")
    assert capfd.readouterr().out.count("quaternion is in another order") == 1
