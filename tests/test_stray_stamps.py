"""Single stamps hours or years from all others are left out, and a clock that jumped is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from conftest import Refuse, change_table
from example_bag import (
    FIELD,
    GYRO,
    IMU,
    MEASURED,
    POSE,
    POSITION,
    STAMPS,
    Make,
    N,
    field_message,
    header,
    imu_message,
    pose_message,
    write_bag,
)
from example_log import example_log
from test_bag_files import imported, recording

from magfusion.errors import InputError
from magfusion.files.clock_steps import clock_set_back
from magfusion.files.foreign.convert import Counts
from magfusion.files.log import read_log, write_log
from magfusion.files.open import open_log
from magfusion.files.stray_stamps import misplaced_rows, stray_rows
from magfusion.jobs.check import CheckSettings, run_check
from magfusion.jobs.import_figures import first_stamp_of
from magfusion.jobs.import_log import _count_burst
from magfusion.results.figures import Figures

DAY, YEAR = 86_400, 31_536_000  # s
TOPICS: dict[str, tuple[str, Make]] = {
    "/imu": (IMU, imu_message),
    "/mag": (FIELD, field_message),
    "/pose": (POSE, pose_message),
}
ROLES = {"/imu": "IMU", "/mag": "magnetometer", "/pose": "truth"}


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check of imported logs, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def _bag(path: Path, topic: str, row: int, shift_s: int) -> Path:
    msgtype, make = TOPICS[topic]

    def shifted(k: int) -> Any:
        message = make(k)
        if k == row:
            message.header = header(int(STAMPS[k]) + shift_s * 10**9)
        return message

    return write_bag(path, TOPICS | {topic: (msgtype, shifted)})


@pytest.mark.parametrize("topic", list(TOPICS))
@pytest.mark.parametrize(("row", "shift_s"), [(7, DAY), (0, -YEAR), (N - 1, -DAY), (N - 1, YEAR)])
def test_a_stray_stamp_of_a_bag_is_left_out_and_reported(
    tmp_path: Path, topic: str, row: int, shift_s: int
) -> None:
    bag = _bag(tmp_path / "run", topic, row, shift_s)
    log = open_log(bag)
    (finding,) = log.findings
    assert finding.code == "stray_stamps"
    assert finding.text.startswith(f"{ROLES[topic]}: 1 samples have stamps far from")
    by_import, figures = imported(tmp_path / "log", bag)
    stream = ROLES[topic].lower()
    assert figures[f"{stream}_dropped_with_a_stray_time"] == 1
    for one in (log, by_import):
        assert one.waveform is not None
        assert one.truth is not None
        for name, values, expected in (
            ("/imu", one.imu.gyro_body, GYRO),
            ("/mag", one.waveform.measured_sensor, MEASURED),
            ("/pose", one.truth.position_world, POSITION),
        ):
            kept = np.delete(expected, row, axis=0) if name == topic else expected
            np.testing.assert_array_equal(values, kept)
        assert one.epoch_ns == STAMPS[0]
        assert one.imu.time[-1] < 0.2  # s


@pytest.mark.parametrize("stream", ["imu", "magnetometer"])
@pytest.mark.parametrize("shift_s", [DAY, -YEAR, 60, -30])
def test_a_stray_stamp_of_a_log_is_left_out_wherever_its_row_is(
    tmp_path: Path, stream: str, shift_s: int
) -> None:
    write_log(example_log(), tmp_path / "log")
    table = tmp_path / "log" / f"{stream}.parquet"

    def shift(columns: dict[str, Any]) -> None:
        columns["time_ns"][5] += shift_s * 10**9

    before = read_log(tmp_path / "log")
    change_table(table, shift)
    log = read_log(tmp_path / "log")
    assert [finding.code for finding in log.findings] == ["stray_stamps"]
    own, whole = (
        (one.imu.time if stream == "imu" else one.waveform.time if one.waveform else None)
        for one in (log, before)
    )
    np.testing.assert_array_equal(own, np.delete(whole, 5))
    # Rows are counted as the file has them.
    change_table(table, lambda c: c["time_ns"].__setitem__(8, c["time_ns"][6]))
    with pytest.raises(InputError, match=r"row 8 .*before the row above"):
        read_log(tmp_path / "log")


@pytest.mark.parametrize("stream", ["imu", "magnetometer", "truth"])
def test_rows_of_a_log_that_were_written_twice_are_counted(tmp_path: Path, stream: str) -> None:
    write_log(example_log(), tmp_path / "log")
    before = read_log(tmp_path / "log")
    path = tmp_path / "log" / f"{stream}.parquet"
    table = pyarrow.parquet.read_table(path)
    pyarrow.parquet.write_table(table.take(np.repeat(np.arange(len(table)), 2)), path)
    log = read_log(tmp_path / "log")
    (finding,) = log.findings
    assert finding.code == "repeated_stamps"
    assert f": {len(table)} samples are exact copies of others" in finding.text
    assert before.truth is not None
    assert log.truth is not None
    np.testing.assert_array_equal(log.imu.time, before.imu.time)
    np.testing.assert_array_equal(log.truth.time, before.truth.time)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e150])
@pytest.mark.parametrize(("stream", "name"), [("imu", "gyro_z"), ("magnetometer", "field_x")])
def test_an_infinite_sample_of_a_log_is_a_missing_one(
    tmp_path: Path, stream: str, name: str, value: float
) -> None:
    write_log(example_log(), tmp_path / "log")
    path = tmp_path / "log" / f"{stream}.parquet"
    change_table(path, lambda columns: columns[name].__setitem__(3, value))
    (finding,) = read_log(tmp_path / "log").findings
    assert (finding.code, "1 samples are NaN" in finding.text) == ("missing_samples", True)


def test_a_clock_that_jumped_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    def late(k: int) -> Any:
        message = imu_message(k)
        message.header = header(int(STAMPS[k]) + (DAY * 10**9 if k >= N // 2 else 0))
        return message

    bag = write_bag(tmp_path / "run", TOPICS | {"/imu": (IMU, late)})
    sentence = f"stamped {STAMPS[N // 2] + DAY * 10**9} ns is more than an hour after"
    assert sentence in refuse("check", bag)
    assert "86400 s after the row above" in refuse("import", bag, "-o", tmp_path / "log")
    assert len(open_log(bag, 0.0, 1.0).imu) == N // 2


@pytest.mark.parametrize("back_ms", [20.0, 20.3, 50.0, 81.7])
@pytest.mark.parametrize("topic", list(TOPICS))
def test_a_clock_that_was_set_back_is_refused(
    tmp_path: Path, refuse: Refuse, topic: str, back_ms: float
) -> None:
    msgtype, make = TOPICS[topic]
    back = round(back_ms * 1e6)

    def set_back(k: int) -> Any:
        message = make(k)
        message.header = header(int(STAMPS[k]) - (back if k >= N // 2 else 0))
        return message

    bag = write_bag(tmp_path / "run", TOPICS | {topic: (msgtype, set_back)})
    refused = refuse("check", bag)
    assert f"the clock was set back by {back_ms / 1e3:g} s at message {N // 2}" in refused
    assert f"stamped {STAMPS[N // 2] - back} ns; use one side by --end" in refused
    assert f"row {N // 2} of the data" in refuse("import", bag, "-o", tmp_path / "log")
    assert open_log(bag, 0.0, 0.1 - back_ms / 1e3).truth is not None
    assert open_log(bag, 0.096, 1.0).waveform is not None


def test_a_log_of_a_clock_that_was_set_back_is_refused_by_its_place(tmp_path: Path) -> None:
    log = example_log()
    stamps = log.epoch_ns + 5_000_000 * np.arange(len(log.imu))

    def set_back(columns: dict[str, Any]) -> None:
        columns["time_ns"] = np.where(np.arange(len(stamps)) < 200, stamps, stamps - 50_000_000)

    write_log(log, tmp_path / "log")
    change_table(tmp_path / "log" / "imu.parquet", set_back)
    with pytest.raises(InputError, match=r"imu\.parquet: .*row 200 .*was set back by 0\.05 s"):
        read_log(tmp_path / "log")


def test_a_step_back_is_distinguished_from_late_rows() -> None:
    rng = np.random.default_rng(2)
    step = 5_000_000
    stamps = step * np.arange(4000)
    values = rng.standard_normal((4000, 3))
    jitter = rng.integers(-step // 5, step // 5, 4000)
    bursts = np.repeat(10 * step * np.arange(1, 401), 10) + 200_000 * (np.arange(4000) % 10)
    for even, sizes in ((stamps, (4, 20, 190)), (stamps + jitter, (5, 190)), (bursts, (40, 190))):
        for size in sizes:
            back = even.copy()
            back[2000:] -= size * step
            step_back = clock_set_back(back, values)
            assert step_back is not None
            assert step_back.row == 2000
        block = np.r_[0:1000, 1050:1100, 1000:1050, 1100:4000]
        assert clock_set_back(np.sort(even)[block], values[block]) is None
    late = np.argsort(np.arange(4000) + rng.uniform(0.0, 30.0, 4000))  # by the network
    assert clock_set_back(np.sort(stamps + jitter)[late], values[late]) is None
    twice = np.r_[0:2000, 1900:4000]  # files that overlap, one after the other
    assert clock_set_back(stamps[twice], values[twice]) is None


@pytest.mark.parametrize("topic", list(TOPICS))
@pytest.mark.parametrize(("row", "shift_s"), [(20, 60), (20, -0.09), (0, -30), (N - 1, 100)])
def test_a_single_stamp_seconds_away_is_left_out(
    tmp_path: Path, topic: str, row: int, shift_s: float
) -> None:
    msgtype, make = TOPICS[topic]

    def shifted(k: int) -> Any:
        message = make(k)
        message.header = header(int(STAMPS[k]) + round(shift_s * 1e9) * (k == row))
        return message

    bag = write_bag(tmp_path / "run", TOPICS | {topic: (msgtype, shifted)})
    by_import, figures = imported(tmp_path / "log", bag)
    assert figures[f"{ROLES[topic].lower()}_dropped_with_a_stray_time"] == 1
    log = open_log(bag)
    assert [finding.code for finding in log.findings] == ["stray_stamps"]
    for one in (log, by_import):
        assert one.waveform is not None
        assert one.truth is not None
        assert one.epoch_ns == STAMPS[0]
        counts = {"/imu": len(one.imu), "/mag": len(one.waveform), "/pose": len(one.truth)}
        assert counts == dict.fromkeys(TOPICS, N) | {topic: N - 1}


@pytest.mark.parametrize("stamp", [0, int(STAMPS[3])])
def test_messages_without_stamps_have_their_times_of_arrival(tmp_path: Path, stamp: int) -> None:
    def unstamped(make: Make) -> Make:
        def message(k: int) -> Any:
            built = make(k)
            built.header = header(stamp)
            return built

        return message

    topics = {name: (kind, unstamped(make)) for name, (kind, make) in TOPICS.items()}
    bag = write_bag(tmp_path / "run", topics)
    by_import, figures = imported(tmp_path / "log", bag)
    assert any(f"imu: all messages have the stamp {stamp} ns" in note for note in figures["notes"])
    log = open_log(bag)
    assert [finding.code for finding in log.findings] == ["repeated_stamps"] * 3
    for one in (log, by_import):
        assert one.epoch_ns == 10**9
        np.testing.assert_allclose(one.imu.time, 5e-3 * np.arange(N), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(one.imu.gyro_body, GYRO)
    by_rate, _ = imported(tmp_path / "rate", bag, rate_hz=("imu=100",))
    np.testing.assert_allclose(by_rate.imu.time, 1e-2 * np.arange(N), rtol=0, atol=1e-9)


def test_a_late_row_is_put_in_order_and_a_misplaced_one_is_not() -> None:
    stamps = 5_000_000 * np.arange(1000)
    late = np.r_[0:400, 401:450, 400, 450:1000]
    assert not misplaced_rows(stamps[late]).any()
    assert not misplaced_rows(np.r_[stamps[1:20], stamps[:1], stamps[20:]]).any()
    for row, steps in ((400, 11.3), (400, -300), (1, 2000), (998, -900), (0, 500), (999, -500)):
        wrong = stamps.copy()
        wrong[row] += round(steps * 5_000_000)
        assert np.flatnonzero(misplaced_rows(wrong)).tolist() == [row]
    pause = np.r_[stamps[:500], stamps[500:] + 5_000_000_000]
    assert not misplaced_rows(pause).any()


def test_few_rows_are_strays_and_more_are_a_part_of_the_recording() -> None:
    hour = 3_600_000_000_000
    stamps = 5_000_000 * np.arange(2000)
    for count, shift, expected in ((1, 2, 1), (20, 2, 20), (21, 2, 0), (20, -30_000, 20)):
        far = stamps.copy()
        far[100 : 100 + count] += shift * hour
        stray = stray_rows(far)
        np.testing.assert_array_equal(np.flatnonzero(stray), 100 + np.arange(expected))
    assert not stray_rows(stamps * 1_000_000).any()  # each row is an hour and more after the last
    assert not stray_rows(np.array([0, 2 * hour])).any()
    # A part of a table is compared with what was read before it.
    later = stamps[:3] + 2 * hour
    assert stray_rows(later, 2000, int(stamps[-1])).all()
    assert not stray_rows(later, 200, int(stamps[-1])).any()
    assert not stray_rows(stamps[:3], 2000, int(stamps[-1])).any()
    assert stray_rows(np.append(stamps, 1 << 62))[-1]


def test_the_shared_bag_with_one_stamp_in_the_future_is_checked(tmp_path: Path) -> None:
    bag = recording("one_stamp_in_the_future")
    figures = run_check(CheckSettings(log=bag))
    assert figures["magnetometer_duration_s"] == pytest.approx(5.9975, abs=1e-6)
    imported(tmp_path / "log", bag)
    table = pyarrow.parquet.read_table(tmp_path / "log" / "magnetometer.parquet")
    assert len(table) == 2399


def test_the_first_sample_of_bursts_is_the_epoch_of_an_import(tmp_path: Path) -> None:
    step = 5_000_000
    burst = np.arange(1200) // 10
    stamps = 10 * step * (burst + 1) + 200_000 * (np.arange(1200) % 10)
    for times, before_ms in ((stamps, 43.2), (step * np.arange(1200), 0.0)):
        pyarrow.parquet.write_table(pyarrow.table({"time_ns": times}), tmp_path / "imu.parquet")
        counts = Counts(first=int(times[0]))
        _count_burst(tmp_path / "imu.parquet", counts)
        assert 1e-6 * counts.before_ns == pytest.approx(before_ms, abs=0.1)
        assert first_stamp_of({"imu": counts}) == times[0] - counts.before_ns
