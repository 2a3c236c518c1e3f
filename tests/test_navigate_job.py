"""magfusion navigate along a log: what it writes, tells and refuses."""

import json
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from conftest import Refuse, Worked, change_table, run_command
from evo.tools import file_interface
from online_log import online_log
from rerun.chunk import RrdReader

from magfusion.cli import main
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.trajectory_table import read_trajectory
from magfusion.jobs.inputs import read_estimate
from magfusion.jobs.replay import PIECE, Replay, feed, paced
from magfusion.model.samples import Log
from magfusion.results.recording_live import LiveView


@pytest.fixture(scope="module")
def smoothed(worked: Worked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("navigated") / "run"
    run_command("navigate", worked.log, "-o", output)
    return output


@pytest.fixture(scope="module")
def phasors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log of phasors alone, which is navigated in no time."""
    path = tmp_path_factory.mktemp("phasors") / "log"
    built = online_log(3, 30.0)
    truth = built.motion.trajectory(built.imu.time)
    log = Log("phasors", 1_700_000_000_000_000_000, "test", built.imu, None, built.fields, truth)
    write_log(log, path)
    save_site(built.site, path / "site.yaml")
    return path


def report(output: Path) -> dict[str, float]:
    figures: dict[str, float] = json.loads((output / "report.json").read_text())
    return figures


@pytest.mark.slow
def test_it_writes_what_smooth_writes_and_the_lagged_states(smoothed: Path) -> None:
    names = {path.name for path in smoothed.iterdir()}
    assert names == {
        "trajectory.tum",
        "trajectory.parquet",
        "lagged.parquet",
        "report.html",
        "report.json",
        "run.rrd",
        "site.yaml",
        "site_correlation.parquet",
    }
    epochs = report(smoothed)["epochs"]
    assert file_interface.read_tum_trajectory_file(smoothed / "trajectory.tum").num_poses == epochs
    assert len(RrdReader(smoothed / "run.rrd").recordings()) == 1
    refined = load_site(smoothed / "site.yaml")
    assert refined.platform.imu.time_offset == pytest.approx(report(smoothed)["imu.time_offset_s"])


@pytest.mark.slow
def test_the_report_tells_errors_losses_latency_and_memory(smoothed: Path, worked: Worked) -> None:
    figures = report(smoothed)
    assert figures["job"] == "navigate"
    assert figures["estimator"] == "smoother"
    assert figures["ate_m"] < 0.008
    assert figures["attitude_rmse_deg"] < 0.4
    assert figures["lagged_ate_m"] < 0.008
    assert 0.0 < figures["update_p50_ms"] <= figures["update_p99_ms"] <= figures["update_max_ms"]
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # with earlier tests
    assert 50.0 < figures["memory_mb"] <= peak_mb
    assert figures["first_state_s"] < 7.0
    for beacon in load_site(worked.log / "site.yaml").beacons:
        assert 0.0 < figures[f"distortion_{beacon.name}"] < 3.0
    assert figures["imu.time_offset_s_sigma"] < 0.5 * figures["imu.time_offset_s_prior_sigma"]
    assert "imu.time_offset_s" in figures["determined"]


@pytest.mark.slow
def test_the_current_states_are_those_that_the_navigator_made(
    phasors: Path, tmp_path: Path
) -> None:
    run_command("navigate", phasors, "-o", tmp_path / "run", "--estimator", "ekf")
    log, site = read_log(phasors), load_site(phasors / "site.yaml")
    navigator, states = Navigator(site, NavigatorSettings("ekf")), []
    replayed = Replay(log)
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        states += navigator.take()
    written = read_estimate(tmp_path / "run", log.epoch_ns)
    assert np.array_equal(written.position_world, [s.position_world for s in states])
    assert written.pose_cov is not None
    assert np.array_equal(written.pose_cov[:, 3, 3], [s.cov[3, 3] for s in states])
    assert not (tmp_path / "run" / "lagged.parquet").exists()
    assert "lag_s" not in report(tmp_path / "run")


@pytest.mark.slow
def test_the_lagged_states_are_better_than_the_current(phasors: Path, tmp_path: Path) -> None:
    run_command("navigate", phasors, "-o", tmp_path / "run", "--lag", 3)
    figures = report(tmp_path / "run")
    assert figures["lagged_ate_m"] < 0.85 * figures["ate_m"]
    lagged = read_trajectory(tmp_path / "run" / "lagged.parquet", 0)
    assert figures["lagged_epochs"] == len(lagged)
    current = read_estimate(tmp_path / "run")
    assert current.time[-1] - lagged.time[-1] == pytest.approx(3.0, abs=0.6)


@pytest.mark.slow
def test_what_was_refused_is_counted(phasors: Path, tmp_path: Path) -> None:
    log = read_log(phasors)
    assert log.fields is not None
    corrupted = log.fields.phasor_sensor.copy()
    corrupted[40:43, 1] += 1e-6
    fields = replace(log.fields, phasor_sensor=corrupted)
    write_log(replace(log, fields=fields), tmp_path / "log")
    save_site(load_site(phasors / "site.yaml"), tmp_path / "log" / "site.yaml")
    run_command("navigate", tmp_path / "log", "-o", tmp_path / "run", "--estimator", "ekf")
    assert report(tmp_path / "run")["counted_outlier_of_B"] == 3


def test_pieces_are_all_of_the_log_in_the_order_of_arrival(worked: Worked) -> None:
    log = read_log(worked.log)
    phasors = read_log(worked.phasors).fields
    assert log.waveform is not None
    assert phasors is not None
    replayed = Replay(replace(log, fields=phasors))
    pieces = [piece for _, piece in paced(replayed.pieces(), False)]
    imu = np.concatenate([p.imu.time for p in pieces])
    waves = np.concatenate([p.waveform.time for p in pieces if p.waveform is not None])
    assert np.array_equal(imu, log.imu.time)
    assert np.array_equal(waves, log.waveform.time)
    given = [(p.arrival, s) for p in pieces for s in p.fields]
    assert np.array_equal([s.time[0] for _, s in given], phasors.time)
    for arrival, samples in given:
        late = arrival - (samples.time[0] + samples.window[0] / 2.0)
        assert -1e-9 <= late <= PIECE + 1e-9
    for piece in pieces:
        newest = np.max(piece.imu.time, initial=-np.inf)
        assert newest < piece.arrival <= newest + 2.1 * PIECE or not len(piece.imu)


def test_realtime_is_paced_by_the_logs_clock(phasors: Path) -> None:
    log = read_log(phasors, 0.0, 0.6)
    began = time.monotonic()
    arrivals = [
        (piece.arrival, time.monotonic() - began) for _, piece in paced(Replay(log).pieces(), True)
    ]
    first = arrivals[0][0]
    for arrival, elapsed in arrivals:
        assert elapsed >= arrival - first - 1e-3
    assert arrivals[-1][1] < 5.0


def test_the_live_view_draws_every_state(phasors: Path, tmp_path: Path) -> None:
    log, site = read_log(phasors, end=9.0), load_site(phasors / "site.yaml")
    recording = rr.RecordingStream("magfusion")
    recording.save(tmp_path / "live.rrd")
    view, navigator, shown = LiveView(site, recording), Navigator(site, NavigatorSettings("ekf")), 0
    replayed = Replay(log)
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        for state in navigator.take():
            view.show(state, navigator.distortion)
            shown += 1
    recording.disconnect()
    rows: dict[str, int] = {}
    for chunk in RrdReader(tmp_path / "live.rrd").stream().to_chunks():
        if not chunk.is_static:  # styles are
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    assert shown > 3
    for axis in "xyz":
        assert rows[f"/plots/position_m/{axis}"] == shown
    assert rows["/plots/innovations/A"] >= shown - 1


# Refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--lag", 0.1), "--lag must lie between 0.5 and 60 s; got 0.1"),
        (("--delay", -1), "--delay must lie between 0 and 10 s"),
        (("--every", 0), "--every must lie between"),
        (("--keep-going",), "--keep-going and --format require a stream"),
        (("--estimator", "ukf"), "'ukf' is not one of"),
    ],
)
def test_options_that_cannot_be_are_refused(
    refuse: Refuse, worked: Worked, tmp_path: Path, options: tuple[object, ...], sentence: str
) -> None:
    assert sentence in refuse("navigate", worked.log, "-o", tmp_path / "run", *options)


def test_a_log_too_short_for_a_state_fails_and_leaves_no_result(
    worked: Worked, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["navigate", str(worked.log), "-o", str(tmp_path / "run"), "--end", "3"])
    assert ended.value.code == 1
    assert "give no state: Record longer." in capfd.readouterr().err
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"report.json", "failed"}
    figures = json.loads((tmp_path / "run" / "report.json").read_text())
    assert figures["verdict"] == "failed"
    assert [reason["code"] for reason in figures["reasons"]] == ["no_start"]


def test_a_clock_that_jumped_is_refused_and_leaves_nothing(
    refuse: Refuse, log: Path, tmp_path: Path
) -> None:
    def jump(columns: dict[str, list[int]]) -> None:
        half = len(columns["time_ns"]) // 2
        columns["time_ns"][half:] = [t + 3600 * 10**9 for t in columns["time_ns"][half:]]

    for name in ("imu", "magnetometer"):
        change_table(log / f"{name}.parquet", jump)
    reported = refuse("navigate", log, "-o", tmp_path / "run", "--estimator", "ekf")
    assert "more than an hour after the row above: the clock jumped" in reported


def test_other_files_in_the_output_are_not_touched(
    refuse: Refuse, worked: Worked, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    assert "holds other files" in refuse("navigate", worked.log, "-o", tmp_path / "mine")
