"""Change detection: a gain, clock, bias, mounting or beacon that changes during the log.

An estimator assumes all of them constant.  A step of each at a quarter, at half and at three
quarters of the log is tested as `magfusion.estimation.integrity.fixed_parameter_test` tests fixed
parameters: by the decrease of the cost and the change of the poses, for any constant errors in
addition.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.statistics import holm, sigmas
from magfusion.estimation.integrity.fault_candidates import (
    FaultCandidate,
    display_name,
    fault_candidates,
)
from magfusion.estimation.integrity.fixed_parameter_test import (
    MAX_LINEAR_CHI_SQUARE,
    MIN_EVIDENCE,
)
from magfusion.estimation.integrity.released_fault import (
    COVERED,
    ReleasedFault,
    release_fault,
    release_gain,
)
from magfusion.estimation.integrity.score import Score, answered, scores_of
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
from magfusion.model.parameters.inertial import ACCEL_BIAS, GYRO_BIAS, Bias, Inertial, Stream
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.model.without_imu import logged
from magfusion.units import DEGREE, Array, ComplexArray

CHANGED = "changed"  # code
PARTS = (0.25, 0.5, 0.75)  # of the log, times of the tested steps
MAX_BEACONS = 12  # with more, the test is not made
MIN_EPOCHS = 40  # epochs, for parts with enough information
MIN_PART = 10.0  # s
BUDGET = 1e-5  # of false alarms, besides half a per cent of all other tests together


class StepChange(Parameter):
    """Step of a parameter at some time (s)."""

    group = kind = "change"

    def __init__(self, of: Parameter, begin: float) -> None:
        self.of, self.begin = of, begin

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StepChange) and (self.of, self.begin) == (other.of, other.begin)

    def __hash__(self) -> int:
        return hash((self.of, self.begin))

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return the columns of the parameter itself, zero before the step."""
        columns = self.of.phasor_jacobian(view, owner)
        if columns is None:
            return None
        time = view.calibration.reference_time + view.elapsed
        return columns * (time >= self.begin)[:, None, None, None]


class Stamps(Parameter):
    """Delay of the magnetometer's stamps (s), as visible in its phases."""

    group, owner, kind = "change", "stamps", "delay"
    factor_of_phasor = True

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray:  # noqa: ARG002
        """Return the derivative of the phases of every beacon by a delay."""
        turns = 2.0 * np.pi * view.beacon.tone_frequencies_hz
        return (-1j * view.phasor * turns[:, None])[..., None]


class SinceBias(Inertial):
    """Step of a bias at some time (s)."""

    kind = "change"

    def __init__(self, of: Bias, begin: float) -> None:
        self.of, self.begin = of, begin

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SinceBias) and (self.of, self.begin) == (other.of, other.begin)

    def __hash__(self) -> int:
        return hash((SinceBias, self.of, self.begin))

    def as_bias(self, stream: Stream) -> Array:
        """Return the columns of the bias itself, zero before the step."""
        return self.of.as_bias(stream) * (stream.imu.time >= self.begin)[:, None, None]


STAMPS = Stamps()
# Tested parameters: size in a unit of the tangent vector, and words.
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


def candidate_steps(result: Smoothed) -> list[Block]:
    """Return the steps of parameters that are tested for a log; none if it is too short."""
    return [block for part in _steps_by_time(result).values() for block in part]


def _steps_by_time(result: Smoothed) -> dict[float, list[Block]]:
    """Return them by time of the step (s)."""
    site, time = result.declared.site, result.fields.time
    if not 1 < len(site.beacons) <= MAX_BEACONS or len(time) < MIN_EPOCHS:
        return {}
    begin, length = float(time[0]), float(time[-1] - time[0])
    if length < MIN_PART or len(result.graph.segments) > 1:
        return {}
    return {begin + part * length: _blocks(site, begin + part * length) for part in PARTS}


def changed(case: Case) -> TestResult:
    """Test for changes during the log."""
    result, wide, parts = case.result, case.wide, _steps_by_time(case.result)
    if wide is None or not parts:
        return NOTHING
    every = wide.fixed
    information, gradient = wide.with_declared(tolerance=True)
    known = [
        (fault, estimate.log_p)
        for fault in _changes(parts, every)
        if (estimate := release_gain(fault, information, gradient)) is not None
    ]
    informative = holm([log_p for _, log_p in known], BUDGET)
    if not np.any(informative):
        return NOTHING
    wide = answered(result, wide, case.log.imu)
    released = [
        cause
        for fault, _ in known
        if (cause := release_fault(case.pose_cov, wide, fault, information, gradient)) is not None
    ]
    significant = [cause for cause, yes in zip(released, informative, strict=True) if yes]
    if not any(np.mean(cause.distance) > COVERED for cause in significant):
        return NOTHING
    cause = max(significant, key=lambda one: one.gain)
    assert case.score is not None
    own = slice(0, dimension(case.score.fixed))
    if cause.gain < _throughout(
        result.declared.site, case.score, information[own, own], gradient[own]
    ):
        return NOTHING  # it was wrong from the beginning
    moved = cause.moved[:, :, None] * cause.moved[:, None, :]
    certain = wide.by_pose @ cause.known_cov @ np.swapaxes(wide.by_pose, 1, 2)
    finding = change_finding(cause, prior_sigma(every))
    return TestResult((finding,), spread=moved + certain, causes=(cause,), gain=cause.gain)


def changed_beacon(result: Smoothed, log: Log, name: str, onset: float) -> TestResult | None:
    """Return the test of a beacon that changed at a known time (s); None if none explains it.

    `result`: with the fields of the beacon after that.
    """
    kinds = (GAIN, BEACON_POSITION, BEACON_ROTATION)
    steps = [step_of(kind, name, onset) for kind in kinds]
    imu = logged(log, result.declared.site)[0].imu
    scores, pose_cov = scores_of(result, imu, steps), result.states.pose_cov
    if scores is None or pose_cov is None:
        return None
    score = answered(result, scores.every, imu)
    information, gradient = score.with_declared(tolerance=True)
    own, size = list(score.fixed[-len(steps) :]), dimension(score.fixed)
    rows = np.concatenate([np.arange(size)[block.columns] for block in own[1:]])
    pose = FaultCandidate(changed_name(own[1:]), tuple(own[1:]), np.eye(size)[:, rows], CHANGED)
    released = (
        release_fault(pose_cov, score, fault, information, gradient)
        for fault in (*_fault_candidates(own, size), pose)
    )
    causes = [one for one in released if one is not None and one.gain > MIN_EVIDENCE]
    if not causes:
        return None
    cause = max(causes, key=lambda one: one.gain)
    finding = change_finding(cause, prior_sigma(score.fixed))
    text = f"{finding.text} Its fields are excluded from then on."
    known = replace(finding, text=text, verdict=Verdict.DOUBTFUL)
    return TestResult((known,), gain=cause.gain)


def _changes(parts: dict[float, list[Block]], every: tuple[Block, ...]) -> list[FaultCandidate]:
    """Return the possible changes at each of some times, as columns after the fixed ones."""
    return [
        fault
        for part in _again(every, list(parts.values()))
        for fault in _fault_candidates(part, dimension(every))
    ]


def explained_throughout(result: Smoothed, log: Log, rival: float) -> bool:
    """Return whether a parameter that is wrong throughout explains more than a rival's gain."""
    site = result.declared.site
    scores = scores_of(result, logged(log, site)[0].imu, [])
    if scores is None:
        return False
    evidence = scores.every.with_declared(tolerance=True)
    return _throughout(site, scores.every, *evidence) > rival


def _throughout(site: Site, score: Score, information: Array, gradient: Array) -> float:
    """Return the largest gain of a fixed parameter that is wrong throughout."""
    every = (
        release_gain(one, information, gradient) for one in fault_candidates(site, score.fixed)
    )
    return max((one.gain for one in every if one is not None), default=0.0)


def _blocks(site: Site, at: float) -> list[Block]:
    owners = [beacon.name for beacon in site.beacons]
    every: list[tuple[Parameter, str]] = [(GAIN, owner) for owner in owners]
    every += [(STAMPS, STAMPS.owner)]
    every += [(SENSOR_ROTATION, owner) for owner in SENSOR_ROTATION.owners(site)[:1]]
    every += [(BEACON_POSITION, owner) for owner in owners]
    every += [(BEACON_ROTATION, owner) for owner in owners]
    if site.platform.inertial:
        every += [(kind, "imu") for kind in (TIME_OFFSET, ACCEL_BIAS, GYRO_BIAS)]
    return [step_of(kind, owner, at) for kind, owner in every]


def step_of(kind: Parameter, owner: str, at: float) -> Block:
    """Return a step of a parameter at some time (s)."""
    step = SinceBias(kind, at) if isinstance(kind, Bias) else StepChange(kind, at)
    return Block(step, owner, slice(0), np.full(_width(kind), TYPICAL[kind]))


def _width(kind: Parameter) -> int:
    return 1 if kind in (GAIN, STAMPS, TIME_OFFSET) else 3


def _again(every: tuple[Block, ...], parts: list[list[Block]]) -> Iterator[list[Block]]:
    """Yield the blocks of each part with their columns."""
    at = {block.key: block for block in every}
    for part in parts:
        yield [at[block.key] for block in part]


def _fault_candidates(blocks: list[Block], size: int) -> Iterator[FaultCandidate]:
    """Yield the effects of single events: on a beacon, or on the reception of all."""
    gains = [block for block in blocks if _of(block) == GAIN]
    if len(gains) > 1:
        common = np.zeros((size, 1))
        for block in gains:
            common[block.columns] = 1.0
        yield FaultCandidate("the strength of all fields", tuple(gains), common, CHANGED)
    for block in blocks:
        combine = np.eye(size)[:, np.arange(size)[block.columns]]
        yield FaultCandidate(changed_name((block,)), (block,), combine, CHANGED)


def _of(block: Block) -> Parameter:
    assert isinstance(block.parameter, StepChange | SinceBias)
    return block.parameter.of


def step_time(block: Block) -> float:
    """Return the time of a step (s)."""
    assert isinstance(block.parameter, StepChange | SinceBias)
    return block.parameter.begin


def changed_name(blocks: Sequence[Block]) -> str:
    """Return what changed, in words: a parameter, or the pose of a beacon."""
    block = blocks[0]
    if len(blocks) > 1:
        return f"the pose of beacon {block.owner}"
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
    return display_name(block._replace(parameter=kind))


def change_finding(cause: ReleasedFault, sigma: Array) -> Finding:
    """Return the finding on a step, with the typical errors of all parameters."""
    block = cause.fault.blocks[0]
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
    if kind == GAIN and len(cause.fault.blocks) > 1:
        remedy = "the range or the temperature of the magnetometer, and the supply of the beacons"
    elif kind == GAIN:
        remedy = "its supply and its driver"
    elif kind in (STAMPS, TIME_OFFSET):
        remedy = "the source of the stamps, and samples lost there"
    elif isinstance(kind, Bias):
        remedy = "its temperature, and whether it had a shock, or increase its bias_walk"
    elif kind == SENSOR_ROTATION:
        remedy = "its mounting"
    else:
        remedy = "whether it was moved"
    mean = float(np.mean(cause.distance))
    return Finding(
        CHANGED,
        f"A parameter changed during the log: {cause.fault.name} {amounts[kind]}, from about"
        f" {step_time(block):.0f} s on ({float(sigmas(cause.log_p)):.0f} sigma). This moves the"
        f" poses by {np.sqrt(mean):.1f} times their reported sigma. Check {remedy}. Process the"
        " parts before and after separately (--start, --end).",
        Verdict.FAILED if mean > MAX_LINEAR_CHI_SQUARE else Verdict.DOUBTFUL,
        float(sigmas(cause.log_p)),
    )
