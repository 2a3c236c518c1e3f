"""Clocks in a pipe: counters that wrap, steps, and single stamps that are wrong."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from online_log import OnlineLog, online_log
from test_navigate_stream import EKF, answered, records

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.records import Record
from magfusion.files.site import save_site
from magfusion.jobs.checkpoint import REPORT_INTERVAL, CheckpointWriter
from magfusion.jobs.replay import Replay, feed
from magfusion.jobs.stream import StreamSettings
from magfusion.jobs.stream_clocks import StreamClocks
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

WRAP = 2.0**32 * 1e-6  # s; of a 32-bit counter of microseconds
SECONDS = 22.0


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(3, SECONDS)


@pytest.fixture(scope="module")
def site(walk: OnlineLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clocks") / "site.yaml"
    save_site(walk.site, path)
    return path


@pytest.fixture(scope="module")
def lines(walk: OnlineLog) -> list[dict[str, Any]]:
    return [json.loads(line) for line in records(walk).splitlines()]


def newest(line: dict[str, Any]) -> float:
    (part,) = line.values()
    return float(np.max(part["time"]))


def stamped(line: dict[str, Any], change: Any) -> dict[str, Any]:
    ((kind, part),) = line.items()
    return {kind: part | {"time": change(np.asarray(part["time"], dtype=float)).tolist()}}


def sent(lines: list[dict[str, Any]]) -> bytes:
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)


def errors(walk: OnlineLog, states: list[dict[str, Any]], later: float = 0.0) -> np.ndarray:
    """Return the distances of states from the truth (m), whose clock was so much later (s)."""
    time = np.array([s["time"] for s in states]) + later
    truth = walk.motion.trajectory(time).position_world
    return np.linalg.norm(np.array([s["position"] for s in states]) - truth, axis=1)


@pytest.mark.slow
def test_a_counter_of_microseconds_goes_on_where_it_wraps(
    walk: OnlineLog, site: Path, lines: list[dict[str, Any]]
) -> None:
    ahead = WRAP - 0.5 * SECONDS
    given = [stamped(one, lambda t: (t + ahead) % WRAP) for one in lines]
    states, reported = answered(site, sent(given))
    started = [s for s in states if s["started"]]
    assert reported == ""
    assert np.all(np.diff([s["time"] for s in started]) > 0.0)
    assert len(started) > 25
    assert np.max(errors(walk, started, -ahead)) < 0.05  # m


@pytest.mark.slow
@pytest.mark.parametrize("step", [-5.0, -40.0, 3600.0])
def test_after_a_step_navigation_starts_anew(
    walk: OnlineLog, site: Path, lines: list[dict[str, Any]], step: float
) -> None:
    later = [newest(one) > 9.0 for one in lines]
    given = [
        stamped(one, lambda t: t + step) if new else one
        for one, new in zip(lines, later, strict=True)
    ]
    states, reported = answered(site, sent(given))
    (told,) = re.findall(r"imu: its clock stepped by (\S+) s; navigation restarts", reported)
    assert float(told) == pytest.approx(step, abs=0.1)  # s, two pieces of the stream
    first = next(k for k, s in enumerate(states) if s["started"])
    stepped = next(k for k in range(first, len(states)) if not states[k]["started"])
    anew = [s for s in states[stepped:] if s["started"]]
    assert len(anew) > 5
    assert np.max(errors(walk, anew, -step)) < 0.05  # m
    assert all(s["reset_counter"] == 1 for s in anew)


def test_a_step_back_by_less_than_a_second_is_reported(lines: list[dict[str, Any]]) -> None:
    """Its samples are older than those used, and are left out; one late record is no step."""

    def reported(given: list[dict[str, Any]], delay: float = 0.0) -> list[str]:
        clocks = StreamClocks(delay)
        result: list[str] = []
        for line in given:
            record = Record.model_validate(line)
            result += clocks.set_back(record)
            clocks.check(record)
        return result

    inertial = [one for one in lines if "imu" in one]
    back = [stamped(one, lambda t: t - 0.4) if newest(one) > 9.0 else one for one in inertial]
    (sentence,) = reported(back)
    ((by, before),) = re.findall(r"^imu: .* back by (\S+) s; samples before (\S+) s", sentence)
    assert float(by) == pytest.approx(0.4, abs=0.03)  # s, a sample and rounding
    assert float(before) == pytest.approx(9.0, abs=0.03)
    assert reported(back, delay=0.5) == []
    assert reported(inertial) == []
    for one, other in zip(inertial[40:80:2], inertial[41:80:2], strict=True):
        assert reported([*inertial[:40], other, one, *inertial[80:]]) == []  # exchanged
        assert reported([*inertial[:40], one, one, other, other]) == []  # sent twice


@pytest.mark.slow
def test_a_single_wrong_stamp_is_left_out_and_said(site: Path, lines: list[dict[str, Any]]) -> None:
    wrong = next(k for k, one in enumerate(lines) if "imu" in one and newest(one) > 8.0)
    spoiled = [*lines]
    spoiled[wrong] = stamped(lines[wrong], lambda t: t + 1e6)
    expected, _ = answered(site, sent([*lines[:wrong], *lines[wrong + 1 :]]))
    states, reported = answered(site, sent(spoiled))
    assert [s for s in states if s["started"]] == [s for s in expected if s["started"]]
    assert f"line {wrong + 1}: imu: its clock jumped ahead by" in reported
    assert reported.count("\n") == 2  # it, and the count


def test_a_checkpoint_that_cannot_be_written_is_said_once_a_minute(
    walk: OnlineLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    now = [0.0]
    monkeypatch.setattr("magfusion.jobs.checkpoint.time.monotonic", lambda: now[0])
    writer = CheckpointWriter(tmp_path / "gone" / "state", "ab" * 32, sys.stderr)
    navigator = Navigator(walk.site)
    for _ in range(13):  # every ten seconds
        writer.save(navigator, 1, None)
        now[0] += REPORT_INTERVAL / 6.0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3
    assert all("the checkpoint cannot be written" in line for line in said)


def test_stamps_of_companions_wrap_with_those_of_samples() -> None:
    clocks = StreamClocks(0.0)
    for now in np.arange(WRAP - 1.0, WRAP + 1.0, 0.1):
        stamp = float(now % WRAP)
        record = Record.model_validate(
            {
                "magnetometer": {"time": stamp, "field": [0.0, 0.0, 4e-5]},
                "temperature": {"time": stamp, "degc": {"A": 20.0}},
                "marks": {"start": [stamp], "end": [stamp], "slot": [0]},
            }
        )
        found = clocks.unwrapped(record)
        clocks.check(found)
        assert found.magnetometer is not None
        assert found.temperature is not None
        assert found.marks is not None
        stamps = (found.temperature.time, *found.magnetometer.time, *found.marks.end)
        np.testing.assert_allclose(stamps, now, atol=1e-5)  # s


def test_a_temperature_makes_no_checkpoint_and_is_no_old_data(
    site: Path, lines: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=100.0)
    first = [one for one in lines if newest(one) < 9.0]
    answered(site, sent(first), settings)
    saved: list[int] = []
    monkeypatch.setattr(CheckpointWriter, "save", lambda *given: saved.append(given[2]))
    reading = {"temperature": {"time": 9.0, "degc": {"A": 20.0}}}
    rest = [one for one in lines if 9.0 <= newest(one) < 10.0]
    given = sent([part for one in rest for part in (reading, one)])
    _, reported = answered(site, given, replace(settings, resume=True))
    assert reported == ""
    assert len(saved) == 1


@pytest.mark.slow
def test_data_after_a_step_back_behind_the_checkpoint_are_used(
    site: Path, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=1.0)
    answered(site, sent([one for one in lines if newest(one) < 9.0]), settings)
    rest = [
        stamped(one, lambda t: t - 6.0) if newest(one) >= 10.0 else one
        for one in lines
        if newest(one) >= 9.0
    ]
    states, reported = answered(site, sent(rest), replace(settings, resume=True))
    assert "its clock stepped by" in reported
    assert "before the checkpoint" not in reported
    assert any(state["started"] for state in states)


@pytest.mark.slow
def test_a_resumed_run_navigates_on_a_clock_that_began_again(
    walk: OnlineLog, site: Path, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    """Nobody knows how long the device was off: neither the state nor its biases are used."""
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=1.0)
    later = [stamped(one, lambda t: t + 5e3) for one in lines if newest(one) < 9.0]
    answered(site, sent(later), settings)
    states, reported = answered(site, sent(lines), replace(settings, resume=True))
    (begun,) = re.findall(r"the clock began again; navigation restarts at (\S+) s", reported)
    assert float(begun) == pytest.approx(10.0, abs=0.1)  # s
    anew = [s for s in states if s["started"]]
    assert len(anew) > 5
    assert np.max(errors(walk, anew)) < 0.05  # m
    assert all(s["reset_counter"] == 1 for s in anew)


@pytest.mark.slow
def test_a_run_resumed_after_long_starts_anew(
    walk: OnlineLog, site: Path, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=1.0)
    answered(site, sent([one for one in lines if newest(one) < 9.0]), settings)
    later = [stamped(one, lambda t: t + 100.0) for one in lines if newest(one) >= 9.0]
    states, reported = answered(site, sent(later), replace(settings, resume=True))
    assert re.search(r"imu: its clock stepped by \+10\d s; navigation restarts", reported)
    anew = [s for s in states if s["started"]]
    assert len(anew) > 5
    assert np.max(errors(walk, anew, -100.0)) < 0.05  # m


@pytest.mark.slow
@pytest.mark.parametrize("wraps_at", [5.0, 9.0])
def test_a_counter_that_wrapped_before_the_resumption_goes_on(
    walk: OnlineLog, site: Path, lines: list[dict[str, Any]], tmp_path: Path, wraps_at: float
) -> None:
    """Before the checkpoint, or between it and the resumption."""
    ahead = WRAP - wraps_at
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=1.0)
    given = [(newest(one), stamped(one, lambda t: (t + ahead) % WRAP)) for one in lines]
    answered(site, sent([one for time, one in given if time < 9.0]), settings)
    rest = sent([one for time, one in given if time >= 9.0])
    states, reported = answered(site, rest, replace(settings, resume=True))
    assert reported == ""
    assert len(states) > 20
    assert np.max(errors(walk, states, -ahead)) < 0.05  # m


@pytest.mark.slow
def test_a_start_that_waits_for_late_samples_has_streams_of_one_length() -> None:
    """The inertial samples of the time that it waits for are no difference of clocks."""
    log = simulate_log(
        demo_site(), SimulationConfig(DEMO_BOX_WORLD, duration=8.0), np.random.default_rng(3)
    ).log
    navigator = Navigator(demo_site(), NavigatorSettings("ekf", delay=1.0))
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
    states = navigator.take()
    assert states
    assert not any(state.judgement.reasons for state in states)


@pytest.mark.slow
@pytest.mark.parametrize("behind", [0.0, 100.0])
def test_records_before_a_checkpoint_are_counted_and_change_nothing(
    site: Path, lines: list[dict[str, Any]], tmp_path: Path, behind: float
) -> None:
    """A sender that repeats what was sent, or what it kept of an earlier run."""
    settings = StreamSettings(EKF.navigator, checkpoint=tmp_path / "state", every=1.0)
    answered(site, sent([one for one in lines if newest(one) < 9.0]), settings)
    kept = (tmp_path / "state").read_bytes()
    rest = [one for one in lines if newest(one) >= 9.0]
    old = [stamped(one, lambda t: t - behind) for one in lines if newest(one) < 7.0]
    expected, nothing = answered(site, sent(rest), replace(settings, resume=True))
    (tmp_path / "state").write_bytes(kept)
    states, reported = answered(site, sent([*old, *rest]), replace(settings, resume=True))
    assert nothing == ""
    assert "run without --resume" in reported
    assert reported.endswith(f"{len(old)} records before the checkpoint are not used\n")
    assert states == expected
    assert len([one for one in states if one["started"]]) > 10
