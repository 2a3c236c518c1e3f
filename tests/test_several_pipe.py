"""Several magnetometers through the pipe: the states of the log, whatever comes late."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from test_several_magnetometers import two_magnetometers

from magfusion.errors import InputError
from magfusion.estimation.demodulation.separate_demodulation import demodulated_apart
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.fields import by_own_clocks
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.site import save_site
from magfusion.files.stream import json_line
from magfusion.files.trajectory_table import read_trajectory
from magfusion.jobs.navigate import run_navigate
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.replay import Replay, feed, run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

BOX = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])
EKF = NavigatorSettings("ekf")


@pytest.fixture(scope="module")
def site() -> Site:
    return two_magnetometers(demo_site(coil_radius=None))


@pytest.fixture(scope="module")
def raw(site: Site) -> Log:
    config = SimulationConfig(box_world=BOX, duration=9.0)
    return simulate_log(site, config, np.random.default_rng(5)).log


@pytest.fixture(scope="module")
def demodulated(site: Site, raw: Log) -> Log:
    fields = demodulated_apart(raw, site).log.fields
    assert fields is not None
    return replace(raw, waveforms={}, fields=by_own_clocks(fields, site))


def written(log: Log, site: Site, place: Path) -> Path:
    write_log(log, place / "log")
    save_site(site, place / "log" / "site.yaml")
    return place / "log"


def records(directory: Path) -> list[dict[str, Any]]:
    """Return a log as the records that `replay` prints."""
    sink = io.BytesIO()
    run_replay(open_log(directory), sink, "json", realtime=False)
    return [json.loads(line) for line in sink.getvalue().splitlines()]


def piped(
    lines: list[dict[str, Any]], directory: Path, settings: StreamSettings | None = None
) -> list[dict[str, Any]]:
    """Return the states that a stream leads to."""
    settings = StreamSettings(EKF) if settings is None else settings
    source, sink = io.BytesIO(b"".join(map(json_line, lines))), io.BytesIO()
    run_stream(directory / "site.yaml", settings, source, sink, io.StringIO())
    reported = [json.loads(line) for line in sink.getvalue().splitlines()]
    return [state for state in reported if state["started"]]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raw", "demodulated"])
def test_a_log_and_its_records_lead_to_the_same_states(
    kind: str, site: Site, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    log: Log = request.getfixturevalue(kind)
    directory = written(log, site, tmp_path)
    settings = NavigateSettings(log=directory, estimator="ekf")
    run_navigate(settings, tmp_path / "out")
    expected = read_trajectory(tmp_path / "out" / "trajectory.parquet", log.epoch_ns)
    result = piped(records(directory), directory)
    assert len(result) == len(expected.time) > 10
    for name, values in (("time", expected.time), ("position", expected.position_world)):
        reported = np.array([state[name] for state in result])
        np.testing.assert_allclose(reported, values, rtol=0.0, atol=1e-7)


def delayed(lines: list[dict[str, Any]], name: str, late: float) -> list[dict[str, Any]]:
    """Return a stream in which what is of a magnetometer comes so much later (s)."""
    due: list[tuple[float, dict[str, Any]]] = []
    now = -np.inf
    for line in lines:
        kind = next(iter(line))
        now = max(now, float(np.max(line[kind]["time"])))
        due.append((now + late * (line[kind].get("magnetometer") == name), line))
    return [line for _, line in sorted(due, key=lambda one: one[0])]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raw", "demodulated"])
def test_one_that_is_late_changes_no_state(
    kind: str, site: Site, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    directory = written(request.getfixturevalue(kind), site, tmp_path)
    lines = records(directory)
    expected, result = piped(lines, directory), piped(delayed(lines, "right", 0.3), directory)
    assert len(result) == len(expected)
    for one, other in zip(result, expected, strict=True):
        assert abs(one["time"] - other["time"]) < 1e-9
        # The start's passes end at a share of a sigma: what rounding makes of that is below 0.1 um.
        np.testing.assert_allclose(one["position"], other["position"], rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(
            one["sigma"]["position"], other["sigma"]["position"], rtol=1e-5, atol=0.0
        )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raw", "demodulated"])
def test_one_that_falls_silent_is_named_and_the_other_goes_on(
    kind: str, site: Site, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    directory = written(request.getfixturevalue(kind), site, tmp_path)
    lines = [
        line
        for line in records(directory)
        if next(iter(line.values())).get("magnetometer") != "right"
        or np.max(next(iter(line.values()))["time"]) < 6.5
    ]
    result = piped(lines, directory)
    silent = [
        state
        for state in result
        if any(r["code"] == "magnetometer_silent" for r in state["remarks"])
    ]
    assert silent
    assert all("Magnetometer right has sent nothing" in str(state["remarks"]) for state in silent)
    assert silent[0]["time"] > 6.0
    assert result[-1]["time"] > 8.0
    # With half of what is measured the position is known less.
    both, late = piped([*records(directory)], directory), silent[-1]["time"]
    same = min(both, key=lambda state: abs(state["time"] - late))
    assert max(silent[-1]["sigma"]["position"]) > max(same["sigma"]["position"])


@pytest.mark.slow
def test_one_that_comes_again_is_heard_again(site: Site, demodulated: Log, tmp_path: Path) -> None:
    directory = written(demodulated, site, tmp_path)
    lines = [
        line
        for line in records(directory)
        if next(iter(line.values())).get("magnetometer") != "right"
        or not 5.9 < np.max(next(iter(line.values()))["time"]) < 7.9
    ]
    result = piped(lines, directory)
    named = [bool(state["remarks"]) for state in result]
    assert any(named)
    assert not named[-1]


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (
            {"magnetometer": {"time": 0.0, "field": [0.0, 0.0, 0.0], "magnetometer": "middle"}},
            r"line 1: the samples are of magnetometer middle, which .*it has left, right",
        ),
        (
            {"magnetometer": {"time": 0.0, "field": [0.0, 0.0, 0.0]}},
            r"line 1: the samples do not specify which .*left, right",
        ),
        (
            {
                "fields": {
                    "time": 0.0,
                    "window": 0.1,
                    "phasors": {},
                    "sigma": 1e-9,
                    "magnetometer": "middle",
                }
            },
            r"line 1: the fields are of magnetometer middle",
        ),
        (
            {"fields": {"time": 0.0, "window": 0.1, "phasors": {}, "sigma": 1e-9}},
            r"line 1: the fields do not specify which",
        ),
        (
            {
                "magnetometer": {
                    "time": 0.0,
                    "field": [0.0, 0.0, 0.0],
                    "magnetometer": "left",
                    "slot": 1,
                }
            },
            r"line 1: magnetometer: slots of the samples of several",
        ),
    ],
)
def test_what_does_not_say_whose_it_is_is_refused(
    record: dict[str, Any], sentence: str, site: Site, tmp_path: Path
) -> None:
    save_site(site, tmp_path / "site.yaml")
    with pytest.raises(InputError, match=sentence):
        piped([record], tmp_path)


def test_samples_and_fields_in_one_stream_are_refused(site: Site, tmp_path: Path) -> None:
    save_site(site, tmp_path / "site.yaml")
    tones = [[[1e-7, 0.0, 0.0], [0.0, 0.0, 0.0]]]
    fields = {"time": 0.0, "window": 0.1, "phasors": {"A": tones}, "sigma": 1e-9}
    samples = {"time": 0.0, "field": [0.0, 0.0, 1e-5]}
    lines: list[dict[str, Any]] = [
        {"magnetometer": {**samples, "magnetometer": "left"}},
        {"fields": {**fields, "magnetometer": "right"}},
    ]
    for order in (lines, lines[::-1]):
        with pytest.raises(InputError, match=r"standard input.*: .* mixed with (samples|fields)"):
            piped(order, tmp_path)


def test_the_name_of_the_only_one_is_taken_and_another_refused(tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    samples = {"time": 0.0, "field": [0.0, 0.0, 1e-5]}
    assert piped([{"magnetometer": {**samples, "magnetometer": "magnetometer"}}], tmp_path) == []
    with pytest.raises(InputError, match="of magnetometer left, which the site does not know"):
        piped([{"magnetometer": {**samples, "magnetometer": "left"}}], tmp_path)


def test_the_earth_field_of_several_is_refused(site: Site) -> None:
    with pytest.raises(InputError, match="--earth uses a single magnetometer"):
        Navigator(site, NavigatorSettings(earth=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raw", "demodulated"])
def test_a_stream_goes_on_from_its_checkpoint(
    kind: str, site: Site, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    directory = written(request.getfixturevalue(kind), site, tmp_path)
    lines = records(directory)
    expected = piped(lines, directory)
    kept = StreamSettings(EKF, checkpoint=tmp_path / "kept.bin", every=0.01)
    # A checkpoint is left with the newest stamp there is: that of an inertial record.
    cut = 1 + max(k for k in range(int(0.85 * len(lines))) if "imu" in lines[k])
    before = piped(lines[:cut], directory, kept)
    after = piped(lines[cut:], directory, replace(kept, resume=True))
    assert before
    assert after
    assert [*before, *after] == expected


@pytest.mark.slow
def test_what_is_kept_does_not_grow(site: Site, raw: Log) -> None:
    navigator, replayed = Navigator(site, EKF), Replay(raw)
    sizes = []
    for _, piece in replayed.pieces():
        feed(navigator, piece)
        navigator.take()
        if navigator.started:
            sizes.append(len(msgpack.packb(navigator.checkpoint(), default=lambda a: a.tobytes())))
    half = len(sizes) // 2
    assert max(sizes[half:]) < 1.1 * max(sizes[:half])
