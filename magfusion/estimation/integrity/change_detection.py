"""What changed while a log ran: a gain, a clock, a bias, a mount or a beacon, from some time on.

An estimator takes all of them for constant.  A step of any of them at a quarter, at half and at
three quarters of the log is asked as `magfusion.estimation.integrity.fixed_parameter_test` asks
what is held: by how much the cost would fall, and how far the poses would move, whatever constant
errors there are beside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.statistics import holm, sigmas
from magfusion.estimation.integrity.fixed_parameter_test import (
    COVERED,
    MAX_LINEAR_CHI_SQUARE,
    ReleasedFault,
    release_fault,
    release_gain,
)
from magfusion.estimation.integrity.score import answered
from magfusion.estimation.integrity.suspects import Inertial, Stream, Suspect, spoken_name, suspects
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    GAIN,
    SENSOR_ROTATION,
    TIME_OFFSET,
    Block,
    Parameter,
    dimension,
    prior_sigma,
)
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, Array, ComplexArray

PARTS = (0.25, 0.5, 0.75)  # of the log, after which something may be another
MOST_BEACONS = 12  # of more, each has too many others to be asked so
MIN_EPOCHS = 40  # epochs, of which a part tells anything
SHORTEST = 10.0  # s
BUDGET = 1e-5  # of false alarms, beside half a per cent of all other witnesses together


class StepChange(Parameter):
    """What a parameter is more by from some time on (s)."""

    group = kind = "change"

    def __init__(self, of: Parameter, begin: float) -> None:
        self.of, self.begin = of, begin

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StepChange) and (self.of, self.begin) == (other.of, other.begin)

    def __hash__(self) -> int:
        return hash((self.of, self.begin))

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return the columns of the parameter itself, zero before."""
        columns = self.of.phasor_jacobian(view, owner)
        if columns is None:
            return None
        time = view.calibration.reference_time + view.elapsed
        return columns * (time >= self.begin)[:, None, None, None]


class Stamps(Parameter):
    """How late the magnetometer's stamps are (s), as its phases show it."""

    group, owner, kind = "change", "stamps", "delay"
    factor_of_phasor = True

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray:  # noqa: ARG002
        """Return what a delay does to the phases of every beacon."""
        turns = 2.0 * np.pi * view.beacon.tone_frequencies_hz
        return (-1j * view.phasor * turns[:, None])[..., None]


class Bias(Inertial):
    """A bias of the accelerometer or of the gyro, beside the one that walks."""

    def __init__(self, first: int) -> None:
        self.first = first

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bias) and self.first == other.first

    def __hash__(self) -> int:
        return hash((Bias, self.first))

    def as_bias(self, stream: Stream) -> Array:
        """Return ones in its own rows."""
        rows = np.zeros((6, 3))
        rows[self.first : self.first + 3] = np.eye(3)
        return np.broadcast_to(rows, (len(stream.imu), 6, 3))


class SinceBias(Inertial):
    """What a bias is more by from some time on (s)."""

    kind = "change"

    def __init__(self, of: Bias, begin: float) -> None:
        self.of, self.begin = of, begin

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SinceBias) and (self.of, self.begin) == (other.of, other.begin)

    def __hash__(self) -> int:
        return hash((SinceBias, self.of, self.begin))

    def as_bias(self, stream: Stream) -> Array:
        """Return the bias itself, zero before."""
        return self.of.as_bias(stream) * (stream.imu.time >= self.begin)[:, None, None]


STAMPS = Stamps()
ACCEL_BIAS, GYRO_BIAS = Bias(0), Bias(3)
# What may change, its size in a unit of the tangent vector, and in words.
TYPICAL: dict[Parameter, float] = {
    GAIN: 0.01,
    STAMPS: 1e-4,
    SENSOR_ROTATION: DEGREE,
    BEACON_POSITION: 0.01,
    BEACON_ROTATION: DEGREE,
    TIME_OFFSET: 1e-3,
    ACCEL_BIAS: 0.1,
    GYRO_BIAS: 0.01,
}


@dataclass(frozen=True, eq=False)
class Change:
    """A suspect, and since when it would be another."""

    fault: Suspect
    begin: float


def candidate_steps(result: Smoothed) -> list[Block]:
    """Return the steps of parameters that a log is asked for; none of one that is too short."""
    return [block for part in _steps_by_time(result).values() for block in part]


def _steps_by_time(result: Smoothed) -> dict[float, list[Block]]:
    """Return them by when they would be (s)."""
    site, time = result.declared.site, result.fields.time
    if not 1 < len(site.beacons) <= MOST_BEACONS or len(time) < MIN_EPOCHS:
        return {}
    begin, length = float(time[0]), float(time[-1] - time[0])
    if length < SHORTEST or len(result.graph.segments) > 1:
        return {}
    return {begin + part * length: _blocks(site, begin + part * length) for part in PARTS}


def changed(case: Case) -> TestResult:
    """Ask what may have changed while the log ran."""
    result, wide, parts = case.result, case.wide, _steps_by_time(case.result)
    if wide is None or not parts:
        return NOTHING
    every = wide.fixed
    information, gradient = wide.with_declared()
    known = [
        (one, estimate.log_p)
        for one in _changes(parts, every)
        if (estimate := release_gain(one.fault, information, gradient)) is not None
    ]
    informative = holm([log_p for _, log_p in known], BUDGET)
    if not np.any(informative):
        return NOTHING
    wide = answered(result, wide, case.log.imu)
    released = [
        (one, cause)
        for one, _ in known
        if (cause := release_fault(case.pose_cov, wide, one.fault, information, gradient))
        is not None
    ]
    likely = [
        pair
        for pair, significant in zip(released, informative, strict=True)
        if significant and np.mean(pair[1].distance) > COVERED
    ]
    if not likely:
        return NOTHING
    change, cause = max(likely, key=lambda pair: pair[1].gain)
    if cause.gain < _throughout(case, information, gradient):
        return NOTHING  # it was so from the beginning
    moved = cause.moved[:, :, None] * cause.moved[:, None, :]
    certain = wide.by_pose @ cause.known_cov @ np.swapaxes(wide.by_pose, 1, 2)
    return TestResult((_finding(change, cause, prior_sigma(every)),), spread=moved + certain)


def _changes(parts: dict[float, list[Block]], every: tuple[Block, ...]) -> list[Change]:
    """Return what may have changed at each of some times, as columns behind those held."""
    return [
        Change(fault, at)
        for at, part in zip(parts, _again(every, list(parts.values())), strict=True)
        for fault in _fault_candidates(part, dimension(every))
    ]


def _throughout(case: Case, information: Array, gradient: Array) -> float:
    """Return the most that anything held explains which is wrong all along."""
    assert case.score is not None
    own = slice(0, dimension(case.score.fixed))
    gains = [
        result.gain
        for fault in suspects(case.result.declared.site, case.score.fixed)
        if (
            result := release_fault(
                case.pose_cov,
                case.score,
                fault,
                information[own, own],
                gradient[own],
            )
        )
        is not None
    ]
    return max(gains, default=0.0)


def _blocks(site: Site, at: float) -> list[Block]:
    owners = [beacon.name for beacon in site.beacons]
    every: list[tuple[Parameter, str]] = [(GAIN, owner) for owner in owners]
    every += [(STAMPS, STAMPS.owner)]
    every += [(SENSOR_ROTATION, owner) for owner in SENSOR_ROTATION.owners(site)[:1]]
    every += [(BEACON_POSITION, owner) for owner in owners]
    every += [(BEACON_ROTATION, owner) for owner in owners]
    if site.platform.inertial:
        every += [(kind, "imu") for kind in (TIME_OFFSET, ACCEL_BIAS, GYRO_BIAS)]
    return [
        Block(
            SinceBias(kind, at) if isinstance(kind, Bias) else StepChange(kind, at),
            owner,
            slice(0),
            np.full(_width(kind), TYPICAL[kind]),
        )
        for kind, owner in every
    ]


def _width(kind: Parameter) -> int:
    return 1 if kind in (GAIN, STAMPS, TIME_OFFSET) else 3


def _again(every: tuple[Block, ...], parts: list[list[Block]]) -> Iterator[list[Block]]:
    """Yield the blocks of each part where they were placed."""
    at = {block.key: block for block in every}
    for part in parts:
        yield [at[block.key] for block in part]


def _fault_candidates(blocks: list[Block], size: int) -> Iterator[Suspect]:
    """Yield what one event changes: a beacon, or what hears them all."""
    gains = [block for block in blocks if _of(block) == GAIN]
    if len(gains) > 1:
        common = np.zeros((size, 1))
        for block in gains:
            common[block.columns] = 1.0
        yield Suspect("the strength of all fields", tuple(gains), common)
    for block in blocks:
        name = _display_name(block)
        yield Suspect(name, (block,), np.eye(size)[:, np.arange(size)[block.columns]])


def _of(block: Block) -> Parameter:
    assert isinstance(block.parameter, StepChange | SinceBias)
    return block.parameter.of


def _display_name(block: Block) -> str:
    kind = _of(block)
    if kind == GAIN:
        return f"the strength of beacon {block.owner}"
    words = {
        STAMPS: "the stamps of the magnetometer",
        TIME_OFFSET: "the stamps of the inertial sensor",
        ACCEL_BIAS: "the bias of the accelerometer",
        GYRO_BIAS: "the bias of the gyroscope",
    }
    if kind in words:
        return words[kind]
    return spoken_name(block._replace(parameter=kind))


def _finding(change: Change, cause: ReleasedFault, sigma: Array) -> Finding:
    block = change.fault.blocks[0]
    kind, step = _of(block), (sigma * cause.step)[block.columns]
    size = float(np.linalg.norm(step))
    amounts = {
        GAIN: f"by {100.0 * np.expm1(step[0]):+.2g} %",
        STAMPS: f"by {1e3 * step[0]:+.2g} ms",
        SENSOR_ROTATION: f"by {size / DEGREE:.2g} deg",
        BEACON_ROTATION: f"by {size / DEGREE:.2g} deg",
        BEACON_POSITION: f"by {100.0 * size:.2g} cm",
        TIME_OFFSET: f"by {-1e3 * step[0]:+.2g} ms",
        ACCEL_BIAS: f"by {size:.2g} m/s^2",
        GYRO_BIAS: f"by {size / DEGREE:.2g} deg/s",
    }
    if kind == GAIN and len(change.fault.blocks) > 1:
        remedy = "the range or the temperature of the magnetometer, and the supply of the beacons"
    elif kind == GAIN:
        remedy = "its supply and its driver"
    elif kind in (STAMPS, TIME_OFFSET):
        remedy = "what makes the stamps, and samples that were lost there"
    elif isinstance(kind, Bias):
        remedy = "how warm it became, and whether it was struck"
    elif kind == SENSOR_ROTATION:
        remedy = "how it is fastened"
    else:
        remedy = "whether it was moved"
    mean = float(np.mean(cause.distance))
    return Finding(
        "changed",
        f"Something changed while the log ran: {change.fault.name} {amounts[kind]}, from about"
        f" {change.begin:.0f} s on ({float(sigmas(cause.log_p)):.0f} sigma), which moves the poses"
        f" by {np.sqrt(mean):.1f} times what they claim. Check {remedy}; smooth the parts before"
        " and after apart, by --start and --end.",
        Verdict.FAILED if mean > MAX_LINEAR_CHI_SQUARE else Verdict.DOUBTFUL,
        float(sigmas(cause.log_p)),
    )
