"""The iterated update: fields of a wide prediction are linearised where the platform is."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.state import MOTION, State, between, states_of
from magfusion.estimation.measurements.linearization import is_curved, relinearized
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

NOISE_DENSITY = 2.5e-10  # T per root Hz
TRUE_ROTATION = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
TRUE_POSITION = np.array([2.0, 1.5, 1.1])
# What a minute of dead reckoning leaves (rad, m, m/s, m/s^2, rad/s).
AFTER_A_MINUTE = np.repeat([5e-3, 0.2, 0.04, 0.01, 1e-4], 3)


def a_site() -> Site:
    return replace(demo_site(), model_error=1e-3)


def predicted_state(site: Site, sigma: Array, error: Array) -> State:
    """Return a state off the truth by an error (15,), with independent sigmas (15,)."""
    pose = gtsam.Pose3(gtsam.Rot3(TRUE_ROTATION), TRUE_POSITION).retract(error[:6])
    return State(
        time=60.0,
        world_from_body=pose.rotation().matrix(),
        position_world=np.asarray(pose.translation()),
        velocity_world=error[6:9],
        accel_bias_body=error[9:12],
        gyro_bias_body=error[12:15],
        calibration=initial_calibration(site, 0.0),
        cov=np.diag(sigma**2),
    )


def an_epoch(site: Site, predicted: State, rng: np.random.Generator) -> FieldPhasors:
    """Return the fields at the true pose, as an epoch of that prediction."""
    time, now = np.array([predicted.time]), np.zeros(1, dtype=np.int64)
    true = Trajectory(time, TRUE_ROTATION[None], TRUE_POSITION[None])
    assumed = replace(
        true,
        world_from_body=predicted.world_from_body[None],
        position_world=predicted.position_world[None],
    )
    samples = simulate_fields(site, true, NOISE_DENSITY, rng)
    offset = np.array([site.platform.imu.time_offset])
    return field_phasors(site, samples, now, assumed, np.zeros((1, 3)), offset, 1.0)


def propagated(state: State, site: Site) -> Propagated:
    """Return a prediction whose covariance is that of the state, over a moment."""
    time = np.arange(state.time - 0.1, state.time + 0.1, 0.01)
    still = np.repeat([[0.0, 0.0, 0.0]], len(time), axis=0)
    imu = ImuSamples(time, still, still)
    moved = propagate(state, imu, state.time + 1e-3, site, 0.0)
    return replace(moved, state=replace(state, time=moved.state.time))


def most_probable(phasors: FieldPhasors, predicted: State) -> Array:
    """Return the step (6,) to the pose of least cost, by SciPy."""
    information = 1.0 / np.sqrt(np.diag(predicted.cov)[:6])

    def residual(step: Array) -> Array:
        pose = predicted.pose.retract(step)
        at = replace(
            predicted,
            world_from_body=pose.rotation().matrix(),
            position_world=np.asarray(pose.translation()),
        )
        error = phasors.error(states_of([at]), predicted.calibration)
        return np.concatenate([error.ravel(), information * step])

    result = least_squares(residual, np.zeros(6), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return np.asarray(result.x)


def updated(phasors: FieldPhasors, predicted: State, site: Site) -> State:
    light = ErrorStateFilter(predicted, ())
    light.absorb(propagated(predicted, site), [phasors])
    return light.state


@pytest.mark.parametrize("seed", range(6))
def test_the_update_of_a_wide_prediction_is_the_least_squares_solution(seed: int) -> None:
    rng, site = np.random.default_rng(seed), a_site()
    predicted = predicted_state(
        site, AFTER_A_MINUTE, AFTER_A_MINUTE * np.clip(rng.standard_normal(15), -1.5, 1.5)
    )
    phasors = an_epoch(site, predicted, rng)
    assert is_curved(phasors, predicted)
    at = relinearized(phasors, predicted, ())
    assert at is not None
    state = updated(at, predicted, site)
    step = np.asarray(predicted.pose.localCoordinates(state.pose))
    sigma = np.sqrt(np.diag(state.cov)[:6])
    np.testing.assert_allclose((step - most_probable(phasors, predicted)) / sigma, 0.0, atol=0.1)


def test_one_linearisation_of_a_wide_prediction_errs_by_many_sigma() -> None:
    """The field's curvature over twenty centimetres is a few per cent of it."""
    rng, site = np.random.default_rng(1), a_site()
    predicted = predicted_state(site, AFTER_A_MINUTE, 1.2 * AFTER_A_MINUTE)
    phasors = an_epoch(site, predicted, rng)
    at = relinearized(phasors, predicted, ())
    assert at is not None
    errors = []
    for measurement in (phasors, at):
        state = updated(measurement, predicted, site)
        sigma = np.sqrt(np.diag(state.cov)[3:6])
        errors.append(np.max(np.abs(state.position_world - TRUE_POSITION)) / np.max(sigma))
    assert errors[0] > 5.0
    assert errors[1] < 3.0


@pytest.mark.slow
def test_wide_predictions_have_a_consistent_nees() -> None:
    """Of 150 draws the mean NEES per degree of freedom has a sigma of sqrt(2 / 900)."""
    site, level = a_site(), []
    for seed in range(150):
        rng = np.random.default_rng(1000 + seed)
        error = AFTER_A_MINUTE * rng.standard_normal(15)
        predicted = predicted_state(site, AFTER_A_MINUTE, error)
        phasors = an_epoch(site, predicted, rng)
        # The noise that is simulated is all there is.
        quiet = replace(site, model_error=0.0)
        samples_only = an_epoch(quiet, predicted, np.random.default_rng(1000 + seed))
        phasors = replace(phasors, sqrt_information=samples_only.sqrt_information)
        at = relinearized(phasors, predicted, ())
        assert at is not None
        state = updated(at, predicted, site)
        true = gtsam.Pose3(gtsam.Rot3(TRUE_ROTATION), TRUE_POSITION)
        off = np.asarray(true.localCoordinates(state.pose))
        level.append(off @ np.linalg.solve(state.cov[:6, :6], off) / 6.0)
    assert 0.85 < np.mean(level) < 1.2


def test_filter_and_window_agree_on_a_relinearised_epoch() -> None:
    rng, site = np.random.default_rng(3), a_site()
    predicted = predicted_state(site, AFTER_A_MINUTE, AFTER_A_MINUTE * rng.standard_normal(15))
    at = relinearized(an_epoch(site, predicted, rng), predicted, ())
    assert at is not None
    start = predicted
    time = np.arange(start.time - 0.1, start.time + 0.6, 0.005)
    gyro = np.zeros((len(time), 3))
    imu = ImuSamples(time, gyro, gyro + TRUE_ROTATION.T @ [0.0, 0.0, site.gravity])
    later = propagate(start, imu, start.time + 0.4, site, 0.0)
    light = ErrorStateFilter(start, ())
    light.absorb(later, [at])
    window = SlidingWindow(start, (), 10.0, ProcessNoise((), np.zeros(0)))
    window.absorb(later, [at])
    sigma = np.sqrt(np.diag(light.state.cov))
    went = np.max(np.abs(between(later.state, light.state, ()) / sigma))
    assert went > 10.0
    assert np.max(np.abs(between(light.state, window.state, ()) / sigma)) < 1e-9 * went


def test_derivatives_are_those_of_the_linearisation_point() -> None:
    """Beside it the error is the tangent's, whatever the state is."""
    rng, site = np.random.default_rng(4), a_site()
    predicted = predicted_state(site, AFTER_A_MINUTE, AFTER_A_MINUTE)
    phasors = an_epoch(site, predicted, rng)
    at = phasors.linearized_at(TRUE_ROTATION, TRUE_POSITION)
    true = predicted_state(site, AFTER_A_MINUTE, np.zeros(MOTION))
    here = phasors.linearize(states_of([true]), true.calibration, ())
    there = at.linearize(states_of([predicted]), predicted.calibration, ())
    assert here.by_pose is not None
    assert there.by_pose is not None
    np.testing.assert_array_equal(there.by_pose, here.by_pose)
    step = np.asarray(true.pose.localCoordinates(predicted.pose))
    tangent = here.error + here.by_pose @ step
    np.testing.assert_allclose(there.error, tangent, rtol=0, atol=1e-6 * np.max(np.abs(tangent)))
    cost_only = at.error(states_of([predicted]), predicted.calibration)
    np.testing.assert_array_equal(cost_only, there.error)


def test_a_prediction_of_millimetres_is_not_curved() -> None:
    """A dipole's field 2 m away deviates from its tangent over 1 mm by 1.5e-6 of itself."""
    narrow = np.repeat([5e-4, 1e-3, 0.01, 0.01, 1e-4], 3)
    rng, site = np.random.default_rng(5), a_site()
    predicted = predicted_state(site, narrow, np.zeros(MOTION))
    assert not is_curved(an_epoch(site, predicted, rng), predicted)


def test_innovations_of_many_epochs_are_unbiased() -> None:
    """As those of a platform at rest, whose predictions are off by random centimetres.

    What an innovation contains besides the error of its prediction is noise, and curvature, whose
    mean is not zero: one linearisation, which is the test's power, shows it in a thousand epochs.
    Over a sphere it would be, as a static field is harmonic; dead reckoning errs in the horizontal.
    """
    site, sigma = replace(demo_site(), model_error=0.0), AFTER_A_MINUTE.copy()
    sigma[3:6] = 0.02, 0.02, 0.002
    true = gtsam.Pose3(gtsam.Rot3(TRUE_ROTATION), TRUE_POSITION)
    noise: dict[bool, list[Array]] = {False: [], True: []}
    for seed in range(1000):
        rng = np.random.default_rng(2000 + seed)
        predicted = predicted_state(site, sigma, sigma * rng.standard_normal(15))
        phasors = an_epoch(site, predicted, rng)
        assert is_curved(phasors, predicted)
        at = relinearized(phasors, predicted, ())
        assert at is not None
        step = np.asarray(predicted.pose.localCoordinates(true))
        for iterated, measurement in ((False, phasors), (True, at)):
            rows = measurement.linearize(states_of([predicted]), predicted.calibration, ())
            assert rows.by_pose is not None
            noise[iterated].append((rows.error + rows.by_pose @ step).ravel())
    mean = {iterated: np.mean(each, axis=0) for iterated, each in noise.items()}
    bias = {iterated: np.max(np.abs(one)) * np.sqrt(1000) for iterated, one in mean.items()}
    assert bias[False] > 8.0
    assert bias[True] < 4.0  # one of 24 by chance in seven hundred runs
