"""A magnetometer that answers to a tone by less than to a static field, and late."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import bilinear, freqz, lfilter

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.site import load_site, save_site
from magfusion.jobs.replay import Replay, feed
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.response import AxisResponses, FrequencyResponse, ResponseSigma, log_response
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE, ComplexArray

RATE, CUT_OFF, THINNED = 4000.0, 200.0, 8  # Hz, Hz, samples
FREQUENCIES = np.linspace(10.0, 190.0, 40)  # Hz


def low_pass() -> tuple[np.ndarray, np.ndarray]:
    """Return a digital filter of first order, which is what a converter has before it."""
    cut = 2.0 * np.pi * CUT_OFF
    return bilinear([cut], [1.0, cut], RATE)


def answering(site: Site) -> Site:
    _, own = freqz(*low_pass(), FREQUENCIES, fs=RATE)
    response = FrequencyResponse(FREQUENCIES, np.abs(own), np.angle(own))
    magnetometer = replace(site.platform.magnetometer, response=response)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


@pytest.fixture(scope="module")
def filtered() -> Log:
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=6.0, magnetometer_rate_hz=RATE, perturb=False, motion="static"
    )
    log = simulate_log(demo_site(), config, np.random.default_rng(2)).log
    wave = log.waveform
    assert wave is not None
    first = wave.measured_sensor[0]
    passed = first + lfilter(*low_pass(), wave.measured_sensor - first, axis=0)
    wave = replace(wave, time=wave.time[::THINNED], measured_sensor=passed[::THINNED])
    return replace(log, waveform=wave)


def test_phasors_are_predicted_as_they_are_measured(filtered: Log) -> None:
    truth = filtered.truth
    assert truth is not None
    site = answering(demo_site())
    fields = phasors(filtered, site)[0].rows(slice(2, None))
    pose = truth.world_from_body[:1], truth.position_world[:1]
    time = fields.time[:1]
    error = {}
    for name, known in (("declared", site), ("not declared", demo_site())):
        expected = predict_channels(initial_calibration(known, 0.0), time, *pose)[0]
        result = np.mean(fields.phasor_sensor, axis=0)
        error[name] = np.linalg.norm(result - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert np.max(error["declared"]) < 0.003
    assert np.min(error["not declared"]) > 0.05


def separate(site: Site) -> Site:
    """Return the site with axes that answer each in its own way."""
    lag = -np.arctan(FREQUENCIES / CUT_OFF)
    x, y, z = (FrequencyResponse(FREQUENCIES, np.cos(k * lag), k * lag) for k in (0.5, 1.0, 1.5))
    magnetometer = replace(site.platform.magnetometer, response=AxisResponses(x, y, z))
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


@pytest.mark.parametrize("respond", [answering, separate])
def test_simulated_samples_are_what_such_a_magnetometer_reads(
    respond: Callable[[Site], Site],
) -> None:
    site = respond(demo_site())
    config = SimulationConfig(DEMO_BOX_WORLD, duration=6.0, perturb=False, motion="static")
    log = simulate_log(site, config, np.random.default_rng(3)).log
    assert log.truth is not None
    fields = phasors(log, site)[0].rows(slice(2, None))
    pose = log.truth.world_from_body[:1], log.truth.position_world[:1]
    result = np.mean(fields.phasor_sensor, axis=0)
    for known, differs in ((site, False), (demo_site(), True)):
        expected = predict_channels(initial_calibration(known, 0.0), fields.time[:1], *pose)[0]
        off = np.linalg.norm(result - expected, axis=1) / np.linalg.norm(expected, axis=1)
        assert np.min(off) > 0.05 if differs else np.max(off) < 0.003


def test_samples_of_axes_that_answer_apart_are_followed_along_a_motion() -> None:
    site = separate(demo_site())
    config = SimulationConfig(DEMO_BOX_WORLD, duration=6.0, perturb=False)
    walk = simulate_log(site, config, np.random.default_rng(3))
    result = smooth(walk.log, site, SmootherSettings(tune=False)).states
    errors = trajectory_errors(result, walk.motion.trajectory(result.time))
    assert errors.ate < 0.01
    assert errors.nees is not None
    assert np.mean(errors.nees) < 12.0  # of six degrees of freedom, of states that err alike


def test_a_site_keeps_the_response(tmp_path: Path) -> None:
    site = answering(demo_site())
    save_site(site, tmp_path / "site.yaml")
    result = load_site(tmp_path / "site.yaml").platform.magnetometer.response
    expected = site.platform.magnetometer.response
    assert result is not None
    assert expected is not None
    for name in ("frequency_hz", "gain", "phase"):
        np.testing.assert_allclose(getattr(result, name), getattr(expected, name), rtol=1e-9)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (
            "{frequency_hz: 50.0, gain: 0.9}, {frequency_hz: 60.0, gain: 0.8}",
            r"platform.magnetometer.response: found \[50.0, 60.0\]; give it as far as the tone at",
        ),
        (
            "{frequency_hz: 5.0, gain: 0.9}, {frequency_hz: 5.0, gain: 0.8}",
            r"response\[1\].frequency_hz: found 5.0; give each frequency once",
        ),
        ("{frequency_hz: 5.0, gain: 0.0}", r"response\[0\].gain"),
    ],
)
def test_a_table_that_cannot_be_is_refused(tmp_path: Path, rows: str, sentence: str) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    text = (tmp_path / "site.yaml").read_text(encoding="utf-8")
    key = "    noise_density_t_rthz"
    text = text.replace(key, f"    response: [{rows}]\n{key}", 1)
    (tmp_path / "site.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=sentence):
        load_site(tmp_path / "site.yaml")


def uncertain(site: Site, gain: float, phase_deg: float) -> Site:
    """Return the site with responses of y and z that are hardly known, and all else as declared."""
    tones_hz = np.unique(site.tone_frequencies_hz)
    by_axis = np.ones((len(tones_hz), 2))
    sensor = site.platform.magnetometer
    response = ResponseSigma(tones_hz, gain * by_axis, phase_deg * DEGREE * by_axis)
    sigma = replace(sensor.sigma, matrix=np.zeros((3, 3)))
    magnetometer = replace(sensor, sigma=sigma, response_sigma=response)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def errors_of_axes(result: Site, truth: Site) -> ComplexArray:
    """Return the errors of y and z relative to x at each tone: of log-gain and phase (rad)."""
    sensor = truth.platform.magnetometer
    assert sensor.response_sigma is not None
    tones_hz = sensor.response_sigma.frequency_hz
    both = (log_response(s.platform.magnetometer.response, tones_hz) for s in (result, truth))
    own, true = (log[:, 1:] - log[:, :1] for log in both)
    return own - true


def test_a_site_keeps_the_sigmas_of_its_response(tmp_path: Path) -> None:
    site = uncertain(demo_site(), 0.2, 10.0)
    save_site(site, tmp_path / "site.yaml")
    result = load_site(tmp_path / "site.yaml").platform.magnetometer.response_sigma
    expected = site.platform.magnetometer.response_sigma
    assert result is not None
    assert expected is not None
    for name in ("frequency_hz", "gain", "phase"):
        np.testing.assert_allclose(getattr(result, name), getattr(expected, name), rtol=1e-9)


def test_a_tone_without_sigmas_is_refused(tmp_path: Path) -> None:
    save_site(uncertain(demo_site(), 0.2, 10.0), tmp_path / "site.yaml")
    text = (tmp_path / "site.yaml").read_text(encoding="utf-8")
    text = re.sub(r"(response_sigma:\s+- \{?frequency_hz: )20.0", r"\g<1>21.0", text)
    (tmp_path / "site.yaml").write_text(text, encoding="utf-8")
    sentence = r"response_sigma: found \[21.*give one row for each tone: 20, 25, 30, 35 Hz"
    with pytest.raises(InputError, match=sentence):
        load_site(tmp_path / "site.yaml")


@pytest.mark.slow
def test_a_minute_of_walk_finds_the_responses() -> None:
    site = uncertain(demo_site(), 0.2, 10.0)
    walk = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD), np.random.default_rng(0))
    result, trust = judge_result(smooth(walk.log, site, SmootherSettings()), walk.log)
    error = errors_of_axes(result.calibration.site, walk.true_site)
    assert np.max(np.abs(errors_of_axes(site, walk.true_site).real)) > 0.2
    assert np.sqrt(np.mean(error.real**2)) < 0.003
    assert np.sqrt(np.mean(error.imag**2)) < 0.2 * DEGREE
    sigma = {b.kind: np.sqrt(np.diag(result.calibration_cov))[b.columns] for b in result.blocks}
    for part, kind in ((error.real, "response_gain"), (error.imag, "response_phase")):
        # Of 8 numbers with common errors: 1 is expected.
        assert 0.3 < np.sqrt(np.mean((part.ravel() / sigma[kind]) ** 2)) < 2.0
    assert trust.verdict is Verdict.TRUSTWORTHY
    navigator = Navigator(site, NavigatorSettings(estimator="ekf"))
    for _, piece in Replay(walk.log).pieces():
        feed(navigator, piece)
    last = navigator.take()[-1]
    error = errors_of_axes(last.calibration.site, walk.true_site)
    assert np.sqrt(np.mean(error.real**2)) < 0.003
    assert np.sqrt(np.mean(error.imag**2)) < 0.2 * DEGREE
    assert last.verdict is Verdict.TRUSTWORTHY


@pytest.mark.slow
def test_a_filtered_log_smooths_like_any_other() -> None:
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=15.0, magnetometer_rate_hz=RATE, perturb=False
    )
    log = simulate_log(demo_site(), config, np.random.default_rng(2)).log
    wave = log.waveform
    assert wave is not None
    first = wave.measured_sensor[0]
    passed = first + lfilter(*low_pass(), wave.measured_sensor - first, axis=0)
    wave = replace(wave, time=wave.time[::THINNED], measured_sensor=passed[::THINNED])
    log = replace(log, waveform=wave)
    assert log.truth is not None
    size, verdict = {}, {}
    for name, site in (("declared", answering(demo_site())), ("not declared", demo_site())):
        result, trust = judge_result(smooth(log, site, SmootherSettings()), log)
        estimate = trajectory_errors(result.states, log.truth)
        error = np.linalg.norm(estimate.position_world, axis=1)
        size[name], verdict[name] = float(np.sqrt(np.mean(error**2))), trust.verdict
    assert size["declared"] < 0.003  # m
    assert verdict["declared"] is Verdict.TRUSTWORTHY
    assert size["not declared"] > 0.02  # m
    assert verdict["not declared"] is not Verdict.TRUSTWORTHY
