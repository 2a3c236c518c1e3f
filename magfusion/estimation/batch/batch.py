"""Offline estimation of one log: start, passes over the waveform, posterior."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.chain import Start
from magfusion.estimation.batch.log_graph import PreprocessedLog, noise_of
from magfusion.estimation.batch.outer_iteration import (
    advance,
    begin_iterations,
    demodulate_about,
    nothing_moved,
    plan_pass,
    relax,
    retune,
    solve_about,
)
from magfusion.estimation.batch.outer_iterations import PassFile
from magfusion.estimation.batch.preprocessed_log import preprocess
from magfusion.estimation.batch.settings import SmootherSettings as SmootherSettings
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.inertial_noise import with_measured_noise
from magfusion.estimation.demodulation.beacon_selection import select_detected
from magfusion.estimation.graph.graph import Graph, GraphEstimate, read_states
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.measurements.earth import EarthField, check_earth, disturbed
from magfusion.estimation.measurements.field_error import field_errors
from magfusion.estimation.measurements.phasors import FieldPhasors, alone
from magfusion.estimation.measurements.signs import count_open
from magfusion.estimation.measurements.zero_velocity import quiet_before
from magfusion.estimation.posterior.convergence import last_move, refuse_open
from magfusion.estimation.posterior.marginals import marginals
from magfusion.estimation.posterior.noise_tuning import Tuned, compared_with
from magfusion.estimation.snapshot.survey_error import survey_response
from magfusion.estimation.solve.bordered import Optimised, optimise
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.arguments import check_arguments
from magfusion.model.parameters import Block, Calibration, placed
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.short_repr import one_line
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust
from magfusion.model.without_imu import logged, require_motion_prior
from magfusion.units import Array, BoolArray, IntArray

QUIET = 0.3  # sigmas; a last pass that moved the poses by less counts as converged


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The posterior of one log."""

    # with velocity, biases and pose covariance, on the log's clock: at the fields, in gaps between
    # them, and at other measurements
    states: Trajectory
    epoch: IntArray  # (n,), state index of each field epoch
    fields: FieldSamples  # the phasors of the last pass
    # declared, calibration: before and after the estimation
    declared: Calibration
    calibration: Calibration
    blocks: tuple[Block, ...]  # estimated parameters
    # parameters that are not estimated, but whose uncertainty is in the covariance
    considered: tuple[Block, ...]
    calibration_cov: Array  # (dimension, dimension)
    # (n, channels, 6), whitened; NaN where a channel is missing, or with loose coupling
    residual: Array
    start: Start
    graph: Graph  # as of the last optimisation
    # solution of ``graph``: the states, and the calibration of every segment of a long log
    estimate: GraphEstimate
    # excess chi square of the best trajectory from another chain of hypotheses, after its first
    # pass: if small, the log leaves a mirrored trajectory possible. None without another chain, or
    # where all gave the same trajectory
    rival_chi_square: float | None
    dropped: Mapping[str, int]  # reason to number of windows
    gap_bridged: int  # intervals with a gap in the inertial stream
    cost: float
    iteration_count: int
    iterations: int
    # whether the last pass moved the poses by nothing, or by little in units of their sigmas
    converged: bool
    # root mean square of the pose changes in the last pass, in sigmas: that of the survey's gauge
    # is large
    last_move: float = 0.0
    rival: Trajectory | None = None  # that trajectory
    # (n, 3), whitened; None where the Earth field was not measured
    earth_residual: Array | None = None
    earth_disturbed: BoolArray | None = None  # (n,), where it is inconsistent with the motion
    # (states, 6, parameters), change of every pose by one sigma of the survey, common to all, with
    # loose coupling
    fix_response: Array | None = None
    # estimated noise and model error, also in the site of ``calibration``
    noise: tuple[Tuned, ...] = ()
    open_signs: int = 0  # amplitudes that the last pass omitted, since their sign was ambiguous
    # errors of the beacons' fields that are constant in place, with the same effect
    field_errors: tuple[Block, ...] = ()
    # (dimension, uncertain), change by one sigma of each uncertain parameter; included in that
    # covariance
    calibration_response: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (states,), where the platform is at rest
    standing: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    log_name: str = ""  # of the log
    epoch_ns: int = 0  # zero of the log's clock
    trust: Trust | None = None  # after `magfusion.estimation.integrity.judge.judge_result`

    def __repr__(self) -> str:
        time, beacons = self.states.time, len(self.calibration.site.beacons)
        span = f"{time[0]:g} to {time[-1]:g} s" if len(time) else "no time"
        parts = [f"log {self.log_name!r}", f"{len(time)} states", span, f"{beacons} beacons"]
        parts.append("not judged" if self.trust is None else str(self.trust.verdict))
        return one_line(type(self).__name__, parts)

    @property
    def uncertain(self) -> tuple[Block, ...]:
        """Considered parameters and field errors: in the covariance without being estimated."""
        return placed((*self.considered, *self.field_errors))


def smooth(
    log: Log,
    site: Site,
    settings: SmootherSettings | None = None,
    report: Report = quiet,
    iterations_file: PassFile | None = None,
) -> Smoothed:
    """Estimate the trajectory of a log and its calibration in one solution.

    Parameters
    ----------
    log : Log
        With a waveform, or with phasors in the site's channel order.
    report : callable, optional
        Called with stage, steps done and total steps.
    iterations_file : PassFile, optional
        Checkpoint of the passes, from which a stopped run is resumed.

    Raises
    ------
    TypeError
        Where the arguments are not a log and a site, in this order.
    InputError
        Where the log has no usable data.
    EstimationError
        Where the graph cannot be solved.
    """
    check_arguments("smooth", log=(log, Log), site=(site, Site))
    settings = SmootherSettings() if settings is None else settings
    log, site = logged(log, site)
    require_motion_prior(site)
    for beacon in site.beacons:
        if beacon.unknown is not None:
            raise InputError(
                f"the {beacon.unknown} of beacon {beacon.name} is unknown; place it by"
                " magfusion.estimation.batch.self_survey.smooth_and_place"
            )
    if settings.earth:
        check_earth(site)
    log, site = select_detected(log, site, settings.lockin)
    known = clean_log(log, site)
    result = _solved(preprocess(known, site, settings, report), settings, report, iterations_file)
    return replace(result, log_name=log.name, epoch_ns=log.epoch_ns)


def _solved(
    log: PreprocessedLog,
    settings: SmootherSettings,
    report: Report,
    iterations_file: PassFile | None = None,
) -> Smoothed:
    """Return the posterior of a log after passes until convergence."""
    first, time, steps = log.declared, log.states.time, settings.max_iterations + 3
    calm = quiet_before(log.imu, time - first.imu_offset(time), first.site.platform.motion)
    known = None if iterations_file is None else iterations_file.begun(log)
    if settings.tune:
        log = replace(log, declared=replace(first, site=with_measured_noise(first.site, log.imu)))
    prior = log.declared.site
    now = begin_iterations(log, settings) if known is None else known
    log = replace(log, declared=now.declared)
    while True:
        report(f"pass {now.done + 1}", now.done + 2, steps)
        plan, wave = plan_pass(log, now, settings), demodulate_about(log, now)
        solved = solve_about(log, now, wave, calm, plan)
        before, now = now, advance(now, solved)
        converged = nothing_moved(before, now, solved)
        if plan.finds_noise:
            give_back_memory()
            newest = noise_of(log, solved.graph, solved.solution.estimate, now.states, wave, prior)
            now, converged = retune(before, now, newest, plan), False
            log = replace(log, declared=now.declared)
        if converged or now.done >= settings.max_iterations:
            break
        now = relax(log, before, now, solved.graph.blocks)
        del solved  # most of the memory in a long log
        give_back_memory()
        if iterations_file is not None:
            iterations_file.keep(now, first, log.blocks)
    report("posterior", steps - 1, steps)
    # Receiver data for another pass are no longer needed.
    log = replace(log, demodulation=replace(log.demodulation, receiver=None))
    give_back_memory()
    estimate, fields = solved.solution, log.samples if wave is None else wave.fields
    result = posterior(log, solved.graph, estimate, fields, solved.gaps)
    report("done", steps, steps)
    refuse_open(result.states)
    move = 0.0
    if not (converged and estimate.converged):
        unfinished = None if estimate.converged else (solved.graph, estimate.estimate)
        move = last_move(before.states, result.states, unfinished)
    return replace(
        result,
        noise=compared_with(now.tuned, first.site, prior),
        standing=now.standing,
        iteration_count=now.done,
        iterations=now.iterations,
        converged=move < QUIET,
        last_move=move,
    )


def solved_again(result: Smoothed, measurements: tuple[Measurement, ...]) -> Smoothed:
    """Return a posterior with other measurements of the same states, started from the solution.

    Raises RuntimeError from GTSAM, where these measurements leave the system singular.
    """
    graph = replace(result.graph, measurements=measurements)
    estimate = optimise(graph, result.estimate)
    pose_cov, calibration_cov, response = marginals(graph, estimate.estimate, result.uncertain)
    states = read_states(estimate.estimate.values, result.states.time)
    phasors = next(m for m in measurements if isinstance(m, FieldPhasors))
    detected = np.any(phasors.sqrt_information != 0.0, axis=(2, 3))
    error = graph.residual(phasors.alone(), estimate.estimate)
    return replace(
        result,
        states=replace(states, pose_cov=pose_cov),
        calibration=estimate.estimate.calibration,
        calibration_cov=calibration_cov,
        calibration_response=response,
        residual=np.where(detected[..., None], error, np.nan),
        graph=graph,
        estimate=estimate.estimate,
        cost=estimate.cost,
        iterations=result.iterations + estimate.iterations,
    )


def posterior(
    log: PreprocessedLog,
    graph: Graph,
    result: Optimised[GraphEstimate],
    samples: FieldSamples,
    gaps: int,
) -> Smoothed:
    """Return the posterior of a log from its optimised graph.

    `samples`: phasors measured in the graph. `gaps`: number of intervals with a bridged gap.
    """
    estimate = result.estimate
    states, response = read_states(estimate.values, log.states.time), None
    errors: tuple[Block, ...] = ()
    if log.fixes is None:
        measured = log.measured_at(graph.measurements)
        here = states.rows(measured)
        errors = field_errors(estimate.calibration.site, here.time, here)
    uncertain = placed((*log.considered, *errors))
    pose_cov, calibration_cov, moved = marginals(graph, estimate, uncertain)
    if log.fixes is not None:
        there = survey_response(log.declared, log.samples, log.at_fields(states))
        later = np.searchsorted(log.epoch, np.arange(len(states)))
        response = there[np.minimum(later, len(there) - 1)]
        pose_cov = pose_cov + response @ np.swapaxes(response, 1, 2)
    remaining = {type(m): graph.residual(m, estimate) for m in map(alone, graph.measurements)}
    error = remaining.get(FieldPhasors, np.nan)
    residual = np.where(samples.is_measured, error, np.nan)
    earth_field = next((m for m in graph.measurements if isinstance(m, EarthField)), None)
    earth = None if earth_field is None else remaining[EarthField][:, 0]
    return Smoothed(
        states=replace(states, pose_cov=pose_cov),
        epoch=log.epoch,
        fields=samples,
        declared=log.declared,
        calibration=estimate.calibration,
        blocks=graph.blocks,
        considered=log.considered,
        calibration_cov=calibration_cov,
        residual=residual,
        start=log.start,
        graph=graph,
        estimate=estimate,
        rival_chi_square=log.rival_chi_square,
        rival=log.rival,
        dropped=log.demodulation.dropped,
        open_signs=count_open(log.samples, samples),
        gap_bridged=gaps,
        cost=result.cost,
        iteration_count=1,
        iterations=result.iterations,
        converged=result.converged,
        earth_residual=earth,
        earth_disturbed=(
            None if earth is None or earth_field is None else disturbed(earth, earth_field.repeats)
        ),
        fix_response=response,
        field_errors=errors,
        calibration_response=moved,
    )
