"""Biases and calibration that a navigator knew before it started again."""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.state import MOTION, State, between, moved
from magfusion.model.parameters import Block, dimension, initial_calibration
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.site import Site
from magfusion.units import Array, IntArray

CONTRADICTION = 1e-6  # probability of a larger difference, if both are of one platform
MIN_UNKNOWN_SHARE = 0.99  # of the prior's variance; a larger share is no knowledge


def with_earlier(
    state: State, earlier: State, site: Site, estimated: tuple[Block, ...], walk: ProcessNoise
) -> State:
    """Return a first state, improved by the biases and calibration of an earlier state.

    Both contain the site's prior, which counts once.  Parameters that each log has for itself, and
    the rate of a motion prior, do not outlast a silence.  If both states contradict each other, as
    after an exchange of instruments, the first state is returned unchanged. `site`: the
    navigator's, whose sigmas are the prior. `estimated`: the first blocks in the states' tangent.
    `walk`: of all blocks.
    """
    rows = _lasting(site, estimated)
    if not len(rows):
        return state
    elapsed = max(state.time - earlier.time, 0.0)
    of_site = replace(
        state,
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(site, state.calibration.reference_time),
    )
    whiten = np.linalg.inv(np.linalg.cholesky(_prior(site, estimated)[np.ix_(rows, rows)]))
    cov = earlier.cov + _walked(earlier, site, walk, state.time, elapsed)
    variance, axes = np.linalg.eigh(whiten @ cov[np.ix_(rows, rows)] @ whiten.T)
    known = variance < MIN_UNKNOWN_SHARE
    variance, into = variance[known], axes[:, known].T @ whiten
    # The earlier estimate without the prior: mean and sigma along the axes, in prior sigmas.
    mean = into @ between(of_site, earlier, walk.blocks)[rows] / (1.0 - variance)
    sigma = np.sqrt(variance / (1.0 - variance))
    jacobian = np.zeros((len(sigma), len(state.cov)))
    jacobian[:, rows] = into / sigma[:, None]
    error = mean / sigma - jacobian @ between(of_site, state, walk.blocks)
    spread = jacobian @ state.cov @ jacobian.T + np.eye(len(sigma))
    if error @ np.linalg.solve(spread, error) > chdtri(len(sigma), CONTRADICTION):
        return state
    gain = np.linalg.solve(spread, jacobian @ state.cov).T
    gain[MOTION + dimension(estimated) :] = 0.0  # considered parameters keep their values
    kept = np.eye(len(gain)) - gain @ jacobian
    cov = kept @ state.cov @ kept.T + gain @ gain.T
    return replace(moved(state, walk.blocks, gain @ error), cov=0.5 * (cov + cov.T))


def _lasting(site: Site, estimated: tuple[Block, ...]) -> IntArray:
    """Return the rows of the tangent that a silence leaves as they are, up to their walks."""
    imu, own = site.platform.imu, np.zeros(MOTION + dimension(estimated), dtype=bool)
    if site.platform.inertial:
        own[9:MOTION] = np.repeat([imu.accel_bias_sigma > 0.0, imu.gyro_bias_sigma > 0.0], 3)
    for block in estimated:
        own[MOTION:][block.columns] = not block.parameter.each_log
    return np.flatnonzero(own)


def _prior(site: Site, estimated: tuple[Block, ...]) -> Array:
    """Return the covariance of biases and calibration in the site, in the tangent."""
    imu, spread = site.platform.imu, prior_sqrt_covariance(site, estimated)
    biases = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3) ** 2
    return np.asarray(block_diag(np.zeros((9, 9)), np.diag(biases), spread @ spread.T))


def _walked(earlier: State, site: Site, walk: ProcessNoise, time: float, elapsed: float) -> Array:
    """Return the covariance that biases and calibration gained in a silence (s)."""
    imu = site.platform.imu
    biases = np.repeat([imu.accel_bias_walk, imu.gyro_bias_walk], 3) ** 2 * elapsed
    of_calibration = walk.cov(earlier.calibration, time, elapsed)
    return np.asarray(block_diag(np.zeros((9, 9)), np.diag(biases), of_calibration))
