"""Coils and a magnetometer that warm up: declared, recorded, and taken off."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from temperature_drift import (
    EVERY,
    MATRIX_PER_K,
    OFFSET_PER_K,
    PER_K,
    REFERENCE,
    Config,
    run,
    temperature_site,
    warm_log,
    warmer,
)

from magfusion.errors import InputError
from magfusion.estimation.demodulation.temperature_compensation import (
    at_reference,
    samples_at_reference,
)
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.demodulate import DemodulateSettings, run_demodulate
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.channel_effects import warmed
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import Log
from magfusion.model.temperature import Temperatures

DURATION = 24.0  # s
READINGS = np.arange(0.0, DURATION + EVERY, EVERY)  # s


def warmth(time: np.ndarray) -> np.ndarray:
    return REFERENCE + warmer(time)


@pytest.fixture(scope="module")
def warm() -> Log:
    return warm_log(DURATION, 3)


def test_a_warm_beacon_is_one_of_other_moments() -> None:
    degrees = Temperatures({name: np.stack([READINGS, warmth(READINGS)]) for name in "ABCD"})
    site, time = replace(temperature_site(), temperatures=degrees), np.array([7.25])
    more = np.interp(7.25, READINGS, warmer(READINGS))
    scaled = tuple(
        replace(
            b,
            temperature_model=None,
            coils=tuple(
                replace(c, moment_beacon=np.exp(PER_K * more) * c.moment_beacon) for c in b.coils
            ),
        )
        for b in site.beacons
    )
    pose = np.eye(3)[None], np.array([[3.0, 2.0, 1.0]])
    result, expected = (
        predict_channels(initial_calibration(known, 0.0), time, *pose)
        for known in (site, replace(site, beacons=scaled))
    )
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    assert np.max(np.abs(np.exp(PER_K * more) - 1.0)) > 0.05


def test_samples_are_those_of_the_reference() -> None:
    rng, sensor = np.random.default_rng(1), temperature_site().platform.magnetometer
    sensor = replace(
        sensor, matrix=np.eye(3) + 0.1 * rng.standard_normal((3, 3)), offset=np.full(3, 3e-6)
    )
    field, degc = 5e-5 * rng.standard_normal((40, 3)), rng.uniform(-20.0, 60.0, 40)
    above = (degc - REFERENCE)[:, None]
    matrix = sensor.matrix + above[..., None] * MATRIX_PER_K
    measured = (matrix @ field[..., None])[..., 0] + sensor.offset + above * OFFSET_PER_K
    result = samples_at_reference(measured, degc, sensor)
    np.testing.assert_allclose(result, field @ sensor.matrix.T + sensor.offset, atol=1e-17)


def test_log_and_site_keep_what_they_say(warm: Log, tmp_path: Path) -> None:
    site = temperature_site()
    write_log(warm, tmp_path / "log")
    save_site(site, tmp_path / "site.yaml")
    known, log = load_site(tmp_path / "site.yaml"), read_log(tmp_path / "log", 5.0, 9.0)
    assert known.beacons[1].temperature_model == site.beacons[1].temperature_model
    assert known.platform.magnetometer.temperature_model is not None
    np.testing.assert_array_equal(
        known.platform.magnetometer.temperature_model.matrix_per_k, MATRIX_PER_K
    )
    assert log.temperatures is not None
    assert set(log.temperatures.readings) == {"A", "B", "C", "D", "magnetometer"}
    np.testing.assert_allclose(log.temperatures.readings["B"][1], warmth(READINGS))


def test_a_temperature_in_kelvin_is_refused(tmp_path: Path, warm: Log) -> None:
    write_log(replace(warm, temperatures=None), tmp_path / "log")
    table = tmp_path / "log" / "temperature.csv"
    begin = warm.epoch_ns
    rows = f"{begin},A,20.5\n{begin + 10**9},A,-293.0\n"
    table.write_text(f"time_ns,part,temperature_degc\n{rows}", encoding="utf-8")
    with pytest.raises(InputError, match=r"temperature.csv: .*row 1 .*-293.*degrees Celsius"):
        read_log(tmp_path / "log")


def test_what_is_declared_and_not_recorded_is_said(warm: Log) -> None:
    log, _ = at_reference(replace(warm, temperatures=None), temperature_site())
    (finding,) = [f for f in log.findings if f.code == "temperature_missing"]
    assert "beacon A" in finding.text
    assert "the magnetometer" in finding.text
    log, _ = at_reference(warm, temperature_site())
    assert not [f for f in log.findings if f.code == "temperature_missing"]


def test_a_run_that_goes_on_knows_how_warm_it_is() -> None:
    site = temperature_site()
    first = Navigator(site)
    for when in (1.0, 2.0, 2.0):  # the last is passed over
        first.add_temperature("B", when, 30.0 + when)
    second = restored(site, NavigatorSettings(), first.checkpoint())
    assert second.site.temperatures is not None
    known = second.site.temperatures.readings
    np.testing.assert_array_equal(known["B"], [[1.0, 2.0], [31.0, 32.0]])
    second.add_temperature("B", 3.0, 50.0)
    warm = warmed(second.site, np.array([2.5]))[0]
    assert warm[[c[0] for c in site.channels].index("B")] == pytest.approx(PER_K * 21.0)


@pytest.mark.slow
def test_a_warm_log_is_as_good_as_a_cold_one() -> None:
    rows = {(row.case, row.estimator): row for row in run(Config(DURATION))}
    smooth, online = (rows["declared", name] for name in ("smooth", "navigate (ekf)"))
    assert smooth.verdict == online.verdict == "trustworthy"
    assert smooth.position_mm < 2.0
    assert online.position_mm < 5.0
    for row in (rows["not declared", name] for name in ("smooth", "navigate (ekf)")):
        assert row.verdict != "trustworthy"
        assert row.position_mm > 50.0


@pytest.mark.slow
def test_the_pipe_hears_what_the_log_has(warm: Log, tmp_path: Path) -> None:
    save_site(temperature_site(), tmp_path / "site.yaml")
    write_log(warm, tmp_path / "log")
    given, reported = io.BytesIO(), io.StringIO()
    run_replay(read_log(tmp_path / "log", None, 9.0), given, "json", realtime=False)
    assert given.getvalue().count(b'"temperature"') > 10
    worst = {}
    for name, records in (
        ("heard", given.getvalue()),
        ("deaf", b"".join(r for r in given.getvalue().splitlines(True) if b"degc" not in r)),
    ):
        sink = io.BytesIO()
        settings = StreamSettings(NavigatorSettings("ekf"))
        run_stream(tmp_path / "site.yaml", settings, io.BytesIO(records), sink, reported)
        lines = [json.loads(line) for line in sink.getvalue().splitlines()]
        states = [line for line in lines if line["started"]]
        nearest = [np.argmin(np.abs(warm.truth.time - state["time"])) for state in states]
        errors = [state["position"] for state in states] - warm.truth.position_world[nearest]
        worst[name] = np.max(np.linalg.norm(errors, axis=1))
    assert worst["heard"] < 0.01  # m
    # Coils that fade by a tenth of their moment seem 3 % farther than they are: 3 m away, 9 cm.
    assert worst["deaf"] > 0.05  # m


def test_demodulated_phasors_lack_no_temperature(warm: Log, tmp_path: Path) -> None:
    write_log(warm, tmp_path / "log")
    save_site(temperature_site(), tmp_path / "log" / "site.yaml")
    run_demodulate(DemodulateSettings(log=tmp_path / "log", end=8.0), tmp_path / "phasors")
    log, site = at_reference(
        read_log(tmp_path / "phasors"), load_site(tmp_path / "phasors" / "site.yaml")
    )
    assert site.platform.magnetometer.temperature_model is None
    assert all(beacon.temperature_model is not None for beacon in site.beacons)
    assert not [f for f in log.findings if f.code == "temperature_missing"]
