"""Consistency of the logs of one site: each against the survey and all other logs."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.joint import LogInformation, Shared, known_by
from magfusion.estimation.data_checks.statistics import TEST_BUDGET, TOLERATED, holm, sigmas
from magfusion.estimation.integrity.priors_of_log import distance
from magfusion.model.parameters import BeaconParameter
from magfusion.model.trust import LISTED, Finding
from magfusion.units import Array


class LogAgreement(NamedTuple):
    """Result of a comparison of logs."""

    # of each log: empty, or its contradiction of the others
    of_log: tuple[tuple[Finding, ...], ...]
    excess: float  # factor by which variances are too small, one where they agree
    sigmas: Array  # (logs,), overall deviation of each log from the others, in sigmas of chance


class Deviation(NamedTuple):
    """Deviation of a log's calibration from that of the other logs."""

    # chi square, freedom and log probability of each block, then of all together
    tests: list[tuple[float, int, float]]
    by_block: list[float]  # largest change of each block, in its own sigmas

    @property
    def least(self) -> float:
        """Log probability of the least probable test."""
        return min(log_p for _, _, log_p in self.tests)


def agreement(
    shared: Shared, names: Sequence[str], deviations: Callable[[list[int]], Sequence[Deviation]]
) -> LogAgreement:
    """Test every log against the others; report those that contradict, the largest first.

    A log that contradicts the others makes each of them contradict the rest: once it is reported,
    the others are tested without it. `names`: of the logs, for the findings. `deviations`: returns
    the `deviation` of each log of a pool, given by their numbers.
    """
    pool, excess = list(range(len(names))), 1.0
    findings: list[tuple[Finding, ...]] = [() for _ in names]
    first = deviations(pool)
    result = dict(zip(pool, first, strict=True))
    while len(pool) > 1:
        ratios = _contradictions(result)
        if not ratios:
            break
        worst = min(ratios, key=lambda i: result[i].least)
        excess = max(excess, *ratios[worst])
        other = [names[i] for i in pool if i != worst]
        findings[worst] = (_finding(shared, names[worst], other, result[worst]),)
        pool.remove(worst)
        result = dict(zip(pool, deviations(pool), strict=True))
    far = np.array([float(sigmas(one.tests[-1][2])) for one in first])
    return LogAgreement(tuple(findings), excess, far)


def _contradictions(result: dict[int, Deviation]) -> dict[int, list[float]]:
    """Return the excess chi squares of each log that contradicts the others."""
    tests = [(i, test) for i, one in result.items() for test in one.tests]
    informative = holm([log_p for _, (_, _, log_p) in tests], TEST_BUDGET)
    out: dict[int, list[float]] = {}
    for (i, (square, freedom, _)), yes in zip(tests, informative, strict=True):
        if yes and square > TOLERATED * freedom:
            out.setdefault(i, []).append(square / freedom)
    return out


def deviation(
    shared: Shared, total: LogInformation, rest: LogInformation | None, at: Array
) -> Deviation:
    """Return the deviation of a log from the other logs of a pool.

    `total`: of all logs of the pool. `rest`: of the others. `at` (s,): from the declared
    calibration to the linearisation point.
    """
    every = known_by(shared, total, at)
    others = known_by(shared, rest, at)
    moved = every.by_common.copy()
    if rest is not None:
        moved -= others.by_common
    cov = others.cov - every.cov + moved @ moved.T + every.separate_errors + others.separate_errors
    scale = np.sqrt(np.diagonal(others.cov))
    change, cov = (every.step - others.step) / scale, cov / scale[:, None] / scale
    tests = [distance(change, cov, [block]) for block in shared.blocks]
    tests.append(distance(change, cov, list(shared.blocks)))
    certain = np.abs(change) / np.sqrt(np.maximum(np.diagonal(cov), 1e-4))
    return Deviation(tests, [float(np.max(certain[b.columns])) for b in shared.blocks])


def _finding(shared: Shared, name: str, others: list[str], one: Deviation) -> Finding:
    blocks = shared.blocks
    order = sorted(range(len(blocks)), key=lambda k: one.tests[k][2])[:LISTED]
    amounts = ", ".join(f"{blocks[k].name} by {one.by_block[k]:.1f} sigma" for k in order)
    square, freedom, _ = one.tests[-1]
    first = blocks[order[0]]
    cause = (
        f"beacon {first.owner} was moved or its drive changed"
        if isinstance(first.parameter, BeaconParameter)
        else "the magnetometer, its mounting or its surroundings changed"
    )
    recipient = f"log {others[0]}" if len(others) == 1 else "the other logs"
    text = (
        f"Log {name} contradicts {recipient}: it moves {amounts} from the estimate of {recipient}"
        f" and the survey (a total chi square of {square:.3g} on {freedom}). Probably {cause}"
        " between the logs. Refine the site separately by the logs before and after."
    )
    return Finding("logs_disagree", text, weight=float(sigmas(one.least)))
