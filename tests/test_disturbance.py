"""Iron, smooth random fields, day and night: against physics, magpylib and their own statistics."""

import json
import re
from dataclasses import replace
from pathlib import Path

import magpylib
import numpy as np
import pytest
from conftest import Refuse, run_command
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import spherical_jn
from scipy.stats import chi2

from magfusion.errors import InputError
from magfusion.files.log import read_log
from magfusion.model.physics.disturbance import induced_field, sphere_polarizability
from magfusion.model.site import Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import (
    CLEARANCE,
    Ambient,
    DayNight,
    FieldDrift,
    Spheres,
    draw_bending,
    draw_smooth,
    draw_spheres,
)
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.log import SimulationConfig, simulate_fields, simulate_log
from magfusion.simulation.motion import SimulatedMotion, static_motion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import DAY, MU0, NANOTESLA, Array

TWO_PI = 2.0 * np.pi
VOLUME = 4.0 * np.pi / MU0  # polarizability of a sphere of one metre, as radius cubed

# The moment of a sphere ------------------------------------------------------------------------


@pytest.mark.parametrize("permeability", [1.0, 3.0, 100.0, 1e6])
def test_at_rest_a_sphere_is_magnetised_by_its_permeability_alone(permeability: float) -> None:
    expected = VOLUME * 0.2**3 * (permeability - 1.0) / (permeability + 2.0)
    assert sphere_polarizability(0.2, permeability, 0.0, 157.0) == expected
    assert sphere_polarizability(0.2, permeability, 5e6, 0.0) == expected


@pytest.mark.parametrize("permeability", [1.0, 100.0])
def test_at_high_frequency_a_sphere_keeps_the_field_out(permeability: float) -> None:
    """The skin is thin; what enters it falls with the root of the frequency."""
    saturated = -0.5 * VOLUME * 0.2**3
    errors = [
        abs(sphere_polarizability(0.2, permeability, 5e6, w) / saturated - 1.0)
        for w in (1e11, 1e13)
    ]
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.02)


def test_a_poor_conductor_is_the_sum_of_rings_and_opposes_the_change() -> None:
    """Paper 004, Eq 24, with one turn a ring, its sign put right, summed over the sphere."""
    radius, conductivity, omega = 0.3, 1e3, TWO_PI * 25.0

    def ring(distance: float) -> float:  # S^2 / R a metre of distance from the axis
        height = 2.0 * np.sqrt(radius**2 - distance**2)
        return (np.pi * distance**2) ** 2 * conductivity * height / (TWO_PI * distance)

    expected = -1j * omega * quad(ring, 0.0, radius)[0]
    result = sphere_polarizability(radius, 1.0, conductivity, omega)
    assert result == pytest.approx(expected, rel=3e-3)  # the rings induce in each other
    assert expected.imag == pytest.approx(-omega * TWO_PI / 15.0 * conductivity * radius**5)


@pytest.mark.parametrize(
    ("radius", "permeability", "conductivity", "frequency_hz"),
    [(0.05, 1.0, 3.5e7, 25.0), (0.02, 100.0, 5e6, 25.0), (0.1, 30.0, 5e6, 10.0)],
)
def test_the_moment_is_that_of_the_diffusion_equation_solved_step_by_step(
    radius: float, permeability: float, conductivity: float, frequency_hz: float
) -> None:
    """``A'' + 2 A' / r - 2 A / r^2 = i w mu sigma A`` for the azimuthal potential inside."""
    square = 1j * TWO_PI * frequency_hz * MU0 * permeability * conductivity

    def slope(r: float, state: np.ndarray) -> list[complex]:
        return [state[1], -2.0 * state[1] / r + (2.0 / r**2 + square) * state[0]]

    start = 1e-6 * radius
    inside = solve_ivp(
        slope, (start, radius), [start + 0j, 1.0 + 0j], "DOP853", rtol=1e-11, atol=1e-14
    )
    potential, by_r = inside.y[:, -1]
    # Outside it is B r / 2 + D / r^2; A is continuous, and so is (r A)' / (mu r).
    ratio = (potential + radius * by_r) / potential / permeability
    dipole = radius**3 * (1.0 - ratio / 2.0) / (1.0 + ratio)
    result = sphere_polarizability(radius, permeability, conductivity, TWO_PI * frequency_hz)
    assert result == pytest.approx(VOLUME * dipole, rel=1e-7)


def test_the_moment_is_that_of_scipys_bessel_functions_at_any_skin_depth() -> None:
    """Through the join of series and closed form, which is at 0.03."""
    size = np.geomspace(1e-3, 30.0, 200)
    x = size * np.sqrt(-1j)
    q = x * spherical_jn(0, x) / spherical_jn(1, x) - 1.0
    conductivity = size**2 / (MU0 * 7.0)
    result = sphere_polarizability(1.0, 7.0, conductivity, 1.0)
    np.testing.assert_allclose(result, VOLUME * (14.0 - q) / (2.0 * (7.0 + q)), rtol=1e-9)
    finite = sphere_polarizability(1.0, np.array([1.0, 1e4]), 1e8, 1e12)
    assert np.isfinite(finite).all()


def test_a_sphere_takes_power_and_stays_between_iron_and_superconductor() -> None:
    rng = np.random.default_rng(1)
    permeability = np.exp(rng.uniform(0.0, 10.0, 1000))
    conductivity, omega = np.exp(rng.uniform(-5.0, 18.0, 1000)), np.exp(rng.uniform(0, 15, 1000))
    share = sphere_polarizability(1.0, permeability, conductivity, omega) / VOLUME
    assert np.all(share.imag <= 0.0)
    assert np.all((share.real >= -0.5) & (share.real < 1.0))


def test_the_static_moment_satisfies_the_boundary_with_magpylibs_sphere() -> None:
    """B inside is ``mu_r mu0 H`` inside: the applied field with that of the magnetised sphere."""
    radius, permeability = 0.15, 40.0
    applied = np.array([1e-6, -2e-6, 3e-6])
    moment = sphere_polarizability(radius, permeability, 0.0, 0.0).real * applied
    polarisation = MU0 * moment / (4.0 / 3.0 * np.pi * radius**3)
    sphere = magpylib.magnet.Sphere(polarization=polarisation, diameter=2.0 * radius)
    inside = [[0.0, 0.0, 0.0], [0.05, -0.1, 0.02]]
    flux = applied + sphere.getB(inside)
    strength = applied / MU0 + sphere.getH(inside)
    np.testing.assert_allclose(flux, permeability * MU0 * strength, rtol=1e-7)
    outside = np.array([[0.3, 0.2, -0.1], [-0.1, 0.16, 0.4]])
    result = induced_field(
        outside, np.zeros((1, 3)), np.array([[moment[0] / applied[0]]]), applied[None, None]
    )
    np.testing.assert_allclose(result[:, 0].real, sphere.getB(outside), rtol=1e-9)


def test_what_one_coil_induces_at_another_is_what_that_induces_at_the_first() -> None:
    """Reciprocity: ``m2 . B(r2) of m1`` is ``m1 . B(r1) of m2``, by way of any spheres."""
    rng = np.random.default_rng(2)
    place, moment = np.array([[3.0, 0.5, 0.0], [-3.0, 1.0, 2.0]]), rng.normal(size=(2, 3))
    centre = rng.normal(size=(4, 3))
    polarizability = rng.normal(size=(4, 1)) + 1j * rng.normal(size=(4, 1))

    def at_other(source: int) -> complex:
        primary = magpylib.misc.Dipole(moment=moment[source], position=place[source]).getB(centre)
        other = 1 - source
        field = induced_field(place[other][None], centre, polarizability, primary[:, None] + 0j)
        return complex(field[0, 0] @ moment[other])

    assert at_other(0) == pytest.approx(at_other(1), rel=1e-10)


# Iron in the simulator --------------------------------------------------------------------------


def plain_site() -> Site:
    site = replace(demo_site(), earth_field_world=None)
    magnetometer = replace(site.platform.magnetometer, noise_density=0.0)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def still() -> SimulatedMotion:
    return static_motion(np.array([3.0, 2.5, 1.0]), Rotation.from_rotvec((0.1, -0.2, 0.7)))


def some_spheres() -> Spheres:
    beacons_world = np.array([b.position_world for b in demo_site().beacons])
    return draw_spheres(np.random.default_rng(3), 8, DEMO_BOX_WORLD, beacons_world)


def test_the_waveform_has_what_the_phasors_say_of_steel() -> None:
    site, spheres = plain_site(), some_spheres()
    pose = still().trajectory(np.array([0.5]))
    free_parameters, with_iron = (
        simulate_fields(site, pose, 0.0, np.random.default_rng(1), spheres=s).phasor_sensor[0]
        for s in (None, spheres)
    )
    change = np.linalg.norm(with_iron - free_parameters, axis=-1) / np.linalg.norm(
        free_parameters, axis=-1
    )
    assert np.all((change > 1e-3) & (change < 0.1))
    wave = simulate_waveform(
        still(),
        site,
        synchronised_drives(site),
        400.0,
        1.0,
        np.random.default_rng(1),
        ambient=Ambient(spheres),
    )
    for k, beacon in enumerate(site.beacons):
        carrier = np.exp(-2j * np.pi * beacon.frequency_hz * wave.time)
        phasor = 2.0 * np.mean(wave.measured_sensor * carrier[:, None], axis=0)
        np.testing.assert_allclose(phasor / NANOTESLA, with_iron[k] / NANOTESLA, atol=1e-6)


def test_a_sphere_without_iron_or_conduction_is_not_there() -> None:
    site, spheres = plain_site(), some_spheres()
    air = replace(spheres, permeability=np.ones(8), conductivity=np.zeros(8))
    pose = still().trajectory(np.zeros(1))
    free_parameters, with_air = (
        simulate_fields(site, pose, 0.0, np.random.default_rng(1), spheres=s).phasor_sensor
        for s in (None, air)
    )
    np.testing.assert_array_equal(free_parameters, with_air)


def test_drawn_spheres_keep_clear_of_the_way_the_beacons_and_each_other() -> None:
    beacons_world = np.array([b.position_world for b in demo_site().beacons])
    for seed in range(5):
        spheres = draw_spheres(np.random.default_rng(seed), 30, DEMO_BOX_WORLD, beacons_world)
        place, radius = spheres.position_world, spheres.radius
        nearest = np.clip(place, DEMO_BOX_WORLD[0], DEMO_BOX_WORLD[1])
        assert np.all(np.linalg.norm(place - nearest, axis=1) > radius + CLEARANCE)
        to_beacons = np.linalg.norm(place[:, None] - beacons_world, axis=-1)
        assert np.all(to_beacons > radius[:, None] + CLEARANCE)
        between = np.linalg.norm(place[:, None] - place, axis=-1) + 10.0 * np.eye(30)
        assert np.all(between > radius + radius[:, None])


def test_a_way_through_iron_is_refused() -> None:
    inside = Spheres(
        np.array([[3.0, 2.5, 1.1]]), np.array([0.3]), np.array([100.0]), np.array([5e6])
    )
    with pytest.raises(InputError, match=r"spheres: .* sphere 0 of radius 0\.3 m"):
        simulate_fields(
            plain_site(),
            still().trajectory(np.zeros(1)),
            0.0,
            np.random.default_rng(1),
            spheres=inside,
        )


def test_iron_leaves_motion_and_instruments_as_they_were() -> None:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=3.0)
    free_parameters, with_iron, again = (
        simulate_log(demo_site(), replace(config, iron=iron), np.random.default_rng(1))
        for iron in (0, 5, 5)
    )
    assert free_parameters.ambient is None
    assert with_iron.ambient is not None
    assert with_iron.ambient.spheres is not None
    assert len(with_iron.ambient.spheres) == 5
    assert free_parameters.log.waveform is not None
    assert with_iron.log.waveform is not None
    assert again.log.waveform is not None
    np.testing.assert_array_equal(free_parameters.log.imu.gyro_body, with_iron.log.imu.gyro_body)
    change = with_iron.log.waveform.measured_sensor - free_parameters.log.waveform.measured_sensor
    assert 1.0 < np.std(change) / NANOTESLA < 1e3
    np.testing.assert_array_equal(
        with_iron.log.waveform.measured_sensor, again.log.waveform.measured_sensor
    )


def test_simulate_draws_iron_and_counts_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, options in {"free": [], "iron": ["--iron", 4], "again": ["--iron", 4]}.items():
        run_command("simulate", "-o", tmp_path / name, "--duration", 2, "--json", *options)
        figures = json.loads(capfd.readouterr().out.splitlines()[-1])
        assert figures["iron_spheres"] == (4 if options else 0)
        written = json.loads((tmp_path / name / "report.json").read_text())
        assert written["iron_spheres"] == figures["iron_spheres"]
    waves = [read_log(tmp_path / name).waveform for name in ("free", "iron", "again")]
    free_parameters, with_iron, again = (w.measured_sensor for w in waves if w is not None)
    assert np.std(with_iron - free_parameters) > NANOTESLA
    np.testing.assert_array_equal(with_iron, again)


@pytest.mark.parametrize(
    ("iron", "reported"),
    [
        ("-1", "--iron must lie between 0 and 200"),
        ("2.5", "--iron.*integer"),
        ("many", "--iron.*integer"),
        ("nan", "--iron.*integer"),
        ("5000", "--iron must lie between 0 and 200"),
    ],
)
def test_iron_that_cannot_be_is_refused(
    iron: str, reported: str, tmp_path: Path, refuse: Refuse
) -> None:
    sentence = refuse("simulate", "-o", tmp_path / "out", "--duration", 2, "--iron", iron)
    assert re.search(reported, sentence), sentence


def test_more_iron_than_there_is_room_for_is_refused() -> None:
    config = SimulationConfig(np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]]), 1.0, iron=1000)
    with pytest.raises(InputError, match="iron: found 1000 spheres, but only"):
        simulate_log(demo_site(), config, np.random.default_rng(1))


def test_a_negative_number_of_spheres_is_refused_in_python_too() -> None:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=1.0, iron=-1)
    with pytest.raises(InputError, match="iron: found -1 spheres"):
        simulate_log(demo_site(), config, np.random.default_rng(1))


# Smooth random fields ---------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [1, 3])
def test_smooth_fields_have_the_covariance_that_they_say(dimension: int) -> None:
    rms, length = 0.3, 1.7
    distance = np.array([0.0, 0.5, 1.0, 2.0, 4.0]) * length
    direction = np.full(dimension, 1.0 / np.sqrt(dimension))
    rng = np.random.default_rng(4)
    products = []
    for _ in range(200):
        value = draw_smooth(rng, rms, length, 300, dimension)(5.0 + distance[:, None] * direction)
        products.append(np.mean(value[0] * value, axis=1))
    expected = rms**2 * np.exp(-0.5 * (distance / length) ** 2)
    error = np.std(products, axis=0) / np.sqrt(len(products))
    assert np.all(np.abs(np.mean(products, axis=0) - expected) < 4.0 * error)
    assert np.all(error < 0.01 * rms**2)


def test_smooth_fields_are_as_gaussian_as_they_claim_and_independent() -> None:
    value = draw_smooth(np.random.default_rng(5), 2.0, 1.0, 20_000)(np.zeros((1, 3)))[0]
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], value.size)
    assert low < np.sum((value / 2.0) ** 2) < high
    assert np.mean(np.abs(value) > 2.0) == pytest.approx(0.3173, abs=0.013)  # 4 sigma
    assert np.mean(value[::2] * value[1::2]) / 4.0 == pytest.approx(0.0, abs=0.04)


# Day, night and drift ---------------------------------------------------------------------------


def background(ambient: Ambient, time: Array, seed: int = 1) -> Array:
    return ambient.background_world(time, 2.0, np.random.default_rng(seed))


def test_noise_is_loud_by_day_and_quiet_at_night() -> None:
    room = Ambient(day_night=DayNight(1e-10, 4e-10, noisiest_time=0.25 * DAY))
    time = np.arange(0.0, DAY, 1.0)
    value = background(room, time)  # at 2 Hz, so that a sample's variance is the squared density
    for hour, density in ((6, 4e-10), (18, 1e-10), (0, 2.5e-10), (12, 2.5e-10)):
        near = np.abs((time / 3600.0 - hour + 12.0) % 24.0 - 12.0) < 0.5
        assert np.std(value[near]) / density == pytest.approx(1.0, rel=0.02)


def test_drift_is_as_large_and_as_slow_as_said() -> None:
    room = Ambient(drift=FieldDrift(2e-8, 3600.0))
    time = np.arange(0.0, 40.0 * DAY, 600.0)
    value = background(room, time) / 2e-8
    np.testing.assert_allclose(np.sqrt(np.mean(value**2, axis=0)), 1.0, atol=0.2)
    slope = np.diff(value, axis=0) * 6.0  # an hour; its rms is rms / correlation time
    np.testing.assert_allclose(np.sqrt(np.mean(slope**2, axis=0)), 1.0, atol=0.2)
    dense = np.arange(0.0, 600.0, 0.01)
    by_knots, exact = background(room, dense), background(room, dense[[0, 30_000, -1]])
    np.testing.assert_allclose(by_knots[[0, 30_000, -1]] / 2e-8, exact / 2e-8, atol=1e-6)


def test_a_room_adds_its_background_to_the_waveform_turned_into_the_sensor() -> None:
    site = replace(plain_site(), beacons=())
    drift = Ambient(drift=FieldDrift(2e-8, 1e6))
    drives = synchronised_drives(plain_site())
    drives = replace(drives, phase=drives.phase[:0], drift=drives.drift[:0])
    wave = simulate_waveform(
        still(), site, drives, 10.0, 1.0, np.random.default_rng(6), ambient=drift
    )
    world = drift.background_world(wave.time, 10.0, np.random.default_rng(6))
    turn = still().world_from_body(np.zeros(1))[0].as_matrix()
    turn = turn @ site.platform.magnetometer.body_from_sensor
    np.testing.assert_allclose(wave.measured_sensor / 1e-8, world @ turn / 1e-8, atol=1e-9)


@pytest.mark.slow
def test_a_bent_field_is_off_by_its_share_and_alike_nearby() -> None:
    rng = np.random.default_rng(3)
    start = rng.uniform(0.0, 3.0, (4500, 3))
    phasor = rng.standard_normal((4500, 2, 3)) + 1j * rng.standard_normal((4500, 2, 3))
    error: list[list[Array]] = [[], []]
    for seed in range(6):
        bending = draw_bending(np.random.default_rng(seed), 0.04, 0.5, 2)
        for kept, place in zip(error, (start, start + np.array([0.5, 0.0, 0.0])), strict=True):
            kept.append(bending.bent_world(1, phasor, place) - phasor)
    size = np.linalg.norm(np.array(error[0])) / np.linalg.norm(phasor) / np.sqrt(6.0)
    assert size == pytest.approx(0.04, rel=0.1)
    shared = np.vdot(error[0], error[1]).real / np.vdot(error[0], error[0]).real
    assert shared == pytest.approx(np.exp(-0.5), abs=0.05)  # a correlation length apart
    other = draw_bending(np.random.default_rng(0), 0.04, 0.5, 2).bent_world(0, phasor, start)
    between = np.vdot(error[0][0], other - phasor) / np.linalg.norm(error[0][0]) ** 2
    assert abs(between) < 0.2


def test_simulate_disturbs_what_it_is_asked_to_and_nothing_else(tmp_path: Path) -> None:
    requested = {
        "free": [],
        "noisy": ["--ambient", "day-night"],
        "drifting": ["--drift", "1e-7"],
        "bent": ["--random-field", "0.1"],
    }
    for name, options in requested.items():
        run_command("simulate", "-o", tmp_path / name, "--duration", 4, "--no-perturb", *options)
    logs = {name: read_log(tmp_path / name) for name in requested}
    waves = {name: log.waveform.measured_sensor for name, log in logs.items() if log.waveform}
    for log in logs.values():
        np.testing.assert_array_equal(log.imu.gyro_body, logs["free"].imu.gyro_body)
    bent = waves["bent"] - waves["free"]  # the same noise: the difference is the field's
    spectrum = np.abs(np.fft.rfft(bent * np.hanning(len(bent))[:, None], axis=0)).sum(axis=1)
    tones = np.fft.rfftfreq(len(bent), logs["bent"].waveform.time[1])[
        spectrum > 0.1 * spectrum.max()
    ]
    assert np.all((tones > 15.0) & (tones < 50.0))
    strong = np.diff(waves["noisy"] - waves["free"], axis=0)
    assert np.std(strong) / np.sqrt(2.0) > 2e-10 * np.sqrt(200.0)
    slow = np.linalg.norm(np.mean(waves["drifting"] - waves["free"], axis=0))
    assert 1e-9 < slow < 5e-7
