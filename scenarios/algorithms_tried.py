"""Paper 004's three algorithms and maximum likelihood, each as a method of one room."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from paper_rooms import Scenario, SceneLayout, SimulatedWorld, draw_world, mapped
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.explained_fixes import explained_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.survey import Survey
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.papers.p004_fingerprints.algorithms import attitude_as_published, locate_by_lines
from magfusion.papers.p004_fingerprints.equations import distances, eq_23_angles, eq_25_fingerprint
from magfusion.papers.p004_fingerprints.fingerprint import (
    FingerprintDatabase,
    fingerprint_database,
    locate_by_differential_range,
    locate_by_neighbours,
)
from magfusion.papers.p004_fingerprints.rssi import RssiLines, fit_lines
from magfusion.receiver.ellipse import plane_normal
from magfusion.results.coverage import coverage
from magfusion.units import DEGREE, Array

MODEL_ERROR = 0.02  # relative; half a per cent to five give nearly the same
GAIN_SIGMA = 0.2  # of the logarithm
LEVEL = np.eye(3)
PUBLISHED = ("A1 lines", "A2 kNN ln", "A3 differential")
ML, FIX, MAPPED = "ML", "fix", "MLrel + map"
OURS = (ML, "MLrel", "MLrel + gain", FIX, MAPPED)


@dataclass(frozen=True, eq=False)
class Trial:
    """What a method is given: a survey of a room, and the fields at its targets, sensor level."""

    world: SimulatedWorld
    survey: Survey
    samples: FieldSamples

    @property
    def database(self) -> FingerprintDatabase:
        """The fingerprints."""
        return fingerprint_database(self.survey, self.world.site)

    @property
    def amplitude(self) -> Array:
        """Of each beacon at each target (T)."""
        return eq_25_fingerprint(self.samples.phasor_sensor[:, :, None])


@dataclass(frozen=True, eq=False)
class Poses:
    """Positions (n, 3) (m) and attitudes world_from_body (n, 3, 3)."""

    position_world: Array
    world_from_body: Array


Method = Callable[[Trial], Poses]


@dataclass(frozen=True)
class Task:
    """One room to draw, and what is tried in it."""

    scenario: Scenario
    targets: int
    layout: SceneLayout
    methods: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AlgorithmOutcome:
    """Errors in one room.

    Parameters
    ----------
    position, euler, geodesic : dict of str to ndarray, shape (targets,)
        Of each method: distance (m); mean size of the three printed angles, and angle of the
        rotation between estimate and truth (deg).
    position_bound, attitude_bound : ndarray, shape (targets,)
        Cramér-Rao, white noise and a known model: root mean square distance (m), rotation (deg).
    """

    position: Mapping[str, Array]
    euler: Mapping[str, Array]
    geodesic: Mapping[str, Array]
    position_bound: Array
    attitude_bound: Array


def by_lines(trial: Trial) -> Poses:
    """Algorithm 1: lines of all fingerprints, which have aged since."""
    known = trial.database
    fresh = fit_lines(distances(known.position_world, known.beacons_world), known.amplitude)
    lines = RssiLines(fresh.slope, fresh.intercept + trial.world.line_bias)
    return _with_attitude(trial, locate_by_lines(known, trial.amplitude, lines))


def by_neighbours(trial: Trial) -> Poses:
    """Algorithm 2 in logarithms."""
    return _with_attitude(trial, locate_by_neighbours(trial.database, trial.amplitude))


def by_neighbours_nt(trial: Trial) -> Poses:
    """Algorithm 2 as printed."""
    result = locate_by_neighbours(trial.database, trial.amplitude, logarithmic=False)
    return _with_attitude(trial, result)


def by_differential_range(trial: Trial) -> Poses:
    """Algorithm 3."""
    return _with_attitude(trial, locate_by_differential_range(trial.database, trial.amplitude))


def by_likelihood(trial: Trial) -> Poses:
    """Maximum likelihood of dipoles in white noise."""
    return fixed(trial.samples, replace(trial.world.site, model_error=0.0))


def by_relative_weights(trial: Trial) -> Poses:
    """Maximum likelihood that allows for the model's error."""
    return fixed(trial.samples, trial.world.site)


def by_free_gain(trial: Trial) -> Poses:
    """Maximum likelihood with relative weights and a gain of each beacon in each epoch."""
    return fixed(trial.samples, trial.world.site, ("gain",))


def by_default(trial: Trial) -> Poses:
    """Fix as `magfusion fix` does: beacons omitted or gains estimated where required."""
    calibration = initial_calibration(trial.world.site, 0.0)
    result = explained_fixes(trial.samples, calibration, survey_error=False).fixes.best()
    return Poses(result.position_world, result.world_from_body)


def by_map(trial: Trial) -> Poses:
    """Maximum likelihood on the model with a map of the survey."""
    return fixed(trial.samples, mapped(trial.world.site, trial.survey))


METHODS: dict[str, Method] = {
    "A1 lines": by_lines,
    "A2 kNN ln": by_neighbours,
    "A2 kNN nT": by_neighbours_nt,
    "A3 differential": by_differential_range,
    ML: by_likelihood,
    "MLrel": by_relative_weights,
    "MLrel + gain": by_free_gain,
    FIX: by_default,
    MAPPED: by_map,
}


def _with_attitude(trial: Trial, position_world: Array) -> Poses:
    """Add the attitude that the paper finds at a position: the nearest rotation to Eq 18."""
    beacons_world = trial.world.layout.beacons_world
    axis_world = np.tile([0.0, 0.0, 1.0], (len(beacons_world), 1))
    normal = plane_normal(trial.samples.phasor_sensor)
    attitude = attitude_as_published(normal, position_world, beacons_world, axis_world)
    return Poses(position_world, attitude)


def fixed(
    samples: FieldSamples,
    site: Site,
    free_parameters: tuple[str, ...] = (),
    gain_sigma: float = GAIN_SIGMA,
) -> Poses:
    """Return the most likely poses."""
    calibration = initial_calibration(site, 0.0)
    fixes = fix_epochs(
        samples,
        calibration,
        survey_error=False,
        free_parameters=free_parameters,
        gain_sigma=gain_sigma,
    ).best()
    return Poses(fixes.position_world, fixes.world_from_body)


def try_world(task: Task, rng: np.random.Generator) -> AlgorithmOutcome:
    """Draw one room and try the methods in it."""
    world = draw_world(task.scenario, rng, task.layout, model_error=MODEL_ERROR)
    targets = task.layout.draw_targets(rng, task.targets)
    trial = Trial(world, world.survey(rng), world.measure(targets, LEVEL, rng))
    result = {name: METHODS[name](trial) for name in task.methods}
    angles = {
        name: eq_23_angles(np.swapaxes(poses.world_from_body, -1, -2))
        for name, poses in result.items()
    }
    position_bound, attitude_bound = bound(world, targets)
    return AlgorithmOutcome(
        position={n: size(poses.position_world - targets) for n, poses in result.items()},
        euler={n: np.mean(np.abs(a), axis=1) / DEGREE for n, a in angles.items()},
        geodesic={n: angle_deg(poses.world_from_body) for n, poses in result.items()},
        position_bound=position_bound,
        attitude_bound=attitude_bound,
    )


def bound(world: SimulatedWorld, position_world: Array) -> tuple[Array, Array]:
    """Return the Cramér-Rao bounds of position (m) and attitude (deg) in noise alone."""
    receiver, platform = world.receiver, world.site.platform
    window = receiver.samples / receiver.rate_hz
    magnetometer = replace(
        platform.magnetometer, noise_density=receiver.sigma * float(np.sqrt(window))
    )
    site = replace(
        world.site, model_error=0.0, platform=replace(platform, magnetometer=magnetometer)
    )
    limits = coverage(site, position_world, window, survey=False)
    return limits.position_sigma, limits.attitude_sigma / DEGREE


def angle_deg(rotation: Array) -> Array:
    """Return the angle of rotations (n, 3, 3) (deg)."""
    return Rotation.from_matrix(rotation).magnitude() / DEGREE


def size(vector: Array) -> Array:
    """Return the lengths of vectors (..., 3)."""
    return np.asarray(np.linalg.norm(vector, axis=-1))
