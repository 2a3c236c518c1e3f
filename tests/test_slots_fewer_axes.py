"""Coils in time slots, heard by a receiver that lacks axes."""

from dataclasses import replace

import numpy as np
import pytest
import unsigned_amplitudes
from derivatives import central_difference, relative_to_group
from scipy.spatial.transform import Rotation
from time_slots_and_mains import tracker

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import FixProblem, FixState, epochs_of
from magfusion.estimation.snapshot.sequential_channels import linearized, predicted
from magfusion.jobs.fix_coil import find_coil
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.progress import quiet
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.turn import slot_turn_of, turn_of

SLOTS = Slots(2.5e-3, 4)
RATE_BODY = np.array([1.2, -0.8, 0.9])  # rad/s; 100 deg/s
CYCLES, SIGMA = 6, 1e-13


def heard_by(axes: str) -> Site:
    site = tracker(1e4, SLOTS)
    lever = np.array([0.1, -0.05, 0.08])
    sensor = replace(site.platform.magnetometer, position_body=lever, axes=axes)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def poses(time: np.ndarray) -> Trajectory:
    """Return a platform that turns where it is."""
    turn = Rotation.from_rotvec([0.3, 0.2, -0.4]) * Rotation.from_rotvec(time[:, None] * RATE_BODY)
    return Trajectory(time, turn.as_matrix(), np.tile([0.45, 0.1, -0.2], (len(time), 1)))


def slots_of(site: Site) -> FieldSamples:
    """Return exact fields in the axes of each slot's own time."""
    number = np.arange(4 * CYCLES)
    number = number[number % 4 != 3]
    time = (number + 0.5) * SLOTS.duration
    at, rows, channel = poses(time), np.arange(len(time)), number % 4
    every = predict_channels(
        initial_calibration(site, 0.0), time, at.world_from_body, at.position_world
    )
    phasor, cov = np.full_like(every, np.nan), np.full((*every.shape, 3), np.nan)
    phasor[rows, channel] = every[rows, channel]
    phasor[..., site.platform.magnetometer.lacking] = np.nan
    cov[rows, channel] = SIGMA**2 * np.eye(3)
    length = np.full(len(time), SLOTS.duration)
    own = site.platform.magnetometer.axes
    return FieldSamples(time, length, site.channels, phasor, cov, axes=own)


def imu() -> ImuSamples:
    time = np.arange(-10, 80) / 500.0
    return ImuSamples(time, np.tile(RATE_BODY, (len(time), 1)), np.zeros((len(time), 3)))


def cycles_of(site: Site) -> FieldSamples:
    return whole_cycles(slots_of(site), imu(), site)


def problem_of(site: Site) -> FixProblem:
    calibration = initial_calibration(site, 0.0)
    (epochs,) = epochs_of(
        *(cycles_of(site), calibration),
        gravity=None,
        prior=None,
        survey_error=False,
        free_parameters=(),
        gain_sigma=0.2,
    )
    return epochs.problem


@pytest.mark.parametrize("axes", ["xy", "yz"])
def test_a_turning_receiver_of_two_axes_is_located_and_its_other_poses_are_told(axes: str) -> None:
    site = heard_by(axes)
    samples = cycles_of(site)
    truth = poses(samples.time)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0))
    away = np.linalg.norm(fixes.position_world - truth.position_world[:, None], axis=2)
    best, rows = np.argmin(away, axis=1), np.arange(len(samples))
    assert np.max(away[rows, best]) < 1e-5
    turn = np.swapaxes(truth.world_from_body, 1, 2) @ fixes.world_from_body[rows, best]
    assert np.max(Rotation.from_matrix(turn).magnitude()) < 1e-5
    # Both sides of the source, and both of the plane of what was measured.
    assert np.all(np.sum(fixes.probability > 0.2, axis=1) == 4)
    assert np.all(fixes.probability[:, 0] < 0.3)


def test_where_it_was_turned_is_in_the_prediction_and_its_derivative() -> None:
    site = heard_by("xy")
    problem = problem_of(site)
    assert problem.channel_rotation is not None
    truth = poses(problem.time)
    here = problem.start(truth.world_from_body, truth.position_world)
    there = np.einsum("...ii->...i", problem.sqrt_information) > 0.0
    remaining = (predicted(problem, here) - problem.measured).reshape(*there.shape[:2], 2, 3)
    size = np.max(np.abs(problem.measured))
    assert np.max(np.abs(np.where(there[:, :, None], remaining, 0.0))) < 1e-9 * size

    def moved(step: np.ndarray) -> np.ndarray:
        turn = here.rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        shift = (here.rotation @ step[3:, None])[..., 0]
        state = FixState(turn, here.position + shift, here.phase, here.log_gain)
        return predicted(problem, state)

    value, by_pose, _ = linearized(problem, here)
    np.testing.assert_allclose(value, predicted(problem, here))
    assert relative_to_group(by_pose, central_difference(moved, 6, 1e-5)) < 1e-6


def test_slots_of_a_receiver_without_all_axes_are_not_turned() -> None:
    time = np.linspace(0.0, 0.05, 5)
    assert np.array_equal(slot_turn_of(imu(), heard_by("xy"))(time), np.tile(np.eye(3), (5, 1, 1)))
    whole = heard_by("xyz")
    assert np.array_equal(slot_turn_of(imu(), whole)(time), turn_of(imu(), whole)(time))
    assert cycles_of(whole).channel_rotation is None


def test_one_axis_about_a_lone_source_is_said_to_be_too_little() -> None:
    site = heard_by("z")
    with pytest.raises(EstimationError, match="three numbers of a single source of three coils"):
        fix_epochs(cycles_of(site), initial_calibration(site, 0.0))


def floor_in_turn() -> Site:
    """Return sixteen coils in a floor that are driven in turn, under a receiver of one axis."""
    site = unsigned_amplitudes.floor()
    slots = Slots(SLOTS.duration, len(site.beacons))
    beacons = tuple(
        replace(b, coils=(replace(b.coils[0], slot=k),), frequency_hz=2e3, slots=slots)
        for k, b in enumerate(site.beacons)
    )
    sensor = replace(site.platform.magnetometer, position_body=np.zeros(3))
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, beacons=beacons, platform=platform)


def measured_in_turn(
    site: Site, count: int, *, signed: bool
) -> tuple[FieldSamples, ImuSamples, np.ndarray]:
    """Return fields of random poses, one for each cycle, an IMU at rest, and the places."""
    rng, coils, sigma = np.random.default_rng(3), len(site.beacons), unsigned_amplitudes.SIGMA
    place = rng.uniform(*unsigned_amplitudes.BOX, (count, 3))
    turn, cycle = Rotation.random(count, rng).as_matrix(), np.repeat(np.arange(count), coils)
    time, row = (np.arange(coils * count) + 0.5) * SLOTS.duration, np.arange(coils * count)
    every = predict_channels(initial_calibration(site, 0.0), time, turn[cycle], place[cycle])
    value = every[row, row % coils, 2]
    value = value + sigma * (rng.standard_normal((2, len(value))).T @ [1.0, 1j])
    phasor, cov = np.full_like(every, np.nan), np.full((*every.shape, 3), np.nan)
    phasor[row, row % coils, 2] = value if signed else np.abs(value)
    cov[row, row % coils] = sigma**2 * np.eye(3)
    length = np.full(len(time), SLOTS.duration)
    fields = FieldSamples(time, length, site.channels, phasor, cov, axes="z", signed=signed)
    stamps = np.arange(0.0, time[-1] + 0.1, 0.005)
    still = np.zeros((len(stamps), 3))
    weight = np.tile([0.0, 0.0, site.gravity], (len(stamps), 1))
    return fields, ImuSamples(stamps, still, weight), place


@pytest.mark.slow
@pytest.mark.parametrize("signed", [True, False])
def test_a_coil_is_found_by_what_sixteen_others_send_in_turn(signed: bool) -> None:
    site = floor_in_turn()
    samples, samples_imu, place = measured_in_turn(site, 60, signed=signed)
    result = whole_cycles(samples, samples_imu, site)
    assert result.signed is signed
    fixes = find_coil(Log("walk", 0, "test", samples_imu, fields=result), result, site, (), quiet)
    away = np.linalg.norm(fixes.fixes.position_world[:, 0] - place, axis=1)
    assert np.max(away) < 0.02  # m


def test_cycles_and_joined_epochs_keep_whatever_else_was_measured() -> None:
    site = floor_in_turn()
    samples, samples_imu, _ = measured_in_turn(site, 4, signed=False)
    named = replace(samples, magnetometers=tuple("m" for _ in samples.channels))
    result = whole_cycles(named, samples_imu, site)
    assert (result.signed, result.axes, result.magnetometers) == (False, "z", named.magnetometers)
    again = FieldSamples.joined(result.epochs())
    for name, value in vars(result).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
