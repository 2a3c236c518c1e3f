"""What a program or a notebook of one's own meets after ``import magfusion as mf``."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import pandas
import pyarrow as pa
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import magfusion as mf
from magfusion.files.trajectory_table import read_trajectory
from magfusion.files.tum import read_tum
from magfusion.simulation.demo_site import demo_site

ONE_LINE = 200  # characters
EPOCH_NS = 1_790_000_000_123_456_789
BOX = np.array([[-1.5, -1.5, 0.5], [1.5, 1.5, 1.5]])


@pytest.fixture(scope="module")
def simulated() -> tuple[mf.Log, mf.Site]:
    site = demo_site()
    result = mf.simulate_log(
        site, mf.SimulationConfig(BOX, duration=10.0), np.random.default_rng(1)
    )
    return replace(result.log, epoch_ns=EPOCH_NS), site


@pytest.fixture(scope="module")
def result(simulated: tuple[mf.Log, mf.Site]) -> mf.SmoothedLog:
    log, site = simulated
    return mf.smooth(log, site)


@pytest.fixture(scope="module")
def trajectory(result: mf.SmoothedLog) -> mf.ResultTrajectory:
    return result.trajectory


@pytest.fixture(scope="module")
def navigator(simulated: tuple[mf.Log, mf.Site]) -> mf.Navigator:
    log, site = simulated
    assert log.waveform is not None
    navigator = mf.Navigator(site, mf.NavigatorSettings(estimator="ekf"))
    field = log.waveform
    for tenth in range(100):
        i, m = (stream.time // 0.1 == tenth for stream in (log.imu, field))
        navigator.add_imu(log.imu.time[i], log.imu.gyro_body[i], log.imu.accel_body[i])
        navigator.add_magnetometer(field.time[m], field.measured_sensor[m])
    return navigator


def test_the_version_is_that_which_is_installed() -> None:
    assert mf.__version__ == version("magfusion")
    assert "__version__" in dir(mf)


def test_euler_angles_are_turned_by_yaw_then_pitch_then_roll(
    trajectory: mf.ResultTrajectory,
) -> None:
    roll, pitch, yaw = trajectory.euler.T
    by_hand = (
        Rotation.from_rotvec(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
        * Rotation.from_rotvec(pitch[:, None] * np.array([0.0, 1.0, 0.0]))
        * Rotation.from_rotvec(roll[:, None] * np.array([1.0, 0.0, 0.0]))
    )
    np.testing.assert_allclose(by_hand.as_matrix(), trajectory.world_from_body, atol=1e-12)


def test_the_rotation_takes_what_the_accelerometer_holds_at_rest_up() -> None:
    """A body that is rolled by 90 deg has the world's up along its own y."""
    turn = Rotation.from_euler("xyz", [90.0, 0.0, 0.0], degrees=True).as_matrix()
    still = mf.Trajectory(np.zeros(1), turn[None], np.zeros((1, 3)))
    np.testing.assert_allclose(still.euler, [[np.pi / 2.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(still.rotation.apply([0.0, 9.81, 0.0]), [[0, 0, 9.81]], atol=1e-12)


def test_position_and_covariance_are_those_of_the_states(
    trajectory: mf.ResultTrajectory, result: mf.SmoothedLog
) -> None:
    assert np.array_equal(trajectory.position, result.states.position_world)
    assert trajectory.cov is result.states.pose_cov
    assert np.array_equal(trajectory.time, result.states.time)


def test_what_is_saved_as_a_table_is_read_back(
    trajectory: mf.ResultTrajectory, tmp_path: Path
) -> None:
    for name in ("t.parquet", "t.csv"):
        trajectory.save(tmp_path / name)
        read = read_trajectory(tmp_path / name, EPOCH_NS)
        assert read.pose_cov is not None
        assert trajectory.cov is not None
        np.testing.assert_allclose(read.time, trajectory.time, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(read.position, trajectory.position, rtol=0.0, atol=1e-15)
        rotated = (trajectory.rotation.inv() * read.rotation).magnitude()
        assert np.max(rotated) < 1e-12
        np.testing.assert_allclose(read.pose_cov, trajectory.cov, rtol=1e-12, atol=1e-18)


def test_what_is_saved_as_text_is_read_back(
    trajectory: mf.ResultTrajectory, tmp_path: Path
) -> None:
    trajectory.save(str(tmp_path / "t.tum"))
    read = read_tum(tmp_path / "t.tum", EPOCH_NS)
    np.testing.assert_allclose(read.time, trajectory.time, rtol=0.0, atol=2e-9)
    np.testing.assert_allclose(read.position, trajectory.position, rtol=0.0, atol=1e-9)
    assert np.max((trajectory.rotation.inv() * read.rotation).magnitude()) < 1e-8

    trajectory.save(tmp_path / "t.kitti")
    rows = np.loadtxt(tmp_path / "t.kitti").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows[:, :, :3], trajectory.world_from_body, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rows[:, :, 3], trajectory.position, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("form", ["mcap", "db3"])
def test_what_is_saved_as_a_bag_has_the_log_s_stamps(
    form: str, trajectory: mf.ResultTrajectory, tmp_path: Path
) -> None:
    trajectory.save(tmp_path / f"t.{form}")
    with AnyReader([tmp_path / f"t.{form}"]) as reader:
        result = [
            (stamp, reader.deserialize(raw, one.msgtype).pose.pose.position)
            for one, stamp, raw in reader.messages()
            if one.topic == "/magfusion/odometry"
        ]
    stamps = np.array([stamp - EPOCH_NS for stamp, _ in result])
    np.testing.assert_allclose(1e-9 * stamps, trajectory.time, rtol=0.0, atol=1e-9)
    places = np.array([[p.x, p.y, p.z] for _, p in result])
    np.testing.assert_allclose(places, trajectory.position, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("name", ["t.txt", "t", "nowhere/t.tum"])
def test_a_file_that_cannot_be_written_is_refused_in_a_sentence(
    name: str, trajectory: mf.ResultTrajectory, tmp_path: Path
) -> None:
    with pytest.raises(mf.InputError, match=r"end the name with one of|make it first"):
        trajectory.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_the_table_is_that_of_the_file(trajectory: mf.ResultTrajectory, tmp_path: Path) -> None:
    trajectory.save(tmp_path / "t.parquet")
    pandas.testing.assert_frame_equal(
        trajectory.to_pandas(), pandas.read_parquet(tmp_path / "t.parquet")
    )


def test_a_table_without_pandas_says_what_to_install(
    trajectory: mf.ResultTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Without:
        def to_pandas(self) -> None:
            raise ModuleNotFoundError("No module named 'pandas'")

    monkeypatch.setattr(pa, "table", lambda _: Without())
    with pytest.raises(ImportError, match="pip install pandas"):
        trajectory.to_pandas()


def test_a_plot_shows_the_path_its_bounds_and_its_errors(
    trajectory: mf.ResultTrajectory, simulated: tuple[mf.Log, mf.Site]
) -> None:
    with mpl.rc_context({"backend": "agg"}):
        import matplotlib.pyplot as plt

        axes = trajectory.plot(truth=simulated[0].truth)
        assert plt.get_fignums() == [axes[0].figure.number]
        plan, height, position, _ = axes
        np.testing.assert_array_equal(plan.lines[0].get_xdata(), trajectory.position[:, 0])
        np.testing.assert_array_equal(height.lines[0].get_ydata(), trajectory.position[:, 2])
        names = {text.get_text() for text in plan.texts}
        assert {beacon.name for beacon in trajectory.site.beacons} <= names
        assert trajectory.cov is not None
        largest = np.linalg.eigvalsh(trajectory.cov[:, 3:, 3:])[:, -1]
        drawn = {line.get_label(): line.get_ydata() for line in position.lines}
        np.testing.assert_allclose(drawn["3 sigma, worst direction"], 3.0 * np.sqrt(largest))
        errors = mf.trajectory_errors(trajectory, simulated[0].truth)
        np.testing.assert_allclose(drawn["error"], np.linalg.norm(errors.pose_body[:, 3:], axis=1))
        axes[0].figure.savefig(os.devnull, format="png")
        plt.close(axes[0].figure)


def test_the_states_of_a_navigator_are_a_trajectory(
    navigator: mf.Navigator, simulated: tuple[mf.Log, mf.Site]
) -> None:
    states = navigator.take()
    result = mf.collect_states(states, EPOCH_NS)
    last = states[-1]
    assert result.epoch_ns == EPOCH_NS
    assert np.array_equal(result.position[-1], last.position)
    np.testing.assert_allclose(result.euler[-1], last.euler, rtol=0.0, atol=1e-12)
    assert result.cov is not None
    assert np.array_equal(result.cov[-1], last.cov[:6, :6])
    truth = simulated[0].truth
    assert truth is not None
    assert mf.trajectory_errors(result, truth).ate < 0.1
    with pytest.raises(mf.InputError, match="no state to collect"):
        mf.collect_states([])


def test_whatever_is_public_is_shown_in_one_line(
    result: mf.SmoothedLog, simulated: tuple[mf.Log, mf.Site], navigator: mf.Navigator
) -> None:
    log, site = simulated
    verdicts, trust = mf.judge_result(result, log)
    assert log.truth is not None
    shown = [
        *(log, log.imu, log.waveform, log.truth),
        *(site, site.platform, site.platform.magnetometer, *site.beacons),
        *(result, verdicts, trust, result.trajectory, result.states, result.fields),
        *(result.calibration, result.graph, result.estimate, result.start),
        mf.fix_epochs(result.fields, mf.initial_calibration(site, 0.0)),
        mf.trajectory_errors(result.states, log.truth),
        mf.trajectory_errors(result.states, log.truth).relative,
        *(navigator, navigator.state(), mf.SmootherSettings(), mf.NavigatorSettings()),
        mf.SimulationConfig(BOX),
    ]
    for one in shown:
        assert len(repr(one)) <= ONE_LINE, type(one)
        assert "\n" not in repr(one)
        assert repr(one).startswith((type(one).__name__, "<magfusion"))


def test_a_result_says_whether_it_was_judged(
    result: mf.SmoothedLog, simulated: tuple[mf.Log, mf.Site]
) -> None:
    verdicts, trust = mf.judge_result(result, simulated[0])
    assert isinstance(verdicts, mf.SmoothedLog)
    assert verdicts.trust is trust
    assert "not judged" in repr(result)
    assert str(trust.verdict) in repr(verdicts)


def test_settings_are_shown_as_far_as_they_were_chosen() -> None:
    settings = mf.NavigatorSettings(estimator="ekf", lag=2.5)
    assert repr(settings) == "NavigatorSettings(estimator='ekf', lag=2.5)"


def test_a_notebook_shows_the_head_of_the_page(
    result: mf.SmoothedLog, simulated: tuple[mf.Log, mf.Site]
) -> None:
    """With the verdict and what led to it; what it is styled by stays within it."""
    assert "No verdict yet" in result._repr_html_()
    verdicts, trust = mf.judge_result(replace(result, log_name="<b>log"), simulated[0])
    page = verdicts._repr_html_()
    assert str(trust.verdict).upper() in page
    assert "Main figures" in page
    assert "<b>log" not in page
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.S)
    assert style.startswith(".magfusion{")
    depth = 0
    for k, character in enumerate(style):
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth > 0 or k < len(".magfusion") or k == len(style) - 1
    assert len(page) < 100_000


class Given(NamedTuple):
    """What the calls that are refused are made with."""

    log: mf.Log
    site: mf.Site
    result: mf.SmoothedLog


SWAPPED = "the arguments are swapped; give them in this order"
CONFIG, RNG = mf.SimulationConfig(BOX), np.random.default_rng(1)
REFUSED: list[tuple[Callable[[Given], object], str]] = [
    (lambda g: mf.smooth(g.site, g.log), f"smooth(log, site): {SWAPPED}"),
    (lambda g: mf.judge_result(g.log, g.result), f"judged(result, log): {SWAPPED}"),
    (
        lambda g: mf.fix_epochs(g.result.calibration, g.result.fields),
        f"fix_epochs(samples, calibration): {SWAPPED}",
    ),
    (
        lambda g: mf.simulate_log(g.site, RNG, CONFIG),
        f"simulate_log(site, config, rng): {SWAPPED}",
    ),
    (lambda g: mf.smooth(g.log, "site.yaml"), "site must be a Site; got a str"),
    (lambda g: mf.judge_result(g.result, g.site), "log must be a Log; got a Site"),
    (lambda g: mf.Navigator(g.log), "site must be a Site; got a Log"),
    (lambda g: mf.save_site("site.yaml", g.site), "site must be a Site; got a str"),
    (
        lambda g: mf.trajectory_errors(g.result, g.log.truth),
        "estimate must be a Trajectory; got a SmoothedLog",
    ),
    (
        lambda g: mf.trajectory_errors(g.result.states, None),
        "truth must be a Trajectory; got a NoneType",
    ),
]


@pytest.mark.parametrize(("call", "sentence"), REFUSED, ids=[text for _, text in REFUSED])
def test_arguments_of_another_type_are_refused_by_a_sentence(
    call: Callable[[Given], object],
    sentence: str,
    simulated: tuple[mf.Log, mf.Site],
    result: mf.SmoothedLog,
) -> None:
    with pytest.raises(TypeError, match=re.escape(sentence)) as refused:
        call(Given(*simulated, result))
    assert "\n" not in str(refused.value)


ASKS_TWICE = """
import warnings
import numpy
import scipy.linalg
import threadpoolctl
from magfusion.files.blas_threads import warn_about_threads

def called_by_a_user():
    warn_about_threads()

with threadpoolctl.threadpool_limits({threads}, user_api="blas"):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        called_by_a_user(); called_by_a_user()
print(len(caught), *(one.message for one in caught))
print(*(one.lineno for one in caught))
"""


@pytest.mark.parametrize(
    ("given", "threads", "count"),
    [
        ({}, 2, 1),
        ({}, 1, 0),
        ({"OPENBLAS_NUM_THREADS": "2"}, 2, 0),
        ({"OMP_NUM_THREADS": "2"}, 2, 0),
    ],
)
def test_a_program_is_warned_once_of_threads_that_nobody_asked_for(
    given: dict[str, str], threads: int, count: int
) -> None:
    known = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    script = ASKS_TWICE.format(threads=threads)
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=known | given,
        capture_output=True,
        text=True,
        check=True,
    )
    findings, lines = done.stdout.splitlines()
    assert int(findings.split()[0]) == count
    if count:
        assert "BLAS uses 2 threads" in findings
        assert "OPENBLAS_NUM_THREADS=1" in findings
        assert int(lines) == 1 + script.splitlines().index(
            "        called_by_a_user(); called_by_a_user()"
        )
