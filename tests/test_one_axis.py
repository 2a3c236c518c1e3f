"""A receiver of one axis: its place and direction, by phasors or amplitudes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import one_axis_receiver as scenario
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import Refuse, run_command

from magfusion.estimation.snapshot.coil_fix import CoilFixes, Gain, _Problem, fix_coil
from magfusion.estimation.snapshot.coil_poses import (
    judged_poses,
    nearest_reported,
    nearest_truth,
    poses_of,
)
from magfusion.estimation.snapshot.coil_starts import CoilEpochs, at_point
from magfusion.files.site import load_site, save_site
from magfusion.model.coil_field import as_points
from magfusion.model.one_axis import least_turn
from magfusion.model.parameters import initial_calibration
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.units import Array

SIGMA = 1e-11  # T
PLACE = np.array([[0.05, -0.03, 0.25], [-0.1, 0.08, 0.15], [-0.1, 0.08, 0.15]])
AXIS = np.array([[0.6, 0.0, -0.8], [0.0, 0.8, 0.6], [0.0, 0.8, 0.6]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """Dipoles in the place of the coils, the receiver in front of them."""
    path = tmp_path_factory.mktemp("one_axis") / "site.yaml"
    path.write_text(scenario.site_text())
    declared = load_site(path)
    points = [as_points(replace(b, synchronised=True)) for b in declared.beacons]
    points[0] = replace(points[0], hemisphere_beacon=np.array([0.0, 0.0, 1.0]))
    return replace(declared, beacons=tuple(points))


def seen(site: Site, gain: float) -> Array:
    """Return what a coil measures of every beacon, by the dipole's formula alone."""
    fields = [
        [dipole_field(place - b.position_world, b.coils[0].moment_beacon) for b in site.beacons]
        for place in PLACE
    ]
    return np.asarray(gain * np.einsum("ncx,nx->nc", np.array(fields), AXIS))


def epochs(value: Array, *, signed: bool) -> CoilEpochs:
    measured = (value if signed else np.abs(value)).astype(np.complex128)
    return CoilEpochs(np.arange(3.0), measured, np.full(value.shape, SIGMA), signed)


@pytest.fixture(scope="module")
def result(site: Site) -> CoilFixes:
    own = epochs(seen(site, 3.1), signed=False)
    return fix_coil(own, initial_calibration(site, 0.0), Gain())


def test_amplitudes_of_unknown_gain_give_place_and_line(result: CoilFixes) -> None:
    np.testing.assert_allclose(result.position_world[:, 0], PLACE, atol=1e-5)
    across = np.cross(result.axis_world[:, 0], AXIS)
    np.testing.assert_allclose(across, np.zeros((3, 3)), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(result.axis_world[:, 0], axis=1), 3.1, rtol=1e-3)
    assert not np.isfinite(result.cost[:, 1:]).any()  # in front of the coils there is no other


def test_equal_epochs_have_equal_answers(result: CoilFixes, site: Site) -> None:
    fixes = poses_of(result, np.arange(3.0), site, signed=False)
    for part in (fixes.world_from_body, fixes.position_world, fixes.pose_cov):
        np.testing.assert_allclose(part[1, 0], part[2, 0], rtol=1e-7, atol=1e-12)


def test_the_roll_is_that_of_any(result: CoilFixes, site: Site) -> None:
    fixes = poses_of(result, np.arange(3.0), site, signed=False)
    sigma = np.sqrt(np.diagonal(fixes.pose_cov[:, 0], axis1=1, axis2=2))
    assert (sigma[:, 2] > 1.5).all()  # about z, the axis that it has
    assert (sigma[:, :2] < 0.01).all()
    assert not fixes.determined.any()


def test_signed_phasors_of_a_known_gain_tell_which_way_it_points(site: Site) -> None:
    own = epochs(seen(site, 1.0), signed=True)
    result = fix_coil(own, initial_calibration(site, 0.0), Gain(1.0, 0.01))
    np.testing.assert_allclose(result.position_world[:, 0], PLACE, atol=1e-5)
    np.testing.assert_allclose(result.axis_world[:, 0], AXIS, atol=1e-3)


@pytest.mark.parametrize("signed", [False, True])
def test_the_gradient_is_that_of_the_cost(site: Site, *, signed: bool) -> None:
    own = epochs(seen(site, 2.0), signed=signed)
    problem = _Problem(own, at_point(initial_calibration(site, 0.0)), Gain(2.0, 0.1))
    state = np.concatenate([PLACE[:1] + 0.01, 2.2 * AXIS[:1] + 0.1], axis=1)
    epoch, step = np.zeros(1, dtype=np.int64), 1e-6
    sigma = problem.sigma(epoch, state)
    sides = state + step * np.concatenate([np.eye(6), -np.eye(6)])
    many = np.zeros(12, dtype=np.int64)
    cost = problem.normal(many, sides, np.repeat(sigma, 12, axis=0)).cost
    slope = (cost[:6] - cost[6:]) / (4.0 * step)  # the gradient is half of it
    gradient = problem.normal(epoch, state, sigma).gradient[0]
    np.testing.assert_allclose(gradient, slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())


def test_errors_against_the_truth_leave_roll_and_sign_out(result: CoilFixes, site: Site) -> None:
    sensor = replace(site.platform.magnetometer, position_body=np.array([0.02, 0.03, -0.01]))
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    fixes = poses_of(result, np.arange(3.0), site, signed=False)
    best = fixes.best()
    turn = np.diag([1.0, -1.0, -1.0])  # the axis reversed, and another roll
    other = best.world_from_body @ turn
    coil = best.position_world + best.world_from_body @ sensor.position_body
    truth = Trajectory(best.time, other, coil - other @ sensor.position_body)
    separate = trajectory_errors(best, truth, max_gap=2.0)
    same = trajectory_errors(best, nearest_truth(truth, best, site, signed=False), max_gap=2.0)
    assert separate.ate > 0.01
    assert same.ate < 1e-9
    wide = np.sqrt(np.trace(fixes.pose_cov[:, 0, 3:, 3:], axis1=1, axis2=2))
    away = np.linalg.norm(separate.position_world, axis=1)
    assert (away < 3.0 * wide).all()  # the lever's part is in the covariance


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    built = tmp_path_factory.mktemp("one_axis") / "log"
    scenario.write_log(built, scenario.measured(PLACE, AXIS, np.random.default_rng(1)))
    return built


def copied(log: Path, simulation: Path, change: Callable[[pa.Table], pa.Table]) -> Path:
    simulation.mkdir()
    for name in ("log.yaml", "site.yaml"):
        (simulation / name).write_bytes((log / name).read_bytes())
    pq.write_table(change(pq.read_table(log / "fields.parquet")), simulation / "fields.parquet")
    return simulation


def test_a_site_keeps_the_axes_of_its_receiver(log: Path, tmp_path: Path) -> None:
    save_site(load_site(log / "site.yaml"), tmp_path / "site.yaml")
    assert load_site(tmp_path / "site.yaml").platform.magnetometer.axes == "z"


def test_other_jobs_refuse_it_in_a_sentence(log: Path, tmp_path: Path, refuse: Refuse) -> None:
    findings = refuse("demodulate", log, "-o", tmp_path / "run")
    assert findings
    findings = refuse("smooth", log, "-o", tmp_path / "run")
    assert "platform.motion_prior" in findings


def test_amplitudes_of_two_axes_are_refused_in_a_sentence(
    log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    text = (log / "site.yaml").read_text()
    (tmp_path / "site.yaml").write_text(text.replace("axes: [z]", "axes: [x, z]"))
    findings = refuse("fix", log, "--site", tmp_path / "site.yaml", "-o", tmp_path / "run")
    assert "is [x, z], but the fields of" in findings


def test_what_does_not_fit_the_receiver_is_refused(
    log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    def negative(table: pa.Table) -> pa.Table:
        column = table.column_names.index("amplitude")
        return table.set_column(column, "amplitude", pa.array(-table["amplitude"].to_numpy()))

    built = copied(log, tmp_path / "negative", negative)
    assert "an amplitude has no sign" in refuse("fix", built, "-o", tmp_path / "run")
    text = (log / "site.yaml").read_text()
    (tmp_path / "site.yaml").write_text(text.replace("axes: [z]", "axes: [x, y, z]"))
    findings = refuse("fix", log, "--site", tmp_path / "site.yaml", "-o", tmp_path / "run")
    assert "have one amplitude; declare the axes of the receiver" in findings


@pytest.mark.slow
def test_the_report_says_what_is_told_and_what_is_not(log: Path, tmp_path: Path) -> None:
    run_command("fix", log, "-o", tmp_path / "run", "--free", "gain", "--hemisphere", "C0=+z")
    report = (tmp_path / "run" / "report.json").read_text()
    assert "roll about the axis" in report
    assert "roll_open" in report
    table = pq.read_table(tmp_path / "run" / "fixes.parquet").to_pydict()
    assert {"axis_x", "axis_sigma_deg", "position_sigma_m", "gain"} <= table.keys()
    assert max(table["axis_sigma_deg"]) < 0.5
    assert table["gain"] == pytest.approx([scenario.GAIN] * 3, rel=0.01)


@pytest.mark.slow
def test_wound_coils_locate_it_with_both_mirrors_and_one_in_front() -> None:
    result = scenario.run(7, 60)
    assert result.mirrored == 1.0
    assert result.alone >= 1.0 - scenario.MAX_AMBIGUOUS_SHARE
    assert result.roll_open
    assert result.largest_place_percent <= 100.0 * scenario.LIMIT
    # Of all epochs, not of each as the scenario's verdict has it: noise takes one to 0.0107 rad.
    assert result.axis_rad <= scenario.LIMIT
    assert 1.5 <= result.nees <= 6.0


def test_errors_are_those_of_the_nearest_mirror(site: Site) -> None:
    beacons = tuple(replace(b, hemisphere_beacon=None) for b in site.beacons)
    both = replace(site, beacons=beacons)
    rng = np.random.default_rng(2)
    noisy = seen(both, 1.0) + SIGMA * rng.standard_normal((3, len(beacons)))
    own = epochs(noisy, signed=True)
    result = fix_coil(own, initial_calibration(both, 0.0), Gain(1.0, 0.01))
    fixes = poses_of(result, own.time, both, signed=True)
    verdicts = judged_poses(fixes, result, 0, signed=True)
    truth = Trajectory(own.time, np.broadcast_to(np.eye(3), (3, 3, 3)).copy(), PLACE)
    rotated = least_turn(np.array([0.0, 0.0, 1.0]), AXIS)
    truth = replace(truth, world_from_body=rotated)
    nearest, _ = nearest_reported(verdicts.alone, truth, both)
    np.testing.assert_allclose(nearest.position_world, PLACE, atol=1e-4)
    against = nearest_truth(truth, nearest, both, signed=True)
    errors = trajectory_errors(nearest, against, max_gap=2.0)
    assert errors.nees is not None
    assert (errors.nees < 30.0).all()
    assert (np.sum(np.isfinite(verdicts.fixes.cost), axis=1) == 2).all()
