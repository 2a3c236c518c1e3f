"""`magfusion calibrate response`: a small coil on a bench tells the axes of a receiver apart."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from scipy.spatial.transform import Rotation
from test_response import errors_of_axes, uncertain

from magfusion.errors import InputError
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, write_survey
from magfusion.jobs.calibrate_response import ResponseSettings, run_calibrate_response
from magfusion.model.site import BeaconSigma, Coil, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.magnetometers import answered
from magfusion.simulation.perturbed import perturb_site
from magfusion.units import DEGREE

TONES_HZ = (1010.0, 1130.0, 1270.0, 1430.0)
MOMENT = 3.1e-3  # A m^2: 100 turns of 1 cm with 0.1 A
AWAY = 0.5  # m
POSITION, ROTATION = 0.5e-3, 0.2 * DEGREE  # m, rad; errors of a pose
NOISE = 1e-12  # T


def room() -> Site:
    """Return four beacons, and a receiver whose axes are known to 20 % and 10 degrees."""
    plain = demo_site()
    beacons = (replace(b, frequency_hz=f) for b, f in zip(plain.beacons, TONES_HZ, strict=True))
    return uncertain(replace(plain, beacons=tuple(beacons)), 0.2, 10.0)


def bench() -> Site:
    """Return the same receiver with a coil that sends all tones."""
    coils = tuple(Coil(np.array([MOMENT, 0.0, 0.0]), 0.0, frequency_hz=f) for f in TONES_HZ)
    sigma = BeaconSigma(np.zeros(3), np.zeros(3), np.full(4, 0.02))
    site = room()
    coil = replace(
        site.beacons[0],
        name="coil",
        position_world=np.zeros(3),
        world_from_beacon=np.eye(3),
        frequency_hz=TONES_HZ[0],
        coils=coils,
        synchronised=False,
        sigma=sigma,
    )
    sensor = site.platform.magnetometer
    known = replace(sensor.sigma, rotation_sensor=np.zeros(3), position_body=np.zeros(3))
    sensor = replace(
        sensor,
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        sigma=known,
        offset=np.zeros(3),
    )
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, beacons=(coil,), platform=platform)


def surveyed(true: Site, rng: np.random.Generator) -> Survey:
    """Return what the receiver measures on the coil's axis, in the 24 attitudes of a cube."""
    turn = Rotation.create_group("O")
    place = np.tile([AWAY, 0.0, 0.0], (len(turn), 1))
    turned = turn * Rotation.from_rotvec(rng.normal(0.0, ROTATION, (len(turn), 3)))
    away = place + rng.normal(0.0, POSITION, place.shape)
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    unit, along = away / distance, MOMENT * np.array([1.0, 0.0, 0.0])
    field_world = 1e-7 * (3.0 * unit * (unit @ along)[:, None] - along) / distance**3
    field = turned.inv().apply(field_world)[:, None] * np.exp(1j * np.arange(1.0, 5.0))[:, None]
    phasor = answered(field, true.platform.magnetometer.response, np.array(TONES_HZ))
    noise = rng.normal(0.0, NOISE, (2, *phasor.shape))
    return Survey(
        point=np.arange(len(turn)),
        position_world=place,
        world_from_body=turn.as_matrix(),
        channels=tuple(("coil", tone) for tone in range(4)),
        sigma=np.full(phasor.shape[:2], NOISE),
        phasor_sensor=phasor + noise[0] + 1j * noise[1],
    )


@pytest.fixture
def given(tmp_path: Path) -> tuple[ResponseSettings, Site]:
    """Return the inputs of the command, and the true receiver."""
    rng = np.random.default_rng(4)
    true = perturb_site(bench(), rng)
    save_site(bench(), tmp_path / "bench.yaml")
    save_site(room(), tmp_path / "room.yaml")
    write_survey(surveyed(true, rng), tmp_path / "survey.parquet")
    settings = ResponseSettings(
        survey=tmp_path / "survey.parquet",
        site=tmp_path / "bench.yaml",
        into=tmp_path / "room.yaml",
        pose_position_m=POSITION,
        pose_rotation_deg=ROTATION / DEGREE,
    )
    return settings, true


def test_a_coil_on_a_bench_finds_the_responses(
    given: tuple[ResponseSettings, Site], tmp_path: Path
) -> None:
    settings, true = given
    run_calibrate_response(settings, tmp_path / "response")
    result = load_site(tmp_path / "response" / "site.yaml")
    error = errors_of_axes(result, true)
    assert np.max(np.abs(errors_of_axes(room(), true).real)) > 0.2
    assert np.sqrt(np.mean(error.real**2)) < 0.003
    assert np.sqrt(np.mean(error.imag**2)) < 0.2 * DEGREE
    sigma = result.platform.magnetometer.response_sigma
    assert sigma is not None
    # Places err alike at all tones: the gains are two numbers, the phases eight.
    assert np.max(np.abs(np.mean(error.real, axis=0)) / np.mean(sigma.gain, axis=0)) < 3.0
    assert np.sqrt(np.mean((error.imag / sigma.phase) ** 2)) < 2.0
    assert np.max(sigma.gain) < 0.003
    report = json.loads((tmp_path / "response" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"
    assert [b.name for b in result.beacons] == [b.name for b in room().beacons]


@pytest.mark.slow
def test_a_minute_of_walk_calibrates_the_responses(tmp_path: Path) -> None:
    """Moments and drive phases are declared, so that they do not take the part of an axis."""
    site = uncertain(demo_site(), 0.2, 10.0)
    walk = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD), np.random.default_rng(1))
    write_log(walk.log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("calibrate", "log", tmp_path / "log", "-o", tmp_path / "result")
    result = load_site(tmp_path / "result" / "site.yaml")
    before, error = (errors_of_axes(one, walk.true_site) for one in (site, result))
    assert np.max(np.abs(before.real)) > 0.1
    assert np.max(np.abs(before.imag)) > 5.0 * DEGREE
    assert np.sqrt(np.mean(error.real**2)) < 0.003
    assert np.sqrt(np.mean(error.imag**2)) < 0.2 * DEGREE
    sigma = result.platform.magnetometer.response_sigma
    assert sigma is not None
    for part, own in ((error.real, sigma.gain), (error.imag, sigma.phase)):
        # Of 8 numbers with common errors: 1 is expected.
        assert 0.3 < np.sqrt(np.mean((part / own) ** 2)) < 2.0
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    assert report["verdict"] == "trustworthy"


def test_a_receiver_that_is_known_is_refused(
    given: tuple[ResponseSettings, Site], tmp_path: Path
) -> None:
    save_site(demo_site(), tmp_path / "known.yaml")
    settings = replace(given[0], site=tmp_path / "known.yaml")
    with pytest.raises(InputError, match=r"response_sigma: is missing; declare how far"):
        run_calibrate_response(settings, tmp_path / "response")
    assert not (tmp_path / "response").exists()


def test_a_room_of_other_tones_is_refused(
    given: tuple[ResponseSettings, Site], tmp_path: Path
) -> None:
    save_site(demo_site(), tmp_path / "room.yaml")
    with pytest.raises(InputError, match="has tones of 20, 25, 30, 35 Hz; give the coil on"):
        run_calibrate_response(given[0], tmp_path / "response")
