"""Motion inside the windows of several magnetometers: taken off each by its own place and clock."""

from dataclasses import replace

import numpy as np
import pytest
from test_several_magnetometers import only, two_magnetometers

from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.demodulation.several_demodulation import demodulated_several, same_windows
from magfusion.model.parameters import Calibration, initial_calibration, predict_channels, seen_by
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

BOX = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])


@pytest.fixture(scope="module")
def site() -> Site:
    return two_magnetometers(demo_site(coil_radius=None))


@pytest.fixture(scope="module")
def walk(site: Site) -> SimulatedLog:
    """Almost without noise, so that what is left is of the motion."""
    config = SimulationConfig(box_world=BOX, duration=10.0, noise_scale=1e-9)
    return simulate_log(site, config, np.random.default_rng(3))


def known(walk: SimulatedLog, time: np.ndarray) -> tuple[Calibration, Trajectory]:
    """Return all that is true of a walk."""
    site, drives = walk.true_site, walk.drives
    phase = np.tile(drives.phase, len(site.platform.magnetometers))
    calibration = initial_calibration(site, 0.0, float(walk.log.imu.time[0]))
    states = walk.motion.trajectory(time)
    calibration = replace(calibration, phase=phase, drift=drives.drift)
    none = np.zeros((len(time), 3))
    return calibration, replace(states, gyro_bias_body=none, accel_bias_body=none)


def test_what_is_left_of_the_motion_is_far_less_than_without(walk: SimulatedLog) -> None:
    result = demodulated_several(walk.log, walk.true_site)
    calibration, states = known(walk, result.fields.time)
    wave = result.compensated(calibration, states)
    pose = states.time, states.world_from_body, states.position_world
    expected = predict_channels(calibration, *pose)
    size = np.linalg.norm(expected, axis=2)
    before, after = (
        np.linalg.norm(fields.phasor_sensor - expected, axis=2) / size
        for fields in (result.fields, wave.fields)
    )
    for k in range(2):
        mine = walk.true_site.of_sensor(k)
        assert np.nanmedian(after[:, mine]) < 0.1 * np.nanmedian(before[:, mine])


def test_each_is_demodulated_as_if_it_were_alone(walk: SimulatedLog) -> None:
    site = walk.true_site
    result = demodulated_several(walk.log, site)
    calibration, states = known(walk, result.fields.time)
    wave = result.compensated(calibration, states)
    for k, sensor in enumerate(site.platform.magnetometers):
        own = walk.log.waveforms[sensor.name]
        log = replace(
            walk.log, waveforms={}, waveform=replace(own, time=own.time + sensor.clock_offset)
        )
        alone = demodulated(log, only(site, k), same_windows(site, None))
        rows = np.isin(np.round(states.time, 6), np.round(alone.fields.time, 6))
        here = {n: v[rows] for n, v in vars(states).items() if v is not None}
        expected = alone.compensated(seen_by(calibration, k), Trajectory(**here))
        mine = rows, site.of_sensor(k)
        np.testing.assert_allclose(
            wave.fields.phasor_sensor[mine], expected.fields.phasor_sensor, rtol=1e-9, atol=0.0
        )
        np.testing.assert_allclose(
            wave.by_time_offset[mine], expected.by_time_offset, rtol=1e-9, atol=1e-20
        )
