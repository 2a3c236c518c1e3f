"""Several logs of one site: their joint solution is that of one graph of all of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.joint import (
    LogInformation,
    Shared,
    SharedCalibration,
    apart_in_sigmas,
    known_by,
    narrowed,
    total_information,
)
from magfusion.estimation.batch.joint_log import (
    OfLog,
    Round,
    after_round,
    joint_posterior,
    of_smoothed,
    solve_round,
)
from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate
from magfusion.estimation.integrity.logs_agree import Deviation, LogAgreement, agreement, deviation
from magfusion.estimation.posterior.marginalized_log import columns_of, marginalize
from magfusion.jobs.joint_tasks import shared_of, together_settings
from magfusion.model.parameters import Calibration, difference, dimension, placed
from magfusion.model.prior import prior_sqrt_information
from magfusion.model.samples import Log
from magfusion.model.site import BeaconSigma, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    SimulationConfig,
    perturb_site,
    simulate_fields,
    simulate_log,
)
from magfusion.simulation.motion import Rests
from magfusion.units import DEGREE, Array

RESTLESS = Rests(start=0.0, move=1e3, pause=0.0)
NOISE = 3e-10  # T; of each part of a phasor
SETTINGS = together_settings(SmootherSettings(tune=False))
ROUNDS = 9


def surveyed() -> Site:
    """Return a site of a rough survey with a beacon whose clock is its own."""
    plain = replace(demo_site(coil_radius=None), model_error=1e-4)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 1.0 * DEGREE), np.full(2, 0.01))
    beacons = tuple(replace(beacon, sigma=sigma) for beacon in plain.beacons)
    return replace(plain, beacons=(replace(beacons[0], synchronised=False), *beacons[1:]))


def log_of(true: Site, which: int, duration: float = 2.4) -> Log:
    """Return a log of phasors."""
    rng = np.random.default_rng([7, which])
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=duration, perturb=False, rests=RESTLESS, magnetometer_rate_hz=100.0
    )
    built = simulate_log(true, config, rng)
    time = np.arange(0.3, duration - 0.3, 0.2)
    fields = simulate_fields(
        built.true_site, built.motion.trajectory(time), NOISE, rng, built.drives, window=0.2
    )
    return replace(built.log, name=f"log{which}", waveform=None, fields=fields)


@dataclass(frozen=True, eq=False)
class Together:
    """Logs, what each is alone, and what they are together."""

    site: Site
    true: Site
    logs: list[Log]
    alone: list[Smoothed]
    shared: Shared
    known: SharedCalibration
    kept: list[OfLog]
    rounds: list[Round]


def in_total(shared: Shared, logs: Sequence[LogInformation], at: Array) -> SharedCalibration:
    return known_by(shared, total_information(shared, logs, at), at)


def compared(together: "Together", logs: Sequence[LogInformation]) -> LogAgreement:
    shared, at = together.shared, together.known.step

    def deviations(pool: list[int]) -> list[Deviation]:
        total = total_information(shared, [logs[i] for i in pool], at)
        assert total is not None
        rest = ([logs[j] for j in pool if j != i] for i in pool)
        return [deviation(shared, total, total_information(shared, o, at), at) for o in rest]

    return agreement(shared, "abcdefgh"[: len(logs)], deviations)


def refined(site: Site, true: Site, logs: list[Log], rounds: int = ROUNDS) -> Together:
    alone = [smooth(log, site, SETTINGS) for log in logs]
    shared = shared_of(site, SETTINGS)
    kept = [of_smoothed(result, shared) for result in alone]
    at = kept[0].information.step
    for _ in range(rounds):
        every = in_total(shared, [log.information for log in kept], at)
        at = every.step
        solved = [
            solve_round(log, site, SETTINGS, own, shared, narrowed(every))
            for log, own in zip(logs, kept, strict=True)
        ]
        kept = [after_round(own, done, shared) for own, done in zip(kept, solved, strict=True)]
    known = in_total(shared, [log.information for log in kept], at)
    priors = (in_total(shared, [o.information for o in kept if o is not own], at) for own in kept)
    solved = [
        solve_round(log, site, SETTINGS, own, shared, prior)
        for log, own, prior in zip(logs, kept, priors, strict=True)
    ]
    return Together(site, true, logs, alone, shared, known, kept, solved)


@pytest.fixture(scope="module")
def together() -> Together:
    site = surveyed()
    true = perturb_site(site, np.random.default_rng(5))
    return refined(site, true, [log_of(true, which) for which in range(2)])


def step_to(shared: Shared, calibration: Calibration) -> Array:
    return difference(shared.declared, calibration, shared.blocks)


# One graph of all logs, dense and by orthogonal transformations ---------------------------------


class AllLogs:
    """Least squares over the states of every log, what each has of its own, and what they share."""

    def __init__(self, shared: Shared, graphs: list[Graph]) -> None:
        self.shared = shared
        self.prior = prior_sqrt_information(shared.declared.site, shared.blocks)
        self.graphs = [replace(graph, declared=None) for graph in graphs]
        self.declared = [graph.declared for graph in graphs]
        self.own = [columns_of(graph.blocks, own=True) for graph in graphs]

    def rows(self, estimates: list[GraphEstimate]) -> Iterator[tuple[int, Array, Array, Array]]:
        """Yield, for each log, Jacobian by its own variables, by what is shared, and error."""
        for k, (graph, estimate) in enumerate(zip(self.graphs, estimates, strict=True)):
            matrix, right = graph.linearized(estimate).jacobian(graph.ordering)
            own = np.concatenate([np.ones(15 * graph.epochs, dtype=bool), self.own[k]])
            blocks = placed(b for b in graph.blocks if b.parameter.each_log)
            declared = self.declared[k]
            assert declared is not None
            whitening = prior_sqrt_information(declared.site, blocks)
            moved = difference(declared, estimate.calibration, graph.blocks)[self.own[k]]
            prior = np.zeros((len(whitening), matrix.shape[1]))
            prior[:, np.flatnonzero(own)[-len(whitening) :]] = whitening
            matrix, right = np.vstack([matrix, prior]), np.append(right, -whitening @ moved)
            yield k, matrix[:, own], matrix[:, ~own], right

    def step(self, estimates: list[GraphEstimate]) -> tuple[list[GraphEstimate], float]:
        parts = list(self.rows(estimates))
        width, size = [own.shape[1] for _, own, _, _ in parts], len(self.prior)
        columns = sum(width)
        height = sum(len(right) for _, _, _, right in parts)
        matrix, right = np.zeros((height + size, columns + size)), np.zeros(height + size)
        row = column = 0
        for _, own, by_shared, error in parts:
            rows = slice(row, row + len(error))
            matrix[rows, column : column + own.shape[1]] = own
            matrix[rows, columns:], right[rows] = by_shared, error
            row, column = rows.stop, column + own.shape[1]
        matrix[row:, columns:] = self.prior
        moved = difference(self.shared.declared, estimates[0].calibration, self.graphs[0].blocks)[
            ~self.own[0]
        ]
        right[row:] = -self.prior @ moved
        r = np.linalg.qr(np.column_stack([matrix, right]), mode="r")
        r, end = r[: len(matrix.T), :-1], r[: len(matrix.T), -1]
        step = np.linalg.solve(r, end)
        out, column = [], 0
        for k, estimate in enumerate(estimates):
            own = step[column : column + width[k]]
            out.append(self.moved(k, estimate, own, step[columns:]))
            column += width[k]
        return out, float(np.max(np.abs(r[columns:, columns:] @ step[columns:])))

    def moved(self, k: int, estimate: GraphEstimate, own: Array, common: Array) -> GraphEstimate:
        graph, change, column = self.graphs[k], gtsam.VectorValues(), 0
        keys = graph.ordering
        for i in range(keys.size() - 1):
            size = 3 if gtsam.Symbol(keys.at(i)).chr() == ord("v") else 6
            change.insert(keys.at(i), own[column : column + size])
            column += size
        whole = np.zeros(dimension(graph.blocks))
        whole[self.own[k]], whole[~self.own[k]] = own[column:], common
        change.insert(CALIBRATION_KEY, whole)
        return graph.moved(estimate, change)


def in_one_graph(together: Together) -> list[GraphEstimate]:
    """Return the solution of one graph of all logs, after comparing its calibration."""
    whole = AllLogs(together.shared, [done.graph for done in together.rounds])
    first = together.alone[0].calibration
    # One calibration of the site, beside what each log has of its own.
    estimates = [
        initial_estimate(result.states, replace(result.calibration, site=first.site))
        for result in together.alone
    ]
    moved = np.inf
    for _ in range(25):
        estimates, moved = whole.step(estimates)
        if moved < 1e-8:
            break
    assert moved < 1e-8
    there = step_to(together.shared, estimates[0].calibration)
    assert apart_in_sigmas(together.known.step, there, together.known.cov) < 1e-6
    alone = step_to(together.shared, first)
    assert apart_in_sigmas(alone, there, together.known.cov) > 0.1
    return estimates


@pytest.mark.slow
def test_many_short_logs_are_one_graph_of_them_all() -> None:
    """To a millionth of a sigma, where each alone determines little."""
    site = surveyed()
    true = perturb_site(site, np.random.default_rng(6))
    in_one_graph(refined(site, true, [log_of(true, which, 1.4) for which in range(20)]))


@pytest.mark.slow
def test_the_joint_solution_is_that_of_one_graph_of_all_logs(together: Together) -> None:
    """To a millionth of a sigma, from the solutions of the logs alone."""
    estimates = in_one_graph(together)
    for which, estimate in enumerate(estimates):
        done, blocks = together.rounds[which], together.alone[which].blocks
        cov = joint_posterior(together.kept[which], done, blocks).states.pose_cov
        assert cov is not None
        ends = done.solution.estimate.values
        for i in range(done.graph.epochs):
            separate = ends.atPose3(X(i)).localCoordinates(estimate.values.atPose3(X(i)))
            assert np.max(np.abs(separate) / np.sqrt(np.diagonal(cov[i]))) < 1e-6
            faster = ends.atVector(V(i)) - estimate.values.atVector(V(i))
            assert np.max(np.abs(faster)) < 1e-9  # m/s
            bias = (
                ends.atConstantBias(B(i)).vector() - estimate.values.atConstantBias(B(i)).vector()
            )
            assert np.max(np.abs(bias)) < 1e-9


@pytest.mark.slow
def test_a_log_alone_condensed_says_what_its_own_posterior_says(together: Together) -> None:
    result, shared = together.alone[0], together.shared
    own = of_smoothed(result, shared).information
    known = known_by(shared, own, own.step)
    rows = ~columns_of(result.blocks, own=True)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(known.honest)),
        np.sqrt(np.diagonal(result.calibration_cov))[rows],
        rtol=1e-6,
    )
    assert apart_in_sigmas(known.step, own.step, known.cov) < 1e-2  # where its loop had ended
    without = marginalize(result.graph, result.estimate, ())
    assert np.all(np.linalg.eigvalsh(without.information) > -1e-6 * np.max(without.information))


def test_together_logs_know_more_and_each_knows_it(together: Together) -> None:
    sigma = np.sqrt(np.diagonal(together.known.honest))
    for own, done, result in zip(together.kept, together.rounds, together.alone, strict=True):
        rows = ~columns_of(result.blocks, own=True)
        information = of_smoothed(result, together.shared).information
        alone = known_by(together.shared, information, own.information.step)
        less = alone.cov - together.known.cov
        scale = np.sqrt(np.diagonal(alone.cov))
        assert np.min(np.linalg.eigvalsh(less / scale[:, None] / scale)) > -0.05  # each at its own
        before = np.sqrt(np.diagonal(result.calibration_cov))[rows]
        assert np.median(sigma / before) < 0.95
        joint = joint_posterior(own, done, result.blocks)
        after = np.sqrt(np.diagonal(joint.calibration_cov))[rows]
        np.testing.assert_allclose(after, sigma, rtol=0.2)  # but for who met what iron
        assert joint.blocks is result.blocks


def test_logs_of_one_site_agree(together: Together) -> None:
    alone = [of_smoothed(result, together.shared).information for result in together.alone]
    for logs in (alone, [log.information for log in together.kept]):
        result = compared(together, logs)
        assert result.of_log == ((), ())
        assert result.excess == 1.0
        assert np.max(result.sigmas) < 4.0


def test_a_log_that_says_otherwise_is_named_with_its_beacon(together: Together) -> None:
    """What two logs say thrice, and once with beacon C elsewhere."""
    logs = [log.information for log in together.kept]
    (place,) = (b for b in together.shared.blocks if b.name == "C.position")
    moved = logs[0].step.copy()
    moved[place.columns.start] += 0.05  # m
    liar = LogInformation(moved, logs[0].part)
    result = compared(together, [*logs, liar])
    assert result.of_log[:2] == ((), ())
    (finding,) = result.of_log[2]
    assert finding.code == "logs_disagree"
    assert "Log c contradicts the other logs: it moves C." in finding.text
    assert "beacon C was moved" in finding.text
    assert result.excess > 2.0
