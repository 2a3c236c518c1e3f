"""Tasks of one log among several, in any process: alone, a round, and the final pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.joint import Shared, SharedCalibration, uncoupled
from magfusion.estimation.batch.joint_log import (
    OfLog,
    after_round,
    joint_posterior,
    of_smoothed,
    solve_round,
)
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.posterior.marginalized_log import shared_blocks
from magfusion.jobs.failure import reason_of
from magfusion.jobs.inputs import Job, named, read_job
from magfusion.jobs.joint_kept import Alone, load_alone, save_alone
from magfusion.jobs.result_directory import claim
from magfusion.model.parameters import GROUPS, initial_calibration
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.units import Rate

if TYPE_CHECKING:
    from magfusion.model.trust import Risk


@dataclass(frozen=True)
class LogTask:
    """One of several logs.

    Parameters
    ----------
    name : str
        Its unique name among them.
    job : Job
        Its files, and the directory of its own results.
    kept : Path
        File of its solution alone.
    key : str
        Hash of all its inputs.
    """

    name: str
    job: Job
    smoother: SmootherSettings
    kept: Path
    key: str


@dataclass(frozen=True, eq=False)
class RoundTask:
    """One of several logs, with the prior from the others.

    Parameters
    ----------
    log : OfLog
    shared : Shared
    prior : SharedCalibration
        From all others and the survey.
    """

    task: LogTask
    log: OfLog
    shared: Shared
    prior: SharedCalibration


@dataclass(frozen=True, eq=False)
class LastTask:
    """The final pass of a log, in the joint solution.

    Parameters
    ----------
    excess : float
        Factor on the variances, as the logs contradict each other.
    `findings` : tuple of Finding
        On the consistency of this log with the others.
    writes : bool
        Whether its trajectory is written.
    """

    round: RoundTask
    excess: float
    findings: tuple[Finding, ...]
    writes: bool
    rate: Rate
    risk: Risk | None


def read_shared(task: LogTask) -> tuple[Log, Site, Shared]:
    """Return a log, its site, and the parameters it shares with the others."""
    log, site = read_job(task.job)
    site = uncoupled(site, shared_blocks(task.smoother.blocks(site)[0]))
    return replace(log, name=task.name), site, shared_of(site, task.smoother)


def together_settings(smoother: SmootherSettings) -> SmootherSettings:
    """Return the smoother settings for several logs.

    Several logs can determine parameters for which one log relies on the survey, and errors of
    these are common to all logs: all parameters with a sigma are estimated, unless the user
    declares otherwise.
    """
    return replace(smoother, estimate=GROUPS) if smoother.estimate is None else smoother


def shared_of(site: Site, smoother: SmootherSettings) -> Shared:
    """Return the parameters shared by the logs of a site."""
    blocks, _ = smoother.blocks(site)
    return Shared(initial_calibration(site, 0.0), shared_blocks(blocks))


def alone(task: LogTask, _rng: np.random.Generator) -> Alone:
    """Smooth a log alone and store it, or load the stored result."""
    log, site, shared = read_shared(task)
    known = load_alone(task.kept, task.key, site)
    if known is not None:
        return known
    try:
        with named(task.job.log_path):
            result = smooth(log, site, task.smoother)
    except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
        failed = {"verdict": str(Verdict.FAILED), "code": "no_solution", "reason": reason_of(error)}
        return Alone(None, failed)
    detected = np.any(result.fields.valid, axis=0).tolist()
    names = {name for (name, _), yes in zip(result.fields.channels, detected, strict=True) if yes}
    kept = of_smoothed(result, shared)
    honest, trust = judge_result(result, log)
    done = Alone(kept, table_facts(honest, trust, log) | {"heard": sorted(names)})
    save_alone(task.kept, task.key, done)
    return done


def one_round(task: RoundTask, _rng: np.random.Generator) -> OfLog:
    """Solve a log with the prior from the others."""
    log, site, _ = read_shared(task.task)
    done = solve_round(log, site, task.task.smoother, task.log, task.shared, task.prior)
    return after_round(task.log, done, task.shared)


def last(given: LastTask, _rng: np.random.Generator) -> dict[str, Any]:
    """Assess a log in the joint solution, write its results, and return its row of the table."""
    own = given.round
    log, site, _ = read_shared(own.task)
    blocks, _ = own.task.smoother.blocks(site)
    done = solve_round(log, site, own.task.smoother, own.log, own.shared, own.prior)
    result = joint_posterior(own.log, done, blocks)
    if given.writes:
        result, trust = _written(result, log, site, given)
    else:
        result, trust = judged_among(result, log, given)
    return table_facts(result, trust, log)


def _written(result: Smoothed, log: Log, site: Site, given: LastTask) -> tuple[Smoothed, Trust]:
    """Assess a log and write its results."""
    from magfusion.jobs.smooth_result import finished, with_errors, write_finished

    task = given.round.task
    done = finished(
        log, site, task.smoother, result, given.risk, excess=given.excess, findings=given.findings
    )
    done = with_errors(done, log)
    with claim(task.job.output, "smooth", overwrite=True) as whole:
        write_finished(whole, log, done, rate=given.rate)
    return done.result, done.trust


def judged_among(result: Smoothed, log: Log, given: LastTask) -> tuple[Smoothed, Trust]:
    """Assess a log, with the findings against the others."""
    result, trust = judge_result(result, log)
    assert result.states.pose_cov is not None
    wider = replace(result.states, pose_cov=given.excess * result.states.pose_cov)
    return replace(result, states=wider), trust | Trust(given.findings)


def table_facts(result: Smoothed, trust: Trust, log: Log) -> dict[str, Any]:
    """Return the facts of one log for the table of logs."""
    states, cov = result.states, result.states.pose_cov
    assert cov is not None
    sigma = np.median(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)).reshape(-1, 2, 3), (0, 2))
    first = trust.reasons[0] if trust.reasons else None
    facts: dict[str, Any] = {
        "verdict": str(trust.verdict),
        "code": first.code if first else "",
        "reason": first.text if first else "",
        "epochs": len(states),
        "duration_s": float(states.time[-1] - states.time[0]),
        "residual_rms": float(np.sqrt(np.nanmean(result.residual**2))),
        "position_sigma_m": float(sigma[1]),
        "attitude_sigma_deg": float(np.rad2deg(sigma[0])),
    }
    if log.truth is not None:
        try:
            errors = trajectory_errors(states, log.truth)
        except InputError:  # a truth elsewhere
            return facts
        if errors.has_position:
            facts |= {"ate_m": errors.ate, "aligned_ate_m": errors.aligned_ate}
        if errors.has_attitude:
            aligned = errors.aligned_attitude_rmse_deg
            facts |= {"attitude_rmse_deg": errors.attitude_rmse_deg}
            facts |= {"aligned_attitude_rmse_deg": aligned}
        if errors.nees is not None:
            facts["nees_mean"] = float(np.mean(errors.nees))
    return facts
