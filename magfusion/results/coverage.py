"""Where an installation can navigate: the Cramér-Rao bound of the pose over a volume.

No unbiased estimator is better than the inverse of the Fisher information of one window; the
maximum-likelihood fix comes close to it.  A mirrored pose is a separate solution, not a larger
sigma: the bound assumes that the side of the platform is known.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from magfusion.model.detection_range import are_many, largest_fields, phasor_sigma
from magfusion.model.parameters import beacons_of, choose_blocks, initial_calibration
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import Risk
from magfusion.results.pose_information import (
    NEAREST,
    SURVEY_GROUPS,
    bound,
    prior_of,
    protected,
    root_information,
    whitened,
)
from magfusion.results.pose_information import phasor_variance as phasor_variance
from magfusion.units import Array, BoolArray, IntArray

CHUNK = 500  # points linearised at once
TOGETHER = 64  # points at which the same of many beacons are heard
COMPARED = 400  # points at which candidates for one more beacon are compared


@dataclass(frozen=True, eq=False)
class Coverage:
    """Bound of the pose from one window, at each point of a volume."""

    position_world: Array  # (n, 3), origin of the body (m)
    # (n,), root of the sum of the three axes' variances (m); infinite where not determined
    position_sigma: Array
    # (n,), the same of the rotation vector (rad); zero where the attitude is known independently
    attitude_sigma: Array
    # (n, 3), unit vector along which the position is least certain; zero where not determined
    worst_world: Array
    beacons: IntArray  # (n,), number of beacons detected above the noise
    # (n,), False where a direction of the pose is undetermined, or a beacon is too close to be a
    # dipole
    determined: BoolArray
    # protection_level_m, protection_level_deg: (n,), bounds of the errors of position and attitude
    # with an undetected fault of one beacon; infinite where there is none. None without a risk
    protection_level_m: Array | None = None
    protection_level_deg: Array | None = None

    def __len__(self) -> int:
        return len(self.position_world)

    def position_quantile(self, share: float) -> float:
        """Return the position sigma (m) met by a share of points; infinite where undetermined."""
        return _quantile(self.position_sigma, share)

    def attitude_quantile(self, share: float) -> float:
        """Return the attitude sigma (rad) met by a share of the points."""
        return _quantile(self.attitude_sigma, share)


@dataclass(frozen=True, eq=False)
class ExtraBeacon:
    """Best placement of one more beacon, and its effect.

    `beacon`: a copy of the site's first at its best position. `before`, `after`: position sigma met
    by the given share of the points, without and with it (m).
    """

    beacon: Beacon
    before: float
    after: float


def volume(box_world: Array, spacing: float, heights: Array | None = None) -> Array:
    """Return the points of a regular grid that spans a box, shape (n, 3) (m).

    `box_world` (2, 3): lower and upper corner (m). `spacing`: largest distance of neighbours along
    an axis (m). `heights`: heights instead of the box's own (m).
    """
    steps = np.ceil((box_world[1] - box_world[0]) / spacing * (1.0 - 1e-9)).astype(int)
    x, y, z = (np.linspace(box_world[0, i], box_world[1, i], steps[i] + 1) for i in range(3))
    mesh = np.meshgrid(x, y, z if heights is None else heights, indexing="ij")
    return np.stack(mesh, axis=-1).reshape(-1, 3)


def usual_box(site: Site) -> Array:
    """Return the box around the beacons, somewhat enlarged in plan, shape (2, 3) (m)."""
    places = np.array([b.position_world for b in site.beacons])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.2 * float(np.max(high - low)) or 3.0
    box: Array = np.stack([low, high]) + np.outer([-margin, margin], [1.0, 1.0, 0.0])
    box[1, 2] = max(box[1, 2], box[0, 2] + 1.0)
    return box


def coverage(
    site: Site,
    position_world: Array,
    window: float,
    *,
    survey: bool = True,
    attitude_known: bool = False,
    world_from_body: Array | None = None,
    risk: Risk | None = None,
) -> Coverage:
    """Return the Cramér-Rao bound of the pose at each point, from the fields of one window.

    Noise and model error have the same weights as in the solvers.  The drive phase of an
    unsynchronised beacon is estimated.  The bound of the position hardly depends on the attitude: a
    rotated platform measures the same field in other axes, and only the lever arm and the errors of
    the magnetometer's matrix rotate with it.  So one attitude is enough.

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        Of the body (m).
    window : float
        Time over which the tones are averaged (s).
    survey : bool
        Whether uncertain calibration parameters are estimated too, with their sigmas as prior.
    attitude_known : bool
        Whether the attitude is known independently, without error.
    world_from_body : ndarray, shape (3, 3), optional
        By default level and along the world's axes.
    risk : Risk, optional
        Specification of the protection levels, which are computed only if it is given.
    """
    attitude = np.eye(3) if world_from_body is None else world_from_body
    if are_many(site) and len(position_world):
        parts = []
        for start in range(0, len(position_world), TOGETHER):
            points = position_world[start : start + TOGETHER]
            near = _site_detected_at(site, points, window)
            own = _of_window(near, points, window, survey, attitude_known, attitude, risk)
            parts.append(own)
        return _joined(parts)
    return _of_window(site, position_world, window, survey, attitude_known, attitude, risk)


def _site_detected_at(site: Site, position_world: Array, window: float) -> Site:
    """Return a site of the beacons that are detected at any of some points."""
    largest = np.max(largest_fields(site, position_world), axis=0)
    detected = beacons_of(site, np.asarray(largest > phasor_sigma(site, window))).tolist()
    kept = detected or [0]
    others = tuple((k, b) for k, b in enumerate(site.beacons) if k not in kept)
    return replace(site, beacons=tuple(site.beacons[k] for k in kept), undetected=others)


def _joined(parts: list[Coverage]) -> Coverage:
    """Return the coverage of all points."""
    values: dict[str, Any] = {}
    for name, first in vars(parts[0]).items():
        each = [getattr(part, name) for part in parts]
        values[name] = None if first is None else np.concatenate(each)
    return Coverage(**values)


def _of_window(
    site: Site,
    position_world: Array,
    window: float,
    survey: bool,
    attitude_known: bool,
    attitude: Array,
    risk: Risk | None,
) -> Coverage:
    variance, calibration = phasor_variance(site, window), initial_calibration(site, 0.0)
    blocks = choose_blocks(site, SURVEY_GROUPS if survey else ("phase",))
    prior = prior_of(site, blocks)
    sensor = position_world + attitude @ site.platform.magnetometer.position_body
    centres = np.array([b.position_world for b in site.beacons])
    separate = np.linalg.norm(sensor[:, None] - centres, axis=2).min(axis=1)
    far = np.flatnonzero(separate >= NEAREST)
    cov = np.full((len(position_world), 6, 6), np.inf)
    detected = np.full(len(position_world), len(site.beacons))
    determined = np.zeros(len(position_world), dtype=bool)
    level = None if risk is None else np.full((len(position_world), 2), np.inf)
    for start in range(0, len(far), CHUNK):
        rows = far[start : start + CHUNK]
        seen = whitened(calibration, blocks, variance, attitude, position_world[rows])
        seen = seen.at_known_attitude() if attitude_known else seen
        detected[rows] = seen.detected
        cov[rows], determined[rows] = bound(root_information(seen, *prior))
        if risk is not None and level is not None:
            without = [
                bound(root_information(seen.without(beacon), *prior))
                for beacon in range(len(site.beacons))
            ]
            level[rows] = protected((cov[rows], determined[rows]), without, risk)
    result = _summary(position_world, attitude, cov, detected, determined)
    if level is None:
        return result
    return replace(result, protection_level_m=level[:, 0], protection_level_deg=level[:, 1])


def best_extra_beacon(
    site: Site, box_world: Array, bound: Callable[[Site, Array], Coverage], position_world: Array
) -> ExtraBeacon:
    """Find the best position of one more beacon of the first's kind, on the boundary of a box.

    `box_world` (2, 3): its corners, and the centres of its edges and faces, are the candidates (m).
    `bound`: `coverage` of a site at given points. `position_world` (n, 3): positions of the
    platform to navigate at (m); the median of their sigmas is minimised.
    """
    step = -(-len(position_world) // COMPARED)
    points = position_world[step // 2 :: step]
    selected = np.array([b.position_world for b in site.beacons])
    best: tuple[float, Beacon] | None = None
    for place in boundary_places(box_world):
        if np.min(np.linalg.norm(selected - place, axis=1)) < NEAREST:
            continue
        beacon = _copy(site, place)
        sigma = bound(replace(site, beacons=(*site.beacons, beacon)), points).position_sigma
        reached = _quantile(sigma, 0.5)
        if best is None or reached < best[0]:
            best = reached, beacon
    assert best is not None  # no twenty-six beacons stand on one boundary
    return ExtraBeacon(best[1], bound(site, points).position_quantile(0.5), best[0])


def boundary_places(box_world: Array) -> Array:
    """Return corners, edge centres and face centres of a box, shape (26, 3) (m)."""
    shares = [s for s in product((0.0, 0.5, 1.0), repeat=3) if s != (0.5, 0.5, 0.5)]
    return box_world[0] + np.array(shares) * (box_world[1] - box_world[0])


def _copy(site: Site, place: Array) -> Beacon:
    names = {b.name for b in site.beacons}
    name = next(n for n in ("extra", *(f"extra {i}" for i in range(len(names)))) if n not in names)
    # It will have a separate frequency, at which the field is the same as at the first's.
    return replace(site.beacons[0], name=name, position_world=place, planned=True)


def _quantile(sigma: Array, share: float) -> float:
    # Use the sorted values themselves: do not interpolate between finite and infinite.
    return float(np.quantile(sigma, share, method="higher"))


def _summary(
    position_world: Array, attitude: Array, cov: Array, detected: IntArray, determined: BoolArray
) -> Coverage:
    variance = np.diagonal(cov, axis1=1, axis2=2)
    finite = np.where(determined[:, None, None], cov[:, 3:, 3:], np.eye(3))
    worst_body = np.linalg.eigh(finite)[1][..., -1]
    return Coverage(
        position_world=position_world,
        position_sigma=np.sqrt(np.sum(variance[:, 3:], axis=1)),
        attitude_sigma=np.sqrt(np.sum(variance[:, :3], axis=1)),
        worst_world=np.where(determined[:, None], worst_body @ attitude.T, 0.0),
        beacons=detected,
        determined=determined,
    )
