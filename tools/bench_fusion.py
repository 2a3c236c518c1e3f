"""Time the batch smoother against GTSAM's own engines, and against itself on longer logs.

All on simulated epochs 1 s apart with 100 Hz inertial data, three beacons, and poses and moments of
the beacons and the magnetometer matrix estimated.  Times are of the processor, which other work on
the machine disturbs less than those of the clock; everything runs on one thread.

- `bench_engines`: our Gauss-Newton loop over GTSAM's linear layer, as the smoother uses it, and
  GTSAM's optimizers, on the same log: error, sigma, NEES, time, and growth of the time.
  ``python tools/bench_fusion.py --only-engines`` stops there.
- Our loop's time an epoch and iteration on a long log against that on a short one, and the
  posterior's covariances, on their own.
- `bench_batch`: the whole smoother on a long log at rest against a bare loop over its samples;
  ``python tools/bench_fusion.py --only-batch --batch-hours 48`` needs 6 GB.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import gtsam
import numpy as np
from bench_batch import bench_batch
from bench_engines import TOLERANCE, bench_engines
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate
from magfusion.estimation.graph.inertial import inertial_graph
from magfusion.estimation.graph.preintegration import cut_at_epochs, preintegrate
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.marginals import marginals
from magfusion.estimation.solve.bordered import Optimised, optimise
from magfusion.model.noise import paired_whitening, stacked
from magfusion.model.parameters import Block, Calibration, choose_blocks, initial_calibration
from magfusion.model.site import Beacon, BeaconSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import perturb_site, simulate_fields
from magfusion.simulation.motion import random_walk_motion

T = TypeVar("T")

EPOCHS, BEACONS = 2880, 3
ENLARGED = 5.0  # the demo's room, with moments that keep its fields
IMU_RATE_HZ = 100.0
FIELD_SIGMA = 5e-9  # T
POSITION_ERROR, ROTATION_ERROR = 0.3, 0.02  # of the start (m, rad)
AT_MOST = {"growth": 1.5, "batch_s_for_48_h": 120.0}


def bench_site() -> Site:
    """Return the demo's first three beacons in a room five times larger, less well surveyed."""
    site = demo_site(coil_radius=None)
    sensor = site.platform.magnetometer
    none = {name: np.zeros(3) for name in ("offset", "rotation_sensor", "position_body")}
    sigma = replace(sensor.sigma, matrix=np.full((3, 3), 5e-3), **none)
    platform = replace(site.platform, magnetometer=replace(sensor, sigma=sigma))
    beacons = tuple(_enlarged(beacon) for beacon in site.beacons[:BEACONS])
    return replace(site, beacons=beacons, platform=platform)


def _enlarged(beacon: Beacon) -> Beacon:
    coils = [replace(c, moment_beacon=ENLARGED**3 * c.moment_beacon) for c in beacon.coils]
    return replace(
        beacon,
        position_world=ENLARGED * beacon.position_world,
        coils=tuple(coils),
        sigma=BeaconSigma(np.full(3, 0.02), np.full(3, 0.01), np.full(2, 0.01)),
    )


@dataclass(frozen=True, eq=False)
class Scene:
    """One simulated log, ready for any engine."""

    declared: Calibration
    blocks: tuple[Block, ...]
    truth: Trajectory
    start: Trajectory
    measurements: FieldPhasors
    preintegrated: list[gtsam.PreintegratedCombinedMeasurementsG]
    preintegrate_seconds: float

    def problem(self) -> Graph:
        """Return a graph for our loop."""
        native = inertial_graph(self.preintegrated, self.declared.site.platform)
        own = (self.measurements,)
        return Graph(native, own, self.declared, self.blocks, len(self.start))


def timed(job: Callable[[], T]) -> tuple[T, float]:
    """Return what a job returns, and the seconds that it took."""
    started = time.process_time()
    result = job()
    return result, time.process_time() - started


def make_scene(epochs: int, seed: int) -> Scene:
    """Simulate a walk of so many seconds, and preintegrate it."""
    site, rng = bench_site(), np.random.default_rng(seed)
    true_site, imu = perturb_site(site, rng), site.platform.imu
    motion = random_walk_motion(rng, float(epochs), ENLARGED * DEMO_BOX_WORLD)
    inertial = simulate_imu(motion, imu, site.gravity, IMU_RATE_HZ, float(epochs), rng).samples
    truth = motion.trajectory(np.arange(epochs, dtype=float))
    samples = simulate_fields(true_site, truth, FIELD_SIGMA, rng)
    zero = np.zeros((epochs, 3))
    declared = initial_calibration(site, float(np.mean(samples.time)))
    turn = Rotation.from_rotvec(rng.normal(0.0, ROTATION_ERROR, (epochs, 3))).as_matrix()
    start = replace(
        truth,
        world_from_body=truth.world_from_body @ turn,
        position_world=truth.position_world + rng.normal(0.0, POSITION_ERROR, (epochs, 3)),
    )
    measured = stacked(samples.phasor_sensor)
    measurements = FieldPhasors(
        epoch=np.arange(epochs),
        time=samples.time,
        measured=measured,
        sqrt_information=paired_whitening(samples.phasor_cov, samples.valid),
        rate_body=zero,
        applied_offset=np.zeros(epochs),
        moving=np.ones(epochs, dtype=bool),
        by_time_offset=np.zeros_like(measured),
    )
    increments = cut_at_epochs(inertial, 0.0, samples.time)
    preintegrated, seconds = timed(partial(preintegrate, increments, imu, site.gravity, zero, zero))
    blocks = choose_blocks(site, ("beacons", "moments", "magnetometer"))
    return Scene(declared, blocks, truth, start, measurements, preintegrated, seconds)


@dataclass(frozen=True, eq=False)
class Ours:
    """Our loop on one scene, run once or more."""

    problem: Graph
    start: GraphEstimate
    preintegrate_seconds: float
    build_seconds: float
    trajectory: Optimised[GraphEstimate]
    runs: list[float]

    @property
    def seconds(self) -> float:
        """Median time of a run."""
        return float(np.median(self.runs))

    def figures(self, prefix: str) -> dict[str, float]:
        """Return times and cost, each name with a prefix."""
        work = self.problem.epochs * self.trajectory.iterations
        return {
            f"{prefix}_epochs": self.problem.epochs,
            f"{prefix}_s": self.seconds,
            f"{prefix}_iterations": self.trajectory.iterations,
            f"{prefix}_us_per_epoch_iteration": 1e6 * self.seconds / work,
            f"{prefix}_preintegrate_s": self.preintegrate_seconds,
            f"{prefix}_build_s": self.build_seconds,
            f"{prefix}_cost": self.trajectory.cost,
        }

    def again(self) -> float:
        """Run once more; return the time an epoch and iteration (us)."""
        self.runs.append(timed(partial(optimise, self.problem, self.start, tolerance=TOLERANCE))[1])
        declare(f"ours: {self.problem.epochs} epochs, {self.runs[-1]:.2f} s")
        return 1e6 * self.runs[-1] / (self.problem.epochs * self.trajectory.iterations)


def run_ours(scene: Scene, repeats: int) -> Ours:
    """Run our loop."""
    problem, build_seconds = timed(scene.problem)
    start = initial_estimate(scene.start, scene.declared)
    result, seconds = timed(partial(optimise, problem, start, tolerance=TOLERANCE))
    declare(f"ours: {problem.epochs} epochs, {result.iterations} iterations, {seconds:.2f} s")
    ours = Ours(problem, start, scene.preintegrate_seconds, build_seconds, result, [seconds])
    for _ in range(repeats - 1):
        ours.again()
    return ours


def declare(text: str) -> None:
    """Report progress, separately from the result."""
    print(text, file=sys.stderr, flush=True)


def compare(long_epochs: int, seed: int) -> dict[str, float]:
    """Run our loop on a short and a long log; return the figures by name."""
    short = run_ours(make_scene(EPOCHS, seed), repeats=3)
    _, marginal_seconds = timed(partial(marginals, short.problem, short.trajectory.estimate))
    long = run_ours(make_scene(long_epochs, seed), repeats=1)
    # In pairs: a shared machine is not as fast now as a minute ago.
    growth = [long.again() / short.again() for _ in range(3)]
    figures = {**short.figures("ours"), **long.figures("long")}
    figures["marginals_s"] = marginal_seconds
    figures["growth"] = float(np.median(growth))
    return figures


def engine_scene(seed: int, epochs: int) -> tuple[Graph, GraphEstimate, Trajectory]:
    """Return problem, start and truth of so many epochs."""
    scene = make_scene(epochs, seed)
    return scene.problem(), initial_estimate(scene.start, scene.declared), scene.truth


def main() -> int:
    """Print the figures and what was wanted of them; a benchmark reports, it does not fail."""
    parser = argparse.ArgumentParser(description="Time the batch smoother.")
    parser.add_argument("--only-engines", action="store_true", help="the comparison with GTSAM")
    parser.add_argument("--long-epochs", type=int, default=40_000)
    parser.add_argument("--batch-hours", type=float, default=4.8, help="of the log at rest")
    parser.add_argument("--only-batch", action="store_true", help="leave the optimizers out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    chosen = parser.parse_args()
    figures = {}
    if not chosen.only_batch:
        figures |= bench_engines(partial(engine_scene, chosen.seed))
    if not (chosen.only_batch or chosen.only_engines):
        figures |= compare(chosen.long_epochs, chosen.seed)
    if not chosen.only_engines:
        figures |= bench_batch(chosen.batch_hours, chosen.seed)
    for name, value in figures.items():
        print(f"{name:<44}{value:>16.6g}")
    for name in [name for name in AT_MOST if name in figures]:
        met = figures[name] <= AT_MOST[name]
        print(f"{name} at most {AT_MOST[name]:g}: {'met' if met else 'MISSED'}")
    if chosen.json:
        print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
