"""Information of one window's fields on a pose, and its remainder without one beacon.

The rows are whitened as in the solvers.  Uncertain survey parameters are marginalised by QR of
Jacobian and prior: for an accurate survey and a strong field, the difference of normal matrices
would be dominated by rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import Separation
from magfusion.model.detection_range import owned_at
from magfusion.model.noise import (
    magnetometers_sharing_error,
    model_error,
    model_error_cov,
    paired_whitening,
    sensors_at,
)
from magfusion.model.parameters import PHASE, Block, Calibration, linearize_channels
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.site import Site
from magfusion.model.trust import Risk
from magfusion.units import Array, BoolArray, IntArray

SURVEY_GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics", "ground")
NEAREST = 0.2  # m from a beacon's centre; nearer, coils are no dipoles
OPEN = 1e-6  # of the best determined direction, in sigmas: what counts as no information
DETECTION_CHI_SQUARE = (
    3.0  # phasor against the noise of one component, from where a beacon contributes
)


@dataclass(frozen=True, eq=False)
class PoseRows:
    """Whitened Jacobians of the fields at each of some poses."""

    # (n, rows, 6), rotation, then position, body axes; the position alone for a known attitude
    by_pose: Array
    by_nuisance: Array  # (n, rows, nuisances), by the uncertain survey parameters
    owner: IntArray  # (rows,), beacon of each row
    detected: IntArray  # (n,), number of beacons detected above the noise

    def without(self, beacon: int) -> "PoseRows":
        """Return the rows without one beacon: its own are empty."""
        kept = (self.owner != beacon)[:, None]
        return replace(self, by_pose=self.by_pose * kept, by_nuisance=self.by_nuisance * kept)

    def at_known_attitude(self) -> "PoseRows":
        """Return the rows with the attitude known independently."""
        return replace(self, by_pose=self.by_pose[..., 3:])


def phasor_variance(site: Site, window: float) -> Array:
    """Return the variance of each phasor component due to white noise, (channels,) (T^2).

    A tone fitted to ``N = T rate`` samples of variance ``d^2 rate / 2`` (``d`` the one-sided
    density) has the variance ``2 / N`` of theirs in its cosine and in its sine: ``d^2 / T``,
    at any rate.  Coils driven in turn share the window.  A beacon's `noise_factor` is included.
    """
    slots = [slot for b in site.beacons for _, slot in b.tones]
    turns = 1 + max((slot for slot in slots if slot is not None), default=0)
    dwell = np.array([window if slot is None else window / turns for slot in slots])
    factor = np.array([beacon.noise_factor for beacon in site.beacons for _ in beacon.tones])
    return factor**2 * (site.platform.magnetometer.noise_density**2 / dwell)


def whitened(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    variance: Array,
    attitude: Array,
    position_world: Array,
) -> PoseRows:
    """Return the whitened Jacobians of all channels at places.

    `variance` (channels,): of a phasor's components, due to noise alone (T^2). `attitude` (3, 3):
    world_from_body, the same everywhere. `position_world` (n, 3) (m).
    """
    site, count = calibration.site, len(position_world)
    rotation = np.broadcast_to(attitude, (count, 3, 3))
    value, by_pose, by_nuisance = linearize_channels(
        calibration, blocks, np.zeros(count), rotation, position_world
    )
    phasor = value[..., :3] + 1j * value[..., 3:]
    noise = variance[:, None, None] * np.eye(3)
    sensor_world = sensors_at(site, rotation, position_world)
    error = model_error(site, sensor_world)
    each = [owned_at(site, place).channels for place in np.swapaxes(sensor_world, 0, 1)]
    owned = np.concatenate(each, axis=1)
    if site.platform.further:
        error = error * np.sqrt(magnetometers_sharing_error(site, owned))
    cov = noise + model_error_cov(phasor, error)
    sqrt_information = paired_whitening(cov, owned)
    strong = np.linalg.norm(value, axis=2) > DETECTION_CHI_SQUARE * np.sqrt(variance)
    strong &= owned
    owner = site.owner
    owners = owner == np.arange(len(site.beacons))[:, None]
    detected = np.sum((strong[:, None] & owners).any(axis=2), axis=1)
    rows = (count, 6 * value.shape[1])
    return PoseRows(
        (sqrt_information @ by_pose).reshape(*rows, 6),
        (sqrt_information @ by_nuisance).reshape(*rows, by_nuisance.shape[-1]),
        np.repeat(owner, 6),
        detected,
    )


def is_free(blocks: tuple[Block, ...]) -> BoolArray:
    """Return which nuisances have no prior, shape (nuisances,)."""
    return np.array([b.parameter == PHASE for b in blocks for _ in b.sigma], dtype=bool)


def prior_of(site: Site, blocks: tuple[Block, ...]) -> tuple[Array, Array]:
    """Return the scale from unit nuisances, and the prior rows of these about zero."""
    free_parameters = is_free(blocks)
    spread = prior_sqrt_covariance(site, blocks)
    spread[free_parameters, free_parameters] = 1.0
    return spread, np.diag((~free_parameters).astype(float))


def root_information(seen: PoseRows, spread: Array, prior: Array, shared: int = 0) -> Array:
    """Return a triangular root of the pose's information with the nuisances marginalised.

    `spread` (nuisances, nuisances): scale from the nuisances of the prior. `prior` (k, nuisances):
    rows of the prior. `shared`: number of the last nuisances that remain, in front of the pose.
    Returns (n, k, shared + 6).
    """
    reported = np.any(seen.by_nuisance, axis=(0, 1)) | np.any(prior, axis=0)
    reported[len(reported) - shared :] = True
    # A column of zeros would use a row of the triangle that others need.
    by_nuisance, prior = (seen.by_nuisance @ spread)[..., reported], prior[:, reported]
    count, _, width = by_nuisance.shape
    known = np.zeros((count, len(prior), width + seen.by_pose.shape[-1]))
    known[:, :, :width] = prior
    stacked = np.concatenate([by_nuisance, seen.by_pose], axis=2)
    rows = np.concatenate([stacked, known], axis=1)
    missing = max(rows.shape[2] - rows.shape[1], 0)  # fewer channels than unknowns
    rows = np.pad(rows, ((0, 0), (0, missing), (0, 0)))
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    own = width - shared
    return triangle[:, own : rows.shape[2], own:]


def bound(sqrt_information: Array) -> tuple[Array, BoolArray]:
    """Return the pose's covariance, shape (n, 6, 6), and whether it is determined, shape (n,).

    A known attitude has no variance; infinite where a direction is undetermined.
    """
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


def protected(
    whole: tuple[Array, BoolArray], without: Sequence[tuple[Array, BoolArray]], risk: Risk
) -> Array:
    """Return the protection levels of position (m) and attitude (deg), shape (n, 2).

    Those of `magfusion.estimation.posterior.separation` with the covariances of a best estimate,
    without measurements.  Infinite where there is none. `whole`: covariance (n, 6, 6) with all
    beacons, and whether the pose is determined (n,). `without`: the same without each beacon.
    """
    cov, known = whole
    level = np.full((len(cov), 2), np.inf)
    rows = np.flatnonzero(known & np.all([determined for _, determined in without], axis=0))
    if not len(rows):
        return level
    full = cov[rows]
    subset = np.stack([other[rows] for other, _ in without], axis=1)
    shape = subset.shape[:2]
    separation = Separation(
        step=np.zeros((*shape, 6)),
        cov=full,
        subset_cov=subset,
        separation_cov=subset - full[:, None],
        determined=np.ones(shape, dtype=bool),
        cost=np.zeros(shape),
        rows=np.ones(shape),
    )
    level[rows] = np.stack(protection_levels(separation, risk), axis=1)
    return np.where(np.isnan(level), np.inf, level)
