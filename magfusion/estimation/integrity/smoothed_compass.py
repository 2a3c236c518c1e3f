"""Test of the static field at the poses of a smoothed log that does not use the Earth field."""

import numpy as np

from magfusion.estimation.data_checks.data_quality import beginning
from magfusion.estimation.data_checks.steady_field import OffEarth, off_earth
from magfusion.estimation.data_checks.still_means import SPAN, still_means
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

TOGETHER = 3  # spans, whose mean is tested; about the memory of the same test online
NEAR = 0.5 * SPAN + 1.0  # s; largest distance of a state from the middle of a span


def compass(case: Case) -> TestResult:
    """Test the static field at the poses, and doubt the poses of the spans where it differs."""
    site, states, log = case.result.declared.site, case.result.states, case.log
    if case.result.earth_residual is not None or site.earth_field_world is None:
        return NOTHING
    if log.vectors is None or len(site.platform.magnetometer.axes) < 3 or not len(states):
        return NOTHING
    means = still_means(beginning(log), site)
    near, row, attitude = means.near(states, NEAR)
    field_body = means.field_body[near]
    if len(row) < TOGETHER or not np.all(np.isfinite(field_body)):
        return NOTHING
    residual = np.einsum("nij,nj->ni", attitude, field_body) - site.earth_field_world
    cov = attitude @ case.pose_cov[row, :3, :3] @ np.swapaxes(attitude, 1, 2)
    result = [
        off_earth(site, np.mean(residual[k : k + TOGETHER], axis=0), cov[k])
        for k in range(len(row) - TOGETHER + 1)
    ]
    off = [one for one in result if one is not None]
    if not off:
        return NOTHING
    worst = max(off, key=lambda one: one.score)
    return TestResult((worst.finding,), spread=_spread(states, means.time[near], result))


def _spread(states: Trajectory, time: Array, result: list[OffEarth | None]) -> Array:
    """Return the possible errors of the poses nearest to each span, shape (states, 6, 6)."""
    middle = time[TOGETHER // 2 : len(time) - TOGETHER // 2]
    nearest = np.argmin(np.abs(states.time[:, None] - middle), axis=1)
    spread = np.zeros((len(states), 6, 6))
    for k, one in enumerate(result):
        if one is None:
            continue
        for row in np.flatnonzero(nearest == k).tolist():
            spread[row, :3, :3] = one.turn**2 * np.eye(3)
            spread[row, 3:, 3:] = one.shift(states.position_world[row]) ** 2 * np.eye(3)
    return spread
