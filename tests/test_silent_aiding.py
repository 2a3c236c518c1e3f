"""Aiding sensors of the site of which a log, or a part of it, has no samples."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from aiding_site import aided_site

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.estimation.data_checks.stamps import silent_aiding
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.check import CheckSettings, run_check
from magfusion.jobs.replay import Replay
from magfusion.model.aiding import AidingSamples, AidingSensor
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trust import Verdict
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

DURATION = 60.0  # s
ROOM = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.2]])  # m
LEVEL = AidingSensor("level", "height", 0.02)
FOOT = AidingSensor("foot", "mark", 0.02, marks_world={"7": np.zeros(3)})
EVERY = np.arange(0.1, DURATION, 0.1)  # s
OTHER_EPOCH = 1.7e9  # s; a log by its own clock, and a sensor by that of the world


def _log(heights_at: Array | None) -> Log:
    time = np.arange(0.0, DURATION, 0.01)
    resting = np.zeros((len(time), 3))
    aiding = {}
    if heights_at is not None:
        value = np.zeros((len(heights_at), 1))
        aiding["level"] = AidingSamples("height", heights_at, value)
    return Log("drive", 0, "test", ImuSamples(time, resting, resting), aiding=aiding)


@pytest.mark.parametrize(
    ("heights_at", "part"),
    [
        (None, "level of the site's aiding has no samples from 0.0 to 60.0 s"),
        (EVERY + OTHER_EPOCH, "The samples of level, from 1700000000.1 to"),
        (EVERY[EVERY < 39.96], "level has no samples from 39.9 to 60.0 s"),
        (EVERY[np.abs(EVERY - 20.0) > 5.05], "level has no samples from 14.9 to 25.1 s"),
    ],
)
def test_a_sensor_without_samples_is_named(heights_at: Array | None, part: str) -> None:
    (finding,) = silent_aiding(_log(heights_at), aided_site(LEVEL))
    assert finding.code == "aiding_silent"
    assert finding.verdict is Verdict.TRUSTWORTHY
    assert part in finding.text


@pytest.mark.parametrize("heights_at", [EVERY, np.arange(0.0, DURATION, 2.5)])
def test_a_sensor_with_samples_throughout_is_not_named(heights_at: Array) -> None:
    assert not list(silent_aiding(_log(heights_at), aided_site(LEVEL)))


def test_a_platform_is_seldom_on_a_mark() -> None:
    once = {"foot": AidingSamples("mark", np.array([30.0]), np.zeros((1, 0)), ("7",))}
    assert not list(silent_aiding(replace(_log(None), aiding=once), aided_site(FOOT)))


def test_the_check_of_a_recording_names_it() -> None:
    log = simulate_log(aided_site(LEVEL), SimulationConfig(ROOM, 2.0), np.random.default_rng(1)).log
    codes = [f.code for f in recorded(replace(log, aiding={}), aided_site(LEVEL))]
    assert "aiding_silent" in codes


def test_a_sensor_of_another_clock_does_not_lengthen_the_replay() -> None:
    assert len(Replay(_log(EVERY + OTHER_EPOCH))) == len(Replay(_log(None)))


def test_check_refuses_a_sensor_that_the_site_lacks(tmp_path: Path) -> None:
    log = simulate_log(aided_site(LEVEL), SimulationConfig(ROOM, 2.0), np.random.default_rng(1)).log
    write_log(log, tmp_path / "log")
    save_site(aided_site(replace(LEVEL, name="level_1")), tmp_path / "log" / "site.yaml")
    with pytest.raises(InputError, match="level is no aiding sensor of the site"):
        run_check(CheckSettings(log=tmp_path / "log"))


def test_stamps_in_another_unit_are_named() -> None:
    epoch = 1_700_000_000.0  # s
    milliseconds = (epoch + EVERY) * 1e-6 - epoch  # read as nanoseconds
    log = replace(_log(milliseconds), epoch_ns=int(epoch * 1e9))
    (finding,) = silent_aiding(log, aided_site(LEVEL))
    assert "They are milliseconds: write nanoseconds." in finding.text
