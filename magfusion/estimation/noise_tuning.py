"""Noise that tunes itself: what the residuals of a pass say of the noise that was declared.

For each beacon its noise and its model error, and the densities of gyro and accelerometer, each
with its declared value as a prior of a factor of two.  An estimate takes part of every error with
it; how much is left in the residuals is found by drawing errors of the declared kind, and giving
them to the same linear system that made the estimate (a variance component estimation by Monte
Carlo, K.-R. Koch and J. Kusche, J. Geodesy 76, 2002).  Faults come first: a Student distribution of
few degrees of freedom lets what is false a while say little of the noise of the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from magfusion.estimation.graph import Estimate, Graph
from magfusion.estimation.log_graph import PreparedLog, overlap
from magfusion.estimation.measurements.model_error import alike_in_batch
from magfusion.estimation.motion_compensation import MotionCompensated
from magfusion.estimation.residual_shares import ChannelErrors, Leavings
from magfusion.estimation.solve.bounded import minimise_bounded
from magfusion.model.parameters import Block, Calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray

PRIOR = float(np.log(2.0))  # of the logarithm of a declared sigma
LEAST, MOST = 0.1, 1e3  # of a factor; that a noise is smaller yet, no log tells for sure
STUDENT = 4.0  # degrees of freedom: what is false says little
# Gain, by components, with which that distribution finds the variance of normal residuals.
NORMAL = {3: 1.322946, 6: 1.224631}
SETTLED = 0.05  # of a logarithm; a smaller change is none
GYRO, ACCEL = slice(0, 3), slice(6, 9)  # rows of an inertial factor that each determines
SCALES = 8  # epochs in a row that are compared, so far apart that they share no sample
FAULT = 3.0  # of a declared model error; more is no error of that kind, and is not covered by it
WEIGHINGS = 5  # times that the epochs are weighed by what is found, at first as if noise were all
OF_IMU = ("gyro_noise", "accel_noise")  # a beacon may be called "imu", too
# Of a motion prior, by what of the IMU stands for it; the rate is that of the bias, in its rows.
OF_MOTION = {"angular_accel_density": "gyro_bias_walk", "accel_density": "accel_noise"}
WALK = slice(12, 15)
NONE = 1e-4  # of a part that was not declared: as good as none
PLAUSIBLE = 6.0  # by a factor of more, either way, white noise is a fault under another name
LEFT = 1e-3  # of an error; of which less is left says nothing
# Of a beacon's noise; where less is left no IMU holds the pose, the beacon alone does, and by its
# own residuals, which it takes with it, it would seem better and better from pass to pass.
SELF_MADE = 0.5


@dataclass(frozen=True)
class Tuned:
    """One standard deviation of the noise, as declared and as found.

    Parameters
    ----------
    owner : str
        Beacon, "imu" or "motion_prior".
    key : {'noise_factor', 'model_error', 'gyro_noise', 'accel_noise', or of `OF_MOTION`}
    declared, found : float
        In the unit of the site's file.
    """

    owner: str
    key: str
    declared: float
    found: float

    @property
    def factor(self) -> float:
        """Found over declared."""
        return self.found / self.declared


def tuned_site(site: Site, tuned: Sequence[Tuned]) -> Site:
    """Return a site with the noise that was found."""
    of_imu: dict[str, Any] = {t.key: t.found for t in tuned if t.key in OF_IMU}
    of_imu |= {OF_MOTION[t.key]: t.found for t in tuned if t.key in OF_MOTION}
    platform = replace(site.platform, imu=replace(site.platform.imu, **of_imu))
    beacons = []
    for beacon in site.beacons:
        named = (t for t in tuned if t.owner == beacon.name and t.key not in (*OF_IMU, *OF_MOTION))
        own: dict[str, Any] = {t.key: t.found for t in named}
        beacons.append(replace(beacon, **own))
    return replace(site, platform=platform, beacons=tuple(beacons))


def with_noise(calibration: Calibration, tuned: Sequence[Tuned]) -> Calibration:
    """Return a calibration whose site has the noise that was found."""
    return replace(calibration, site=tuned_site(calibration.site, tuned))


def plausible(tuned: Sequence[Tuned]) -> bool:
    """Tell whether what was found is noise: a fault is none, and must not be hidden by it."""
    white = [t.factor for t in tuned if t.key != "model_error" and t.key not in OF_MOTION]
    return all(1.0 / PLAUSIBLE < factor < PLAUSIBLE for factor in white)


def as_declared(tuned: Sequence[Tuned]) -> tuple[Tuned, ...]:
    """Return the noise as it was declared."""
    return tuple(replace(t, found=t.declared) for t in tuned)


def settled(before: Sequence[Tuned], after: Sequence[Tuned]) -> bool:
    """Tell whether two tunings differ by less than matters."""
    old = {(t.owner, t.key): t.found for t in before}
    return all(
        abs(np.log(t.found / old.get((t.owner, t.key), t.declared))) < SETTLED for t in after
    )


def noise_of(
    log: PreparedLog,
    graph: Graph,
    estimate: Estimate,
    states: Trajectory,
    wave: MotionCompensated | None,
    declared: Site,
) -> tuple[Tuned, ...]:
    """Return the noise of a log whose graph was solved with some phasors; see `tune`."""
    samples, here = log.samples if wave is None else wave.fields, log.at_fields(states)
    alike = alike_in_batch(here.position_world, declared.model_error_length)
    blind = log.demodulation.blind
    windows, held = overlap(samples), log.considered
    return tune(graph, estimate, samples, here, declared, windows, alike, blind, held)


def tune(
    graph: Graph,
    estimate: Estimate,
    samples: FieldSamples,
    poses: Trajectory,
    declared: Site,
    windows: float,
    alike: Array,
    blind: BoolArray | None = None,
    considered: tuple[Block, ...] = (),
) -> tuple[Tuned, ...]:
    """Return the noise that the residuals of a solved graph are likeliest with.

    Parameters
    ----------
    samples : FieldSamples
        As they were measured in the graph.
    poses : Trajectory
        At the samples.
    declared : Site
        Whose noise is the prior.
    windows : float
        How many windows hold each sample.
    alike : ndarray, shape (n,)
        How many epochs have the same model error.
    blind : bool ndarray, shape (n,), optional
        Epochs whose noise is another: of a motion that was found without an IMU.
    considered : tuple of Block
        Parameters that are not estimated: what their errors do to residuals is no noise.
    """
    system = Leavings(graph, estimate, samples, poses, windows, considered)
    now = estimate.calibration.site
    lag = max(1, round(windows))
    found: list[Tuned] = []
    for i, beacon in enumerate(now.beacons):
        channels = [_without(own, blind) for own in system.channels_of(i)]
        square, expected, near = _by_scale(channels, alike, lag)
        if not len(square):
            continue
        prior = declared.beacons[i]
        usual = declared.model_error if prior.model_error is None else prior.model_error
        tuned = beacon.field_map is None and usual > 0.0
        known = np.array([prior.noise_factor, usual, usual])[:, None] ** 2 * expected[:3]
        fixed, weight = expected[3], np.full(len(square), 1.0 / lag)
        if not tuned:
            known, fixed = known[:1], fixed + known[1]
        for _ in range(WEIGHINGS):
            log = _likeliest(square, known, fixed, weight, 6, slice(2, None))
            parts = np.exp(2.0 * log)[:, None] * known
            of_model = (parts[1] if tuned else fixed) / (np.sum(parts, axis=0) + fixed)
            weight = (1.0 - of_model + of_model * near) / lag
        # What is white but goes with the field, as of a jitter among gradients, is noise all told.
        white = float(np.sum(parts[::2]) / np.sum(known[0]))
        # Of a strong beacon less noise than declared is not to be told from a little model error.
        unsure = LEAST**2 * float(np.sum(known[2:]) / np.sum(known[0]))
        white = float(np.sqrt(max(white, min(white + unsure, 1.0))))
        self_made = not declared.platform.inertial and _left_of_noise(channels) < SELF_MADE
        white = max(white, 1.0) if self_made else white
        found.append(
            Tuned(beacon.name, "noise_factor", prior.noise_factor, white * prior.noise_factor)
        )
        if tuned:
            factor = min(float(np.exp(log[1])), FAULT)  # faults come first
            factor = max(factor, 1.0) if self_made else factor
            found.append(Tuned(beacon.name, "model_error", usual, factor * usual))
    return (*found, *_tuned_imu(system, now, declared))


def _without(own: ChannelErrors, blind: BoolArray | None) -> ChannelErrors:
    if blind is None:
        return own
    kept = ~blind[own.epoch]
    noise, model, inertial = (part[kept] for part in own.left)
    variance = own.variance[0][kept], own.variance[1][kept]
    left = noise, model, inertial
    return replace(own, epoch=own.epoch[kept], seen=own.seen[kept], left=left, variance=variance)


def _left_of_noise(channels: list[ChannelErrors]) -> float:
    """Return the share of a beacon's noise that its residuals still have."""
    left = sum(float(np.sum(own.left[0] ** 2)) for own in channels)
    given = sum(float(np.sum(own.variance[0])) * own.size[0] ** 2 for own in channels)
    return left / given if given > 0.0 else 1.0


def _by_scale(channels: list[ChannelErrors], alike: Array, lag: int) -> tuple[Array, Array, Array]:
    """Return squares of a beacon's residuals on several scales of time, and their expectation.

    Noise is alike on all scales; an error that is constant in place is mostly in the longest.

    Returns
    -------
    square : ndarray, shape (m,)
    expected : ndarray, shape (4, m)
        Of a component, by noise and by model error of size one, by a relative error of size one
        that is white, and by inertial noise.
    near : ndarray, shape (m,)
        Share of it that is independent, where model error prevails.
    """
    squares, parts, nears = [np.zeros(0)], [np.zeros((4, 0))], [np.zeros(0)]
    for scale in _haar(SCALES):
        seen, left, given = [], [], []
        for own in channels:
            used = len(own.seen) // (SCALES * lag) * SCALES * lag
            shape = (-1, SCALES, lag)
            rows = [
                np.einsum("s,bslk->blk", scale, v[:used].reshape(*shape, 6)).reshape(-1, 6)
                for v in (own.seen, *own.left)
            ]
            seen.append(np.sum(rows[0] ** 2, axis=1))
            left.append([np.sum(row**2, axis=1) for row in rows[1:]])
            given.append([np.mean(v[:used].reshape(shape), axis=1).ravel() for v in own.variance])
            close = np.mean(alike[own.epoch][:used].reshape(shape), axis=1).ravel()
            nears.append(np.minimum(SCALES * lag / close, 1.0))
        kept, drawn = np.concatenate(left, axis=1), np.concatenate(given, axis=1)
        # Of a wrong motion too, a stronger field has more.
        drawn = np.stack([*drawn, drawn[1]])
        total = np.array([*channels[0].size, 1.0]) ** 2 * np.sum(drawn, axis=1)
        share = np.divide(np.sum(kept, axis=1), total, out=np.ones(3), where=total > 0.0)
        squares += seen
        rows = share[:, None] * drawn / 6.0
        parts.append(np.stack([rows[0], rows[1], share[0] * drawn[1] / 6.0, rows[2]]))
    return np.concatenate(squares), np.concatenate(parts, axis=1), np.concatenate(nears)


@cache
def _haar(size: int) -> Array:
    """Return the orthonormal Haar transform, shape (size, size): the mean first."""
    if size == 1:
        return np.ones((1, 1))
    means = np.kron(_haar(size // 2), [1.0, 1.0])
    steps = np.kron(np.eye(size // 2), [1.0, -1.0])
    return np.concatenate([means, steps]) / np.sqrt(2.0)


def _tuned_imu(system: Leavings, now: Site, declared: Site) -> list[Tuned]:
    """Return the densities of gyro and accelerometer."""
    plain = system.inertial()
    found = []
    owner, of_turn, names = "imu", GYRO, {name: name for name in OF_IMU}
    if not declared.platform.inertial:
        owner, of_turn, names = "motion_prior", WALK, OF_MOTION
    for (name, key), rows in zip(names.items(), (of_turn, ACCEL), strict=True):
        scale = system.sigma[:, rows]
        square, noise, model, own = (np.sum((p[:, rows] / scale) ** 2, axis=1) for p in plain)
        before, usual = getattr(declared.platform.imu, key), getattr(now.platform.imu, key)
        here = system.ordinary
        every = [float(np.mean(p[here])) / 3.0 for p in (noise, model, own)]
        if not np.any(here) or every[2] < LEFT:
            continue
        count = int(np.sum(here))
        known = np.full((1, count), every[2] * (before / usual) ** 2)
        fixed = np.full(count, every[0] + every[1])
        # Neighbours in time share what is left of them.
        weight = np.full(count, min(1.0, (every[2] + fixed[0]) ** 2 / every[2]))
        log = _likeliest(square[here], known, fixed, weight, 3)
        # What is declared below these holds scale and vibration too, which are not white.
        found.append(Tuned(owner, name, before, float(before * np.exp(max(log[0], 0.0)))))
    return found


def _likeliest(
    square: Array,
    parts: Array,
    fixed: Array,
    weight: Array,
    components: int,
    undeclared: slice = slice(0, 0),
) -> Array:
    """Return the logarithm of what each part's standard deviation is too small by.

    Parameters
    ----------
    square : ndarray, shape (m,)
        Squared norms of residuals.
    parts : ndarray, shape (kinds, m)
        Expected square of a component by each kind of noise, as declared.
    fixed : ndarray, shape (m,)
        And by all else.
    weight : ndarray, shape (m,)
        Of each: how much of it is independent.
    components : int
        Of each residual.
    undeclared : slice
        Parts of which nothing was declared: there may be none of them.
    """
    start, least = np.zeros(len(parts)), np.full(len(parts), LEAST)
    start[undeclared], least[undeclared] = np.log(LEAST), NONE
    declared = np.ones(len(parts))
    declared[undeclared] = 0.0
    gain, width = NORMAL[components], STUDENT + components

    def cost(log: Array) -> float:
        variance = np.exp(2.0 * log) @ parts + fixed
        bounded = width * np.log1p(gain * square / (STUDENT * variance))
        likelihood = 0.5 * np.sum(weight * (components * np.log(variance) + bounded))
        return float(likelihood + 0.5 * np.sum(declared * (log / PRIOR) ** 2))

    def gradient(log: Array) -> Array:
        by = 2.0 * np.exp(2.0 * log)[:, None] * parts
        variance = 0.5 * np.sum(by, axis=0) + fixed
        bounded = width * gain * square / (STUDENT * variance + gain * square)
        by_variance = 0.5 * weight * (components - bounded) / variance
        return np.asarray(by @ by_variance + declared * log / PRIOR**2)

    limits = np.log(np.stack([least, np.full(len(parts), MOST)], axis=1))
    return minimise_bounded(cost, start, limits, steps=100, decrease=1e-9, gradient=gradient)
