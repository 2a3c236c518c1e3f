"""The jobs as functions: files in, a directory of results out."""

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.evaluation.errors import TrajectoryErrors, trajectory_errors
from magfusion.fixes.fix import Fixes
from magfusion.fusion.batch import Smoothed, SmootherSettings, smooth
from magfusion.fusion.inertial import motion_at
from magfusion.fusion.source import first_fixes, phasors
from magfusion.parameters import initial_calibration
from magfusion.receiver.windows import LockinSettings
from magfusion.records.atomic import whole_directory
from magfusion.records.fields import order_channels
from magfusion.records.fix_table import write_hypotheses
from magfusion.records.log import write_log
from magfusion.records.open import open_log
from magfusion.records.samples import Log
from magfusion.records.trajectory_table import read_trajectory, write_trajectory
from magfusion.records.tum import read_tum, write_tum
from magfusion.refinement import findings, refined_site
from magfusion.report import (
    Figures,
    dropped_figures,
    error_figures,
    fix_figures,
    smoothed_figures,
)
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.site import Site
from magfusion.site_file import load_site, save_site
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.view import write_recording

Report = Callable[[str, int, int], None]


def quiet(_stage: str, _done: int, _total: int) -> None:
    """Tell nobody of the progress."""


@dataclass(frozen=True)
class Job:
    """What every job on a log needs.

    Parameters
    ----------
    log_path : Path
    site_path : Path, optional
        None takes ``site.yaml`` in the log's directory.
    output : Path
        Directory of the results; an earlier result there is replaced.
    lockin : LockinSettings, optional
    start, end : float, optional
        Part of the log to use, seconds since its epoch.
    """

    log_path: Path
    site_path: Path | None
    output: Path
    lockin: LockinSettings | None = None
    start: float | None = None
    end: float | None = None


def _is_result(path: Path) -> bool:
    return (path / "report.json").is_file()


def result_directory(output: Path) -> AbstractContextManager[Path]:
    """Yield a temporary directory that becomes ``output`` only if nothing fails.

    Raises
    ------
    InputError
        Where ``output`` exists and is not an earlier result.
    """
    return whole_directory(output, replaces=_is_result)


def read_job(job: Job) -> tuple[Log, Site]:
    """Read the log and the site of a job, and see that they belong together.

    Raises
    ------
    InputError
        For anything in either file that a user must mend.
    """
    if job.site_path is None and not (job.log_path / "site.yaml").is_file():
        # A log that is not there is the nearer cause.
        open_log(job.log_path, job.start, job.end)
        raise InputError(
            f"{job.log_path}: holds no site.yaml; name the site's file with --site SITE.yaml"
        )
    site = load_site(job.log_path / "site.yaml" if job.site_path is None else job.site_path)
    log = open_log(job.log_path, job.start, job.end)
    if log.fields is not None:
        log = replace(log, fields=order_channels(log.fields, site))
    return log, site


def _write_report(directory: Path, figures: Figures) -> None:
    text = json.dumps(figures, indent=1, allow_nan=False, default=float)
    (directory / "report.json").write_text(text + "\n")


def _errors(estimate: Trajectory, log: Log) -> TrajectoryErrors | None:
    return None if log.truth is None else trajectory_errors(estimate, log.truth)


def _innovations(result: Smoothed) -> dict[str, tuple[Array, Array]]:
    channels = result.fields.channels
    found = {}
    for name in dict.fromkeys(beacon for beacon, _ in channels):
        own = result.residual[:, [beacon == name for beacon, _ in channels]]
        seen = np.isfinite(own).all(axis=(1, 2))
        if np.any(seen):
            found[name] = (result.states.time[seen], np.sqrt(np.mean(own[seen] ** 2, axis=(1, 2))))
    return found


def at_imu_rate(result: Smoothed, log: Log) -> Trajectory:
    """Return the smoothed motion at every IMU sample between the first and the last epoch.

    The covariance is that of the epochs, interpolated.
    """
    states, offset = result.states, result.calibration.time_offset
    stamps = log.imu.time + offset
    wanted = stamps[(stamps >= states.time[0]) & (stamps <= states.time[-1])]
    dense = motion_at(states, log.imu, offset, result.declared.site.gravity, wanted)

    def between(values: Array | None) -> Array | None:
        if values is None:
            return None
        flat = values.reshape(len(values), -1)
        out = np.stack([np.interp(wanted, states.time, column) for column in flat.T], axis=1)
        return out.reshape(len(wanted), *values.shape[1:])

    return replace(
        dense,
        gyro_bias_body=between(states.gyro_bias_body),
        accel_bias_body=between(states.accel_bias_body),
        pose_cov=between(states.pose_cov),
    )


def run_smooth(
    job: Job, settings: SmootherSettings, *, imu_rate: bool = False, report: Report = quiet
) -> Figures:
    """Smooth a log: trajectory, refined site, report and recording.

    Parameters
    ----------
    job : Job
    settings : SmootherSettings
    imu_rate : bool
        Write the trajectory at every IMU sample rather than at the field epochs.
    report : callable
        Told stage, steps done and steps in all.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError, EstimationError
        In the latter case the single-epoch fixes have been saved in the output directory.
    """
    log, site = read_job(job)
    began = time.perf_counter()
    settings = replace(settings, lockin=job.lockin)
    try:
        result = smooth(log, site, settings, report)
    except EstimationError as error:
        _save_fixes_instead(job, log, site, error)
        raise EstimationError(
            f"{error}; the single-epoch fixes were saved in {job.output}"
        ) from error
    figures: Figures = {"job": "smooth", "log": log.name, "coupling": settings.coupling}
    figures |= smoothed_figures(result)
    figures["elapsed_s"] = time.perf_counter() - began
    errors = _errors(result.states, log)
    if errors is not None:
        figures |= error_figures(errors)
        figures |= _held_figures(log, site, settings, result)
    told = findings(result.declared, result.calibration, result.blocks, result.calibration_cov)
    refined = refined_site(
        result.calibration, result.blocks, result.calibration_cov, told, log.name
    )
    written = at_imu_rate(result, log) if imu_rate else result.states
    with result_directory(job.output) as directory:
        write_tum(written, directory / "trajectory.tum", log.epoch_ns)
        write_trajectory(written, directory / "trajectory.parquet", log.epoch_ns)
        save_site(refined, directory / "site.yaml")
        write_recording(
            directory / "run.rrd",
            refined,
            result.states,
            truth=log.truth,
            errors=errors,
            innovations=_innovations(result),
        )
        _write_report(directory, figures)
    return figures


def _held_figures(log: Log, site: Site, settings: SmootherSettings, result: Smoothed) -> Figures:
    """Errors with the surveyed calibration held: what estimating it was worth."""
    kept = ("phase", "time-offset")
    if all(block.group in kept for block in result.blocks):
        return {}
    held = smooth(log, site, replace(settings, estimate=kept))
    assert log.truth is not None
    return error_figures(trajectory_errors(held.states, log.truth), prefix="held_")


def _save_fixes_instead(job: Job, log: Log, site: Site, reason: EstimationError) -> None:
    samples, dropped = phasors(log, site, job.lockin)
    fixes = first_fixes(samples, log, initial_calibration(site, 0.0))
    figures: Figures = {"job": "smooth", "log": log.name, "failed": str(reason)}
    figures |= fix_figures(fixes) | dropped_figures(dropped)
    _write_fix_result(job.output, log, site, fixes, figures, _errors(fixes.best(), log))


def _write_fix_result(
    output: Path,
    log: Log,
    site: Site,
    fixes: Fixes,
    figures: Figures,
    errors: TrajectoryErrors | None,
) -> None:
    best = fixes.best()
    with result_directory(output) as directory:
        write_tum(best, directory / "trajectory.tum", log.epoch_ns)
        write_trajectory(best, directory / "trajectory.parquet", log.epoch_ns)
        write_hypotheses(
            directory / "fixes.parquet",
            log.epoch_ns,
            fixes.time,
            fixes.world_from_body,
            fixes.position_world,
            fixes.cost,
            fixes.probability,
            fixes.determined,
        )
        write_recording(directory / "run.rrd", site, best, truth=log.truth, errors=errors)
        _write_report(directory, figures)


def run_fix(job: Job, *, report: Report = quiet) -> Figures:
    """Fix the pose at every epoch on its own: every hypothesis, best first.

    Raises
    ------
    InputError, EstimationError
    """
    log, site = read_job(job)
    began = time.perf_counter()
    report("demodulating", 0, 2)
    samples, dropped = phasors(log, site, job.lockin)
    report("fixing", 1, 2)
    fixes = first_fixes(samples, log, initial_calibration(site, float(np.mean(samples.time))))
    report("done", 2, 2)
    figures: Figures = {"job": "fix", "log": log.name}
    figures |= fix_figures(fixes) | dropped_figures(dropped)
    figures["elapsed_s"] = time.perf_counter() - began
    errors = _errors(fixes.best(), log)
    if errors is not None:
        figures |= error_figures(errors)
    _write_fix_result(job.output, log, site, fixes, figures, errors)
    return figures


def run_demodulate(job: Job, *, report: Report = quiet) -> Figures:
    """Demodulate a waveform: a log that holds phasors in its place.

    Raises
    ------
    InputError
        Where the log has no waveform, or no window of it is usable.
    """
    log, site = read_job(job)
    if log.waveform is None:
        raise InputError(f"{job.log_path}: holds no magnetometer stream to demodulate")
    report("demodulating", 0, 1)
    samples, dropped = phasors(log, site, job.lockin)
    report("done", 1, 1)
    sigma = np.sqrt(np.trace(samples.phasor_cov, axis1=2, axis2=3) / 3.0)
    figures: Figures = {
        "job": "demodulate",
        "log": log.name,
        "epochs": len(samples),
        "window_s": float(np.median(samples.window)),
    }
    for c, (beacon, tone) in enumerate(samples.channels):
        figures[f"sigma_{beacon}_{tone}_t"] = float(np.median(sigma[:, c]))
    figures |= dropped_figures(dropped)
    with result_directory(job.output) as directory:
        write_log(replace(log, waveform=None, fields=samples), directory)
        save_site(site, directory / "site.yaml")
        _write_report(directory, figures)
    return figures


def run_simulate(site: Site, config: SimulationConfig, output: Path, seed: int) -> Figures:
    """Simulate a log, with truth, in the files a user has.

    Parameters
    ----------
    site : Site
        What the user would declare; written beside the log as ``site.yaml``.
    config : SimulationConfig
    output : Path
    seed : int

    Raises
    ------
    InputError
        Where ``output`` is in the way, or the configuration does not fit the site.
    """
    rng = np.random.default_rng(seed)
    imu = site.platform.imu
    if config.time_offset is None and config.perturb:
        drawn = imu.time_offset + imu.time_offset_sigma * float(rng.standard_normal())
        config = replace(config, time_offset=drawn)
    simulated = simulate_log(site, config, rng)
    figures: Figures = {
        "job": "simulate",
        "log": simulated.log.name,
        "seed": seed,
        "duration_s": config.duration,
        "imu_samples": len(simulated.log.imu),
        "time_offset_s": simulated.time_offset,
    }
    with result_directory(output) as directory:
        write_log(simulated.log, directory)
        save_site(site, directory / "site.yaml")
        save_site(simulated.true_site, directory / "true_site.yaml")
        _write_report(directory, figures)
    return figures


def read_estimate(path: Path, epoch_ns: int) -> Trajectory:
    """Read a trajectory from a result's directory, a TUM file or a Parquet table.

    Raises
    ------
    InputError
        Where there is none.
    """
    if path.is_dir() and (path / "trajectory.parquet").is_file():
        return read_trajectory(path / "trajectory.parquet", epoch_ns)
    if path.is_dir():
        log = open_log(path)
        if log.truth is None:
            raise InputError(f"{path}: holds neither a trajectory nor a truth; name another")
        return log.truth
    if path.suffix in (".parquet", ".csv"):
        return read_trajectory(path, epoch_ns)
    found = read_tum(path)
    return replace(found, time=found.time - epoch_ns * 1e-9)


def run_evaluate(estimate: Path, truth: Path) -> Figures:
    """Compare a trajectory with a truth.

    Raises
    ------
    InputError
    """
    log = (
        open_log(truth) if truth.is_dir() and not (truth / "trajectory.parquet").is_file() else None
    )
    epoch_ns = 0 if log is None else log.epoch_ns
    true = read_estimate(truth, epoch_ns)
    found = read_estimate(estimate, epoch_ns)
    return {"job": "evaluate"} | error_figures(trajectory_errors(found, true))
