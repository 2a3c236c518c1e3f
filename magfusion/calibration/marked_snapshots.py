"""Fields at known marks, with check distances: what proves an installation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.field_snapshots import JointEstimate, Snapshots
from magfusion.estimation.solve.batched import NormalEquations
from magfusion.model.check_distance import CheckDistance
from magfusion.model.parameters import BEACON_POSITION, Block, predict_channels
from magfusion.units import Array, ComplexArray

HEADINGS = 36  # initial headings that are compared
DETECTED = 10.0  # signal to noise from which a beacon decides on the heading
CAP = 0.5  # largest share of a beacon's power that one contradicting beacon costs


@dataclass(frozen=True, eq=False)
class MarkedSnapshots(Snapshots):
    """Phasors of epochs at known marks, and check distances."""

    # (n, 3), mark of each epoch (m)
    marks_world: Array = field(default_factory=lambda: np.zeros((0, 3)))
    mark_sigma: float = 0.01  # of a mark's coordinates and of the placement on it (m)
    # (3,), point of the platform that is on the mark (m)
    lever_body: Array = field(default_factory=lambda: np.zeros(3))
    # (n, 3), direction of the specific force at each epoch
    up_body: Array = field(default_factory=lambda: np.zeros((0, 3)))
    distances: tuple[CheckDistance, ...] = ()
    points_world: dict[str, Array] = field(default_factory=dict)  # marks by their names (m)

    def initial_poses(self) -> tuple[Array, Array]:
        """Return poses on the marks, with the heading that most beacons agree on.

        One wrong beacon costs no heading more than another, so that it does not decide.
        """
        tilt = Rotation.concatenate(
            [Rotation.align_vectors([[0.0, 0.0, 1.0]], up[None])[0] for up in self.up_body]
        )
        cost, turns = [], []
        for heading in np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False):
            turn = (Rotation.from_euler("z", heading) * tilt).as_matrix()
            cost.append(self._disagreement(turn, self.marks_world - turn @ self.lever_body))
            turns.append(turn)
        best = np.array(turns)[np.argmin(cost, axis=0), np.arange(len(self.up_body))]
        return best, self.marks_world - best @ self.lever_body

    def gains(self, turn: Array, place: Array) -> Array:
        """Return each beacon's measured over expected field at poses, shape (beacons,)."""
        expected, measured, weight = self._phasors(turn, place)
        own = self.site.owner == np.arange(len(self.site.beacons))[:, None]
        power = np.sum(weight * np.abs(expected) ** 2, axis=(0, 2)) @ own.T
        shared = np.sum(weight * (np.conj(expected) * measured).real, axis=(0, 2)) @ own.T
        return np.asarray(shared / np.maximum(power, 1e-300))

    def detected(self) -> Array:
        """Return at how many marks each beacon is well above the noise, shape (beacons,)."""
        strong = np.abs(np.nan_to_num(self.samples.phasor_sensor)) ** 2
        limit = DETECTED**2 * self._noise_power()
        own = self.site.owner == np.arange(len(self.site.beacons))[:, None]
        return np.asarray(np.sum((np.sum(strong, axis=2) > limit) @ own.T > 0, axis=0))

    def _noise_power(self) -> Array:
        return np.asarray(np.nan_to_num(np.trace(self.samples.phasor_cov, axis1=-2, axis2=-1)))

    def _phasors(self, turn: Array, place: Array) -> tuple[ComplexArray, ComplexArray, Array]:
        expected = predict_channels(self.calibration, self.samples.time, turn, place)
        measured = self.samples.phasor_sensor
        valid = np.all(np.isfinite(measured), axis=2)
        strong = np.sum(np.abs(expected) ** 2, axis=2) > DETECTED**2 * self._noise_power()
        weight = (valid & strong).astype(float)[..., None]
        return expected, np.nan_to_num(measured), weight

    def _disagreement(self, turn: Array, place: Array) -> Array:
        expected, measured, weight = self._phasors(turn, place)
        error = np.sum(weight * np.abs(expected - measured) ** 2, axis=2)
        power = np.sum(weight * np.abs(expected) ** 2, axis=2)
        return np.asarray(np.sum(np.minimum(error / np.maximum(power, 1e-300), CAP), axis=1))

    def normal(self, at: JointEstimate, blocks: tuple[Block, ...]) -> NormalEquations:
        """Return the normal equations of the fields, with marks and check distances."""
        fields = super().normal(at, blocks)
        information, gradient = fields.information[0], fields.gradient[0]
        cost = float(fields.cost[0])
        weight, lever = self.mark_sigma**-2, self.lever_body
        cross = np.cross(np.eye(3), lever)  # rows: e_k x lever
        for k, (turn, place, mark) in enumerate(
            zip(at.turn, at.place, self.marks_world, strict=True)
        ):
            jacobian = np.hstack([turn @ cross.T, turn])
            error = place + turn @ lever - mark
            own = slice(6 * k, 6 * k + 6)
            information[own, own] += weight * jacobian.T @ jacobian
            gradient[own] += weight * jacobian.T @ error
            cost += weight * float(error @ error)
        for one in self.distances:
            row, error = self._distance_row(at, blocks, one, len(gradient))
            information += np.outer(row, row) / one.sigma**2
            gradient += row * error / one.sigma**2
            cost += (error / one.sigma) ** 2
        return NormalEquations(np.array([cost]), gradient[None], information[None])

    def _distance_row(
        self, at: JointEstimate, blocks: tuple[Block, ...], one: CheckDistance, size: int
    ) -> tuple[Array, float]:
        placed = {b.name: b.position_world for b in at.calibration.site.beacons}
        way = (self.points_world | placed)[one.end] - (self.points_world | placed)[one.begin]
        length = float(np.linalg.norm(way))
        row = np.zeros(size)
        for block in blocks:
            if block.parameter == BEACON_POSITION and block.owner in (one.begin, one.end):
                columns = slice(
                    6 * len(at.turn) + block.columns.start, 6 * len(at.turn) + block.columns.stop
                )
                row[columns] += (1.0 if block.owner == one.end else -1.0) * way / length
        return row, length - one.distance
