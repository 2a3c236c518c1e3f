"""Orientation smoother: the filter forward, and a backward pass over all measurements."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.orientation.filter import OrientationFilter, Update
from magfusion.estimation.orientation.layout import SIZE, Orientation
from magfusion.estimation.orientation.stretch import OrientationStretch, stretches
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.strapdown import resting
from magfusion.units import Array

PIECE = 1500  # segments whose matrices are in memory at once


@dataclass(frozen=True, eq=False)
class Oriented:
    """Orientation of a log."""

    time: Array  # (n,), of the inertial samples (s)
    world_from_body: Array  # (n, 3, 3), at each
    states: tuple[Orientation, ...]  # at the ends of the segments
    disturbance: Array  # (stretches,), usual deviation of the field then (uT)
    changed: Array  # (m,), times of changes of the field that the model did not explain (s)

    @property
    def ends(self) -> Array:
        """Times of the states (s)."""
        return np.array([state.time for state in self.states])


def pieces(log: Log, site: Site) -> list[OrientationStretch]:
    """Return the segments of a log, on its clock.

    Raises InputError where it has no samples of the magnetometer, or too few of the IMU.
    """
    imu, wave = log.imu, log.waveform
    if wave is None or len(wave) == 0:
        raise InputError(
            "has only phasors, which do not contain the Earth field; give the log with"
            " magnetometer.parquet"
        )
    if len(imu) < 3:
        raise InputError(f"has {len(imu)} inertial samples; orientation needs the gyroscope")
    time = imu.time + site.platform.imu.time_offset
    rests = resting(time, imu.gyro_body, imu.accel_body, motion=site.platform.motion)
    streams = (time, imu.gyro_body, imu.accel_body, rests, wave.time, wave.measured_sensor)
    return list(stretches(*streams, float("nan")))


def oriented(log: Log, site: Site, *, back: bool = True, report: Report = quiet) -> Oriented:
    """Estimate the orientation of a log at every inertial sample.

    `back`: whether to use later samples too; otherwise the estimate is that of the online filter.
    """
    cut = pieces(log, site)
    estimator, snapshots, last = OrientationFilter(site), [], None
    samples = np.cumsum([0, *(len(s.time) for s in cut)])
    attitude = np.empty((samples[-1], 3, 3))
    disturbance, changed, states = np.empty(len(cut)), [], []
    for k, stretch in enumerate(cut):
        if k % PIECE == 0:
            snapshots.append(copy.deepcopy(estimator))
            report("orientation", k, len(cut) * (2 if back else 1))
        last = estimator.take(stretch)
        disturbance[k] = last.disturbance
        if last.changed:
            changed.append(last.state.time)
        if not back:
            own = slice(samples[k], samples[k + 1])
            begin = last.predicted.world_from_body @ last.attitude[-1].T
            attitude[own] = begin @ last.attitude[1:]
            attitude[samples[k + 1] - 1] = last.state.world_from_body
            states.append(last.state)
    if back:
        assert last is not None
        states = []
        for k, state, rotated in _smoothed(cut, snapshots, estimator.measured_from_body):
            states.append(state)
            own = slice(samples[k], samples[k + 1])
            attitude[own] = rotated
        states.reverse()
    time = np.concatenate([s.time for s in cut])
    return Oriented(time, attitude, tuple(states), disturbance, np.array(changed))


def _smoothed(
    cut: list[OrientationStretch], snapshots: list[OrientationFilter], measured_from_body: Array
) -> Iterator[tuple[int, Orientation, Array]]:
    """Yield the segments from the last to the first: state at the end, attitudes at samples."""
    after: Orientation | None = None
    later: Update | None = None
    for piece in reversed(range(len(snapshots))):
        estimator, first = snapshots[piece], piece * PIECE
        updates = [estimator.take(stretch) for stretch in cut[first : first + PIECE]]
        for k in reversed(range(len(updates))):
            own = updates[k]
            if after is None or later is None:
                state = own.state
            else:
                state = _one_back(own.state, later, after, measured_from_body)
            if later is not None and after is not None:
                yield first + k + 1, after, _between(state, later, after)
            after, later = state, own
    if after is not None and later is not None:
        yield 0, after, _between(None, later, after)


def _one_back(
    state: Orientation, later: Update, after: Orientation, measured_from_body: Array
) -> Orientation:
    """Return a state smoothed by later measurements (Rauch, Tung and Striebel)."""
    cross = later.transition @ state.cov
    # A state that the site declares known has no variance to invert.
    is_estimated = np.diag(later.predicted.cov) > 0.0
    gain = np.zeros((SIZE, SIZE))
    gain[:, is_estimated] = np.linalg.solve(
        later.predicted.cov[np.ix_(is_estimated, is_estimated)], cross[is_estimated]
    ).T
    step = gain @ later.predicted.step_to(after, measured_from_body)
    cov = state.cov + gain @ (after.cov - later.predicted.cov) @ gain.T
    floor = 1e-3 * np.diag(state.cov)
    cov[np.arange(SIZE), np.arange(SIZE)] = np.maximum(np.diag(cov), floor)
    return replace(state.moved(step, measured_from_body), cov=0.5 * (cov + cov.T))


def _between(before: Orientation | None, update: Update, after: Orientation) -> Array:
    """Return the attitudes at a segment's samples, its rotation fitted to its ends."""
    count = len(update.stretch.time)
    if before is None or np.isnan(update.stretch.begin):
        begin = after.world_from_body @ update.attitude[-1].T
        return np.asarray(begin @ update.attitude[1:])
    propagated = before.world_from_body @ update.attitude
    missed = Rotation.from_matrix(propagated[-1].T @ after.world_from_body).as_rotvec()
    share = np.arange(1, count + 1)[:, None] / count
    return np.asarray(propagated[1:] @ Rotation.from_rotvec(share * missed).as_matrix())
