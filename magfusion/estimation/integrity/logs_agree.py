"""Consistency of the logs of one site: each against the survey and all other logs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.joint import LogReport, Shared, SharedCalibration, known_by
from magfusion.estimation.data_checks.statistics import TEST_BUDGET, holm, sigmas
from magfusion.estimation.integrity.priors_of_log import TOLERATED, distance
from magfusion.model.parameters import BeaconParameter
from magfusion.model.trust import Finding
from magfusion.units import Array

NAMED = 3  # parameters in a sentence


class LogAgreement(NamedTuple):
    """Result of a comparison of logs.

    Parameters
    ----------
    of_log : tuple of tuple of Finding
        Of each log: empty, or its contradiction of the others.
    excess : float
        Factor by which variances are too small, one where they agree.
    sigmas : ndarray, shape (logs,)
        Overall deviation of each log from the others, in sigmas of chance.
    """

    of_log: tuple[tuple[Finding, ...], ...]
    excess: float
    sigmas: Array


class _Distance(NamedTuple):
    """Chi square, freedom and log probability of each block, then of all together."""

    tests: list[tuple[float, int, float]]
    by_block: list[float]  # largest change, in its own sigmas


def agreement(
    shared: Shared, logs: Sequence[LogReport], names: Sequence[str], joint: SharedCalibration
) -> LogAgreement:
    """Test every log against the others; report those that contradict, the largest first.

    A log that contradicts the others makes each of them contradict the rest: once it is reported,
    the others are tested without it.

    Parameters
    ----------
    names : sequence of str
        Of the logs, for the findings.
    joint : SharedCalibration
        From all logs.
    """
    pool, excess = list(range(len(logs))), 1.0
    findings: list[tuple[Finding, ...]] = [() for _ in logs]
    first = [_distance(shared, logs, pool, i, joint) for i in pool]
    result = dict(zip(pool, first, strict=True))
    while len(pool) > 1:
        ratios = _contradictions(result)
        if not ratios:
            break
        worst = min(ratios, key=lambda i: _least(result[i]))
        excess = max(excess, *ratios[worst])
        other = [names[i] for i in pool if i != worst]
        findings[worst] = (_finding(shared, names[worst], other, result[worst]),)
        pool.remove(worst)
        result = {i: _distance(shared, logs, pool, i, joint) for i in pool}
    far = np.array([float(sigmas(one.tests[-1][2])) for one in first])
    return LogAgreement(tuple(findings), excess, far)


def _contradictions(result: dict[int, _Distance]) -> dict[int, list[float]]:
    """Return the excess chi squares of each log that contradicts the others."""
    tests = [(i, test) for i, one in result.items() for test in one.tests]
    informative = holm([log_p for _, (_, _, log_p) in tests], TEST_BUDGET)
    out: dict[int, list[float]] = {}
    for (i, (square, freedom, _)), yes in zip(tests, informative, strict=True):
        if yes and square > TOLERATED * freedom:
            out.setdefault(i, []).append(square / freedom)
    return out


def _least(one: _Distance) -> float:
    return min(log_p for _, _, log_p in one.tests)


def _distance(
    shared: Shared, logs: Sequence[LogReport], pool: list[int], which: int, joint: SharedCalibration
) -> _Distance:
    """Return the deviation of a log's calibration from that of the other logs of a pool."""
    every = known_by(shared, [logs[i] for i in pool], joint.step)
    others = known_by(shared, [logs[i] for i in pool if i != which], joint.step)
    none = np.zeros((len(joint.step), joint.by_common.shape[1]))
    before = others.by_common if others.by_common.shape[1] else none
    moved = every.by_common - before
    cov = others.cov - every.cov + moved @ moved.T + every.separate_errors + others.separate_errors
    scale = np.sqrt(np.diagonal(others.cov))
    change, cov = (every.step - others.step) / scale, cov / scale[:, None] / scale
    tests = [distance(change, cov, [block]) for block in shared.blocks]
    tests.append(distance(change, cov, list(shared.blocks)))
    certain = np.abs(change) / np.sqrt(np.maximum(np.diagonal(cov), 1e-4))
    return _Distance(tests, [float(np.max(certain[b.columns])) for b in shared.blocks])


def _finding(shared: Shared, name: str, others: list[str], one: _Distance) -> Finding:
    blocks = shared.blocks
    order = sorted(range(len(blocks)), key=lambda k: one.tests[k][2])[:NAMED]
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
    return Finding("logs_disagree", text, weight=float(sigmas(_least(one))))
