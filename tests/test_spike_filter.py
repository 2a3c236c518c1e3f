"""Single false samples in a pipe: left out as in a log, with the wait of two samples."""

import io
import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_data_cleaning import STREAMS, missing_rows, walked, with_spikes

from magfusion.estimation.data_checks.spike_filter import SpikeFilter
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.files.site import save_site
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE, Array

ROWS = (
    [700],
    [900, 902],
    [900, 901],
    [900, 901, 902],
    list(range(900, 908)),
    [2, 2397],
    list(range(40, 1000, 120)),
)


def streamed(
    own: SpikeFilter, time: Array, rows: Array, size: int
) -> tuple[Array, Array, list[int]]:
    """Return what passes of samples that come several at a time, and how many wait after each."""
    passed, waiting = [], []
    for k in range(0, len(time), size):
        passed.append(own.push(time[k : k + size], rows[k : k + size]))
        waiting.append(min(k + size, len(time)) - sum(len(t) for t, _ in passed) - own.left_out)
    passed.append(own.end())
    return (
        np.concatenate([t for t, _ in passed]),
        np.concatenate([r for _, r in passed]),
        waiting,
    )


def filtered(log: Log, size: int = 10) -> tuple[Log, dict[str, list[int]]]:
    """Return a log that went through the filters of a pipe, and how many samples waited."""
    site, wave = demo_site(coil_radius=None), log.waveform
    assert wave is not None
    inertial = SpikeFilter(("gyroscope", "accelerometer"), site)
    both = np.hstack([log.imu.gyro_body, log.imu.accel_body])
    time, rows, late = streamed(inertial, log.imu.time, both, size)
    imu = ImuSamples(time, rows[:, :3], rows[:, 3:])
    magnetic = SpikeFilter(("magnetometer",), site)
    time, rows, later = streamed(magnetic, wave.time, wave.measured_sensor, size)
    return Log("", 0, "", imu, Waveform(time, rows)), {"imu": late, "field": later}


@pytest.mark.parametrize("size", [6.0, 1e4])
@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("stream", STREAMS)
def test_false_samples_of_a_stream_are_those_of_its_log(
    stream: str, rows: list[int], size: float
) -> None:
    log = walked()
    result, _ = filtered(with_spikes(log, stream, rows, size, axis=1), 7)
    assert missing_rows(log, result, stream) == rows


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("row", [0, 1, 33, -2, -1])
def test_a_false_sample_at_an_end_of_a_stream_is_left_out(stream: str, row: int) -> None:
    log = walked()
    result, _ = filtered(with_spikes(log, stream, [row], 35.0))
    count = 4800 if stream == "field" else 2400
    assert missing_rows(log, result, stream) == [row % count]


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["walk", "turn"])
def test_a_stream_without_false_samples_passes_whole_and_at_once(motion: Any) -> None:
    site = demo_site(coil_radius=None)
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=12.0, motion=motion)
    log = simulate_log(site, plan, np.random.default_rng(9)).log
    if motion == "turn":  # the same motion, as fast as a hand can
        faster = 800.0 * DEGREE / float(np.max(np.linalg.norm(log.imu.gyro_body, axis=1)))
        time = log.imu.time / faster
        log = Log(
            "",
            0,
            "",
            ImuSamples(time, faster * log.imu.gyro_body, log.imu.accel_body),
            log.waveform,
        )
    result, waiting = filtered(log, size=1)
    for recorded, own in ((log.imu, result.imu), (log.waveform, result.waveform)):
        for name, values in vars(recorded).items():
            if isinstance(values, np.ndarray):
                np.testing.assert_array_equal(getattr(own, name), values)
    for late in waiting.values():
        assert max(late[32:]) <= 2
        assert np.mean(np.array(late[32:]) > 0) < 0.02


def test_late_samples_pass_as_they_are() -> None:
    site, rng = demo_site(coil_radius=None), np.random.default_rng(1)
    time = 0.005 * np.arange(400)
    rows = 1e-3 * rng.standard_normal((400, 6))
    order = np.arange(400)
    order[100:110] = np.roll(order[100:110], 3)
    passed, values, _ = streamed(
        SpikeFilter(("gyroscope", "accelerometer"), site), time[order], rows[order], 10
    )
    assert sorted(passed.tolist()) == time.tolist()
    np.testing.assert_array_equal(values[np.argsort(passed)], rows)


@cache
def lines(stream: str, rows: tuple[int, ...], size: float) -> bytes:
    sink = io.BytesIO()
    run_replay(with_spikes(walked(), stream, list(rows), size), sink, "json", realtime=False)
    return sink.getvalue()


def navigated(given: bytes, estimator: Any, path: Path) -> tuple[Array, Array, str]:
    """Return the errors of a pipe's positions (m) and attitudes (deg), and its messages."""
    save_site(demo_site(coil_radius=None), path / "site.yaml")
    sink, messages = io.BytesIO(), io.StringIO()
    settings = StreamSettings(NavigatorSettings(estimator))
    run_stream(path / "site.yaml", settings, io.BytesIO(given), sink, messages)
    states = [json.loads(line) for line in sink.getvalue().splitlines()]
    states = [state for state in states if state["started"]]
    truth = walked().truth
    assert truth is not None
    assert len(states) > 15
    time = np.array([state["time"] for state in states])
    near = np.argmin(np.abs(truth.time - time[:, None]), axis=1)
    position = np.array([state["position"] for state in states]) - truth.position_world[near]
    own = Rotation.from_quat([state["quaternion"] for state in states], scalar_first=True)
    off = own.inv() * Rotation.from_matrix(truth.world_from_body[near])
    return np.linalg.norm(position, axis=1), off.magnitude() / DEGREE, messages.getvalue()


@cache
def undisturbed(estimator: str) -> tuple[Array, Array, str]:
    with TemporaryDirectory() as path:
        return navigated(lines("gyro", (), 0.0), estimator, Path(path))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stream", "estimator", "rows"),
    [
        ("gyro", "ekf", (300, 899, 1400)),
        ("gyro", "ekf", (300, 1400, 1402)),
        ("accel", "ekf", (300, 899, 1400)),
        ("field", "ekf", (300, 1800, 4000)),
        ("gyro", "smoother", (300, 899, 1400)),
    ],
)
def test_false_samples_do_not_move_the_states_of_a_pipe(
    stream: str, estimator: str, rows: tuple[int, ...], tmp_path: Path
) -> None:
    expected = undisturbed(estimator)
    result = navigated(
        lines(stream, rows, 35.0 if stream != "field" else 3e-4), estimator, tmp_path
    )
    assert expected[2] == ""
    kind = "magnetometer" if stream == "field" else "imu"
    assert result[2] == (
        f"magfusion: {kind}: 3 isolated samples are off their neighbours, probably by bit errors."
        " They are left out.\n"
    )
    for own, whole in zip(result[:2], expected[:2], strict=True):
        assert rms(own) < 1.2 * rms(whole)
        assert own[-1] < 1.2 * whole[-1] + 0.1 * rms(whole)
