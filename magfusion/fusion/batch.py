"""The whole offline estimate of one log: start, passes over the waveform, posterior."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.fixes.fix import Fixes
from magfusion.fusion.beginning import begin, with_rest_bias
from magfusion.fusion.earth import EARTH_LOSS, check_earth, earth_cov, hold, with_earth
from magfusion.fusion.factors import FieldFactors, FieldMeasurements, read_poses
from magfusion.fusion.hearing import heard, only
from magfusion.fusion.inertial import low_passed_rate_at
from magfusion.fusion.loose import survey_cov
from magfusion.fusion.smoother import (
    Optimised,
    Problem,
    add_pose_fixes,
    inertial_graph,
    initial_estimate,
    marginals,
    optimise,
    read_states,
)
from magfusion.fusion.source import Source, open_source
from magfusion.fusion.start import Start
from magfusion.fusion.thinning import preintegrate_stream
from magfusion.fusion.wave import WaveFields
from magfusion.parameters import (
    Block,
    Calibration,
    choose_blocks,
    held_blocks,
    initial_calibration,
)
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.records.samples import FieldSamples, Log, SteadyFields
from magfusion.site import Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.weights import (
    measurement_cov,
    paired_whitening,
    sensor_positions,
    stacked,
)

OFFSET_CONVERGED = 2e-5  # s; change of the time offset at which the passes end
POSITION_CONVERGED = 5e-5  # m; rms change of the positions at which the passes end

Report = Callable[[str, int, int], None]


def _silent(_stage: str, _done: int, _total: int) -> None:
    pass


@dataclass(frozen=True)
class SmootherSettings:
    """How a log is smoothed.

    Parameters
    ----------
    coupling : {'tight', 'loose'}
        Whether the phasors or the fixes made of them enter the graph.
    loss : {None, 'huber', 'cauchy'}
        Robust loss of the field measurements.
    estimate : tuple of str, optional
        Calibration groups; None takes those whose sigma in the site is not negligible.
    passes : int
        At most so many predictions of the waveform.
    lockin : LockinSettings, optional
        None chooses window and step from the tones' spacing.
    earth : bool
        Measure the Earth field too; where no beacon is heard, it and gravity alone hold the
        attitude.  With tight coupling only.
    """

    coupling: str = "tight"
    loss: str | None = None
    estimate: tuple[str, ...] | None = None
    passes: int = 8
    lockin: LockinSettings | None = None
    earth: bool = False

    def __post_init__(self) -> None:
        if self.earth and self.coupling == "loose":
            raise ValueError("the Earth field is measured with tight coupling only")
        if self.passes < 1:
            raise ValueError(f"passes must be at least 1; got {self.passes}")


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The posterior of one log.

    Parameters
    ----------
    states : Trajectory
        With velocity, biases and pose covariance, on the log's clock.
    fields : FieldSamples
        The phasors of the last pass.
    declared, calibration : Calibration
        Before and after.
    blocks : tuple of Block
        What was estimated.
    calibration_cov : ndarray, shape (dimension, dimension)
    residual : ndarray, shape (n, channels, 6)
        Whitened; NaN where a channel is missing, or with loose coupling.
    start : Start
    problem : Problem
        The graph as it was last optimised.
    values : gtsam.Values
        States in it.
    rival_chi_square : float, optional
        How much worse the best trajectory from another chain of hypotheses is, after its first
        pass: a small figure means that the log leaves a mirrored trajectory possible.  None where
        there was no other chain.
    dropped : mapping
        Reason to number of windows.
    bridged : int
        Intervals with a gap in the inertial stream.
    cost : float
    passes, iterations : int
    converged : bool
    earth_residual : ndarray, shape (n, 3), optional
        Whitened; None where the Earth field was not measured.
    """

    states: Trajectory
    fields: FieldSamples
    declared: Calibration
    calibration: Calibration
    blocks: tuple[Block, ...]
    calibration_cov: Array
    residual: Array
    start: Start
    problem: Problem
    values: gtsam.Values
    rival_chi_square: float | None
    dropped: Mapping[str, int]
    bridged: int
    cost: float
    passes: int
    iterations: int
    converged: bool
    earth_residual: Array | None = None


def smooth(
    log: Log, site: Site, settings: SmootherSettings | None = None, report: Report = _silent
) -> Smoothed:
    """Estimate the best trajectory of a log, with the calibration in the same solution.

    Parameters
    ----------
    log : Log
        With a waveform, or with phasors in the site's channel order.
    site : Site
    settings : SmootherSettings, optional
    report : callable, optional
        Told stage, steps done and steps in all.

    Returns
    -------
    Smoothed

    Raises
    ------
    InputError
        Where the log holds nothing usable.
    EstimationError
        Where the graph cannot be solved.
    """
    settings = SmootherSettings() if settings is None else settings
    for beacon in site.beacons:
        if beacon.unknown is not None:
            raise InputError(
                f"the {beacon.unknown} of beacon {beacon.name} is unknown; place it by"
                " magfusion.fusion.self_survey.smooth_and_place"
            )
    if settings.earth:
        check_earth(site)
    job = _prepared(log, site, settings, report)
    return _loose(job) if settings.coupling == "loose" else _tight(job)


@dataclass(frozen=True, eq=False)
class _Job:
    """A log with a start found."""

    log: Log
    settings: SmootherSettings
    source: Source
    samples: FieldSamples
    steady: SteadyFields | None
    fixes: Fixes | None
    start: Start
    states: Trajectory
    declared: Calibration
    report: Report
    rival_chi_square: float | None = None

    def told(self, stage: str, done: int) -> None:
        self.report(stage, done, self.settings.passes + 3)


def _prepared(log: Log, site: Site, settings: SmootherSettings, report: Report) -> _Job:
    report("demodulating", 0, settings.passes + 3)
    source = open_source(log, site, settings.lockin)
    samples = source.first(initial_calibration(site, 0.0))
    if settings.coupling == "loose" and has_schedule(site):
        samples = whole_cycles(samples, log.imu, site)
    if len(samples) < 2:
        raise EstimationError(
            f"log {log.name} has {len(samples)} field epoch; at least 2 are needed"
        )
    report("finding a start", 1, settings.passes + 3)
    calibration = initial_calibration(site, float(np.mean(samples.time)))
    steady = source.steady(calibration) if settings.earth else None
    if settings.earth:
        samples = only(samples, heard(samples))
    jobs = [
        _Job(
            log=log,
            settings=settings,
            source=source,
            samples=samples,
            steady=steady,
            fixes=beginning.fixes,
            start=beginning.start,
            states=with_rest_bias(beginning.start.states, log.imu, calibration.time_offset),
            declared=beginning.declared,
            report=report,
        )
        for beginning in begin(samples, steady, log, calibration)
    ]
    return jobs[0] if len(jobs) == 1 else _likeliest(jobs)


def _likeliest(jobs: list[_Job]) -> _Job:
    """Let the motion decide between chains that single epochs cannot tell apart."""
    costs = []
    for job in jobs:
        problem, _ = _problem(job, job.samples, job.states, job.declared, None)
        costs.append(optimise(problem, initial_estimate(job.states, job.declared)).cost)
    order = np.argsort(costs)
    margin = 2.0 * (costs[int(order[1])] - costs[int(order[0])])
    likeliest: _Job = jobs[int(order[0])]
    return replace(likeliest, rival_chi_square=float(margin))


def _tight(job: _Job) -> Smoothed:
    states, calibration, wave = job.states, job.declared, None
    iterations, done, settled = 0, 0, False
    while done < job.settings.passes and not settled:
        job.told(f"pass {done + 1}", done + 2)
        if done > 0 and job.log.waveform is not None:
            wave = job.source.about(calibration, states)
        samples = job.samples if wave is None else wave.fields
        if job.steady is not None:
            samples = only(samples, job.samples.valid)
        problem, bridged = _problem(job, samples, states, calibration, wave)
        found = optimise(problem, initial_estimate(states, calibration))
        moved = read_states(found.estimate.values, samples.time)
        settled = done > 0 and _settled(states, moved, calibration, found.estimate.calibration)
        states, calibration = moved, found.estimate.calibration
        iterations, done = iterations + found.iterations, done + 1
    job.told("posterior", job.settings.passes + 2)
    result = _posterior(job, problem, found, samples, bridged)
    return replace(
        result, passes=done, iterations=iterations, converged=found.converged and settled
    )


def _settled(before: Trajectory, after: Trajectory, old: Calibration, new: Calibration) -> bool:
    moved = np.sqrt(np.mean((after.position_world - before.position_world) ** 2))
    shifted = abs(new.time_offset - old.time_offset)
    return bool(moved < POSITION_CONVERGED and shifted < OFFSET_CONVERGED)


def _inertial(
    job: _Job, time: Array, states: Trajectory, time_offset: float
) -> tuple[gtsam.NonlinearFactorGraph, int]:
    """Inertial graph between the epochs, and the number of intervals bridged."""
    site = job.declared.site
    assert states.accel_bias_body is not None
    assert states.gyro_bias_body is not None
    preintegrated, bridged = preintegrate_stream(
        job.log.imu,
        time_offset,
        time,
        site.platform.imu,
        site.gravity,
        states.accel_bias_body,
        states.gyro_bias_body,
    )
    graph = inertial_graph(preintegrated, site.platform.imu)
    return graph, int(np.sum(bridged))


def _problem(
    job: _Job,
    samples: FieldSamples,
    states: Trajectory,
    calibration: Calibration,
    wave: WaveFields | None,
) -> tuple[Problem, int]:
    graph, bridged = _inertial(job, samples.time, states, calibration.time_offset)
    rate = low_passed_rate_at(job.log.imu, calibration.time_offset, samples.time)
    assert states.gyro_bias_body is not None
    shape = (*samples.phasor_sensor.shape[:2], 6)
    sensor_world = sensor_positions(calibration.site, states)
    cov = measurement_cov(calibration.site, samples, sensor_world=sensor_world) * overlap(samples)
    measurements = FieldMeasurements(
        time=samples.time,
        measured=stacked(samples.phasor_sensor),
        root=paired_whitening(cov, samples.valid),
        rate_body=rate - states.gyro_bias_body,
        applied_offset=calibration.time_offset,
        by_time_offset=np.zeros(shape) if wave is None else stacked(wave.by_time_offset),
    )
    if job.steady is not None:
        steady, step = job.steady if wave is None else wave.steady, _step(samples)
        cov = earth_cov(calibration.site, steady)
        measurements = with_earth(measurements, steady, cov, step)
        hold(graph, states, np.asarray(samples.valid.any(axis=1)), step)
    blocks = choose_blocks(job.declared.site, job.settings.estimate, earth=job.settings.earth)
    fields = FieldFactors(measurements, blocks, job.settings.loss, EARTH_LOSS)
    return Problem(graph, fields, job.declared, len(samples)), bridged


def overlap(samples: FieldSamples) -> float:
    """Return how many windows hold each sample: their information must not be counted twice."""
    return max(1.0, float(np.median(samples.window)) / _step(samples))


def _step(samples: FieldSamples) -> float:
    return float(np.median(np.diff(samples.time)))


def _posterior(
    job: _Job, problem: Problem, found: Optimised, samples: FieldSamples, bridged: int
) -> Smoothed:
    earth = job.settings.earth
    held = held_blocks(problem.declared.site, problem.blocks, earth=earth)
    pose_cov, calibration_cov = marginals(problem, found.estimate, held)
    earth_residual = None
    residual = np.full((*samples.phasor_sensor.shape[:2], 6), np.nan)
    if problem.fields is not None:
        poses = read_poses(found.estimate.values)
        error, _, _ = problem.fields.residual(poses, found.estimate.calibration)
        earth_residual = error[:, -1, :3] if earth else None
        error = error[:, : len(samples.channels)]
        residual = np.where(samples.valid[..., None], error, np.nan)
    job.told("done", job.settings.passes + 3)
    return Smoothed(
        states=replace(read_states(found.estimate.values, samples.time), pose_cov=pose_cov),
        fields=samples,
        declared=problem.declared,
        calibration=found.estimate.calibration,
        blocks=problem.blocks,
        calibration_cov=calibration_cov,
        residual=residual,
        start=job.start,
        problem=problem,
        values=found.estimate.values,
        rival_chi_square=job.rival_chi_square,
        dropped=job.source.dropped,
        bridged=bridged,
        cost=found.cost,
        passes=1,
        iterations=found.iterations,
        converged=found.converged,
        earth_residual=earth_residual,
    )


def _loose(job: _Job) -> Smoothed:
    job.told("fusing fixes", 2)
    offset = job.declared.time_offset
    assert job.fixes is not None
    graph, bridged = _inertial(job, job.samples.time, job.states, offset)
    rows = np.arange(len(job.fixes))
    cov = job.fixes.pose_cov[rows, job.start.chosen] * overlap(job.samples)
    add_pose_fixes(graph, replace(job.start.states, pose_cov=cov), job.settings.loss)
    problem = Problem(graph, None, job.declared, len(job.samples))
    found = optimise(problem, initial_estimate(job.states, job.declared))
    job.told("posterior", job.settings.passes + 2)
    result = _posterior(job, problem, found, job.samples, bridged)
    states = result.states
    assert states.pose_cov is not None
    shared = survey_cov(job.declared, job.samples, states)
    return replace(result, states=replace(states, pose_cov=states.pose_cov + shared))
