"""The Earth field as a measurement: its model, its weight, and what it holds without beacons."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import earth_field_attitude as scenario
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.cli import main
from magfusion.errors import InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE, detected
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.measurements.earth import check_earth, earth_cov
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.site import load_site, save_site
from magfusion.model.field import observe_earth
from magfusion.model.parameters import (
    PARAMETERS,
    choose_blocks,
    difference,
    initial_calibration,
    retract,
)
from magfusion.model.samples import FieldSamples, StaticFields, Waveform
from magfusion.model.site import Magnetometer, MagnetometerSigma
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

REAL = Path(__file__).parents[1].parent / "shared" / "logs" / "turn_miscalibrated"
STEP_WORLD = np.array([5e-6, 0.0, 0.0])  # T; turns the field by 15 degrees, its size by 0.5 %


def a_sensor(rng):
    return Magnetometer(
        position_body=np.zeros(3),
        body_from_sensor=Rotation.random(rng=rng).as_matrix(),
        noise_density=1e-10,
        matrix=np.eye(3) + 0.1 * rng.normal(size=(3, 3)),
        offset=1e-6 * rng.normal(size=3),
        sigma=MagnetometerSigma(np.zeros((3, 3)), *(np.zeros(3),) * 3),
    )


def rotated(rotation, step):
    return rotation @ Rotation.from_rotvec(step).as_matrix()


MOVES = {
    "platform_rotation": lambda s, r, e, d: (s, rotated(r, d), e),
    "matrix": lambda s, r, e, d: (replace(s, matrix=s.matrix + d.reshape(3, 3)), r, e),
    "sensor_rotation": lambda s, r, e, d: (
        replace(s, body_from_sensor=rotated(s.body_from_sensor, d)),
        r,
        e,
    ),
    "offset": lambda s, r, e, d: (replace(s, offset=s.offset + d), r, e),
    "earth_world": lambda s, r, e, d: (s, r, e + d),
}


@pytest.mark.parametrize("block", MOVES)
def test_every_block_of_the_earth_field_is_its_derivative(block):
    rng = np.random.default_rng(3)
    sensor, rotation = a_sensor(rng), Rotation.random(4, rng=rng).as_matrix()
    earth = np.array([1.2e-6, 1.9e-5, -4.5e-5])
    jacobian = getattr(observe_earth(sensor, rotation, earth), block)
    scale = 1e-6 if block in ("offset", "earth_world") else 1.0
    for k in range(jacobian.shape[-1]):
        step = np.zeros(jacobian.shape[-1])
        step[k] = 1e-6 * scale
        ahead, behind = (
            observe_earth(*MOVES[block](sensor, rotation, earth, sign * step)).measured_sensor
            for sign in (1.0, -1.0)
        )
        result = (ahead - behind) / (2e-6 * scale)
        np.testing.assert_allclose(
            result, jacobian[..., k], rtol=0, atol=1e-8 * np.max(np.abs(jacobian))
        )


def test_the_size_of_a_perfect_sensors_reading_knows_no_attitude():
    rng = np.random.default_rng(4)
    sensor = replace(a_sensor(rng), matrix=np.eye(3), offset=np.zeros(3))
    earth = np.array([1.2e-6, 1.9e-5, -4.5e-5])
    seen = observe_earth(sensor, Rotation.random(20, rng=rng).as_matrix(), earth).measured_sensor
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), np.linalg.norm(earth), rtol=1e-12)


def test_offset_and_field_are_calibration_only_where_the_field_is_measured():
    site = demo_site()
    names = {b.name for b in choose_blocks(site, parameters=PARAMETERS)}
    extra = {"magnetometer.offset", "earth.declination", "earth.strength"}
    assert names - {b.name for b in choose_blocks(site)} == extra


def test_a_step_of_the_earth_field_is_found_again():
    site = demo_site()
    blocks = choose_blocks(site, ["earth", "magnetometer"], parameters=PARAMETERS)
    declared = initial_calibration(site, 0.0)
    sigma = np.concatenate([b.sigma for b in blocks])
    step = 3.0 * sigma * np.random.default_rng(1).normal(size=len(sigma))
    result = difference(declared, retract(declared, blocks, step), blocks)
    np.testing.assert_allclose(result / sigma, step / sigma, rtol=0, atol=1e-9)


def test_a_field_of_the_wrong_size_counts_less():
    site = demo_site()
    sensor, earth = site.platform.magnetometer, site.earth_field_world
    time = np.arange(0.0, 60.0, 0.2)
    attitude = np.broadcast_to(np.eye(3), (len(time), 3, 3))
    wrong = (time > 20.0) & (time < 40.0)
    measured = observe_earth(sensor, attitude, earth).measured_sensor
    measured = measured + wrong[:, None] * np.array([0.0, 0.0, 5e-6])
    static = StaticFields(time, measured, np.zeros((len(time), 3, 3)))
    sigma = np.sqrt(earth_cov(site, static)[:, 0, 0])
    assert np.all(sigma[(time > 23.0) & (time < 37.0)] > 10.0 * sigma[0])
    np.testing.assert_allclose(sigma[time < 17.0], sigma[0], rtol=1e-9)


def test_noise_is_no_beacon_and_a_window_at_the_edge_of_silence_neither():
    rng = np.random.default_rng(2)
    n, cov = 40, 1e-18
    phasor = rng.normal(0.0, 1e-9, (2, n, 1, 3))
    phasor[0, :20] += 1e-7
    samples = FieldSamples(
        time=0.2 * np.arange(n),
        window=np.full(n, 0.4),
        channels=(("A", 0),),
        phasor_sensor=phasor[0] + 1j * phasor[1],
        phasor_cov=np.broadcast_to(cov * np.eye(3), (n, 1, 3, 3)),
    )
    assert DETECTION_CHI_SQUARE < (0.1**2 / 0.001**2)
    np.testing.assert_array_equal(detected(samples)[:, 0], np.arange(n) < 18)


def test_a_site_without_the_field_is_refused_in_one_sentence():
    site = demo_site()
    with pytest.raises(InputError, match="no Earth field"):
        check_earth(replace(site, earth_field_world=None))
    with pytest.raises(InputError, match="too little to determine a heading"):
        Navigator(
            replace(site, earth_field_world=np.array([0.0, 5e-7, 6e-5])),
            NavigatorSettings(earth=True),
        )
    with pytest.raises(ValueError, match="tight"):
        SmootherSettings(coupling="loose", earth=True)


# Whole logs.


def silent(site):
    """Return a site whose beacons are off, as good as."""
    beacons = []
    for beacon in site.beacons:
        coils = [replace(c, moment_beacon=1e-9 * c.moment_beacon) for c in beacon.coils]
        beacons.append(replace(beacon, coils=tuple(coils)))
    return replace(site, beacons=tuple(beacons))


def turning(seed, duration, begin, end, gyro_noise=3e-3):
    """Return site, simulation, and its log with the beacons silent from begin to end (s)."""
    site = demo_site(coil_radius=None)
    imu = replace(site.platform.imu, gyro_noise=gyro_noise)
    site = replace(site, platform=replace(site.platform, imu=imu))
    plan = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=duration,
        motion="turn",
        rests=Rests(start=2.0, move=12.0, pause=2.0),
    )
    heard_all, undetected = (
        simulate_log(s, plan, np.random.default_rng(seed)) for s in (site, silent(site))
    )
    np.testing.assert_array_equal(heard_all.log.imu.gyro_body, undetected.log.imu.gyro_body)
    time = heard_all.log.waveform.time
    off = ((time >= begin) & (time < end))[:, None]
    waveform = [s.log.waveform.measured_sensor for s in (undetected, heard_all)]
    log = replace(heard_all.log, waveform=Waveform(time, np.where(off, *waveform)))
    return site, heard_all, log


def disturbed(simulated, log, begin, end):
    """Return a log with a step of the ambient field."""
    time = log.waveform.time
    sensor = simulated.true_site.platform.magnetometer
    world_from_sensor = simulated.motion.trajectory(time).world_from_body @ sensor.body_from_sensor
    step = STEP_WORLD @ world_from_sensor @ sensor.matrix.T
    during = ((time >= begin) & (time < end))[:, None]
    return replace(log, waveform=Waveform(time, log.waveform.measured_sensor + during * step))


def attitude_errors(states, truth, begin, end):
    """Return heading and total attitude error over a stretch (deg, rms)."""
    errors = trajectory_errors(states, truth)
    turn = Rotation.from_matrix(errors.world_from_body).apply(errors.attitude_body)
    during = (errors.time >= begin) & (errors.time < end)
    square = np.rad2deg(turn[during]) ** 2
    return np.sqrt(np.mean(square[:, 2])), np.sqrt(np.mean(np.sum(square, axis=1)))


@pytest.fixture(scope="module")
def gap():
    return turning(1, 24.0, 8.0, 18.0)


def test_the_steady_field_of_a_turning_window_is_that_of_its_centre(gap):
    site, simulated, _ = gap
    true = replace(simulated.true_site, beacons=site.beacons)
    static = demodulated(simulated.log, true, None).static(initial_calibration(true, 0.0))
    poses = simulated.motion.trajectory(static.time)
    sensor = true.platform.magnetometer
    expected = observe_earth(sensor, poses.world_from_body, site.earth_field_world)
    error = static.measured_sensor - expected.measured_sensor
    assert np.sqrt(np.mean(error**2)) < 5e-8  # T; the gyro's unknown bias turns half a window
    assert np.max(np.abs(np.diff(static.measured_sensor, axis=0))) > 1e-6


@pytest.mark.slow
def test_where_no_beacon_is_heard_the_smoother_goes_on_by_the_earth_field(gap):
    site, _, log = gap
    result = smooth(log, site, SmootherSettings(earth=True))
    undetected = ~np.isfinite(result.residual).any(axis=(1, 2))
    times = result.states.time[undetected]
    assert 7.5 < times[0] < 8.2
    assert 17.8 < times[-1] < 18.6
    heading, total = attitude_errors(result.states, log.truth, 8.0, 18.0)
    assert heading < 0.6
    assert total < 0.8
    sigma = np.sqrt(np.trace(result.states.pose_cov[:, :3, :3], axis1=1, axis2=2))
    assert np.rad2deg(np.max(sigma)) < 2.0


@pytest.mark.slow
def test_no_beacon_at_all_leaves_an_attitude_and_says_that_the_heading_is_the_fields():
    site, _, log = turning(2, 20.0, 0.0, 20.0)
    result = smooth(log, site, SmootherSettings(earth=True))
    assert not np.isfinite(result.residual).any()
    _, total = attitude_errors(result.states, log.truth, 0.0, 20.0)
    assert total < 1.5
    heading = np.sqrt(result.states.pose_cov[:, :3, :3].trace(axis1=1, axis2=2))
    assert np.all(np.rad2deg(heading) > 2.5)  # the declination's own sigma is three degrees


def test_phasors_alone_are_refused(gap):
    site, simulated, _ = gap
    source = demodulated(simulated.log, site, None)
    phasors = source.fields
    with pytest.raises(InputError, match="only phasors"):
        smooth(
            replace(simulated.log, waveform=None, fields=phasors),
            site,
            SmootherSettings(earth=True),
        )


def navigated(log, site, *, earth, without=(np.inf, np.inf)):
    """Return the filter's states; without the magnetometer over a stretch."""
    navigator = Navigator(site, NavigatorSettings("ekf", earth=earth, longest_step=1.0))
    imu, waveform = log.imu, log.waveform
    heard_at = (waveform.time < without[0]) | (waveform.time >= without[1])
    for begin in np.arange(imu.time[0], imu.time[-1], 0.5):
        now = (imu.time >= begin) & (imu.time < begin + 0.5)
        navigator.add_imu(imu.time[now], imu.gyro_body[now], imu.accel_body[now])
        now = (waveform.time >= begin) & (waveform.time < begin + 0.5) & heard_at
        if np.any(now):
            navigator.add_magnetometer(waveform.time[now], waveform.measured_sensor[now])
    return as_trajectory(navigator.take()), navigator


@pytest.mark.slow
def test_a_minute_without_beacons_costs_less_heading_with_the_earth_field():
    fixed, drifted = [], []
    for seed in (2, 3):
        site, simulated, log = turning(seed, 82.0, 15.0, 75.0, gyro_noise=6e-3)
        with_field, _ = navigated(log, site, earth=True)
        inertial, _ = navigated(simulated.log, site, earth=False, without=(15.0, 75.0))
        fixed.append(attitude_errors(with_field, log.truth, 45.0, 75.0)[0])
        drifted.append(attitude_errors(inertial, log.truth, 45.0, 75.0)[0])
    assert np.sqrt(np.mean(np.square(fixed))) < 1.2
    assert np.sqrt(np.mean(np.square(fixed))) < 0.5 * np.sqrt(np.mean(np.square(drifted)))


@pytest.mark.slow
def test_a_disturbed_field_does_no_harm():
    site, simulated, log = turning(2, 70.0, 12.0, 65.0)
    bent = disturbed(simulated, log, 25.0, 45.0)
    result = smooth(bent, site, SmootherSettings(earth=True))
    assert attitude_errors(result.states, log.truth, 12.0, 65.0)[1] < 0.6
    residual = np.sum(result.earth_residual**2, axis=1)
    inside = (result.states.time > 26.0) & (result.states.time < 44.0)
    assert np.median(residual[inside]) > 100.0 * np.median(residual[~inside])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_the_filter_lets_a_disturbed_field_go_and_takes_it_up_again(seed):
    site, simulated, log = turning(seed, 70.0, 12.0, 65.0)
    states, navigator = navigated(disturbed(simulated, log, 25.0, 45.0), site, earth=True)
    during = (states.time > 25.0) & (states.time < 65.0)
    claimed = np.trace(states.pose_cov[during, :3, :3], axis1=1, axis2=2)
    error = attitude_errors(states, log.truth, 25.0, 65.0)[1]
    assert error < 1.5 * np.rad2deg(np.sqrt(np.mean(claimed)))
    # A hundred windows hold the step; it takes two seconds to believe that it has gone.
    assert 98 <= navigator.counts["Earth field disturbed"] <= 115


@pytest.mark.slow
def test_a_disturbed_field_changes_nothing_where_beacons_hold_the_attitude():
    site, simulated, log = turning(3, 20.0, 30.0, 30.0)
    bent = disturbed(simulated, log, 6.0, 14.0)
    result = [
        attitude_errors(
            smooth(one, site, SmootherSettings(earth=earth)).states, log.truth, 0.0, 20.0
        )[1]
        for one, earth in ((log, False), (bent, True))
    ]
    assert result[1] < 1.2 * result[0]


@pytest.mark.slow
def test_the_scenario_prints_a_table_and_one_object(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["earth_field_attitude", "--quick"])
    scenario.main()
    lines = capsys.readouterr().out.splitlines()
    assert any("omitted" in line for line in lines)
    by_way = {row["magnetometer"]: row for row in json.loads(lines[-1])["rows"]}
    assert by_way["calibrated"]["total_deg"] < 0.8
    assert by_way["calibrated"]["total_deg"] < by_way["declared"]["total_deg"]


@pytest.mark.parametrize("command", ["smooth", "navigate"])
def test_the_commands_refuse_phasors_with_the_earth_field(gap, tmp_path, capsys, command):
    site, simulated, _ = gap
    phasors = demodulated(simulated.log, site, None).fields
    write_log(replace(simulated.log, waveform=None, fields=phasors), tmp_path / "log")
    save_site(site, tmp_path / "site.yaml")
    given = [command, str(tmp_path / "log"), "--site", str(tmp_path / "site.yaml"), "--earth"]
    with pytest.raises(SystemExit) as remaining:
        main([*given, "-o", str(tmp_path / "out")])
    assert remaining.value.code == 2
    assert "only phasors" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the shared logs are not beside the repository")
def test_real_inertial_data_and_the_earth_field_alone():
    log, site = open_log(REAL), load_site(REAL / "site.yaml")
    rows = list(scenario.rows_of("real", log, site, ("smoother",)))
    by_way = {row.magnetometer: row for row in rows}
    assert by_way["calibrated"].total_deg < 0.5
    assert by_way["estimated"].total_deg < 0.5
    assert by_way["declared"].total_deg > 2.0 * by_way["calibrated"].total_deg
