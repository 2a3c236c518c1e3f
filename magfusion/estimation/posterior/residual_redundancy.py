"""Share of errors that remains in the residuals, by solving for drawn errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.marginals import is_chain
from magfusion.estimation.posterior.residual_covariance_chain import left_by_chain
from magfusion.estimation.posterior.residual_tree import left_by_tree
from magfusion.model.noise import cholesky, model_error_cov, sensor_positions
from magfusion.model.parameters import Block
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

KINDS = 4  # of drawn errors
WAVES = 64  # of a random model error
MIN_CHANNELS = 3  # of an epoch; the pose of fewer explains too much
LOOSE = 1e-9  # of the fields' information on a pose
ORDINARY = 3.0  # of usual sigmas; an interval with larger ones has a gap


@dataclass(frozen=True, eq=False)
class ChannelErrors:
    """Whitened errors of one channel, in world axes, at the epochs that have it."""

    epoch: IntArray  # (m,), rows of the samples
    seen: Array  # (m, 6), residuals
    # (m, 6 * draws) each, remainders of drawn noise, of a rough and of a smooth drawn model error,
    # and of drawn inertial noise
    residuals: tuple[Array, Array, Array, Array]
    # (m,) each, of noise and of model error of size one: the sum over the components
    variance: tuple[Array, Array]
    size: tuple[float, float]  # noise and model error of the drawn errors


class ResidualProjection:
    """The linear system of a solved graph, and the remainders of errors after its estimate.

    Parameters
    ----------
    samples : FieldSamples
        As measured in the graph.
    poses : Trajectory
        At the samples.
    windows : float
        Number of windows that contain each sample.
    considered : tuple of Block
        Uncertain parameters that are not estimated elsewhere.  Here they are: the effect of their
        errors is no noise.
    seed : int
        Of the drawn errors.
    draws : int
        Number of drawn errors of each kind.
    """

    ordinary: BoolArray  # inertial intervals without a gap

    def __init__(
        self,
        graph: Graph,
        estimate: GraphEstimate,
        samples: FieldSamples,
        poses: Trajectory,
        windows: float,
        considered: tuple[Block, ...] = (),
        seed: int = 0,
        draws: int = 1,
    ) -> None:
        # Reproducible for the same log.
        self._samples, self._rng = samples, np.random.default_rng(seed)
        self._measured = next(m for m in graph.measurements if isinstance(m, FieldPhasors))
        site = estimate.calibration.site
        first = graph.native.size() - graph.epochs + 1
        roots = [_root(graph.native.at(i)) for i in range(first, graph.native.size())]
        self._unwhitening = np.linalg.inv(np.array(roots).reshape(-1, ROWS, ROWS))
        self.sigma = np.sqrt(np.sum(self._unwhitening**2, axis=2))
        self.ordinary = np.all(self.sigma < ORDINARY * np.median(self.sigma, axis=0), axis=1)
        error = graph.residual(self._measured, estimate)
        weight = np.ones(error.shape[:2])
        if self._measured.loss is not None:
            weight, _ = self._measured.loss.weighed(np.sum(error**2, axis=2), 6)
        self._weight = np.sqrt(weight)[..., None]
        self._world_from_sensor = np.stack(
            [poses.world_from_body @ s.body_from_sensor for s in site.platform.magnetometers],
            axis=1,
        )
        self._owner, self._sensor = site.owner, site.sensor
        self._size = _sizes(site)
        rows = self._measured.linearize(
            states_in(estimate.values).rows(self._measured.epoch), estimate.calibration, ()
        )
        assert rows.by_pose is not None
        self._by_pose = rows.by_pose.reshape(len(error), -1, 6)
        drawn = self._drawn_errors(site, sensor_positions(site, poses), windows, draws)
        fields, inertial = [self._weight * own for own, _ in drawn], [own for _, own in drawn]
        residual = None
        if is_chain(graph, considered):
            residual = left_by_chain(graph, estimate, considered, fields, inertial)
        if residual is None:
            residual = left_by_tree(graph, estimate, considered, fields, inertial)
        every = [field / self._weight for field in residual[0]]
        of_motion = residual[1]
        # Squares of whitened remainders of all drawn errors, mean over the intervals, (errors, 15).
        self.inertial_squares = np.mean(_of_kinds(of_motion[1:] ** 2), axis=(1, 2))
        seen, *others = (self._unwhitening @ of_motion[..., None])[..., 0]
        self._inertial = [seen, *np.sqrt(np.mean(_of_kinds(np.array(others) ** 2), axis=1))]
        self._seen, *others = self._without_pose(every)
        self._separate = np.moveaxis(_of_kinds(np.array(others)), 1, 3)

    def _drawn_errors(
        self, site: Site, sensor_world: Array, windows: float, draws: int
    ) -> list[tuple[Array, Array]]:
        """Return all drawn errors, those of each kind one after the other."""
        drawn = [self._drawn(site, sensor_world, windows) for _ in range(draws)]
        return [one for kind in zip(*drawn, strict=True) for one in kind]

    def _drawn(self, site: Site, sensor_world: Array, windows: float) -> list[tuple[Array, Array]]:
        """Return drawn errors of fields and inertial factors: noise, model errors, the IMU's."""
        rng, samples, root = self._rng, self._samples, self._measured.sqrt_information[..., :3, :3]
        unit = model_error_cov(np.nan_to_num(samples.phasor_sensor), 1.0)
        self._variance = [_spread(root, c) for c in (samples.phasor_cov, unit)]
        noise, model = np.array(self._size)[:, self._owner]
        drawn = noise[:, None] * _draw_noise(rng, samples, windows, root)
        length = max(site.model_error_length, 1e-3)
        sensors = sensor_world.shape[1]
        count = len(site.beacons)
        tones = samples.valid.shape[1] // sensors
        owner = self._owner[:tones]
        phasor = np.nan_to_num(samples.phasor_sensor).reshape(len(samples), sensors, tones, 3)
        parts = np.stack([phasor.real, phasor.imag], axis=3)
        turn = self._world_from_sensor
        parts_world = np.einsum("nsij,nscpj->nscpi", turn, parts)

        def false(matrix: Array) -> Array:
            bent = np.einsum("nscij,nscpj->nscpi", matrix[:, :, owner], parts_world) / np.sqrt(3.0)
            sensor = np.einsum("nsji,nscpj->nscpi", turn, bent).reshape(*samples.valid.shape, 2, 3)
            return np.asarray(model[:, None] * _six(np.einsum("ncij,ncpj->ncpi", root, sensor)))

        rough = false(_matrices(rng, sensor_world / length, count, smooth=False))
        imu = rng.standard_normal((len(self._unwhitening), ROWS))
        smooth = false(_matrices(rng, sensor_world / length, count, smooth=True))
        nothing, still = np.zeros_like(drawn), np.zeros_like(imu)
        return [(drawn, still), (rough, still), (smooth, still), (nothing, imu)]

    def _without_pose(self, fields: Sequence[Array]) -> list[Array]:
        """Return errors without the part that a pose of their own epoch would explain.

        Remainders of inertial errors in the fields have the form of a pose, and are no noise.
        """
        weight = np.repeat(self._weight[..., 0] ** 2, 6, axis=1)
        several = np.sum(self._samples.valid, axis=1) >= MIN_CHANNELS
        by = self._by_pose
        weighed = np.swapaxes(weight[..., None] * by, 1, 2)
        errors = np.stack([field.reshape(len(field), -1) for field in fields], axis=-1)
        normal = weighed @ by
        scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), np.finfo(float).tiny))
        normal = normal / scale[:, None] / scale[..., None] + LOOSE * np.eye(6)
        step = np.linalg.solve(normal, weighed @ errors / scale[..., None]) / scale[..., None]
        residual = np.where(several[:, None, None], errors - by @ step, errors)
        return [residual[..., k].reshape(field.shape) for k, field in enumerate(fields)]

    def channels_of(self, beacon: int) -> list[ChannelErrors]:
        """Return the errors of the channels of a beacon, given by its index."""
        out = []
        for channel in np.flatnonzero(self._owner == beacon).tolist():
            rows = np.flatnonzero(self._samples.valid[:, channel])
            turn = self._world_from_sensor[rows, self._sensor[channel]]
            seen, noise, rough, smooth, inertial = (
                _rotated(e[rows, channel], turn) for e in (self._seen, *self._separate)
            )
            by_noise, by_model = (v[rows, channel] for v in self._variance)
            size = (float(self._size[0][beacon]), float(self._size[1][beacon]))
            residual = noise, rough, smooth, inertial
            out.append(ChannelErrors(rows, seen, residual, (by_noise, by_model), size))
        return out

    def inertial(self) -> list[Array]:
        """Return inertial residuals, and remainders of noise, model errors and the IMU's own.

        Each of shape (intervals, 15): rotation, position, velocity, biases; the remainders are root
        mean squares of all draws.
        """
        return self._inertial


def _of_kinds(drawn: Array) -> Array:
    """Return drawn errors by kind, shape (4, draws, ...)."""
    return drawn.reshape(KINDS, len(drawn) // KINDS, *drawn.shape[1:])


def _rotated(parts: Array, turn: Array) -> Array:
    """Return rotated errors, shape (m, 6 * draws); given of shape (m, 6) or (m, draws, 6)."""
    width = int(np.prod(parts.shape[1:]))
    vectors = parts.reshape(len(parts), width // 3, 3)
    return (vectors @ np.swapaxes(turn, 1, 2)).reshape(len(parts), width)


def _root(factor: gtsam.NonlinearFactor) -> Array:
    assert isinstance(factor, gtsam.NoiseModelFactor)
    noise = factor.noiseModel()
    assert isinstance(noise, gtsam.noiseModel.Gaussian)
    return np.asarray(noise.R())


def _sizes(site: Site) -> tuple[list[float], list[float]]:
    """Return noise factor and model error of each beacon."""
    errors = [site.model_error if b.model_error is None else b.model_error for b in site.beacons]
    return [b.noise_factor for b in site.beacons], errors


def _spread(root: Array, cov: Array) -> Array:
    """Return the variance of the whitened parts of phasors, summed, shape (n, channels)."""
    return np.asarray(2.0 * np.einsum("ncij,ncjk,ncik->nc", root, np.nan_to_num(cov), root))


def _draw_noise(
    rng: np.random.Generator, samples: FieldSamples, windows: float, root: Array
) -> Array:
    """Return whitened noise, shape (n, channels, 6), shared by overlapping windows."""
    shared, (count, channels) = max(1, round(windows)), samples.valid.shape
    cells = rng.standard_normal((count + shared - 1, channels, 2, 3)) / np.sqrt(shared)
    drawn = np.sum([cells[k : k + count] for k in range(shared)], axis=0)
    safe = np.where(samples.valid[..., None, None], samples.phasor_cov, np.eye(3))
    scale = np.sqrt(np.trace(safe, axis1=2, axis2=3) / 3.0)[..., None, None]
    spread = root @ (scale * cholesky(safe / scale**2))
    return _six(np.einsum("ncij,ncpj->ncpi", spread, drawn))


def _matrices(rng: np.random.Generator, place: Array, count: int, *, smooth: bool) -> Array:
    """Return random matrices of place, (n, magnetometers, count, 3, 3), of elements of variance 1.

    Their correlation is exp(-distance), or exp(-distance^2 / 2) where they are smooth; by waves of
    random vectors (random Fourier features), Cauchy's for the one and Gauss's for the other.
    `place` (n, magnetometers, 3).
    """
    wave = rng.standard_normal((WAVES, 3))
    if not smooth:
        wave /= np.abs(rng.standard_normal((WAVES, 1)))
    amplitude = rng.standard_normal((2, WAVES, 9 * count)) / np.sqrt(WAVES)
    angle = place @ wave.T
    field = np.cos(angle) @ amplitude[0] + np.sin(angle) @ amplitude[1]
    return np.asarray(field).reshape(*place.shape[:2], count, 3, 3)


def _six(parts: Array) -> Array:
    return parts.reshape(*parts.shape[:2], 6)
