"""One estimator through one simulated world of hours: what it errs, what it takes; resumable."""

import os
import pickle
import resource
import shutil
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.evaluation.drift import ErrorSeries
from magfusion.files import whole_file
from magfusion.fusion.inertial import preintegration_parameters
from magfusion.fusion.online import Navigator, NavigatorSettings, restored
from magfusion.fusion.state import ACCEL_BIAS, GYRO_BIAS, State, pose_of
from magfusion.records.samples import ImuSamples
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.endurance import (
    Biases,
    EnduranceConfig,
    Stretch,
    World,
    draw_endurance,
    usual_drift,
)
from magfusion.simulation.inertial import BiasInstability
from magfusion.site import ImuModel, Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray

STRETCH = 10  # blocks that are made, navigated and written at once
PIECE = 10.0  # s that are fed at once
BARE = 6000  # samples of each stretch on which the bare loop is timed
# A good MEMS, beside the walk that the site declares.
INSTABILITY = BiasInstability(gyro=1e-5, accel=1e-4, time=300.0)
# What the user of such a drive declares of a moment (log): heat and wander.
MOMENT_SIGMA = {"current": 0.005, "voltage": 0.08}
Estimator = Literal["ekf", "smoother"]
PACE = ("time", "seconds", "updates", "memory_mib", "distortion", "bare_sample_seconds")


@dataclass(frozen=True)
class WorldTask:
    """One run.

    Parameters
    ----------
    world : int
    estimator : {'ekf', 'smoother'}
    hours : float
    seed : int
    drive : {'current', 'voltage'}
    phase_known : bool
        Whether the drives are declared synchronised; otherwise each beacon has a clock of its own.
    clock_rate : float
        Relative error of the clock that all drives share.
    place : str, optional
        Directory of what is needed to go on; None keeps nothing.
    """

    world: int
    estimator: Estimator
    hours: float
    seed: int
    drive: str = "current"
    phase_known: bool = False
    clock_rate: float = 0.0
    place: str | None = None

    @property
    def own_place(self) -> Path | None:
        """Directory of this run."""
        if self.place is None:
            return None
        return Path(self.place) / f"world_{self.world}_{self.estimator}"

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return -(-EnduranceConfig(self.hours).blocks // STRETCH)


@dataclass(frozen=True, eq=False)
class WorldRun:
    """What came out.

    Parameters
    ----------
    task : WorldTask
    errors : ErrorSeries
        Of all states.
    pace : ndarray, shape (pieces, 6)
        Of each piece the columns `PACE`: begin, processor time (s), states made, resident memory
        (MiB), mean squared innovation in units of its expectation, processor time of the bare loop
        for one sample in the same minutes (s), by which the machine's own mood cancels.
    bare_seconds : float
        Processor time of a bare loop over ``integrateMeasurement`` on all samples, extrapolated.
    losses : dict of str to int
        What the navigator refused, lost and recovered.
    """

    task: WorldTask
    errors: ErrorSeries
    pace: Array
    bare_seconds: float
    losses: dict[str, int]


@dataclass(frozen=True, eq=False)
class _Progress:
    """Where a run is: all that it needs beside the rows already written."""

    stretch: int
    biases: Biases
    navigator: bytes
    bare: float


def declared_site(drive: str, phase_known: bool) -> Site:
    """Return the site as its user declares it: moments as uncertain as their drive makes them."""
    site = demo_site(synchronised=phase_known)
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, log_moment=np.full(len(b.coils), MOMENT_SIGMA[drive])))
        for b in site.beacons
    )
    return replace(site, beacons=beacons)


def draw_task(task: WorldTask) -> World:
    """Return the world of a task; both estimators see the same."""
    config = EnduranceConfig(
        hours=task.hours,
        drift=usual_drift(task.drive, task.clock_rate),
        instability=INSTABILITY,
    )
    site = declared_site(task.drive, task.phase_known)
    return draw_endurance(site, config, (task.seed, task.world))


def run_world(task: WorldTask, _rng: np.random.Generator | None = None) -> WorldRun:
    """Navigate through a world, from where the run was if it was begun before.

    Raises
    ------
    EstimationError
        Where the navigator finds no start.
    """
    world = draw_task(task)
    place = task.own_place
    if place is not None:
        place.mkdir(parents=True, exist_ok=True)
    progress = _begun(place, world, task)
    navigator = restored(progress.navigator)
    kept: list[tuple[ErrorSeries, Array]] = []
    while progress.stretch < task.stretches:
        made = world.stretch(progress.stretch * STRETCH, STRETCH, progress.biases)
        sample = bare_loop(made.imu, world.site.platform.imu, world.site.gravity)
        errors, pace = navigate(navigator, world, made)
        pace = np.column_stack([pace, np.full(len(pace), sample)])
        bare = progress.bare + sample * len(made.imu)
        number = progress.stretch
        saved = navigator.checkpoint() if place is not None else b""
        progress = _Progress(number + 1, made.after, saved, bare)
        if place is None:
            kept.append((errors, pace))
        else:
            _write_rows(place, number, errors, pace)
            _write_progress(place, progress)
    if place is not None:
        kept = [_read_rows(place, k) for k in range(task.stretches)]
    if not navigator.started:
        raise EstimationError(
            f"world {task.world}: {task.hours:g} h lead the {task.estimator} to no state"
        )
    series = _joined([errors for errors, _ in kept])
    every = np.concatenate([pace for _, pace in kept])
    return WorldRun(task, series, every, progress.bare, navigator.losses)


def navigate(navigator: Navigator, world: World, made: Stretch) -> tuple[ErrorSeries, Array]:
    """Feed a stretch piece by piece; return the errors of its states and their own pace."""
    states: list[State] = []
    pace = []
    # A field when it is measured, then the inertial samples up to the next one.
    grid = np.arange(made.imu.time[0], made.imu.time[-1], PIECE)
    starts = np.union1d(grid, made.fields.time)
    inertial = np.searchsorted(made.imu.time, [*starts, np.inf])
    heard = np.searchsorted(made.fields.time, [*starts, np.inf])
    for i in range(len(starts)):
        rows = slice(inertial[i], inertial[i + 1])
        began = time.process_time()
        for k in range(heard[i], heard[i + 1]):
            navigator.add_fields(made.fields.rows(slice(k, k + 1)))
        navigator.add_imu(made.imu.time[rows], made.imu.gyro_body[rows], made.imu.accel_body[rows])
        new = navigator.take()
        spent = time.process_time() - began
        navigator.take_lagged()
        level = list(navigator.distortion.values())
        innovation = float(np.mean(level)) if level else np.nan
        pace.append([starts[i], spent, len(new), memory_mib(), innovation])
        states += new
    stamps = np.array([s.time for s in states])
    truth = world.truth(made, stamps)
    return state_errors(states, truth, np.asarray(np.isin(stamps, made.fields.time))), np.array(
        pace
    )


def state_errors(states: list[State], truth: Trajectory, measured: BoolArray) -> ErrorSeries:
    """Return what states err: attitude, position and velocity in world axes, biases in the body's.

    Parameters
    ----------
    states : list of State
    truth : Trajectory
        At their times, with velocity and biases.
    measured : ndarray of bool, shape (n,)
    """
    error = np.empty((len(states), 15))
    sigma, nees = np.empty_like(error), np.empty((len(states), 2))
    assert truth.velocity_world is not None
    assert truth.accel_bias_body is not None
    assert truth.gyro_bias_body is not None
    for i, state in enumerate(states):
        true = gtsam.Pose3(gtsam.Rot3(truth.world_from_body[i]), truth.position_world[i])
        own = np.empty(15)
        own[:6] = true.localCoordinates(pose_of(state))
        own[6:9] = state.velocity_world - truth.velocity_world[i]
        own[ACCEL_BIAS] = state.accel_bias_body - truth.accel_bias_body[i]
        own[GYRO_BIAS] = state.gyro_bias_body - truth.gyro_bias_body[i]
        for j, part in enumerate((slice(0, 6), slice(9, 15))):
            nees[i, j] = own[part] @ np.linalg.solve(state.cov[part, part], own[part])
        turn = np.eye(15)
        turn[:3, :3] = turn[3:6, 3:6] = truth.world_from_body[i]
        error[i] = turn @ own
        sigma[i] = np.sqrt(np.einsum("ij,jk,ik->i", turn, state.cov[:15, :15], turn))
    return ErrorSeries(truth.time, measured, error, sigma, nees[:, 0], nees[:, 1])


def bare_loop(imu: ImuSamples, model: ImuModel, gravity: float) -> float:
    """Return the processor time of ``integrateMeasurement`` alone, for one sample (s)."""
    rows = slice(0, min(BARE, len(imu)))
    step = float(imu.time[1] - imu.time[0])
    parameters = preintegration_parameters(model, gravity, bridge=False)
    measurement = gtsam.PreintegratedCombinedMeasurementsG(parameters, gtsam.imuBias.ConstantBias())
    integrate = measurement.integrateMeasurement
    began = time.process_time()
    for accel, gyro in zip(imu.accel_body[rows], imu.gyro_body[rows], strict=True):
        integrate(accel, gyro, step)
    return (time.process_time() - began) / (rows.stop - rows.start)


def memory_mib() -> float:
    """Return the resident memory of this process (MiB)."""
    now = Path("/proc/self/statm")
    if now.exists():
        return int(now.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2.0**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def stretches_done(place: Path) -> int:
    """Return how many stretches all runs of a place have written."""
    return sum(1 for _ in place.glob("world_*/rows_*.npz"))


def forget(place: Path) -> None:
    """Remove what an earlier run left."""
    shutil.rmtree(place, ignore_errors=True)


def _begun(place: Path | None, world: World, task: WorldTask) -> _Progress:
    if place is not None and (place / "progress.pickle").is_file():
        try:
            found = pickle.loads((place / "progress.pickle").read_bytes())
        except (pickle.UnpicklingError, AttributeError, EOFError, ImportError) as error:
            raise InputError(
                f"{place}: cannot be gone on with ({error}); run without --resume"
            ) from error
        assert isinstance(found, _Progress)
        return found
    navigator = Navigator(world.site, NavigatorSettings(estimator=task.estimator))
    return _Progress(0, world.start(), navigator.checkpoint(), 0.0)


def _write_progress(place: Path, progress: _Progress) -> None:
    with whole_file(place / "progress.pickle") as unfinished:
        unfinished.write_bytes(pickle.dumps(progress))


def _write_rows(place: Path, number: int, errors: ErrorSeries, pace: Array) -> None:
    columns = {f.name: getattr(errors, f.name) for f in fields(errors)}
    with whole_file(_rows_path(place, number)) as unfinished, unfinished.open("wb") as stream:
        np.savez(stream, pace=pace, **columns)


def _read_rows(place: Path, number: int) -> tuple[ErrorSeries, Array]:
    with np.load(_rows_path(place, number)) as found:
        return ErrorSeries(**{f.name: found[f.name] for f in fields(ErrorSeries)}), found["pace"]


def _rows_path(place: Path, number: int) -> Path:
    return place / f"rows_{number:04d}.npz"


def _joined(parts: list[ErrorSeries]) -> ErrorSeries:
    return ErrorSeries(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(ErrorSeries)}
    )
