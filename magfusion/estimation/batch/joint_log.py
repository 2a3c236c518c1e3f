"""One log among several of one site: its data between two rounds, and one round of it."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.batch import Smoothed, posterior
from magfusion.estimation.batch.joint import (
    LogInformation,
    Shared,
    SharedCalibration,
    as_prior,
    with_prior,
)
from magfusion.estimation.batch.log_graph import PreprocessedLog, graph_of
from magfusion.estimation.batch.preprocessed_log import WarmStart, restore_preprocessed
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate, read_states
from magfusion.estimation.graph.prior_factor import PriorShift
from magfusion.estimation.measurements.field_error import field_errors
from magfusion.estimation.posterior.marginalized_log import columns_of, marginalize
from magfusion.estimation.posterior.noise_tuning import Tuned, with_noise
from magfusion.estimation.solve.bordered import Optimised, eliminate, optimise
from magfusion.model.parameters import Block, Calibration, difference, dimension, retract
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray


@dataclass(frozen=True, eq=False)
class OfLog:
    """Data of a log between two rounds, all of which can be written to a file."""

    begun: WarmStart  # its states, and its declared calibration
    # (segments, dimension), from its declared calibration to that of each segment of a long log
    steps: Array
    noise: tuple[Tuned, ...]  # estimated when it was smoothed alone
    standing: BoolArray  # (states,), where the platform is at rest
    information: LogInformation  # on the shared calibration


class Round(NamedTuple):
    """One log, solved with a prior from other logs."""

    log: PreprocessedLog
    graph: Graph
    solution: Optimised[GraphEstimate]
    wave: MotionCompensated | None
    gaps: int
    shift: PriorShift


def of_smoothed(result: Smoothed, shared: Shared) -> OfLog:
    """Return the data between rounds of a log that was smoothed alone."""
    begun = WarmStart(
        replace(result.states, pose_cov=None),
        result.declared,
        result.start,
        result.rival_chi_square,
        result.rival,
    )
    part = marginalize(result.graph, result.estimate, result.considered, result.field_errors)
    information = LogInformation(
        difference(shared.declared, result.calibration, shared.blocks), part
    )
    steps = _steps(result.declared, result.estimate, result.blocks)
    return OfLog(begun, steps, result.noise, result.standing, information)


def solve_round(
    log: Log,
    site: Site,
    settings: SmootherSettings,
    kept: OfLog,
    shared: Shared,
    prior: SharedCalibration,
) -> Round:
    """Solve a log from its last states, with a prior of the shared calibration.

    The waveform is predicted again from these states; the noise estimated from it alone is kept.
    `prior`: in a round that of all logs, `narrowed`; in the end from the survey and all other logs.
    Raises EstimationError where the log is not the one that was smoothed, or cannot be solved.
    """
    declared = with_noise(kept.begun.declared, kept.noise)
    ready = restore_preprocessed(clean_log(log, site), site, settings, kept.begun)
    blocks, states = ready.blocks, ready.states
    every = tuple(retract(declared, blocks, step) for step in kept.steps)
    ready = replace(
        ready, declared=with_prior(prior, shared, declared), blocks=as_prior(prior, shared, blocks)
    )
    segments = every if len(every) > 1 else ()
    calibration = every[len(every) // 2]
    by_waveform = ready.demodulation.can_repeat
    wave = ready.compensated(calibration, states) if by_waveform else None
    graph, gaps = graph_of(ready, states, calibration, wave, kept.standing)
    start = initial_estimate(states, calibration, segments)
    result = optimise(graph, start)
    if result.converged:  # costs cannot resolve steps below their own rounding
        step = eliminate(graph.linearized(result.estimate), graph.ordering).optimize()
        result = replace(result, estimate=graph.moved(result.estimate, step))
    return Round(ready, graph, result, wave, gaps, _shift(prior, ready))


def _shift(prior: SharedCalibration, log: PreprocessedLog) -> PriorShift:
    """Return the shift of a log's prior from other logs by considered parameters."""
    rows = columns_of(log.blocks, own=False)
    by_considered = np.zeros((len(rows), dimension(log.considered)))
    columns = columns_of(log.considered, own=False)
    if prior.by_common.shape[1]:
        by_considered[np.ix_(rows, columns)] = prior.by_common
    separate = np.zeros((len(rows), len(prior.step)))
    value, vector = np.linalg.eigh(prior.separate_errors)
    separate[rows] = vector * np.sqrt(np.maximum(value, 0.0))
    return PriorShift(by_considered, separate)


def after_round(kept: OfLog, done: Round, shared: Shared) -> OfLog:
    """Return the data of a log after a round."""
    estimate, log = done.solution.estimate, done.log
    states = read_states(estimate.values, log.states.time)
    measured = log.measured_at(done.graph.measurements)
    here = states.rows(measured)
    errors = field_errors(estimate.calibration.site, here.time, here)
    part = marginalize(done.graph, estimate, log.considered, errors)
    information = LogInformation(
        difference(shared.declared, estimate.calibration, shared.blocks), part
    )
    begun = replace(kept.begun, states=states)
    return replace(
        kept,
        begun=begun,
        steps=_steps(kept.begun.declared, estimate, log.blocks),
        information=information,
    )


def joint_posterior(kept: OfLog, done: Round, blocks: tuple[Block, ...]) -> Smoothed:
    """Return the posterior of a log in the joint solution, relative to the declared site.

    `blocks`: with the declared sigmas.
    """
    samples = done.log.samples if done.wave is None else done.wave.fields
    graph = replace(done.graph, shift=done.shift)
    result = posterior(done.log, graph, done.solution, samples, done.gaps)
    return replace(
        result,
        declared=with_noise(kept.begun.declared, kept.noise),
        blocks=blocks,
        noise=kept.noise,
        standing=kept.standing,
    )


def _steps(declared: Calibration, estimate: GraphEstimate, blocks: tuple[Block, ...]) -> Array:
    every = estimate.segments or (estimate.calibration,)
    steps = [difference(declared, calibration, blocks) for calibration in every]
    return np.array(steps).reshape(len(every), dimension(blocks))
