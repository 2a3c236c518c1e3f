"""Currents of coils that were recorded beside the field: phasors are referred to them."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_reference import CURRENT, Config, wandering_log, with_currents

from magfusion.errors import InputError
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.demodulation.drive_reference import referred, with_drives
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.channel_effects import driven
from magfusion.model.drive import DriveSamples, DriveShares
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import Log
from magfusion.model.site import Slots
from magfusion.receiver.drive import DriveReceiver
from magfusion.simulation.demo_site import demo_site

DURATION = 12.0  # s
SITE = with_currents(demo_site())


@pytest.fixture(scope="module")
def wandering() -> Log:
    return wandering_log(Config(DURATION), steady=False)


def test_a_share_is_a_factor_of_the_phasor() -> None:
    shares = DriveShares()
    shares.add_readings("B", 0, np.array([1.0, 3.0]), np.array([0.9, 0.7]) * np.exp([0.2j, 0.6j]))
    site = demo_site()
    pose = np.array([2.0]), np.eye(3)[None], np.array([[3.0, 2.0, 1.0]])
    steady, driven = (
        predict_channels(initial_calibration(known, 0.0), *pose)
        for known in (site, replace(site, drives=shares))
    )
    expected = np.where(
        np.array([name == "B" for name, _ in site.channels])[:, None],
        np.sqrt(0.9 * 0.7) * np.exp(0.4j),
        1.0,
    )
    np.testing.assert_allclose(driven[0] / steady[0], expected * np.ones(3), rtol=1e-12)


def test_angles_have_no_jumps_and_go_on_for_one_interval() -> None:
    shares, time = DriveShares(), np.arange(6.0)
    for part in (slice(0, 3), slice(3, 6)):
        shares.add_readings("A", 0, time[part], np.exp(2.5j * time[part]))
    result = shares.at("A", 0, np.array([4.5, 6.0, 9.0]))
    assert result is not None
    np.testing.assert_allclose(result[1], 2.5 * np.array([4.5, 6.0, 6.0]), rtol=1e-12)


def test_windows_do_not_depend_on_the_pieces(wandering: Log) -> None:
    assert wandering.drive is not None
    whole, pieces = DriveReceiver(SITE, DriveShares()), DriveReceiver(SITE, DriveShares())
    whole.push(wandering.drive)
    edges = np.sort(np.random.default_rng(1).integers(0, len(wandering.drive.time), 200))
    for begin, end in zip([0, *edges], [*edges, len(wandering.drive.time)], strict=True):
        pieces.push(wandering.drive.rows(slice(begin, end)))
    for key, readings in whole.shares.readings.items():
        np.testing.assert_array_equal(pieces.shares.readings[key], readings)
        assert readings.shape[1] > 50


def test_phasors_are_those_of_steady_currents(wandering: Log) -> None:
    steady = wandering_log(Config(DURATION), steady=True)
    log, site = with_drives(wandering, SITE)
    fields = phasors(log, site)[0]
    result, expected = referred(fields, site), phasors(steady, SITE)[0]
    sigma = np.sqrt(np.einsum("nkii->nk", expected.phasor_cov))
    for remaining, worst in ((fields, 20.0), (result, 3.0)):
        error = np.linalg.norm(remaining.phasor_sensor - expected.phasor_sensor, axis=2) / sigma
        assert (np.median(error) < worst) == (remaining is result)
        assert np.median(error) < 3.0 or remaining is fields


def test_pulses_of_direct_current_have_a_share() -> None:
    (first, *_) = SITE.beacons
    coils = tuple(replace(c, phase=0.0, slot=k) for k, c in enumerate(first.coils))
    slots = Slots(0.1, len(coils) + 1, 0.03)
    pulsed = replace(first, frequency_hz=0.0, coils=coils, slots=slots)
    site = replace(SITE, beacons=(pulsed,))
    time = np.arange(0.0, 4.0, 1e-3)
    number = slots.running(time) % slots.count
    current = np.choose(number, [0.8 * CURRENT, -1.1 * CURRENT, *[0.0] * (slots.count - 2)])
    receiver = DriveReceiver(site, DriveShares())
    receiver.push(DriveSamples(time, {"": current}))
    for tone, share in enumerate((0.8, -1.1)):
        result = receiver.shares.at(pulsed.name, tone, np.array([2.0]))
        assert result is not None
        assert np.exp(result[0] + 1j * result[1])[0] == pytest.approx(share, rel=1e-9)


def test_log_and_site_keep_currents(wandering: Log, tmp_path: Path) -> None:
    write_log(wandering, tmp_path / "log")
    save_site(SITE, tmp_path / "site.yaml")
    log = read_log(tmp_path / "log", 5.0, 9.0)
    assert log.drive is not None
    assert wandering.drive is not None
    kept = (wandering.drive.time >= 5.0) & (wandering.drive.time < 9.0)
    np.testing.assert_array_equal(log.drive.current["C"], wandering.drive.current["C"][kept])
    known = load_site(tmp_path / "site.yaml")
    assert all(coil.current == CURRENT for b in known.beacons for coil in b.coils)


def test_what_does_not_fit_is_refused(wandering: Log) -> None:
    with pytest.raises(InputError, match=r"beacon A: .* give current_a of its coils"):
        with_drives(wandering, demo_site())
    assert wandering.drive is not None
    other = replace(wandering.drive, current={"Z": wandering.drive.current["A"]})
    with pytest.raises(InputError, match=r"drive_Z: the site has no beacon Z; name one of A, B"):
        with_drives(replace(wandering, drive=other), SITE)


def test_a_column_in_milliamperes_is_said(wandering: Log) -> None:
    assert wandering.drive is not None
    wrong = {name: 1e3 * values for name, values in wandering.drive.current.items()}
    log, _ = with_drives(replace(wandering, drive=replace(wandering.drive, current=wrong)), SITE)
    result = [f for f in log.findings if f.code == "drive_current"]
    assert len(result) == 4
    assert "times that of its declared moments" in result[0].text
    log, _ = with_drives(wandering, SITE)
    assert not [f for f in log.findings if f.code == "drive_current"]


@pytest.mark.slow
def test_the_pipe_hears_the_currents(wandering: Log, tmp_path: Path) -> None:
    save_site(SITE, tmp_path / "site.yaml")
    write_log(wandering, tmp_path / "log")
    given, reported, sink = io.BytesIO(), io.StringIO(), io.BytesIO()
    run_replay(read_log(tmp_path / "log"), given, "json", realtime=False)
    given.seek(0)
    run_stream(
        tmp_path / "site.yaml", StreamSettings(NavigatorSettings("ekf")), given, sink, reported
    )
    last = json.loads(sink.getvalue().splitlines()[-1])
    truth = wandering.truth
    assert truth is not None
    at = truth.position_world[np.argmin(np.abs(truth.time - last["time"]))]
    # Phases and currents of the site alone are 40 cm and more off.
    assert np.linalg.norm(np.array(last["position"]) - at) < 0.005  # m
    assert last["verdict"] == "trustworthy"


def test_online_a_column_in_milliamperes_is_said_as_offline(wandering: Log) -> None:
    assert wandering.drive is not None
    wrong = {name: 1e3 * values for name, values in wandering.drive.current.items()}
    currents = replace(wandering.drive, current=wrong).rows(slice(0, 1000))
    navigator, offline = Navigator(SITE), replace(wandering, drive=currents)
    navigator.add_drive(currents)
    findings = [finding.text for finding in navigator.of_currents]
    assert len(findings) == 4
    assert findings == [f.text for f in with_drives(offline, SITE)[0].findings]


def test_a_run_goes_on_with_its_currents(wandering: Log) -> None:
    assert wandering.drive is not None
    first = Navigator(SITE)
    first.add_drive(wandering.drive.rows(slice(0, 1000)))
    second = restored(SITE, NavigatorSettings(), first.checkpoint())
    for navigator in (first, second):
        navigator.add_drive(wandering.drive.rows(slice(1000, 2000)))
    time = np.linspace(0.5, 4.5, 9)
    result, expected = (driven(navigator.site, time) for navigator in (second, first))
    assert expected is not None
    np.testing.assert_array_equal(result, expected)
