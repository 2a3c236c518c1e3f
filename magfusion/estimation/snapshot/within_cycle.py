"""Platform position at the time of each coil of a cycle, from neighbouring fixes.

Coils driven in turn are measured at different positions of a moving platform.  The gyroscope
measures the rotation, but not the translation, which is taken from the neighbouring cycles' fixes.
"""

from dataclasses import replace

import numpy as np

from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.place import outside
from magfusion.estimation.snapshot.problem import CycleMotion, FixEpochs
from magfusion.estimation.snapshot.refine import as_fixes, solved_from
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray

MIN_EPOCHS = 3  # epochs needed for neighbours on both sides
MAX_INTERVAL = 1.0  # s; more distant fixes are not used


def fixed_in_motion(epochs: FixEpochs, fixes: Fixes, velocity: Array, sigma: Array) -> Fixes:
    """Repeat fixes with each channel predicted at the platform's position of its measurement.

    `velocity` (n, hypotheses, 3): world axes (m/s). `sigma` (n, hypotheses): standard deviation of
    each component (m/s).
    """
    ahead = epochs.samples.ahead_or_zero
    n, count = fixes.cost.shape
    problem = epochs.reweighed(fixes.world_from_body[:, 0], fixes.position_world[:, 0])
    problem = epochs.problem if problem is None else problem
    shift = ahead[:, None, :, None] * velocity[:, :, None]
    spread = ahead[:, None] * sigma[..., None]
    rows = replace(
        problem.rows(np.repeat(np.arange(n), count)),
        motion=CycleMotion(shift.reshape(-1, *shift.shape[2:]), spread.reshape(n * count, -1)),
    )
    start = rows.start(fixes.world_from_body.reshape(-1, 3, 3), fixes.position_world.reshape(-1, 3))
    start = start._replace(
        phase=fixes.phase.reshape(n * count, -1), log_gain=fixes.log_gain.reshape(n * count, -1)
    )
    solved = solved_from(rows, start)
    result = as_fixes(rows, solved, count)
    cost = np.where(np.isfinite(fixes.cost), result.cost + outside(problem, solved, count), np.inf)
    order = np.argsort(cost, axis=1, kind="stable")
    parts = {
        name: part if part.ndim == 1 else part[np.arange(n)[:, None], order]
        for name, part in vars(replace(result, cost=cost)).items()
    }
    return Fixes(**parts)


def velocities(fixes: Fixes, site: Site, *, rotated: bool) -> tuple[Array, Array]:
    """Return the velocity of each hypothesis from the nearest ones of neighbouring epochs.

    `rotated`: whether phasors are in the axes of their own times: then the velocity is that of the
    body, else that of its magnetometer with its lever arm. Returns `velocity` (n, hypotheses, 3):
    world axes (m/s); `sigma` (n, hypotheses): standard deviation of each component (m/s); with the
    usual speed as a prior.
    """
    sensor, motion = site.platform.magnetometer, site.platform.motion
    lever = np.zeros(3) if rotated else sensor.position_body
    place = fixes.position_world + fixes.world_from_body @ lever
    variance = np.trace(fixes.pose_cov[..., 3:, 3:], axis1=2, axis2=3) / 3.0
    there = np.isfinite(fixes.cost) & fixes.determined
    here, unsure = np.arange(len(fixes)), np.full(variance.shape, np.inf)
    sides = []
    for others in (np.maximum(here - 1, 0), np.minimum(here + 1, len(here) - 1)):
        known = (others != here) & (np.abs(fixes.time[others] - fixes.time) < MAX_INTERVAL)
        result, own = _nearest(place, variance, there, others)
        use = known[:, None] & np.isfinite(own)
        sides.append(
            (
                np.where(use[..., None], result, place),
                np.where(use, own, variance),
                np.where(use, fixes.time[others][:, None], fixes.time[:, None]),
            )
        )
    (before, of_before, begin), (after, of_after, end) = sides
    run = end - begin
    some = (run > 0.0) & there
    step = np.where(some, run, 1.0)
    velocity = np.where(some[..., None], (after - before) / step[..., None], 0.0)
    changed = 0.5 * motion.accel_sigma * step
    square = np.where(some, (of_before + of_after) / step**2 + changed**2, unsure)
    usual = motion.speed_sigma**2
    share = usual / (usual + square)
    return share[..., None] * velocity, np.sqrt(usual * (1.0 - share))


def _nearest(place: Array, variance: Array, there: BoolArray, others: Array) -> tuple[Array, Array]:
    """Return the nearest hypothesis of another epoch, and its variance; infinite if none."""
    away = np.linalg.norm(place[others][:, None] - place[:, :, None], axis=3)
    away = np.where(there[others][:, None], away, np.inf)
    best = np.argmin(away, axis=2)
    rows = np.arange(len(place))[:, None]
    there_is = np.isfinite(np.min(away, axis=2))
    return place[others][rows, best], np.where(there_is, variance[others][rows, best], np.inf)
