"""Batch of motion hypotheses, each an error-state filter, updated in the same calls.

Tangent of a track: rotation (body axes, right perturbation), position and velocity (world),
accelerometer and gyro bias, then phase and rate of phase of every tone of unknown drive phase.
A `PartialUpdateFilter` for each would take 2.6 times as long (12 tracks).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.strides import Strides
from magfusion.estimation.graph.preintegration import (
    BRIDGE_ACCEL_NOISE,
    BRIDGE_GYRO_NOISE,
    bias_walks,
)
from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, VELOCITY
from magfusion.estimation.snapshot.problem import nuisance_blocks
from magfusion.estimation.snapshot.survey_error import whitened
from magfusion.model.channel_effects import of_all_sensors
from magfusion.model.field import skew
from magfusion.model.noise import measurement_cov, stacked, whitening
from magfusion.model.parameters import Block, Calibration, linearize_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray, IntArray

ACCEL, GYRO = slice(9, 12), slice(12, 15)
ROUNDS = 3  # of linearisation in one update: the first prediction may be wide
STRONG_CHI_SQUARE = 16.0  # times the expected chi square, above which a channel is downweighted


@dataclass(frozen=True, eq=False)
class Tracks:
    """Filters at one epoch, one row each."""

    rotation: Array  # (h, 3, 3), world_from_body
    # position, velocity: (h, 3), world (m, m/s)
    position: Array
    velocity: Array
    # accel_bias, gyro_bias: (h, 3), body (m/s^2, rad/s)
    accel_bias: Array
    gyro_bias: Array
    # phase, rate: (h, channels of a magnetometer), drive phase at this epoch (rad), and its rate
    # relative to the nominal one (rad/s)
    phase: Array
    rate: Array
    cov: Array  # (h, 15 + 2 free, 15 + 2 free)
    cost: Array  # (h,), minus twice the logarithm of the likelihood, up to a common constant
    parent: IntArray  # (h,), row at the epoch before; at the first epoch its own

    def __len__(self) -> int:
        return len(self.cost)

    def rows(self, chosen: IntArray | BoolArray) -> "Tracks":
        """Return some tracks, or repeated tracks."""
        return Tracks(**{name: value[chosen] for name, value in vars(self).items()})

    def joined(self, other: "Tracks") -> "Tracks":
        """Return these tracks and others."""
        return Tracks(**{k: np.concatenate([v, getattr(other, k)]) for k, v in vars(self).items()})


@dataclass(frozen=True, eq=False)
class TrackPhasors:
    """Phasors of all epochs, prepared for tracks."""

    calibration: Calibration
    time: Array
    measured: Array  # (n, channels, 6) (T); zero where missing
    sqrt_information: Array  # (n, channels, 3, 3), whitening, including the survey's error
    components: Array  # (n,), number of components present
    free_phases: BoolArray  # (channels of a magnetometer,), whether the drive phase is unknown
    blocks: tuple[Block, ...]  # of the unknown phases

    @property
    def site(self) -> Site:
        """As declared."""
        return self.calibration.site


def track_phasors(samples: FieldSamples, calibration: Calibration) -> TrackPhasors:
    """Return phasors prepared for tracks."""
    site = calibration.site
    cov = measurement_cov(site, samples, survey_error=True)
    synchronised = {beacon.name: beacon.synchronised for beacon in site.beacons}
    return TrackPhasors(
        calibration=calibration,
        time=samples.time,
        measured=stacked(samples.phasor_sensor),
        sqrt_information=whitening(cov, samples.there),
        components=np.sum(samples.numbers, axis=1).astype(np.float64),
        free_phases=np.array(
            [not synchronised[name] for name, _ in samples.channels[site.of_sensor(0)]], dtype=bool
        ),
        blocks=nuisance_blocks(site),
    )


def moved(tracks: Tracks, step: Array, phases: BoolArray) -> Tracks:
    """Return tracks moved by a tangent vector each, shape (h, 15 + 2 free)."""
    phase, rate = tracks.phase.copy(), tracks.rate.copy()
    count = int(np.sum(phases))
    phase[:, phases] += step[:, MOTION : MOTION + count]
    rate[:, phases] += step[:, MOTION + count :]
    return replace(
        tracks,
        rotation=tracks.rotation @ _turn(step[:, ROTATION]),
        position=tracks.position + step[:, POSITION],
        velocity=tracks.velocity + step[:, VELOCITY],
        accel_bias=tracks.accel_bias + step[:, ACCEL],
        gyro_bias=tracks.gyro_bias + step[:, GYRO],
        phase=phase,
        rate=rate,
    )


def _turn(vector: Array) -> Array:
    return Rotation.from_rotvec(vector).as_matrix()


def propagate_tracks(
    tracks: Tracks, strides: Strides, k: int, phasors: TrackPhasors, backward: bool
) -> Tracks:
    """Propagate tracks over a stride: to its end, or from its end to its beginning."""
    site, free_parameters = phasors.site, phasors.free_phases
    dt, lever = float(strides.dt[k]), strides.lever[k]
    sign = -1.0 if backward else 1.0
    turn = strides.turn[k] @ _turn(-dt * tracks.gyro_bias)
    gained = strides.velocity[k] - tracks.accel_bias @ lever.T
    shift = strides.displacement[k] - 0.5 * dt * tracks.accel_bias @ lever.T
    down = np.array([0.0, 0.0, -site.gravity])
    back = np.swapaxes(turn, 1, 2)
    first = tracks.rotation @ back if backward else tracks.rotation
    by_force, fallen = _applied(first, gained) + down * dt, _applied(first, shift)
    begin = tracks.velocity - by_force if backward else tracks.velocity
    way = begin * dt + 0.5 * down * dt**2 + fallen
    later = replace(
        tracks,
        rotation=first if backward else first @ turn,
        position=tracks.position + sign * way,
        velocity=tracks.velocity + sign * by_force,
        phase=tracks.phase + sign * dt * tracks.rate,
    )
    size = tracks.cov.shape[1]
    step = np.tile(np.eye(size), (len(tracks), 1, 1))
    step[:, ROTATION, ROTATION] = back
    step[:, ROTATION, GYRO] = -dt * np.eye(3)
    step[:, POSITION, ROTATION] = -first @ np.real(skew(shift))
    step[:, VELOCITY, ROTATION] = -first @ np.real(skew(gained))
    step[:, POSITION, VELOCITY] = dt * np.eye(3)
    step[:, POSITION, ACCEL] = -0.5 * dt * first @ lever
    step[:, VELOCITY, ACCEL] = -first @ lever
    # The attitude error by the gyro's bias grows within the stride.
    step[:, POSITION, GYRO] = first @ np.real(skew(shift)) * dt / 3.0
    step[:, VELOCITY, GYRO] = first @ np.real(skew(gained)) * dt / 2.0
    count = int(np.sum(free_parameters))
    number = np.arange(count)
    step[:, MOTION + number, MOTION + count + number] = dt
    noise = _noise(site, dt, size, bool(strides.gap_bridged[k]))
    if backward:
        inverse = np.linalg.inv(step)
        cov = inverse @ (tracks.cov + noise) @ np.swapaxes(inverse, 1, 2)
    else:
        cov = step @ tracks.cov @ np.swapaxes(step, 1, 2) + noise
    return replace(later, cov=cov)


def _applied(rotation: Array, vector: Array) -> Array:
    return (rotation @ vector[..., None])[..., 0]


def _noise(site: Site, dt: float, size: int, gap_bridged: bool) -> Array:
    """Return a stride's process noise, except the velocity error by gyro noise within it."""
    imu, noise = site.platform.imu, np.zeros((size, size))
    gyro = max(imu.gyro_noise, BRIDGE_GYRO_NOISE) if gap_bridged else imu.gyro_noise
    accel = max(imu.accel_noise, BRIDGE_ACCEL_NOISE) if gap_bridged else imu.accel_noise
    index = np.arange(3)
    noise[index, index] = gyro**2 * dt
    noise[3 + index, 3 + index] = accel**2 * dt**3 / 3.0
    noise[6 + index, 6 + index] = accel**2 * dt
    noise[3 + index, 6 + index] = noise[6 + index, 3 + index] = 0.5 * accel**2 * dt**2
    walk, accel_walk = bias_walks(imu)
    noise[index, index] += walk**2 * dt**3 / 3.0
    noise[index, 12 + index] = noise[12 + index, index] = -0.5 * walk**2 * dt**2
    noise[9 + index, 9 + index] = accel_walk**2 * dt
    noise[12 + index, 12 + index] = walk**2 * dt
    return noise


def rows_at(tracks: Tracks, phasors: TrackPhasors, k: int) -> tuple[Array, Array]:
    """Return whitened error (h, rows) and its derivative (h, rows, tangent) at an epoch."""
    time, free_parameters = phasors.time[k], phasors.free_phases
    known = replace(
        phasors.calibration,
        phase=of_all_sensors(phasors.site, tracks.phase),
        drift=np.zeros_like(phasors.calibration.drift),
        reference_time=float(time),
    )
    value, by_pose, by_phase = linearize_channels(
        known, phasors.blocks, np.full(len(tracks), time), tracks.rotation, tracks.position
    )
    back = np.swapaxes(tracks.rotation, 1, 2)[:, None]
    none = np.zeros((*value.shape, 9))
    still = np.zeros((*value.shape, int(np.sum(free_parameters))))
    error = (value - phasors.measured[k])[..., None]
    columns = [by_pose[..., :3], by_pose[..., 3:] @ back, none, by_phase, still, error]
    root = np.broadcast_to(
        phasors.sqrt_information[k], (len(tracks), *phasors.sqrt_information.shape[1:])
    )
    both = whitened(root, np.concatenate(columns, axis=-1))
    return both[..., -1], both[..., :-1]


def updated(tracks: Tracks, phasors: TrackPhasors, k: int) -> Tracks:
    """Update tracks by the phasors of an epoch.

    A badly explained channel increases the cost, but its effect on a track is bounded.
    """
    if phasors.components[k] == 0.0:
        return tracks
    step, there = np.zeros((len(tracks), tracks.cov.shape[1])), tracks
    for _ in range(ROUNDS):
        error, by = rows_at(there, phasors, k)
        # From the prediction, which contains all prior information.
        error = error - (by @ step[..., None])[..., 0]
        excess = _excess(error, by, tracks.cov)
        root = np.repeat(1.0 / np.sqrt(np.maximum(excess, 1.0)), 6, axis=1)
        error, by = root * error, root[..., None] * by
        across = tracks.cov @ np.swapaxes(by, 1, 2)
        spread = by @ across + np.eye(by.shape[1])
        solved = np.linalg.solve(spread, error[..., None])
        before, step = step, -(across @ solved)[..., 0]
        there = moved(tracks, step, phasors.free_phases)
        if np.max(np.abs(step - before)[:, : POSITION.stop]) < 1e-2:
            break
    gain = np.linalg.solve(spread, np.swapaxes(across, 1, 2))
    cov = tracks.cov - across @ gain
    square = np.einsum("hi,hi->h", error, solved[..., 0])
    # As for a loss that grows with the logarithm beyond a credible error.
    lost_epochs = 6.0 * STRONG_CHI_SQUARE * np.sum(np.log(np.maximum(excess, 1.0)), axis=1)
    _, volume = np.linalg.slogdet(spread)
    return replace(
        there,
        cov=0.5 * (cov + np.swapaxes(cov, 1, 2)),
        cost=tracks.cost + square + lost_epochs + volume,
    )


def _excess(error: Array, by: Array, cov: Array) -> Array:
    """Return each channel's chi square relative to its prediction, limited to credible errors."""
    separate = error.reshape(len(error), -1, 6)
    blocks = by.reshape(*separate.shape, -1)
    spread = blocks @ cov[:, None] @ np.swapaxes(blocks, -1, -2) + np.eye(6)
    solved = np.linalg.solve(spread, separate[..., None])[..., 0]
    return np.asarray(np.sum(separate * solved, axis=-1) / (6.0 * STRONG_CHI_SQUARE))
