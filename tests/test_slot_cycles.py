"""Slots of a cycle as one epoch: each is measured where the sensor was when it was driven."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from scipy.spatial.transform import Rotation
from time_slots_and_mains import tracker

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import CycleMotion, FixProblem, FixState, epochs_of
from magfusion.estimation.snapshot.sequential_channels import by_motion, linearized, predicted
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.cycles import cycles, joins, whole_cycles
from magfusion.receiver.turn import turn_of
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.waveform import usual_rate_hz

SLOTS = Slots(2.5e-3, 4)
RATE_BODY = np.array([1.2, -0.8, 0.9])  # rad/s; 100 deg/s
X_WORLD = np.array([1.0, 0.0, 0.0])
VELOCITY_WORLD = np.array([0.4, -0.3, 0.2])  # m/s


def _site() -> Site:
    site = tracker(1e4, SLOTS)
    lever = replace(site.platform.magnetometer, position_body=np.array([0.1, -0.05, 0.08]))
    return replace(site, platform=replace(site.platform, magnetometer=lever))


def _poses(time: np.ndarray) -> Trajectory:
    """Return a platform that turns and moves steadily."""
    turn = Rotation.from_rotvec([0.3, 0.2, -0.4]) * Rotation.from_rotvec(time[:, None] * RATE_BODY)
    place = np.array([0.45, 0.1, -0.2]) + time[:, None] * VELOCITY_WORLD
    return Trajectory(time, turn.as_matrix(), place)


def _slot_rows(site: Site, count: int) -> FieldSamples:
    """Return exact fields, a row for each driven slot."""
    number = np.arange(count)
    number = number[number % 4 != 3]
    time = (number + 0.5) * SLOTS.duration
    at, rows, channel = _poses(time), np.arange(len(time)), number % 4
    every = predict_channels(
        initial_calibration(site, 0.0), time, at.world_from_body, at.position_world
    )
    phasor, cov = np.full_like(every, np.nan), np.full((*every.shape, 3), np.nan)
    phasor[rows, channel] = every[rows, channel]
    cov[rows, channel] = 1e-22 * np.eye(3)
    return FieldSamples(time, np.full(len(time), SLOTS.duration), site.channels, phasor, cov)


def _imu() -> ImuSamples:
    time = np.arange(-10, 60) / 500.0
    return ImuSamples(time, np.tile(RATE_BODY, (len(time), 1)), np.zeros((len(time), 3)))


def _measured(site: Site, samples: FieldSamples) -> FieldPhasors:
    n = len(samples)
    rate, offset = np.tile(RATE_BODY, (n, 1)), np.zeros(n)
    return field_phasors(
        site, samples, np.arange(n), _poses(samples.time), rate, offset, repeats=1.0
    )


def _states(poses: Trajectory, step: np.ndarray) -> States:
    """Return the states of poses after a step of rotation, translation and velocity."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    shift_world = poses.world_from_body @ step[3:6]
    velocity = np.tile(VELOCITY_WORLD + step[6:], (len(poses.time), 1))
    return States(
        poses.world_from_body @ turn,
        poses.position_world + shift_world,
        velocity,
        lambda: np.zeros((len(poses.time), 6)),
    )


def test_a_cycle_is_predicted_where_each_slot_was() -> None:
    site = _site()
    result = cycles(_slot_rows(site, 40), turn_of(_imu(), site), site)
    assert len(result) == 10
    measured = _measured(site, result)
    size = np.max(np.linalg.norm(measured.sqrt_information @ measured.measured[..., None], axis=2))
    states = _states(_poses(result.time), np.zeros(9))
    calibration = initial_calibration(site, 0.0)
    # Half a cycle later the lever has swung by 0.4 degrees more than its tangent says.
    assert np.max(np.abs(measured.error(states, calibration))) < 1e-4 * size
    together = replace(measured, ahead=None)
    assert np.max(np.abs(together.error(states, calibration))) > 2e-3 * size


def test_derivatives_are_those_of_the_prediction() -> None:
    site = _site()
    result = cycles(_slot_rows(site, 8), turn_of(_imu(), site), site)
    measured, calibration = _measured(site, result), initial_calibration(site, 0.0)
    poses = _poses(result.time)
    rows = measured.linearize(_states(poses, np.zeros(9)), calibration, ())
    assert rows.by_pose is not None
    assert rows.by_velocity is not None
    expected = central_difference(
        lambda step: measured.error(_states(poses, step), calibration), 9, 1e-5
    )
    for own, part in ((rows.by_pose[..., :3], slice(0, 3)), (rows.by_pose[..., 3:], slice(3, 6))):
        assert relative_to_group(own, expected[..., part]) < 1e-6
    assert relative_to_group(rows.by_velocity, expected[..., 6:]) < 1e-6


def test_a_slot_that_was_lost_leaves_the_others_of_its_cycle() -> None:
    site = _site()
    rows = _slot_rows(site, 40)
    kept = np.arange(len(rows)) != 4
    result = cycles(rows.rows(kept), turn_of(_imu(), site), site)
    assert np.sum(result.valid, axis=1).tolist() == [3, 2] + [3] * 8
    assert len(whole_cycles(rows.rows(kept), _imu(), site)) == 9


@pytest.mark.parametrize(("duration", "together"), [(2.5e-3, True), (20e-3, False)])
def test_only_a_short_cycle_is_one_epoch(duration: float, together: bool) -> None:
    assert joins(tracker(1e4, Slots(duration, 4))) is together


def test_a_site_is_simulated_as_fast_as_its_tones_and_slots_need() -> None:
    assert usual_rate_hz(demo_site()) == 400.0
    assert usual_rate_hz(tracker(1e4, SLOTS)) == pytest.approx(25e3)
    assert usual_rate_hz(tracker(0.0, SLOTS)) == pytest.approx(6400.0)


def _noisy_cycles(site: Site, count: int, rng: np.random.Generator) -> FieldSamples:
    """Return cycles of slots with the noise that they declare."""
    rows = _slot_rows(site, count)
    noise = 1e-11 * (rng.standard_normal((2, *rows.phasor_sensor.shape)))
    return cycles(
        replace(rows, phasor_sensor=rows.phasor_sensor + noise[0] + 1j * noise[1]),
        turn_of(_imu(), site),
        site,
    )


def _here(site: Site) -> Site:
    """Return a site whose beacons have a hemisphere: a lone source leaves the sign open."""
    half = [replace(b, hemisphere_beacon=b.world_from_beacon.T @ X_WORLD) for b in site.beacons]
    return replace(site, beacons=tuple(half))


def _errors(site: Site, samples: FieldSamples) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (n, 6) of the most probable fixes, body axes, and their NEES."""
    fixes, truth = fix_epochs(samples, initial_calibration(site, 0.0)), _poses(samples.time)
    turn = np.swapaxes(truth.world_from_body, 1, 2) @ fixes.world_from_body[:, 0]
    off_world = fixes.position_world[:, 0] - truth.position_world
    off_body = np.einsum("nji,nj->ni", truth.world_from_body, off_world)
    error = np.hstack([Rotation.from_matrix(turn).as_rotvec(), off_body])
    whitened = np.linalg.solve(fixes.pose_cov[:, 0], error[..., None])[..., 0]
    return error, np.sum(error * whitened, axis=1)


def test_a_fix_takes_the_motion_within_a_cycle_from_those_beside_it() -> None:
    site = _here(_site())
    samples = _noisy_cycles(site, 48, np.random.default_rng(1))
    error, nees = _errors(site, samples)
    still, _ = _errors(site, replace(samples, ahead=None))
    moved = np.linalg.norm(VELOCITY_WORLD) * SLOTS.duration  # m; from slot to slot
    assert np.sqrt(np.mean(np.sum(still[:, 3:] ** 2, axis=1))) > 0.3 * moved
    inner = error[1:-1, 3:]
    assert np.sqrt(np.mean(np.sum(inner**2, axis=1))) < 0.1 * moved
    assert np.mean(nees) < 12.0


def _problem(site: Site, samples: FieldSamples) -> tuple[FixProblem, FixState]:
    calibration = initial_calibration(site, 0.0)
    (epochs,) = epochs_of(
        samples,
        calibration,
        gravity=None,
        prior=None,
        survey_error=False,
        free_parameters=(),
        gain_sigma=0.1,
    )
    assert samples.ahead is not None
    shift = samples.ahead[..., None] * VELOCITY_WORLD
    problem = replace(epochs.problem, motion=CycleMotion(shift, np.abs(samples.ahead) * 0.3))
    at = _poses(samples.time)
    return problem, problem.start(at.world_from_body, at.position_world)


def test_derivatives_of_a_fix_in_motion_are_those_of_its_prediction() -> None:
    site = _site()
    problem, state = _problem(site, _noisy_cycles(site, 8, np.random.default_rng(2)))
    assert problem.motion is not None
    motion = problem.motion

    def after(step: np.ndarray) -> np.ndarray:
        turn = state.rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        place = state.position + state.rotation @ step[3:6]
        shift = motion.shift_world + motion.spread[..., None] * step[6:]
        own = replace(problem, motion=motion._replace(shift_world=shift))
        return predicted(own, state._replace(rotation=turn, position=place))

    expected = central_difference(after, 9, 1e-5)
    _, by_pose, _ = linearized(problem, state)
    assert relative_to_group(by_pose[..., :3], expected[..., :3]) < 1e-6
    assert relative_to_group(by_pose[..., 3:], expected[..., 3:6]) < 1e-6
    assert relative_to_group(by_motion(problem, state, by_pose), expected[..., 6:]) < 1e-6
