"""A small smoothing problem with phasors given directly, to look inside the smoother."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate
from magfusion.estimation.graph.inertial import inertial_graph
from magfusion.estimation.graph.preintegration import cut_at_epochs, preintegrate
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.noise import measurement_cov, paired_whitening, stacked
from magfusion.model.parameters import Block, initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, perturb_site, simulate_fields
from magfusion.simulation.motion import Rests, random_walk_motion

SIGMA = 1e-9  # T


@dataclass(frozen=True, eq=False)
class SmallLog:
    """Phasors and inertial samples of a short walk among three beacons, and the truth."""

    site: Site
    true_site: Site
    imu: ImuSamples
    fields: FieldSamples
    truth: Trajectory

    @property
    def log(self) -> Log:
        return Log("small", EPOCH_NS, "test", self.imu, fields=self.fields, truth=self.truth)


def three_beacons(model_error: float = 1e-5) -> Site:
    site = demo_site(coil_radius=None)
    return replace(site, beacons=site.beacons[:3], model_error=model_error)


def small_log(
    seed: int, epochs: int = 25, sigma: float = SIGMA, *, perturb: bool = True
) -> SmallLog:
    rng = np.random.default_rng(seed)
    site = three_beacons()
    true_site = perturb_site(site, rng) if perturb else site
    duration = 0.5 * epochs + 1.0
    rests = Rests(start=0.0, move=duration, pause=0.0)
    motion = random_walk_motion(rng, duration, DEMO_BOX_WORLD, rests=rests)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 100.0, duration, rng)
    truth = motion.trajectory(0.5 + 0.5 * np.arange(epochs))
    fields = simulate_fields(true_site, truth, sigma, rng)
    return SmallLog(site, true_site, imu.samples, fields, truth)


def small_problem(
    small: SmallLog,
    blocks: tuple[Block, ...],
    start: Trajectory | None = None,
    loss: str | None = None,
) -> tuple[Graph, GraphEstimate]:
    """Return the problem and a start: the truth where no other is given."""
    site, fields = small.site, small.fields
    time, n = fields.time, len(fields)
    increments = cut_at_epochs(small.imu, 0.0, time)
    zero = np.zeros((n, 3))
    measured = preintegrate(increments, site.platform.imu, site.gravity, zero, zero)
    graph = inertial_graph(measured, site.platform)
    rate = [np.interp(time, small.imu.time, axis) for axis in small.imu.gyro_body.T]
    measurements = FieldPhasors(
        epoch=np.arange(n),
        time=time,
        measured=stacked(fields.phasor_sensor),
        sqrt_information=paired_whitening(measurement_cov(site, fields), fields.valid),
        rate_body=np.stack(rate, axis=1),
        applied_offset=np.zeros(n),
        moving=np.ones(n, dtype=bool),
        by_time_offset=np.zeros((n, len(fields.channels), 6)),
        robust=loss,
    )
    declared = initial_calibration(site, float(np.mean(time)))
    problem = Graph(graph, (measurements,), declared, blocks, n)
    return problem, initial_estimate(small.truth if start is None else start, declared)
