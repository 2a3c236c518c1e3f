"""The whole offline estimate of one log: start, passes over the waveform, posterior."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import EstimationError
from magfusion.fixes.fix import Fixes
from magfusion.fusion.factors import FieldFactors, FieldMeasurements, read_poses
from magfusion.fusion.inertial import cut_at_epochs, preintegrate
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
from magfusion.fusion.source import Source, first_fixes, open_source
from magfusion.fusion.start import Start, choose_chain, start_phases
from magfusion.fusion.wave import WaveFields
from magfusion.parameters import Block, Calibration, choose_blocks, held_blocks, initial_calibration
from magfusion.receiver.windows import LockinSettings
from magfusion.records.samples import FieldSamples, ImuSamples, Log
from magfusion.site import Site
from magfusion.strapdown import resting
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.weights import measurement_cov, paired_whitening, stacked

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
    """

    coupling: str = "tight"
    loss: str | None = None
    estimate: tuple[str, ...] | None = None
    passes: int = 8
    lockin: LockinSettings | None = None


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
    dropped : mapping
        Reason to number of windows.
    bridged : int
        Intervals with a gap in the inertial stream.
    cost : float
    passes, iterations : int
    converged : bool
    """

    states: Trajectory
    fields: FieldSamples
    declared: Calibration
    calibration: Calibration
    blocks: tuple[Block, ...]
    calibration_cov: Array
    residual: Array
    start: Start
    dropped: Mapping[str, int]
    bridged: int
    cost: float
    passes: int
    iterations: int
    converged: bool


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
    total = settings.passes + 3
    source = open_source(log, site, settings.lockin)
    report("demodulating", 0, total)
    samples = source.first(initial_calibration(site, 0.0))
    if len(samples) < 2:
        raise EstimationError(
            f"log {log.name} has {len(samples)} field epoch; at least 2 are needed"
        )
    calibration = initial_calibration(site, float(np.mean(samples.time)))
    report("finding a start", 1, total)
    fixes = first_fixes(samples, log, calibration)
    start = choose_chain(fixes, log.imu, calibration.time_offset, site.gravity)
    calibration = start_phases(calibration, samples.time, start.phase)
    # Unsynchronised drives have no declared phase: the prior is centred on the start.
    declared = replace(
        initial_calibration(site, calibration.reference_time), phase=calibration.phase
    )
    states = _with_rest_bias(start.states, log.imu, calibration.time_offset)
    if settings.coupling == "loose":
        return _loose(log, samples, fixes, start, states, declared, source, settings, report)
    return _tight(log, samples, start, states, declared, calibration, source, settings, report)


def _with_rest_bias(states: Trajectory, imu: ImuSamples, time_offset: float) -> Trajectory:
    """Gyro bias from the first rest, where there is one."""
    still = resting(imu.time + time_offset, imu.gyro_body, imu.accel_body)
    bias = np.mean(imu.gyro_body[still], axis=0) if np.any(still) else np.zeros(3)
    shape = (len(states), 3)
    return replace(
        states, gyro_bias_body=np.broadcast_to(bias, shape).copy(), accel_bias_body=np.zeros(shape)
    )


def _tight(
    log: Log,
    samples: FieldSamples,
    start: Start,
    states: Trajectory,
    declared: Calibration,
    calibration: Calibration,
    source: Source,
    settings: SmootherSettings,
    report: Report,
) -> Smoothed:
    site = declared.site
    blocks = choose_blocks(site, settings.estimate)
    total, iterations, done = settings.passes + 3, 0, 0
    passes = 1 if log.waveform is None else settings.passes
    settled = False
    while True:
        report(f"pass {done + 1}", done + 2, total)
        wave = source.about(calibration, states) if done > 0 else None
        samples = samples if wave is None else wave.fields
        problem, bridged = _problem(
            log, samples, states, calibration, declared, blocks, wave, settings
        )
        found = optimise(problem, initial_estimate(states, calibration))
        previous, offset = states, calibration.time_offset
        states = read_states(found.estimate.values, samples.time)
        calibration = found.estimate.calibration
        iterations, done = iterations + found.iterations, done + 1
        moved = np.sqrt(np.mean((states.position_world - previous.position_world) ** 2))
        shifted = abs(calibration.time_offset - offset)
        settled = bool(moved < POSITION_CONVERGED and shifted < OFFSET_CONVERGED)
        if done >= passes or settled:
            break
    report("posterior", total - 1, total)
    result = _posterior(problem, found, states, samples)
    report("done", total, total)
    return replace(
        result,
        declared=declared,
        start=start,
        dropped=source.dropped,
        bridged=bridged,
        passes=done,
        iterations=iterations,
        converged=found.converged and (settled or passes == 1),
    )


def _problem(
    log: Log,
    samples: FieldSamples,
    states: Trajectory,
    calibration: Calibration,
    declared: Calibration,
    blocks: tuple[Block, ...],
    wave: WaveFields | None,
    settings: SmootherSettings,
) -> tuple[Problem, int]:
    site, model = declared.site, declared.site.platform.imu
    assert states.accel_bias_body is not None
    assert states.gyro_bias_body is not None
    increments = cut_at_epochs(log.imu, calibration.time_offset, samples.time)
    preintegrated = preintegrate(
        increments, model, site.gravity, states.accel_bias_body, states.gyro_bias_body
    )
    stamps = log.imu.time + calibration.time_offset
    rate = np.stack([np.interp(samples.time, stamps, w) for w in log.imu.gyro_body.T], axis=1)
    shape = (*samples.phasor_sensor.shape[:2], 6)
    cov = measurement_cov(calibration.site, samples) * overlap(samples)
    measurements = FieldMeasurements(
        time=samples.time,
        measured=stacked(samples.phasor_sensor),
        root=paired_whitening(cov, samples.valid),
        rate_body=rate - states.gyro_bias_body,
        applied_offset=calibration.time_offset,
        by_time_offset=np.zeros(shape) if wave is None else stacked(wave.by_time_offset),
    )
    problem = Problem(
        native=inertial_graph(preintegrated, model),
        fields=FieldFactors(measurements, blocks, settings.loss),
        declared=declared,
        epochs=len(samples),
    )
    return problem, int(np.sum(increments.bridged))


def overlap(samples: FieldSamples) -> float:
    """Return how many windows hold each sample: their information must not be counted twice."""
    step = float(np.median(np.diff(samples.time)))
    return max(1.0, float(np.median(samples.window)) / step)


def _posterior(
    problem: Problem, found: Optimised, states: Trajectory, samples: FieldSamples
) -> Smoothed:
    held = held_blocks(problem.declared.site, problem.blocks)
    pose_cov, calibration_cov = marginals(problem, found.estimate, held)
    residual = np.full((*samples.phasor_sensor.shape[:2], 6), np.nan)
    if problem.fields is not None:
        poses = read_poses(found.estimate.values)
        error, _, _ = problem.fields.residual(poses, found.estimate.calibration)
        residual = np.where(samples.valid[..., None], error, np.nan)
    return Smoothed(
        states=replace(states, pose_cov=pose_cov),
        fields=samples,
        declared=problem.declared,
        calibration=found.estimate.calibration,
        blocks=problem.blocks,
        calibration_cov=calibration_cov,
        residual=residual,
        start=Start(states, np.zeros(0), np.zeros(0, dtype=np.int64), np.inf),
        dropped={},
        bridged=0,
        cost=found.cost,
        passes=1,
        iterations=found.iterations,
        converged=found.converged,
    )


def _loose(
    log: Log,
    samples: FieldSamples,
    fixes: Fixes,
    start: Start,
    states: Trajectory,
    declared: Calibration,
    source: Source,
    settings: SmootherSettings,
    report: Report,
) -> Smoothed:
    site, total = declared.site, settings.passes + 3
    report("fusing fixes", 2, total)
    assert states.accel_bias_body is not None
    assert states.gyro_bias_body is not None
    increments = cut_at_epochs(log.imu, declared.time_offset, samples.time)
    preintegrated = preintegrate(
        increments,
        site.platform.imu,
        site.gravity,
        states.accel_bias_body,
        states.gyro_bias_body,
    )
    native = inertial_graph(preintegrated, site.platform.imu)
    rows = np.arange(len(fixes))
    cov = fixes.pose_cov[rows, start.chosen] * overlap(samples)
    add_pose_fixes(native, replace(start.states, pose_cov=cov), settings.loss)
    problem = Problem(native, None, declared, len(samples))
    found = optimise(problem, initial_estimate(states, declared))
    report("posterior", total - 1, total)
    result = _posterior(problem, found, read_states(found.estimate.values, samples.time), samples)
    report("done", total, total)
    return replace(
        result,
        start=start,
        dropped=source.dropped,
        bridged=int(np.sum(increments.bridged)),
    )
