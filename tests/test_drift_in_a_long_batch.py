"""Over hours the moments drift: in a long batch as online, each stretch has values of its own."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import Smoothed, smooth
from magfusion.estimation.graph import drift_segments
from magfusion.estimation.graph.drift_segments import SEGMENT
from magfusion.estimation.solve.ordering import nested_dissection
from magfusion.model.parameters import (
    LOG_MOMENT,
    choose_blocks,
    difference,
    dimension,
    initial_calibration,
    retract,
)
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import BeaconSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields

HOURS, EVERY, RATE_HZ = 2.0, 20.0, 20.0
DRIFT = 4e-3  # of the log-moments of the first beacon, from the first epoch to the last
POSITION_WORLD = np.array([2.0, 1.5, 1.0])


def a_site() -> Site:
    """Return a site of which only the first beacon's moments are not known well."""
    site = replace(demo_site(coil_radius=None), model_error=1e-6)
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    open_ = replace(known, log_moment=np.full(2, 5e-3))
    beacons = [replace(b, sigma=open_ if k == 0 else known) for k, b in enumerate(site.beacons)]
    sensor = site.platform.magnetometer
    sigma = replace(sensor.sigma, matrix=np.zeros((3, 3)))
    sigma = replace(sigma, rotation_sensor=np.zeros(3), position_body=np.zeros(3))
    imu = replace(site.platform.imu, time_offset_sigma=0.0)
    platform = replace(site.platform, imu=imu, magnetometer=replace(sensor, sigma=sigma))
    return replace(site, beacons=tuple(beacons), platform=platform)


def drift_at(time: np.ndarray) -> np.ndarray:
    return DRIFT * (time / (3600.0 * HOURS) - 0.5)


def a_log(site: Site, hours: float, seed: int) -> Log:
    rng, imu = np.random.default_rng(seed), site.platform.imu
    number = int(3600.0 * hours * RATE_HZ)
    gyro, accel = rng.standard_normal((2, number, 3)) * np.sqrt(RATE_HZ)
    gyro, accel = imu.gyro_noise * gyro, imu.accel_noise * accel + [0.0, 0.0, site.gravity]
    time = np.arange(EVERY / 2.0, 3600.0 * hours - 1.0, EVERY)
    declared, blocks = initial_calibration(site, 0.0), choose_blocks(site, ("moments",))
    parts: list[FieldSamples] = []
    for now, step in zip(time, drift_at(time), strict=True):
        there = retract(declared, blocks, np.full(dimension(blocks), step)).site
        pose = Trajectory(np.array([now]), np.eye(3)[None], POSITION_WORLD[None])
        parts.append(simulate_fields(there, pose, 2e-10, rng))
    fields = FieldSamples.joined(parts)
    return Log(
        "long", 0, "test", ImuSamples(np.arange(number) / RATE_HZ, gyro, accel), None, fields
    )


@pytest.fixture(scope="module")
def smoothed() -> tuple[Site, Log, Smoothed]:
    site = a_site()
    log = a_log(site, HOURS, 1)
    return site, log, smooth(log, site)


@pytest.mark.slow
def test_each_segment_follows_the_drift(smoothed: tuple[Site, Log, Smoothed]) -> None:
    _, _, result = smoothed
    count = len(result.graph.segments)
    assert count == int(np.ceil(3600.0 * HOURS / SEGMENT))
    assert all(block.parameter == LOG_MOMENT for block in result.blocks)
    centre = (np.arange(count) + 0.5) * 3600.0 * HOURS / count
    estimate = np.array(
        [difference(result.declared, c, result.blocks) for c in result.estimate.segments]
    )
    sigma = np.sqrt(np.diag(result.calibration_cov))
    assert np.all(sigma < 0.1 * DRIFT)
    np.testing.assert_allclose(estimate, np.tile(drift_at(centre)[:, None], 2), atol=0.1 * DRIFT)
    main = result.estimate.segments[result.graph.segments.main]
    assert np.all(difference(result.calibration, main, result.blocks) == 0.0)


@pytest.mark.slow
def test_the_drift_does_not_move_the_platform(
    smoothed: tuple[Site, Log, Smoothed], monkeypatch: pytest.MonkeyPatch
) -> None:
    site, log, result = smoothed
    assert log.fields is not None
    monkeypatch.setattr(drift_segments, "SEGMENT", np.inf)
    rigid = smooth(log, site)
    assert len(rigid.graph.segments) == 1

    def worst(result: Smoothed) -> float:
        error = result.states.position_world - POSITION_WORLD
        ends = np.r_[: len(error) // 8, -(len(error) // 8) : 0]
        return float(np.linalg.norm(np.mean(np.abs(error[ends]), axis=0)))

    assert worst(result) < 0.7 * worst(rigid)
    expected = 0.5 * log.fields.phasor_sensor.size * 2.0  # half the residuals, real and imaginary
    assert result.cost - expected < 0.25 * (rigid.cost - expected)


def test_a_log_of_one_segment_has_one_calibration() -> None:
    site = a_site()
    result = smooth(a_log(site, 0.4, 2), site)
    assert len(result.graph.segments) == len(result.estimate.segments) == 1


def test_the_ordering_ends_every_segment_with_its_own_variable() -> None:
    ordering = nested_dissection(8, 99, [(0, 90), (3, 99), (6, 92)])
    keys = [ordering.at(i) for i in range(ordering.size())]
    assert len(keys) == len(set(keys)) == 3 * 8 + 3
    assert keys[-1] == 99
    whole = {nested_dissection(8, None).at(i) for i in range(24)}
    assert set(keys) == whole | {90, 92, 99}
