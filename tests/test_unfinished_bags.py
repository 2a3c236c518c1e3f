"""Bags that a recorder did not finish are read as far as they are whole."""

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse
from example_bag import FIELD, GYRO, MEASURED, SENSORS, N, field_message, write_bag, write_ros1_bag
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from test_bag_files import assert_samples, imported

from magfusion.files.bag_reader import open_bag
from magfusion.files.bag_topics import is_bag
from magfusion.files.open import open_log
from magfusion.results.figures import Figures


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check of imported logs, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def _logged(bag: Path) -> Path:
    """Move the second half of a bag's messages to the log of its database, as it is in a crash."""
    database = bag / f"{bag.name}.db3"
    crashed = bag.with_name("crashed")
    with sqlite3.connect(database) as db:
        rows = db.execute("SELECT * FROM messages ORDER BY id").fetchall()
        insert = f"INSERT INTO messages VALUES ({','.join('?' * len(rows[0]))})"
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("DELETE FROM messages WHERE id > ?", (rows[len(rows) // 2][0],))
        db.commit()
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.executemany(insert, rows[len(rows) // 2 + 1 :])
        db.commit()
        shutil.copytree(bag, crashed)
    db.close()
    return crashed


@pytest.mark.parametrize("metadata", [True, False])
def test_messages_in_the_log_of_a_database_are_read(tmp_path: Path, metadata: bool) -> None:
    bag = _logged(write_bag(tmp_path / "run", SENSORS, StoragePlugin.SQLITE3))
    names = {path.name for path in bag.iterdir()}
    assert "run.db3-wal" in names
    if not metadata:
        (bag / "metadata.yaml").unlink()
    for path in (bag, bag / "run.db3"):
        log = open_log(path)
        assert_samples(log)
        assert not log.findings
    assert_samples(imported(tmp_path / "log", bag)[0])
    assert {path.name for path in bag.iterdir()} | {"metadata.yaml"} == names


def _finished(folder: Path, kind: str) -> Path:
    """Return the file of a bag: MCAP, plain or compressed, or ROS 1."""
    folder.mkdir()
    if kind == "bag":
        return write_ros1_bag(folder / "run.bag", SENSORS)
    mode = CompressionMode.STORAGE if kind == "zstd" else None
    bag = write_bag(folder / "bag", SENSORS, compression=mode)
    return (bag / "bag.mcap").rename(folder / "run.mcap")


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_a_bag_that_is_cut_is_read_up_to_there(tmp_path: Path, kind: str) -> None:
    path = _finished(tmp_path / "cut", kind)
    # Of the second topic, which follows the first in these files, about the half.
    content = path.read_bytes()
    middle = content.index(MEASURED[N // 2].tobytes())
    path.write_bytes(content[:middle])
    log = open_log(path)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
    assert log.waveform is not None
    np.testing.assert_array_equal(log.waveform.measured_sensor, MEASURED[: N // 2])
    (finding,) = log.findings
    assert finding.code == "bag_unfinished"
    assert f"{N + N // 2} messages in 0.195 s are whole" in finding.text
    by_import, figures = imported(tmp_path / "log", path)
    assert len(by_import.imu) == N
    assert finding.text in figures["notes"]


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("damage", ["cut", "zeros"])
def test_rows_of_a_damaged_database_are_read(tmp_path: Path, damage: str, metadata: bool) -> None:
    """As ``.recover`` of SQLite does: pages that are cut or overwritten lose their own rows."""
    bag = write_bag(tmp_path / "run", SENSORS, StoragePlugin.SQLITE3)
    path = bag / "run.db3"
    content = path.read_bytes()
    at = content.index(MEASURED[N // 2].tobytes())
    page = at // 4096 * 4096
    overwritten = content[:page] + bytes(4096) + content[page + 4096 :]
    path.write_bytes(overwritten if damage == "zeros" else content[:at])
    if not metadata:
        (bag / "metadata.yaml").unlink()
    log = open_log(bag)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
    assert log.waveform is not None
    measured = log.waveform.measured_sensor
    assert all((row == MEASURED).all(axis=1).any() for row in measured)
    assert N // 2 - 12 <= len(measured) < N  # twelve messages a page
    (finding,) = log.findings
    assert finding.code == "bag_damaged"
    assert f"{N + len(measured)} messages in " in finding.text
    by_import, figures = imported(tmp_path / "log", bag)
    assert len(by_import.imu) == N
    assert finding.text in figures["notes"]


@pytest.mark.parametrize("kind", ["mcap", "zstd", "bag"])
def test_a_bag_without_its_end_is_read_whole(tmp_path: Path, kind: str) -> None:
    path = _finished(tmp_path / "cut", kind)
    for lost in (5, 200):  # bytes of the index
        path.write_bytes(path.read_bytes()[:-lost])
        log = open_log(path)
        assert_samples(log)
        assert [finding.code for finding in log.findings] == ["bag_unfinished"]


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_zeros_behind_what_was_written_are_no_messages(tmp_path: Path, kind: str) -> None:
    path = _finished(tmp_path / "cut", kind)
    content = path.read_bytes()
    end = content.index(MEASURED[N // 2].tobytes())
    path.write_bytes(content[:end] + bytes(len(content) - end) + bytes(100_000))
    log = open_log(path)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
    assert log.waveform is not None
    np.testing.assert_array_equal(log.waveform.measured_sensor[: N // 2], MEASURED[: N // 2])
    assert [finding.code for finding in log.findings] == ["bag_unfinished"]


def test_messages_lost_to_damage_are_counted(tmp_path: Path) -> None:
    """The index is whole, and a record of a length that is none hides what follows it."""
    path = _finished(tmp_path / "damaged", "mcap")
    content = bytearray(path.read_bytes())
    at = content.index(MEASURED[N // 2].tobytes())
    content[at : at + 300] = bytes([34]) * 300  # a length below 2**63
    path.write_bytes(content)
    log = open_log(path)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO)
    (finding,) = log.findings
    assert finding.code == "bag_damaged"
    assert f"{N // 2 + 1} of {N} messages of /imu/mag are read" in finding.text
    assert str(path) in finding.text
    by_import, figures = imported(tmp_path / "log", path)
    assert len(by_import.imu) == N
    assert figures["notes"] == [finding.text]


def test_of_a_compressed_chunk_that_is_cut_the_beginning_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)

    def noisy(k: int) -> Any:
        message = field_message(k)
        message.magnetic_field_covariance = rng.normal(size=9)
        return message

    many = np.tile(np.arange(N), 100)  # enough for several blocks of the compression
    topics = {"/mag": (FIELD, noisy)}
    bag = write_bag(tmp_path / "run", topics, compression=CompressionMode.STORAGE, arrival=many)
    path = bag / "run.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with open_bag([bag]) as reader:
        messages = [raw for _, _, raw in reader.messages()]
        (note,) = reader.notes
    assert 0.3 * len(many) < len(messages) < 0.9 * len(many)
    assert f"{len(messages)} messages" in note


def test_a_bag_of_ros_1_that_was_being_recorded_is_read(tmp_path: Path) -> None:
    path = _finished(tmp_path / "run", "bag")
    content = bytearray(path.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    active = path.rename(path.with_name("run.bag.active"))
    active.write_bytes(content)
    assert is_bag(active)
    for place in (active, active.parent):
        assert_samples(open_log(place))
    assert_samples(imported(tmp_path / "log", active)[0])


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_a_bag_without_a_whole_message_is_refused(
    tmp_path: Path, kind: str, refuse: Refuse
) -> None:
    path = _finished(tmp_path / "cut", kind)
    content = path.read_bytes()
    for size in (0, 10, 30, 100, 101):
        path.write_bytes(content[:size] + bytes([255]) * (12 if size == 101 else 0))
        sentence = refuse("check", path)
        assert "cannot be read" in sentence or "has no messages of" in sentence
        refuse("import", path, "-o", tmp_path / "log")
