"""Starts joined by the inertial stream: tracks of every hypothesis, forward and backward.

A track that took the wrong branch where two mirrored poses meet is worse from there on than one
that restarts on the other side, at a price.  Tracks that are little worse at the end are rivals,
for the whole log or for a part of it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.batch.strides import Strides, strides_between
from magfusion.estimation.batch.tracks import (
    TrackPhasors,
    Tracks,
    propagate_tracks,
    rows_at,
    track_phasors,
    updated,
)
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.channel_effects import of_all_sensors
from magfusion.model.parameters import Calibration
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.model.strapdown import attitude_at, attitude_from_gyro, mean_about
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

STEP = 0.1  # s; of the epochs that tracks process, unless windows are longer
VISITS = 6000  # maximum; a longer log has longer steps
MAX_STEP = 2.0  # s; over which an inertial stream still joins fixes
RESTART_INTERVAL = 1.0  # s; between epochs at which tracks may restart
PHASE_RESTART_EPOCHS = 4  # of these, at which drive phases may restart too
LEAP = 60.0  # chi square; price of a restart
MAX_TRACKS = 12  # maximum number of tracks at a time
WORSE = 250.0  # chi square; a track worse by more is discarded
SAME_PLACE, SAME_TURN = 0.03, 0.03  # m, rad; within which two tracks are one
RETURNING = 4  # tracks of the backward search
OTHERWISE, STRETCH = 0.1, 0.5  # m or rad, and s; minimum deviation of a rival, and its duration
RIVALS = 3
FIRST_ROTATION, FIRST_POSITION, FIRST_PHASE = 0.5, 1.0, 1.0  # rad, m, rad; if unobservable


@dataclass(frozen=True, eq=False)
class FoundTrajectory:
    """Trajectory of a track."""

    states: Trajectory  # at some of the epochs, with velocity
    phase: Array  # (n, channels), drive phase relative to the calibration's (rad)
    cost: float  # of its track


@dataclass(frozen=True, eq=False)
class Search:
    """Inputs of the search: phasors, strides, fixes and gravity of the same epochs."""

    samples: FieldSamples
    phasors: TrackPhasors
    strides: Strides
    fixes: Fixes
    gravity: Gravity

    @property
    def site(self) -> Site:
        """As declared."""
        return self.phasors.site


@dataclass(frozen=True)
class _Meeting:
    """Two tracks that merged at a visited epoch: rows of the epoch before."""

    visit: int
    kept: int
    lost_epochs: int
    worse: float


@dataclass(frozen=True, eq=False)
class _Followed:
    """Tracks of every visited epoch, and those that were merged into others."""

    visits: list[Tracks]
    meetings: list[_Meeting]

    def path(self, row: int, visit: int) -> list[tuple[int, int]]:
        """Return visit and row of a track's history, newest first."""
        out = []
        for i in range(visit, -1, -1):
            out.append((i, row))
            row = int(self.visits[i].parent[row])
        return out


def search(
    samples: FieldSamples, fixes: Fixes, imu: ImuSamples, calibration: Calibration
) -> list[FoundTrajectory]:
    """Return the trajectories that explain a log best, the most probable first.

    `samples`: epochs of the fixes. `imu`: with the gyro's bias at rest removed.
    """
    kept = thinned(samples)
    some = samples.rows(kept)
    offset, site = calibration.time_offset, calibration.site
    search = Search(
        some,
        track_phasors(some, calibration),
        strides_between(imu, offset, some.time),
        fixes.rows(kept),
        upright(imu, offset, some.time, site),
    )
    count = len(some)
    ahead = follow_tracks(search, _seeds(search, 0), range(count))
    last = ahead.visits[-1]
    best = last.rows(np.argsort(last.cost)[:RETURNING])
    # The backward search uses the forward data again: that gives only its start.
    parent = np.arange(len(best))
    again = replace(best, cov=4.0 * best.cov, cost=np.zeros(len(best)), parent=parent)
    back = follow_tracks(search, again, range(count - 1, -1, -1))
    return _trajectories(search, back)


def can_search(samples: FieldSamples) -> bool:
    """Return whether the length of a log suits tracks."""
    return len(samples) > 2 and float(np.ptp(samples.time)) <= VISITS * MAX_STEP


def thinned(samples: FieldSamples) -> IntArray:
    """Return which epochs are used, so that no two windows share a sample."""
    usual = float(np.median(np.diff(samples.time)))
    wanted = max(STEP, float(np.median(samples.window)), float(np.ptp(samples.time)) / VISITS)
    stride = min(round(wanted / usual), len(samples) - 1)  # both ends of the shortest log
    return np.arange(0, len(samples), max(1, stride))


def upright(imu: ImuSamples, time_offset: float, time: Array, site: Site) -> Gravity:
    """Return the direction of the mean specific force, which motion disturbs."""
    stamps, motion = imu.time + time_offset, site.platform.motion
    chain = attitude_from_gyro(stamps, imu.gyro_body)
    rotated = mean_about(stamps, chain.apply(imu.accel_body), time, motion.accel_span)
    if not site.platform.inertial:
        return Gravity(np.tile([0.0, 0.0, 1.0], (len(time), 1)), np.full(len(time), np.inf))
    up = attitude_at(chain, stamps, imu.gyro_body, time).inv().apply(rotated)
    sigma = np.full(len(time), motion.accel_sigma / site.gravity)
    return Gravity(up / np.linalg.norm(up, axis=1, keepdims=True), sigma)


def _seeds(search: Search, k: int) -> Tracks:
    """Return tracks that begin at the fixes of an epoch, with their drive phases."""
    phasors, site, rows = search.phasors, search.site, np.array([k])
    fixes = fix_epochs(
        search.samples.rows(rows), phasors.calibration, gravity=search.gravity.rows(rows)
    )
    good = np.flatnonzero(np.isfinite(fixes.cost[0]))
    free_parameters, none = int(np.sum(phasors.free_phases)), np.zeros((len(good), 3))
    drift_sigma = site.relative_clock.drift_sigma * 2.0 * np.pi
    clock = drift_sigma * site.tone_frequencies_hz[phasors.free_phases]
    phases = [np.full(free_parameters, FIRST_PHASE), np.maximum(clock, 1e-9)]
    sigma = np.concatenate([_motion_sigma(site), *phases])
    mine = site.of_sensor(0)
    own = phasors.calibration.drive_phase(phasors.time[k])[mine]
    tracks = Tracks(
        rotation=fixes.world_from_body[0, good],
        position=fixes.position_world[0, good],
        velocity=none,
        accel_bias=none,
        gyro_bias=none,
        phase=own + fixes.phase[0, good][:, mine],
        rate=np.zeros((len(good), len(phasors.free_phases))),
        cov=np.tile(np.diag(sigma**2), (len(good), 1, 1)),
        cost=fixes.cost[0, good] - fixes.cost[0, 0],
        parent=np.arange(len(good)),
    )
    _, by = rows_at(tracks, phasors, k)
    information = np.diag(1.0 / sigma**2) + np.swapaxes(by, 1, 2) @ by
    return replace(tracks, cov=np.asarray(np.linalg.inv(information), dtype=np.float64))


def _motion_sigma(site: Site) -> Array:
    """Return the prior sigmas of a track's motion, shape (15,)."""
    imu = site.platform.imu
    sigma = [
        FIRST_ROTATION,
        FIRST_POSITION,
        site.platform.motion.speed_sigma,
        max(imu.accel_bias_sigma, 1e-6),
        max(imu.gyro_bias_sigma, 1e-8),
    ]
    return np.repeat(sigma, 3)


def follow_tracks(search: Search, tracks: Tracks, order: Sequence[int]) -> _Followed:
    """Return tracks propagated and updated over epochs, in the order of a range."""
    phasors, backward = search.phasors, order[0] > order[-1]
    time = phasors.time
    visits, meetings = [_light(tracks)], list[_Meeting]()
    restarted, begun = time[order[0]], 0
    spent, selected = 0.0, 0.0
    for i in range(1, len(order)):
        k = order[i]
        before = float(np.min(tracks.cost))
        tracks = propagate_tracks(tracks, search.strides, min(k, order[i - 1]), phasors, backward)
        tracks = updated(replace(tracks, parent=np.arange(len(tracks))), phasors, k)
        spent = spent + float(np.min(tracks.cost)) - before
        selected += phasors.components[k]
        # Noise above the declared one increases every difference as well.
        level = max(1.0, spent / max(selected, 1.0))
        if abs(time[k] - restarted) >= RESTART_INTERVAL and phasors.components[k] > 0.0:
            restarted, begun = time[k], begun + 1
            fresh = not backward and begun <= PHASE_RESTART_EPOCHS
            tracks = _with_others(search, tracks, k, level, fresh=fresh)
        tracks, met = _merged(tracks, i)
        meetings += [m for m in met if m.worse < WORSE * level]
        keep = np.argsort(tracks.cost)[:MAX_TRACKS]
        keep = keep[tracks.cost[keep] < tracks.cost[keep[0]] + WORSE * level]
        tracks = tracks.rows(keep)
        visits.append(_light(tracks))
    return _Followed([*visits[:-1], tracks], meetings)


def _light(tracks: Tracks) -> Tracks:
    """Return tracks without their covariance, for storage."""
    return replace(tracks, cov=np.zeros((len(tracks), 0, 0)))


def _with_others(search: Search, tracks: Tracks, k: int, level: float, *, fresh: bool) -> Tracks:
    """Return tracks, with new ones at hypotheses of an epoch that no track is near."""
    best = int(np.argmin(tracks.cost))
    price, parent = tracks.cost[best] + LEAP * level, tracks.parent[best]
    others = [_restart(search, tracks, best, k)]
    if fresh and np.any(search.phasors.free_phases):
        others.append(_seeds(search, k))
    for other in others:
        if len(other):
            parents = np.full(len(other), parent)
            other = replace(other, cost=price + other.cost, parent=parents)
            new = other.rows(~np.any(_same(other, tracks), axis=1))
            tracks = _with_places(tracks, len(new)).joined(new)
    return tracks


def _with_places(tracks: Tracks, number: int) -> Tracks:
    """Return the best tracks, without the worst where new ones need their places.

    At their price new tracks would be discarded before any epoch shows that all others are lost.
    """
    kept = MAX_TRACKS - min(number, MAX_TRACKS // 2)
    return tracks.rows(np.argsort(tracks.cost)[:kept])


def _restart(search: Search, tracks: Tracks, best: int, k: int) -> Tracks:
    """Return tracks at the fixes of an epoch, with the drive phases of the best track.

    Its motion is not used, since that may be the cause of its error.
    """
    phasors, fixes, row = search.phasors, search.fixes, k
    if np.any(phasors.free_phases) and not np.all(
        fixes.determined[row, np.isfinite(fixes.cost[row])]
    ):
        # With the track's drive phases the azimuth is observable.
        site = phasors.site
        known = tuple(replace(beacon, synchronised=True) for beacon in site.beacons)
        calibration = replace(
            phasors.calibration,
            site=replace(site, beacons=known),
            phase=of_all_sensors(site, tracks.phase[best]),
            drift=np.zeros(len(known)),
            reference_time=float(phasors.time[k]),
        )
        fixes, row = fix_epochs(search.samples.rows(np.array([k])), calibration), 0
    cost = fixes.cost[row] - fixes.cost[row, 0]
    good = np.flatnonzero((cost < 2.0 * LEAP) & fixes.determined[row])
    new = tracks.rows(np.full(len(good), best))
    rotation = fixes.world_from_body[row, good]
    to_world = np.tile(np.eye(6), (len(good), 1, 1))
    to_world[:, 3:, 3:] = rotation
    cov = new.cov.copy()
    cov[:, :MOTION, :] = cov[:, :, :MOTION] = 0.0
    cov[:, :MOTION, :MOTION] = np.diag(_motion_sigma(search.site) ** 2)
    cov[:, :6, :6] = to_world @ fixes.pose_cov[row, good] @ np.swapaxes(to_world, 1, 2)
    none = np.zeros((len(good), 3))
    return replace(
        new,
        rotation=rotation,
        position=fixes.position_world[row, good],
        velocity=none,
        accel_bias=none,
        gyro_bias=none,
        cov=cov,
        cost=cost[good],
    )


def _same(some: Tracks, others: Tracks) -> BoolArray:
    """Return which tracks coincide with others, shape (some, others)."""
    away = np.linalg.norm(some.position[:, None] - others.position, axis=-1)
    turn = np.swapaxes(some.rotation, 1, 2)[:, None] @ others.rotation
    near = (away < SAME_PLACE) & (_angle(turn) < SAME_TURN)
    lag = np.angle(np.exp(1j * (some.phase[:, None] - others.phase)))
    return np.asarray(near & np.all(np.abs(lag) < 2.0 * SAME_TURN, axis=-1))


def _angle(turn: Array) -> Array:
    """Return the angle of rotation matrices, shape (...,)."""
    off = np.stack(
        [turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1
    )
    return np.arctan2(np.linalg.norm(off, axis=-1), np.einsum("...ii->...", turn) - 1.0)


def _merged(tracks: Tracks, visit: int) -> tuple[Tracks, list[_Meeting]]:
    """Return tracks without those that coincide with a better one."""
    if len(tracks) == 1:
        return tracks, []
    tracks = tracks.rows(np.argsort(tracks.cost))
    same, elapsed, met = _same(tracks, tracks), np.zeros(len(tracks), dtype=bool), []
    for j in range(1, len(tracks)):
        better = np.flatnonzero(same[j, :j] & ~elapsed[:j])
        if len(better):
            i, elapsed[j] = int(better[0]), True
            worse = float(tracks.cost[j] - tracks.cost[i])
            kept, lost_epochs = int(tracks.parent[i]), int(tracks.parent[j])
            if kept != lost_epochs:
                met.append(_Meeting(visit - 1, kept, lost_epochs, worse))
    return tracks.rows(~elapsed), met


def _trajectories(search: Search, followed: _Followed) -> list[FoundTrajectory]:
    """Return the best path, and those that differ from it for a while and are not much worse."""
    last = len(followed.visits) - 1
    order = np.argsort(followed.visits[-1].cost)
    paths = [(float(followed.visits[-1].cost[r]), followed.path(int(r), last)) for r in order]
    paths += list(_by_stretch(followed, *paths[0]))
    out: list[FoundTrajectory] = []
    for cost, path in sorted(paths, key=lambda pair: pair[0]):
        result = _read(search, followed, path, cost)
        if len(out) <= RIVALS and all(differ(result.states, other.states) for other in out):
            out.append(result)
    return out


def _by_stretch(
    followed: _Followed, cost: float, path: list[tuple[int, int]]
) -> Iterator[tuple[float, list[tuple[int, int]]]]:
    """Yield paths that separate from the best before one of its merges."""
    row_at = dict(path)
    for meeting in followed.meetings:
        if row_at.get(meeting.visit) == meeting.kept:
            earlier = followed.path(meeting.lost_epochs, meeting.visit)
            yield cost + meeting.worse, [p for p in path if p[0] > meeting.visit] + earlier


def differ(some: Trajectory, others: Trajectory) -> bool:
    """Return whether two trajectories of the same epochs differ in pose for long enough."""
    away = np.linalg.norm(some.position_world - others.position_world, axis=1)
    between = np.swapaxes(some.world_from_body, 1, 2) @ others.world_from_body
    other = (away > OTHERWISE) | (_angle(between) > OTHERWISE)
    step = float(np.median(np.diff(some.time)))
    return bool(np.sum(other) * step > STRETCH)


def _read(
    search: Search, followed: _Followed, path: list[tuple[int, int]], cost: float
) -> FoundTrajectory:
    """Return a path as a trajectory; its visits are in backward order."""
    rows = [(followed.visits[visit], row) for visit, row in path]

    def values(name: str) -> Array:
        return np.array([getattr(tracks, name)[row] for tracks, row in rows])

    time = search.samples.time
    own = search.phasors.calibration.drive_phase(time)[:, search.site.of_sensor(0)]
    states = Trajectory(
        time=time,
        world_from_body=values("rotation"),
        position_world=values("position"),
        velocity_world=values("velocity"),
    )
    phase = np.where(search.phasors.free_phases, values("phase") - own, 0.0)
    return FoundTrajectory(states, of_all_sensors(search.site, phase), cost)
