"""Where an installation can navigate: the Cramér-Rao bound of the pose over a volume.

No estimator without bias does better than the inverse of the Fisher information of one window; the
maximum-likelihood fix comes close to it.  A mirrored pose is another solution, not a wide one: the
bound is that of whoever knows on which side the platform is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from magfusion.model.field import model_error_cov
from magfusion.model.noise import model_error, paired_whitening
from magfusion.model.parameters import (
    PHASE,
    Block,
    Calibration,
    choose_blocks,
    initial_calibration,
    linearize_channels,
)
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, BoolArray, IntArray

SURVEY_GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics", "ground")
CHUNK = 500  # points linearised at once
NEAREST = 0.2  # m from a beacon's centre; nearer, coils are no dipoles
OPEN = 1e-6  # of the best determined direction, in sigmas: what counts as no information
DETECTION_CHI_SQUARE = (
    3.0  # phasor against the noise of one component, from where a beacon contributes
)
COMPARED = 400  # points at which candidates for one more beacon are compared


@dataclass(frozen=True, eq=False)
class Coverage:
    """Bound of the pose that one window gives, at each point of a volume.

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        Origin of the body (m).
    position_sigma : ndarray, shape (n,)
        Root of the sum of the three axes' variances (m); infinite where not determined.
    attitude_sigma : ndarray, shape (n,)
        The same of the rotation vector (rad); zero where the attitude is known from elsewhere.
    worst_world : ndarray, shape (n, 3)
        Unit vector along which the position is least certain; zero where not determined.
    beacons : int ndarray, shape (n,)
        How many beacons are detected above the noise.
    determined : bool ndarray, shape (n,)
        False where a direction of the pose is open, or a beacon is too near to be a dipole.
    """

    position_world: Array
    position_sigma: Array
    attitude_sigma: Array
    worst_world: Array
    beacons: IntArray
    determined: BoolArray

    def __len__(self) -> int:
        return len(self.position_world)

    def position_quantile(self, share: float) -> float:
        """Return the position sigma (m) that a share of the points keeps; infinite where open."""
        return _quantile(self.position_sigma, share)

    def attitude_quantile(self, share: float) -> float:
        """Return the attitude sigma (rad) that a share of the points keeps."""
        return _quantile(self.attitude_sigma, share)


@dataclass(frozen=True, eq=False)
class ExtraBeacon:
    """What one more beacon adds where it adds most.

    Parameters
    ----------
    beacon : Beacon
        A copy of the site's first in its best place.
    before, after : float
        Position sigma that the given share of the points keeps, without and with it (m).
    """

    beacon: Beacon
    before: float
    after: float


def volume(box_world: Array, spacing: float, heights: Array | None = None) -> Array:
    """Return the points of a regular grid that spans a box, shape (n, 3) (m).

    Parameters
    ----------
    box_world : ndarray, shape (2, 3)
        Lower and upper corner (m).
    spacing : float
        Largest distance of neighbours along an axis (m).
    heights : ndarray, optional
        Heights in place of the box's own (m).
    """
    steps = np.ceil((box_world[1] - box_world[0]) / spacing * (1.0 - 1e-9)).astype(int)
    x, y, z = (np.linspace(box_world[0, i], box_world[1, i], steps[i] + 1) for i in range(3))
    mesh = np.meshgrid(x, y, z if heights is None else heights, indexing="ij")
    return np.stack(mesh, axis=-1).reshape(-1, 3)


def usual_box(site: Site) -> Array:
    """Return the box around the beacons, somewhat widened in plan, shape (2, 3) (m)."""
    places = np.array([b.position_world for b in site.beacons])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.2 * float(np.max(high - low)) or 3.0
    box: Array = np.stack([low, high]) + np.outer([-margin, margin], [1.0, 1.0, 0.0])
    box[1, 2] = max(box[1, 2], box[0, 2] + 1.0)
    return box


def phasor_variance(site: Site, window: float) -> Array:
    """Return the variance that white noise leaves in each phasor component, (channels,) (T^2).

    A tone fitted to ``N = T rate`` samples of variance ``d^2 rate / 2`` (``d`` the one-sided
    density) has the variance ``2 / N`` of theirs in its cosine and in its sine: ``d^2 / T``,
    whatever the rate.  Coils driven in turn share the window.
    """
    slots = [slot for b in site.beacons for _, slot in b.tones]
    turns = 1 + max((slot for slot in slots if slot is not None), default=0)
    dwell = np.array([window if slot is None else window / turns for slot in slots])
    return site.platform.magnetometer.noise_density**2 / dwell


def coverage(
    site: Site,
    position_world: Array,
    window: float,
    *,
    survey: bool = True,
    attitude_known: bool = False,
    world_from_body: Array | None = None,
) -> Coverage:
    """Return the Cramér-Rao bound of the pose at each point, from the fields of one window.

    Noise and model error weigh as in the solvers.  The drive phase of a beacon without
    synchronisation is free.  The bound of the position hardly depends on the attitude: a turned
    platform sees the same field in other axes, and only the lever arm and the errors of the
    magnetometer's matrix turn with it.  So one attitude is enough.

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        Of the body (m).
    window : float
        Time over which the tones are averaged (s).
    survey : bool
        Take what the calibration's sigmas leave open for unknown, with the sigmas as its prior.
    attitude_known : bool
        Take the attitude from elsewhere, without error.
    world_from_body : ndarray, shape (3, 3), optional
        Level and along the world's axes where it is not given.
    """
    attitude = np.eye(3) if world_from_body is None else world_from_body
    variance, calibration = phasor_variance(site, window), initial_calibration(site, 0.0)
    blocks = choose_blocks(site, SURVEY_GROUPS if survey else ("phase",))
    sensor = position_world + attitude @ site.platform.magnetometer.position_body
    centres = np.array([b.position_world for b in site.beacons])
    apart = np.linalg.norm(sensor[:, None] - centres, axis=2).min(axis=1)
    far = np.flatnonzero(apart >= NEAREST)
    cov = np.full((len(position_world), 6, 6), np.inf)
    detected = np.full(len(position_world), len(site.beacons))
    determined = np.zeros(len(position_world), dtype=bool)
    for start in range(0, len(far), CHUNK):
        rows = far[start : start + CHUNK]
        by_pose, by_nuisance, detected[rows] = _whitened(
            calibration, blocks, variance, attitude, position_world[rows]
        )
        by_pose = by_pose[..., 3:] if attitude_known else by_pose
        cov[rows], determined[rows] = _bound(_root_information(by_pose, by_nuisance, site, blocks))
    return _summary(position_world, attitude, cov, detected, determined)


def best_extra_beacon(
    site: Site,
    box_world: Array,
    bound: Callable[[Site, Array], Coverage],
    position_world: Array,
    share: float = 0.5,
) -> ExtraBeacon:
    """Find where, on the boundary of a box, one more beacon of the first's kind adds most.

    Parameters
    ----------
    box_world : ndarray, shape (2, 3)
        Its corners, and the centres of its edges and faces, are the candidates (m).
    bound : callable
        `coverage` of a site at given points.
    position_world : ndarray, shape (n, 3)
        Where the platform is to navigate (m).
    share : float
        Part of the points whose position sigma is to be lowered: 0.5 for the median.
    """
    step = -(-len(position_world) // COMPARED)
    points = position_world[step // 2 :: step]
    taken = np.array([b.position_world for b in site.beacons])
    best: tuple[float, Beacon] | None = None
    for place in boundary_places(box_world):
        if np.min(np.linalg.norm(taken - place, axis=1)) < NEAREST:
            continue
        beacon = _copy(site, place)
        sigma = bound(replace(site, beacons=(*site.beacons, beacon)), points).position_sigma
        reached = _quantile(sigma, share)
        if best is None or reached < best[0]:
            best = reached, beacon
    assert best is not None  # no twenty-six beacons stand on one boundary
    return ExtraBeacon(best[1], bound(site, points).position_quantile(share), best[0])


def boundary_places(box_world: Array) -> Array:
    """Return corners, edge centres and face centres of a box, shape (26, 3) (m)."""
    shares = [s for s in product((0.0, 0.5, 1.0), repeat=3) if s != (0.5, 0.5, 0.5)]
    return box_world[0] + np.array(shares) * (box_world[1] - box_world[0])


def _copy(site: Site, place: Array) -> Beacon:
    names = {b.name for b in site.beacons}
    name = next(n for n in ("extra", *(f"extra {i}" for i in range(len(names)))) if n not in names)
    return replace(site.beacons[0], name=name, position_world=place)


def _quantile(sigma: Array, share: float) -> float:
    # Of the sorted values themselves: between a finite and an infinite one nothing lies.
    return float(np.quantile(sigma, share, method="higher"))


def _whitened(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    variance: Array,
    attitude: Array,
    position_world: Array,
) -> tuple[Array, Array, IntArray]:
    """Whitened Jacobians, (n, rows, 6) and (n, rows, nuisances); beacons detected."""
    site, count = calibration.site, len(position_world)
    rotation = np.broadcast_to(attitude, (count, 3, 3))
    value, by_pose, by_nuisance = linearize_channels(
        calibration, blocks, np.zeros(count), rotation, position_world
    )
    phasor = value[..., :3] + 1j * value[..., 3:]
    noise = variance[:, None, None] * np.eye(3)
    sensor_world = position_world + attitude @ site.platform.magnetometer.position_body
    cov = noise + model_error_cov(phasor, model_error(site, sensor_world))
    sqrt_information = paired_whitening(cov, np.ones(cov.shape[:2], dtype=bool))
    strong = np.linalg.norm(value, axis=2) > DETECTION_CHI_SQUARE * np.sqrt(variance)
    owners = np.array([[name == b.name for name, _ in site.channels] for b in site.beacons])
    detected = np.sum((strong[:, None] & owners).any(axis=2), axis=1)
    rows = (count, 6 * value.shape[1])
    return (
        (sqrt_information @ by_pose).reshape(*rows, 6),
        (sqrt_information @ by_nuisance).reshape(*rows, by_nuisance.shape[-1]),
        detected,
    )


def _root_information(
    by_pose: Array, by_nuisance: Array, site: Site, blocks: tuple[Block, ...]
) -> Array:
    """Triangular root of the pose's information with the nuisances marginalised.

    By QR of Jacobian and prior: where the survey is fine and the field strong, the difference of
    normal matrices would leave only rounding.
    """
    free = np.array([b.parameter == PHASE for b in blocks for _ in b.sigma], dtype=bool)
    spread = prior_sqrt_covariance(site, blocks)
    spread[free, free] = 1.0
    count, _, width = by_nuisance.shape
    prior = np.zeros((count, width, width + by_pose.shape[-1]))
    prior[:, np.arange(width), np.arange(width)] = ~free
    stacked = np.concatenate([by_nuisance @ spread, by_pose], axis=2)
    rows = np.concatenate([stacked, prior], axis=1)
    missing = max(rows.shape[2] - rows.shape[1], 0)  # fewer channels than unknowns
    rows = np.pad(rows, ((0, 0), (0, missing), (0, 0)))
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle[:, width : rows.shape[2], width:]


def _bound(sqrt_information: Array) -> tuple[Array, BoolArray]:
    """Covariance (n, 6, 6), with no variance for an attitude that is known; infinite where open."""
    length = np.linalg.norm(sqrt_information, axis=1)
    length = np.where(length > 0.0, length, 1.0)
    _, size, axes = np.linalg.svd(sqrt_information / length[:, None])
    determined = size[:, -1] > OPEN * size[:, 0]
    spread = np.swapaxes(axes, 1, 2) / np.where(determined[:, None], size, 1.0)[:, None]
    spread = spread / length[..., None]
    cov = np.zeros((len(sqrt_information), 6, 6))
    known = 6 - sqrt_information.shape[-1]
    cov[:, known:, known:] = spread @ np.swapaxes(spread, 1, 2)
    cov[~determined] = np.inf
    return cov, determined


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
