"""The jobs as functions: files in, a directory of results out."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.evaluation.errors import trajectory_errors
from magfusion.fixes.ambiguity import relations
from magfusion.fixes.fix import Fixes
from magfusion.fusion.batch import Smoothed, SmootherSettings, smooth
from magfusion.fusion.inertial import motion_at
from magfusion.fusion.self_survey import smooth_and_place
from magfusion.fusion.source import first_fixes, phasors
from magfusion.job import Job, claim, named, read_estimate, read_job
from magfusion.parameters import initial_calibration
from magfusion.records.fix_table import write_hypotheses
from magfusion.records.log import write_log
from magfusion.records.open import open_log
from magfusion.records.rosbag import BAG_SUFFIXES, Topics
from magfusion.records.samples import Log
from magfusion.records.trajectory_table import write_trajectory
from magfusion.records.tum import write_tum
from magfusion.refinement import findings, refined_site
from magfusion.report import (
    Figures,
    compared_with_truth,
    dropped_figures,
    error_figures,
    fix_figures,
    placement_figures,
    smoothed_figures,
    write_report,
)
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.site import Site
from magfusion.site_file import save_site
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.view import write_recording

DIVERGED = 3.0  # whitened residual, one where noise and model are as declared
Report = Callable[[str, int, int], None]


def quiet(_stage: str, _done: int, _total: int) -> None:
    """Tell nobody of the progress."""


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
    claimed = claim(job.output, "smooth", "fix")
    log, site = read_job(job, unknown=True)
    began = time.perf_counter()
    settings = replace(settings, lockin=job.lockin)
    try:
        with named(job.log_path):
            result, placed = smooth_and_place(log, site, settings, report)
        _refuse_divergence(result)
    except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
        reason = _reason(error)
        if any(beacon.unknown is not None for beacon in site.beacons):
            raise EstimationError(f"{job.log_path}: {reason}") from error
        with claimed as directory:
            _save_fixes_instead(directory, job, log, site, reason)
        raise EstimationError(
            f"{job.log_path}: {reason}; the single-epoch fixes were saved in {job.output}"
        ) from error
    figures: Figures = {"job": "smooth", "log": log.name, "coupling": settings.coupling}
    figures |= smoothed_figures(result)
    figures["elapsed_s"] = time.perf_counter() - began
    errors, compared = compared_with_truth(result.states, log)
    figures |= compared | placement_figures(placed, result.calibration.site)
    if errors is not None and not placed:
        figures |= _held_figures(log, site, settings, result)
    told = findings(result.declared, result.calibration, result.blocks, result.calibration_cov)
    refined = refined_site(
        result.calibration, result.blocks, result.calibration_cov, told, log.name
    )
    written = at_imu_rate(result, log) if imu_rate else result.states
    with claimed as directory:
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
        write_report(directory, figures)
    return figures


def _held_figures(log: Log, site: Site, settings: SmootherSettings, result: Smoothed) -> Figures:
    """Errors with the surveyed calibration held: what estimating it was worth."""
    kept = ("phase", "time-offset")
    if all(block.group in kept for block in result.blocks):
        return {}
    try:
        held = smooth(log, site, replace(settings, estimate=kept))
    except RuntimeError as error:
        return {"held_failed": _reason(error)}
    assert log.truth is not None
    return error_figures(trajectory_errors(held.states, log.truth), prefix="held_")


def _refuse_divergence(result: Smoothed) -> None:
    """Refuse a result that neither converged nor explains the fields, or had no start."""
    residual = (
        float(np.sqrt(np.nanmean(result.residual**2)))
        if np.isfinite(result.residual).any()
        else 0.0
    )
    if not result.converged and residual > DIVERGED:
        raise EstimationError(
            f"the smoother did not converge (residual {residual:.3g} where about 1 is expected):"
            " add a beacon or a coil, or check the survey"
        )
    if not result.converged and not result.start.determined.any():
        # The start was arbitrary then: where the loop happened to stop, it still is.
        raise EstimationError(
            "no epoch alone determines its pose, and the motion did not either (the smoother did"
            " not converge): add a beacon or a coil"
        )


def _reason(error: RuntimeError) -> str:
    if isinstance(error, EstimationError):
        return str(error)
    if "Indeterminate" in str(error):
        return "the measurements leave a direction of the motion open: add a beacon or a coil"
    raise error


def _save_fixes_instead(directory: Path, job: Job, log: Log, site: Site, reason: str) -> None:
    samples, dropped = phasors(log, site, job.lockin)
    fixes = first_fixes(samples, log, initial_calibration(site, float(np.mean(samples.time))))
    figures: Figures = {"job": "smooth", "log": log.name, "failed": reason}
    figures |= fix_figures(fixes, site) | dropped_figures(dropped)
    _write_fix_result(directory, log, site, fixes, figures)


def _write_fix_result(
    directory: Path, log: Log, site: Site, fixes: Fixes, figures: Figures
) -> Figures:
    """Write the fixes; return the figures with the errors against the truth."""
    best = fixes.best()
    errors, compared = compared_with_truth(best, log)
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
        relations(fixes, site).label,
    )
    write_recording(directory / "run.rrd", site, best, truth=log.truth, errors=errors)
    write_report(directory, figures | compared)
    return figures | compared


def run_fix(job: Job, *, free: tuple[str, ...] = (), report: Report = quiet) -> Figures:
    """Fix the pose at every epoch on its own: every hypothesis, best first.

    Parameters
    ----------
    job : Job
    free : tuple of str
        What is found beside the pose, as in `magfusion.fixes.likelihood.fix_epochs`.
    report : callable
        Told stage, steps done and steps in all.

    Raises
    ------
    InputError, EstimationError
    """
    claimed = claim(job.output, "smooth", "fix")
    log, site = read_job(job)
    began = time.perf_counter()
    report("demodulating", 0, 2)
    with named(job.log_path):
        samples, dropped = phasors(log, site, job.lockin)
    report("fixing", 1, 2)
    calibration = initial_calibration(site, float(np.mean(samples.time)))
    fixes = first_fixes(samples, log, calibration, free)
    report("done", 2, 2)
    figures: Figures = {"job": "fix", "log": log.name}
    figures |= fix_figures(fixes, site) | dropped_figures(dropped)
    figures["elapsed_s"] = time.perf_counter() - began
    with claimed as directory:
        return _write_fix_result(directory, log, site, fixes, figures)


def run_demodulate(job: Job, *, report: Report = quiet) -> Figures:
    """Demodulate a waveform: a log that holds phasors in its place.

    Raises
    ------
    InputError
        Where the log has no waveform, or no window of it is usable.
    """
    claimed = claim(job.output, "demodulate")
    log, site = read_job(job)
    if log.waveform is None:
        raise InputError(
            f"{job.log_path}: holds no magnetometer.parquet to demodulate; give the raw log"
        )
    report("demodulating", 0, 1)
    with named(job.log_path):
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
        figures[f"sigma_{beacon}_{tone}_t"] = float(np.median(sigma[samples.valid[:, c], c]))
    figures |= dropped_figures(dropped)
    with claimed as directory:
        write_log(replace(log, waveform=None, fields=samples), directory)
        save_site(site, directory / "site.yaml")
        write_report(directory, figures)
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
    claimed = claim(output, "simulate")
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
        "iron_spheres": config.iron,
    }
    with claimed as directory:
        write_log(simulated.log, directory)
        save_site(site, directory / "site.yaml")
        save_site(simulated.true_site, directory / "true_site.yaml")
        write_report(directory, figures)
    return figures


def _read_truth(path: Path, topics: Topics | None) -> tuple[Trajectory, int]:
    """Return the truth, and the zero of the clock (ns) from which its times count."""
    is_result = (path / "trajectory.parquet").is_file()
    if is_result or not (path.is_dir() or path.suffix in BAG_SUFFIXES):
        return read_estimate(path), 0
    log = open_log(path, topics=topics)
    if log.truth is None:
        raise InputError(f"{path}: holds no truth; name a log, TUM file or table that does")
    return log.truth, log.epoch_ns


def run_evaluate(estimate: Path, truth: Path, topics: Topics | None = None) -> Figures:
    """Compare a trajectory with a truth.

    Parameters
    ----------
    estimate : Path
        As `read_estimate`.
    truth : Path
        The same, or a log with truth.
    topics : Topics, optional
        Of a truth that is a bag.

    Raises
    ------
    InputError
        Where one of the two cannot be read, or they do not overlap in time.
    """
    true, epoch_ns = _read_truth(truth, topics)
    found = read_estimate(estimate, epoch_ns)
    with named(f"{estimate} against {truth}"):
        return {"job": "evaluate"} | error_figures(trajectory_errors(found, true))
