"""The files of a bag: in a folder without metadata, and in several parts."""

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse
from example_bag import (
    ACCEL,
    FIELD,
    GYRO,
    MEASURED,
    POSE,
    SENSORS,
    STAMPS,
    STEP_NS,
    N,
    field_message,
    pose_message,
    write_bag,
    write_ros1_bag,
)
from rosbags.rosbag2 import StoragePlugin
from test_import_parts import imported

from magfusion.errors import InputError
from magfusion.files.open import open_log
from magfusion.model.samples import Log
from magfusion.results.figures import Figures

SHARED = Path(__file__).parents[1].parent / "shared"
HALF = N // 2


@pytest.fixture(autouse=True)
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check of imported logs, which has its own tests."""
    monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


def recording(name: str) -> Path:
    """Return one of the shared recordings."""
    path = SHARED / "recordings" / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def assert_samples(log: Log, samples: slice = slice(None)) -> None:
    """Compare with the samples that were written, to the nanosecond."""
    count = len(STAMPS[samples])
    for time in (log.imu.time, log.waveform.time if log.waveform else np.zeros(0)):
        np.testing.assert_allclose(time, 1e-9 * STEP_NS * np.arange(count), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(log.imu.gyro_body, GYRO[samples])
    np.testing.assert_array_equal(log.imu.accel_body, ACCEL[samples])
    assert log.waveform is not None
    np.testing.assert_array_equal(log.waveform.measured_sensor, MEASURED[samples])


def _parts(folder: Path, kind: str) -> list[Path]:
    """Return the files of a recording that was split in the middle."""
    folder.mkdir()
    parts = []
    for part, samples in enumerate((range(HALF), range(HALF, N))):
        path = folder / f"run_{part}.{kind}"
        if kind == "bag":
            write_ros1_bag(path, SENSORS, samples)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            # Connections are numbered in each file: here the other way round.
            topics = dict(list(SENSORS.items())[:: 1 if part else -1])
            whole = write_bag(folder / f"part{part}", topics, plugin, samples=samples)
            (whole / f"part{part}.{kind}").rename(path)
        parts.append(path)
    return parts


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_a_folder_without_metadata_is_read_as_the_file_in_it(tmp_path: Path, kind: str) -> None:
    (tmp_path / "run").mkdir()
    _parts(tmp_path / "parts", kind)[0].rename(tmp_path / "run" / f"r_0.{kind}")
    log = open_log(tmp_path / "run")
    assert log.name == "run"
    assert_samples(log, slice(HALF))
    assert_samples(imported(tmp_path / "log", tmp_path / "run")[0], slice(HALF))


def test_a_table_in_the_folder_of_a_bag_is_left_out_and_reported(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", SENSORS)
    (bag / "truth.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    _, figures = imported(tmp_path / "log", bag)
    assert any(re.search(r"Skipped: .*truth\.tum.*--truth", note) for note in figures["notes"])


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_bags_that_follow_each_other_are_one_recording(tmp_path: Path, kind: str) -> None:
    first, second = _parts(tmp_path / "run", kind)
    assert_samples(open_log(tmp_path / "run"))
    assert_samples(imported(tmp_path / "folder", tmp_path / "run")[0])
    assert_samples(imported(tmp_path / "log", second, first)[0])


def test_topics_of_bags_recorded_together_are_one_recording(tmp_path: Path) -> None:
    (imu, make), name = SENSORS["/imu/data"], "/imu/data"
    one = write_bag(tmp_path / "one", {name: (imu, make)})
    other = write_bag(tmp_path / "other", {"/mag": (FIELD, field_message)})
    poses = write_bag(tmp_path / "poses", {"/pose": (POSE, pose_message)})
    log, _ = imported(tmp_path / "log", one, other, poses)
    assert_samples(log)
    assert log.truth is not None
    assert len(log.truth) == N


def test_bags_of_the_same_time_or_of_two_kinds_are_refused(tmp_path: Path, refuse: Refuse) -> None:
    (folder := tmp_path / "copies").mkdir()
    for name in ("a", "b"):
        write_bag(tmp_path / name, SENSORS)
        (tmp_path / name / f"{name}.mcap").rename(folder / f"{name}.mcap")
    with pytest.raises(InputError, match=r"a\.mcap and .*b\.mcap both hold /imu/data at the same"):
        open_log(folder)
    assert "both hold /imu/data at the same" in refuse("import", folder, "-o", tmp_path / "log")
    write_ros1_bag(folder / "c.bag", SENSORS)
    with pytest.raises(InputError, match=r"of ROS 1 and of ROS 2 \(a\.mcap, b\.mcap, c\.bag\)"):
        open_log(folder)


def test_messages_that_two_bags_share_are_counted_once(tmp_path: Path, refuse: Refuse) -> None:
    (folder := tmp_path / "run").mkdir()
    write_ros1_bag(folder / "r_0.bag", SENSORS, range(30))
    write_ros1_bag(folder / "r_1.bag", SENSORS, range(20, N))
    log = open_log(folder)
    assert_samples(log)
    texts = [finding.text for finding in log.findings]
    expected = "{}: 10 samples are exact copies of others. They are left out."
    assert texts == [expected.format(name) for name in ("IMU", "magnetometer")]
    by_import, figures = imported(tmp_path / "log", folder)
    assert_samples(by_import)
    assert figures["imu_dropped_that_are_copies_of_others"] == 10
    others = {
        name: (kind, lambda k, m=make: m((k + 7) % N)) for name, (kind, make) in SENSORS.items()
    }
    (folder / "r_1.bag").unlink()
    write_ros1_bag(folder / "r_1.bag", others, range(20, N))
    sentence = r"r_0\.bag and .*r_1\.bag both hold /imu/data at the same time, from \d+ to \d+ ns"
    assert re.search(sentence, refuse("check", folder))
    assert re.search(sentence, refuse("import", folder, "-o", tmp_path / "log"))


def test_a_folder_of_folders_of_bags_is_refused_by_how_to_give_them(
    tmp_path: Path, refuse: Refuse
) -> None:
    (folder := tmp_path / "runs").mkdir()
    parts = [
        write_bag(folder / f"run_{k}", SENSORS, samples=samples)
        for k, samples in enumerate((range(HALF), range(HALF, N)))
    ]
    sentence = f"holds 2 folders of bags; .*magfusion import {parts[0]} {parts[1]} -o LOG"
    assert re.search(sentence, refuse("check", folder))
    assert re.search(sentence, refuse("import", folder, "-o", tmp_path / "log"))


def test_shared_folders_without_metadata_and_in_two_parts(tmp_path: Path) -> None:
    for name in ("dir_without_metadata", "ros1_bag_in_two"):
        log, _ = imported(tmp_path / name, recording(name))
        assert len(log.imu) == 1200  # 6 s at 200 Hz
        assert log.imu.time[-1] == pytest.approx(5.995, abs=1e-9)  # s
        np.testing.assert_array_equal(log.imu.gyro_body, open_log(recording(name)).imu.gyro_body)
