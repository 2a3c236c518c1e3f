"""Map of the steel near a path, estimated from the log itself.

The modes of `magfusion.estimation.measurements.steel`, more of them than for the test, are
estimated with the poses by one Gauss-Newton step; a posterior covariance remains.  Steel that the
modes do not describe makes a map that is wrong and sure of itself, which no residual shows: only
another beacon does.  So each beacon is left out in turn, and the map is used if the map of the
others predicts its field better than no map.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from magfusion.estimation.batch.batch import Smoothed, solved_again
from magfusion.estimation.graph.graph import read_states
from magfusion.estimation.integrity.fixed_parameter_test import MARGIN
from magfusion.estimation.integrity.score import Score, field_residual, moved_estimate, scores_of
from magfusion.estimation.integrity.smoothed_exclusion import without_beacon
from magfusion.estimation.integrity.steel_test import (
    STEEL,
    SteelEstimate,
    amplitude_evidence,
    amplitudes,
    basis_of,
    best_explanation,
    best_size,
    block_of,
    distortion_of,
    estimated_steel,
    has_close_tones,
    poses_of_fields,
)
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.sparse_steel import voxel_variances, with_variances
from magfusion.estimation.measurements.steel import (
    MAX_EPOCHS,
    UNIT,
    SteelBasis,
    Voxels,
    steel_modes,
    without_columns,
)
from magfusion.model.parameters import Block, dimension, placed
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.steel_field import SteelField
from magfusion.model.trust import Finding, Verdict
from magfusion.units import MU0, Array

SHARED, OWN, PLACES = 400, 30, 150  # modes of a map: of all beacons, and of each tone
MIN_BEACONS = 4  # without one, three determine the pose
MOVED = Finding(
    "steel_moved",
    "The log is explained better without the map of steel in its site: steel was moved, or the map"
    " is of another room. The map is not used. Map the steel again (magfusion smooth --map-steel),"
    " or omit world.steel.",
    Verdict.TRUSTWORTHY,
)
MIN_SIZE = 0.5  # of the distortion, from which the variances of voxels are sought


class SteelMap(NamedTuple):
    """Steel near a path."""

    steel: SteelEstimate
    mean: Array  # (modes,), amplitudes (1)
    cov: Array  # (modes, modes)
    score: Score  # whose last block they are
    # error of each beacon's field as predicted by a map of the others, over that without a map
    held_out: dict[str, float]

    @property
    def voxels(self) -> Voxels:
        """Places of possible steel."""
        return basis_of(self.score).voxels

    @property
    def ratio(self) -> float:
        """Error of beacons left out, rms over all, with the map over that without."""
        return float(np.sqrt(np.mean(np.square(list(self.held_out.values())))))

    @property
    def is_used(self) -> bool:
        """Whether the map predicts beacons that it does not know."""
        return self.ratio < 1.0

    def finding(self, site: Site) -> Finding:
        """Return the finding in place of that of the test for steel."""
        text, percent = self.steel.described(site), 100.0 * self.ratio
        if self.is_used:
            text += (
                " Its map corrects the poses: made without a beacon, it predicts its fields with"
                f" {percent:.3g} % of the error without a map."
            )
            return Finding(STEEL, text, Verdict.TRUSTWORTHY, self.steel.weight)
        known = self.steel.finding(site, mapped=True)
        text = (
            " Its map is not used: made without a beacon, it predicts its fields with"
            f" {percent:.3g} % of the error without a map."
        )
        return replace(known, text=known.text + text)

    @property
    def polarisability(self) -> tuple[Array, Array]:
        """Polarisability of each voxel, rms over tones, and its sigma, shape (v,) (m^3)."""
        unit = UNIT * basis_of(self.score).polarisability
        mean = np.sum(np.abs(unit @ self.mean) ** 2, axis=2)
        variance = np.sum(((unit @ self.cov) * unit.conj()).real, axis=(2, 3))
        return np.sqrt(np.mean(mean, axis=1)), np.sqrt(np.mean(variance, axis=1))

    def on(self, site: Site) -> Site:
        """Return a site whose beacons have the steel of the map, besides what they had."""
        voxels, start, beacons = self.voxels, 0, []
        of_tones = basis_of(self.score).moment @ (UNIT / MU0 * self.mean)
        for beacon in site.beacons:
            moment = of_tones[:, start : start + len(beacon.tones)]
            start += len(beacon.tones)
            # Coils' moments are real; a tone in quadrature has those of two coils.
            drive = np.concatenate([beacon.excitation.real, beacon.excitation.imag], axis=1).T
            parts = np.concatenate([moment.real, moment.imag], axis=1)
            of_coils = np.linalg.pinv(drive) @ parts
            steel = SteelField(voxels.centre_world, 0.5 * voxels.edge, of_coils)
            known = beacon.steel
            steel = steel if known is None else known.joined(steel)
            beacons.append(replace(beacon, steel=steel))
        return replace(site, beacons=tuple(beacons))

    def applied(self, result: Smoothed) -> Smoothed:
        """Return a result whose states and calibration are those with the map."""
        cov, own = result.states.pose_cov, block_of(self.score).columns
        assert cov is not None
        estimate = moved_estimate(result, self.score, step_of(self.score, self.mean))
        states = read_states(estimate.values, result.states.time)
        by_pose, by_calibration = (
            by[..., own] for by in (self.score.by_pose, self.score.by_calibration)
        )
        return replace(
            result,
            states=replace(states, pose_cov=cov + by_pose @ self.cov @ np.swapaxes(by_pose, 1, 2)),
            calibration=estimate.calibration,
            calibration_cov=result.calibration_cov + by_calibration @ self.cov @ by_calibration.T,
            estimate=estimate,
        )


def explained_without_map(result: Smoothed) -> bool:
    """Return whether a log is explained better without its site's map of steel.

    False of a graph of fixes, which compares no fields.
    """
    if result.declared.site.without_steel() is result.declared.site:
        return False
    if not any(isinstance(m, FieldPhasors) for m in result.graph.measurements):
        return False
    estimate = result.estimate
    bare, *segments = (
        replace(known, site=known.site.without_steel())
        for known in (estimate.calibration, *estimate.segments)
    )
    start = replace(estimate, calibration=bare, segments=tuple(segments))
    try:
        other = solved_again(replace(result, estimate=start), result.graph.measurements)
    except RuntimeError:  # GTSAM's: without it the poses are undetermined
        return False
    return 2.0 * (result.cost - other.cost) > MARGIN


def step_of(score: Score, mean: Array) -> Array:
    """Return the step of all parameters of a score by amplitudes of steel."""
    step = np.zeros(len(score.gradient))
    step[block_of(score).columns] = mean
    return step


def map_steel(result: Smoothed, imu: ImuSamples) -> SteelMap | str:
    """Return the map of the steel near a path, or why there is none.

    `result`: as estimated without a map. `imu`: as recorded.
    """
    site = result.calibration.site
    if len(site.beacons) < MIN_BEACONS:
        return f"it needs {MIN_BEACONS} beacons, the log has {len(site.beacons)}"
    if has_close_tones(result):
        return "its tones are too close to be received apart"
    if site.platform.further:
        return "the platform has several magnetometers"
    poses = poses_of_fields(result)
    if len(poses) > MAX_EPOCHS:
        return f"the log has {len(poses)} epochs, {MAX_EPOCHS} are supported; shorten it by --end"
    modes = steel_modes(site, poses.time, poses, (SHARED, OWN), PLACES)
    if not modes:
        return "path and beacons span too much for the memory"
    scores = scores_of(result, imu, modes, responses=True)
    known = None if scores is None else best_explanation(scores.every, 0.0)
    if scores is None or known is None:
        return "the log shows none"
    held_out = {}
    for beacon in site.beacons:
        ratio = _held_out(result, imu, modes, beacon.name)
        if ratio is None:
            return f"without beacon {beacon.name} the poses are undetermined"
        held_out[beacon.name] = ratio
    gain, sigma = known
    distortion, (score, sigma) = distortion_of(sigma), _sparse(scores.every, sigma, site)
    steel = estimated_steel(score, gain, sigma, distortion)
    return SteelMap(steel, *amplitudes(score, sigma), score, held_out)


def _sparse(score: Score, sigma: Array, site: Site) -> tuple[Score, Array]:
    """Return a score with the steel in as few voxels as explain it, and sigmas of its amplitudes.

    `sigma` (modes,): of the amplitudes, with the same variance in all voxels.
    """
    basis, shared = basis_of(score), slice(0, basis_of(score).shared)
    size, own = len(score.gradient), len(sigma) - shared.stop
    spread = np.eye(size)[:, size - own :] * sigma[shared.stop :]  # of each tone's own moments
    alone = replace(score, spread=np.concatenate([score.spread, spread], axis=1))
    information, gradient = amplitude_evidence(alone)
    evidence = information[shared, shared], gradient[shared]
    variance = voxel_variances(basis, *evidence, max(float(sigma[0]), MIN_SIZE))
    few = _with_basis(score, *with_variances(basis, site, variance))
    is_shared = np.arange(len(block_of(few).sigma)) < basis_of(few).shared
    return few, best_size(*amplitude_evidence(few), is_shared)[1]


def _with_basis(score: Score, basis: SteelBasis, old_by_new: Array) -> Score:
    """Return a score with other shared modes, linear in those before."""
    block, size = block_of(score), len(score.gradient)
    fixed = placed((*(b for b in score.fixed if b is not block), *without_columns(basis)))
    first, last = block.columns.start, block.columns.start + len(old_by_new)
    by = block_diag(np.eye(first), old_by_new, np.eye(size - last))
    return Score(
        fixed,
        by.T @ score.information @ by,
        by.T @ score.gradient,
        np.pad(score.spread[:first], ((0, dimension(fixed) - first), (0, 0))),
        score.by_state @ by,
        score.by_calibration @ by,
    )


def _held_out(
    result: Smoothed, imu: ImuSamples, modes: tuple[Block, ...], name: str
) -> float | None:
    """Return the error of a beacon's field by a map of the others, over that without a map.

    None where the others do not determine the poses.
    """
    try:
        others = solved_again(result, without_beacon(result, name))
    except RuntimeError:  # GTSAM's: without it the pose is undetermined
        return None
    scores = scores_of(others, imu, modes, responses=True)
    known = None if scores is None else best_explanation(scores.every, 0.0)
    if scores is None or known is None:
        return 1.0
    whole = replace(others, graph=result.graph)
    own = np.array([owner == name for owner, _ in result.fields.channels])
    before = field_residual(whole, others.estimate, raw=True)[:, own]
    few = _sparse(scores.every, known[1], others.calibration.site)
    after = _predicted_error(whole, *few)[:, own]
    return float(np.sqrt(np.nansum(after**2) / np.nansum(before**2)))


def _predicted_error(result: Smoothed, score: Score, sigma: Array) -> Array:
    """Return whitened errors of the fields with the shared modes of a score, (n, channels, 6).

    The moments of each tone's own are unknown of a beacon that is left out.
    """
    basis, (mean, _) = basis_of(score), amplitudes(score, sigma)
    moment = basis.moment[..., : basis.shared] @ (UNIT * mean[: basis.shared, None])
    poses, added = poses_of_fields(result), basis._replace(moment=moment)
    place = poses.world_from_body, poses.position_world
    field = added.phasors(result.calibration, poses.time, *place)[..., 0]
    parts = np.concatenate([field.real, field.imag], axis=-1)
    moved = moved_estimate(result, score, step_of(score, mean))
    measured = next(m for m in result.graph.measurements if isinstance(m, FieldPhasors)).alone()
    steel = (measured.sqrt_information @ parts[..., None])[..., 0]
    return np.asarray(field_residual(result, moved, raw=True) + steel)
