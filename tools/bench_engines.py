"""One problem by our loop and by GTSAM's optimizers, on the factors that `to_gtsam` gives.

All engines have the same factors, start and calibration parameters.  Our loop and
LevenbergMarquardtOptimizer solve the whole log.  ISAM2 and GTSAM's fixed-lag smoothers receive it
epoch by epoch, one update each, and the calibration stays in the lag.  Errors, sigmas and NEES are
those of the newest `LAG` epochs at the end, which every engine has.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.gtsam_graph import WIDTHS, NativeProblem
from magfusion.estimation.posterior.marginals import marginals
from magfusion.estimation.solve.bordered import optimise
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

LAG = 20  # epochs, 1 s each
SIZES = (100, 400)  # epochs
TOLERANCE = 1e-6  # relative decrease of the cost that ends a batch optimizer
RELINEARIZE, WILDFIRE = 1e-4, 1e-5  # of ISAM2, far below the sigmas of the poses


@dataclass(frozen=True, eq=False)
class Solved:
    """What an engine returns.

    Parameters
    ----------
    values : gtsam.Values
        Have the newest poses.
    pose_cov : callable
        Returns the covariance of the pose of an epoch, shape (6, 6) (rad, m).
    """

    values: gtsam.Values
    pose_cov: Callable[[int], Array]


@dataclass(frozen=True, eq=False)
class Increment:
    """What an epoch adds to a graph."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    seconds: dict[int, float]  # by key, of the epoch's states and of the calibration


Engine = Callable[[NativeProblem, GraphEstimate], Solved]


def bordered(native: NativeProblem, start: GraphEstimate) -> Solved:
    """Run our loop."""
    solved = optimise(native.problem, start, tolerance=TOLERANCE).estimate
    poses = cache(lambda: marginals(native.problem, solved)[0])
    return Solved(solved.values, lambda i: poses()[i])


def levenberg_marquardt(native: NativeProblem, _: GraphEstimate) -> Solved:
    """Run GTSAM's batch optimizer."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    graph, start = native.graph, native.values
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, native.ordering, parameters)
    return _by_marginals(native.graph, optimizer.optimize())


def isam2(native: NativeProblem, _: GraphEstimate) -> Solved:
    """Run ISAM2 epoch by epoch."""
    isam = gtsam.ISAM2(_isam2_parameters())
    for part in increments(native):
        isam.update(part.graph, part.values)
    return Solved(isam.calculateEstimate(), lambda i: isam.marginalCovariance(X(i)))


def incremental_fixed_lag(native: NativeProblem, _: GraphEstimate) -> Solved:
    """Run GTSAM's fixed-lag smoother on ISAM2."""
    smoother = gtsam.IncrementalFixedLagSmoother(float(LAG), _isam2_parameters())
    for part in increments(native):
        smoother.update(part.graph, part.values, part.seconds)
    return Solved(smoother.calculateEstimate(), lambda i: smoother.marginalCovariance(X(i)))


def batch_fixed_lag(native: NativeProblem, _: GraphEstimate) -> Solved:
    """Run GTSAM's fixed-lag smoother on Levenberg and Marquardt's method."""
    smoother = gtsam.BatchFixedLagSmoother(float(LAG))
    for part in increments(native):
        smoother.update(part.graph, part.values, part.seconds)
    return _by_marginals(smoother.getFactors(), smoother.calculateEstimate())


ENGINES: dict[str, Engine] = {
    "bordered": bordered,
    "LevenbergMarquardtOptimizer": levenberg_marquardt,
    "ISAM2": isam2,
    "IncrementalFixedLagSmoother": incremental_fixed_lag,
    "BatchFixedLagSmoother": batch_fixed_lag,
}


def increments(native: NativeProblem) -> list[Increment]:
    """Return the factors and initial values by the newest epoch on which they are."""
    epochs, keys = native.problem.epochs, set(native.values.keys())
    calibration = {key for key in keys if _epoch(key) < 0}
    parts = []
    for k in range(epochs):
        values, new = gtsam.Values(native.values), {key for key in keys if _epoch(key) == k}
        new |= calibration if k == 0 else set()
        for key in keys - new:
            values.erase(key)
        seconds = dict.fromkeys(new | calibration, float(k))
        parts.append(Increment(gtsam.NonlinearFactorGraph(), values, seconds))
    for i in range(native.graph.size()):
        factor = native.graph.at(i)
        parts[max(0, *map(_epoch, factor.keys()))].graph.add(factor)
    return parts


def _epoch(key: int) -> int:
    """Return the epoch of a state's key, -1 for the calibration's."""
    symbol = gtsam.Symbol(key)
    return int(symbol.index()) if chr(symbol.chr()) in WIDTHS else -1


def _isam2_parameters() -> gtsam.ISAM2Params:
    parameters, steps = gtsam.ISAM2Params(), gtsam.ISAM2GaussNewtonParams()
    parameters.setRelinearizeThreshold(RELINEARIZE)
    parameters.relinearizeSkip = 1
    steps.setWildfireThreshold(WILDFIRE)
    parameters.setOptimizationParams(steps)
    return parameters


def _by_marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Solved:
    result = cache(lambda: gtsam.Marginals(graph, values))
    return Solved(values, lambda i: result().marginalCovariance(X(i)))


def bench_engine(
    engine: Engine, problem: Graph, start: GraphEstimate, truth: Trajectory
) -> dict[str, float]:
    """Return an engine's error and sigma (m), NEES, and time (s), covariances excluded."""
    native = NativeProblem(problem, start)
    started = time.process_time()
    solved = engine(native, start)
    seconds = time.process_time() - started
    error, sigma, nees = [], [], []
    for i in range(problem.epochs - LAG, problem.epochs):
        true = gtsam.Pose3(gtsam.Rot3(truth.world_from_body[i]), truth.position_world[i])
        away, cov = solved.values.atPose3(X(i)).localCoordinates(true), solved.pose_cov(i)
        error.append(float(away[3:] @ away[3:]))
        sigma.append(float(np.trace(cov[3:, 3:])))
        nees.append(float(away @ np.linalg.solve(cov, away)))
    return {
        "error_m": float(np.sqrt(np.mean(error))),
        "sigma_m": float(np.sqrt(np.mean(sigma))),
        "nees_per_axis": float(np.mean(nees)) / 6.0,
        "s": seconds,
    }


def bench_engines(
    make: Callable[[int], tuple[Graph, GraphEstimate, Trajectory]],
) -> dict[str, float]:
    """Return the figures of all engines on logs of `SIZES` epochs, and how their times grow.

    Parameters
    ----------
    make : callable
        Returns problem, start and truth of so many epochs.
    """
    scenes, figures = [make(size) for size in SIZES], {}
    for name, engine in ENGINES.items():
        seconds = []
        for size, scene in zip(SIZES, scenes, strict=True):
            own = bench_engine(engine, *scene)
            seconds.append(own["s"])
            figures |= {f"{name}_{size}_{figure}": value for figure, value in own.items()}
        figures[f"{name}_growth"] = seconds[-1] / seconds[0]
    return figures
