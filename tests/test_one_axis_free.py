"""A coil of one axis without an IMU: it is followed, and its roll is told to be open."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import one_axis_free as scenario
import pytest
from conftest import run_command
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.preintegration import across_held
from magfusion.estimation.measurements.fixed_roll import held_roll, without_roll
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.one_axis import (
    ANY_ROLL,
    axis_of,
    coil_lever,
    opened_poses,
    opened_state,
    roll_is_open,
)
from magfusion.model.platform_motion import HeldModel
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.without_imu import as_declared, on_motion_prior


@pytest.fixture(scope="module")
def site() -> Site:
    return scenario.run_free()


def turning(count: int) -> Trajectory:
    rng = np.random.default_rng(6)
    steps = Rotation.from_rotvec(0.2 * rng.standard_normal((count, 3))).as_matrix()
    turn = [Rotation.random(rng=rng).as_matrix()]
    for step in steps[1:]:
        turn.append(turn[-1] @ step)
    return Trajectory(np.arange(float(count)), np.array(turn), rng.standard_normal((count, 3)))


def test_states_without_roll_have_their_coil_where_it_was(site: Site) -> None:
    states, sensor = turning(30), site.platform.magnetometer
    axis, lever = axis_of(sensor), coil_lever(sensor)
    result = without_roll(states, site)
    for value, other in (
        (states.world_from_body @ axis, result.world_from_body @ axis),
        (
            states.position_world + states.world_from_body @ lever,
            result.position_world + result.world_from_body @ lever,
        ),
    ):
        np.testing.assert_allclose(value, other, atol=1e-12)
    step = np.swapaxes(result.world_from_body[:-1], 1, 2) @ result.world_from_body[1:]
    np.testing.assert_allclose(Rotation.from_matrix(step).as_rotvec() @ axis, 0.0, atol=1e-12)
    again = without_roll(result, site)  # whatever roll it began with
    np.testing.assert_allclose(again.world_from_body, result.world_from_body, atol=1e-12)
    assert held_roll(site, result).world_from_body.shape == (1, 3, 3)


def test_without_signs_no_state_turns_round(site: Site) -> None:
    states, axis = turning(30), axis_of(site.platform.magnetometer)
    across = np.linalg.svd(axis[None])[2][1]
    rotated = states.world_from_body.copy()
    rotated[::3] = rotated[::3] @ Rotation.from_rotvec(np.pi * across).as_matrix()
    result = without_roll(replace(states, world_from_body=rotated), site, signed=False)
    towards = result.world_from_body @ axis
    assert np.min(np.sum(towards[1:] * towards[:-1], axis=1)) > 0.0
    assert towards[0, 2] > 0.0
    line = np.abs(np.sum(towards * (states.world_from_body @ axis), axis=1))
    np.testing.assert_allclose(line, 1.0)


def test_an_open_roll_covers_the_body_anywhere_on_its_circle(site: Site) -> None:
    sensor = site.platform.magnetometer
    axis, lever = axis_of(sensor), coil_lever(sensor)
    opened = opened_poses(site, 1e-8 * np.eye(6))
    assert axis @ opened[:3, :3] @ axis == pytest.approx(ANY_ROLL**2, rel=1e-6)
    rolls = np.random.default_rng(1).uniform(-np.pi, np.pi, 2000)
    rotated = Rotation.from_rotvec(rolls[:, None] * axis).as_matrix()
    shift = lever - rotated @ lever
    mean = np.mean(np.einsum("ni,ij,nj->n", shift, np.linalg.inv(opened[3:, 3:]), shift))
    assert mean < 3.0
    assert np.linalg.eigvalsh(opened[3:, 3:])[0] < 1e-7  # along the coil the place is known


def test_the_rate_of_an_open_roll_is_that_of_central_differences(site: Site) -> None:
    sensor, turn, step = site.platform.magnetometer, turning(1).world_from_body[0], 1e-5
    axis, lever = axis_of(sensor), coil_lever(sensor)
    bias, coil = np.array([0.3, -0.5, 0.2]), np.array([1.0, 2.0, 3.0])

    def reported(angle: float) -> np.ndarray:
        """Velocity of the body and bias, of a coil that moves as it does, after a roll."""
        roll = Rotation.from_rotvec(angle * axis).as_matrix()
        own = roll.T @ bias
        return np.concatenate([coil - turn @ roll @ np.cross(-own, lever), own])

    slope = (reported(step) - reported(-step)) / (2.0 * step)
    opened = opened_state(site, np.zeros((15, 15)), turn, bias, 0.0)
    rows = [6, 7, 8, 12, 13, 14]
    result = opened[np.ix_(rows, rows)]
    np.testing.assert_allclose(result, ANY_ROLL**2 * np.outer(slope, slope), atol=1e-8)


def test_the_prior_has_no_rate_about_the_coil(site: Site) -> None:
    fixed, axis = on_motion_prior(site), axis_of(site.platform.magnetometer)
    imu = fixed.platform.imu
    assert isinstance(imu, HeldModel)
    cov = across_held(9.0 * np.eye(3), imu)
    assert axis @ cov @ axis < 1e-6
    assert np.trace(cov) == pytest.approx(18.0)
    assert roll_is_open(fixed)
    assert as_declared(fixed).platform == site.platform
    whole = replace(site.platform.magnetometer, axes="xyz")
    other = replace(site, platform=replace(site.platform, magnetometer=whole))
    assert not isinstance(on_motion_prior(other).platform.imu, HeldModel)
    assert not roll_is_open(other)


@pytest.mark.slow
def test_smooth_says_that_the_roll_is_open(site: Site, tmp_path: Path) -> None:
    write_log(scenario.moved(site, 5, 1.5), tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("smooth", tmp_path / "log", "-o", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert "roll_open" in json.dumps(report)
    assert report["open_directions"] == ["roll about the axis"]
    assert report["nees_mean"] < 15.0
    assert report["attitude_rmse_deg"] < 2.0  # of the direction


@pytest.mark.slow
def test_a_coil_is_followed_without_an_imu() -> None:
    rows, faults = scenario.rows_of(1, 9.0)
    assert not faults
    assert not scenario.faults_of(rows)
