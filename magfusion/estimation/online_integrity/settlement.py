"""Test whether beacons move steadily against each other while the platform rests for hours.

At one pose a movement is a slope of the residuals that neither the pose nor gain and phase of each
beacon's drive explain, which may drift, too: those are projected out.  The ratio of a beacon's
moments is taken as constant, as is the magnetometer's matrix but for its scale.  Averages over the
rest make the standard error independent of the noise's model.  A movement of all beacons together
moves the pose, and is not observable.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from magfusion.estimation.data_checks.statistics import FALSE_ALARMS
from magfusion.estimation.graph.state import State, states_of
from magfusion.estimation.integrity.fixed_parameter_test import MARGIN
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.files.site_changes import changed_keys
from magfusion.model.detection_range import are_many
from magfusion.model.noise import paired_whitening
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    GAIN,
    PHASE,
    Block,
    Parameter,
    candidates,
    placed,
)
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DAY, DEGREE, HOUR, Array, BoolArray, ComplexArray, IntArray

SETTLEMENT = "settlement"  # code
AVERAGED = 1800.0  # s; of one average
MIN_AVERAGES, MAX_AVERAGES = 8, 96  # two neighbours are joined where there are more
INTERVAL = 20.0  # s; between two poses at which the platform might have begun to rest
NEAR, NEARLY = 0.02, 2.0 * DEGREE  # m, rad; estimates of one pose at rest differ by less
POSE = 6  # components of a beacon's movement: rotation, then position
UNOBSERVED = 1e-4  # share of the largest information, below which a direction is a gain or a phase
TURN_GAIN = float(chdtri(3, 1e-3))  # what a turn explains by chance
MAX_CORRELATION = 0.95  # of successive averages
# By chance in one result of a rest, of which there are as many as averages.
P_MOVED = FALSE_ALARMS / MAX_AVERAGES


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest, and the averages of what its pose and the drifting parameters do not explain."""

    world_from_body: Array  # (3, 3)
    position_world: Array  # (3,) (m)
    begin: float  # s
    used: float  # newest epoch (s)
    there: BoolArray  # (channels, 3), components that are measured
    variance: float  # mean of theirs at the beginning (T^2)
    predicted: Array  # (channels, 6), phasors at the beginning, real part first (T)
    whitening: Array  # (channels, 6, 6)
    explained: Array  # (6 channels, k), orthonormal columns
    by_movement: Array  # (6 channels, 6 beacons), whitened, without what is explained
    count: Array  # (n,), epochs of each average, as many as their noise is worth
    time: Array  # (n,), their mean (s)
    mean: Array  # (n, 6 channels)

    def check(self, site: Site) -> None:
        """Raise ValueError unless the shapes are those of a site."""
        channels, averages, size = len(site.channels), len(self.count), 6 * len(site.channels)
        shapes = {
            "world_from_body": (3, 3),
            "position_world": (3,),
            "there": (channels, 3),
            "predicted": (channels, 6),
            "whitening": (channels, 6, 6),
            "explained": (size, self.explained.shape[-1]),
            "by_movement": (size, POSE * len(site.beacons)),
            "time": (averages,),
            "mean": (averages, size),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or not np.all(np.isfinite(value)):
                raise ValueError(f"has an invalid {name}")
        if self.count.ndim != 1 or not np.all(self.count > 0.0) or averages > MAX_AVERAGES:
            raise ValueError("has invalid counts")

    def with_epoch(self, time: float, measured: Array, weight: float = 1.0) -> "Rest":
        """Return the rest with the phasors of an epoch, (channels, 6) (T).

        `weight`: ratio of the variance at the beginning to that of the epoch.
        """
        # As if no clock of a drive had advanced since the beginning.
        turn = np.sum(np.conj(_complex(measured)) * _complex(self.predicted), axis=1)
        turn = np.exp(1j * np.angle(turn))[:, None]
        error = turn * _complex(measured) - _complex(self.predicted)
        error = np.concatenate([error.real, error.imag], axis=1)
        residual = (self.whitening @ error[..., None]).reshape(-1)
        rest = residual - self.explained @ (self.explained.T @ residual)
        count, times, mean = self.count, self.time, self.mean
        number = (time - self.begin) // AVERAGED
        if not len(count) or number > (self.used - self.begin) // AVERAGED:
            if len(count) >= MAX_AVERAGES:
                count, times, mean = _joined(count, times, mean)
            count, times = np.append(count, 0.0), np.append(times, 0.0)
            mean = np.concatenate([mean, np.zeros((1, mean.shape[1]))])
        else:
            count, times, mean = count.copy(), times.copy(), mean.copy()
        count[-1] += weight
        times[-1] += weight / count[-1] * (time - times[-1])
        mean[-1] += weight / count[-1] * (rest - mean[-1])
        return replace(self, used=time, count=count, time=times, mean=mean)


class Movement(NamedTuple):
    """A steady movement of a beacon against the others, in world axes.

    One along the line of sight to the platform is not distinguished from a gain: it is zero here.
    """

    beacon: int
    per_day: Array  # (6,), rotation about the beacon's axes (rad), then position (m)
    cov: Array  # (6, 6)
    days: float  # for which it was observed
    excess: float  # of the test statistic over its limit

    @property
    def distance(self) -> float:
        """Distance moved (m)."""
        return float(np.linalg.norm(self.per_day[3:])) * self.days

    @property
    def _turn(self) -> str:
        turn = float(np.rad2deg(np.linalg.norm(self.per_day[:3])))
        return f", and turns by {turn:.2g} deg a day" if turn else ""

    def finding(self, site: Site) -> Finding:
        """Return the finding: a remark while the declared sigma covers the movement."""
        beacon = site.beacons[self.beacon]
        size = np.linalg.norm(self.per_day[3:])
        along = self.per_day[3:] / size
        sigma = np.sqrt(along @ self.cov[3:, 3:] @ along)
        axes = ", ".join(
            f"{name} {1e3 * value:+.2g}"
            for name, value in zip("xyz", self.per_day[3:], strict=True)
        )
        text = (
            f"Beacon {beacon.name} moves steadily against the others by at least"
            f" {1e3 * size:.2g} ±"
            f" {1e3 * sigma:.1g} mm a day ({axes}), {1e3 * self.distance:.2g} mm in the"
            f" last {self.days * DAY / HOUR:.0f} h{self._turn}: it settles, its mount creeps, or"
            " its coils drift against each other."
        )
        declared = beacon.sigma.position_world
        covered = self.distance <= float(np.linalg.norm(declared))
        text += (
            " The declared sigma of its position covers this so far."
            if covered
            else " Survey it again, or declare a larger sigma.position_m."
        )
        wide = np.hypot(declared, np.abs(self.per_day[3:]) * self.days)
        beacons = list(site.beacons)
        beacons[self.beacon] = replace(beacon, sigma=replace(beacon.sigma, position_world=wide))
        remedy = changed_keys(site, replace(site, beacons=tuple(beacons)))
        verdict = Verdict.TRUSTWORTHY if covered else Verdict.DOUBTFUL
        return Finding(SETTLEMENT, text, verdict, self.excess, remedy=remedy)


class SettlementTest:
    """The test of the beacons of a running estimate; of few beacons, on a platform with an IMU."""

    _rest: Rest | None
    _movements: tuple[Finding, ...]

    def __init__(self, site: Site) -> None:
        self.site = site
        self._is_tested = len(site.beacons) > 1 and not are_many(site) and site.platform.inertial
        self._rest, self._movements = None, ()
        self._drifting = _blocks(site, (GAIN, PHASE))
        self._moving = _blocks(site, (BEACON_ROTATION, BEACON_POSITION))

    def findings(self) -> tuple[Finding, ...]:
        """Return the movements in this rest, or in the last one while this one is short."""
        return self._movements

    def update(self, phasors: FieldPhasors, samples: FieldSamples, state: State) -> None:
        """Process an epoch: its fields, whether rejected or not, and the state after it."""
        rest = self._rest
        if not self._is_tested or not np.any(samples.there):
            return
        if rest is None or not self._continues(rest, samples, state):
            if rest is not None and state.time < rest.begin + INTERVAL:
                return
            rest = self._begun(phasors, samples, state)
        elif not np.array_equal(samples.there[0], rest.there):
            return
        weight = rest.variance / _mean_variance(samples)
        self._rest = rest.with_epoch(state.time, phasors.measured[0], weight)
        if len(self._rest.count) != len(rest.count) >= MIN_AVERAGES:  # an average is complete
            moved = movements(rest, len(self.site.beacons))
            self._movements = tuple(one.finding(self.site) for one in moved)

    def _continues(self, rest: Rest, samples: FieldSamples, state: State) -> bool:
        """Return whether the platform is still where it was, with beacons as they were."""
        shift = np.linalg.norm(state.position_world - rest.position_world)
        trace = np.sum(state.world_from_body * rest.world_from_body)
        turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
        silent = state.time > rest.used + AVERAGED  # other beacons for as long
        others = silent and not np.array_equal(samples.there[0], rest.there)
        return bool(shift < NEAR and turn < NEARLY and not others)

    def _begun(self, phasors: FieldPhasors, samples: FieldSamples, state: State) -> Rest:
        there = samples.there[0]
        whitening = paired_whitening(samples.phasor_cov, samples.there)[0]
        blocks = placed((*self._drifting, *self._moving))
        at = states_of([state]), state.calibration, blocks
        value, by_pose, _, by_calibration = phasors.unwhitened(*at)
        size = 6 * len(there)
        by_free, by_movement = np.split(
            (whitening @ by_calibration[0]).reshape(size, -1), [self._moving_from], axis=1
        )
        nuisance = np.concatenate([(whitening @ by_pose[0]).reshape(size, POSE), by_free], axis=1)
        explained = _own_basis(nuisance, np.zeros((size, 0)))
        by_movement = by_movement - explained @ (explained.T @ by_movement)
        return Rest(
            world_from_body=state.world_from_body,
            position_world=state.position_world,
            begin=state.time,
            used=state.time,
            there=there,
            variance=_mean_variance(samples),
            predicted=value[0],
            whitening=whitening,
            explained=explained,
            by_movement=by_movement,
            count=np.zeros(0),
            time=np.zeros(0),
            mean=np.zeros((0, size)),
        )

    @property
    def _moving_from(self) -> int:
        return self._drifting[-1].columns.stop


def movements(rest: Rest, beacons: int) -> list[Movement]:
    """Return the beacons that move steadily, the most certain first.

    One more is named only where those named do not explain the slopes, and none while another
    beacon explains them as well.  A step is none.
    """
    count, time = rest.count, rest.time - np.average(rest.time, weights=rest.count)
    freedom = 2 * int(np.count_nonzero(rest.there)) - rest.explained.shape[1]
    if freedom < 1:
        return []
    moment = count @ time**2
    slope = (count * time) @ rest.mean / moment
    scatter = rest.mean - np.average(rest.mean, axis=0, weights=count) - np.outer(time, slope)
    remaining = float(count @ np.sum(scatter**2, axis=1))
    if remaining > _after_a_step(count, rest.mean):
        return []
    scatters = freedom * (len(count) - 2)
    variance = remaining / scatters * _correlated(np.sqrt(count)[:, None] * scatter) / moment
    slopes, by_movement = slope / np.sqrt(variance), rest.by_movement / np.sqrt(variance)
    named: list[_Candidate] = []
    while len(named) < beacons - 1:
        best, *others = _ranked(slopes, by_movement, named, scatters)
        if best.excess < 1.0 or any(one.gain > best.gain - MARGIN for one in others):
            break
        named.append(best)
    if not named:
        return []
    rows = np.concatenate([one.rows for one in named])
    information = by_movement[:, rows].T @ by_movement[:, rows]
    # A turn about the axis of a rotating beacon is a phase, a movement along the line of sight a
    # gain.
    cov = np.zeros((by_movement.shape[1],) * 2)
    cov[np.ix_(rows, rows)] = np.linalg.pinv(information, rcond=UNOBSERVED, hermitian=True)
    per_second = cov @ (by_movement.T @ slopes)
    days = float(np.ptp(rest.time)) / DAY
    return [
        Movement(one.beacon, DAY * per_second[own], DAY**2 * cov[own, own], days, one.excess)
        for one in named
        for own in (slice(POSE * one.beacon, POSE * (one.beacon + 1)),)
    ]


class _Candidate(NamedTuple):
    """A movement of a beacon: a shift, or a shift with a turn."""

    beacon: int
    rows: IntArray  # of the movements of all beacons
    gain: float  # decrease of -2 log likelihood
    excess: float  # of the gain over the limit of chance


def _ranked(
    slopes: Array, by_movement: Array, named: Sequence[_Candidate], scatters: int
) -> list[_Candidate]:
    """Return what a movement of each other beacon explains in addition, the most first."""
    basis, beacons = np.zeros((len(slopes), 0)), by_movement.shape[1] // POSE
    for one in named:
        basis = np.concatenate([basis, _own_basis(by_movement[:, one.rows], basis)], axis=1)

    def gain(rows: IntArray) -> float:
        return float(np.sum((_own_basis(by_movement[:, rows], basis).T @ slopes) ** 2))

    others = sorted(set(range(beacons)) - {one.beacon for one in named})
    result = []
    for beacon in others:
        whole = POSE * beacon + np.arange(POSE)
        shift = whole[POSE // 2 :]
        rows = whole if gain(whole) - gain(shift) > TURN_GAIN else shift
        limit = len(rows) * float(fdtri(len(rows), scatters, 1.0 - P_MOVED / beacons))
        result.append(_Candidate(beacon, rows, gain(rows), gain(rows) / limit))
    return sorted(result, key=lambda one: -one.excess)


def _own_basis(columns: Array, basis: Array) -> Array:
    """Return an orthonormal basis of columns, orthogonal to a basis."""
    columns = columns - basis @ (basis.T @ columns)
    norm = np.linalg.norm(columns, axis=0)
    vectors, singular, _ = np.linalg.svd(columns[:, norm > 0.0] / norm[norm > 0.0], False)
    return np.asarray(vectors[:, singular > 1e-6 * max(singular, default=1.0)])


def _after_a_step(count: Array, mean: Array) -> float:
    """Return the least scatter about a step between two averages."""
    before, total = np.cumsum(count)[:-1], count.sum()
    centred = count[:, None] * (mean - np.average(mean, axis=0, weights=count))
    jump = np.sum(np.cumsum(centred, axis=0)[:-1] ** 2, axis=1)
    explained = jump * total / (before * (total - before))
    whole = float(np.sum(centred**2 / count[:, None]))
    return whole - float(np.max(explained))


def _correlated(scatter: Array) -> float:
    """Return the factor of a slope's variance by the correlation of successive averages."""
    both = np.sum(scatter[1:] * scatter[:-1])
    share = float(np.clip(both / np.sum(scatter**2), 0.0, MAX_CORRELATION))
    return (1.0 + share) / (1.0 - share)


def _mean_variance(samples: FieldSamples) -> float:
    variance = np.diagonal(samples.phasor_cov[0], axis1=1, axis2=2)
    return float(np.mean(variance[samples.there[0]]))


def _complex(parts: Array) -> ComplexArray:
    return np.asarray(parts[:, :3] + 1j * parts[:, 3:])


def _joined(count: Array, time: Array, mean: Array) -> tuple[Array, Array, Array]:
    pairs = count.reshape(-1, 2)
    both = pairs.sum(axis=1)
    times = np.sum(pairs * time.reshape(-1, 2), axis=1) / both
    joined = np.einsum("np,npk->nk", pairs, mean.reshape(len(both), 2, -1)) / both[:, None]
    return both, times, joined


def _blocks(site: Site, kinds: tuple[Parameter, ...]) -> tuple[Block, ...]:
    return placed(
        Block(kind, owner, slice(0), np.ones(1 if kind == GAIN else len(kind.sigma(site, owner))))
        for kind, owner in candidates(site, kinds)
    )
