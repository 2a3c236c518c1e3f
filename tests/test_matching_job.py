"""The commands that match attitudes: their files, their figures, and what they refuse."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import yaml
from conftest import Refuse, change_table, run_command
from scipy.spatial.transform import Rotation

from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site

RATE = 200.0  # Hz
YAW = 1.0  # rad
TONE = 2e-6  # T, of a beacon near by
NOISE = 2.5e-9  # T, of a sample, as the site declares


def write_turning(
    path: Path, seed: int, pitch: np.ndarray, yaw_rate: float = 0.0, roll_rate: float = 0.8
) -> Path:
    """Write the log of a body that rolls at the pitch given (rad), beside a beacon."""
    rng = np.random.default_rng(seed)
    site = demo_site()
    time = np.arange(len(pitch)) / RATE
    angles = [roll_rate * time + rng.uniform(0.0, 6.0), pitch, YAW + yaw_rate * time]
    turn = Rotation.from_euler("xyz", np.stack(angles, axis=1))
    rate = RATE * (turn[:-1].inv() * turn[1:]).as_rotvec()
    sensor = site.platform.magnetometer
    assert site.earth_field_world is not None
    tone = TONE * np.cos(2.0 * np.pi * 20.0 * time)
    field_body = turn.apply(site.earth_field_world + tone[:, None] * [1.0, 0.5, -0.3], inverse=True)
    measured = field_body @ sensor.body_from_sensor @ sensor.matrix.T + sensor.offset
    measured += rng.normal(0.0, NOISE, measured.shape)
    force = turn.apply([0.0, 0.0, site.gravity], inverse=True)
    model, root = site.platform.imu, np.sqrt(RATE)
    rate = np.concatenate([rate, rate[-1:]]) + rng.normal(0.0, model.gyro_noise * root, force.shape)
    imu = ImuSamples(time, rate, force + rng.normal(0.0, model.accel_noise * root, force.shape))
    truth = Trajectory(time, turn.as_matrix(), np.zeros((len(time), 3)))
    write_log(Log("turning", 0, "test", imu, Waveform(time, measured), None, truth), path)
    save_site(site, path / "site.yaml")
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("turning")
    short, long = np.arange(20.0 * RATE) / RATE, np.arange(240.0 * RATE) / RATE
    write_turning(root / "turn", 1, np.full_like(short, 0.1))
    write_turning(root / "turn_again", 2, np.full_like(short, 0.1))
    write_turning(root / "nod", 3, 0.35 * np.sin(0.23 * long))
    write_turning(root / "nod_again", 4, 0.33 * np.sin(0.3 * short))
    write_turning(root / "wander", 5, 0.3 * np.sin(0.3 * short), yaw_rate=0.3)
    tilted = np.where(short < 10.0, 0.3, -0.4)  # turned at once between two rests
    write_turning(root / "rests", 7, tilted, roll_rate=0.0)
    write_turning(root / "dive", 6, np.linspace(0.6, 1.3, len(short)))
    run_command("calibrate", "attitude-database", root / "turn", "-o", root / "turn_table",
                "--step", 0.1)  # fmt: skip
    run_command("calibrate", "attitude-database", root / "nod", "-o", root / "nod_table",
                "--step", 0.1, "--step-deg", 4)  # fmt: skip
    return root


def report(path: Path) -> dict[str, Any]:
    reported: dict[str, Any] = json.loads((path / "report.json").read_text())
    return reported


@pytest.mark.slow
def test_the_database_has_table_picture_and_report(logs: Path) -> None:
    result = logs / "nod_table"
    names = {"attitudes.parquet", "attitudes.png", "report.html", "report.json"}
    assert {path.name for path in result.iterdir()} == names
    assert (result / "attitudes.png").read_bytes().startswith(b"\x89PNG")
    reported = report(result)
    assert reported["angles"] == "roll-pitch"
    assert 12 <= reported["entries"] < reported["measurements"]
    assert reported["held_yaw_deg"] == pytest.approx(np.rad2deg(YAW), abs=1e-6)
    # Averaging over four degrees shortens 50 microtesla by ten nanotesla.
    assert reported["unexplained_by_a_uniform_field_t"] < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(("method", "limit"), [("nearest", 2.0), ("interpolated", 0.3)])
def test_roll_and_pitch_are_found_in_the_database_of_another_log(
    logs: Path, tmp_path: Path, method: str, limit: float
) -> None:
    for _ in range(2):  # an earlier result is replaced
        run_command("match", logs / "nod_again", "--database", logs / "nod_table",
                    "--method", method, "-o", tmp_path / "out")  # fmt: skip
    names = {"attitude.parquet", "attitude.png", "report.html", "report.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    reported = report(tmp_path / "out")
    assert reported["roll_rms_deg"] < limit
    assert reported["pitch_rms_deg"] < limit
    # Each claims as much as it errs.
    assert 0.4 < reported["pitch_rms_deg"] / reported["pitch_sigma_median_deg"] < 2.5
    table = pyarrow.parquet.read_table(tmp_path / "out" / "attitude.parquet").to_pydict()
    assert len(table["time_ns"]) == reported["epochs"]
    assert set(table["yaw_sigma_deg"]) == {0.0}


@pytest.mark.slow
def test_roll_is_found_by_its_database_and_in_closed_form(logs: Path, tmp_path: Path) -> None:
    run_command("match", logs / "turn_again", "--database", logs / "turn_table" /
                "attitudes.parquet", "-o", tmp_path / "table")  # fmt: skip
    given = ("--yaw-deg", np.rad2deg(YAW), "--pitch-deg", np.rad2deg(0.1))
    run_command("match", logs / "turn_again", *given, "-o", tmp_path / "model")
    run_command("match", logs / "turn_again", *given, "--raw", "-o", tmp_path / "raw")
    errors = [report(tmp_path / name)["roll_rms_deg"] for name in ("table", "model", "raw")]
    assert max(errors[:2]) < 0.05
    # Sample by sample the beacon's tone is there in full: 2 microtesla in 40.
    assert errors[2] > 20.0 * errors[1]
    assert report(tmp_path / "raw")["epochs"] == 20.0 * RATE


def test_roll_is_found_at_twenty_turns_a_second_with_the_gyroscope_clipped(tmp_path: Path) -> None:
    """The "large dynamic" of paper 001: each sample alone, and no beacon near."""
    rng, site = np.random.default_rng(8), demo_site()
    time = np.arange(2.0 * RATE) / RATE
    turn = Rotation.from_euler("x", 2.0 * np.pi * 20.0 * time[:, None])
    sensor = site.platform.magnetometer
    assert site.earth_field_world is not None
    field_body = turn.apply(np.tile(site.earth_field_world, (len(time), 1)), inverse=True)
    measured = field_body @ sensor.body_from_sensor @ sensor.matrix.T + sensor.offset
    measured += rng.normal(0.0, NOISE, measured.shape)
    clipped = np.deg2rad(2000.0) * np.tile([1.0, 0.0, 0.0], (len(time), 1))
    force = turn.apply([0.0, 0.0, site.gravity], inverse=True)
    truth = Trajectory(time, turn.as_matrix(), np.zeros((len(time), 3)))
    imu = ImuSamples(time, clipped, force)
    log = Log("spinning", 0, "test", imu, Waveform(time, measured), None, truth)
    write_log(log, tmp_path / "spin")
    save_site(site, tmp_path / "spin" / "site.yaml")
    given = ("--yaw-deg", 0.0, "--pitch-deg", 0.0, "--raw")
    run_command("match", tmp_path / "spin", *given, "-o", tmp_path / "out")
    reported = report(tmp_path / "out")
    assert reported["epochs"] == len(time)
    assert reported["roll_rms_deg"] == pytest.approx(0.003, abs=0.001)


@pytest.mark.slow
def test_gravity_adds_the_third_angle(logs: Path, tmp_path: Path) -> None:
    run_command("match", logs / "rests", "--gravity", "-o", tmp_path / "out")
    reported = report(tmp_path / "out")
    assert reported["angles"] == "roll-pitch-yaw"
    assert reported["attitude_rmse_deg"] < 0.1
    assert 0 < reported["epochs_not_determined"] < 0.2 * reported["epochs"]
    assert reported["reasons"][0]["code"] == "geometry"


def test_gravity_is_not_believed_in_motion(logs: Path, tmp_path: Path) -> None:
    run_command("match", logs / "wander", "--gravity", "-o", tmp_path / "out")
    reported = report(tmp_path / "out")
    assert reported["epochs_not_determined"] == reported["epochs"]
    assert reported["verdict"] == "doubtful"
    assert "not_compared" in reported


def test_both_pitches_are_written_where_there_are_two(logs: Path, tmp_path: Path) -> None:
    run_command("match", logs / "dive", "--yaw-deg", np.rad2deg(YAW), "-o", tmp_path / "out")
    reported = report(tmp_path / "out")
    assert reported["epochs_with_two_pitches"] > 0
    assert reported["max_of_nearer_solution_deg"] < 1.0 < reported["pitch_max_deg"]
    table = pyarrow.parquet.read_table(tmp_path / "out" / "attitude.parquet").to_pydict()
    assert table["hypothesis"].count(1) == reported["epochs_with_two_pitches"]


def test_a_platform_whose_yaw_wanders_makes_no_database(logs: Path, refuse: Refuse) -> None:
    reported = refuse("calibrate", "attitude-database", logs / "wander", "-o", logs / "none")
    assert "yaw rotates by" in reported
    assert "gravity" in reported


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ((), "give the yaw"),
        (("--angles", "roll-pitch-yaw"), "two of three angles"),
        (("--angles", "roll-pitch-yaw", "--database", "nod_table"), "two of three angles"),
        (("--angles", "roll", "--database", "nod_table"), "has roll-pitch"),
        (("--angles", "roll", "--yaw-deg", "3"), "requires --pitch-deg"),
        (("--yaw-deg", "nan"), "--yaw-deg"),
        (("--yaw-deg", "3", "--database", "nod_table"), "those of the database"),
        (("--yaw-deg", "3", "--method", "nearest"), "--database"),
        (("--gravity", "--yaw-deg", "3"), "all three"),
        (("--gravity", "--raw"), "--raw"),
        (("--yaw-deg", "3", "--step", "1e-5"), "--step"),
        (("--yaw-deg", "3", "--raw", "--step", "1"), "--raw uses every sample"),
        (("--database", "nod_again"), "attitudes.parquet"),
    ],
)
def test_what_cannot_be_told_is_refused(
    logs: Path, tmp_path: Path, refuse: Refuse, options: tuple[str, ...], reported: str
) -> None:
    known = [logs / o if (logs / o).is_dir() else o for o in options]
    assert reported in refuse("match", logs / "nod_again", *known, "-o", tmp_path / "out")


@pytest.mark.parametrize("place", [None, {"location": True}])
def test_the_earth_field_is_the_sites_or_that_of_its_place(
    logs: Path, tmp_path: Path, refuse: Refuse, place: object
) -> None:
    site = yaml.safe_load((logs / "nod_again" / "site.yaml").read_text())
    del site["world"]["earth_field_t"]
    arguments = ["match", logs / "nod_again", "--site", tmp_path / "site.yaml", "--yaw-deg", 3]
    if place is None:
        (tmp_path / "site.yaml").write_text(yaml.safe_dump(site))
        assert "gives no Earth field" in refuse(*arguments, "-o", tmp_path / "out")
        return
    where = {"latitude_deg": 41.8, "longitude_deg": 123.4, "height_m": 50.0, "date": "2013-07-01"}
    site["world"]["location"] = where
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(site))
    run_command(*arguments, "-o", tmp_path / "out")
    assert report(tmp_path / "out")["epochs"] > 0


@pytest.mark.parametrize("step_deg", ["0", "nan", "90"])
def test_a_cell_that_is_no_cell_is_refused(
    logs: Path, tmp_path: Path, refuse: Refuse, step_deg: str
) -> None:
    arguments = ("calibrate", "attitude-database", logs / "nod", "--step-deg", step_deg)
    assert "--step-deg" in refuse(*arguments, "-o", tmp_path / "out")


@pytest.mark.slow
def test_a_log_without_truth_needs_a_reference(logs: Path, tmp_path: Path, refuse: Refuse) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("log.yaml", "site.yaml", "imu.parquet", "magnetometer.parquet"):
        (bare / name).write_bytes((logs / "nod" / name).read_bytes())
    build = ("calibrate", "attitude-database", bare, "-o", tmp_path / "out")
    assert "--trajectory" in refuse(*build)
    run_command(*build, "--trajectory", logs / "nod" / "truth.parquet", "--step-deg", 4)
    assert report(tmp_path / "out")["angles"] == "roll-pitch"


def test_a_dead_magnetometer_is_refused(logs: Path, tmp_path: Path, refuse: Refuse) -> None:
    corrupted = shutil.copytree(logs / "turn", tmp_path / "dead")
    offset = demo_site().platform.magnetometer.offset
    change_table(
        corrupted / "magnetometer.parquet",
        lambda c: [
            c.update({f"field_{x}": [o] * len(c["time_ns"])})
            for x, o in zip("xyz", offset, strict=True)
        ],
    )
    reported = refuse("match", corrupted, "--yaw-deg", 3, "-o", tmp_path / "out")
    assert "the field is zero at" in reported
