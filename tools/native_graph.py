"""The batch smoother's problem as GTSAM's own optimizer takes it, not handicapped.

It holds the same inertial factors and priors; the calibration has variables of its own, so that
GTSAM retracts it; the ordering is nested dissection, calibration last, as ours; and its callbacks
only hand out rows of one vectorised call of the measurement model a linearisation.  The remainder
is GTSAM's own work: it copies all values into every callback.
"""

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, M, S, X

from magfusion.estimation.graph.graph import initial_estimate
from magfusion.estimation.graph.inertial import inertial_graph
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.solve.ordering import nested_dissection
from magfusion.model.field import observe, predict
from magfusion.model.noise import stacked
from magfusion.model.parameters import Calibration
from magfusion.model.site import Beacon, Magnetometer, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

JACOBIAN_COLUMNS = (6, 6, 2, 9)  # platform, beacon, log-moments, magnetometer matrix


class BatchedModel:
    """Residuals of all epochs, computed at once and handed out to the factors row by row.

    A row holds for the platform pose and the calibration at which it was computed; where a factor
    comes with others, all are computed again.
    """

    def __init__(self, site: Site, measurements: FieldPhasors) -> None:
        self.site, self.data = site, measurements
        self._poses = np.zeros((0, 12))
        self._calibration = [b""] * len(site.beacons)
        self._errors: list[Array] = []
        self._jacobians: list[list[Array]] = []

    def row(
        self, values: gtsam.Values, epoch: int, beacon: int, derivatives: bool
    ) -> tuple[Array, list[Array]]:
        """Return one factor's residual, shape (6,), and its Jacobians if they are wanted."""
        if (derivatives and not self._jacobians) or not self._fits(values, epoch, beacon):
            self._compute(values, derivatives)
        blocks = [b[epoch] for b in self._jacobians[beacon]] if derivatives else []
        return self._errors[beacon][epoch], blocks

    def _fits(self, values: gtsam.Values, epoch: int, beacon: int) -> bool:
        if not len(self._poses) or _calibration_at(values, beacon) != self._calibration[beacon]:
            return False
        pose = values.atPose3(X(epoch))
        row = self._poses[epoch]
        return bool(
            (pose.translation() == row[9:]).all()
            and (pose.rotation().matrix().ravel() == row[:9]).all()
        )

    def _compute(self, values: gtsam.Values, derivatives: bool) -> None:
        # Sorted by key: the beacons' poses (l) come before the platform's (x).
        self._poses = gtsam.utilities.extractPose3(values)[len(self.site.beacons) :]
        turn, position = self._poses[:, :9].reshape(-1, 3, 3), self._poses[:, 9:]
        sensor = self.site.platform.magnetometer
        sensor = replace(sensor, matrix=values.atVector(S(0)).reshape(3, 3))
        self._calibration = [_calibration_at(values, i) for i in range(len(self.site.beacons))]
        self._errors, self._jacobians = [], []
        for i, declared in enumerate(self.site.beacons):
            beacon = _beacon_at(values, declared, i)
            if derivatives:
                self._jacobians.append(self._differentiate(beacon, sensor, turn, position, i))
            else:
                self._add_error(stacked(predict(beacon, sensor, turn, position)), i)

    def _add_error(self, value: Array, i: int) -> None:
        error = (value - self.data.measured[:, [i]])[..., None]
        self._errors.append((self.data.sqrt_information[:, [i]] @ error)[:, 0, :, 0])

    def _differentiate(
        self, beacon: Beacon, sensor: Magnetometer, turn: Array, position: Array, i: int
    ) -> list[Array]:
        seen = observe(beacon, sensor, turn, position)
        self._add_error(stacked(seen.phasor_sensor), i)
        root = self.data.sqrt_information[:, i]
        blocks = (seen.platform_pose, seen.beacon_pose, seen.log_moments, seen.matrix)
        return [root @ np.concatenate([b[:, 0].real, b[:, 0].imag], axis=1) for b in blocks]


def _calibration_at(values: gtsam.Values, beacon: int) -> bytes:
    parts = (values.atPose3(L(beacon)).matrix(), values.atVector(M(beacon)), values.atVector(S(0)))
    return b"".join(part.tobytes() for part in parts)


def _beacon_at(values: gtsam.Values, declared: Beacon, i: int) -> Beacon:
    pose, sizes = values.atPose3(L(i)), np.exp(values.atVector(M(i)))
    return replace(
        declared,
        world_from_beacon=pose.rotation().matrix(),
        position_world=pose.translation(),
        coils=tuple(
            replace(coil, moment_beacon=size * coil.moment_beacon)
            for coil, size in zip(declared.coils, sizes, strict=True)
        ),
    )


def native_factor(model: BatchedModel, epoch: int, beacon: int) -> gtsam.CustomFactor:
    """Return the factor of one beacon at one epoch; GTSAM does not check shapes, so this does."""

    def error(
        _factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        residual, blocks = model.row(values, epoch, beacon, jacobians is not None)
        if jacobians is not None:
            shapes = tuple(block.shape for block in blocks)
            if residual.shape != (6,) or shapes != tuple((6, k) for k in JACOBIAN_COLUMNS):
                raise ValueError(f"factor of beacon {beacon} has blocks of shapes {shapes}")
            for i, block in enumerate(blocks):
                jacobians[i] = block
        return residual

    keys = [X(epoch), L(beacon), M(beacon), S(0)]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error)


def native_graph(
    declared: Calibration,
    start: Trajectory,
    preintegrated: list[gtsam.PreintegratedCombinedMeasurementsG],
    measurements: FieldPhasors,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, gtsam.Ordering]:
    """Return the same problem for GTSAM's optimizer: graph, start and ordering."""
    site, epochs = declared.site, len(start)
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    graph = inertial_graph(preintegrated, site.platform)
    values = gtsam.Values(initial_estimate(start, declared).values)
    ordering = nested_dissection(epochs, None)
    for i, beacon in enumerate(site.beacons):
        pose = gtsam.Pose3(gtsam.Rot3(beacon.world_from_beacon), beacon.position_world)
        values.insert(L(i), pose)
        values.insert(M(i), np.zeros(2))
        sigma = beacon.sigma
        graph.add(gtsam.PoseRotationPrior3D(L(i), pose, diagonal(sigma.rotation_beacon)))
        graph.add(gtsam.PoseTranslationPrior3D(L(i), pose, diagonal(sigma.position_world)))
        graph.addPriorVector(M(i), np.zeros(2), diagonal(sigma.log_moment))
        ordering.push_back(L(i))
        ordering.push_back(M(i))
    sensor = site.platform.magnetometer
    values.insert(S(0), sensor.matrix.ravel())
    graph.addPriorVector(S(0), sensor.matrix.ravel(), diagonal(sensor.sigma.matrix.ravel()))
    ordering.push_back(S(0))
    model = BatchedModel(site, measurements)
    for epoch in range(epochs):
        for i in range(len(site.beacons)):
            graph.add(native_factor(model, epoch, i))
    return graph, values, ordering
