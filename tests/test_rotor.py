"""A magnet on a shaft is two coils in quadrature, whatever its speed does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.demodulation.drive_reference import (
    referred,
    turning_currents,
    with_drives,
)
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.field import predict
from magfusion.model.physics.casing import (
    Casing,
    gathering_weights,
    tube_response,
)
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.rotor import Depths, Rotor, RotorAngles
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site, rotor_coils
from magfusion.receiver.rotor import demodulate_rotor
from magfusion.receiver.rotor_phase import followed_angle
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.pipe import Pipe, Steel, wall_transmission
from magfusion.simulation.shaft import Shaft, shaft_angle, turned_moment
from magfusion.units import Array

ROTOR = Rotor(200.0, np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0]))
SPEED_HZ, NOISE = 3.0, 2e-11


def _site() -> Site:
    plain = demo_site()
    beacon = replace(
        plain.beacons[0],
        name="bit",
        coils=rotor_coils(ROTOR, SPEED_HZ),
        frequency_hz=SPEED_HZ,
        rotor=ROTOR,
        sigma=replace(plain.beacons[0].sigma, log_moment=np.full(2, 0.02)),
    )
    sensor = replace(plain.platform.magnetometer, noise_density=NOISE, offset=np.zeros(3))
    return replace(plain, beacons=(beacon,), platform=replace(plain.platform, magnetometer=sensor))


def _recorded(rng: np.random.Generator) -> tuple[Waveform, Array, Array]:
    """Return a minute at rest beside a magnet whose speed drifts by a tenth, angle and phasor."""
    time = np.arange(3000) / 50.0
    angle = shaft_angle(Shaft(drift_hz=0.3, drift_time=10.0), SPEED_HZ, time, rng)
    offset = np.array([3.0, -4.0, 6.0])
    field = dipole_field(offset, turned_moment(ROTOR, Shaft(), angle))
    noisy = field + 2e-5 + NOISE * 5.0 * rng.standard_normal(field.shape)
    cosine, sine = dipole_field(offset, ROTOR.turning_moments)
    return Waveform(time, noisy), angle, cosine - 1j * sine


def test_two_coils_in_quadrature_are_a_moment_that_turns() -> None:
    rng = np.random.default_rng(1)
    site = _site()
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    body, place = Rotation.random(random_state=rng).as_matrix(), np.array([2.0, -3.0, 5.0])
    phasor = predict(beacon, sensor, body, place)[0]
    point = place + body @ sensor.position_body - beacon.position_world
    for angle in rng.uniform(0.0, 6.3, 5):
        about = Rotation.from_rotvec(angle * ROTOR.axis_beacon)
        moment = ROTOR.moment * about.apply(ROTOR.zero_beacon)
        world = dipole_field(point, beacon.world_from_beacon @ moment)
        seen = sensor.matrix @ sensor.body_from_sensor.T @ body.T @ world
        np.testing.assert_allclose(np.real(phasor * np.exp(1j * angle)), seen, rtol=1e-10)


def test_the_simulator_turns_the_moment_itself() -> None:
    angle = np.array([0.0, 0.5, 2.0])
    moment = turned_moment(replace(ROTOR, tilt=0.1), Shaft(), angle)
    about = Rotation.from_rotvec(angle[:, None] * ROTOR.axis_beacon)
    np.testing.assert_allclose(moment @ ROTOR.axis_beacon, 200.0 * np.sin(0.1), rtol=1e-12)
    np.testing.assert_allclose(about.inv().apply(moment), np.tile(moment[0], (3, 1)), atol=1e-10)
    whirled = turned_moment(ROTOR, Shaft(whirl=0.01), angle)
    np.testing.assert_allclose(np.linalg.norm(whirled, axis=1), 200.0, rtol=1e-12)
    twice = whirled @ ROTOR.axis_beacon / 2.0  # along the axis, twice a turn
    np.testing.assert_allclose(twice, np.sin(2.0 * angle), atol=1e-3)


def test_a_speed_that_drifts_smears_nothing_by_the_angle() -> None:
    wave, angle, phasor = _recorded(np.random.default_rng(2))
    result = demodulate_rotor(wave, angle, _site().beacons[0], _site(), 10.0)
    assert len(result.fields) == 6
    error = result.fields.phasor_sensor[:, 0] - phasor
    sigma = np.sqrt(np.diagonal(result.fields.phasor_cov[:, 0], axis1=1, axis2=2))
    assert np.sqrt(np.mean(np.abs(error / sigma) ** 2) / 2.0) == pytest.approx(1.0, abs=0.35)
    speeds = np.diff(np.interp(np.arange(0.0, 60.5, 10.0), wave.time, angle)) / 20.0 / np.pi
    np.testing.assert_allclose(result.speed_hz[:5], speeds[:5], rtol=1e-2)
    clock = 2.0 * np.pi * SPEED_HZ * wave.time
    by_clock = demodulate_rotor(wave, clock, _site().beacons[0], _site(), 10.0).fields
    share = np.linalg.norm(by_clock.phasor_sensor[:, 0], axis=1) / np.linalg.norm(phasor)
    assert np.median(share) < 0.8


def test_an_angle_that_nobody_measures_is_followed_through_the_field() -> None:
    wave, angle, _ = _recorded(np.random.default_rng(3))
    rotor = replace(ROTOR, speed_sigma_hz=0.3, speed_walk_hz_rts=0.15)
    result = followed_angle(wave, SPEED_HZ, rotor)
    remaining = result - angle
    remaining -= np.median(remaining)
    assert np.max(np.abs(remaining[100:-100])) < 0.3


def test_noise_alone_is_no_magnet() -> None:
    rng = np.random.default_rng(4)
    wave = Waveform(np.arange(3000) / 50.0, 1e-9 * rng.standard_normal((3000, 3)))
    with pytest.raises(InputError, match="not detected above the noise"):
        followed_angle(wave, SPEED_HZ, ROTOR)


def test_a_rotor_and_a_casing_come_back_from_a_file(tmp_path: Path) -> None:
    site, casing = _site(), Casing(0.09, 0.01, 80.0, 4e6, 0.2, 0.1, 0.05, 0.2)
    sensor = replace(site.platform.magnetometer, casing=casing)
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    save_site(site, tmp_path / "site.yaml")
    back = load_site(tmp_path / "site.yaml")
    result = back.platform.magnetometer.casing
    assert result is not None
    assert vars(result) == pytest.approx(vars(casing), rel=1e-12)
    rotor = back.beacons[0].rotor
    assert rotor is not None
    np.testing.assert_allclose(rotor.turning_moments, ROTOR.turning_moments, rtol=1e-12)
    np.testing.assert_allclose(
        back.beacons[0].moments_beacon, site.beacons[0].moments_beacon, rtol=1e-12
    )
    assert back.beacons[0].sigma.log_moment.tolist() == [0.02, 0.02]


@pytest.mark.parametrize(
    ("given", "findings"),
    [
        ("rotor: {moment_a_m2: 100, axis: [1, 0, 0], zero: [1, 0, 1]}", "across the axis"),
        ("rotor: {moment_a_m2: 100}\n  coils: [{moment_a_m2: [1, 0, 0]}]", "remove it or rotor"),
        ("synchronised: true", "coils"),
    ],
)
def test_a_rotor_that_is_none_is_refused(given: str, findings: str, tmp_path: Path) -> None:
    text = f"""magfusion_site: 1
beacons:
- name: bit
  unknown: pose
  frequency_hz: 3.0
  {given}
platform: {{magnetometer: {{noise_density_t_rthz: 1.0e-11}}}}
"""
    (tmp_path / "site.yaml").write_text(text)
    with pytest.raises(InputError, match=findings):
        load_site(tmp_path / "site.yaml", unknown=True)


def test_angles_and_depths_come_back_from_a_log(tmp_path: Path) -> None:
    wave, angle, _ = _recorded(np.random.default_rng(5))
    rotated = RotorAngles(wave.time, {"bit": np.mod(angle, 2.0 * np.pi)})
    depths = Depths({"bit": np.array([[0.0, 60.0], [1000.0, 1006.0]])})
    log = Log("log", 0, "", ImuSamples.empty(), wave, rotation=rotated, depths=depths)
    write_log(log, tmp_path / "log")
    back = read_log(tmp_path / "log")
    assert back.rotation is not None
    assert back.depths is not None
    np.testing.assert_array_equal(back.rotation.angle["bit"], rotated.angle["bit"])
    middle = back.depths.at("bit", np.array([30.0]))
    assert middle is not None
    assert middle[0] == pytest.approx(1003.0)


@pytest.mark.parametrize("frequency_hz", [1e-3, 1.0, 3.0, 10.0])
def test_a_thin_wall_is_the_limit_of_the_exact_one(frequency_hz: float) -> None:
    thin = Casing(0.0999, 0.0002, 1000.0, 5e6)
    exact = wall_transmission(
        Pipe(np.zeros(3), np.array([10.0, 0.0, 0.0]), 0.1, 0.0002, 1000.0, 5e6), frequency_hz
    )
    result = tube_response(thin, frequency_hz, np.zeros((1, 3)))
    assert result.across[0] == pytest.approx(exact.across, rel=5e-3)
    assert result.along[0] == pytest.approx(exact.along, rel=5e-3)
    # Of a static field, in closed form.
    static = wall_transmission(Pipe(np.zeros(3), np.ones(3), 0.1, 0.01), 1e-6).across
    assert static == pytest.approx(1.0 / (1.0 + 99.0**2 / 400.0 * (1.0 - 0.9**2)), rel=1e-4)


def test_what_a_casing_gathers_is_that_of_its_poles() -> None:
    """By segments that answer each other, and by a response to a wave along a tube without end."""
    pipe = Pipe(
        np.array([-25.0, 0.0, 0.0]), np.array([25.0, 0.0, 0.0]), 0.09, 0.002, 100.0, 1.0, 0.2
    )
    steel, wave = Steel((pipe,), about=0), 0.3
    x = steel.points_world()[:, 0]
    field = np.zeros((len(x), 1, 3))
    field[:, 0, 0] = np.cos(wave * x)
    seen = steel.seen_world(field, np.array([[1.0, 0.0, 0.0]]), np.zeros(3), 3.0)[0, 0]
    place = np.arange(-10, 11) * 2.0
    strength = tube_response(Casing(0.089, 0.002, 100.0, 1.0), 3.0, np.zeros((1, 3))).strength
    weight, _ = gathering_weights(strength, 0.089, place)
    assert seen - 1.0 == pytest.approx(weight[0] @ np.cos(wave * place), rel=0.05)


def test_an_encoder_refers_the_phasors_of_every_job_to_its_angle() -> None:
    """A speed that is not the declared one leaves the phasor of a log at rest what it is."""
    rng = np.random.default_rng(6)
    time = np.arange(4000) / 200.0
    site = _site()
    angle = shaft_angle(Shaft(drift_hz=0.01, drift_time=10.0), SPEED_HZ + 0.03, time, rng)
    offset = np.array([3.0, -4.0, 6.0])
    field = dipole_field(offset, turned_moment(ROTOR, Shaft(), angle))
    field += NOISE * 10.0 * rng.standard_normal(field.shape)
    rest = ImuSamples(time, np.zeros((4000, 3)), np.tile([0.0, 0.0, 9.8], (4000, 1)))
    rotated = RotorAngles(time, {"bit": np.mod(angle, 2.0 * np.pi)})
    log = turning_currents(Log("log", 0, "", rest, Waveform(time, field), rotation=rotated), site)
    log, known = with_drives(log, site)
    result = referred(phasors(log, known, None)[0], known)
    cosine, sine = dipole_field(offset, ROTOR.turning_moments)
    measured = result.phasor_sensor[1:-1, 0]
    error = np.linalg.norm(measured - (cosine - 1j * sine), axis=1)
    assert np.max(error) < 0.02 * np.linalg.norm(cosine - 1j * sine)


def test_an_angle_of_no_rotor_is_refused() -> None:
    rotated = RotorAngles(np.zeros(1), {"other": np.zeros(1)})
    log = Log("log", 0, "", ImuSamples.empty(), rotation=rotated)
    with pytest.raises(InputError, match="no rotor of this name"):
        turning_currents(log, _site())
