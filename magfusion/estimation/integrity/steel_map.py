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
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import Smoothed, solved_again
from magfusion.estimation.integrity.score import (
    Score,
    field_residual,
    moved_estimate,
    scores_of,
)
from magfusion.estimation.integrity.smoothed_exclusion import without_beacon
from magfusion.estimation.integrity.steel_test import (
    STEEL,
    SteelEstimate,
    amplitudes,
    best_explanation,
    block_of,
    estimated_steel,
    has_close_tones,
    poses_of_fields,
)
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.steel import UNIT, SteelBasis, SteelModes, steel_modes
from magfusion.model.parameters import Block
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

SHARED, OWN, PLACES = 400, 30, 150  # modes of a map: of all beacons, and of each tone
LEAST_BEACONS = 3  # without one, the others determine the pose
USED = 0.97  # largest error of a beacon left out, with the map over that without


class SteelMap(NamedTuple):
    """Steel near a path.

    Parameters
    ----------
    steel : SteelEstimate
    basis : SteelBasis
    mean : ndarray, shape (modes,)
        Amplitudes (1).
    cov : ndarray, shape (modes, modes)
    by_pose : ndarray, shape (states, 6, modes)
        Effect of a unit of each on the poses.
    held_out : dict
        Error of each beacon's field as predicted by a map of the others, over that without a map.
    """

    steel: SteelEstimate
    basis: SteelBasis
    mean: Array
    cov: Array
    by_pose: Array
    held_out: dict[str, float]

    @property
    def ratio(self) -> float:
        """Error of beacons left out, rms over all, with the map over that without."""
        return float(np.sqrt(np.mean(np.square(list(self.held_out.values())))))

    @property
    def is_used(self) -> bool:
        """Whether the map predicts beacons that it does not know."""
        return self.ratio < USED

    def finding(self, site: Site) -> Finding:
        """Return the finding in place of that of the test for steel."""
        text, percent = self.steel.described(site), 100.0 * self.ratio
        if self.is_used:
            text += (
                " Its map corrects the poses: made without a beacon, it predicts its fields with"
                f" {percent:.0f} % of the error without a map."
            )
            return Finding(STEEL, text, Verdict.TRUSTWORTHY, self.steel.weight)
        known = self.steel.finding(site)
        text = (
            " Its map is not used: made without a beacon, it predicts its fields with"
            f" {percent:.0f} % of the error without a map (at most {100.0 * USED:.0f} %)."
        )
        return replace(known, text=known.text + text)

    @property
    def polarisability(self) -> tuple[Array, Array]:
        """Mean polarisability of each voxel over tones, rms, and its sigma, shape (v,) (m^3)."""
        basis = self.basis.polarisability
        mean = np.linalg.norm(basis @ (UNIT * self.mean), axis=2)
        spread = np.sqrt(np.sum(np.abs(basis @ (UNIT * _root(self.cov))) ** 2, axis=(2, 3)))
        return tuple(np.sqrt(np.mean(part**2, axis=1)) for part in (mean, spread))

    def applied(self, result: Smoothed) -> Smoothed:
        """Return a result whose poses are those with the map."""
        states, cov = result.states, result.states.pose_cov
        assert cov is not None
        step = self.by_pose @ self.mean
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        shift_world = (states.world_from_body @ step[:, 3:, None])[..., 0]
        moved = replace(
            states,
            world_from_body=states.world_from_body @ turn,
            position_world=states.position_world + shift_world,
            pose_cov=cov + self.by_pose @ self.cov @ np.swapaxes(self.by_pose, 1, 2),
        )
        return replace(result, states=moved)


def _root(cov: Array) -> Array:
    value, vector = np.linalg.eigh(cov)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


def map_steel(result: Smoothed, imu: ImuSamples) -> SteelMap | None:
    """Return the map of the steel near a path; None if there is none, or none can be tested.

    Parameters
    ----------
    result : Smoothed
        As estimated without a map.
    imu : ImuSamples
        As recorded.
    """
    site = result.calibration.site
    if has_close_tones(result) or len(site.beacons) <= LEAST_BEACONS:
        return None
    poses = poses_of_fields(result)
    modes = steel_modes(site, poses.time, poses, (SHARED, OWN), PLACES)
    estimate = _estimate(result, imu, modes) if modes else None
    if estimate is None:
        return None
    score, known, mean, cov = estimate
    block = block_of(score)
    assert isinstance(block.parameter, SteelModes)
    held_out = {}
    for beacon in site.beacons:
        ratio = _held_out(result, imu, modes, beacon.name)
        if ratio is None:
            return None
        held_out[beacon.name] = ratio
    by_pose = score.by_pose[..., block.columns]
    return SteelMap(known, block.parameter.basis, mean, cov, by_pose, held_out)


def _estimate(
    result: Smoothed, imu: ImuSamples, modes: tuple[Block, ...]
) -> tuple[Score, SteelEstimate, Array, Array] | None:
    """Return the score, the steel by it, and mean and covariance of its amplitudes."""
    scores = scores_of(result, imu, modes, responses=True)
    known = None if scores is None else best_explanation(scores.every, 0.0)
    if scores is None or known is None:
        return None
    every, (gain, sigma) = scores.every, known
    return every, estimated_steel(every, gain, sigma), *amplitudes(every, sigma)


def _held_out(
    result: Smoothed, imu: ImuSamples, modes: tuple[Block, ...], name: str
) -> float | None:
    """Return the error of a beacon's field by a map of the others, over that without a map."""
    try:
        others = solved_again(result, without_beacon(result, name))
    except RuntimeError:  # GTSAM's: without it the pose is undetermined
        return None
    every = replace(others, graph=result.graph)
    own = np.array([owner == name for owner, _ in result.fields.channels])
    before = field_residual(every, others.estimate, raw=True)[:, own]
    estimate = _estimate(others, imu, modes)
    if estimate is None:
        return 1.0
    score, _, mean, _ = estimate
    block = block_of(score)
    assert isinstance(block.parameter, SteelModes)
    step = np.zeros(len(score.gradient))
    step[block.columns] = mean
    after = field_residual(every, moved_estimate(others, score, step), raw=True)[:, own]
    shared = np.where(np.arange(len(mean)) < block.parameter.basis.shared, UNIT * mean, 0.0)
    phasors = next(m for m in result.graph.measurements if isinstance(m, FieldPhasors)).alone()
    poses = poses_of_fields(others)
    added = block.parameter.basis.phasors(
        others.calibration, poses.time, poses.world_from_body, poses.position_world
    )
    field = (added @ shared)[:, own]
    parts = np.concatenate([field.real, field.imag], axis=-1)
    after = after + (phasors.sqrt_information[:, own] @ parts[..., None])[..., 0]
    return float(np.sqrt(np.nansum(after**2) / np.nansum(before**2)))
