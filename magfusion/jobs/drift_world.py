"""One estimator through one simulated world of hours: errors and cost; resumable."""

import os
import re
import resource
import sys
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import gtsam
import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.graph.preintegration import preintegration_parameters
from magfusion.estimation.graph.state import ACCEL_BIAS, GYRO_BIAS, State
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.atomic import abandoned_pattern
from magfusion.files.checkpoint import claim_checkpoint, read_position, run_key
from magfusion.files.row_file import RowFile, RowPosition, claim_rows
from magfusion.jobs.checkpoint import CheckpointWriter, begin
from magfusion.jobs.drift_conditions import Condition, declared_site, endurance_config
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import Trajectory
from magfusion.results.drift import ErrorSeries
from magfusion.simulation.endurance import (
    Biases,
    EnduranceConfig,
    EnduranceWorld,
    SimulatedStretch,
    draw_endurance,
)
from magfusion.units import Array, BoolArray

STRETCH = 10  # blocks that are made, navigated and written at once
PIECE = 10.0  # s that are fed at once
BARE = 6000  # samples of each stretch on which the bare loop is timed
Estimator = Literal["ekf", "smoother"]
PACE = ("time", "seconds", "updates", "memory_mib", "distortion", "bare_sample_seconds")
_ERRORS = {"time": 1, "measured": 1, "error": 15, "sigma": 15, "pose_nees": 1, "bias_nees": 1}
_PACE = dict.fromkeys(PACE, 1)
_PROGRESS, _ERROR_ROWS, _PACE_ROWS = "progress.bin", "errors.rows", "pace.rows"


@dataclass(frozen=True)
class WorldTask:
    """One run."""

    world: int
    estimator: Estimator
    hours: float
    seed: int
    drive: str = "current"
    # whether the drives are declared synchronised; otherwise each beacon has a clock of its own
    phase_known: bool = False
    clock_rate: float = 0.0  # relative error of the clock that all drives share
    condition: Condition = "usual"
    place: str | None = None  # directory of the files needed to resume; None stores nothing

    @property
    def progress(self) -> Path:
        """File needed to resume; the finished rows are in the same directory."""
        assert self.place is not None
        return Path(self.place) / f"world_{self.world}_{self.estimator}" / _PROGRESS

    @property
    def key(self) -> str:
        """Key of runs that may resume from each other's files."""
        return run_key("drift", replace(self, place=None))

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return -(-EnduranceConfig(self.hours).blocks // STRETCH)


@dataclass(frozen=True)
class Reported:
    """The first finding of a code about the same beacons."""

    code: str
    beacons: tuple[str, ...]
    time: float  # s
    text: str


@dataclass(frozen=True, eq=False)
class WorldRun:
    """Result of a run."""

    task: WorldTask
    errors: ErrorSeries  # of all states
    # (pieces, 6), of each piece the columns `PACE`: begin, processor time (s), number of states,
    # resident memory (MiB), mean squared innovation relative to its expectation, processor time of
    # the bare loop for one sample in the same minutes (s), which removes the machine's load
    pace: Array
    # processor time of a bare loop over ``integrateMeasurement`` on all samples, extrapolated
    bare_seconds: float
    losses: dict[str, int]  # counts of refused, lost and recovered epochs
    reported: tuple[Reported, ...] = ()
    event_beacon: str = ""  # that settles or is exchanged


@dataclass(frozen=True, eq=False)
class _Progress:
    """Other state that a run needs to resume, apart from its navigator."""

    biases: Biases
    bare: float
    errors: RowPosition | None = None
    pace: RowPosition | None = None
    reported: tuple[Reported, ...] = ()


def draw_task(task: WorldTask) -> EnduranceWorld:
    """Return the world of a task; it is the same for both estimators."""
    config = endurance_config(task.condition, task.hours, task.drive, task.clock_rate)
    site = declared_site(task.condition, task.drive, task.phase_known)
    return draw_endurance(site, config, (task.seed, task.world))


def run_world(task: WorldTask, _rng: np.random.Generator | None = None) -> WorldRun:
    """Navigate through a world, from the last checkpoint if there is one."""
    if task.place is None:
        with TemporaryDirectory() as place:
            return replace(run_world(replace(task, place=place)), task=task)
    world, settings = draw_task(task), NavigatorSettings(estimator=task.estimator)
    task.progress.parent.mkdir(parents=True, exist_ok=True)
    unmoved = _Progress(world.start(), 0.0)
    begun = begin(task.progress, task.key, world.site, settings, unmoved, resume=True)
    navigator, progress = begun.navigator, begun.extra
    kept = CheckpointWriter(task.progress, task.key, sys.stderr)
    with (
        closing(RowFile(task.progress.with_name(_ERROR_ROWS), _ERRORS, progress.errors)) as errors,
        closing(RowFile(task.progress.with_name(_PACE_ROWS), _PACE, progress.pace)) as pace,
    ):
        for stretch in range(begun.position, task.stretches):
            built = world.stretch(stretch * STRETCH, STRETCH, progress.biases)
            sample = bare_loop(built.imu, world.site.platform.imu, world.site.gravity)
            new, own_pace, states = navigate(navigator, world, built)
            errors.extend({name: getattr(new, name) for name in _ERRORS})
            own_pace = np.column_stack([own_pace, np.full(len(own_pace), sample)])
            pace.extend(dict(zip(PACE, own_pace.T, strict=True)))
            bare = progress.bare + sample * len(built.imu)
            reported = first_findings(states, progress.reported)
            progress = _Progress(built.after, bare, errors.settle(), pace.settle(), reported)
            kept.save(navigator, stretch + 1, progress)
        series, every = _series(errors.rows()), np.column_stack(list(pace.rows().values()))
    if not navigator.started:
        raise EstimationError(
            f"world {task.world}: {task.hours:g} h give no state of the {task.estimator}"
        )
    event_beacon = world.site.beacons[world.events.beacon].name
    known = progress.bare, navigator.losses, progress.reported, event_beacon
    return WorldRun(task, series, every, *known)


def first_findings(states: list[JudgedState], known: tuple[Reported, ...]) -> tuple[Reported, ...]:
    """Return known findings and those that the states have for the first time."""
    first = {(one.code, one.beacons): one for one in known}
    for state in states:
        names = [beacon.name for beacon in state.calibration.site.beacons]
        for one in state.judgement.findings:
            beacons = tuple(n for n in names if re.search(rf"[Bb]eacons? {n}\b", one.text))
            new = Reported(one.code, beacons, state.time, one.text)
            first.setdefault((one.code, beacons), new)
    return tuple(first.values())


def _series(rows: dict[str, Array]) -> ErrorSeries:
    return ErrorSeries(
        time=rows["time"][:, 0],
        measured=rows["measured"][:, 0] > 0.0,
        error=rows["error"],
        sigma=rows["sigma"],
        pose_nees=rows["pose_nees"][:, 0],
        bias_nees=rows["bias_nees"][:, 0],
    )


def navigate(
    navigator: Navigator, world: EnduranceWorld, simulation: SimulatedStretch
) -> tuple[ErrorSeries, Array, list[JudgedState]]:
    """Process a stretch piece by piece; return the errors of its states, their pace, and them."""
    states: list[State] = []
    reported: list[JudgedState] = []
    pace = []
    # A field at its time, then the inertial samples up to the next one.
    grid = np.arange(simulation.imu.time[0], simulation.imu.time[-1], PIECE)
    starts = np.union1d(grid, simulation.fields.time)
    inertial = np.searchsorted(simulation.imu.time, [*starts, np.inf])
    detected = np.searchsorted(simulation.fields.time, [*starts, np.inf])
    for i in range(len(starts)):
        rows = slice(inertial[i], inertial[i + 1])
        began = time.process_time()
        for k in range(detected[i], detected[i + 1]):
            navigator.add_fields(simulation.fields.rows(slice(k, k + 1)))
        navigator.add_imu(
            simulation.imu.time[rows],
            simulation.imu.gyro_body[rows],
            simulation.imu.accel_body[rows],
        )
        # The estimator's own sigmas: those enlarged by its tests would hide a drift.
        reported += navigator.take()
        claimed = [replace(s, cov=s.judgement.estimators(s.cov)) for s in reported[len(states) :]]
        spent = time.process_time() - began
        navigator.take_lagged()
        level = list(navigator.distortion.values())
        innovation = float(np.mean(level)) if level else np.nan
        pace.append([starts[i], spent, len(claimed), memory_mib(), innovation])
        states += claimed
    stamps = np.array([s.time for s in states])
    truth = world.truth(simulation, stamps)
    measured = np.asarray(np.isin(stamps, simulation.fields.time))
    return state_errors(states, truth, measured), np.array(pace), reported


def state_errors(states: list[State], truth: Trajectory, measured: BoolArray) -> ErrorSeries:
    """Return the errors of states: attitude, position and velocity in world axes, biases in body.

    `truth`: at their times, with velocity and biases. `measured` (n,).
    """
    error = np.empty((len(states), 15))
    sigma, nees = np.empty_like(error), np.empty((len(states), 2))
    assert truth.velocity_world is not None
    assert truth.accel_bias_body is not None
    assert truth.gyro_bias_body is not None
    for i, state in enumerate(states):
        true = gtsam.Pose3(gtsam.Rot3(truth.world_from_body[i]), truth.position_world[i])
        own = np.empty(15)
        own[:6] = true.localCoordinates(state.pose)
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


def stretches_done(tasks: list[WorldTask]) -> int:
    """Return the number of stretches written by runs."""
    return sum(read_position(task.progress) for task in tasks)


def claim_place(place: Path) -> None:
    """Check that a directory contains only files of unfinished runs."""
    for path in (p for p in sorted(place.rglob("*")) if not p.is_dir()):
        if path.name == _PROGRESS:
            claim_checkpoint(path)
        elif path.name in (_ERROR_ROWS, _PACE_ROWS):
            claim_rows(path)
        elif not re.fullmatch(abandoned_pattern(r"(progress\.bin|(errors|pace)\.rows)"), path.name):
            raise InputError(f"{path}: is of no unfinished drift run and is kept; move it away")
