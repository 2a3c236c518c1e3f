"""Samples that are recorded in batches with one stamp are counted, and spread between stamps."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from conftest import Refuse, change_table
from example_bag import FIELD, GYRO, IMU, STAMPS, STEP_NS, N, field_message, header, imu_message
from example_bag import write_bag as write_example
from test_bag_files import imported, recording

from magfusion.errors import InputError
from magfusion.files.foreign.convert import write_stream
from magfusion.files.foreign.plan import Findings, plan_stream
from magfusion.files.foreign.text import text_source
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.row_stamps import separate_stamps
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.results.figures import Figures

BATCH = 5


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check of imported logs, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def _bag(path: Path) -> Path:
    """Write a bag whose driver reads five inertial samples at once and stamps them together."""

    def together(k: int) -> object:
        message = imu_message(k)
        message.header = header(int(STAMPS[k - k % BATCH + BATCH - 1]))
        return message

    return write_example(path, {"/imu": (IMU, together), "/mag": (FIELD, field_message)})


def test_batches_of_a_bag_are_read_at_their_sampling_times(tmp_path: Path) -> None:
    bag = _bag(tmp_path / "run")
    log = open_log(bag)
    assert log.epoch_ns == STAMPS[0]
    (finding,) = log.findings
    assert finding.code == "repeated_stamps"
    assert "32 of 40 samples have the stamp of the one before, in batches of 5" in finding.text
    by_itself, figures = imported(tmp_path / "log", bag)
    assert any("in batches of 5" in note for note in figures["notes"])
    counted, _ = imported(tmp_path / "counted", bag, rate_hz=("imu=200",))
    for one in (log, by_itself, counted):
        assert one.waveform is not None
        time = 1e-9 * STEP_NS * np.arange(N)  # s
        np.testing.assert_allclose(one.imu.time, time, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.waveform.time, time, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(one.imu.gyro_body, GYRO)


def test_a_rate_with_a_start_counts_the_messages_from_there(tmp_path: Path) -> None:
    start_ns = int(STAMPS[3])
    rate = f"imu=200@{start_ns // 10**9}.{start_ns % 10**9:09d}"
    log, _ = imported(tmp_path / "log", _bag(tmp_path / "run"), rate_hz=(rate,))
    assert log.epoch_ns == start_ns
    assert len(log.imu) == N


def test_the_shared_bag_of_batches_has_200_hz(tmp_path: Path) -> None:
    bag = recording("equal_stamps_bag")
    for k, options in enumerate(({}, {"rate_hz": ("imu=200",)})):
        log, _ = imported(tmp_path / str(k), bag, **options)
        assert len(log.imu) == 1200
        np.testing.assert_allclose(np.diff(log.imu.time), 0.005, rtol=0, atol=1e-9)  # s


def _written(tmp_path: Path, seconds: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the stamps (ns) that the import of a table gives, and what it notes of batches."""
    rows = np.column_stack([seconds, np.random.default_rng(3).normal(size=(len(seconds), 6))])
    head = "time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
    path = tmp_path / "imu.csv"
    np.savetxt(path, rows, fmt="%.9f", delimiter=",", header=head, comments="")
    plan = plan_stream("imu", text_source(path), (), None, Findings())
    assert plan is not None
    counts = write_stream(plan, tmp_path / "imu.parquet")
    stamps = pyarrow.parquet.read_table(tmp_path / "imu.parquet")["time_ns"].to_numpy()
    assert counts.written == len(stamps)
    assert (counts.first, counts.last) == (stamps[0], stamps[-1])
    return stamps, counts.batches


def test_a_table_with_a_stamp_a_second_keeps_all_its_samples(tmp_path: Path) -> None:
    rate = 204.8  # Hz
    taken = np.arange(2048) / rate  # s
    # Written at the end of each of its clock's seconds.
    stamps, note = _written(tmp_path, np.ceil(taken - 0.37) + 0.37)
    assert "2037 of 2048 samples" in note
    # True to two steps; the last sample's second was not over when it was written.
    error = stamps[:1800] * 1e-9 - taken[:1800]
    assert np.max(np.abs(error)) < 2.0 / rate


def test_batches_that_arrive_unevenly_are_as_late_as_they_arrive(tmp_path: Path) -> None:
    taken = 0.005 * np.arange(2000)  # s
    late = np.random.default_rng(5).uniform(0.0, 0.004, 200)  # s
    arrived = np.repeat(taken[9::10] + late, 10)
    stamps, _ = _written(tmp_path, arrived)
    error = stamps * 1e-9 - taken
    assert np.all(np.diff(stamps) > 0)
    assert error.min() > -1e-6
    assert error.max() < 0.0041  # s


def test_nothing_is_spread_over_a_gap(tmp_path: Path) -> None:
    taken = 0.005 * np.arange(400)  # s
    taken[200:] += 1.0
    stamps, _ = _written(tmp_path, np.repeat(taken[4::5], 5))
    np.testing.assert_allclose(stamps * 1e-9, taken, rtol=0, atol=1e-9)


@pytest.mark.parametrize("current", [False, True])
def test_batches_of_a_log_are_read_unless_other_columns_have_their_stamps(
    tmp_path: Path, current: bool
) -> None:
    time = 0.013 + 0.005 * np.arange(400)  # s
    wave = Waveform(time, np.random.default_rng(8).normal(0.0, 2e-5, (400, 3)))
    imu = ImuSamples(
        time, np.zeros((400, 3)), np.tile([0.0, 0.0, 9.81], (400, 1)) + wave.time[:, None]
    )
    write_log(
        Log(name="run", epoch_ns=int(STAMPS[0]), source="test", imu=imu, waveform=wave),
        tmp_path / "log",
    )

    def together(columns: dict[str, Any]) -> None:
        columns["time_ns"] = np.repeat(columns["time_ns"][4::5], 5)
        if current and "field_x" in columns:
            columns["current_A"] = np.ones(400)

    for stream in ("imu", "magnetometer"):
        change_table(tmp_path / "log" / f"{stream}.parquet", together)
    if current:
        with pytest.raises(InputError, match=r"rows have the stamp of another: .* coarser than"):
            open_log(tmp_path / "log")
        return
    log = open_log(tmp_path / "log")
    assert [finding.code for finding in log.findings] == ["repeated_stamps"] * 2
    for own in (log.imu.time, log.waveform.time if log.waveform else np.zeros(0)):
        np.testing.assert_allclose(own, time, rtol=0, atol=1e-9)


def test_rows_written_twice_and_clocks_too_coarse_are_no_batches(
    tmp_path: Path, refuse: Refuse
) -> None:
    values = np.random.default_rng(6).normal(size=(300, 3))
    once = 5_000_000 * np.arange(300)
    assert separate_stamps(np.repeat(once, 2), np.repeat(values, 2, axis=0)) is None
    assert separate_stamps(once, values) is None
    minutes = 60_000_000_000 * (np.arange(300) // 100) + 1_234_567_891
    assert separate_stamps(minutes, values) is None
    # Rounded down, a stamp would be that of the first sample.
    rounded = 5_000_000 * np.arange(300) // 50_000_000 * 50_000_000
    assert separate_stamps(rounded, values) is None
    assert separate_stamps(rounded + 12_345_678, values) is not None
    stopped = once + 1_234_567
    stopped[100:150] = stopped[100]
    assert separate_stamps(np.where(np.arange(300) < 100, stopped[99], stopped), values) is None
    assert separate_stamps(stopped, values) is None
    bag = write_example(tmp_path / "run", {"/imu": (IMU, _at_once), "/mag": (FIELD, field_message)})
    sentence = refuse("import", bag, "-o", tmp_path / "log")
    # Times of arrival are on another clock than the headers of the other topic.
    assert "times of imu and magnetometer do not overlap" in sentence


def _at_once(k: int) -> object:
    message = imu_message(k)
    message.header = header(int(STAMPS[0]))
    return message
