"""The calibration that several logs share: estimated from all of them, and from all but one.

In each round all logs are linearised at one calibration, that of the sum over all: a round is a
Gauss-Newton step of one graph of all logs, with only one log in memory at a time.  (Linearised each
at its own solution, many short logs need three times the rounds: the errors of their linearisations
then do not cancel.)  In the end each log is solved with the survey and the other logs as its prior.
What the others know is added, never the own part subtracted from the sum over all: that would lose
the directions that logs determine well.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.model.correlation import Correlation, joined
from magfusion.model.parameters import Block, Calibration, prior_sigma, retract
from magfusion.model.prior import parameters_of, prior_sqrt_information
from magfusion.model.site import Site
from magfusion.units import Array, IntArray

NARROW = 1e-3  # of a sigma; a log does not move a prior so narrow


@dataclass(frozen=True, eq=False)
class Shared:
    """Declared calibration parameters that logs share."""

    declared: Calibration
    blocks: tuple[Block, ...]
    # (s, s), information of the survey; by default that of the declared site
    prior: Array | None = None

    @cached_property
    def information(self) -> Array:
        """Of the survey alone, shape (s, s)."""
        if self.prior is not None:
            return self.prior
        whitening = prior_sqrt_information(self.declared.site, self.blocks)
        return np.asarray(whitening.T @ whitening)

    @cached_property
    def _rotations(self) -> IntArray:
        """Columns of the rotations, shape (rotations, 3)."""
        columns = [b.columns.start for b in self.blocks if b.parameter.is_rotation]
        return np.array(columns, dtype=np.int64)[:, None] + np.arange(3)

    def moved(self, step: Array) -> Calibration:
        """Return the calibration after a step."""
        return retract(self.declared, self.blocks, step)

    def after(self, at: Array, step: Array) -> Array:
        """Return the step from the declared calibration after another step from ``at``."""
        result, columns = at + step, self._rotations
        first, second = (Rotation.from_rotvec(each[columns]) for each in (at, step))
        result[columns] = (first * second).as_rotvec()
        return np.asarray(result)

    def between(self, before: Array, after: Array) -> Array:
        """Return the step from one calibration to another: the inverse of `after`."""
        result, columns = after - before, self._rotations
        first, second = (Rotation.from_rotvec(each[columns]) for each in (before, after))
        result[columns] = (first.inv() * second).as_rotvec()
        return np.asarray(result)


@dataclass(frozen=True, eq=False)
class SharedCalibration:
    """Estimate of the shared calibration."""

    step: Array  # (s,), from the declared calibration
    cov: Array  # (s, s), as estimators use it: by white noise alone
    # (s, c), change by one sigma of each parameter that is considered in every log
    by_common: Array
    # (s, s), covariance due to parameters that are considered separately in each log
    separate_errors: Array

    @property
    def honest(self) -> Array:
        """Covariance including considered parameters, shape (s, s)."""
        return self.cov + self.by_common @ self.by_common.T + self.separate_errors

    def of(self, columns: IntArray, common: IntArray) -> "SharedCalibration":
        """Return the marginal of some parameters.

        `columns`, `common` (s,), (c,): of the shared parameters, and of those considered in every
        log.
        """
        square, moved = np.ix_(columns, columns), self.by_common[columns]
        others = np.delete(moved, common, axis=1)
        return SharedCalibration(
            self.step[columns],
            self.cov[square],
            moved[:, common],
            self.separate_errors[square] + others @ others.T,
        )


@dataclass(frozen=True, eq=False)
class LogInformation:
    """Information of one log, or of several, on the shared calibration."""

    step: Array  # (s,), from the declared calibration to the linearisation point
    part: MarginalizedLog
    logs: Array | float = 1.0  # scalar or (s,), number of logs in the sum, that have each parameter

    @property
    def by_place(self) -> Array:
        """Covariance of the gradient, as if all logs in one place had met the same iron."""
        root = np.sqrt(np.broadcast_to(self.logs, self.step.shape))
        return np.asarray(root[:, None] * self.part.by_place * root)

    def among(
        self, size: int, columns: IntArray, common: IntArray, considered: int
    ) -> "LogInformation":
        """Return the same information on more parameters.

        `size`, `considered`: number of the shared parameters of all logs, and of those considered
        in every log. `columns`, `common` (s,), (c,): those of this log.
        """

        def spread(matrix: Array) -> Array:
            whole = np.zeros((size, size))
            whole[np.ix_(columns, columns)] = matrix
            return whole

        step, gradient, by_common = np.zeros(size), np.zeros(size), np.zeros((size, considered))
        logs = np.zeros(size)
        step[columns], gradient[columns], logs[columns] = self.step, self.part.gradient, self.logs
        by_common[np.ix_(columns, common)] = self.part.by_common
        part = MarginalizedLog(
            spread(self.part.information),
            gradient,
            by_common,
            spread(self.part.by_place),
            spread(self.part.by_log),
        )
        return LogInformation(step, part, logs)

    def taken_at(self, shared: Shared, step: Array) -> "LogInformation":
        """Return the same information at another linearisation point."""
        moved = self.part.information @ shared.between(self.step, step)
        part = replace(self.part, gradient=self.part.gradient - moved)
        return replace(self, step=step, part=part)


def total_information(
    shared: Shared, logs: Iterable[LogInformation], at: Array
) -> LogInformation | None:
    """Return the sum over logs, or over sums of logs, at one linearisation point.

    `logs`: only two are in memory at a time. `at` (s,): from the declared calibration to the
    linearisation point. Returned None for no log.
    """

    def both(a: LogInformation | None, b: LogInformation) -> LogInformation:
        if a is None:
            return b
        part = {k: v + getattr(b.part, k) for k, v in vars(a.part).items()}
        return LogInformation(at, MarginalizedLog(**part), a.logs + b.logs)

    return reduce(both, (one.taken_at(shared, at) for one in logs), None)


def known_by(shared: Shared, logs: LogInformation | None, at: Array) -> SharedCalibration:
    """Return the shared calibration from survey and logs after a Gauss-Newton step.

    `logs`: None for the survey alone. `at` (s,): from the declared calibration to the linearisation
    point of the step.
    """
    prior, unit = shared.information, prior_sigma(shared.blocks)
    information, gradient = prior.copy(), -prior @ at
    by_common, separate = np.zeros((len(at), 0)), np.zeros_like(prior)
    if logs is not None:
        logs = logs.taken_at(shared, at)
        total = logs.part
        information += total.information
        gradient += total.gradient
        by_common = total.by_common
        separate = logs.by_place + total.by_log
    cov = np.linalg.inv(unit[:, None] * information * unit)
    cov = unit[:, None] * (0.5 * (cov + cov.T)) * unit
    step = shared.after(at, cov @ gradient)
    return SharedCalibration(step, cov, cov @ by_common, cov @ separate @ cov)


def between(
    shared: Shared, old: LogInformation, new: LogInformation, share: float
) -> LogInformation:
    """Return the information of a log after a share of its change, linearised at the new point."""
    if share == 1.0:
        return new
    before = vars(old.taken_at(shared, new.step).part)
    part = {k: share * v + (1.0 - share) * before[k] for k, v in vars(new.part).items()}
    return LogInformation(new.step, MarginalizedLog(**part))


def narrowed(known: SharedCalibration) -> SharedCalibration:
    """Return an estimate as the prior of logs that are all linearised there."""
    return replace(known, cov=NARROW**2 * known.cov)


def apart_in_sigmas(one: Array, other: Array, cov: Array) -> float:
    """Return the root mean square of a difference over all directions, in sigmas of each."""
    scale = np.sqrt(np.diagonal(cov))
    step = (one - other) / scale
    solved = np.linalg.solve(cov / scale[:, None] / scale, step)
    return float(np.sqrt(max(float(step @ solved), 0.0) / len(step)))


def as_prior(
    known: SharedCalibration, shared: Shared, blocks: tuple[Block, ...]
) -> tuple[Block, ...]:
    """Return the blocks of a log, with the estimate as prior of those that are shared."""
    sigma, at = np.sqrt(np.diagonal(known.cov)), {b.key: b.columns for b in shared.blocks}
    return tuple(b._replace(sigma=sigma[at[b.key]]) if b.key in at else b for b in blocks)


def with_prior(known: SharedCalibration, shared: Shared, declared: Calibration) -> Calibration:
    """Return a log's declared calibration with the mean and correlation of the estimate."""
    sigma, own = np.sqrt(np.diagonal(known.cov)), parameters_of(shared.blocks)
    fresh = Correlation(tuple(own), known.cov / sigma[:, None] / sigma)
    moved = retract(declared, shared.blocks, known.step)
    before = declared.site.correlation
    rest = before and before.kept(lambda p: p not in own)
    return replace(moved, site=replace(moved.site, correlation=joined([fresh, rest])))


def uncoupled(site: Site, shared: tuple[Block, ...]) -> Site:
    """Return a site without correlation between shared parameters and those of each log."""
    if site.correlation is None:
        return site
    own = set(parameters_of(shared))
    parts = [
        site.correlation.kept(lambda p: p in own),
        site.correlation.kept(lambda p: p not in own),
    ]
    return replace(site, correlation=joined(parts))
