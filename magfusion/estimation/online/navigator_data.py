"""Conversion of a running navigator to plain data and back: the contents of a checkpoint.

The state of a part is its class's annotations; the rest is rebuilt from the site and the settings.
Calibrations are stored as differences from the declared one, GTSAM's preintegrated measurements as
their inertial steps.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.calibration_data import calibration_rules, require
from magfusion.estimation.data_checks.stream_buffer import Buffer
from magfusion.estimation.graph.inertial import ROWS, Link, Steps
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.measurements.aiding_samples import MEASUREMENTS as OF_AIDING
from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.factor_of_state import StateFactor
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors, Predictions
from magfusion.estimation.measurements.pose_fix import PoseFix
from magfusion.estimation.measurements.zero_velocity import ZeroVelocity
from magfusion.estimation.online.fixed_lag import Node, SlidingWindow
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.inertial_stream import InertialStream
from magfusion.estimation.online.window_prior import WindowPrior
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.judgement import JudgedState, Judgement
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.estimation.online_integrity.running import DecayingSums
from magfusion.estimation.online_integrity.score_epochs import Sums
from magfusion.estimation.online_integrity.settlement import Rest
from magfusion.files.plain_data import Rules, from_plain, to_plain
from magfusion.files.plausible import beyond_range
from magfusion.model.parameters import Block, Calibration, dimension, initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.marked_bursts import OVERLAP, Bursts
from magfusion.units import Array

MEASUREMENTS: tuple[type[Measurement], ...] = (
    FieldPhasors,
    JointPhasors,
    EarthField,
    ZeroVelocity,
    PoseFix,
    *OF_AIDING.values(),
)
MAX_OFFSET = 1e5  # s, of the IMU's stamps
MIN_INTERVAL = 1e-5  # s, of inertial samples
ROUNDING = 1e-6  # of a rotation, and of a correlation's least eigenvalue


def _made_again(data: Any) -> Predictions:
    require(data is None, "contains predictions, which are not stored")
    return Predictions()


# What is only cached for sharing is rebuilt.
_WITHOUT_PREDICTIONS = Rules({Predictions: lambda _: None}, {Predictions: _made_again})


def navigator_rules(
    site: Site, blocks: tuple[Block, ...], measurements: tuple[type[Measurement], ...] = ()
) -> Rules:
    """Return how the parts of a navigator become plain data, and their validity checks.

    `blocks`: calibration parameters in the states' tangent. `measurements`: kinds of measurements
    from outside the package.
    """
    declared = initial_calibration(site, 0.0)
    kinds = {kind.__name__: kind for kind in (*MEASUREMENTS, *measurements)}
    size = MOTION + dimension(blocks)
    of_calibration = replace(calibration_rules(declared, blocks), checks={Steps: _check_steps})
    return Rules(
        writers={
            **of_calibration.writers,
            UserFactors: _refuse_factors,
            Link: lambda link: _link_data(link, of_calibration),
            Measurement: _measurement_data,
            Verdict: str,
            Finding: _finding_data,
            Levels: lambda levels: list(levels.values),
        },
        readers={
            **of_calibration.readers,
            Link: lambda data: _link(data, site, size - MOTION, of_calibration),
            Measurement: lambda data: _measurement(data, kinds),
            Verdict: Verdict,
            Finding: _finding,
            Levels: _levels,
        },
        checks={
            State: lambda state: _check_state(state, size),
            JudgedState: lambda state: _check_state(state, size),
            Judgement: _check_judgement,
            DecayingSums: _check_running,
            Sums: _check_sums,
            Rest: lambda rest: rest.check(site),
            SubsetBank: lambda bank: bank.check(size),
            Node: lambda node: _check_node(node, blocks),
            WindowPrior: lambda prior: _check_prior(prior, size),
            Buffer: _check_buffer,
            InertialStream: _check_inertial,
            Arrivals: lambda a: require(a.last_epoch < np.inf, "has an invalid last epoch"),
            Bursts: _check_bursts,
            FieldSamples: lambda f: require(f.channels == site.channels, "has other channels"),
            SlidingWindow: lambda window: _check_window(window),
        },
    )


@dataclass(frozen=True)
class _FindingData:
    """A finding, its remedy as JSON: any key of a site's file may be a part of it."""

    code: str
    text: str
    verdict: Verdict
    weight: float
    remedy: str
    explained: tuple[str, ...]


_OF_FINDING = Rules({Verdict: str}, {Verdict: Verdict})


def _finding_data(finding: Finding) -> Any:
    own = vars(finding) | {"remedy": json.dumps(finding.remedy)}
    return to_plain(_FindingData(**own), _OF_FINDING)


def _finding(data: Any) -> Finding:
    own = from_plain(_FindingData, data, "finding", _OF_FINDING)
    remedy = json.loads(own.remedy)
    require(remedy is None or isinstance(remedy, dict), "has a remedy that is none")
    return Finding(**(vars(own) | {"remedy": remedy}))


def _levels(data: Any) -> Levels:
    right = isinstance(data, list) and len(data) == 2
    require(right and all(x is None or type(x) is float for x in data), "is not a pair of levels")
    return Levels((data[0], data[1]))


def _check_bursts(bursts: Bursts) -> None:
    marks = bursts.marks
    lengths = {
        len(marks.begin),
        len(marks.end),
        len(marks.slot),
        len(bursts.epochs(bursts.numbers)),
    }
    require(len(lengths) == 1, "has columns of different length")
    edges = np.stack([marks.begin, marks.end], axis=1).ravel()
    require(np.all(np.diff(edges) > -OVERLAP), "has bursts that overlap")


def _check_state(state: State, size: int) -> None:
    shapes = {"world_from_body": (3, 3), "cov": (size, size)}
    for name, value in vars(state).items():
        if isinstance(value, np.ndarray):
            require(value.shape == shapes.get(name, (3,)), f"has a {name} of another shape")
            require(np.all(np.isfinite(value)), f"has a {name} that is not finite")
    require(np.isfinite(state.time), "has a time that is not finite")
    bias = np.concatenate([state.gyro_bias_body, state.accel_bias_body])
    require(not beyond_range(bias[None])[0], "has a bias that no instrument has")
    rotated = state.world_from_body @ state.world_from_body.T
    require(np.max(np.abs(rotated - np.eye(3))) < ROUNDING, "has an invalid rotation")
    _check_cov(state.cov)


def _check_judgement(judgement: Judgement) -> None:
    levels = (judgement.protection_level_m, judgement.protection_level_deg)
    known = [level for level in levels if level is not None]
    values = (judgement.inflation, judgement.turn, judgement.shift, *known)
    require(np.all(np.isfinite(values)) and judgement.inflation >= 1.0, "is not a valid judgement")


def _check_running(running: DecayingSums) -> None:
    sums = (*running.total, running.weight, running.squares)
    require(running.total.ndim == 1 and np.all(np.isfinite(sums)), "is not finite")


def _check_sums(sums: Sums) -> None:
    size, states = len(sums.gradient), sums.response.shape[:1]
    shapes = (sums.information.shape, sums.gradient.shape, sums.response.shape)
    require(shapes == ((size, size), (size,), (*states, size)), "has sums of another shape")
    parts = (sums.information, sums.gradient, sums.response, sums.onsets, sums.time)
    require(all(np.all(np.isfinite(part)) for part in parts), "has sums that are not finite")


def _check_cov(cov: Array) -> None:
    sigma = np.sqrt(np.maximum(np.diagonal(cov), np.finfo(float).tiny))
    correlation = cov / sigma / sigma[:, None]
    require(np.all(np.isfinite(correlation)), "has a covariance that is not finite")
    require(np.max(np.abs(correlation - correlation.T)) < ROUNDING, "has an asymmetric covariance")
    least = np.linalg.eigvalsh(correlation)[0]
    require(least > -ROUNDING, "has a covariance that is not positive definite")


def _check_node(node: Node, blocks: tuple[Block, ...]) -> None:
    state = states_of([node.state])
    for measurement in node.measurements:
        rows = measurement.linearize(state, node.state.calibration, blocks)
        require(len(measurement.epoch) == 1, "contains a measurement of several epochs")
        require(np.all(np.isfinite(rows.error)), "contains a measurement that is not finite")


def _check_prior(prior: WindowPrior, size: int) -> None:
    matrix, right = prior.sqrt_information, prior.right
    require(matrix.ndim == 2 and matrix.shape[1] == size, "has a matrix of another shape")
    require(right.shape == matrix.shape[:1], "has a right-hand side of another shape")
    require(np.all(np.isfinite(matrix)) and np.all(np.isfinite(right)), "is not finite")


def _check_buffer(buffer: Buffer) -> None:
    time, rows = buffer.rows()
    require(time.ndim == 1 and rows.shape == (len(time), buffer.width), "has another shape")
    require(np.all(np.isfinite(time)) and np.all(np.isfinite(rows)), "is not finite")
    require(np.all(np.diff(time) > 0.0), "is not sorted by time")


def _check_inertial(stream: InertialStream) -> None:
    require(abs(stream.offset) < MAX_OFFSET, "has an invalid offset")
    usual = stream.usual
    require(usual is None or MIN_INTERVAL <= usual < np.inf, "has an invalid interval")


def _check_window(window: SlidingWindow) -> None:
    require(np.all(np.diff([n.state.time for n in window.nodes]) > 0.0), "is not sorted by time")
    require(all(node.link for node in window.nodes[1:]), "has nodes that are not linked")


def _refuse_factors(_: UserFactors) -> NoReturn:
    raise InputError(
        "a checkpoint cannot store a GTSAM factor of yours; write it when the factor is older"
        " than the lag"
    )


def _measurement_data(measurement: Measurement) -> dict[str, Any]:
    if isinstance(measurement, StateFactor):
        _refuse_factors(measurement.factors)
    return {
        "kind": type(measurement).__name__,
        **{k: to_plain(v, _WITHOUT_PREDICTIONS) for k, v in vars(measurement).items()},
    }


def _measurement(data: Any, kinds: Mapping[str, type[Measurement]]) -> Measurement:
    require(isinstance(data, dict) and str(data.get("kind")) in kinds, "is of an unknown kind")
    own = {name: value for name, value in data.items() if name != "kind"}
    return from_plain(kinds[str(data["kind"])], own, str(data["kind"]), _WITHOUT_PREDICTIONS)


@dataclass(frozen=True, eq=False)
class _LinkData:
    by_calibration: Array | None
    calibration: Calibration
    steps: Steps


def _link_data(link: Link, rules: Rules) -> Any:
    assert link.steps is not None
    return to_plain(_LinkData(link.by_calibration, link.calibration, link.steps), rules)


def _link(data: Any, site: Site, columns: int, rules: Rules) -> Link:
    result = from_plain(_LinkData, data, "link", rules)
    if (by := result.by_calibration) is not None:
        require(by.shape == (ROWS, columns) and np.all(np.isfinite(by)), "has a wrong derivative")
    measurement = result.steps.preintegrated(site)
    return Link(measurement, result.by_calibration, result.calibration, result.steps)


def _check_steps(steps: Steps) -> None:
    own, biases = steps.increments, (steps.accel_bias_body, steps.gyro_bias_body)
    count = len(own.dt)
    shapes = (own.gyro_body.shape, own.accel_body.shape, own.dt.shape)
    require(shapes == ((count, 3), (count, 3), (count,)), "has steps of another shape")
    require(biases[0].shape == biases[1].shape == (3,), "has biases of another shape")
    require(
        own.first.tolist() == [0, count] and len(own.gap_bridged) == 1, "is not of one interval"
    )
    values = np.concatenate([v.ravel() for v in (*vars(own).values(), *biases)])
    require(np.all(np.isfinite(values)) and np.all(own.dt > 0.0), "has steps that are not finite")
