"""Segment of a tenth of a second of inertial samples, with the field samples in it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.stamps import GAP
from magfusion.estimation.orientation.layout import Orientation
from magfusion.model.field import skew
from magfusion.units import MICROTESLA, Array, BoolArray

STEP = 0.1  # s; of a segment


@dataclass(frozen=True, eq=False)
class OrientationStretch:
    """Samples after one time, up to another.

    A sample is assumed to be the mean over the step that ends at its stamp, as for an instrument
    that averages; one that filters has a larger delay.
    """

    begin: float  # (s); NaN after a gap, and at first: the state is not propagated into it
    time: Array  # (n,), of the inertial samples (s)
    gyro_body: Array  # (n, 3) (rad/s)
    accel_body: Array  # (n, 3) (m/s^2)
    field_time: Array  # (m,) (s)
    field: Array  # (m, 3), measured axes (uT)
    rests: bool  # whether the platform is at rest

    @cached_property
    def steps(self) -> Array:
        """Duration of each step (s), shape (n,)."""
        first = 0.0 if np.isnan(self.begin) else self.time[0] - self.begin
        return np.diff(self.time, prepend=self.time[0] - first)


@dataclass(frozen=True, eq=False)
class StretchMotion:
    """Rotation and velocity change of a segment, given the instruments' errors."""

    attitude: Array  # (n + 1, 3, 3), ``begin_from_then``: at the beginning, and at every sample
    # by_bias, by_matrix, by_gyro_force: (3, 3), (3, 9), (3, 9), derivatives of the whole rotation,
    # axes of the beginning
    by_bias: Array
    by_matrix: Array
    by_gyro_force: Array
    push: Array  # (3,), integral of the specific force, axes of the beginning (m/s)
    # by_force, by_accel_matrix: (3, 3), (3, 9), its derivatives by the specific force
    by_force: Array
    by_accel_matrix: Array
    rate: Array  # (n, 3), corrected (rad/s)


def integrate_stretch(stretch: OrientationStretch, state: Orientation) -> StretchMotion:
    """Integrate a segment."""
    dt = stretch.steps
    rate = corrected_rate(state, stretch.gyro_body, stretch.accel_body)
    force = stretch.accel_body @ (np.eye(3) + state.accel_matrix).T - state.accel_bias
    steps = Rotation.from_rotvec(rate * dt[:, None]).as_matrix()
    attitude = np.empty((len(dt) + 1, 3, 3))
    attitude[0] = np.eye(3)
    for i, step in enumerate(steps):
        attitude[i + 1] = attitude[i] @ step
    middle = 0.5 * (attitude[1:] + attitude[:-1])
    weighted = middle * dt[:, None, None]
    by_accel = np.einsum("nij,nk->ijk", weighted, stretch.accel_body).reshape(3, 9)
    return StretchMotion(
        attitude=attitude,
        by_bias=-np.sum(weighted, axis=0),
        by_matrix=np.einsum("nij,nk->ijk", weighted, stretch.gyro_body).reshape(3, 9),
        by_gyro_force=-by_accel,
        push=np.einsum("nij,nj->i", weighted, force),
        by_force=np.sum(weighted, axis=0),
        by_accel_matrix=by_accel,
        rate=rate,
    )


def corrected_rate(state: Orientation, gyro_body: Array, accel_body: Array) -> Array:
    """Return the true rates (rad/s) of measured ones, shape (..., 3)."""
    scaled = gyro_body @ (np.eye(3) + state.gyro_matrix).T
    return np.asarray(scaled - accel_body @ state.gyro_force.T - state.gyro_bias)


def body_from_end(
    stretch: OrientationStretch, turn: StretchMotion, lag: float
) -> tuple[Array, Array]:
    """Return the mean rotation from the axes of the end to those of the field samples.

    `lag`: delay of the samples' stamps relative to the motion (s). Returns `mean`, `by_lag` (3, 3):
    mean of ``sample_from_end``, and its derivative (1/s).
    """
    shown = stretch.field_time - lag
    stamps = np.concatenate([stretch.time[:1] - stretch.steps[:1], stretch.time])
    index = np.clip(np.searchsorted(stamps, shown, side="right") - 1, 0, len(stamps) - 1)
    rate = turn.rate[np.minimum(index, len(turn.rate) - 1)]
    ahead = Rotation.from_rotvec(rate * (shown - stamps[index])[:, None]).as_matrix()
    sample_from_end = np.swapaxes(turn.attitude[index] @ ahead, 1, 2) @ turn.attitude[-1]
    return np.mean(sample_from_end, axis=0), np.mean(skew(rate) @ sample_from_end, axis=0)


def stretches(
    time: Array,
    gyro_body: Array,
    accel_body: Array,
    rests: BoolArray,
    field_time: Array,
    field_t: Array,
    begin: float,
) -> Iterator[OrientationStretch]:
    """Cut streams into segments; the last one may be shorter.

    `begin`: time of the sample before the first (s); NaN where there is none.
    """
    first, edge = 0, begin
    while first < len(time):
        if np.isnan(edge) or time[first] - edge > GAP:
            edge = np.nan
        start = time[first] if np.isnan(edge) else edge
        last = int(np.searchsorted(time, start + STEP + 1e-9, side="right"))
        last = max(last, first + 1)
        if len(time) - last < 2:
            last = len(time)
        jumps = np.flatnonzero(np.diff(time[first:last]) > GAP)
        if len(jumps):
            last = first + int(jumps[0]) + 1
        own = slice(first, last)
        end = time[last - 1]
        lo, hi = np.searchsorted(field_time, [start, end], side="right")
        yield OrientationStretch(
            edge,
            time[own],
            gyro_body[own],
            accel_body[own],
            field_time[lo:hi],
            field_t[lo:hi] / MICROTESLA,
            bool(np.all(rests[own])),
        )
        first, edge = last, float(end)
