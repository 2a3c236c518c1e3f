"""A navigation that is killed goes on from its checkpoint and ends with the same figures."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, Worked, run_command
from online_log import WINDOW, OnlineLog, epoch, navigate, online_log
from test_navigate_stream import EKF, answered, records

from magfusion.errors import InputError
from magfusion.estimation.graph.state import State
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.files.atomic import whole_file
from magfusion.files.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.row_file import RowFile
from magfusion.files.site import load_site, save_site
from magfusion.jobs.replay import Replay, feed
from magfusion.jobs.stream import StreamSettings
from magfusion.model.samples import Log

SCRIPT = Path(sys.executable).parent / "magfusion"
TIMING = {"elapsed_s", "memory_mb", "update_p50_ms", "update_p99_ms", "update_max_ms"}
KEY = "ab" * 32
RESULTS = ("trajectory.tum", "trajectory.parquet", "lagged.parquet", "site.yaml")


def _add(file: RowFile, row: Mapping[str, np.ndarray | float]) -> None:
    file.extend({name: np.array([value]) for name, value in row.items()})


def same(one: State, other: State) -> bool:
    names = ("position_world", "world_from_body", "velocity_world", "gyro_bias_body", "cov")
    return one.time == other.time and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in names
    )


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["smoother", "ekf"])
def test_a_restored_navigator_goes_on_to_the_last_bit(estimator: str) -> None:
    """What GTSAM preintegrated is in the checkpoint, with all its digits."""
    log, twins = online_log(8, 22.0), {}

    def watch(navigator, now: float) -> None:  # type: ignore[no-untyped-def]
        if now in (4.0, 10.0, 13.25):  # before the start, and in a full window
            twins[now] = restored(log.site, settings, navigator.checkpoint())

    settings = NavigatorSettings(estimator, delay=0.1)  # type: ignore[arg-type]
    navigator, states = navigate(log, settings, watch=watch)
    for begin, twin in twins.items():
        again = _rest(log, twin, begin)
        expected = states[len(states) - len(again) :]
        assert len(again) > 15
        assert all(same(a, b) for a, b in zip(again, expected, strict=True))
        assert twin.losses == navigator.losses


@pytest.mark.slow
@pytest.mark.parametrize("earth", [False, True])
def test_a_navigator_of_raw_samples_goes_on_to_the_last_bit(worked: Worked, earth: bool) -> None:
    """What its receiver has admitted, and the calibration so far, are in the checkpoint."""
    log, site = open_log(worked.log), load_site(worked.log / "site.yaml")
    settings, replay = NavigatorSettings(lag=1.0, earth=earth), Replay(log)
    navigators, states = [Navigator(site, settings)], {0: [], 1: []}  # type: ignore[var-annotated]
    for k in range(len(replay)):
        if k == 200:
            states[0].clear()
            assert navigators[0].started
            navigators.append(restored(site, settings, navigators[0].checkpoint()))
        for i, navigator in enumerate(navigators):
            feed(navigator, replay.piece(k))
            states[i] += navigator.take()
    assert len(states[1]) > 5
    assert all(same(a, b) for a, b in zip(*states.values(), strict=True))
    assert navigators[0].losses == navigators[1].losses


@pytest.mark.parametrize(
    "foreign",
    [pickle.dumps((0, None)), b"", "navigator", None, {}, {"parts": {}, "estimator": None}],
)
def test_what_is_no_state_of_a_navigator_is_refused(foreign: object) -> None:
    with pytest.raises(InputError, match="run without --resume"):
        restored(online_log(8, 10.0).site, NavigatorSettings(), foreign)


def test_a_bias_that_no_instrument_has_is_refused() -> None:
    log, kept = online_log(8, 14.0), list[Any]()
    settings = NavigatorSettings("ekf")
    navigate(log, settings, watch=lambda own, _: kept.append(own.checkpoint()))
    assert restored(log.site, settings, kept[-1]).started
    changed = list(_values_of(kept[-1], "gyro_bias_body"))
    assert changed
    changed[0][:] = 8e90
    with pytest.raises(InputError, match="has a bias that no instrument has"):
        restored(log.site, settings, kept[-1])


def _values_of(content: Any, name: str) -> Iterator[Any]:
    """Yield what has a name anywhere in plain data."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        if key == name:
            yield value
        elif isinstance(value, dict | list):
            yield from _values_of(value, name)


def _rest(log: OnlineLog, navigator, begin: float) -> list[State]:  # type: ignore[no-untyped-def]
    states: list[State] = []
    arrival = log.fields.time + WINDOW / 2.0
    edges = np.arange(0.0, log.imu.time[-1] + 0.25, 0.25)
    for lo, hi in pairwise(edges):
        if lo < begin:
            continue
        own = slice(*np.searchsorted(log.imu.time, [lo, hi]))
        navigator.add_imu(log.imu.time[own], log.imu.gyro_body[own], log.imu.accel_body[own])
        for k in range(*np.searchsorted(arrival, [lo, hi])):
            navigator.add_fields(epoch(log.fields, k))
        states += navigator.take()
    return states


@pytest.fixture(scope="module")
def phasors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log that takes some seconds to navigate."""
    path = tmp_path_factory.mktemp("phasors") / "log"
    built = online_log(3, 120.0)
    truth = built.motion.trajectory(built.imu.time)
    epoch_ns = 1_700_000_000_000_000_000
    write_log(Log("phasors", epoch_ns, "test", built.imu, None, built.fields, truth), path)
    save_site(built.site, path / "site.yaml")
    return path


@pytest.fixture(scope="module")
def uninterrupted(phasors: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("uninterrupted") / "run"
    run_command("navigate", phasors, "-o", output)
    return output


def _figures(output: Path) -> dict[str, object]:
    figures = json.loads((output / "report.json").read_text())
    return {key: value for key, value in figures.items() if key not in TIMING}


def _killed(log: Path, output: Path, *options: str, kill_after: float | None) -> bool:
    """Run the command; tell whether it was killed, so long (s) after its first checkpoint."""
    command = [SCRIPT, "navigate", log, "-o", output, "--every", "2", *options]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    quiet = {"stdout": subprocess.DEVNULL, "env": os.environ | threads}
    with subprocess.Popen(command, **quiet) as running:  # type: ignore[call-overload]
        place = output / "checkpoint.bin"
        former = place.stat().st_mtime_ns if place.is_file() else 0
        while kill_after is not None and running.poll() is None:
            if place.is_file() and place.stat().st_mtime_ns > former:
                time.sleep(kill_after)
                running.send_signal(signal.SIGKILL)
                break
            time.sleep(0.005)
    assert running.returncode in (0, -signal.SIGKILL)
    return running.returncode != 0


def _ends_alike(log: Path, uninterrupted: Path, output: Path, moments: list[float]) -> int:
    """Kill a run at these moments, each after the one before; return how often it was killed."""
    kills, options = 0, []
    for moment in [*moments, None]:
        killed = _killed(log, output, *options, kill_after=moment)
        kills, options = kills + killed, ["--resume"]
        if not killed:
            break
    assert {p.name for p in output.iterdir()} == {p.name for p in uninterrupted.iterdir()}
    for name in RESULTS:
        assert (output / name).read_bytes() == (uninterrupted / name).read_bytes(), name
    assert _figures(output) == _figures(uninterrupted)
    return kills


@pytest.mark.slow
def test_a_run_killed_twice_ends_as_if_it_had_not_been(
    phasors: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    moments = np.random.default_rng(1).uniform(0.05, 0.6, 2).tolist()
    assert _ends_alike(phasors, uninterrupted, tmp_path / "run", moments) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_run_killed_at_any_moment_ends_as_if_it_had_not_been(
    phasors: Path, uninterrupted: Path, tmp_path: Path, seed: int
) -> None:
    moment = float(np.random.default_rng(100 + seed).uniform(0.0, 2.5))
    _ends_alike(phasors, uninterrupted, tmp_path / "run", [moment])


@pytest.mark.slow
def test_killed_before_the_first_checkpoint_it_begins_again(
    phasors: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    output = tmp_path / "run"
    output.mkdir()
    begun = RowFile(output / "checkpoint.rows", {"time": 1})
    _add(begun, {"time": 1.0})
    begun.settle()
    begun.close()
    with whole_file(output / "checkpoint.bin") as unfinished:  # and the first checkpoint
        unfinished.write_bytes(b"\0")
        remaining = unfinished.read_bytes()
        name = unfinished.name.replace(f"-{os.getpid()}.", "-4194305.")  # no process has it
    (output / "checkpoint.bin").unlink()
    (output / name).write_bytes(remaining)
    run_command("navigate", phasors, "-o", output, "--resume")
    assert (output / "trajectory.tum").read_bytes() == (
        uninterrupted / "trajectory.tum"
    ).read_bytes()


@pytest.mark.slow
def test_the_checkpoint_may_lie_elsewhere_and_goes_when_all_is_done(
    worked: Worked, tmp_path: Path
) -> None:
    place = tmp_path / "kept" / "navigator"
    run_command("navigate", worked.log, "-o", tmp_path / "run", "--checkpoint", place)
    assert not place.parent.exists()


def test_the_checkpoint_of_another_run_is_refused(
    refuse: Refuse, worked: Worked, tmp_path: Path
) -> None:
    write_checkpoint(Checkpoint("ab" * 32, 5, {}), tmp_path / "checkpoint.bin")
    command = ("navigate", worked.log, "-o", tmp_path / "run", "--resume", "--checkpoint")
    reported = refuse(*command, tmp_path / "checkpoint.bin")
    assert "is the checkpoint of another log, site or setting" in reported
    (tmp_path / "checkpoint.bin").write_bytes(b"nonsense")
    assert "is no checkpoint of magfusion" in refuse(*command, tmp_path / "checkpoint.bin")


def test_rows_made_after_the_checkpoint_are_forgotten(tmp_path: Path) -> None:
    columns = {"time": 1, "position": 3}

    def row(k: float) -> dict[str, np.ndarray | float]:
        return {"time": k, "position": np.full(3, k)}

    file = RowFile(tmp_path / "rows", columns)
    for k in range(4):
        _add(file, row(k))
    mark = file.settle()
    assert mark.rows == 4
    _add(file, row(9.0))
    file.close()
    again = RowFile(tmp_path / "rows", columns, mark)
    _add(again, row(4.0))
    assert again.rows()["position"][:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    further = again.settle()
    again.close()
    shorter = RowFile(tmp_path / "rows", columns, mark)
    assert len(shorter.rows()["time"]) == 4
    shorter.close()
    with pytest.raises(InputError, match="does not match its checkpoint"):
        RowFile(tmp_path / "rows", columns, further)


def test_a_checkpoint_that_cannot_be_written_leaves_the_former(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint.bin"
    write_checkpoint(Checkpoint(KEY, 1, {"state": "first"}), path)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("magfusion.files.checkpoint.os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_checkpoint(Checkpoint(KEY, 2, {"state": "second"}), path)
    result = read_checkpoint(path, KEY)
    assert result is not None
    assert result.content == {"state": "first"}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.bin"]


@pytest.mark.slow
def test_a_stream_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    walk, site, place = online_log(3, 14.0), tmp_path / "site.yaml", tmp_path / "checkpoint"
    save_site(walk.site, site)
    lines = records(walk).splitlines(keepends=True)
    whole, _ = answered(site, b"".join(lines))
    settings = StreamSettings(EKF.navigator, checkpoint=place, every=1.0)
    answered(site, b"".join(lines[:230]), settings)
    result = read_checkpoint(place)
    assert result is not None
    assert 200 < result.position <= 230
    resumed = StreamSettings(EKF.navigator, checkpoint=place, every=1.0, resume=True)
    later, _ = answered(site, b"".join(lines[result.position :]), resumed)
    assert later[-1] == whole[-1]
    assert later == whole[len(whole) - len(later) :]
