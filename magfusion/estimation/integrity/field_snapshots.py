"""Fields of a few dozen calm epochs, and how well a site explains them for any motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.statistics import TEST_BUDGET, log_p_chi_square
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.survey_error import whitened
from magfusion.estimation.solve.batched import NormalEquations, minimise
from magfusion.model.noise import measurement_cov, stacked, whitening
from magfusion.model.parameters import (
    Block,
    Calibration,
    Parameter,
    choose_blocks,
    dimension,
    initial_calibration,
    linearize_channels,
    placed,
    predict_channels,
    retract,
)
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.units import AnyArray, Array, IntArray

EPOCHS = 24
OF_SURVEY = ("beacons", "moments", "magnetometer")  # groups of parameters
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Poses of all epochs, and shared parameters."""

    calibration: Calibration
    turn: Array  # (n, 3, 3) world_from_body
    place: Array  # (n, 3)
    estimate: Array  # (dimension,) sum of the shared parameters' steps

    def moved(self, step: Array, blocks: tuple[Block, ...]) -> JointEstimate:
        """Return the estimate after a step."""
        poses = step[: 6 * len(self.turn)].reshape(-1, 6)
        shared = step[6 * len(self.turn) :]
        return JointEstimate(
            retract(self.calibration, blocks, shared),
            self.turn @ Rotation.from_rotvec(poses[:, :3]).as_matrix(),
            self.place + (self.turn @ poses[:, 3:, None])[..., 0],
            self.estimate + shared,
        )


@dataclass(frozen=True, eq=False)
class Snapshots:
    """Phasors of some epochs, with a site that may explain them."""

    samples: FieldSamples
    calibration: Calibration
    # whether the weights include the survey's errors, as if every epoch had its own
    survey_error: bool = True

    @property
    def site(self) -> Site:
        """The site."""
        return self.calibration.site

    @property
    def freedom(self) -> float:
        """Number of residuals less that of pose parameters."""
        return float(np.sum(self.samples.numbers) - 6 * len(self.samples))

    @cached_property
    def fixes(self) -> Fixes:
        """Poses, without an initial guess."""
        return fix_epochs(self.samples, self.calibration)

    @cached_property
    def chi_square(self) -> float:
        """Chi square of the fixes."""
        return float(np.sum(self.fixes.cost[:, 0]))

    def of(self, site: Site) -> Snapshots:
        """Return the same epochs with another site."""
        return replace(self, calibration=replace(self.calibration, site=site))

    def some(self, count: int) -> Snapshots:
        """Return a subset of the epochs."""
        chosen = np.zeros(len(self.samples), dtype=bool)
        chosen[np.linspace(0, len(self.samples) - 1, count).round().astype(np.int64)] = True
        return replace(self, samples=self.samples.rows(chosen))

    def without(self, name: str) -> Snapshots:
        """Return the same epochs as if a beacon had not been received."""
        own = np.array([beacon == name for beacon, _ in self.samples.channels])
        phasor = np.where(own[:, None], np.nan, self.samples.phasor_sensor)
        return replace(self, samples=replace(self.samples, phasor_sensor=phasor))

    def residual(self, fixes: Fixes) -> Array:
        """Return the whitened residual at the best fixes, shape (n, channels, 6)."""
        at, place = fixes.world_from_body[:, 0], fixes.position_world[:, 0]
        phasor = predict_channels(self.calibration, self.samples.time, at, place)
        error = stacked(phasor - self.samples.phasor_sensor)
        return whitened(self.weights, error[..., None]).reshape(error.shape)

    @cached_property
    def weights(self) -> Array:
        """Whitening of each phasor."""
        cov = measurement_cov(self.site, self.samples, survey_error=self.survey_error)
        return whitening(cov, self.samples.there)

    def fitted(
        self, parameters: Sequence[tuple[Parameter, str, float]], fixes: Fixes
    ) -> tuple[float, Calibration]:
        """Return chi square and calibration with some parameters estimated besides the poses.

        `parameters`: with owner, and a sigma that constrains undetermined ones. `fixes`: initial
        poses.
        """
        cost, guess, _ = self.minimised(wide_blocks(self.site, parameters), *_best_poses(fixes))
        return cost, guess.calibration

    @cached_property
    def joint_chi_square(self) -> float:
        """Chi square with the survey's errors estimated, each the same at all epochs.

        `chi_square` is larger or smaller by chance, as an error at one epoch is one at all others.
        """
        joint = self._jointly(())
        if all(beacon.synchronised for beacon in self.site.beacons):
            return joint
        return min(joint, self.chi_square)  # from unknown phases no minimum is sure to be reached

    @property
    def excess(self) -> float:
        """Mean square of what the survey, as declared, does not explain."""
        return self.joint_chi_square / max(self.freedom, 1.0)

    def rejects(self, parameters: Sequence[tuple[Parameter, str, float]], tests: int) -> bool:
        """Return whether the fields contradict some parameters, one of so many tests.

        The likelihood ratio of larger errors of them than their declared sigmas.
        """
        released = self._jointly(parameters)
        count = sum(len(b.sigma) for b in wide_blocks(self.site, parameters))
        return is_significant(self.joint_chi_square, released, count, self.freedom, tests)

    def rejects_rest(self, rest: Snapshots, tests: int) -> bool:
        """Return whether what a subset leaves out contradicts it, one of so many tests."""
        count, after = self.freedom - rest.freedom, rest.joint_chi_square
        return is_significant(self.joint_chi_square, after, count, rest.freedom, tests)

    def _jointly(self, parameters: Sequence[tuple[Parameter, str, float]]) -> float:
        wide = wide_blocks(self.site, parameters)
        released = {block.key for block in wide}
        groups = (*OF_SURVEY, "phase")
        survey = (b for b in choose_blocks(self.site, groups) if b.key not in released)
        own = replace(self, survey_error=False)
        return own.minimised(placed([*survey, *wide]), *_best_poses(self.fixes))[0]

    def minimised(
        self, blocks: tuple[Block, ...], world_from_body: Array, position_world: Array
    ) -> tuple[float, JointEstimate, Array]:
        """Return chi square, estimate and information of all poses and some parameters."""
        start = JointEstimate(
            self.calibration, world_from_body, position_world, np.zeros(dimension(blocks))
        )

        def model(_: IntArray, state: AnyArray) -> NormalEquations:
            return self.normal(state[0], blocks)

        def move(state: AnyArray, step: Array) -> AnyArray:
            return _one(state[0].moved(step[0], blocks))

        result = minimise(model, _one(start), move, max_iterations=ITERATIONS, relative=1e-5)
        guess: JointEstimate = result.state[0]
        return float(result.cost[0]), guess, result.information[0]

    def normal(self, at: JointEstimate, blocks: tuple[Block, ...]) -> NormalEquations:
        """Return the normal equations of all poses, and of the shared parameters."""
        time, n = self.samples.time, len(self.samples)
        value, by_pose, by_free = linearize_channels(
            at.calibration, blocks, time, at.turn, at.place
        )
        error = (value - stacked(self.samples.phasor_sensor))[..., None]
        every = np.concatenate([by_pose, by_free, error], axis=-1)
        rows = whitened(self.weights, every).reshape(n, -1, every.shape[-1])
        square = np.swapaxes(rows, 1, 2) @ rows
        sigma = np.concatenate([np.zeros(0), *(block.sigma for block in blocks)])
        size = 6 * n + len(sigma)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        for k in range(n):
            own = slice(6 * k, 6 * k + 6)
            information[own, own] = square[k, :6, :6]
            information[own, 6 * n :] = square[k, :6, 6:-1]
            information[6 * n :, own] = square[k, 6:-1, :6]
            gradient[own] = square[k, :6, -1]
        information[6 * n :, 6 * n :] = np.sum(square[:, 6:-1, 6:-1], axis=0)
        information[6 * n :, 6 * n :] += np.diag(1.0 / sigma**2)
        gradient[6 * n :] = np.sum(square[:, 6:-1, -1], axis=0) + at.estimate / sigma**2
        cost = np.sum(square[:, -1, -1]) + np.sum((at.estimate / sigma) ** 2)
        return NormalEquations(np.array([cost]), gradient[None], information[None])


def is_significant(before: float, after: float, count: float, freedom: float, tests: int) -> bool:
    """Return whether so many released parameters reduce chi square by more than chance does."""
    noise = max(1.0, after / max(freedom, 1.0))
    log_p = log_p_chi_square((before - after) / noise, count)
    return bool(log_p < np.log(TEST_BUDGET / tests))


def wide_blocks(
    site: Site, parameters: Sequence[tuple[Parameter, str, float]]
) -> tuple[Block, ...]:
    """Return blocks of parameters with an owner and a sigma each."""
    out = []
    for parameter, owner, sigma in parameters:
        width = len(parameter.sigma(site, owner))
        out.append(Block(parameter, owner, slice(0), np.full(width, sigma)))
    return placed(out)


def _best_poses(fixes: Fixes) -> tuple[Array, Array]:
    return fixes.world_from_body[:, 0], fixes.position_world[:, 0]


def _one(guess: JointEstimate) -> AnyArray:
    state = np.empty(1, dtype=object)
    state[0] = guess
    return state


def calm_epochs(samples: FieldSamples, imu: ImuSamples) -> FieldSamples:
    """Return epochs spread over a log, of each stretch the one with the least rate.

    The size of the rate depends on no axis and no sign; its unit does not matter either.
    """
    if len(samples) <= EPOCHS:
        return samples
    rate = np.linalg.norm(imu.gyro_body, axis=1)
    nearest = np.clip(np.searchsorted(imu.time, samples.time), 0, len(imu) - 1)
    maximum = np.sum(samples.valid, axis=1)
    order = np.lexsort((rate[nearest], -maximum))  # by number of beacons, then by rate
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    stretches = np.array_split(np.arange(len(samples)), EPOCHS)
    kept = np.array([stretch[np.argmin(rank[stretch])] for stretch in stretches])
    chosen = np.zeros(len(samples), dtype=bool)
    chosen[kept] = True
    return samples.rows(chosen)


def snapshots_of(samples: FieldSamples, imu: ImuSamples, site: Site) -> Snapshots:
    """Return calm epochs of a log with the site as declared."""
    some = calm_epochs(samples, imu)
    return Snapshots(some, initial_calibration(site, float(np.mean(some.time))))
