"""Changes of beacons and platforms between logs: hypothesis tests over the sequence of logs.

For each owner of parameters and each interval between two logs, the hypothesis that the parameters
are the same before and after is tested by a score test: the gradient of the later logs by these
parameters at the estimate of all logs.  It takes one pass over the logs for all owners.  The most
significant change is accepted, its owner has new parameters from then on, and the test is repeated.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.calendar import Calendar, LogBlocks, SiteChange
from magfusion.estimation.batch.joint import (
    LogInformation,
    Shared,
    SharedCalibration,
    known_by,
    total_information,
)
from magfusion.estimation.data_checks.statistics import (
    MIN_INFORMATION_RATIO,
    TEST_BUDGET,
    TOLERATED,
    holm,
    log_p_chi_square,
)
from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.model.parameters import Block, prior_sigma
from magfusion.units import Array, IntArray

MAX_CHANGES = 100
# Chi square by which a date may be less likely than the most likely one: three sigmas.
DATE_CHI_SQUARE = 9.0
NOT_DETECTED = 1e-6  # information of a log on parameters that it does not detect, by the survey's
DETERMINED_SHARE = 0.9  # of a parameter's direction within those that the logs determine

Load = Callable[[int], LogInformation]


class ChangeTest(NamedTuple):
    """Test of one owner's parameters between two successive logs."""

    owner: str  # among the parameters of all logs
    after: int  # number of logs before, in the order of their times
    # chi_square, freedom: with the errors of parameters that are only considered
    chi_square: float
    freedom: int
    # chi square of white noise alone: its difference between two times is that of the logs in
    # between
    likelihood_ratio: float

    @property
    def log_p(self) -> float:
        """Logarithm of the probability of a chi square at least this large."""
        return float(log_p_chi_square(self.chi_square, self.freedom))


class FoundChange(NamedTuple):
    """A change between logs."""

    change: SiteChange  # at the most likely time
    test: ChangeTest
    # last log that is certainly before, and first that is certainly after (s, Unix)
    between: tuple[float, float]


def find_changes(
    calendar: Calendar, logs: Sequence[LogBlocks], load: Load, at: Callable[[Calendar], Array]
) -> list[FoundChange]:
    """Return the changes that the logs show, the most significant first.

    `logs`: in the order of their times. `load`: returns the information of a log, by its index, on
    its own parameters. `at`: returns the linearisation point of a calendar's parameters, from the
    declared.
    """
    accepted: list[FoundChange] = []
    while len(accepted) < MAX_CHANGES:
        tests = change_tests(calendar, logs, load, at(calendar))
        significant = holm([test.log_p for test in tests], TEST_BUDGET)
        informative = [
            test
            for test, yes in zip(tests, significant, strict=True)
            if yes and test.chi_square > TOLERATED * test.freedom
        ]
        if not informative:
            break
        best = min(informative, key=lambda test: test.log_p)
        one = _accepted(calendar, logs, best, tests)
        accepted.append(one)
        calendar = replace(calendar, changes=(*calendar.changes, one.change))
    return accepted


def change_tests(
    calendar: Calendar, logs: Sequence[LogBlocks], load: Load, at: Array
) -> list[ChangeTest]:
    """Return the tests of all owners between all logs."""
    known, every = _estimate(calendar, logs, load, at)
    out = []
    before: LogInformation | None = None
    for i, one in enumerate(every()):
        if before is not None:
            for owner, score in known.scores(before, known.less(before)).items():
                test = _score_test(score)
                if test is not None:
                    out.append(ChangeTest(owner, i, *test))
        before = total_information(calendar.shared, filter(None, [before, one]), at)
    return out


class PeriodTest(NamedTuple):
    """Parameters of one owner in the logs of one period, against all other logs."""

    owner: str
    logs: int  # that detect it in the period
    # chi_square, freedom: of the difference
    chi_square: float
    freedom: int
    # difference, sigma: (k,), of its parameters, in the order of their blocks; NaN where the logs
    # do not determine it
    difference: Array
    sigma: Array


def period_tests(
    calendar: Calendar, logs: Sequence[LogBlocks], load: Load, at: Array, period: Sequence[int]
) -> dict[int, list[PeriodTest]]:
    """Return the test of each owner in each period against all other logs.

    `period`: number of each log's period.
    """
    known, every = _estimate(calendar, logs, load, at)
    parts: dict[int, LogInformation] = {}
    detected: Counter[tuple[int, str]] = Counter()
    for i, (log, one) in enumerate(zip(logs, every(), strict=True)):
        parts[period[i]] = known.added(parts.get(period[i]), one)
        owners = {calendar.owner(name, log.platform, log.time) for name in log.shared}
        detected.update((period[i], owner) for owner in owners)
    out: dict[int, list[PeriodTest]] = {}
    for which, part in parts.items():
        for owner, score in known.scores(known.less(part), part).items():
            test = _score_test(score)
            if test is not None:
                change = score.change(known.scale[known.columns[owner]])
                one_test = PeriodTest(owner, detected[which, owner], *test[:2], *change)
                out.setdefault(which, []).append(one_test)
    return out


class _Score(NamedTuple):
    """Gradient of some logs by new parameters of an owner, in units of the survey's sigmas."""

    gradient: Array  # (k,)
    information: Array  # (k, k), on the change, also the gradient's covariance due to white noise
    noise: Array  # (k, k), further covariance of the gradient

    def change(self, scale: Array) -> tuple[Array, Array]:
        """Return the change of the parameters and its sigma; NaN where it is not determined."""
        value, vector = np.linalg.eigh(self.information)
        yes = value > MIN_INFORMATION_RATIO
        inverse = (vector[:, yes] / value[yes]) @ vector[:, yes].T
        cov = inverse @ (self.information + self.noise) @ inverse
        known = np.sum(vector[:, yes] ** 2, axis=1) > DETERMINED_SHARE
        sigma = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
        scale = np.where(known, scale, np.nan)
        return scale * (inverse @ self.gradient), scale * sigma


class _Estimate(NamedTuple):
    """Estimate of the parameters of all logs."""

    total: LogInformation
    known: SharedCalibration
    shared: Shared
    step: Array  # from the linearisation point
    scale: Array
    columns: dict[str, IntArray]  # of each owner

    def added(self, total: LogInformation | None, one: LogInformation) -> LogInformation:
        """Return a sum."""
        result = total_information(self.shared, filter(None, [total, one]), one.step)
        assert result is not None
        return result

    def less(self, part: LogInformation) -> LogInformation:
        """Return all logs but some."""
        rest = {name: v - getattr(part.part, name) for name, v in vars(self.total.part).items()}
        return LogInformation(part.step, MarginalizedLog(**rest), self.total.logs - part.logs)

    def scores(self, before: LogInformation, after: LogInformation) -> dict[str, _Score]:
        """Return the scores of the owners that two parts of the logs detect.

        The gradient of the later logs by new parameters, at the estimate of all logs, combines the
        logs' gradients: with ``gain = after @ cov`` it is ``(1 - gain)`` times that of the later
        logs, less ``gain`` times those of the earlier logs and of the survey.
        """
        scale = self.scale
        units = scale[:, None] * scale
        gradient = scale * (after.part.gradient - after.part.information @ self.step)
        gain = scale[:, None] * (after.part.information @ self.known.cov) / scale
        information = units * after.part.information
        of_after = information.diagonal().copy()
        of_before = units.diagonal() * before.part.information.diagonal()
        information -= gain @ information
        by_later = np.eye(len(scale)) - gain
        # As if all earlier logs had met the same iron, and all later ones another.
        disturbed = [units * (side.by_place + side.part.by_log) for side in (before, after)]
        noise = gain @ disturbed[0] @ gain.T + by_later @ disturbed[1] @ by_later.T
        common = by_later @ (scale[:, None] * after.part.by_common)
        common -= gain @ (scale[:, None] * before.part.by_common)
        noise += common @ common.T
        out = {}
        for owner, own in self.columns.items():
            if np.any(of_before[own] > NOT_DETECTED) and np.any(of_after[own] > NOT_DETECTED):
                square = np.ix_(own, own)
                own_information = 0.5 * (information[square] + information[square].T)
                out[owner] = _Score(gradient[own], own_information, noise[square])
        return out


def _estimate(
    calendar: Calendar, logs: Sequence[LogBlocks], load: Load, at: Array
) -> tuple[_Estimate, Callable[[], Iterator[LogInformation]]]:
    """Return the estimate of all logs, and what yields the information of each."""
    shared = calendar.shared

    def every() -> Iterator[LogInformation]:
        return (calendar.whole(load(i), log).taken_at(shared, at) for i, log in enumerate(logs))

    total = total_information(shared, every(), at)
    assert total is not None
    known = known_by(shared, total, at)
    scale, columns = prior_sigma(shared.blocks), columns_by_owner(shared.blocks)
    return _Estimate(total, known, shared, shared.between(at, known.step), scale, columns), every


def columns_by_owner(blocks: Iterable[Block]) -> dict[str, IntArray]:
    """Return the columns of each owner."""
    columns: dict[str, list[int]] = {}
    for block in blocks:
        columns.setdefault(block.owner, []).extend(range(block.columns.start, block.columns.stop))
    return {owner: np.array(own) for owner, own in columns.items()}


def _score_test(score: _Score) -> tuple[float, int, float] | None:
    """Return chi square, freedom and likelihood ratio of determined directions; None of none."""
    value, vector = np.linalg.eigh(score.information)
    determined = vector[:, value > MIN_INFORMATION_RATIO]
    if not determined.shape[1]:
        return None
    cov = determined.T @ (score.information + score.noise) @ determined
    projected = determined.T @ score.gradient
    square = float(projected @ np.linalg.solve(cov, projected))
    return (
        square,
        len(projected),
        float(np.sum(projected**2 / value[value > MIN_INFORMATION_RATIO])),
    )


def _accepted(
    calendar: Calendar, logs: Sequence[LogBlocks], best: ChangeTest, tests: list[ChangeTest]
) -> FoundChange:
    """Return the accepted change, with the times between which it lies."""
    own = [test for test in tests if test.owner == best.owner]
    best = max(own, key=lambda test: test.likelihood_ratio)
    # Model errors, which reduce chi square, reduce the evidence of the logs in between as well.
    least = DATE_CHI_SQUARE * max(1.0, best.likelihood_ratio / best.chi_square)
    likely = {t.after for t in own if t.likelihood_ratio > best.likelihood_ratio - least}
    first = last = best.after
    while first - 1 in likely:
        first -= 1
    while last + 1 in likely:
        last += 1
    detects = [
        [n for n in log.shared if calendar.owner(n, log.platform, log.time) == best.owner]
        for log in logs
    ]
    log, (name, *_) = next((log, own) for log, own in zip(logs, detects, strict=True) if own)
    platform = -1 if name.beacon or name.site else log.platform
    times = [log.time if own else None for log, own in zip(logs, detects, strict=True)]
    before = max(time for time in times[:first] if time is not None)
    after, at = (min(time for time in times[k:] if time is not None) for k in (last, best.after))
    return FoundChange(SiteChange(name.owner, at, platform), best, (before, after))
