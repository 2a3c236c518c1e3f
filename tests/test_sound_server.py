"""A walk is played through PulseAudio without hardware, listened to and navigated."""

import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.optimize import minimize_scalar
from test_recordings import FULL_SCALE, RATE_HZ, sound_site

from magfusion.files.site import save_site
from magfusion.files.stream_contents import imu_content
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.bandpass import BandFilter, BandSampler
from magfusion.model.response import NOMINAL_T_PER_V
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

soundfile = pytest.importorskip("soundfile")
PROGRAMS = ("pulseaudio", "paplay", "pactl")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not all(map(shutil.which, PROGRAMS)), reason="PulseAudio is not installed here"
    ),
]
CHANNELS = "front-left,front-right,rear-left,rear-right"
FORM = f"format=s24le rate={RATE_HZ} channels=4 channel_map={CHANNELS}"
DURATION = 20.0  # s
QUIET = 1.0  # s of records before the walk
MAX_ERROR = 4e-4  # m
MAX_START_DELAY = 3.0  # s; of the first state after the first samples
MATCHED = 37  # every so many samples are compared
Sigma = TypeVar("Sigma", BeaconSigma, MagnetometerSigma)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Start a sound server with a null sink, and yield the environment of its clients."""
    own = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path)}
    own["PULSE_RUNTIME_PATH"] = str(tmp_path / "pulse")
    script = tmp_path / "default.pa"
    script.write_text(
        "load-module module-native-protocol-unix\n"
        f"load-module module-null-sink sink_name=kit {FORM}\n"
        "set-default-source kit.monitor\n"
    )
    command = ["pulseaudio", "-n", "-F", script, "--exit-idle-time=-1", "--daemonize=no"]
    process = subprocess.Popen(
        [*command, "--disable-shm=yes"],
        env=own,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    for _ in range(50):
        time.sleep(0.1)
        if subprocess.run(["pactl", "info"], env=own, capture_output=True).returncode == 0:
            break
    else:
        process.kill()
        process.wait()
        pytest.skip("PulseAudio cannot be started here")
    yield own
    process.terminate()
    process.wait()


def heard(site: Path, recording: Path, own: dict[str, str], output: Path) -> list[dict]:
    """Play a recording, and return the records of what is listened to."""
    words = ["--device", "pulse", "--rate", RATE_HZ, "--channels", "x,y,z,-", "--site", site]
    words += ["--full-scale", FULL_SCALE, "--duration", DURATION + QUIET + 15.0]
    command = [sys.executable, "-m", "magfusion", "listen", *map(str, words)]
    with output.open("wb") as sink, subprocess.Popen(command, env=own, stdout=sink) as listener:
        while listener.poll() is None and not output.stat().st_size:
            time.sleep(0.1)  # a loaded machine takes seconds to begin
        time.sleep(QUIET)
        play = ["paplay", "--device=kit", f"--channel-map={CHANNELS}", "--no-remix", recording]
        subprocess.run(play, env=own, check=True, stderr=subprocess.DEVNULL)
    assert listener.returncode == 0
    return [json.loads(line) for line in output.read_text().splitlines()]


def begin_of(records: list[dict], site: Site, field: Array) -> float:
    """Return when the recording began to play (s), by the amplitudes of its tones."""
    band = BandFilter.of_site(site, RATE_HZ)
    assert band is not None
    place, tones = BandSampler(band).push(field)
    played = np.abs(tones[::MATCHED])
    time_s = np.concatenate([r["baseband"]["time"] for r in records])
    parts = [np.array(r["baseband"]["re"]) + 1j * np.array(r["baseband"]["im"]) for r in records]
    size = np.abs(np.concatenate(parts))
    last = len(size) - len(tones)
    off = [np.sum((size[k : k + len(tones) : MATCHED] - played) ** 2) for k in range(last)]
    return float(time_s[int(np.argmin(off))] - place[0] / RATE_HZ)


def exact_site() -> Site:
    """Return the site of the recordings, calibrated, with a good inertial sensor."""
    site = sound_site()
    beacons = [replace(b, synchronised=False, sigma=without_error(b.sigma)) for b in site.beacons]
    sensor = site.platform.magnetometer
    sensor = replace(sensor, sigma=without_error(sensor.sigma))
    imu = replace(site.platform.imu, gyro_noise=2e-4, accel_noise=2e-3, accel_bias_walk=1e-4)
    platform = replace(site.platform, magnetometer=sensor, imu=imu)
    return replace(site, beacons=tuple(beacons), platform=platform, model_error=1e-3)


def without_error(sigma: Sigma) -> Sigma:
    """Return the prior of a calibration without error."""
    return replace(sigma, **{name: 0.0 * value for name, value in vars(sigma).items()})


@pytest.fixture(scope="module")
def walk() -> Log:
    """Return a walk as a card of an exact clock records it."""
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=DURATION, magnetometer_rate_hz=RATE_HZ, perturb=False
    )
    return simulate_log(exact_site(), config, np.random.default_rng(1)).log


def sampled(log: Log, fast: float) -> Array:
    """Return the field at the samples of a card whose clock is fast by a share (n, 3)."""
    wave = log.waveform
    assert wave is not None
    if not fast:
        return wave.measured_sensor
    elapsed = np.arange(len(wave)) / (RATE_HZ * (1.0 + fast))
    spline = make_interp_spline(wave.time - wave.time[0], wave.measured_sensor, k=7)
    return np.asarray(spline(elapsed))


@pytest.mark.parametrize("card_ppm", [0.0, 50.0])
def test_a_played_walk_is_navigated(
    tmp_path: Path, server: dict[str, str], walk: Log, card_ppm: float
) -> None:
    """The inertial sensor moves with what is played: its samples are stamped by when it begins.

    The server plays and records by one clock.  What a fast card records of the walk is played at
    its nominal rate: the tones are low, and other stamps are on the clock of the card.
    """
    try:
        import sounddevice  # noqa: F401
    except (ImportError, OSError) as error:  # the latter without the library of PortAudio
        pytest.skip(str(error))
    site, fast = of_card(exact_site()), 1e-6 * card_ppm
    save_site(site, tmp_path / "site.yaml")
    field = sampled(walk, fast)
    silent = np.zeros((len(field), 1))
    volts = np.c_[field / (NOMINAL_T_PER_V * FULL_SCALE), silent]
    soundfile.write(tmp_path / "walk.wav", volts, RATE_HZ, subtype="PCM_24")
    records = heard(tmp_path / "site.yaml", tmp_path / "walk.wav", server, tmp_path / "records")
    begin = begin_of(records, site, field)
    log = on_card(walk, fast)
    states = navigated(log, records, begin, tmp_path / "site.yaml")
    assert len(states) > 100
    assert states[0]["time"] - begin < MAX_START_DELAY
    assert {state["verdict"] for state in states} == {"trustworthy"}
    assert error_of(log, states, begin) < MAX_ERROR


def of_card(site: Site) -> Site:
    """Return a site that declares the clock of a sound card, as the page of `listen` asks."""
    sensor = replace(site.platform.magnetometer, clock_rate_sigma=5e-5)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def on_card(log: Log, fast: float) -> Log:
    """Return a log with the stamps of inertial samples and truth on a clock that is fast."""
    assert log.truth is not None
    imu, truth = (replace(part, time=part.time * (1.0 + fast)) for part in (log.imu, log.truth))
    return replace(log, imu=imu, truth=truth)


def navigated(log: Log, records: list[dict], begin: float, site: Path) -> list[dict]:
    """Return the states from the records while the walk lasts, with its inertial samples."""
    own = [
        (r["baseband"]["time"][-1], r)
        for r in records
        if begin + 0.06 < r["baseband"]["time"][0] < begin + DURATION - 0.1
    ]
    imu = log.imu
    for k in range(0, len(imu), 4):
        rows = slice(k, k + 4)
        part = ImuSamples(imu.time[rows] + begin, imu.gyro_body[rows], imu.accel_body[rows])
        own.append((float(part.time[-1]), imu_content(part)))
    lines = [json.dumps(r) for _, r in sorted(own, key=lambda one: one[0])]
    source, sink = io.BytesIO("\n".join(lines).encode()), io.BytesIO()
    run_stream(site, StreamSettings(), source, sink, io.StringIO())
    states = [json.loads(line) for line in sink.getvalue().splitlines()]
    return [state for state in states if state.get("position")]


def error_of(log: Log, states: list[dict], begin: float) -> float:
    """Return the rms position error (m), but for a time offset of up to 10 ms."""
    assert log.truth is not None
    known = CubicSpline(log.truth.time, log.truth.position_world)
    stamps = np.array([state["time"] for state in states])
    position = np.array([state["position"] for state in states])

    def rms(shift: float) -> float:
        off = position - known(stamps - begin - shift)
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    return float(minimize_scalar(rms, bounds=(-0.01, 0.01), method="bounded").fun)
