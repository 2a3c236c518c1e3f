"""A second magnetometer as a witness: what it takes off, and when it must not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from far_and_weak import FAR_AWAY, STORMS, errors_in_sigmas, far_site, monitored_log

from magfusion.estimation.rests.stationary_integration import IntegratedRests, integrate_rests
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.model.samples import Waveform
from magfusion.model.trust import Verdict
from magfusion.receiver.reference import NO_LAG, lag_of
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.units import Array

DURATION = 150.0  # s


def sigma(rested: IntegratedRests) -> Array:
    return np.sqrt(np.trace(rested.fields.phasor_cov[0], axis1=1, axis2=2) / 3.0)


def codes(rested: IntegratedRests) -> dict[str, Verdict]:
    return {finding.code: finding.verdict for finding in rested.findings}


def assert_alike(result: Array, expected: Array) -> None:
    """See that covariances are the same but for rounding."""
    np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-9 * np.max(expected))


def both(simulation: SimulatedLog) -> tuple[IntegratedRests, IntegratedRests]:
    """Return the rest without and with the reference."""
    site = simulation.true_site
    return integrate_rests(replace(simulation.log, reference=None), site), integrate_rests(
        simulation.log, site
    )


@pytest.mark.slow
def test_what_it_leaves_is_the_noise_of_two_instruments_and_the_covariance_is_true() -> None:
    nees = []
    for seed in range(5):
        built = monitored_log(far_site(), DURATION, seed, FAR_AWAY, STORMS, late=0.4)
        alone, result = both(built)
        assert result.gain is not None
        assert np.all(result.gain > 8.0)
        least = 1e-11 * np.sqrt(2.0 / DURATION)  # both densities, in quadrature
        assert np.all(sigma(result) < 1.5 * least)
        assert np.all(sigma(alone) > 8.0 * least)
        nees.append(errors_in_sigmas(result, built))
    assert 6.0 - 4.0 * np.sqrt(12.0 / 20.0) < np.mean(nees) < 6.0 + 4.0 * np.sqrt(12.0 / 20.0)


def test_the_clock_of_a_reference_is_found() -> None:
    built = monitored_log(far_site(), 400.0, 1, FAR_AWAY, STORMS, late=-1.3, rate=3e-5)
    wave, reference = built.log.waveform, built.log.reference
    assert wave is not None
    assert reference is not None
    lag = lag_of(wave, reference, np.array([21.0, 24.0, 27.0, 31.0]))
    for time in (0.0, 400.0):
        assert lag.offset + lag.rate * time == pytest.approx(-1.3 + 3e-5 * time, abs=5e-3)


def test_one_that_hears_other_noise_changes_nothing() -> None:
    built = monitored_log(far_site(), DURATION, 1, FAR_AWAY, STORMS)
    other = monitored_log(far_site(), DURATION, 2, FAR_AWAY, STORMS)
    log = replace(built.log, reference=other.log.reference)
    alone, result = (
        integrate_rests(replace(log, reference=None), built.true_site),
        integrate_rests(log, built.true_site),
    )
    assert log.waveform is not None
    assert log.reference is not None
    assert lag_of(log.waveform, log.reference, np.zeros(0)) == NO_LAG
    np.testing.assert_allclose(result.fields.phasor_sensor, alone.fields.phasor_sensor, rtol=1e-9)
    assert_alike(result.fields.phasor_cov, alone.fields.phasor_cov)
    assert codes(result)["reference_unused"] is Verdict.TRUSTWORTHY


def test_one_that_hears_a_beacon_is_not_used_for_it() -> None:
    site = far_site()
    near_a = site.beacons[0].position_world + np.array([60.0, 0.0, 0.0])
    built = monitored_log(site, DURATION, 1, near_a, STORMS)
    alone, result = both(built)
    assert_alike(result.fields.phasor_cov[:, 0], alone.fields.phasor_cov[:, 0])
    assert "reference_hears" in codes(result)
    assert "A" in next(f.text for f in result.findings if f.code == "reference_hears")
    assert np.all(errors_in_sigmas(result, built) < 30.0)
    # Nobody has said where it stands: by its own fields it is seen to hear.
    unknown = integrate_rests(built.log, replace(built.true_site, reference_world=None))
    assert_alike(unknown.fields.phasor_cov[:, 0], alone.fields.phasor_cov[:, 0])


def test_one_whose_place_nobody_declared_casts_doubt() -> None:
    built = monitored_log(far_site(), DURATION, 1, FAR_AWAY, STORMS)
    unknown = integrate_rests(built.log, replace(built.true_site, reference_world=None))
    assert codes(unknown)["reference_hears"] is Verdict.DOUBTFUL
    known = integrate_rests(built.log, built.true_site)
    assert "reference_hears" not in codes(known)


def test_one_with_gaps_is_used_where_it_is_and_one_that_ended_is_not() -> None:
    built = monitored_log(far_site(), DURATION, 1, FAR_AWAY, STORMS)
    reference = built.log.reference
    assert reference is not None
    for end, used in ((142.0, True), (75.0, False)):
        kept = reference.time < end
        cut = Waveform(reference.time[kept], reference.measured_sensor[kept])
        result = integrate_rests(replace(built.log, reference=cut), built.true_site)
        assert result.gain is not None
        assert np.all(np.isfinite(result.gain)) == used


def test_a_log_without_one_is_drawn_as_before() -> None:
    config = SimulationConfig(np.array([[-1.0] * 3, [1.0] * 3]), 5.0, imu_rate_hz=50.0)
    built = [simulate_log(far_site(), config, np.random.default_rng(3)) for _ in range(2)]
    assert built[0].log.reference is None
    np.testing.assert_array_equal(built[0].log.imu.gyro_body, built[1].log.imu.gyro_body)


def test_it_goes_through_files_and_jobs(tmp_path: Path, refuse: Refuse) -> None:
    save_site(far_site(), tmp_path / "site.yaml")
    options = ("--motion", "static", "--duration", 120, "--rate", 100, "--imu-rate", 25)
    box = ("--box=-9,9,-9,9,-9,9", "--storms", 1e-9, "--reference", "5000,0,0")
    here = ("--site", tmp_path / "site.yaml", "-o", tmp_path / "log")
    run_command("simulate", *here, *options, *box)
    log = read_log(tmp_path / "log")
    assert log.reference is not None
    assert len(log.reference) == 12000
    site = load_site(tmp_path / "log" / "site.yaml")
    assert site.reference_world is not None
    np.testing.assert_array_equal(site.reference_world, FAR_AWAY)
    write_log(log, tmp_path / "log")
    assert (tmp_path / "log" / "reference.parquet").is_file()
    run_command("demodulate", tmp_path / "log", "--at-rest", "-o", tmp_path / "rests")
    reported = json.loads((tmp_path / "rests" / "report.json").read_text())
    assert reported["reference_gain_A_0"] > 5.0
    assert not (tmp_path / "rests" / "reference.parquet").exists()
    run_command("demodulate", tmp_path / "log", "-o", tmp_path / "plain")
    reported = json.loads((tmp_path / "plain" / "report.json").read_text())
    assert any("sensor is not used" in remark["text"] for remark in reported["remarks"])
    assert "three numbers in metres" in refuse("simulate", "--reference", "1,2", "-o", "x")
