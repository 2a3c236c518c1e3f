"""Twins of public recordings go in by one import with pasted proposals, and their figures are right."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import allantools
import numpy as np
import pytest
from import_twins import G, SITE, Motion, noisy, turning, write
from scipy.spatial.transform import Rotation

from magfusion.files.open import open_log
from magfusion.units import DEGREE, Array

IRON = np.array([22.0, -13.0, 9.0])  # uT
OFFSET_UT = 0.3


@pytest.fixture(autouse=True)
def _in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("site.yaml").write_text(SITE)


def command(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a command as a user does, as a process of its own."""
    line = [sys.executable, "-m", "magfusion", *words]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)


def import_log(*words: str, output: str = "log") -> str:
    """Import, if need be once more with the proposals of the first time; return what it printed."""
    ended = command("import", *words, "-o", output)
    if ended.returncode == 2:
        proposed = ended.stderr.partition("proposed by name")[2].replace("\\\n", "\n")
        pasted = [shlex.split(line) for line in proposed.splitlines()[1:]]
        again = [word for line in pasted for word in line]
        assert again, ended.stderr
        ended = command("import", *words, *again, "-o", output)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def figures(*words: str, output: str) -> dict[str, object]:
    ended = command(*words, "-o", output)
    assert ended.returncode == 0, ended.stderr
    report: dict[str, object] = json.loads(Path(output, "report.json").read_text())
    return report


def ellipsoid_centre(field: Array) -> Array:
    """Return the centre of the quadric nearest to points, shape (3,)."""
    x, y, z = (field - field.mean(axis=0)).T
    terms = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z])
    a = np.linalg.lstsq(terms, np.ones(len(x)), rcond=None)[0]
    shape = np.array([[a[0], a[3], a[4]], [a[3], a[1], a[5]], [a[4], a[5], a[2]]])
    return np.asarray(field.mean(axis=0) - np.linalg.solve(shape, a[6:]))


def assert_offset(field: Array) -> None:
    """Compare the calibrated offset of the imported log with that of an ellipsoid (uT)."""
    report = figures("calibrate", "magnetometer", "log", "--site", "site.yaml", output="out")
    offset = [report[f"magnetometer.offset_nt_{axis}"] for axis in "xyz"]
    print(report["verdict"], np.array(offset)*1e-3, ellipsoid_centre(field))
    np.testing.assert_allclose(np.array(offset) * 1e-3, ellipsoid_centre(field), atol=OFFSET_UT)


def measured(motion: Motion, seed: int, iron: Array = IRON, noise: float = 0.2) -> Array:
    """Return magnetometer samples (uT) with iron on the body."""
    soft = np.eye(3) + 0.03 * np.array([[0.5, 0.2, 0.0], [0.2, -0.4, 0.1], [0.0, 0.1, 0.3]])
    return noisy(motion.field @ soft.T + iron, noise, seed)


def inertial(motion: Motion, seed: int) -> tuple[Array, Array]:
    gyro = noisy(motion.gyro, 2e-3, seed) + [2e-3, -1e-3, 3e-3]
    return gyro, noisy(motion.accel, 0.02, seed + 1)


def axes(stem: str, unit: str = "", names: str = "XYZ") -> list[str]:
    return [f"{stem}{axis}{unit}" for axis in names]


def test_an_inertial_module_holds_a_slow_and_late_magnetometer() -> None:
    motion = turning(np.arange(9000) * 0.01, 1)
    gyro, accel = inertial(motion, 2)
    late = turning(motion.time - 0.055, 1)
    field = np.repeat(measured(late, 4)[::5], 5, axis=0)
    head = ["Time (s)", *axes("Gyroscope ", " (deg/s)"), *axes("Accelerometer ", " (g)")]
    head += axes("Magnetometer ", " (uT)")
    write(Path("module.csv"), [",".join(head)], motion.time, gyro / DEGREE, accel / G, field)
    import_log("module.csv")
    assert_offset(field)


@pytest.mark.parametrize("gyro_too", [True, False])
def test_a_telephone_writes_a_table_a_sensor(gyro_too: bool) -> None:
    motion = turning(np.arange(6000) * 0.01, 3)
    gyro, accel = inertial(motion, 4)
    field = measured(motion, 6)
    folder = Path("phone")
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "device.csv").write_text('"property","value"\n"deviceModel","X"\n')

    def table(name: str, stem: str, unit: str, values: Array, late: float) -> None:
        head = [f'"{n}"' for n in ["Time (s)", *axes(f"{stem} ", f" ({unit})", "xyz")]]
        write(folder / name, [",".join(head)], motion.time + late, values, form="%.9E")

    table("Accelerometer.csv", "Acceleration", "m/s^2", accel, 0.0013)
    table("Magnetometer.csv", "Magnetic field", "µT", field, 0.0021)
    if gyro_too:
        table("Gyroscope.csv", "Gyroscope", "rad/s", gyro, 0.0002)
    import_log("phone")
    assert_offset(field)


def test_motion_capture_writes_attitudes_beside_an_imu() -> None:
    motion = turning(np.arange(6000) * 0.01, 5)
    gyro, accel = inertial(motion, 6)
    field = noisy(motion.field, 0.3, 8) / np.linalg.norm(motion.field[0])
    turn = motion.world_from_body.as_quat(scalar_first=True)
    turn[::7] *= 0.997
    head = [
        "Time (s);Orientation;;;;IMU Acceleration;;;IMU Gyroscope;;;IMU Magnetometer;;",
        ";W;X;Y;Z;X;Y;Z;X;Y;Z;X;Y;Z",
    ]
    write(Path("capture.csv"), head, motion.time, turn, accel, gyro, field, sign=";")
    text = import_log("capture.csv", "--truth", "capture.csv")
    assert "up to 0.3 % off were scaled to unit length" in text
    report = figures("smooth", "log", "--site", "site.yaml", output="out")
    print(report["attitude_rmse_deg"])
    assert report["attitude_rmse_deg"] < 2.0


def test_an_autopilot_log_as_text_has_the_attitude_in_another_table() -> None:
    motion = turning(np.arange(7500) * 0.008, 7)
    gyro, accel = inertial(motion, 8)
    field = measured(motion, 10)
    stamps = np.rint(112_000_000 + motion.time * 1e6)
    index = ["[0]", "[1]", "[2]"]
    head = ["timestamp", *(f"{s}{k}" for s in ("gyro_rad", "accelerometer_m_s2") for k in index)]
    write(Path("sensor_combined.csv"), [",".join(head)], stamps, gyro, accel, form="%.9g")
    head = ["timestamp", *(f"magnetometer_ga{k}" for k in index)]
    write(Path("sensor_mag.csv"), [",".join(head)], stamps[::2], field[::2] * 1e-2, form="%.9g")
    turn = motion.world_from_body.as_quat(scalar_first=True)[::5]
    head = ["timestamp", *(f"q[{k}]" for k in range(4))]
    write(Path("attitude.csv"), [",".join(head)], stamps[::5], turn, form="%.9g")
    import_log("sensor_combined.csv", "sensor_mag.csv", "--truth", "attitude.csv")
    truth = open_log(Path("log")).truth
    assert truth is not None
    np.testing.assert_allclose(truth.world_from_body, motion.world_from_body.as_matrix()[::5], atol=1e-6)
    assert_offset(field[::2])


def test_an_industrial_imu_counts_weeks_and_seconds_of_gps() -> None:
    motion = turning(np.arange(6000) * 0.01, 9)
    gyro, accel = inertial(motion, 10)
    field = measured(motion, 12)
    head = ["GPS Week", "GPS TOW", *axes("", " Accel [x8004]"), *axes("", " Gyro [x8005]")]
    head += axes("", " Mag [x8006]")
    week, second = np.divmod(604_770.0 + motion.time, 604_800.0)
    lines = ["DATA_START", ",".join(head)]
    columns = 2190.0 + week, second, accel / G, gyro, field * 1e-2
    write(Path("mip.csv"), lines, *columns, form="%.9g")
    import_log("mip.csv")
    log = open_log(Path("log"))
    np.testing.assert_allclose(np.diff(log.imu.time), 0.01, atol=1e-6)
    assert_offset(field)
