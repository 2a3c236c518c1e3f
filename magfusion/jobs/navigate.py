"""The job that navigates along a log as if it were live: states as they were when made."""

import hashlib
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.evaluation.errors import TrajectoryErrors
from magfusion.fusion.batch import Report
from magfusion.fusion.online import Navigator, NavigatorSettings, restored
from magfusion.fusion.state import MOTION, State
from magfusion.job import Job, claim, named, read_job
from magfusion.jobs.checkpoint import (
    CHECKPOINT,
    ROWS,
    Checkpoint,
    RowFile,
    read_checkpoint,
    write_checkpoint,
)
from magfusion.jobs.replay import PIECE, Replay, feed, paced
from magfusion.parameters import choose_blocks, dimension, initial_calibration
from magfusion.records.samples import Log
from magfusion.records.trajectory_table import write_trajectory
from magfusion.records.tum import write_tum
from magfusion.refinement import Finding, findings, refined_site
from magfusion.report import AMBIGUOUS_CHI_SQUARE, Figures, compared_with_truth, write_report
from magfusion.site import Site
from magfusion.site_file import save_site
from magfusion.trajectory import Trajectory
from magfusion.units import Array
from magfusion.view import write_recording
from magfusion.view_live import LiveView, open_live_view

_KIND, _LATENCY, _TIME = 0, 1, 2
_ROTATION, _POSITION, _VELOCITY = slice(3, 12), slice(12, 15), slice(15, 18)
_ACCEL_BIAS, _GYRO_BIAS, _COV = slice(18, 21), slice(21, 24), slice(24, 60)
_STATE_WIDTH = 60
_CURRENT, _LAGGED = 0.0, 1.0


@dataclass(frozen=True)
class NavigateSettings:
    """How a log is navigated.

    Parameters
    ----------
    navigator : NavigatorSettings
    realtime : bool
        Pace by the log's clock.
    live : bool
        Show the states in the viewer as they are made.
    resume : bool
        Go on from the checkpoint of a run that was killed, if there is one.
    checkpoint : Path, optional
        Default: in the output directory, while the job runs.
    every : float
        Between checkpoints (s of the log).
    """

    navigator: NavigatorSettings = field(default_factory=NavigatorSettings)
    realtime: bool = False
    live: bool = False
    resume: bool = False
    checkpoint: Path | None = None
    every: float = 30.0


def run_navigate(job: Job, settings: NavigateSettings, report: Report) -> Figures:
    """Navigate along a log: trajectories, refined site, report and recording.

    Parameters
    ----------
    job : Job
    settings : NavigateSettings
    report : callable
        Told stage, steps done and steps in all.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        For anything in the input that a user must mend.
    EstimationError
        Where the log leads to no state.
    """
    claimed = claim(job.output, "navigate")
    log, site = read_job(job)
    if settings.navigator.earth and log.waveform is None:
        raise InputError(
            f"{job.log_path}: holds only phasors, which know nothing of the Earth field; give the"
            " log with magnetometer.parquet, or leave --earth out"
        )
    place = job.output / CHECKPOINT if settings.checkpoint is None else settings.checkpoint
    made = _make_parent(place)
    run = _open_run(job, settings, log, site, place)
    try:
        with named(job.log_path):
            _advance(run, settings, report)
        rows = run.rows.rows()
        if not run.navigator.started:
            raise EstimationError(
                f"{job.log_path}: {len(run.replay) * PIECE:.3g} s of data lead to no state; add a"
                " beacon, or record longer"
            )
        figures, results = _results(settings, run, rows)
        with claimed as directory:
            _write(directory, log, results, figures)
    except (InputError, EstimationError):
        _clear(run, place, made)
        raise
    run.rows.close()
    if settings.checkpoint is not None:
        _clear(run, place, made)
    return figures


@dataclass(eq=False)
class _Run:
    replay: Replay
    site: Site
    navigator: Navigator
    rows: RowFile
    place: Path
    key: str
    position: int
    elapsed: float
    view: LiveView | None


def _make_parent(place: Path) -> list[Path]:
    """Make the checkpoint's directory; return what was made for it."""
    made = [p for p in (place.parent, *place.parent.parents) if not p.exists()]
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{place.parent}: cannot be written ({error.strerror}); give another path"
        ) from error
    return made


def _clear(run: _Run, place: Path, made: list[Path]) -> None:
    run.rows.close()
    place.unlink(missing_ok=True)
    run.rows.path.unlink(missing_ok=True)
    for directory in made:
        if not any(directory.iterdir()):
            directory.rmdir()


def _open_run(job: Job, settings: NavigateSettings, log: Log, site: Site, place: Path) -> _Run:
    key = _key(job, settings, log)
    found = read_checkpoint(place, key) if settings.resume else None
    rows_path = place.with_name(ROWS if place.name == CHECKPOINT else f"{place.name}.rows")
    width = _STATE_WIDTH + len(site.beacons)
    return _Run(
        replay=Replay(log),
        site=site,
        navigator=Navigator(site, settings.navigator)
        if found is None
        else restored(found.navigator),
        rows=RowFile(rows_path, width, 0 if found is None else found.rows),
        place=place,
        key=key,
        position=0 if found is None else found.position,
        elapsed=0.0 if found is None else found.elapsed,
        view=open_live_view(site) if settings.live else None,
    )


def _key(job: Job, settings: NavigateSettings, log: Log) -> str:
    """Return what two runs share that may go on from each other's checkpoints."""
    site_path = job.log_path / "site.yaml" if job.site_path is None else job.site_path
    told = hashlib.sha256(repr((settings.navigator, PIECE, log.epoch_ns)).encode())
    told.update(site_path.read_bytes())
    for stream in (log.imu, log.waveform, log.fields):
        if stream is not None:
            told.update(np.ascontiguousarray(stream.time).tobytes())
    return told.hexdigest()


def _advance(run: _Run, settings: NavigateSettings, report: Report) -> None:
    """Take in the pieces that are left, and leave a checkpoint from time to time."""
    began = time.perf_counter() - run.elapsed
    every = max(1, round(settings.every / PIECE))
    for k, piece in paced(run.replay, run.position, settings.realtime):
        if k % every == 0 and k > run.position:
            _save(run, k, time.perf_counter() - began)
        running = run.navigator.started
        before = time.perf_counter()
        feed(run.navigator, piece)
        states = run.navigator.take()
        spent = (time.perf_counter() - before) / max(len(states), 1)
        for state in states:
            # The first state comes of a whole smoother.
            _append(run, _CURRENT, state, spent if running else np.nan)
            if run.view is not None:
                run.view.show(state, run.navigator.distortion)
        for state in run.navigator.take_lagged():
            _append(run, _LAGGED, state, np.nan)
        if k % every == 0:
            report("navigating", k, len(run.replay))
    run.elapsed = time.perf_counter() - began


def _save(run: _Run, position: int, elapsed: float) -> None:
    rows = run.rows.settle()
    checkpoint = Checkpoint(run.key, position, rows, run.navigator.checkpoint(), elapsed)
    write_checkpoint(checkpoint, run.place)


def _append(run: _Run, kind: float, state: State, latency: float) -> None:
    level = run.navigator.distortion
    row = np.concatenate(
        [
            [kind, latency, state.time],
            state.world_from_body.ravel(),
            state.position_world,
            state.velocity_world,
            state.accel_bias_body,
            state.gyro_bias_body,
            state.cov[:6, :6].ravel(),
            [level.get(beacon.name, np.nan) for beacon in run.site.beacons],
        ]
    )
    run.rows.append(row)


@dataclass(frozen=True, eq=False)
class _Results:
    current: Trajectory
    lagged: Trajectory | None
    errors: TrajectoryErrors | None
    innovations: dict[str, tuple[Array, Array]]
    refined: Site


def _trajectory(rows: Array) -> Trajectory:
    return Trajectory(
        time=rows[:, _TIME],
        world_from_body=rows[:, _ROTATION].reshape(-1, 3, 3),
        position_world=rows[:, _POSITION],
        velocity_world=rows[:, _VELOCITY],
        gyro_bias_body=rows[:, _GYRO_BIAS],
        accel_bias_body=rows[:, _ACCEL_BIAS],
        pose_cov=rows[:, _COV].reshape(-1, 6, 6),
    )


def _results(settings: NavigateSettings, run: _Run, rows: Array) -> tuple[Figures, _Results]:
    log = run.replay.log
    own = rows[rows[:, _KIND] == _CURRENT]
    smoothed = rows[rows[:, _KIND] == _LAGGED]
    current = _trajectory(own)
    lagged = _trajectory(smoothed) if len(smoothed) else None
    told, refined = _calibration(run, settings.navigator)
    errors, compared = compared_with_truth(current, log)
    figures = {"job": "navigate", "log": log.name} | _settings_figures(settings.navigator)
    figures |= _run_figures(run, current) | compared
    if lagged is not None:
        figures["lagged_epochs"] = len(lagged)
        figures |= {f"lagged_{k}": v for k, v in compared_with_truth(lagged, log)[1].items()}
    figures |= _update_figures(own[:, _LATENCY], run.elapsed)
    for found in told:
        figures[found.name] = found.change
        figures[f"{found.name}_sigma"] = found.sigma
        figures[f"{found.name}_prior_sigma"] = found.prior_sigma
    figures["determined"] = [f.name for f in told if f.determined]
    figures["undetermined"] = [f.name for f in told if not f.determined]
    innovations = {
        beacon.name: (current.time, np.sqrt(own[:, _STATE_WIDTH + i]))
        for i, beacon in enumerate(run.site.beacons)
    }
    return figures, _Results(current, lagged, errors, innovations, refined)


def _calibration(run: _Run, settings: NavigatorSettings) -> tuple[list[Finding], Site]:
    """Return what the data said of the calibration, and the refined site."""
    state = run.navigator.state(-np.inf)
    blocks = choose_blocks(run.site, settings.estimate, earth=settings.earth)
    # What is held follows what is estimated.
    own = slice(MOTION, MOTION + dimension(blocks))
    cov = state.cov[own, own]
    declared = initial_calibration(run.site, state.calibration.reference_time)
    told = findings(declared, state.calibration, blocks, cov)
    return told, refined_site(state.calibration, blocks, cov, told, run.replay.log.name)


def _settings_figures(settings: NavigatorSettings) -> Figures:
    figures: Figures = {"estimator": settings.estimator, "delay_s": settings.delay}
    return figures | ({"lag_s": settings.lag} if settings.estimator == "smoother" else {})


def _run_figures(run: _Run, current: Trajectory) -> Figures:
    navigator = run.navigator
    rival = navigator.rival_chi_square
    figures: Figures = {
        "epochs": len(current),
        "duration_s": float(current.time[-1] - current.time[0]),
        "first_state_s": float(current.time[0]),
        "rival_chi_square": rival,
        "ambiguous": rival is not None and rival < AMBIGUOUS_CHI_SQUARE,
    }
    for reason, count in navigator.losses.items():
        figures["counted_" + reason.replace(":", "").replace(" ", "_")] = count
    for name, level in navigator.distortion.items():
        figures[f"distortion_{name}"] = level
    assert current.pose_cov is not None
    sigma = np.sqrt(np.diagonal(current.pose_cov, axis1=1, axis2=2))
    figures["position_sigma_median_m"] = float(np.median(sigma[:, 3:]))
    figures["attitude_sigma_median_deg"] = float(np.rad2deg(np.median(sigma[:, :3])))
    return figures


def _update_figures(latency: Array, elapsed: float) -> Figures:
    """Return how long an update took; the first state, which a smoother finds, is no update."""
    figures: Figures = {"elapsed_s": elapsed, "memory_mb": _memory_mb()}
    known = 1e3 * latency[np.isfinite(latency)]
    if len(known):
        figures["update_p50_ms"] = float(np.median(known))
        figures["update_p99_ms"] = float(np.percentile(known, 99))
        figures["update_max_ms"] = float(np.max(known))
    return figures


def _memory_mb() -> float | None:
    """Return the most memory that the process has had; None where the system does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10  # a macOS tells bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _write(directory: Path, log: Log, results: _Results, figures: Figures) -> None:
    write_tum(results.current, directory / "trajectory.tum", log.epoch_ns)
    write_trajectory(results.current, directory / "trajectory.parquet", log.epoch_ns)
    if results.lagged is not None:
        write_trajectory(results.lagged, directory / "lagged.parquet", log.epoch_ns)
    save_site(results.refined, directory / "site.yaml")
    write_recording(
        directory / "run.rrd",
        results.refined,
        results.current,
        truth=log.truth,
        errors=results.errors,
        innovations=results.innovations,
    )
    write_report(directory, figures)
