"""One update of the filter is one Gauss-Newton step of the graph, for every measurement."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.inertial import inertial_factor
from magfusion.estimation.graph.measurement import joined, measured_rows
from magfusion.estimation.graph.process_noise import ProcessNoise, calibration_process_noise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import (
    MOTION,
    State,
    between,
    moved,
    states_of,
    values_of,
)
from magfusion.estimation.measurements.earth import earth_measurement
from magfusion.estimation.measurements.phasors import field_phasors
from magfusion.estimation.measurements.zero_velocity import ZeroVelocity
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.model.field import observe_earth
from magfusion.model.parameters import (
    GROUPS,
    PARAMETERS,
    PHASOR_PARAMETERS,
    choose_blocks,
    dimension,
    initial_calibration,
    prior_sigma,
)
from magfusion.model.samples import ImuSamples, StaticFields
from magfusion.model.site import ClockModel
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields

SEED = 11


def a_site(synchronised=True):
    site = demo_site(coil_radius=None)
    beacons = tuple(replace(b, synchronised=synchronised) for b in site.beacons)
    return replace(site, beacons=beacons)


def a_state(site, blocks, rng):
    size = MOTION + dimension(blocks)
    root = rng.normal(size=(size, size)) / np.sqrt(size)
    scale = np.concatenate(
        [np.repeat([0.02, 0.03, 0.1, 0.05, 0.005], 3), np.minimum(prior_sigma(blocks), 0.3)]
    )
    cov = scale[:, None] * (0.2 * root @ root.T + np.eye(size)) * scale
    return State(
        time=3.0,
        world_from_body=Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(),
        position_world=np.array([2.0, 1.5, 1.1]),
        velocity_world=np.array([0.4, -0.3, 0.1]),
        accel_bias_body=np.array([0.02, -0.01, 0.03]),
        gyro_bias_body=np.array([0.002, 0.001, -0.003]),
        calibration=initial_calibration(site, 1.0),
        cov=cov,
    )


def an_imu(begin, end, rng):
    time = np.arange(begin - 0.1, end + 0.1, 0.005)
    gyro = np.array([0.3, -0.2, 0.5]) + 0.1 * rng.normal(size=(len(time), 3))
    accel = np.array([0.2, 0.1, 9.8]) + 0.3 * rng.normal(size=(len(time), 3))
    return ImuSamples(time, gyro, accel)


def an_epoch(site, state, blocks, rng, earth=False):
    """Return the measurements of an epoch somewhat beside the state."""
    true = moved(state, blocks, 0.3 * np.sqrt(np.diag(state.cov)) * rng.normal(size=len(state.cov)))
    pose = Trajectory(np.array([state.time]), true.world_from_body[None], true.position_world[None])
    samples = simulate_fields(site, pose, 1e-9, rng)
    rate, offset = np.array([[0.3, -0.2, 0.5]]), np.array([site.platform.imu.time_offset])
    real, imaginary = 1e-7 * rng.normal(size=(2, 1, len(site.channels), 3))
    by_offset, now = real + 1j * imaginary, np.zeros(1, dtype=np.int64)
    out = [field_phasors(site, samples, now, pose, rate, offset, 1.0, by_offset)]
    if earth:
        there = true.calibration.site
        seen = observe_earth(
            there.platform.magnetometer, true.world_from_body, there.earth_field_world
        )
        static = StaticFields(samples.time, seen.measured_sensor[None], 1e-18 * np.eye(3)[None])
        field = earth_measurement(site, static, now, rate, offset, 0.4)
        out.append(replace(field, robust=False))
    return out


def one_interval(groups, synchronised=True, seed=SEED, earth=False):
    """Return a start, where the IMU leads from it, and an epoch measured there."""
    rng = np.random.default_rng(seed)
    site = a_site(synchronised)
    blocks = choose_blocks(site, groups, parameters=PARAMETERS if earth else PHASOR_PARAMETERS)
    start = a_state(site, blocks, rng)
    later = start.time + 0.4
    predicted = propagate(
        start, an_imu(start.time, later, rng), later, site, site.platform.imu.time_offset
    )
    return start, blocks, predicted, an_epoch(site, predicted.state, blocks, rng, earth)


MEASUREMENTS = {
    "fields, calibration known": ((), True, True, None, False),
    "fields and beacons": (("beacons", "moments"), True, True, None, False),
    "fields and everything": (GROUPS, True, True, None, False),
    "fields of free oscillators": (("beacons", "moments", "phase"), False, True, None, False),
    "rest": (("beacons",), True, False, 0.01, False),
    "fields at rest": (GROUPS, False, True, 0.01, False),
    "fields and the Earth field": (("beacons",), True, True, None, True),
    "fields and the Earth field, everything": (GROUPS, False, True, None, True),
    "no field, but slow, where the Earth field is measured": (GROUPS, True, False, 1.0, True),
}


@pytest.mark.parametrize(
    ("groups", "synchronised", "with_fields", "rest", "earth"),
    MEASUREMENTS.values(),
    ids=MEASUREMENTS,
)
def test_one_update_of_the_filter_is_one_gauss_newton_step_of_the_graph(
    groups, synchronised, with_fields, rest, earth
):
    start, blocks, predicted, epoch = one_interval(groups, synchronised, earth=earth)
    measurements = epoch if with_fields else []
    if rest is not None:
        measurements = [*measurements, ZeroVelocity(np.zeros(1, dtype=int), np.array([rest]))]
    light = ErrorStateFilter(start, blocks)
    light.absorb(predicted, measurements)
    still = ProcessNoise(blocks, np.zeros(dimension(blocks)))
    window = SlidingWindow(start, blocks, 10.0, still)
    window.absorb(predicted, measurements)
    sigma = np.sqrt(np.diag(light.state.cov))
    separate = between(light.state, window.state, blocks) / sigma
    went = between(predicted.state, light.state, blocks) / sigma
    assert np.max(np.abs(separate)) < 1e-9 * max(1.0, np.max(np.abs(went)))
    scaled = (window.state.cov - light.state.cov) / np.outer(sigma, sigma)
    assert np.max(np.abs(scaled)) < 1e-9


def test_the_step_of_the_test_is_a_long_one():
    start, blocks, predicted, epoch = one_interval(GROUPS)
    light = ErrorStateFilter(start, blocks)
    light.absorb(predicted, epoch)
    went = between(predicted.state, light.state, blocks)
    assert np.max(np.abs(went) / np.sqrt(np.diag(light.state.cov))) > 1.0


def test_moving_there_and_asking_the_way_are_inverse():
    start, blocks, _, _ = one_interval(GROUPS)
    step = 0.1 * np.random.default_rng(2).normal(size=len(start.cov))
    assert np.max(np.abs(between(start, moved(start, blocks, step), blocks) - step)) < 1e-12


@pytest.mark.parametrize("earth", [False, True])
def test_the_rows_of_an_epoch_are_its_derivative(earth):
    _, blocks, predicted, epoch = one_interval(GROUPS, earth=earth)
    state = predicted.state
    _, jacobian = measured_rows(epoch, state, blocks)
    scale = 1e-6 * np.sqrt(np.diag(state.cov))
    for k in range(len(state.cov)):
        if 6 <= k < MOTION:
            continue  # velocity and biases act through the time offset alone, to second order
        step = np.zeros(len(state.cov))
        step[k] = scale[k]
        ahead, behind = (
            measured_rows(epoch, moved(state, blocks, sign * step), blocks)[0] for sign in (1, -1)
        )
        result = (ahead - behind) / (2.0 * scale[k])
        size = np.max(np.abs(jacobian[:, k]))
        assert np.max(np.abs(result - jacobian[:, k])) < 1e-5 * size


def test_the_calibration_gains_variance_only_where_things_drift():
    site = a_site(synchronised=False)
    blocks = choose_blocks(site, GROUPS, parameters=PARAMETERS)
    walk = calibration_process_noise(site, blocks).variance
    drifting = ("log_moment", "phase", "drift", "offset", "declination", "strength")
    for block in blocks:
        drifts = block.kind in drifting
        assert np.all((walk[block.columns] > 0.0) == drifts)


def test_the_covariance_carried_on_is_that_of_many_runs():
    """Monte Carlo of the IMU's noise: transition and noise are those of the strapdown itself."""
    rng = np.random.default_rng(5)
    site = a_site()
    blocks = ()
    start = a_state(site, blocks, rng)
    start = replace(start, cov=1e-16 * np.eye(MOTION))
    model = site.platform.imu
    quiet = an_imu(start.time, start.time + 0.5, rng)
    later, rate = start.time + 0.5, 200.0
    mean = propagate(start, quiet, later, site, 0.0).state
    spread = np.sqrt(rate) * np.array([model.gyro_noise, model.accel_noise])
    steps = []
    for _ in range(400):
        noisy = ImuSamples(
            quiet.time,
            quiet.gyro_body + spread[0] * rng.normal(size=quiet.gyro_body.shape),
            quiet.accel_body + spread[1] * rng.normal(size=quiet.accel_body.shape),
        )
        steps.append(between(mean, propagate(start, noisy, later, site, 0.0).state, blocks))
    result = np.std(np.array(steps)[:, :9], axis=0)
    # Means of neighbouring samples carry a little less noise at the interval's ends.
    ratio = result / np.sqrt(np.diag(mean.cov)[:9])
    assert np.all((ratio > 0.85) & (ratio < 1.15))


def test_a_frequency_that_changes_now_has_not_turned_the_phase_before():
    """The variance of the phase now is that of its own walk, however long the clock has run."""
    site = a_site(synchronised=False)
    blocks = choose_blocks(site, ("phase",))
    walk = calibration_process_noise(site, blocks)
    calibration = initial_calibration(site, 0.0)
    for time in (0.0, 1e5):
        gained = walk.cov(calibration, time, 2.0)
        for beacon in site.beacons:
            own = {b.kind: b.columns for b in blocks if b.owner == beacon.name}
            rate = 2.0 * np.pi * beacon.tone_frequencies_hz[0] * time
            by = np.zeros(dimension(blocks))
            by[own["phase"]], by[own["drift"]] = 1.0, rate
            expected = 2.0 * walk.variance[own["phase"]][0]
            assert by @ gained @ by == pytest.approx(expected, rel=1e-6)
            drift = own["drift"].start
            assert gained[drift, drift] == 2.0 * walk.variance[drift]


def test_epochs_of_a_kind_are_linearised_in_one_call_with_the_rows_of_each():
    """A window of the fixed lag holds as many as it has epochs; a call each is its whole time."""
    start, blocks, predicted, first = one_interval(None, earth=True)
    second = one_interval(None, seed=SEED + 1, earth=True)[3]
    whole = joined([m.at(k) for k, epoch in enumerate((first, second)) for m in epoch])
    assert [len(m.epoch) for m in whole] == [2, 2]
    states = [start, predicted.state]
    for together, alone in zip(whole, zip(first, second, strict=True), strict=True):
        both = together.linearize(states_of(states), start.calibration, blocks)
        for k, measurement in enumerate(alone):
            one = measurement.linearize(states_of(states[k : k + 1]), start.calibration, blocks)
            np.testing.assert_allclose(both.error[k], one.error[0], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(both.by_pose[k], one.by_pose[0], rtol=1e-9, atol=1e-6)


def as_a_graph(start, blocks, predicted, epoch, walked):
    """Return mean and covariance after an epoch, by least squares over start, walk and end.

    Parameters
    ----------
    walked : ndarray, shape (dimension, k)
        What the calibration gains between the two, by unit steps that are independent.
    """
    end, size, extra = predicted.state, len(start.cov), walked.shape[1]
    factor = inertial_factor(0, predicted.link.measurement)
    rows, right = factor.linearize(values_of([start, end])).jacobian()
    own = np.concatenate([np.r_[0:9, 18:24], np.r_[9:18, 24:30]])  # x0 v0 b0, x1 v1 b1
    error, jacobian = measured_rows(epoch, end, blocks)
    # Unknowns: motion and calibration at the start, motion at the end, steps of the walk.
    prior = np.linalg.inv(np.linalg.cholesky(start.cov))
    inertial = np.zeros((15, size + MOTION + extra))
    inertial[:, np.r_[0:MOTION, size : size + MOTION]] = rows[:, own]
    last = np.zeros((size, size + MOTION + extra))
    last[:MOTION, size : size + MOTION] = np.eye(MOTION)
    last[MOTION:, MOTION:size] = np.eye(size - MOTION)
    last[MOTION:, size + MOTION :] = walked
    whole = np.vstack(
        [
            np.pad(prior, ((0, 0), (0, MOTION + extra))),
            inertial,
            np.pad(np.eye(extra), ((0, 0), (size + MOTION, 0))),
            jacobian @ last,
        ]
    )
    known = np.concatenate([np.zeros(size), right, np.zeros(extra), -error])
    scale = 1.0 / np.linalg.norm(whole, axis=0)
    q, r = np.linalg.qr(whole * scale)
    root = last * scale @ np.linalg.inv(r)
    return root @ (q.T @ known), root @ root.T


def test_an_update_is_that_of_a_graph_in_which_the_clocks_walk():
    """Of crystals that wander as declared, and drives that warm up: variance goes with time."""
    rng = np.random.default_rng(SEED)
    phase, drift, moment = 3.0, 2e-5, 0.5  # rad, 1, 1; standard deviations gained in an hour
    site = replace(a_site(synchronised=False), clock=ClockModel(2e-5, 1e-4, phase, drift, moment))
    blocks = choose_blocks(site, ("moments", "phase"), parameters=PHASOR_PARAMETERS)
    start = a_state(site, blocks, rng)
    # Known well enough that what an interval adds counts.
    sharp = np.concatenate([np.ones(MOTION), np.full(dimension(blocks), 0.02)])
    start = replace(start, cov=sharp[:, None] * start.cov * sharp)
    walk, later = calibration_process_noise(site, blocks), start.time + 0.4
    imu = an_imu(start.time, later, rng)
    offset = site.platform.imu.time_offset
    predicted = propagate(start, imu, later, site, offset, walk, blocks=blocks)
    light = ErrorStateFilter(start, blocks)
    epoch = an_epoch(site, predicted.state, blocks, rng)
    light.absorb(predicted, epoch)
    gained = np.sqrt(0.4 / 3600.0) * np.array([phase, drift, moment])
    walked = np.zeros((dimension(blocks), dimension(blocks)))
    at = {(block.kind, block.owner): block.columns for block in blocks}
    for beacon in site.beacons:
        own = [at[kind, beacon.name] for kind in ("phase", "drift", "log_moment")]
        for columns, sigma in zip(own, gained, strict=True):
            np.fill_diagonal(walked[columns, columns], sigma)
        # The phase does not jump as the frequency steps.
        start_time = (
            2.0 * np.pi * beacon.tone_frequencies_hz * (later - start.calibration.reference_time)
        )
        walked[own[0], own[1]] = -start_time * gained[1]
    mean, cov = as_a_graph(start, blocks, predicted, epoch, walked)
    sigma = np.sqrt(np.diag(cov))
    went = between(predicted.state, light.state, blocks)
    assert np.max(np.abs(went / sigma)) > 1.0
    assert np.max(np.abs(went - mean) / sigma) < 1e-6 * np.max(np.abs(went / sigma))
    assert np.max(np.abs(light.state.cov - cov) / np.outer(sigma, sigma)) < 1e-6
    # Without the walk the graph would claim a good deal more.
    _, static = as_a_graph(start, blocks, predicted, epoch, np.zeros((dimension(blocks), 0)))
    kept = np.sqrt(np.diag(static)) / sigma
    assert np.min(kept[MOTION:]) < 0.8


@pytest.mark.parametrize("lag", [None, 1.0])
def test_moments_that_nothing_measures_walk_as_declared(lag):
    """In the filter from epoch to epoch; in the window as epochs leave it."""
    rng = np.random.default_rng(SEED)
    site = replace(a_site(), clock=ClockModel(log_moment_walk=0.5))  # in an hour
    blocks = choose_blocks(site, ("moments",), parameters=PHASOR_PARAMETERS)
    state = a_state(site, blocks, rng)
    walk, offset = calibration_process_noise(site, blocks), site.platform.imu.time_offset
    imu = an_imu(state.time, state.time + 8.0, rng)
    light = (
        ErrorStateFilter(state, blocks) if lag is None else SlidingWindow(state, blocks, lag, walk)
    )
    for epoch in range(1, 21):
        later = state.time + 0.4 * epoch
        added = walk if lag is None else None
        light.absorb(propagate(light.state, imu, later, site, offset, added, blocks=blocks), [])
    gained = np.diag(light.state.cov)[MOTION:] - np.diag(state.cov)[MOTION:]
    passed = gained * 3600.0 / 0.5**2  # s
    # What is within the window has not walked yet.
    inside = 0.0 if lag is None else lag + 0.4
    assert np.all((passed > 7.999 - inside) & (passed < 8.001))
    assert lag is None or np.all(passed < 8.001 - lag + 0.4)
