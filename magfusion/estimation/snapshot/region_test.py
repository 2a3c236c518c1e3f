"""Test of poses against the declared region or hemisphere: outside, or near its boundary."""

import numpy as np

from magfusion.estimation.snapshot.place import margins
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, IntArray

BEYOND = 5.0  # sigmas outside of a plane; the declaration or the pose is wrong
NEAR = 3.0  # sigmas inside, within which it does not distinguish a pose from its mirror image


def of_place(
    site: Site, time: Array, world_from_body: Array, position_world: Array, pose_cov: Array
) -> tuple[Finding, ...]:
    """Return the findings on poses of a site with a region or a hemisphere.

    `time` (n,) (s), `world_from_body` (n, 3, 3), `position_world` (n, 3) (m). `pose_cov` (n, 6, 6):
    rotation, then position; body axes.
    """
    if site.bounds is None or not len(time):
        return ()
    margin, sigma = margins(site, world_from_body, position_world, pose_cov[:, 3:, 3:])
    score = margin / sigma
    if (score >= NEAR).all():  # the usual case
        return ()
    return (*_outside(site, time, margin, score), *_near(site, time, margin, score))


def _outside(site: Site, time: Array, margin: Array, score: Array) -> tuple[Finding, ...]:
    assert site.bounds is not None
    rows = np.flatnonzero(np.any(score < -BEYOND, axis=1))
    if not len(rows):
        return ()
    row, plane = np.unravel_index(np.argmin(score), score.shape)
    text = (
        f"The magnetometer is {-margin[row, plane]:.2g} m outside of"
        f" {site.bounds.names[int(plane)]} {_when(time, rows, int(row))}: the declared hemisphere"
        " or region is wrong, or the pose is a mirrored one."
    )
    return (Finding("outside_region", text, weight=float(-score[row, plane]) / BEYOND),)


def _near(site: Site, time: Array, margin: Array, score: Array) -> tuple[Finding, ...]:
    assert site.bounds is not None
    close = np.where(score < -BEYOND, np.inf, score)
    rows = np.flatnonzero(np.any(close < NEAR, axis=1))
    if not len(rows):
        return ()
    row, plane = np.unravel_index(np.argmin(close), close.shape)
    text = (
        f"The magnetometer comes within {max(margin[row, plane], 0.0):.2g} m of"
        f" {site.bounds.names[int(plane)]} {_when(time, rows, int(row))}: here only previous data"
        " distinguish a pose from its mirror image, not the declared side."
    )
    return (Finding("region_edge", text, Verdict.TRUSTWORTHY, 0.5),)


def _when(time: Array, rows: IntArray, worst: int) -> str:
    if len(time) == 1:
        return f"at {time[0]:.2f} s"
    share = f"in {len(rows)} of {len(time)} epochs"
    return f"({share}, from {time[rows[0]]:.2f} s; the most at {time[worst]:.2f} s)"
