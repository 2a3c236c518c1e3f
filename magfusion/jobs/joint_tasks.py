"""Tasks of one log among several, in any process: alone, a round, and the final pass.

The workers share the output directory: states and information stay in its files, and the driver
sends and receives names and figures.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.calendar import (
    Calendar,
    LogBlocks,
    PlatformCalibration,
    SiteChange,
    names_of,
)
from magfusion.estimation.batch.joint import (
    LogInformation,
    Shared,
    SharedCalibration,
    between,
    known_by,
    narrowed,
    total_information,
    uncoupled,
)
from magfusion.estimation.batch.joint_log import (
    after_round,
    joint_posterior,
    of_smoothed,
    solve_round,
)
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.integrity.logs_agree import Deviation, deviation
from magfusion.estimation.posterior.marginalized_log import shared_blocks
from magfusion.estimation.posterior.noise_tuning import Tuned
from magfusion.jobs.failure import reason_of
from magfusion.jobs.inputs import Job, named, read_job, read_site
from magfusion.jobs.joint_kept import (
    Kept,
    load_information,
    load_log,
    save_information,
    save_log,
    written_by_worker,
)
from magfusion.jobs.result_directory import claim
from magfusion.model.parameters import GROUPS, Block, initial_calibration
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Trust, Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.units import Array, Rate

ROUNDS = "rounds"  # directory beside the kept solutions


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
    platform : int
        Index of its platform among those of all logs.
    """

    name: str
    job: Job
    smoother: SmootherSettings
    kept: Path
    key: str
    platform: int = 0

    def state(self, rounds: int) -> Path:
        """Return the file of the log after some rounds."""
        return self.kept.parent / ROUNDS / f"{self.name}.{rounds}.npz" if rounds else self.kept

    def information(self, rounds: int) -> Path:
        """Return the file of what the log knows of the shared calibration after some rounds."""
        return self.kept.parent / ROUNDS / f"{self.name}.{rounds}.information.npz"


class Alone(NamedTuple):
    """A log smoothed alone.

    Parameters
    ----------
    time : float
        Of its first sample (s, Unix).
    noise : tuple of Tuned
    facts : dict
        Of the table of logs.
    """

    time: float
    noise: tuple[Tuned, ...]
    facts: dict[str, Any]


@dataclass(frozen=True)
class SiteFiles:
    """Files of a site with its platforms, and its changes: the calendar, in a few bytes.

    `jobs`: one of each platform.
    """

    jobs: tuple[Job, ...]
    smoother: SmootherSettings
    changes: tuple[SiteChange, ...] = ()

    def calendar(self) -> Calendar:
        """Return the parameters of all logs."""
        platforms = (
            _platform(job, self.smoother, job.declared_path.stat().st_mtime_ns) for job in self.jobs
        )
        return _calendar(tuple(platforms), self.changes)


@lru_cache(maxsize=16)
def _platform(job: Job, smoother: SmootherSettings, _modified: int) -> PlatformCalibration:
    """Return the declared calibration of a platform, read once in a process."""
    site, shared = shared_site(read_site(job), smoother)
    return PlatformCalibration(shared, considered_of(site, smoother))


@lru_cache(maxsize=4)
def _calendar(
    platforms: tuple[PlatformCalibration, ...], changes: tuple[SiteChange, ...]
) -> Calendar:
    return Calendar(platforms, changes)


@dataclass(frozen=True, eq=False)
class RoundTask:
    """One of several logs, and where to find its prior from logs.

    Parameters
    ----------
    rounds : int
        Number of rounds before.
    logs : tuple of Path
        Information of all logs in a round, else of all others; each or in sums.
    at : ndarray, shape (s,)
        From the declared calibration to the linearisation point.
    share : float
        Of the change of the information.
    """

    files: SiteFiles
    task: LogTask
    rounds: int
    logs: tuple[Path, ...]
    at: Array
    share: float = 1.0

    def read(self) -> tuple[Log, Site, Shared, Kept]:
        """Return the log, its site, the shared parameters, and the log's data so far."""
        log, site, shared = read_shared(self.task)
        path = self.task.state(self.rounds)
        return log, site, shared, written_by_worker(path, load_log(path, self.task.key, site))

    def prior(self) -> SharedCalibration:
        """Return the estimate of the log's parameters from these logs and the survey."""
        calendar = self.files.calendar()
        known = known_by(calendar.shared, added(calendar, self.logs, self.at), self.at)
        blocks = load_information(self.task.information(self.rounds)).blocks
        assert blocks is not None
        return known.of(*calendar.columns(blocks))


@dataclass(frozen=True, eq=False)
class SumTask:
    """Information of some logs, to be added.

    `at` (s,): from the declared calibration to the linearisation point.
    """

    files: SiteFiles
    parts: tuple[Path, ...]
    at: Array
    result: Path


@dataclass(frozen=True, eq=False)
class LastTask:
    """The final pass of a log, in the joint solution.

    Parameters
    ----------
    excess : float
        Factor on the variances, as the logs contradict each other.
    findings : tuple of Finding
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


def shared_site(site: Site, smoother: SmootherSettings) -> tuple[Site, Shared]:
    """Return a site without correlation of shared and own parameters, and the former."""
    site = uncoupled(site, shared_of(site, smoother).blocks)
    return site, shared_of(site, smoother)


def read_shared(task: LogTask) -> tuple[Log, Site, Shared]:
    """Return a log, its site, and the parameters it shares with the others."""
    log, site = read_job(task.job)
    return replace(log, name=task.name), *shared_site(site, task.smoother)


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


def considered_of(site: Site, smoother: SmootherSettings) -> tuple[Block, ...]:
    """Return the parameters that are considered in every log of a site."""
    return shared_blocks(smoother.blocks(site)[1])


def blocks_of(log: Log, site: Site, shared: Shared, task: LogTask) -> LogBlocks:
    """Return the names of a log's parameters."""
    considered = considered_of(site, task.smoother)
    streams = [s.time for s in (log.imu, log.waveform, log.fields) if s is not None]
    time = 1e-9 * log.epoch_ns + min(float(time[0]) for time in streams if len(time))
    return LogBlocks(time, task.platform, names_of(shared.blocks), names_of(considered))


def alone(task: LogTask, _rng: np.random.Generator) -> Alone:
    """Smooth a log alone and store it, or load the stored result."""
    log, site, shared = read_shared(task)
    kept, blocks = load_log(task.kept, task.key, site), blocks_of(log, site, shared, task)
    if kept is None:
        try:
            with named(task.job.log_path):
                result = smooth(log, site, task.smoother)
        except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
            reason = {"code": "no_solution", "reason": reason_of(error)}
            return Alone(blocks.time, (), {"verdict": str(Verdict.FAILED), **reason})
        detected = np.flatnonzero(np.any(result.fields.valid, axis=0))
        names = {result.fields.channels[c][0] for c in detected}
        honest, trust = judge_result(result, log)
        facts = table_facts(honest, trust, log) | {"heard": sorted(names)}
        kept = Kept(of_smoothed(result, shared), facts)
        save_log(task.kept, task.key, kept)
    save_information(task.information(0), kept.log.information, blocks)
    return Alone(blocks.time, kept.log.noise, kept.facts)


def one_round(given: RoundTask, _rng: np.random.Generator) -> None:
    """Solve a log at the common calibration, and store it."""
    log, site, shared, kept = given.read()
    task, before = given.task, kept.log.information
    done = solve_round(log, site, task.smoother, kept.log, shared, narrowed(given.prior()))
    after = after_round(kept.log, done, shared)
    known = between(shared, before, after.information, given.share)
    save_log(
        task.state(given.rounds + 1), task.key, Kept(replace(after, information=known), kept.facts)
    )
    save_information(task.information(given.rounds + 1), known, blocks_of(log, site, shared, task))


def added(calendar: Calendar, paths: Iterable[Path], at: Array) -> LogInformation | None:
    """Return the sum of the information in some files."""
    every = (load_information(path).whole(calendar) for path in paths)
    return total_information(calendar.shared, every, at)


def sum_of(given: SumTask, _rng: np.random.Generator) -> Path:
    """Add the information of some logs, and return the path of the sum."""
    total = added(given.files.calendar(), given.parts, given.at)
    assert total is not None
    save_information(given.result, total)
    return given.result


def from_others(given: RoundTask, _rng: np.random.Generator) -> Deviation:
    """Return the deviation of a log from the others."""
    calendar, others = given.files.calendar(), given.logs
    own = given.task.information(given.rounds)
    total = added(calendar, (own, *others), given.at)
    assert total is not None
    rest = added(calendar, others, given.at)
    return deviation(calendar.shared, total, rest, given.at)


def last(given: LastTask, _rng: np.random.Generator) -> dict[str, Any]:
    """Assess a log in the joint solution, write its results, and return its row of the table."""
    own = given.round
    log, site, shared, kept = own.read()
    done = solve_round(log, site, own.task.smoother, kept.log, shared, own.prior())
    result = joint_posterior(kept.log, done, own.task.smoother.blocks(site)[0])
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
