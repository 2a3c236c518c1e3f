"""Time the online estimators against the obvious ways to do their parts, in one run.

A platform walks among the demo's four beacons; 100 Hz inertial data and one field epoch a second
are fed as they come.  For each estimator: time of an update (median, 99th percentile, worst; and
of the last thousand updates against the first), inertial samples and field epochs in a second of
processor time, and what the process's memory grew by.  For comparison, on the same data:

- a bare Python loop over GTSAM's ``integrateMeasurement``, which an estimator cannot do without;
- filterpy used plainly: an error-state prediction at every inertial sample, 15 states.

The state of now is timed last: what carrying it to every inertial sample costs, samples arriving
ten at a time, compared with a bare step of the same sample.

Times are of the processor, which other work on the machine disturbs less than those of the clock.
"""

import argparse
import json
import resource
import time
from collections.abc import Callable
from typing import Literal

import gtsam
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.preintegration import preintegration_parameters
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.field import skew
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import random_walk_motion
from magfusion.units import Array

IMU_RATE_HZ = 100.0
FIELD_SIGMA = 2e-10  # T
WARM_UP = 30  # updates
P99_AT_MOST = 5.0  # times the median
FLAT = 1.25  # last thousand updates against the first
PROPAGATION_TIME = 200  # s
ARRIVING = 10  # inertial samples at a time


def simulated(site: Site, seconds: float, seed: int) -> tuple[ImuSamples, FieldSamples]:
    """Return inertial data and phasors of a walk."""
    rng = np.random.default_rng(seed)
    motion = random_walk_motion(rng, seconds, DEMO_BOX_WORLD, 0.5)
    imu = simulate_imu(
        motion, site.platform.imu, site.gravity, IMU_RATE_HZ, seconds, rng, 0.0, None
    )
    epochs = motion.trajectory(np.arange(0.5, seconds - 0.5, 1.0))
    return imu.samples, simulate_fields(site, epochs, FIELD_SIGMA, rng)


def navigated(
    site: Site, estimator: str, imu: ImuSamples, fields: FieldSamples
) -> dict[str, float]:
    """Feed an estimator second by second; return its figures."""
    settings = NavigatorSettings(estimator="ekf" if estimator == "ekf" else "smoother")
    navigator = Navigator(site, settings)
    before, updates = memory_mib(), []
    began = time.process_time()
    for k in range(len(fields)):
        rows = slice(*np.searchsorted(imu.time, [fields.time[k] - 0.5, fields.time[k] + 0.5]))
        start = time.process_time()
        navigator.add_imu(imu.time[rows], imu.gyro_body[rows], imu.accel_body[rows])
        navigator.add_fields(fields.rows(slice(k, k + 1)))
        updates.append(time.process_time() - start)
        navigator.take()
        navigator.take_lagged()
    total = time.process_time() - began
    own = 1e3 * np.array(updates[WARM_UP:])
    part = min(1000, len(own) // 2)
    return {
        "seconds": total,
        "imu_samples_per_s": len(imu) / total,
        "field_epochs_per_s": len(fields) / total,
        "p50_ms": float(np.percentile(own, 50)),
        "p99_ms": float(np.percentile(own, 99)),
        "max_ms": float(np.max(own)),
        "last_to_first": float(np.median(own[-part:]) / np.median(own[:part])),
        "memory_growth_mib": memory_mib() - before,
    }


def fed(site: Site, rate: Literal["field", "imu"], imu: ImuSamples, fields: FieldSamples) -> float:
    """Return the time of the filter that samples reach as they come, with its states taken."""
    navigator = Navigator(site, NavigatorSettings(estimator="ekf", rate=rate))
    epoch, began = 0, time.process_time()
    for start in range(0, len(imu), ARRIVING):
        rows = slice(start, start + ARRIVING)
        navigator.add_imu(imu.time[rows], imu.gyro_body[rows], imu.accel_body[rows])
        while epoch < len(fields) and fields.time[epoch] < imu.time[rows][-1]:
            navigator.add_fields(fields.rows(slice(epoch, epoch + 1)))
            epoch += 1
        navigator.take()
        navigator.take_propagated()
    return time.process_time() - began


def propagation_ms(site: Site, imu: ImuSamples, fields: FieldSamples) -> float:
    """Return what a state of now costs, beyond the estimates of the epochs (ms)."""
    part = imu.time < imu.time[0] + PROPAGATION_TIME
    some = ImuSamples(imu.time[part], imu.gyro_body[part], imu.accel_body[part])
    own = fed(site, "imu", some, fields) - fed(site, "field", some, fields)
    return 1e3 * own / len(some)


def bare_loop(site: Site, imu: ImuSamples) -> float:
    """Return the time of preintegration alone, second by second."""
    parameters = preintegration_parameters(site.platform.imu, site.gravity, bridge=False)
    step, every = 1.0 / IMU_RATE_HZ, int(IMU_RATE_HZ)
    began = time.process_time()
    for start in range(0, len(imu), every):
        measurement = gtsam.PreintegratedCombinedMeasurementsG(
            parameters, gtsam.imuBias.ConstantBias()
        )
        rows = slice(start, start + every)
        for accel, gyro in zip(imu.accel_body[rows], imu.gyro_body[rows], strict=True):
            measurement.integrateMeasurement(accel, gyro, step)
    return time.process_time() - began


def plain_filterpy(site: Site, imu: ImuSamples) -> float:
    """Return the time of predicting 15 error states at every sample."""
    kalman = KalmanFilter(dim_x=15, dim_z=6)
    noise = site.platform.imu
    step = 1.0 / IMU_RATE_HZ
    kalman.Q = step * np.diag(
        np.repeat(
            [
                noise.gyro_noise,
                1e-6,
                noise.accel_noise,
                noise.accel_bias_walk,
                noise.gyro_bias_walk,
            ],
            3,
        )
        ** 2
    )
    attitude, velocity, position = Rotation.identity(), np.zeros(3), np.zeros(3)
    gravity = np.array([0.0, 0.0, site.gravity])
    began = time.process_time()
    for accel, gyro in zip(imu.accel_body, imu.gyro_body, strict=True):
        matrix = attitude.as_matrix()
        transition = np.eye(15)
        transition[0:3, 12:15] = -step * np.eye(3)
        transition[0:3, 0:3] -= step * skew(gyro)
        transition[3:6, 6:9] = step * np.eye(3)
        transition[6:9, 0:3] = -step * matrix @ skew(accel)
        transition[6:9, 9:12] = -step * matrix
        kalman.predict(F=transition)
        position = position + step * velocity
        velocity = velocity + step * (matrix @ accel - gravity)
        attitude = attitude * Rotation.from_rotvec(step * gyro)
    return time.process_time() - began


def memory_mib() -> float:
    """Return the largest resident size so far (MiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def timed(name: str, run: Callable[[], Array | float]) -> float:
    """Run, report and return a time."""
    value = float(run())
    print(f"{name:<34}{value:9.2f} s")
    return value


def main() -> None:
    """Print a table and one JSON line; exit with 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--updates", type=int, default=2000, help="10000 for the full figures")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    site = demo_site(coil_radius=None)
    imu, fields = simulated(site, float(options.updates), options.seed)
    figures: dict[str, object] = {"updates": len(fields), "imu_samples": len(imu)}
    bare = timed("integrateMeasurement, bare loop", lambda: bare_loop(site, imu))
    plain = timed("filterpy at every sample", lambda: plain_filterpy(site, imu))
    figures |= {"bare_loop_s": bare, "plain_filterpy_s": plain}
    failed = False
    for estimator in ("ekf", "smoother"):
        result = navigated(site, estimator, imu, fields)
        failed |= (
            result["p99_ms"] > P99_AT_MOST * result["p50_ms"] or result["last_to_first"] > FLAT
        )
        print(
            f"{estimator:<10}{result['seconds']:8.2f} s, {result['seconds'] / bare:6.1f} bare"
            f" loops; update {result['p50_ms']:.2f} / {result['p99_ms']:.2f} /"
            f" {result['max_ms']:.2f} ms (p50 / p99 / max), last to first"
            f" {result['last_to_first']:.2f}, memory +{result['memory_growth_mib']:.1f} MiB"
        )
        figures |= {f"{estimator}_{key}": value for key, value in result.items()}
        figures[f"{estimator}_bare_loops"] = result["seconds"] / bare
    step_ms, now_ms = 1e3 * bare / len(imu), propagation_ms(site, imu, fields)
    print(f"state of now {now_ms:.3f} ms, {now_ms / step_ms:.0f} bare steps of {step_ms:.4f} ms")
    figures |= {"carried_ms": now_ms, "carried_bare_steps": now_ms / step_ms}
    print(json.dumps(figures))
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
