"""Response of a receiver's axes from the fields of a coil at poses known up to small errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.field_snapshots import JointEstimate, Snapshots
from magfusion.estimation.solve.batched import NormalEquations
from magfusion.model.parameters import (
    DRIFT,
    PHASOR_PARAMETERS,
    Block,
    choose_blocks,
    predict_channels,
)
from magfusion.units import Array

GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics")


@dataclass(frozen=True, eq=False, kw_only=True)
class BenchSnapshots(Snapshots):
    """Phasors at poses that are known up to an error of each."""

    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3) (m)
    pose_sigma: Array  # (6,), of rotation, then position, body axes (rad, m)

    def with_phases(self) -> BenchSnapshots:
        """Return the same with the drive phases that fit best as declared."""
        places = self.samples.time, self.world_from_body, self.position_world
        measured = np.nan_to_num(self.samples.phasor_sensor)
        expected = predict_channels(self.calibration, *places)
        lead = np.angle(np.sum(np.conj(expected) * measured, axis=(0, 2)))
        own = [not self.site.beacons[k].synchronised for k in self.site.owner]
        return replace(self, calibration=replace(self.calibration, phase=np.where(own, lead, 0.0)))

    def fit(self) -> tuple[float, JointEstimate, Array, tuple[Block, ...]]:
        """Return chi square, estimate, covariance of the calibration, and its blocks."""
        kinds = [p for p in PHASOR_PARAMETERS if p != DRIFT]  # all points are of one time
        chosen = choose_blocks(self.site, GROUPS, parameters=kinds)
        start = self.world_from_body, self.position_world
        cost, result, information = self.minimised(chosen, *start)
        own = 6 * len(self.samples)
        return cost, result, np.asarray(np.linalg.inv(information)[own:, own:]), chosen

    def normal(self, at: JointEstimate, blocks: tuple[Block, ...]) -> NormalEquations:
        """Return the normal equations of the fields, with the known poses."""
        fields = super().normal(at, blocks)
        known = np.swapaxes(self.world_from_body, 1, 2)
        turn = Rotation.from_matrix(known @ at.turn).as_rotvec()
        moved = np.swapaxes(at.turn, 1, 2) @ (at.place - self.position_world)[..., None]
        error = np.concatenate([turn, moved[..., 0]], axis=1).ravel()
        weight = np.tile(self.pose_sigma**-2.0, len(self.samples))
        information, gradient = fields.information[0], fields.gradient[0]
        poses = np.arange(len(error))
        information[poses, poses] += weight
        gradient[poses] += weight * error
        cost = fields.cost + np.sum(weight * error**2)
        return NormalEquations(cost, gradient[None], information[None])
