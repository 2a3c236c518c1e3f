"""Whole rests as one epoch: error, covariance and false alarms against what is independent."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from far_and_weak import far_site, noise_log
from mine_noise import Config, Interference, mains, run_kind, switches, vehicles, wandering_mains
from scipy.stats import binom

from magfusion.errors import InputError
from magfusion.estimation.rests.stationary_integration import integrate_rests, rests
from magfusion.files.fields import read_fields
from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.files.table import Span
from magfusion.model.ground import in_ground
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.receiver.hum import hum_of
from magfusion.receiver.integration import trace_chance
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests
from magfusion.units import Array, ComplexArray

RATE_HZ, SIGMA, DURATION = 100.0, 7e-11, 100.0
ALARM = 0.05


def phasors_drawn(rng: np.random.Generator, size: float) -> ComplexArray:
    drawn = rng.standard_normal((2, 4, 3)) * size
    return np.asarray(drawn[0] + 1j * drawn[1])


def noisy_log(
    site: Site,
    rng: np.random.Generator,
    phasor: ComplexArray,
    drift: Array | None = None,
    duration: float = DURATION,
) -> Log:
    """Return a log without inertial samples: white noise and tones, by their definition."""
    time = np.arange(int(duration * RATE_HZ)) / RATE_HZ
    field = SIGMA * rng.standard_normal((len(time), 3))
    for c, beacon in enumerate(site.beacons):
        sent_hz = beacon.frequency_hz * (1.0 + (0.0 if drift is None else drift[c]))
        field += np.real(phasor[c] * np.exp(2j * np.pi * sent_hz * time)[:, None])
    return Log("rest", 0, "test", ImuSamples.empty(), Waveform(time, field), inertial=False)


@pytest.mark.parametrize("synchronised", [True, False])
def test_the_error_is_the_least_there_can_be_and_the_covariance_is_true(
    *, synchronised: bool
) -> None:
    site, nees, square = far_site(synchronised=synchronised), [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        phasor = phasors_drawn(rng, 2e-11)
        drift = None if synchronised else rng.normal(0.0, 2e-5, 4)
        rested = integrate_rests(noisy_log(site, rng, phasor, drift), site)
        assert rested.detected.all()
        assert [f.code for f in rested.findings] == ["few_data"]  # no IMU tells that it rests
        hertz = np.array([b.frequency_hz for b in site.beacons])
        turns = 0.0 if drift is None else hertz * drift * rested.fields.time[0]
        error = rested.fields.phasor_sensor[0] - phasor * np.exp(2j * np.pi * turns)[..., None] * 1
        white = np.linalg.solve(rested.fields.phasor_cov[0], error[..., None])[..., 0]
        nees.append(np.real(np.sum(np.conj(error) * white, axis=1)))
        square.append(np.abs(error) ** 2 / 2.0)
    bound = SIGMA * np.sqrt(2.0 / (DURATION * RATE_HZ))  # of Cramer and Rao, white noise
    mean = float(np.mean(nees))
    assert 6.0 - 4.0 * np.sqrt(12.0 / 100.0) < mean < 6.0 + 4.0 * np.sqrt(12.0 / 100.0)
    # Unknown clocks cost a little of the phase.
    assert 0.9 < float(np.sqrt(np.mean(square))) / bound < 1.15


@pytest.mark.parametrize("synchronised", [True, False])
def test_noise_is_taken_for_a_beacon_as_often_as_was_asked(*, synchronised: bool) -> None:
    site, alarms, tried = far_site(synchronised=synchronised), 0, 0
    for seed in range(40):
        log = noisy_log(site, np.random.default_rng(seed), np.zeros((4, 3), dtype=complex))
        chance = integrate_rests(log, site).chance
        alarms, tried = alarms + int(np.sum(chance < ALARM)), tried + chance.size
    # Davies' bound is one from above.
    least = 0 if not synchronised else binom.ppf(1e-4, tried, ALARM)
    assert least <= alarms <= binom.ppf(1.0 - 1e-4, tried, ALARM)


def test_the_chance_of_a_trace_is_that_of_draws() -> None:
    rng = np.random.default_rng(3)
    freedom, draws = 20, 4000
    others = rng.standard_normal((draws, freedom, 3))
    cov = np.einsum("nki,nkj->nij", others, others) / freedom
    own = rng.standard_normal((draws, 3, 2))
    trace = np.einsum("nik,nik->n", own, np.linalg.solve(cov, own))
    for share in (0.2, 0.02):
        at = float(np.quantile(trace, 1.0 - share))
        assert trace_chance(at, freedom) == pytest.approx(share, rel=0.25)


def test_the_size_of_a_weak_tone_is_unbiased() -> None:
    site, phasor = far_site(), np.zeros((4, 3), dtype=complex)
    phasor[:, 0] = 1.5e-12  # one and a half sigmas
    square, noise = [], []
    for seed in range(40):
        fields = integrate_rests(noisy_log(site, np.random.default_rng(seed), phasor), site).fields
        square.append(np.sum(np.abs(fields.phasor_sensor) ** 2, axis=-1))
        noise.append(2.0 * np.trace(fields.phasor_cov, axis1=-2, axis2=-1))
    result = np.array(square) - np.array(noise)
    error = float(np.std(result)) / np.sqrt(result.size)
    assert abs(float(np.mean(result)) - 1.5e-12**2) < 4.0 * error


def test_a_bang_hardly_harms() -> None:
    site, phasor = far_site(), phasors_drawn(np.random.default_rng(1), 2e-11)
    log = noisy_log(site, np.random.default_rng(2), phasor)
    assert log.waveform is not None
    strong = log.waveform.measured_sensor.copy()
    strong[4000:4200] += 1e-7 * np.random.default_rng(4).standard_normal((200, 3))
    banged = replace(log, waveform=replace(log.waveform, measured_sensor=strong))
    quiet, result = (integrate_rests(one, site).fields for one in (log, banged))
    share = np.trace(result.phasor_cov[0], axis1=1, axis2=2) / np.trace(
        quiet.phasor_cov[0], axis1=1, axis2=2
    )
    assert np.max(share) < 2.0
    assert np.max(np.abs(result.phasor_sensor - quiet.phasor_sensor)) < 4e-12


@pytest.mark.parametrize("kind", [mains, wandering_mains, vehicles, switches])
def test_what_a_mine_does_hardly_harms(kind: Interference) -> None:
    row = run_kind(kind, Config(duration=120.0, runs=2))
    assert row.rest_times_bound < 1.6
    assert 6.0 - 4.0 * np.sqrt(12.0 / 8.0) < row.rest_nees < 6.0 + 4.0 * np.sqrt(12.0 / 8.0)


def test_a_hum_that_wanders_is_followed() -> None:
    time = np.arange(0.0, 120.0, 0.005)
    turns = 50.0 * time + 0.08 / 0.02 / (2.0 * np.pi) * np.sin(2.0 * np.pi * 0.02 * time)
    field = 1e-8 * np.cos(2.0 * np.pi * turns)[:, None] * np.ones(3)
    field += 1e-9 * np.random.default_rng(0).standard_normal(field.shape)
    hum = hum_of(Waveform(time, field), 50.0)
    assert hum is not None
    off = np.unwrap(hum.angle(time) - 2.0 * np.pi * turns)
    assert np.ptp(off[400:-400]) < 0.8


def test_rest_is_told_from_motion_and_from_an_even_turn() -> None:
    site = far_site()
    time = np.arange(0.0, 100.0, 0.02)
    gyro, accel = np.zeros((len(time), 3)), np.tile([0.0, 0.0, 9.81], (len(time), 1))
    gyro[:, 2] = np.where(time > 60.0, 0.5, 0.0)
    accel[2000:2500, 0] = np.sin(10.0 * time[2000:2500])
    wave = Waveform(time, np.zeros((len(time), 3)))
    result = rests(Log("x", 0, "test", ImuSamples(time, gyro, accel), wave), site)
    assert len(result) == 2
    assert result[0][0] == 0.0
    assert result[0][1] == pytest.approx(39.5, abs=0.6)
    assert result[1][0] == pytest.approx(50.5, abs=0.6)
    assert result[1][1] == pytest.approx(59.5, abs=0.6)


@pytest.mark.slow
def test_rests_of_a_walk_are_smoothed(tmp_path: Path) -> None:
    site = far_site(2e4)
    config = SimulationConfig(
        box_world=np.array([[-20.0, -20.0, -3.0], [20.0, 20.0, 3.0]]),
        duration=420.0,
        rests=Rests(start=100.0, move=15.0, pause=100.0),
        imu_rate_hz=100.0,
        magnetometer_rate_hz=RATE_HZ,
        perturb=False,
    )
    built = simulate_log(site, config, np.random.default_rng(4))
    write_log(built.log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("demodulate", tmp_path / "log", "--at-rest", "-o", tmp_path / "rests")
    run_command("smooth", tmp_path / "rests", "-o", tmp_path / "smooth")
    reported = json.loads((tmp_path / "smooth" / "report.json").read_text())
    assert reported["epochs"] >= 3
    assert reported["ate_m"] < 4.0
    assert reported["nees_mean"] < 6.0 + 4.0 * np.sqrt(12.0 / reported["epochs"])


def test_what_cannot_be_integrated_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    log, site = noise_log(far_site(), 60.0, 0), far_site()
    moving = log.imu.accel_body + np.random.default_rng(0).standard_normal((len(log.imu), 3))
    with pytest.raises(InputError, match="has no rest of"):
        integrate_rests(replace(log, imu=replace(log.imu, accel_body=moving)), site)
    with pytest.raises(InputError, match="give the raw log"):
        integrate_rests(replace(log, waveform=None), site)
    write_log(log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    findings = refuse("fix", tmp_path / "log", "--at-rest", "--method", "paper-lines", "-o", "x")
    assert "--at-rest belongs to --method likelihood" in findings


@pytest.mark.slow
def test_rests_go_through_demodulate_and_fix_and_silence_is_said(
    tmp_path: Path, refuse: Refuse, capfd: pytest.CaptureFixture[str]
) -> None:
    strong = in_ground(far_site(moment=2e4), 0.01)
    log = noise_log(strong, 150.0, 1, detected=True)
    write_log(log, tmp_path / "log")
    save_site(strong, tmp_path / "log" / "site.yaml")
    run_command("demodulate", tmp_path / "log", "--at-rest", "-o", tmp_path / "rests")
    fields = read_fields(tmp_path / "rests" / "fields.parquet", Span(log.epoch_ns))
    assert len(fields) == 1
    assert fields.window[0] == pytest.approx(150.0, abs=1.0)
    run_command("fix", tmp_path / "rests", "-o", tmp_path / "of_rests")
    findings = refuse("navigate", tmp_path / "rests", "-o", tmp_path / "now")
    assert "has whole rests, of up to 150 s" in findings
    run_command("fix", tmp_path / "log", "--at-rest", "-o", tmp_path / "fix")
    truth = read_log(tmp_path / "log").truth
    assert truth is not None
    for name in ("of_rests", "fix"):
        result = np.loadtxt(tmp_path / name / "trajectory.tum", ndmin=2)
        assert np.linalg.norm(result[0, 1:4] - truth.position_world[0]) < 15.0
    write_log(noise_log(strong, 60.0, 1), tmp_path / "silent")
    save_site(strong, tmp_path / "silent" / "site.yaml")
    from magfusion.cli import main

    for job in ("demodulate", "fix"):
        with pytest.raises(SystemExit) as ended:
            main([job, str(tmp_path / "silent"), "--at-rest", "-o", str(tmp_path / f"no_{job}")])
        assert ended.value.code == 1
        assert "Below the noise, at a false-alarm rate of 0.001" in capfd.readouterr().err
