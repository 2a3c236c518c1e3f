"""One pass over a log: solution of the graph linearised at the states of the pass before."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from gtsam.symbol_shorthand import V

from magfusion.estimation.batch.log_graph import PreprocessedLog, graph_of
from magfusion.estimation.batch.on_new_clock import on_new_clock
from magfusion.estimation.batch.outer_iterations import IterationState
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate, read_states
from magfusion.estimation.graph.gtsam_graph import NativeProblem
from magfusion.estimation.measurements.zero_velocity import may_stand, slow_enough_to_stand
from magfusion.estimation.posterior.convergence import settled_at
from magfusion.estimation.posterior.fixed_point_acceleration import Step, part_of_the_way
from magfusion.estimation.posterior.noise_tuning import Tuned, as_declared, plausible, with_noise
from magfusion.estimation.posterior.noise_tuning import has_converged as same_noise
from magfusion.estimation.solve.bordered import Optimised, eliminate, marginal, optimise
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.estimation.solve.native import optimise_natively
from magfusion.model.parameters import Block
from magfusion.model.site import MotionModel
from magfusion.model.trajectory import Trajectory
from magfusion.units import BoolArray

TUNINGS = 3  # passes after which the noise is estimated again; then it is kept
ON_THE_WAY, CONVERGED = 1e-4, 1e-6  # relative decrease of the cost at which a pass ends


class SolvedPass(NamedTuple):
    """The solved graph of a pass."""

    graph: Graph
    solution: Optimised[GraphEstimate]
    states: Trajectory  # without covariance
    gaps: int  # number of intervals with a bridged gap
    was_stationary: BoolArray  # (states,), where the platform was detected at rest
    iterations: int  # of the optimiser, including those before rests were detected


def begin_iterations(log: PreprocessedLog, settings: SmootherSettings) -> IterationState:
    """Return the state of a log before its first pass."""
    return IterationState(
        done=0,
        iterations=0,
        tuning=settings.tune and log.fixes is None and log.samples.signed,
        states=log.states,
        declared=log.declared,
        calibration=log.declared,
        segments=(),
        standing=log.samples.is_stationary(log.states.time),
        tuned=(),
    )


class IterationPlan(NamedTuple):
    """Settings of the next pass."""

    short: bool  # whether the optimiser may end early
    finds_noise: bool  # whether noise and model error are estimated from its residuals
    roughly: bool  # whether approximate sigmas of its graph suffice
    engine: str  # optimiser, 'bordered' or 'gtsam'


def plan_pass(
    log: PreprocessedLog, now: IterationState, settings: SmootherSettings
) -> IterationPlan:
    """Return the settings of the next pass."""
    # Another pass will follow.
    short = (now.done == 0 or now.tuning) and now.done + 1 < settings.max_iterations
    # The final noise is estimated from residuals whitened with the present sigmas.
    finds = now.tuning and (now.done > 0 or not by_waveform(log))
    roughly = short and not (finds and now.done >= TUNINGS)
    return IterationPlan(short, finds, roughly, settings.engine)


def by_waveform(log: PreprocessedLog) -> bool:
    """Return whether each pass demodulates the log again."""
    return log.fixes is None and log.demodulation.can_repeat


def demodulate_about(log: PreprocessedLog, now: IterationState) -> MotionCompensated | None:
    """Return the phasors demodulated with the last pass's states; None for those of the log."""
    if now.done > 0 and by_waveform(log):
        wave = log.compensated(now.calibration, now.states)
        give_back_memory()
        return wave
    if not log.samples.signed:
        return log.with_signs(now.calibration, now.states, first=now.done == 0)
    return None


def solve_about(
    log: PreprocessedLog,
    now: IterationState,
    wave: MotionCompensated | None,
    calm: BoolArray,
    plan: IterationPlan,
) -> SolvedPass:
    """Solve the graph linearised at the states of the last pass.

    `calm` (states,): where the IMU is quiet, so that the platform may be at rest.
    """
    time, motion = now.states.time, log.declared.site.platform.motion
    tolerance = ON_THE_WAY if plan.short else CONVERGED
    roughly = plan.roughly
    if now.done:
        log = replace(log, others=tuple((t, m.near_solution()) for t, m in log.others))
    graph, gaps = graph_of(log, now.states, now.calibration, wave, now.standing, roughly=roughly)
    begun = initial_estimate(now.states, now.calibration, now.segments)
    result = _optimised(graph, begun, tolerance, plan.engine)
    iterations, after = result.iterations, read_states(result.estimate.values, time)
    stationary = _stationary_epochs(graph, result.estimate, after, calm & ~now.standing, motion)
    if np.any(stationary):  # directly: it costs no preintegration
        graph = replace(graph, measurements=(*graph.measurements, log.rests(stationary)))
        result = _optimised(graph, result.estimate, tolerance, plan.engine)
        iterations += result.iterations
        after = read_states(result.estimate.values, time)
    return SolvedPass(graph, result, after, gaps, stationary, iterations)


def _optimised(
    graph: Graph, begun: GraphEstimate, tolerance: float, engine: str
) -> Optimised[GraphEstimate]:
    """Return the minimum of a graph by one of the optimisers."""
    if engine == "bordered":
        return optimise(graph, begun, tolerance=tolerance)
    native = NativeProblem(graph, begun)
    result = optimise_natively(native.graph, native.values, native.ordering, tolerance)
    estimate = native.estimate(result.estimate)
    return Optimised(estimate, result.cost, result.iterations, result.converged)


def advance(now: IterationState, solved: SolvedPass) -> IterationState:
    """Return the state of a log after a pass."""
    estimate = solved.solution.estimate
    return replace(
        now,
        done=now.done + 1,
        iterations=now.iterations + solved.iterations,
        states=solved.states,
        calibration=estimate.calibration,
        segments=estimate.segments,
        standing=now.standing | solved.was_stationary,
    )


def nothing_moved(before: IterationState, after: IterationState, solved: SolvedPass) -> bool:
    """Return whether a pass, not the first, reproduced the result of the one before."""
    if before.done == 0 or np.any(solved.was_stationary):
        return False
    return settled_at(before.states, after.states, before.calibration, after.calibration)


def retune(
    before: IterationState, after: IterationState, newest: tuple[Tuned, ...], plan: IterationPlan
) -> IterationState:
    """Return the state of a log after a pass, with the noise of its residuals if plausible."""
    noise = newest if plausible(newest) else as_declared(newest)
    moves = before.done < TUNINGS and not same_noise(before.tuned, newest)
    return replace(
        after,
        tuning=(plan.roughly or moves) and plausible(newest),
        declared=with_noise(after.declared, noise),
        calibration=with_noise(after.calibration, noise),
        segments=tuple(with_noise(segment, noise) for segment in after.segments),
        tuned=noise,
    )


def relax(
    log: PreprocessedLog, before: IterationState, after: IterationState, blocks: tuple[Block, ...]
) -> IterationState:
    """Return the start of the next pass, after accelerating the fixed-point iteration."""
    moved = before.states, after.states, before.calibration, after.calibration
    step = Step.of(before.step, *moved)
    states, calibration = part_of_the_way(*moved, blocks, step.share)
    states = on_new_clock(log, states, before.calibration, calibration, after.standing)
    return replace(after, states=states, calibration=calibration, step=step)


def _stationary_epochs(
    graph: Graph,
    estimate: GraphEstimate,
    states: Trajectory,
    candidates: BoolArray,
    motion: MotionModel,
) -> BoolArray:
    """Return which epochs with a quiet IMU have the platform at rest."""
    out = np.zeros(len(candidates), dtype=bool)
    assert states.velocity_world is not None
    candidates = candidates & slow_enough_to_stand(states.velocity_world, motion)
    if np.any(candidates):
        tree = eliminate(graph.linearized(estimate), graph.ordering)
        rows = np.flatnonzero(candidates)
        cov = np.array([marginal(tree, V(i), 3) for i in rows.tolist()])
        out[rows] = may_stand(states.velocity_world[rows], cov, motion)
    return out
