"""Time the refinement of snapshot fixes against scipy's least squares, one epoch a call.

Compared, in one run and from the same starts, on simulated phasors of three beacons:

- `refine`, ours: all epochs at once, the covariance of each pose included;
- `scipy.optimize.least_squares`, by ``lm`` and by ``trf``, on a part of the epochs; it has no
  covariance to find.

scipy is not handicapped.  Its residual and its Jacobian are one call of `observe` a beacon, kept
until the parameters change, and whitened as ours; its tolerances are its own.  As `observe` returns
blocks that a fix has no use for, it is timed once more with `observe_from`, which leaves them out:
the figure ``speedup_narrow``.

Times are of the processor, which other work on the machine disturbs less than those of the clock.
"""

import os

# One thread for either: numpy reads these when it is loaded.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.refine import refine
from magfusion.model.field import observe, observe_from, skew
from magfusion.model.noise import measurement_cov, paired_whitening, stacked
from magfusion.model.parameters import Calibration, initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array, ComplexArray

FIXES, RIVAL_FIXES = 100_000, 300
BEACONS = 3
FIELD_SIGMA = 3e-10  # T
POSITION_ERROR, ROTATION_ERROR = 0.1, 0.05  # of the start, an axis (m, rad): as a tracker's last
METHODS = ("lm", "trf")
AT_LEAST = {"speedup": 50.0}
AT_MOST = {"apart_m": 1e-6}

Model = Callable[[Beacon, Array, Array], tuple[ComplexArray, ComplexArray]]


@dataclass(frozen=True, eq=False)
class Scene:
    """Simulated phasors, and where the fixes start."""

    calibration: Calibration
    samples: FieldSamples
    start: Trajectory

    @property
    def site(self) -> Site:
        """Return what is installed."""
        return self.calibration.site


def make_scene(fixes: int, seed: int) -> Scene:
    """Draw poses in the demo's room, their phasors among its first beacons, and starts."""
    site = demo_site(coil_radius=None)
    site = replace(site, beacons=site.beacons[:BEACONS])
    rng = np.random.default_rng(seed)
    turns = rng.normal(0.0, ROTATION_ERROR, (fixes, 3))
    truth = Trajectory(
        np.arange(float(fixes)),
        Rotation.random(fixes, rng=rng).as_matrix(),
        rng.uniform(*DEMO_BOX_WORLD, (fixes, 3)),
    )
    samples = simulate_fields(site, truth, FIELD_SIGMA, rng)
    start = replace(
        truth,
        world_from_body=truth.world_from_body @ Rotation.from_rotvec(turns).as_matrix(),
        position_world=truth.position_world + rng.normal(0.0, POSITION_ERROR, (fixes, 3)),
    )
    return Scene(initial_calibration(site, 0.0), samples, start)


def run_ours(scene: Scene) -> tuple[Fixes, float]:
    """Refine all epochs; return the fixes and the seconds."""
    started = time.process_time()
    fixes = refine(scene.samples, scene.calibration, scene.start, survey_error=False)
    return fixes, time.process_time() - started


class Epoch:
    """One epoch's residual and Jacobian for scipy, by rotation vector and shift from the start."""

    def __init__(self, scene: Scene, model: Model, root: Array, measured: Array, row: int) -> None:
        self.beacons, self.model, self.root, self.measured = (
            scene.site.beacons,
            model,
            root,
            measured,
        )
        self.rotation0 = scene.start.world_from_body[row]
        self.position0 = scene.start.position_world[row]
        self._at = np.full(6, np.nan)

    def pose(self, x: Array) -> tuple[Array, Array]:
        """Return world_from_body and position."""
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        return self.rotation0 @ turn, self.position0 + x[3:]

    def residual(self, x: Array) -> Array:
        """Return the whitened residual, shape (rows,)."""
        self._compute(x)
        return self._residual

    def jacobian(self, x: Array) -> Array:
        """Return its derivative, shape (rows, 6)."""
        self._compute(x)
        return self._jacobian

    def _compute(self, x: Array) -> None:
        if (x == self._at).all():
            return
        self._at = x.copy()
        rotation, position = self.pose(x)
        seen = [self.model(beacon, rotation, position) for beacon in self.beacons]
        phasor = np.concatenate([s[0] for s in seen])
        pose = np.concatenate([s[1] for s in seen])
        error = stacked(phasor) - self.measured
        self._residual = (self.root @ error[..., None]).ravel()
        by_pose = self.root @ np.concatenate([pose.real, pose.imag], axis=1)
        by_pose = by_pose.reshape(-1, 6)
        self._jacobian = np.hstack([by_pose[:, :3] @ turned_by(x[:3]), by_pose[:, 3:] @ rotation.T])


def turned_by(rotvec: Array) -> Array:
    """Return the right Jacobian of the rotation of a rotation vector."""
    angle = np.sqrt(rotvec @ rotvec)
    cross = skew(rotvec)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * cross
    square = angle**2
    first = (1.0 - np.cos(angle)) / square
    second = (angle - np.sin(angle)) / (square * angle)
    return np.eye(3) - first * cross + second * cross @ cross


def run_rival(scene: Scene, model: Model, method: str, fixes: int) -> tuple[Array, float]:
    """Solve the first epochs by scipy; return positions, shape (fixes, 3), and seconds a fix."""
    root = paired_whitening(measurement_cov(scene.site, scene.samples), scene.samples.valid)
    measured = stacked(scene.samples.phasor_sensor)
    result = np.empty((fixes, 3))
    started = time.process_time()
    for i in range(fixes):
        epoch = Epoch(scene, model, root[i], measured[i], i)
        solution = least_squares(epoch.residual, np.zeros(6), epoch.jacobian, method=method)
        result[i] = epoch.pose(solution.x)[1]
    return result, (time.process_time() - started) / fixes


def models(scene: Scene) -> dict[str, Model]:
    """Return the measurement model with all its blocks, and without those of no use here."""
    sensor, none = scene.site.platform.magnetometer, np.zeros(1)

    def whole(
        beacon: Beacon, rotation: Array, position: Array
    ) -> tuple[ComplexArray, ComplexArray]:
        seen = observe(beacon, sensor, rotation, position, none)
        return seen.phasor_sensor, seen.platform_pose

    def narrow(
        beacon: Beacon, rotation: Array, position: Array
    ) -> tuple[ComplexArray, ComplexArray]:
        return observe_from(beacon, sensor, rotation, position, none)

    return {"": whole, "_narrow": narrow}


def declare(text: str) -> None:
    """Report progress, separately from the result."""
    print(text, file=sys.stderr, flush=True)


def compare(fixes: int, rival_fixes: int, seed: int) -> dict[str, float]:
    """Run everything; return the figures by name."""
    scene = make_scene(fixes, seed)
    figures: dict[str, float] = {"fixes": fixes, "rival_fixes": rival_fixes}
    runs, separate = [], 0.0
    for name, model in models(scene).items():
        # Ours between the rivals: a shared machine is not as fast now as a minute ago.
        ours, seconds = run_ours(scene)
        runs.append(1e6 * seconds / fixes)
        declare(f"ours: {runs[-1]:.1f} us a fix")
        for method in METHODS:
            position, each = run_rival(scene, model, method, rival_fixes)
            figures[f"scipy_{method}{name}_us"] = 1e6 * each
            declare(f"scipy {method}{name}: {1e6 * each:.0f} us a fix")
            away = np.linalg.norm(position - ours.position_world[:rival_fixes, 0], axis=1)
            separate = max(separate, float(np.max(away)))
    figures["ours_us"] = float(np.mean(runs))
    for name in models(scene):
        rival = min(figures[f"scipy_{method}{name}_us"] for method in METHODS)
        figures[f"speedup{name}"] = rival / figures["ours_us"]
    figures["apart_m"] = separate
    return figures


def main() -> int:
    """Print the figures and what was wanted of them; a benchmark reports, it does not fail."""
    parser = argparse.ArgumentParser(description="Time the refinement of snapshot fixes.")
    parser.add_argument("--fixes", type=int, default=FIXES, help="fewer: a quicker look")
    parser.add_argument("--rival-fixes", type=int, default=RIVAL_FIXES)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    figures = compare(chosen.fixes, chosen.rival_fixes, chosen.seed)
    for name, value in figures.items():
        print(f"{name:<30}{value:>16.6g}")
    for name, wanted in AT_LEAST.items():
        print(f"{name} at least {wanted:g}: {'met' if figures[name] >= wanted else 'MISSED'}")
    for name, wanted in AT_MOST.items():
        print(f"{name} at most {wanted:g}: {'met' if figures[name] <= wanted else 'MISSED'}")
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
