"""Updates from a fix, where the prediction is too wide to linearise at, against SciPy."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from test_ekf import SEED, a_site, a_state, an_epoch, an_imu

from magfusion.estimation.graph.inertial import inertial_factor
from magfusion.estimation.graph.measurement import measured_rows
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import MOTION, between, moved, values_of
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.model.parameters import PHASOR_PARAMETERS, choose_blocks, dimension


def nonlinear_solution(residual, scale):
    """Return the step of least squares (n,), by SciPy from zero, and its covariance there."""
    result = least_squares(
        lambda unit: residual(scale * unit), np.zeros(len(scale)), jac="3-point", method="lm"
    )
    root = scale[:, None] * np.linalg.inv(np.linalg.qr(result.jac).R)
    return scale * result.x, root @ root.T


def a_wide_prediction():
    """Return what `one_interval` does, with 0.3 rad and 0.4 m open and moments known to 0.1 %."""
    rng = np.random.default_rng(SEED)
    site = a_site()
    blocks = choose_blocks(site, ("moments",), parameters=PHASOR_PARAMETERS)
    start = a_state(site, blocks, rng)
    wide = np.ones(len(start.cov))
    wide[:6] = 12.0
    start, later = replace(start, cov=wide[:, None] * start.cov * wide), start.time + 0.4
    offset = site.platform.imu.time_offset
    predicted = propagate(start, an_imu(start.time, later, rng), later, site, offset)
    return start, blocks, predicted, an_epoch(site, predicted.state, blocks, rng)


def a_fix_beside(best, blocks):
    """Return a state some centimetres and degrees from the solution, as a fix of one epoch is."""
    off = np.zeros(len(best.cov))
    off[:6] = np.random.default_rng(3).normal(0.0, 0.03, 6)
    return moved(best, blocks, off)


def check_same(light, best, cov, blocks):
    sigma = np.sqrt(np.diag(cov))
    off = between(best, light.state, blocks) / sigma
    differing = (light.state.cov - cov) / np.outer(sigma, sigma)
    assert np.max(np.abs(off)) < 0.1
    assert np.max(np.abs(differing)) < 0.1


def test_an_update_of_the_filter_from_a_fix_is_the_nonlinear_least_squares_solution():
    """The fields are not linear over a prediction that wide, nor from the fix to the solution."""
    start, blocks, predicted, epoch = a_wide_prediction()
    prior = predicted.state
    whitening = np.linalg.inv(np.linalg.cholesky(prior.cov))

    def residual(step):
        error, _ = measured_rows(epoch, moved(prior, blocks, step), blocks)
        return np.concatenate([whitening @ step, error])

    step, cov = nonlinear_solution(residual, np.sqrt(np.diag(prior.cov)))
    best = moved(prior, blocks, step)
    light = ErrorStateFilter(start, blocks)
    light.absorb(predicted, epoch, a_fix_beside(best, blocks))
    check_same(light, best, cov, blocks)


def test_an_update_of_the_window_from_a_fix_is_the_nonlinear_least_squares_solution():
    """Of the start and the end of an interval together, as the window holds both."""
    start, blocks, predicted, epoch = a_wide_prediction()
    size, noise = len(start.cov), predicted.noise[:MOTION, :MOTION]
    whitening = np.linalg.inv(np.linalg.cholesky(start.cov))
    factor = inertial_factor(0, predicted.link.measurement)
    # The end is where the start leads, and what the inertial noise adds.
    end = np.hstack([predicted.transition, np.eye(size)[:, :MOTION]])

    def states(step):
        first = moved(start, blocks, step[:size])
        return first, moved(predicted.state, blocks, end @ step)

    def residual(step):
        first, last = states(step)
        _, inertial = factor.linearize(values_of([first, last])).jacobian()
        error, _ = measured_rows(epoch, last, blocks)
        return np.concatenate([whitening @ step[:size], inertial, error])

    scale = np.sqrt(np.concatenate([np.diag(start.cov), np.diag(noise)]))
    step, cov = nonlinear_solution(residual, scale)
    best = states(step)[1]
    window = SlidingWindow(start, blocks, 10.0, ProcessNoise(blocks, np.zeros(dimension(blocks))))
    window.absorb(predicted, epoch, a_fix_beside(best, blocks))
    check_same(window, best, end @ cov @ end.T, blocks)
