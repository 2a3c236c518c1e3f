"""Simulated fields and waveforms against magpylib, spectra and their own statistics."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.model.site import Coil
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives, coil_field, synchronised_drives
from magfusion.simulation.log import (
    draw_drives,
    perturb_site,
    simulate_fields,
)
from magfusion.simulation.motion import random_walk_motion, static_motion
from magfusion.simulation.waveform import Mains, simulate_waveform


def walk(seed=1, duration=60.0, **options):
    return random_walk_motion(np.random.default_rng(seed), duration, DEMO_BOX_WORLD, **options)


def still(position=(3.0, 2.5, 1.0), rotvec=(0.1, -0.2, 0.7)):
    return static_motion(np.array(position), Rotation.from_rotvec(rotvec))


def without_noise(site):
    magnetometer = replace(site.platform.magnetometer, noise_density=0.0)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def without_earth(site):
    return replace(site, earth_field_world=None)


def chi2_bounds(degrees, miss=1e-4):
    return chi2.ppf([miss / 2.0, 1.0 - miss / 2.0], degrees)


def around(radius, count=200):
    points = np.random.default_rng(6).normal(size=(count, 3))
    return points * radius / np.linalg.norm(points, axis=1)[:, None]


def relative_error(result, expected):
    return np.linalg.norm(result - expected, axis=1).max() / np.linalg.norm(expected, axis=1).min()


@pytest.mark.parametrize("distance", [0.5, 0.8, 3.0])
def test_a_coil_with_a_radius_has_the_field_of_magpylibs_circle(distance):
    moment, radius, centre = np.array([30.0, -100.0, 200.0]), 0.25, np.array([0.1, 0.0, -0.05])
    current = np.linalg.norm(moment) / (np.pi * radius**2)
    axis = Rotation.align_vectors(moment[None], [[0.0, 0.0, 1.0]])[0]
    circle = magpylib.current.Circle(
        current=current, diameter=2.0 * radius, orientation=axis, position=centre
    )
    points = centre + around(distance)
    result = coil_field(points, Coil(moment, centre_beacon=centre, radius=radius))
    assert relative_error(result, circle.getB(points)) < 1e-7


def test_a_coil_with_radius_and_length_has_the_field_of_magpylibs_cylinder():
    moment, radius, length = 200.0, 0.2, 0.3
    # A uniformly magnetised cylinder is a uniform current sheet; polarisation = mu0 m / volume.
    polarisation = 4e-7 * np.pi * moment / (np.pi * radius**2 * length)
    cylinder = magpylib.magnet.Cylinder(
        polarization=(0.0, 0.0, polarisation), dimension=(2.0 * radius, length)
    )
    points = around(2.0 * length)
    coil = Coil(np.array([0.0, 0.0, moment]), radius=radius, length=length)
    assert relative_error(coil_field(points, coil), cylinder.getB(points)) < 1e-5


def test_the_sizes_of_a_coil_fade_with_the_square_of_the_distance():
    moment = np.array([0.0, 200.0, 0.0])
    for sizes in ({"radius": 0.2}, {"length": 0.4}):
        differences = [
            relative_error(coil_field(around(r), Coil(moment, **sizes)), dipole)
            for r in (2.0, 4.0)
            for dipole in [coil_field(around(r), Coil(moment))]
        ]
        assert differences[0] > 1e-3
        assert differences[0] / differences[1] == pytest.approx(4.0, rel=0.1)


def test_a_waveform_has_the_lines_that_magpylibs_dipoles_give():
    site = without_earth(without_noise(demo_site(coil_radius=None)))
    motion, magnetometer = still(), site.platform.magnetometer
    wave = simulate_waveform(
        motion, site, synchronised_drives(site), 400.0, 2.0, np.random.default_rng(1)
    )
    spectrum = 2.0 * np.fft.rfft(wave.measured_sensor, axis=0) / len(wave)
    world_from_body = motion.world_from_body(np.zeros(1))[0]
    point = motion.position_world(np.zeros(1))[0] + world_from_body.apply(
        magnetometer.position_body
    )
    sensor_from_world = (world_from_body.as_matrix() @ magnetometer.body_from_sensor).T
    lines = np.zeros_like(spectrum)
    for beacon in site.beacons:
        for coil in beacon.coils:
            dipole = magpylib.misc.Dipole(
                moment=coil.moment_beacon,
                position=beacon.position_world,
                orientation=Rotation.from_matrix(beacon.world_from_beacon),
            )
            field_sensor = sensor_from_world @ dipole.getB(point)
            lines[round(2.0 * beacon.frequency_hz)] += field_sensor * np.exp(1j * coil.phase)
    nanotesla = 1e-9
    np.testing.assert_allclose(spectrum / nanotesla, lines / nanotesla, atol=1e-4)
    assert np.abs(lines / nanotesla).max() > 100.0


def test_a_still_magnetometer_shows_the_earth_through_its_matrix_and_offset():
    site = without_noise(replace(demo_site(), beacons=()))
    skewed = replace(
        site.platform.magnetometer,
        matrix=np.eye(3) + 0.02 * np.arange(9.0).reshape(3, 3),
        offset=np.array([1e-7, -2e-7, 3e-7]),
    )
    site = replace(site, platform=replace(site.platform, magnetometer=skewed))
    nothing = Drives(np.zeros(0), np.zeros(0))
    wave = simulate_waveform(still(), site, nothing, 10.0, 1.0, np.random.default_rng(1))
    field_body = Rotation.from_rotvec((0.1, -0.2, 0.7)).as_matrix().T @ site.earth_field_world
    # The demo's mounting is yawed by -90 degrees: sensor x is body -y, sensor y is body x.
    field_sensor = np.array([-field_body[1], field_body[0], field_body[2]])
    measured = skewed.matrix @ field_sensor + skewed.offset
    np.testing.assert_allclose(wave.measured_sensor, np.tile(measured, (10, 1)), rtol=1e-12)


def test_magnetometer_noise_has_its_one_sided_density():
    site = replace(without_earth(demo_site()), beacons=())
    nothing = Drives(np.zeros(0), np.zeros(0))
    wave = simulate_waveform(still(), site, nothing, 300.0, 30.0, np.random.default_rng(7))
    scaled = wave.measured_sensor / (2.5e-10 * np.sqrt(150.0))
    low, high = chi2_bounds(scaled.size)
    assert low < np.sum(scaled**2) < high


def test_mains_stand_on_their_frequency_and_harmonics():
    site = without_noise(replace(without_earth(demo_site()), beacons=()))
    mains = Mains(4e-8, 50.0, harmonics=(0.0, 0.25))
    nothing = Drives(np.zeros(0), np.zeros(0))
    wave = simulate_waveform(still(), site, nothing, 400.0, 1.0, np.random.default_rng(8), mains)
    spectrum = 2.0 * np.abs(np.fft.rfft(wave.measured_sensor, axis=0)) / len(wave)
    lines_nt = np.linalg.norm(spectrum, axis=1) / 1e-9
    assert lines_nt[[50, 100, 150]] == pytest.approx([40.0, 0.0, 10.0], abs=1e-9)


def test_quantised_samples_are_whole_steps_within_half_a_step():
    site, step = demo_site(), 1e-9
    arguments = (walk(), site, synchronised_drives(site), 200.0, 5.0)
    fine = simulate_waveform(*arguments, np.random.default_rng(9)).measured_sensor
    coarse = simulate_waveform(
        *arguments, np.random.default_rng(9), quantisation=step
    ).measured_sensor
    np.testing.assert_allclose(coarse / step, np.round(coarse / step), rtol=0.0, atol=1e-6)
    assert np.abs(coarse - fine).max() / step == pytest.approx(0.5, abs=0.01)


def test_drift_and_phase_turn_the_tone_as_they_say():
    site = without_earth(without_noise(demo_site()))
    phase, drift = np.array([0.4, -1.0, 2.0, 3.0]), np.array([2e-5, -3e-5, 0.0, 1e-4])
    wave = simulate_waveform(
        still(), site, Drives(phase, drift), 400.0, 100.0, np.random.default_rng(1)
    )
    declared = simulate_fields(
        site, still().trajectory(np.zeros(1)), 0.0, np.random.default_rng(1)
    ).phasor_sensor[0]
    for start in (0, 99):  # one-second windows, whole cycles of every tone
        window = slice(400 * start, 400 * (start + 1))
        for k, beacon in enumerate(site.beacons):
            carrier = np.exp(-2j * np.pi * beacon.frequency_hz * wave.time[window])
            phasor = 2.0 * np.mean(wave.measured_sensor[window] * carrier[:, None], axis=0)
            rotated = np.angle(np.vdot(declared[k], phasor) * np.exp(-1j * phase[k]))
            expected = 2.0 * np.pi * beacon.frequency_hz * drift[k] * (start + 0.5)
            assert rotated == pytest.approx(expected, abs=2e-3)  # rad, leakage of the other tones


def test_phasors_in_hand_are_those_of_the_waveform():
    site = perturb_site(demo_site(synchronised=False), np.random.default_rng(10))
    skew = np.eye(3) + 0.02 * np.arange(9.0).reshape(3, 3)
    magnetometer = replace(site.platform.magnetometer, matrix=skew, noise_density=0.0)
    site = replace(site, platform=replace(site.platform, magnetometer=magnetometer))
    drives = draw_drives(site, np.random.default_rng(11))
    wave = simulate_waveform(still(), site, drives, 400.0, 1.0, np.random.default_rng(1))
    fields = simulate_fields(
        site, still().trajectory(np.array([0.5])), 0.0, np.random.default_rng(1), drives
    )
    for k, beacon in enumerate(site.beacons):
        carrier = np.exp(-2j * np.pi * beacon.frequency_hz * wave.time)
        phasor = 2.0 * np.mean(wave.measured_sensor * carrier[:, None], axis=0)
        difference = np.linalg.norm(fields.phasor_sensor[0, k] - phasor)
        assert difference / np.linalg.norm(phasor) < 2e-3  # leakage of drifting tones


def test_phasors_in_hand_have_the_noise_that_they_claim():
    site, sigma = demo_site(), 3e-10
    trajectory = walk().trajectory(np.arange(0.0, 60.0, 0.2))
    noisy = simulate_fields(site, trajectory, sigma, np.random.default_rng(12))
    clean = simulate_fields(site, trajectory, 0.0, np.random.default_rng(12))
    error = noisy.phasor_sensor - clean.phasor_sensor
    low, high = chi2_bounds(error.size)
    for part in (error.real, error.imag):
        assert low < np.sum((part / sigma) ** 2) < high
    assert noisy.phasor_cov[5, 2] == pytest.approx(sigma**2 * np.eye(3))
    assert noisy.channels == (("A", 0), ("B", 0), ("C", 0), ("D", 0))
