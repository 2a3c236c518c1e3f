"""Time the batch smoother on a long log at rest against a bare loop over its inertial samples.

The log has 100 Hz inertial samples and phasors once a minute, simulated from a seed: a platform at
rest, with the noise that its site declares.  The bare loop hands the samples to GTSAM's
`integrateMeasurement` one by one, and does nothing else; it runs over at most `BARE_SAMPLES` of
them, before the smoother and after it, and is scaled to all.
"""

import resource
import time

import gtsam
import numpy as np

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.graph.preintegration import preintegration_parameters
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields

MAX_HOURS = 48.0  # to which the times are scaled
IMU_RATE_HZ = 100.0
EPOCH_S = 60.0
FIELD_SIGMA = 2e-10  # T
POSITION_WORLD = np.array([2.0, 1.5, 1.0])
BARE_SAMPLES = 1_000_000


def resting_log(site: Site, hours: float, seed: int) -> Log:
    """Simulate a log of a platform at rest."""
    rng, imu = np.random.default_rng(seed), site.platform.imu
    number = int(3600.0 * hours * IMU_RATE_HZ)
    spread = np.sqrt(IMU_RATE_HZ)
    gyro, accel = rng.standard_normal((number, 3)), rng.standard_normal((number, 3))
    gyro *= spread * imu.gyro_noise
    accel *= spread * imu.accel_noise
    accel += np.array([0.0, 0.0, site.gravity])
    stream = ImuSamples(np.arange(number) / IMU_RATE_HZ, gyro, accel)
    epochs = np.arange(EPOCH_S / 2.0, 3600.0 * hours - 1.0, EPOCH_S)
    turn, place = np.tile(np.eye(3), (len(epochs), 1, 1)), np.tile(POSITION_WORLD, (len(epochs), 1))
    fields = simulate_fields(site, Trajectory(epochs, turn, place), FIELD_SIGMA, rng)
    return Log("rest", 0, "simulated", stream, None, fields, None)


def bare_loop(site: Site, imu: ImuSamples) -> float:
    """Return the processor time of handing every sample to GTSAM (s), scaled from a part."""
    part = min(len(imu), BARE_SAMPLES)
    parameters = preintegration_parameters(site.platform.imu, site.gravity, bridge=False)
    measurement = gtsam.PreintegratedCombinedMeasurementsG(parameters)
    integrate, step = measurement.integrateMeasurement, 1.0 / IMU_RATE_HZ
    began = time.process_time()
    for accel, gyro in zip(imu.accel_body[:part], imu.gyro_body[:part], strict=True):
        integrate(accel, gyro, step)
    return (time.process_time() - began) * len(imu) / part


def bench_batch(hours: float, seed: int) -> dict[str, float]:
    """Smooth a log of so many hours; return times, their ratio, and what was found, by name."""
    site = demo_site(coil_radius=None)
    log = resting_log(site, hours, seed)
    assert log.fields is not None
    before = bare_loop(site, log.imu)
    began = time.process_time()
    result = smooth(log, site)
    seconds = time.process_time() - began
    bare = 0.5 * (before + bare_loop(site, log.imu))
    scale = MAX_HOURS / hours
    cov = result.states.pose_cov
    assert cov is not None
    error = result.states.position_world - POSITION_WORLD
    return {
        "batch_hours": hours,
        "batch_imu_samples": len(log.imu),
        "batch_epochs": len(log.fields),
        "batch_s": seconds,
        "batch_bare_loop_s": bare,
        "batch_bare_loop_samples_run": 2 * min(len(log.imu), BARE_SAMPLES),
        "batch_s_for_48_h": seconds * scale,
        "batch_bare_loop_s_for_48_h": bare * scale,
        "batch_bare_loops": seconds / bare,
        "batch_passes": result.iteration_count,
        "batch_converged": float(result.converged),
        "batch_position_rms_m": float(np.sqrt(np.mean(error**2))),
        "batch_position_sigma_m": float(
            np.sqrt(np.mean(np.diagonal(cov, axis1=1, axis2=2)[:, 3:]))
        ),
        "batch_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "batch_imu_memory_mib": 7.0 * 8.0 * len(log.imu) / 2.0**20,
    }
