"""The whole offline estimate of one log: start, passes over the waveform, posterior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from gtsam.symbol_shorthand import V

from magfusion.errors import InputError
from magfusion.estimation.batch.chain import Start
from magfusion.estimation.batch.log_graph import PreparedLog, graph_of, noise_of
from magfusion.estimation.batch.on_new_clock import on_new_clock
from magfusion.estimation.batch.prepared import prepared
from magfusion.estimation.batch.settings import SmootherSettings as SmootherSettings
from magfusion.estimation.data_checks.mending import mended
from magfusion.estimation.demodulation.hearing import heard_site
from magfusion.estimation.graph.graph import Estimate, Graph, initial_estimate, read_states
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.measurements.earth import EarthField, check_earth, disturbed
from magfusion.estimation.measurements.field_error import field_errors
from magfusion.estimation.measurements.phasors import FieldPhasors, alone
from magfusion.estimation.measurements.signs import count_open
from magfusion.estimation.measurements.zero_velocity import may_stand, quiet_before
from magfusion.estimation.posterior.convergence import last_move, refuse_open, settled_at
from magfusion.estimation.posterior.marginals import marginals
from magfusion.estimation.posterior.noise_tuning import (
    Tuned,
    as_declared,
    plausible,
    with_noise,
)
from magfusion.estimation.posterior.noise_tuning import settled as same_noise
from magfusion.estimation.posterior.relaxation import Step, part_of_the_way
from magfusion.estimation.snapshot.survey_error import survey_response
from magfusion.estimation.solve.bordered import Optimised, eliminate, marginal, optimise
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.parameters import Block, Calibration, placed
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import MotionModel, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.without_imu import logged, require_motion_prior
from magfusion.units import Array, BoolArray, IntArray

if TYPE_CHECKING:
    from magfusion.estimation.batch.passes import PassFile

QUIET = 0.3  # sigmas; a last pass that moved the poses by less has converged all the same
ON_THE_WAY, CONVERGED = 1e-4, 1e-6  # relative decrease of the cost at which a pass ends
TUNINGS = 3  # passes after which the noise is found anew; then it stays as it is


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The posterior of one log.

    Parameters
    ----------
    states : Trajectory
        With velocity, biases and pose covariance, on the log's clock: at the fields, in gaps of
        them, and where anything else was measured.
    epoch : int ndarray, shape (n,)
        States at which the fields are.
    fields : FieldSamples
        The phasors of the last pass.
    declared, calibration : Calibration
        Before and after.
    blocks : tuple of Block
        What was estimated.
    considered : tuple of Block
        What else is uncertain, and in the covariance.
    field_errors : tuple of Block
        Errors of the beacons' fields that are constant in place, likewise.
    calibration_cov : ndarray, shape (dimension, dimension)
    calibration_response : ndarray, shape (dimension, uncertain)
        What one sigma of what is uncertain does to it; its part is in that covariance.
    residual : ndarray, shape (n, channels, 6)
        Whitened; NaN where a channel is missing, or with loose coupling.
    graph : Graph
        As it was last optimised.
    estimate : Estimate
        In it: the states, and the calibration of every segment of a long log.
    rival_chi_square : float, optional
        How much worse the best trajectory from another chain of hypotheses is, after its first
        pass: a small figure means that the log leaves a mirrored trajectory possible.  None where
        there was no other chain, or all came to the same.
    converged : bool
        Whether the last pass moved nothing, or little in units of its sigma.
    last_move : float
        Root mean square of what the last pass moved the poses by, in sigmas: the gauge of the
        survey has a large one.
    rival : Trajectory, optional
        That trajectory.
    dropped : mapping
        Reason to number of windows.
    bridged : int
        Intervals with a gap in the inertial stream.
    earth_residual : ndarray, shape (n, 3), optional
        Whitened; None where the Earth field was not measured.
    earth_disturbed : bool ndarray, shape (n,), optional
        Where the motion contradicts it.
    fix_response : ndarray, shape (states, 6, parameters), optional
        What one sigma of the survey does to every pose alike, with loose coupling.
    noise : tuple of Tuned
        What was found of noise and model error; the site of ``calibration`` has it.
    open_signs : int
        Amplitudes that the last pass left out, since their sign was open.
    standing : bool ndarray, shape (states,)
        Where the platform stands.
    """

    states: Trajectory
    epoch: IntArray
    fields: FieldSamples
    declared: Calibration
    calibration: Calibration
    blocks: tuple[Block, ...]
    considered: tuple[Block, ...]
    calibration_cov: Array
    residual: Array
    start: Start
    graph: Graph
    estimate: Estimate
    rival_chi_square: float | None
    dropped: Mapping[str, int]
    bridged: int
    cost: float
    passes: int
    iterations: int
    converged: bool
    last_move: float = 0.0
    rival: Trajectory | None = None
    earth_residual: Array | None = None
    earth_disturbed: BoolArray | None = None
    fix_response: Array | None = None
    noise: tuple[Tuned, ...] = ()
    open_signs: int = 0
    field_errors: tuple[Block, ...] = ()
    calibration_response: Array = field(default_factory=lambda: np.zeros((0, 0)))
    standing: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def uncertain(self) -> tuple[Block, ...]:
        """All that is in the covariance without being estimated."""
        return placed((*self.considered, *self.field_errors))


def smooth(
    log: Log,
    site: Site,
    settings: SmootherSettings | None = None,
    report: Report = quiet,
    passes: PassFile | None = None,
) -> Smoothed:
    """Estimate the best trajectory of a log, with the calibration in the same solution.

    Parameters
    ----------
    log : Log
        With a waveform, or with phasors in the site's channel order.
    report : callable, optional
        Called with stage, steps done and steps in all.
    passes : PassFile, optional
        Keeps where the passes are, and knows where those of a run that was stopped were.

    Raises
    ------
    InputError
        Where the log holds nothing usable.
    EstimationError
        Where the graph cannot be solved.
    """
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
    log, site = heard_site(log, site, settings.lockin)
    known = mended(log, site)
    return _solved(prepared(known, site, settings, report), settings, report, passes)


def _solved(
    log: PreparedLog, settings: SmootherSettings, report: Report, passes: PassFile | None = None
) -> Smoothed:
    states, calibration, wave = log.states, log.declared, None
    segments: tuple[Calibration, ...] = ()
    declared = log.declared.site
    tuning = settings.tune and log.fixes is None and log.samples.signed
    time, motion = states.time, log.declared.site.platform.motion
    calm = quiet_before(log.imu, time - calibration.imu_offset(time), motion)
    standing = log.samples.at_rest(time)
    by_waveform = log.fixes is None and log.demodulation.anew
    iterations, done, settled = 0, 0, False
    tuned: tuple[Tuned, ...] = ()
    step: Step | None = None
    first = log.declared
    known = None if passes is None else passes.begun(log)
    if known is not None:
        log = replace(log, declared=known.declared)
        states, calibration, segments = known.states, known.calibration, known.segments
        standing, tuned, tuning, step = known.standing, known.tuned, known.tuning, known.step
        iterations, done = known.iterations, known.done
    while done < settings.passes and not settled:
        report(f"pass {done + 1}", done + 2, settings.passes + 3)
        if done > 0 and by_waveform:
            wave = log.compensated(calibration, states)
            give_back_memory()
        elif not log.samples.signed:
            wave = log.with_signs(calibration, states, first=done == 0)
        # Another pass is sure to come.
        short = (done == 0 or tuning) and done + 1 < settings.passes
        tolerance = ON_THE_WAY if short else CONVERGED
        # The noise that stays is told from the residuals by the sigmas as they are.
        finds = tuning and (done > 0 or not by_waveform)
        roughly = short and not (finds and done >= TUNINGS)
        graph, gaps = graph_of(log, states, calibration, wave, standing, roughly=roughly)
        begun = initial_estimate(states, calibration, segments)
        found = optimise(graph, begun, tolerance=tolerance)
        after = read_states(found.estimate.values, time)
        stood = _at_rest(graph, found.estimate, after, calm & ~standing, motion)
        if np.any(stood):  # at once: it costs no preintegration
            graph = replace(graph, measurements=(*graph.measurements, log.rests(stood)))
            iterations += found.iterations
            found = optimise(graph, found.estimate, tolerance=tolerance)
            after = read_states(found.estimate.values, time)
        settled = (
            done > 0
            and not np.any(stood)
            and settled_at(states, after, calibration, found.estimate.calibration)
        )
        before, states = states, after
        old, calibration = calibration, found.estimate.calibration
        standing = standing | stood
        segments = found.estimate.segments
        if finds:
            give_back_memory()
            latest = noise_of(log, graph, found.estimate, states, wave, declared)
            again = roughly or (done < TUNINGS and not same_noise(tuned, latest))
            tuning = again and plausible(latest)
            tuned, settled = latest if plausible(latest) else as_declared(latest), False
            log = replace(log, declared=with_noise(log.declared, tuned))
            calibration = with_noise(calibration, tuned)
            segments = tuple(with_noise(segment, tuned) for segment in segments)
        iterations, done = iterations + found.iterations, done + 1
        if not settled and done < settings.passes:
            step = Step.of(step, before, states, old, calibration)
            moved = before, states, old, calibration
            states, calibration = part_of_the_way(*moved, graph.blocks, step.share)
            states = on_new_clock(log, states, old, calibration, standing)
            del graph, found  # of a long log they are most of what there is
            give_back_memory()
            if passes is not None:
                from magfusion.estimation.batch.passes import Passed

                passed = Passed(
                    done=done,
                    iterations=iterations,
                    tuning=tuning,
                    states=states,
                    declared=log.declared,
                    calibration=calibration,
                    segments=segments,
                    standing=standing,
                    tuned=tuned,
                    step=step,
                )
                passes.keep(passed, first, log.blocks)
    report("posterior", settings.passes + 2, settings.passes + 3)
    # What the receiver keeps for another pass is not needed any more.
    log = replace(log, demodulation=replace(log.demodulation, receiver=None))
    give_back_memory()
    fields = log.samples if wave is None else wave.fields
    result = posterior(log, graph, found, fields, gaps)
    report("done", settings.passes + 3, settings.passes + 3)
    refuse_open(result.states)
    move = (
        0.0
        if settled and found.converged
        else last_move(before, result.states, None if found.converged else (graph, found.estimate))
    )
    result = replace(result, noise=tuned, standing=standing)
    return replace(
        result, passes=done, iterations=iterations, converged=move < QUIET, last_move=move
    )


def solved_again(result: Smoothed, measurements: tuple[Measurement, ...]) -> Smoothed:
    """Return a posterior with other measurements of the same states, from where it is.

    Raises
    ------
    RuntimeError
        GTSAM's own, of a system that these leave open.
    """
    graph = replace(result.graph, measurements=measurements)
    found = optimise(graph, result.estimate)
    pose_cov, calibration_cov, response = marginals(graph, found.estimate, result.uncertain)
    states = read_states(found.estimate.values, result.states.time)
    phasors = next(m for m in measurements if isinstance(m, FieldPhasors))
    heard = np.any(phasors.sqrt_information != 0.0, axis=(2, 3))
    error = graph.residual(phasors.alone(), found.estimate)
    return replace(
        result,
        states=replace(states, pose_cov=pose_cov),
        calibration=found.estimate.calibration,
        calibration_cov=calibration_cov,
        calibration_response=response,
        residual=np.where(heard[..., None], error, np.nan),
        graph=graph,
        estimate=found.estimate,
        cost=found.cost,
        iterations=result.iterations + found.iterations,
    )


def _at_rest(
    graph: Graph, estimate: Estimate, states: Trajectory, asked: BoolArray, motion: MotionModel
) -> BoolArray:
    """Return at which of some epochs with a quiet IMU the platform is at rest."""
    out = np.zeros(len(asked), dtype=bool)
    if np.any(asked):
        assert states.velocity_world is not None
        tree = eliminate(graph.linearized(estimate), graph.ordering)
        rows = np.flatnonzero(asked)
        cov = np.array([marginal(tree, V(i), 3) for i in rows.tolist()])
        out[rows] = may_stand(states.velocity_world[rows], cov, motion)
    return out


def posterior(
    log: PreparedLog, graph: Graph, found: Optimised[Estimate], samples: FieldSamples, gaps: int
) -> Smoothed:
    """Return the posterior of a log whose graph was optimised.

    Parameters
    ----------
    samples : FieldSamples
        As they are measured in the graph.
    gaps : int
        Intervals that were bridged.
    """
    estimate = found.estimate
    states, response = read_states(estimate.values, log.states.time), None
    errors: tuple[Block, ...] = ()
    if log.fixes is None:
        measured = log.measured_at(graph.measurements)
        here = Trajectory(**{k: v[measured] for k, v in vars(states).items() if v is not None})
        errors = field_errors(estimate.calibration.site, here.time, here)
    uncertain = placed((*log.considered, *errors))
    pose_cov, calibration_cov, moved = marginals(graph, estimate, uncertain)
    if log.fixes is not None:
        there = survey_response(log.declared, log.samples, log.at_fields(states))
        later = np.searchsorted(log.epoch, np.arange(len(states)))
        response = there[np.minimum(later, len(there) - 1)]
        pose_cov = pose_cov + response @ np.swapaxes(response, 1, 2)
    left = {type(m): graph.residual(m, estimate) for m in map(alone, graph.measurements)}
    error = left.get(FieldPhasors, np.nan)
    residual = np.where(samples.told, error, np.nan)
    earth_field = next((m for m in graph.measurements if isinstance(m, EarthField)), None)
    earth = None if earth_field is None else left[EarthField][:, 0]
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
        bridged=gaps,
        cost=found.cost,
        passes=1,
        iterations=found.iterations,
        converged=found.converged,
        earth_residual=earth,
        earth_disturbed=(
            None if earth is None or earth_field is None else disturbed(earth, earth_field.repeats)
        ),
        fix_response=response,
        field_errors=errors,
        calibration_response=moved,
    )
