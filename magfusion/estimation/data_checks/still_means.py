"""Means of specific force and field over seconds, in gyro-stabilized axes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.data_checks.field_rotation import field_body
from magfusion.model.quaternion import inverse, matrices, rotate
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.turn import body_turn_of
from magfusion.units import Array, IntArray

SPAN = 4.0  # s; over which specific force and field are averaged
FULL = 0.8  # share of a span's samples that must exist


@dataclass(frozen=True, eq=False)
class StillMeans:
    """Specific force and field, averaged over spans in gyro-stabilized axes."""

    time: Array  # (n,), middle of each span, on the log's clock (s)
    # force_body, field_body: (n, 3), in body axes at that time (m/s^2, T); the field is NaN where
    # none was measured
    force_body: Array
    field_body: Array
    # (n, 3, 3), attitude at that time, integrated from the gyroscope since the log's first sample
    still_from_body: Array
    attitude: Callable[[Array], Array]  # the same at other times, quaternions, as of `body_turn_of`

    def __len__(self) -> int:
        return len(self.time)

    @property
    def angle(self) -> Array:
        """Between vertical and field (rad), shape (n,)."""
        return angle_between(self.force_body, self.field_body)

    def near(self, poses: Trajectory, limit: float) -> tuple[IntArray, IntArray, Array]:
        """Return the spans with a pose nearer than a limit (s), these poses, and attitudes.

        Returns `spans`, `poses` (m,): rows; `world_from_body` (m, 3, 3): at the middle of each
        span: that of the pose, rotated by the gyroscope.
        """
        nothing = np.zeros(0, dtype=np.int64)
        if not len(poses) or not len(self):
            return nothing, nothing, np.zeros((0, 3, 3))
        after = np.clip(np.searchsorted(poses.time, self.time), 0, len(poses) - 1)
        before = np.maximum(after - 1, 0)
        closer = self.time - poses.time[before] < poses.time[after] - self.time
        nearest = np.where(closer, before, after)
        spans = np.flatnonzero(np.abs(poses.time[nearest] - self.time) < limit)
        row = nearest[spans]
        body_from_still = matrices(inverse(self.attitude(poses.time[row])))
        return (
            spans,
            row,
            poses.world_from_body[row] @ body_from_still @ self.still_from_body[spans],
        )


def still_means(log: Log, site: Site | None, span: float = SPAN) -> StillMeans:
    """Average specific force and field over spans of a log (s)."""
    imu = log.imu
    offset = 0.0 if site is None else site.platform.imu.time_offset
    time = imu.time + offset
    attitude, none = body_turn_of(replace(imu, time=time)), np.zeros((0, 3))
    nothing = StillMeans(np.zeros(0), none, none, np.zeros((0, 3, 3)), attitude)
    if len(time) < 2 or not log.inertial:
        return nothing
    still_from_body = attitude(time)
    force = rotate(still_from_body, imu.accel_body.T).T
    field = np.full_like(force, np.nan)
    if log.vectors is not None:
        known = field_body(log, site)
        body = [np.interp(time, log.vectors.time, c) for c in known.T]
        field = rotate(still_from_body, np.stack(body)).T
    number = np.floor((time - time[0]) / span).astype(np.int64)
    count = np.bincount(number)
    full = count > FULL * span / float(np.median(np.diff(time)))
    if not np.any(full):
        return nothing
    middle = time[0] + span * (np.flatnonzero(full) + 0.5)
    nearest = np.clip(np.searchsorted(time, middle), 0, len(time) - 1)
    still_from_body = still_from_body[:, nearest]

    def mean(value: Array) -> Array:
        total = np.stack([np.bincount(number, column) for column in value.T], axis=1)
        return rotate(inverse(still_from_body), (total[full] / count[full, None]).T).T

    return StillMeans(time[nearest], mean(force), mean(field), matrices(still_from_body), attitude)


def angle_between(a: Array, b: Array) -> Array:
    """Return angles between vectors (..., 3) (rad)."""
    size = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    cosine = np.sum(a * b, axis=-1) / np.maximum(size, 1e-30)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
