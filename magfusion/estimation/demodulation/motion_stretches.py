"""The motion along a log in segments of samples, to limit the memory in a long one.

A segment has the states and inertial samples on which its motion depends: the shape between two
states is independent of those farther away, except for averages near them.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.estimation.demodulation.motion_shape import MARGIN, MotionShape
from magfusion.estimation.graph.preintegration import low_pass_reach
from magfusion.model.samples import ImuSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

STRETCH = 1 << 17  # samples; a multiple of those that are predicted at once


class SampleStretch(NamedTuple):
    """Consecutive samples."""

    # first, last: index of the first sample, and of the one after the last
    first: int
    last: int
    # start, until: times that are nearest to them (s)
    start: float
    until: float
    shape: MotionShape  # motion in the segment

    def pieces(self, at_once: int) -> Iterator[slice]:
        """Yield slices of the samples, of at most this length."""
        for begin in range(self.first, self.last, at_once):
            yield slice(begin, min(begin + at_once, self.last))

    def at_others(self, wanted: Array) -> Trajectory:
        """Return the motion at those of some times (s) that belong to the segment."""
        own = wanted[(self.start <= wanted) & (wanted < self.until)]
        if not len(own):
            return Trajectory(own, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
        return self.shape.at(own)


def only_stretch(time: Array, shape: MotionShape) -> Iterator[SampleStretch]:
    """Yield all samples (n,) (s) as one segment with a single shape."""
    yield SampleStretch(0, len(time), -np.inf, np.inf, shape)


def stretches(
    time: Array, path: Trajectory, imu: ImuSamples, time_offset: float, gravity: float
) -> Iterator[SampleStretch]:
    """Yield all samples in consecutive segments.

    `time` (n,): of the samples, strictly increasing (s). `path`: states between which the motion is
    interpolated. `time_offset`: of the IMU (s). `gravity` (m/s^2).
    """
    if len(time) <= STRETCH:
        yield from only_stretch(time, MotionShape.of(path, imu, time_offset, gravity))
        return
    reach, stamps = low_pass_reach(_usual(imu)), imu.time + time_offset
    margin = 2 * reach + 2 * MARGIN  # averages are averaged again
    for first in range(0, len(time), STRETCH):
        last = min(first + STRETCH, len(time))
        states, samples = _about(time[first:last], path.time, stamps, margin)
        own = ImuSamples(imu.time[samples], imu.gyro_body[samples], imu.accel_body[samples])
        shape = MotionShape.of(path.rows(states), own, time_offset, gravity, reach)
        start_time = float(time[first]) if first > 0 else -np.inf
        until = float(time[last]) if last < len(time) else np.inf
        yield SampleStretch(first, last, start_time, until, shape)


def joined(parts: list[Trajectory]) -> Trajectory:
    """Return consecutive trajectories as one."""
    if len(parts) == 1:
        return parts[0]
    known = (name for name, value in vars(parts[0]).items() if value is not None)
    return Trajectory(**{k: np.concatenate([getattr(p, k) for p in parts]) for k in known})


def _usual(imu: ImuSamples) -> float:
    return float(np.median(np.diff(imu.time)))


def _about(time: Array, known: Array, stamps: Array, margin: int) -> tuple[slice, slice]:
    """Return the states and the inertial samples on which the motion in a segment depends."""
    first = int(np.searchsorted(known, time[0], side="right")) - 1
    last = int(np.searchsorted(known, time[-1]))
    begin = end = None  # unlimited, where the segment is at an end of the log
    if first > 0:
        sample = int(np.searchsorted(stamps, known[first])) - margin
        before = int(np.searchsorted(known, stamps[max(sample, 0)], side="right")) - 2
        if sample > 0 and before > 0:
            begin = before
    if last < len(known) - 1:
        sample = int(np.searchsorted(stamps, known[last])) + margin
        after = int(np.searchsorted(known, stamps[min(sample, len(stamps) - 1)])) + 1
        if sample < len(stamps) and after < len(known) - 1:
            end = after
    from_sample = None if begin is None else max(_at(stamps, known[begin]) - MARGIN, 0)
    to_sample = None if end is None else _at(stamps, known[end]) + MARGIN
    return slice(begin, None if end is None else end + 1), slice(from_sample, to_sample)


def _at(stamps: Array, time: float) -> int:
    return int(np.searchsorted(stamps, time))
