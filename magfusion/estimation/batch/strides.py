"""Motion increments of the inertial stream between epochs, independent of the state."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.preintegration import GAP_SAMPLES
from magfusion.model.hermite import hermite
from magfusion.model.samples import ImuSamples
from magfusion.model.strapdown import attitude_at, attitude_from_gyro
from magfusion.units import Array, BoolArray


@dataclass(frozen=True, eq=False)
class Strides:
    """Rotation and displacement from each epoch to the next, in the body axes of the earlier."""

    dt: Array  # (n,) (s)
    turn: Array  # (n, 3, 3), ``earlier_from_later``
    # velocity, displacement: (n, 3), by the specific force alone, from rest (m/s, m)
    velocity: Array
    displacement: Array
    # (n, 3, 3), integral of the rotation, by which an accelerometer bias changes the velocity (s)
    lever: Array
    gap_bridged: BoolArray  # (n,), where the stream has a gap

    def __len__(self) -> int:
        return len(self.dt)


def strides_between(imu: ImuSamples, time_offset: float, epochs: Array) -> Strides:
    """Return the strides of a stream between epochs.

    `time_offset`: added to its stamps to bring them to the log's clock (s). `epochs` (n + 1,) (s);
    where they lie outside the stream its end values are extended.
    """
    usual = float(np.median(np.diff(imu.time)))
    stamps, rate_body, accel_body = _reaching(imu, time_offset, epochs)
    chain = attitude_from_gyro(stamps, rate_body)
    force, step = chain.apply(accel_body), np.diff(stamps)[:, None]
    velocity = _summed(0.5 * (force[:-1] + force[1:]) * step)
    # Exact for a force that is linear between samples.
    inner = (2.0 * force[:-1] + force[1:]) * step**2 / 6.0
    path = _summed(velocity[:-1] * step + inner)
    axes = chain.as_matrix().reshape(-1, 9)
    rotated = _summed(0.5 * (axes[:-1] + axes[1:]) * step)
    lever = np.stack([np.interp(epochs, stamps, axis) for axis in rotated.T], axis=1)
    here = attitude_at(chain, stamps, rate_body, epochs).as_matrix()
    dt, back = np.diff(epochs), np.swapaxes(here[:-1], 1, 2)
    place, speed = hermite(stamps, path, velocity, epochs)
    moved = np.diff(place, axis=0) - speed[:-1] * dt[:, None]
    gap = np.flatnonzero(np.diff(stamps) > GAP_SAMPLES * usual)
    silent = (stamps[gap] < epochs[1:, None]) & (stamps[gap + 1] > epochs[:-1, None])
    return Strides(
        dt=dt,
        turn=back @ here[1:],
        velocity=(back @ np.diff(speed, axis=0)[..., None])[..., 0],
        displacement=(back @ moved[..., None])[..., 0],
        lever=back @ np.diff(lever, axis=0).reshape(-1, 3, 3),
        gap_bridged=np.asarray(np.any(silent, axis=1)),
    )


def _reaching(imu: ImuSamples, time_offset: float, epochs: Array) -> tuple[Array, Array, Array]:
    """Return stamps, rates and specific forces of a stream that covers the epochs."""
    stamps, rows = imu.time + time_offset, np.arange(len(imu))
    if epochs[0] < stamps[0]:
        stamps, rows = np.append(epochs[0], stamps), np.append(0, rows)
    if epochs[-1] > stamps[-1]:
        stamps, rows = np.append(stamps, epochs[-1]), np.append(rows, rows[-1])
    return stamps, imu.gyro_body[rows], imu.accel_body[rows]


def _summed(steps: Array) -> Array:
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
