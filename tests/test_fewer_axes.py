"""Receivers that lack components: what is missing counts as nothing, and is no zero."""

from dataclasses import replace
from pathlib import Path

import fewer_axes as scenario
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import Refuse
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.samples import frozen_samples
from magfusion.estimation.snapshot.coil_gain import with_found_gain
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.model.noise import measurement_cov, whitening
from magfusion.model.parameters import initial_calibration
from magfusion.model.platform_motion import MotionPrior
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.receivers import receiver_of
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    SimulatedLog,
    SimulationConfig,
    simulate_fields,
    simulate_log,
)

SIGMA = 2e-11  # T


def with_axes(site: Site, axes: str) -> Site:
    sensor = replace(site.platform.magnetometer, axes=axes)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def poses(count: int) -> Trajectory:
    rng = np.random.default_rng(3)
    place = rng.uniform(DEMO_BOX_WORLD[0], DEMO_BOX_WORLD[1], (count, 3))
    turn = Rotation.random(count, rng).as_matrix()
    place[-1], turn[-1] = place[-2], turn[-2]
    return Trajectory(0.1 * np.arange(count), turn, place)


def seen(site: Site, truth: Trajectory, sigma: float = SIGMA) -> FieldSamples:
    return simulate_fields(site, truth, sigma, np.random.default_rng(1))


def angles(result: np.ndarray, true: np.ndarray) -> np.ndarray:
    turn = np.swapaxes(result, 1, 2) @ true
    return np.asarray(Rotation.from_matrix(turn).magnitude())


def test_the_whitening_is_that_of_the_components_that_are_there() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3))
    cov = np.broadcast_to(root @ root.T, (3, 3, 3)).copy()
    there = np.array([[True, False, True], [True, True, True], [False, False, False]])
    cov[0, 1], cov[0, :, 1] = 1e9, 1e9
    result = whitening(cov, there)
    information = np.swapaxes(result, 1, 2) @ result
    own = np.ix_([0, 2], [0, 2])
    np.testing.assert_allclose(information[0][own], np.linalg.inv((root @ root.T)[own]))
    assert not information[0][1].any()
    np.testing.assert_allclose(information[1], np.linalg.inv(root @ root.T))
    assert not information[2].any()


def test_the_models_error_of_one_axis_is_that_of_the_whole_field() -> None:
    site, truth = replace(demo_site(), model_error=0.01), poses(6)
    lever = site.platform.magnetometer.position_body
    place = truth.position_world + truth.world_from_body @ lever
    whole = measurement_cov(site, seen(site, truth), sensor_world=place[:, None])
    one = measurement_cov(site, seen(with_axes(site, "z"), truth), sensor_world=place[:, None])
    np.testing.assert_allclose(one[..., 2, 2], whole[..., 2, 2], rtol=0.1)


@pytest.mark.parametrize("axes", ["xy", "yz"])
def test_two_axes_give_the_pose_and_equal_epochs_equal_ones(axes: str) -> None:
    site, truth = with_axes(demo_site(), axes), poses(4)
    samples = seen(site, truth, 1e-13)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0))
    assert fixes.determined[:, 0].all()
    np.testing.assert_allclose(fixes.position_world[:, 0], truth.position_world, atol=1e-4)
    assert angles(fixes.world_from_body[:, 0], truth.world_from_body).max() < 1e-4
    np.testing.assert_allclose(fixes.position_world[-1], fixes.position_world[-2], atol=1e-5)


def test_one_axis_gives_the_place_of_its_coil_and_its_direction_and_leaves_the_roll() -> None:
    site, truth = with_axes(demo_site(), "z"), poses(4)
    samples = seen(site, truth, 1e-14)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0))
    assert not fixes.determined[:, 0].any()
    sensor = site.platform.magnetometer
    true = truth.position_world + truth.world_from_body @ sensor.position_body
    coil = fixes.position_world + fixes.world_from_body @ sensor.position_body
    nearest = np.argmin(np.linalg.norm(coil - true[:, None], axis=2), axis=1)
    rows = np.arange(len(true))
    np.testing.assert_allclose(coil[rows, nearest], true, atol=2e-3)
    axis = sensor.body_from_sensor[:, 2]
    result = fixes.world_from_body[rows, nearest] @ axis
    np.testing.assert_allclose(result, truth.world_from_body @ axis, atol=5e-3)
    np.testing.assert_allclose(
        fixes.world_from_body[-1, 0], fixes.world_from_body[-2, 0], atol=1e-3
    )


def test_a_component_that_is_missing_once_costs_its_rows_alone() -> None:
    site, truth = demo_site(), poses(6)
    samples = seen(site, truth)
    gap = samples.phasor_sensor.copy()
    gap[2, :, 1] = np.nan  # an axis of an epoch, and one of a channel
    gap[4, 0, 0] = np.nan
    fixes = fix_epochs(replace(samples, phasor_sensor=gap), initial_calibration(site, 0.0))
    whole = fix_epochs(samples, initial_calibration(site, 0.0))
    np.testing.assert_allclose(fixes.position_world[:, 0], truth.position_world, atol=2e-3)
    others = [0, 1, 3, 5]
    np.testing.assert_allclose(fixes.pose_cov[others, 0], whole.pose_cov[others, 0], atol=1e-11)
    size = np.linalg.slogdet(fixes.pose_cov[:, 0])[1] - np.linalg.slogdet(whole.pose_cov[:, 0])[1]
    assert (size[[2, 4]] > 0.01).all()


@pytest.fixture(scope="module")
def simulated() -> SimulatedLog:
    """Raw samples of all three axes, of a platform that walks."""
    config = SimulationConfig(box_world=DEMO_BOX_WORLD, duration=4.0, perturb=False)
    return simulate_log(demo_site(), config, np.random.default_rng(5))


def lacking(log: Log, axes: str) -> Log:
    assert log.waveform is not None
    own = np.array([axis in axes for axis in "xyz"])
    measured = np.where(own, log.waveform.measured_sensor, 0.0)
    return replace(log, waveform=replace(log.waveform, measured_sensor=measured, axes=axes))


def test_raw_samples_of_fewer_axes_become_phasors_of_these(
    simulated: SimulatedLog, tmp_path: Path
) -> None:
    site, axes = demo_site(), "xz"
    write_log(lacking(simulated.log, axes), tmp_path / "log")
    assert "field_y" not in pq.read_schema(tmp_path / "log" / "magnetometer.parquet").names
    log = read_log(tmp_path / "log")
    assert log.waveform is not None
    assert log.waveform.axes == axes
    _, whole = receiver_of(site).whole(log.waveform, log.imu)
    _, result = receiver_of(with_axes(site, axes)).whole(log.waveform, log.imu)
    assert result.axes == axes
    assert np.isnan(result.phasor_sensor[..., 1]).all()
    sensor, truth = site.platform.magnetometer, simulated.motion.trajectory(result.time)
    assert len(whole) == len(result)
    true = simulate_fields(site, truth, 0.0, np.random.default_rng(0)).phasor_sensor
    own = [0, 2]
    error = np.abs(result.phasor_sensor - true)[..., own]
    sigma = np.sqrt(result.phasor_cov[..., own, own])
    assert sensor.lacking == ()
    assert np.mean(error**2 / sigma**2) < 4.0  # two parts, each of variance one at most


def test_an_axis_that_is_not_there_is_no_dead_one(simulated: SimulatedLog) -> None:
    assert not list(frozen_samples(lacking(simulated.log, "z"), with_axes(demo_site(), "z")))
    dead = lacking(simulated.log, "z")
    assert dead.waveform is not None
    dead = replace(dead, waveform=replace(dead.waveform, axes="xyz"))
    assert list(frozen_samples(dead, demo_site()))


def test_what_does_not_fit_the_declared_axes_is_refused(
    simulated: SimulatedLog, tmp_path: Path, refuse: Refuse
) -> None:
    log = tmp_path / "log"
    write_log(lacking(simulated.log, "xz"), log)
    save_site(demo_site(), log / "site.yaml")
    findings = refuse("smooth", log, "-o", tmp_path / "run")
    assert "the magnetometer of" in findings
    assert "have x, z; declare the axes of the receiver" in findings
    save_site(with_axes(demo_site(), "xz"), log / "site.yaml")
    findings = refuse("survey", log, "--poses", log / "site.yaml", "-o", tmp_path / "run")
    assert findings


def test_half_a_component_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    site, truth = demo_site(), poses(4)
    log = Log("few", 0, "test", ImuSamples.empty(), fields=seen(site, truth))
    write_log(log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    path = tmp_path / "log" / "fields.parquet"
    table = pq.read_table(path)
    column = table.column_names.index("im_y")
    value = table["im_y"].to_numpy().copy()
    value[2] = np.nan
    pq.write_table(table.set_column(column, "im_y", pa.array(value)), path)
    assert "write both of re_y, im_y" in refuse("fix", tmp_path / "log", "-o", tmp_path / "run")


def test_the_gain_of_a_coil_is_found_where_it_is_not_declared() -> None:
    site, truth = with_axes(demo_site(), "z"), poses(7)
    platform = site.platform
    stronger = replace(platform.magnetometer, matrix=2.7 * np.eye(3))
    samples = seen(replace(site, platform=replace(platform, magnetometer=stronger)), truth)
    sensor = with_found_gain(samples, site).platform.magnetometer
    assert abs(sensor.matrix[2, 2] - 2.7) < 4.0 * sensor.sigma.matrix[2, 2]
    assert sensor.sigma.matrix[2, 2] < 0.3
    np.testing.assert_array_equal(sensor.matrix[:2], np.eye(3)[:2])


def test_what_one_axis_cannot_do_is_refused(
    simulated: SimulatedLog, tmp_path: Path, refuse: Refuse
) -> None:
    log = tmp_path / "log"
    own = replace(lacking(simulated.log, "z"), imu=ImuSamples.empty(), inertial=False)
    write_log(own, log)
    site = with_axes(demo_site(), "z")
    prior = MotionPrior(2.0, 3.0)
    save_site(replace(site, platform=replace(site.platform, motion_prior=prior)), log / "site.yaml")
    findings = refuse("coverage", log / "site.yaml", "-o", tmp_path / "run")
    assert "is [z], but this job requires all three axes" in findings
    save_site(demo_site(), tmp_path / "whole.yaml")
    write_log(simulated.log, tmp_path / "whole")
    findings = refuse(
        *("smooth", tmp_path / "whole", "--site", tmp_path / "whole.yaml"),
        *("--free", "gain", "-o", tmp_path / "run"),
    )
    assert "is the common gain of a receiver of one axis" in findings
    assert "smooth estimates gain only" in refuse("smooth", log, "--free", "phase", "-o", log)


@pytest.mark.slow
def test_errors_of_fewer_axes_are_consistent() -> None:
    assert not scenario.faults_of(scenario.rows_of(0, 12.0))
