"""Tracks of hypotheses: strides against an exact motion, an update against the other filter."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from online_log import SIGMA, surveyed_site
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.search import MAX_TRACKS, Search, follow_tracks, upright
from magfusion.estimation.batch.strides import strides_between
from magfusion.estimation.batch.tracks import (
    MOTION,
    TrackPhasors,
    Tracks,
    moved,
    propagate_tracks,
    rows_at,
    track_phasors,
    updated,
)
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import State
from magfusion.estimation.measurements.phasors import field_phasors
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import Rests, SimulatedMotion, random_walk_motion

OFFSET = 0.003  # s
EPOCHS = np.array([1.0, 1.1, 1.35, 1.4, 2.0])


def walk() -> SimulatedMotion:
    rests = Rests(start=0.0, move=10.0, pause=1.0)
    return random_walk_motion(np.random.default_rng(3), 4.0, DEMO_BOX_WORLD, 1.0, rests=rests)


def ideal_imu(motion: SimulatedMotion, site: Site) -> ImuSamples:
    """Return samples without any error, stamped too early by the offset."""
    time = np.arange(0.0, 3.0, 1e-3)
    force = motion.specific_force_body(time, site.gravity)
    return ImuSamples(time - OFFSET, motion.rate_body(time), force)


def free_site() -> Site:
    site = surveyed_site()
    one, other = site.beacons[:2]
    return replace(site, beacons=(one, replace(other, synchronised=False)))


def hearing_of(site: Site, motion: SimulatedMotion) -> TrackPhasors:
    truth = motion.trajectory(EPOCHS)
    samples = simulate_fields(site, truth, SIGMA, np.random.default_rng(1), window=0.1)
    return track_phasors(samples, initial_calibration(site, 0.0))


def tracks_at(site: Site, motion: SimulatedMotion, k: int, sigma: float = 1e-3) -> Tracks:
    """Return the truth as a track, and one beside it."""
    at = motion.trajectory(EPOCHS[k : k + 1])
    channels, free_parameters = len(site.channels), sum(not b.synchronised for b in site.beacons)
    assert at.velocity_world is not None
    none = np.zeros((2, channels))
    return Tracks(
        rotation=at.world_from_body[[0, 0]]
        @ Rotation.from_rotvec([[0, 0, 0], [0.1, 0, 0]]).as_matrix(),
        position=at.position_world[[0, 0]] + [[0, 0, 0], [0, 0.1, 0.0]],
        velocity=at.velocity_world[[0, 0]] + [[0, 0, 0], [0.3, 0, 0]],
        accel_bias=np.array([[0, 0, 0], [0.02, -0.01, 0.03]]),
        gyro_bias=np.array([[0, 0, 0], [2e-3, -1e-3, 3e-3]]),
        phase=none + 0.2 * np.arange(2)[:, None] * (np.arange(channels) == 1),
        rate=none.copy(),
        cov=np.tile(sigma**2 * np.eye(MOTION + 2 * free_parameters), (2, 1, 1)),
        cost=np.zeros(2),
        parent=np.arange(2),
    )


def test_strides_carry_the_true_state_along_the_true_motion() -> None:
    site, motion = free_site(), walk()
    strides = strides_between(ideal_imu(motion, site), OFFSET, EPOCHS)
    detection = hearing_of(site, motion)
    for k in range(len(strides)):
        there = propagate_tracks(tracks_at(site, motion, k), strides, k, detection, backward=False)
        truth = motion.trajectory(EPOCHS[k + 1 : k + 2])
        assert truth.velocity_world is not None
        np.testing.assert_allclose(there.position[0], truth.position_world[0], atol=1e-6)
        np.testing.assert_allclose(there.velocity[0], truth.velocity_world[0], atol=1e-5)
        np.testing.assert_allclose(there.rotation[0], truth.world_from_body[0], atol=1e-6)


def test_the_way_back_is_the_way_there() -> None:
    site, motion = free_site(), walk()
    strides = strides_between(ideal_imu(motion, site), OFFSET, EPOCHS)
    detection, tracks = hearing_of(site, motion), tracks_at(site, motion, 1)
    there = propagate_tracks(tracks, strides, 1, detection, backward=False)
    back = propagate_tracks(there, strides, 1, detection, backward=True)
    for name in ("rotation", "position", "velocity", "phase"):
        np.testing.assert_allclose(getattr(back, name), getattr(tracks, name), atol=1e-12)
    # The noise of the stride counts on both ways.
    growth = np.linalg.eigvalsh(back.cov - tracks.cov)
    assert np.min(growth) > -1e-15
    assert np.max(growth) > 1e-9


def test_a_gap_of_the_stream_is_found_wherever_it_lies() -> None:
    site, motion = free_site(), walk()
    imu = ideal_imu(motion, site)
    heard_of = (imu.time < 1.36) | (imu.time > 1.7)
    some = ImuSamples(imu.time[heard_of], imu.gyro_body[heard_of], imu.accel_body[heard_of])
    assert strides_between(some, OFFSET, EPOCHS).gap_bridged.tolist() == [False, False, True, True]


def test_a_stream_that_ends_early_is_extended() -> None:
    site, motion = free_site(), walk()
    imu = ideal_imu(motion, site)
    short = ImuSamples(*(part[imu.time < 1.39] for part in vars(imu).values()))
    strides = strides_between(short, OFFSET, EPOCHS)
    assert strides.gap_bridged.tolist() == [False, False, True, True]
    assert np.max(np.abs(strides.displacement[-1])) < 0.6 * 11.0 * 0.6**2  # m; no spline runs away


def test_rows_are_differentiated() -> None:
    site, motion = free_site(), walk()
    detection, tracks = hearing_of(site, motion), tracks_at(site, motion, 2)
    free_parameters = detection.free_phases

    def error(step: np.ndarray) -> np.ndarray:
        return rows_at(moved(tracks, np.tile(step, (2, 1)), free_parameters), detection, 2)[0]

    _, by = rows_at(tracks, detection, 2)
    expected = central_difference(error, by.shape[2], 1e-5)
    for part in (slice(0, 3), slice(3, 6), slice(MOTION, MOTION + 1)):
        assert relative_to_group(by[..., part], expected[..., part]) < 1e-7
    assert not np.any(expected[..., 6:MOTION])


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_stride_and_an_update_are_those_of_the_filter(k: int) -> None:
    """The filter preintegrates by GTSAM and updates by filterpy."""
    site, motion = surveyed_site(), walk()
    imu, detection = ideal_imu(motion, site), hearing_of(site, motion)
    tracks = tracks_at(site, motion, k, sigma=3e-4).rows(np.array([0]))
    strides = strides_between(imu, OFFSET, EPOCHS)
    ours = updated(
        propagate_tracks(tracks, strides, k, detection, backward=False), detection, k + 1
    )

    state = State(
        time=float(EPOCHS[k]),
        world_from_body=tracks.rotation[0],
        position_world=tracks.position[0],
        velocity_world=tracks.velocity[0],
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(site, 0.0),
        cov=tracks.cov[0],  # a multiple of one is the same in all axes
    )
    predicted = propagate(state, imu, float(EPOCHS[k + 1]), site, OFFSET)
    samples = simulate_fields(
        site, motion.trajectory(EPOCHS), SIGMA, np.random.default_rng(1), window=0.1
    ).rows(np.array([k + 1]))
    pose = Trajectory(
        samples.time, predicted.state.world_from_body[None], predicted.state.position_world[None]
    )
    phasors = field_phasors(site, samples, np.zeros(1, dtype=int), pose, np.zeros((1, 3)), 0.0, 1.0)
    others = ErrorStateFilter(state, ())
    others.absorb(predicted, [phasors])
    sigma = np.sqrt(np.diag(others.state.cov))
    body_from_world = others.state.world_from_body.T
    rotated = Rotation.from_matrix(body_from_world @ ours.rotation[0]).as_rotvec()
    shifted = body_from_world @ (ours.position[0] - others.state.position_world)
    faster = ours.velocity[0] - others.state.velocity_world
    assert np.max(np.abs(np.concatenate([rotated, shifted, faster])) / sigma[:9]) < 0.03
    turn = np.eye(MOTION)
    turn[3:6, 3:6] = body_from_world
    error = (turn @ ours.cov[0] @ turn.T - others.state.cov) / np.outer(sigma, sigma)
    assert np.max(np.abs(error)) < 0.05  # a stride leaves out what is second to its noise


def test_what_is_not_credible_costs_little_more_the_worse_it_is() -> None:
    site, motion = surveyed_site(), walk()
    detection, tracks = hearing_of(site, motion), tracks_at(site, motion, 1)
    good = updated(tracks, detection, 1)
    costs = []
    for size in (10.0, 1000.0):
        false = detection.measured.copy()
        false[1] *= size
        bad = updated(tracks, replace(detection, measured=false), 1)
        assert np.linalg.norm(bad.position[0] - tracks.position[0]) < 0.01  # m
        costs.append(float(bad.cost[0] - good.cost[0]))
    assert 0.0 < costs[0] < costs[1] < 5.0 * costs[0]


def test_fixes_recover_tracks_that_are_all_lost() -> None:
    """Tracks kilometres away explain the fields equally badly: none costs more than a restart."""
    site, motion = surveyed_site(), walk()
    time = np.arange(0.5, 2.9, 0.15)
    samples = simulate_fields(
        site, motion.trajectory(time), SIGMA, np.random.default_rng(1), window=0.1
    )
    calibration, imu = initial_calibration(site, 0.0), ideal_imu(motion, site)
    search = Search(
        samples,
        track_phasors(samples, calibration),
        strides_between(imu, OFFSET, time),
        fix_epochs(samples, calibration),
        upright(imu, OFFSET, time, site),
    )
    one = tracks_at(site, motion, 0).rows(np.zeros(MAX_TRACKS, dtype=np.int64))
    away = 1e3 * np.arange(1, MAX_TRACKS + 1)[:, None] * [1.0, 0.0, 0.0]
    result = follow_tracks(search, replace(one, position=one.position + away), range(len(time)))
    last = result.visits[-1]
    best = last.position[np.argmin(last.cost)]
    assert np.linalg.norm(best - motion.position_world(time[-1:])[0]) < 0.05  # m
