"""TUM files are those that evo reads, and no digit of time or pose is lost on the way."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from example_log import EPOCH_NS, example_trajectory
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.tum import read_tum, write_tum
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding

GOOD = "0.0 1 2 3 0 0 0 1"


def _trajectory() -> Trajectory:
    time = np.array([0, 1_000_000, 2_000_003, 4_000_000_000]) * 1e-9
    return example_trajectory(np.random.default_rng(1), time)


def test_evo_reads_what_was_written(tmp_path: Path) -> None:
    trajectory = _trajectory()
    write_tum(trajectory, tmp_path / "t.tum", EPOCH_NS)
    result = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    assert result.check()[0]
    late = result.timestamps - EPOCH_NS * 1e-9
    np.testing.assert_allclose(late, trajectory.time, rtol=0, atol=1e-6)  # s, a double's of today
    np.testing.assert_allclose(result.positions_xyz, trajectory.position_world, rtol=0, atol=1e-9)
    matrices = np.array(result.poses_se3)[:, :3, :3]
    np.testing.assert_allclose(matrices, trajectory.world_from_body, rtol=0, atol=1e-8)  # rad


def test_evo_s_files_are_read(tmp_path: Path) -> None:
    trajectory = _trajectory()
    write_tum(trajectory, tmp_path / "ours.tum", 0)
    others = file_interface.read_tum_trajectory_file(str(tmp_path / "ours.tum"))
    file_interface.write_tum_trajectory_file(str(tmp_path / "theirs.tum"), others)
    result = read_tum(tmp_path / "theirs.tum")
    np.testing.assert_allclose(result.time, trajectory.time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.world_from_body, trajectory.world_from_body, atol=1e-8)


def test_lines_that_were_written_twice_are_counted(tmp_path: Path) -> None:
    trajectory, findings = _trajectory(), list[Finding]()
    write_tum(trajectory, path := tmp_path / "t.tum", 0)
    path.write_text("".join(2 * line for line in path.read_text().splitlines(keepends=True)))
    result = read_tum(path, 0, findings)
    np.testing.assert_allclose(result.time, trajectory.time, rtol=0, atol=1e-9)
    (finding,) = findings
    assert finding.text == f"{path}: 4 samples are exact copies of others. They are left out."
    with pytest.raises(InputError, match="increasing times"):
        read_tum(path)


def test_nanoseconds_of_today_survive(tmp_path: Path) -> None:
    trajectory = _trajectory()
    write_tum(trajectory, tmp_path / "t.tum", EPOCH_NS)
    lines = (tmp_path / "t.tum").read_text().splitlines()
    assert lines[0] == "# time_s x y z qx qy qz qw"
    stamps = [int(line.split()[0].replace(".", "")) - EPOCH_NS for line in lines[1:]]
    assert stamps == [0, 1_000_000, 2_000_003, 4_000_000_000]
    result = read_tum(tmp_path / "t.tum", EPOCH_NS)
    np.testing.assert_allclose(result.time, trajectory.time, rtol=0, atol=1e-15)  # s
    np.testing.assert_allclose(result.position_world, trajectory.position_world, atol=1e-9)
    turn = Rotation.from_matrix(
        result.world_from_body.transpose(0, 2, 1) @ trajectory.world_from_body
    )
    np.testing.assert_allclose(turn.magnitude(), 0.0, atol=1e-8)  # rad


def test_times_before_the_epoch_keep_their_sign(tmp_path: Path) -> None:
    trajectory = Trajectory(
        np.array([-1.5, -0.25]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    )
    write_tum(trajectory, tmp_path / "t.tum", 0)
    np.testing.assert_array_equal(read_tum(tmp_path / "t.tum").time, [-1.5, -0.25])


def test_comments_and_empty_lines_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text(f"# comment\n\n  {GOOD}  \n\t1e0 1 2 3 0 0 1 0\n")
    result = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(result.time, [0.0, 1.0])
    np.testing.assert_allclose(result.world_from_body[1], np.diag([-1.0, -1.0, 1.0]), atol=1e-15)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        (f"{GOOD}\n1.0 1 2 3 0 0 0\n", "line 2: found '1.0 1 2 3 0 0 0'; write eight"),
        (f"#\n{GOOD} 9\n", "line 2: .*eight numbers"),
        (GOOD.replace(" ", ","), "line 1: .*eight numbers"),
        (GOOD.replace("3", "three"), "line 1: .*eight numbers"),
        (GOOD.replace("3", "nan"), "line 1: found .*; write a pose"),
        (GOOD.replace("0.0", "inf"), "line 1: .*eight numbers"),
        (GOOD.replace("0.0", "1e30"), "line 1: found time 1e30; write seconds"),
        (f"{GOOD}\n{GOOD}\n", "line 2: found time 0.0; write increasing times"),
        (f"1.0{GOOD[3:]}\n# back\n{GOOD}\n", "line 3: found time 0.0"),
        (f"{GOOD}\n1.0 1 2 3 0 0 0 1.01\n", "line 2: found a quaternion of length 1.01"),
        ("0.0 1 2 3 0 0 0 0", "line 1: found .*; write a pose"),
    ],
)
def test_a_bad_file_is_refused_by_its_line(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(InputError, match=rf"t\.tum: .*{sentence}|t\.tum: {sentence}") as caught:
        read_tum(tmp_path / "t.tum")
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("lost", ["nan nan nan nan nan nan nan", "0 0 0 0 0 0 0"])
def test_lines_without_a_pose_are_left_out_and_counted(tmp_path: Path, lost: str) -> None:
    lines = [f"{k} {lost if k == 3 else GOOD[4:]}" for k in range(12)]
    (tmp_path / "t.tum").write_text("\n".join(lines))
    findings: list[Finding] = []
    result = read_tum(tmp_path / "t.tum", findings=findings)
    np.testing.assert_array_equal(result.time, np.delete(np.arange(12.0), 3))
    assert findings[0].text.startswith("t.tum: left out 1 of 12 rows: 1 with")


@pytest.mark.parametrize(("unit", "zeros"), [("ms", 3), ("us", 6), ("ns", 9)])
def test_dates_in_smaller_units_are_read_and_reported(
    tmp_path: Path, unit: str, zeros: int
) -> None:
    lines = [f"{(1_700_000_000 + k) * 10**zeros} {GOOD[4:]}" for k in range(3)]
    (tmp_path / "t.tum").write_text("\n".join(lines))
    findings: list[Finding] = []
    result = read_tum(tmp_path / "t.tum", 1_700_000_000 * 10**9, findings)
    np.testing.assert_array_equal(result.time, [0.0, 1.0, 2.0])
    assert f"t.tum: its times are read as {unit}" in findings[0].text


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"t\.tum: cannot be read as text"):
        read_tum(tmp_path / "t.tum")
    with pytest.raises(InputError, match="nowhere: there is no such file"):
        read_tum(tmp_path / "nowhere")
