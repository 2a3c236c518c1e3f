"""A small log that holds every stream, of numbers without meaning, for tests of its files."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.samples import FieldSamples, ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory

EPOCH_NS = 1_700_000_000_123_456_789


def example_trajectory(rng: np.random.Generator, time: np.ndarray) -> Trajectory:
    n = len(time)
    root = rng.standard_normal((n, 6, 6))
    return Trajectory(
        time=time,
        world_from_body=Rotation.random(n, random_state=rng).as_matrix(),
        position_world=rng.standard_normal((n, 3)),
        velocity_world=rng.standard_normal((n, 3)),
        gyro_bias_body=rng.standard_normal((n, 3)),
        accel_bias_body=rng.standard_normal((n, 3)),
        pose_cov=root @ root.transpose(0, 2, 1),
    )


def example_fields(rng: np.random.Generator) -> FieldSamples:
    n, channels = 20, (("B", 1), ("A", 0), ("B", 0))
    phasor = 1e-6 * (rng.standard_normal((n, 3, 3)) + 1j * rng.standard_normal((n, 3, 3)))
    root = 1e-9 * rng.standard_normal((n, 3, 3, 3))
    cov = root @ root.swapaxes(2, 3) + 1e-20 * np.eye(3)
    missing = rng.random((n, 3)) < 0.3
    missing[0] = missing[:, 0] = False
    phasor[missing], cov[missing] = np.nan, np.nan
    return FieldSamples(0.2 + 0.1 * np.arange(n), np.full(n, 0.4), channels, phasor, cov)


def example_log(seed: int = 1) -> Log:
    rng = np.random.default_rng(seed)
    time = np.sort(rng.choice(2_000_000_000, 400, replace=False)) * 1e-9
    accel = np.array([0.0, 0.0, 9.81]) + rng.standard_normal((400, 3))
    earth = np.array([2e-5, 0.0, -4e-5])
    return Log(
        name="walk",
        epoch_ns=EPOCH_NS,
        source="test",
        imu=ImuSamples(time, rng.standard_normal((400, 3)), accel),
        waveform=Waveform(time + 1e-3, earth + 1e-6 * rng.standard_normal((400, 3))),
        fields=example_fields(rng),
        truth=example_trajectory(rng, time[::4]),
    )
