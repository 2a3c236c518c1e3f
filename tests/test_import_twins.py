"""Twins of public recordings go in by one import with pasted proposals; figures are right."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import allantools
import h5py
import numpy as np
import pyarrow.parquet
import pytest
import unsigned_amplitudes
from example_bag import IMU, MEASURED, STAMPS, STORE, N, header, imu_message, write_ros1_bag, xyz
from import_twins import EARTH, SITE, G, Motion, noisy, turning, write
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from tracker_site import body_poses, tracker_site

from magfusion.files.open import open_log
from magfusion.files.site import load_site, save_site
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.time_division import MarkedSlots, Slots
from magfusion.model.trajectory import interpolated
from magfusion.units import DEGREE, Array

IRON = np.array([22.0, -13.0, 9.0])  # uT
OFFSET_UT = 0.3
EARTH_NT = 1e3 * EARTH


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


def figures(*words: str, output: str) -> dict[str, Any]:
    ended = command(*words, "-o", output)
    assert ended.returncode == 0, ended.stderr
    report: dict[str, Any] = json.loads(Path(output, "report.json").read_text())
    return report


def ellipsoid_centre(field: Array) -> Array:
    """Return the centre of the quadric nearest to points, shape (3,)."""
    x, y, z = (field - field.mean(axis=0)).T
    terms = np.column_stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z]
    )
    a = np.linalg.lstsq(terms, np.ones(len(x)), rcond=None)[0]
    shape = np.array([[a[0], a[3], a[4]], [a[3], a[1], a[5]], [a[4], a[5], a[2]]])
    return np.asarray(field.mean(axis=0) - np.linalg.solve(shape, a[6:]))


def assert_offset(field: Array) -> None:
    """Compare the calibrated offset of the imported log with that of an ellipsoid (uT)."""
    report = figures("calibrate", "magnetometer", "log", "--site", "site.yaml", output="out")
    offset = [report[f"magnetometer.offset_nt_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(np.array(offset) * 1e-3, ellipsoid_centre(field), atol=OFFSET_UT)


def times(count: int, hertz: float) -> Array:
    """Return times of samples (s), shape (count,)."""
    return np.asarray(np.arange(count) / hertz, dtype=np.float64)


def measured(motion: Motion, seed: int, iron: Array = IRON, noise: float = 0.2) -> Array:
    """Return magnetometer samples (uT) with iron on the body."""
    soft = np.eye(3) + 0.03 * np.array([[0.5, 0.2, 0.0], [0.2, -0.4, 0.1], [0.0, 0.1, 0.3]])
    return noisy(motion.field @ soft.T + iron, noise, seed)


def inertial(motion: Motion, seed: int) -> tuple[Array, Array]:
    gyro = noisy(motion.gyro, 2e-3, seed) + np.array([2e-3, -1e-3, 3e-3])
    return gyro, noisy(motion.accel, 0.02, seed + 1)


def axes(stem: str, unit: str = "", names: str = "XYZ") -> list[str]:
    return [f"{stem}{axis}{unit}" for axis in names]


@pytest.mark.slow
def test_an_inertial_module_holds_a_slow_and_late_magnetometer() -> None:
    motion = turning(times(9000, 100.0), 1)
    gyro, accel = inertial(motion, 2)
    late = turning(motion.time - 0.055, 1)
    field = np.repeat(measured(late, 4)[::5], 5, axis=0)
    head = ["Time (s)", *axes("Gyroscope ", " (deg/s)"), *axes("Accelerometer ", " (g)")]
    head += axes("Magnetometer ", " (uT)")
    write(Path("module.csv"), [",".join(head)], motion.time, gyro / DEGREE, accel / G, field)
    import_log("module.csv")
    assert_offset(field)


@pytest.mark.slow
@pytest.mark.parametrize("gyro_too", [True, False])
def test_a_telephone_writes_a_table_a_sensor(gyro_too: bool) -> None:
    motion = turning(times(6000, 100.0), 3)
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


@pytest.mark.slow
def test_motion_capture_writes_attitudes_beside_an_imu() -> None:
    motion = turning(times(6000, 100.0), 5)
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
    assert report["attitude_rmse_deg"] < 2.0


@pytest.mark.slow
def test_an_autopilot_log_as_text_has_the_attitude_in_another_table() -> None:
    motion = turning(times(7500, 125.0), 7)
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
    np.testing.assert_allclose(
        truth.world_from_body, motion.world_from_body.as_matrix()[::5], atol=1e-6
    )
    assert_offset(field[::2])


@pytest.mark.slow
def test_an_industrial_imu_counts_weeks_and_seconds_of_gps() -> None:
    motion = turning(times(6000, 100.0), 9)
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


def at_rest(rate: float, duration: float, seed: int) -> tuple[Array, Array, Array]:
    """Return times (s), rates (rad/s) and forces (m/s^2) of an instrument at rest."""
    time = times(round(rate * duration), rate)
    still = np.tile([0.01, -0.02, 0.005, 0.3, -0.2, G], (len(time), 1))
    gyro = noisy(still[:, :3], 3e-3 * np.sqrt(rate / 100.0), seed)
    return time, gyro, noisy(still[:, 3:], 0.02 * np.sqrt(rate / 100.0), seed + 1)


def assert_allan(values: Array, rate: float, key: str) -> None:
    """Compare white noise with the interval of allantools (3 sigma), at an eighth of a second."""
    report = figures("allan", "log", output="noise")
    for axis, column in zip("xyz", values.T, strict=True):
        count = max(1, round(rate / 8.0))
        found = allantools.oadev(column, rate, data_type="freq", taus=[count / rate])
        tau, deviation = found[0][0], found[1][0]
        edf = allantools.edf_greenhall(0, 2, count, len(column), overlapping=True)
        low, high = allantools.confidence_interval(deviation, edf, ci=0.997)
        assert low < report[f"{key}_white_{axis}"] / np.sqrt(tau) < high


@pytest.mark.slow
def test_gait_analysis_has_a_sensor_a_foot_side_by_side() -> None:
    rate = 204.8
    _, gyro, accel = at_rest(rate, 240.0, 20)
    other = at_rest(rate, 240.0, 30)
    count = 1.0 + times(len(gyro), 1.0)
    head = [
        "Sample;Left foot;;;;;;Right foot;;;;;",
        ";" + ";".join(2 * [*axes("Acc ", " (g)"), *axes("Gyr ", " (deg/s)")]),
    ]
    feet = np.hstack([accel / G, gyro / DEGREE, other[2] / G, other[1] / DEGREE])
    write(Path("gait.csv"), head, count, feet, sign=";")
    import_log("gait.csv", "--rate-hz", "imu=204.8")
    np.testing.assert_allclose(open_table("imu", "gyro"), gyro, atol=1e-6)
    assert_allan(gyro, rate, "gyro")


def open_table(stem: str, column: str) -> Array:
    """Return three columns of a table of the log."""
    data = pyarrow.parquet.read_table(Path("log", f"{stem}.parquet"))
    return np.stack([data[f"{column}_{axis}"].to_numpy() for axis in "xyz"], axis=1)


def host_stamps(count: int, seed: int) -> Array:
    """Return times at which a host receives samples of 100 Hz: several at once, then none."""
    rng = np.random.default_rng(seed)
    stamps: list[float] = []
    while len(stamps) < count:
        batch = int(rng.integers(3, 8))
        arrived = (len(stamps) + batch) * 0.01
        stamps += list(arrived + np.cumsum(rng.uniform(1e-3, 2e-3, batch)))
    return np.array(stamps[:count])


@pytest.mark.slow
def test_a_usb_host_stamps_buffers_of_four_rows() -> None:
    motion = turning(times(6000, 100.0), 11)
    gyro, accel = inertial(motion, 12)
    field = measured(motion, 14)
    with h5py.File("run.mat", "w", userblock_size=512) as file:
        for seed, (name, values) in enumerate(
            {"gyroData": gyro, "accData": -accel / G, "magData": field * 1e-2}.items()
        ):
            stamps = 1000.0 + host_stamps(len(values), seed)
            file.create_dataset(name, data=np.column_stack([stamps, values]))  # MATLAB's 4 x n
    with Path("run.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    import_log("run.mat", "--map", "accel.accel=-accData:x,-accData:y,-accData:z[g]")
    log = open_log(Path("log"))
    assert log.imu.accel_body[:, 2].max() > 9.0
    assert_offset(field)


@pytest.mark.slow
def test_a_magnetometer_alone_is_an_array_with_false_samples() -> None:
    motion = turning(times(3000, 50.0), 13, (1.6, 1.3, 3.0))
    field = measured(motion, 15)
    spoiled = field.copy()
    spoiled[[100, 901, 1500, 2222]] = [[900, 0, 0], [0, -2000, 5], [300, 300, 300], [0, 0, 0]]
    savemat("turned.mat", {"magRaw": spoiled})
    import_log("turned.mat", "--rate-hz", "magnetometer=50")
    assert_offset(field)


@pytest.mark.slow
def test_a_breakout_board_rests_for_half_a_minute() -> None:
    rate = 30.0
    time = times(900, rate)
    field = noisy(np.tile(EARTH_NT, (len(time), 1)), 20.0, 16)
    lines = ["# RM3100 breakout, gain 75", "# x[nT] y[nT] z[nT] total[nT] time[s] unix[s]"]
    size = np.linalg.norm(field, axis=1)
    columns = field, size, time, 1_714_550_000.0 + time
    write(Path("board.txt"), lines, *columns, sign="  ", form="%.3f")
    import_log("board.txt")
    assert_allan(field * 1e-9, rate, "magnetometer")


@pytest.mark.slow
def test_a_board_turned_by_hand_has_no_times() -> None:
    motion = turning(times(4000, 50.0), 17)
    _, accel = inertial(motion, 18)
    field = measured(motion, 19)
    write(Path("hand.csv"), ["ax,ay,az,mx,my,mz"], accel / G, field * 1e-2)
    import_log("hand.csv", "--rate-hz", "accel=50", "--rate-hz", "magnetometer=50")
    assert_offset(field)


@pytest.mark.slow
def test_a_robot_with_hard_iron_has_a_truth_by_two_clocks() -> None:
    motion = turning(times(6000, 100.0), 21, (0.15, 0.9, 3.0), 8.0)
    gyro, accel = inertial(motion, 22)
    field = measured(motion, 24, iron=np.array([60.0, -50.0, 45.0]), noise=0.05)
    write(Path("imu.csv"), ["t_s,wx,wy,wz,ax,ay,az"], motion.time, gyro, accel)
    write(Path("mag.csv"), ["t_s,mag_x_uT,mag_y_uT,mag_z_uT"], motion.time, field)
    turn = 0.9989 * motion.world_from_body.as_quat()
    stamps = motion.time.copy()
    stamps[::20] += 1_714_550_000.0
    place = np.zeros_like(field)
    head = ["t_s,x_m,y_m,z_m,qx,qy,qz,qw"]
    write(Path("truth.csv"), head, stamps, place, turn, form="%.12g")
    text = import_log("imu.csv", "mag.csv", "truth.csv")
    assert "up to 0.11 % off were scaled to unit length" in text
    truth = open_log(Path("log")).truth
    assert truth is not None
    assert len(truth) == 5700
    assert_offset(field)


def imported_fields() -> FieldSamples:
    fields = open_log(Path("log")).fields
    assert fields is not None
    return fields


@pytest.mark.slow
def test_sixteen_coils_are_a_column_of_amplitudes() -> None:
    walk = unsigned_amplitudes.walk(0, 6.0)
    save_site(walk.site, Path("coils.yaml"))
    size = np.abs(walk.phasors.phasor_sensor[..., 2])
    np.savetxt("frames.txt", size.ravel() * 1e9)
    words = ("--fields", "frames.txt", "--rate-hz", "fields=10@0.5", "--sigma", "0.1*nT")
    import_log(*words, "--site", "coils.yaml")
    fields = imported_fields()
    assert not fields.signed
    np.testing.assert_allclose(fields.time, walk.phasors.time, atol=1e-8)
    np.testing.assert_allclose(fields.phasor_sensor[..., 0].real, size, rtol=1e-6)
    report = figures("fix", "log", "--site", "coils.yaml", output="out")
    assert report["residual_rms_median"] < 1.3
    truth = walk.log.truth
    assert truth is not None
    lever = walk.site.platform.magnetometer.position_body
    world = interpolated(
        walk.phasors.time, truth.time, truth.position_world + truth.world_from_body @ lever
    )
    assert_fixed(world, 0.01, lever)


@pytest.mark.slow
def test_sixteen_coils_are_raw_samples_beside_a_marker() -> None:
    rate, burst, carrier = 96_000.0, 0.01, 4_000.0
    site = unsigned_amplitudes.floor()
    beacons = tuple(
        replace(beacon, frequency_hz=carrier, slots=MarkedSlots(), synchronised=False,
            coils=(replace(beacon.coils[0], slot=k),))
        for k, beacon in enumerate(site.beacons)
    )  # fmt: skip
    save_site(replace(site, beacons=beacons), Path("coils.yaml"))
    rng = np.random.default_rng(41)
    size = rng.uniform(5.0, 50.0, 16)  # nT
    time = np.arange(round(16 * 5 * burst * rate)) / rate
    slot = (time // burst).astype(int) % 16
    wave = size[slot] * np.cos(2.0 * np.pi * carrier * time + 0.4) + rng.normal(0.0, 1.0, len(time))
    counts = np.rint(wave / 0.01).astype(np.int16)
    np.savez("adc.npz", adc=counts, marker=slot.astype(np.int16))
    maps = ("magnetometer.field_z=adc[0.01*nT]", "magnetometer.slot=marker")
    words = [word for one in maps for word in ("--map", one)]
    import_log("--magnetometer", "adc.npz", *words, "--rate-hz", "magnetometer=96000")
    ended = command("demodulate", "log", "--site", "coils.yaml", "-o", "fields")
    assert ended.returncode == 0, ended.stderr
    fields = open_log(Path("fields")).fields
    assert fields is not None
    found = np.nanmedian(np.abs(fields.phasor_sensor[..., 2]), axis=0)
    np.testing.assert_allclose(found, size * 1e-9, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("pulsed", [False, True])
def test_a_tracker_of_three_coils(pulsed: bool) -> None:
    rng = np.random.default_rng(43)
    site = tracker_site(rng, gain=0.0, tilt=0.0, centre=0.0)
    (beacon,) = site.beacons
    hertz = 0.0 if pulsed else 1000.0
    coils = tuple(replace(coil, phase=0.0) for coil in beacon.coils)
    beacon = replace(beacon, frequency_hz=hertz, slots=Slots(0.005, 4, 0.0), coils=coils)
    site = replace(site, beacons=(beacon,))
    save_site(site, Path("tracker.yaml"))
    attitude, place = body_poses(site, 40, rng)
    time = times(40, 50.0)
    seen = predict_channels(initial_calibration(site, 0.0), time, attitude, place)
    noise = 1e-11 * (rng.standard_normal(seen.shape) + 1j * rng.standard_normal(seen.shape))
    values = (seen + noise) * 1e9
    if pulsed:
        ambient = rng.uniform(-3e4, 3e4, (40, 1, 3))
        values = np.concatenate([values.real + ambient, ambient], axis=1)
    savemat("tracker.mat", {"coils": values})
    words = ("--fields", "tracker.mat", "--rate-hz", "fields=50", "--sigma", "0.01*nT")
    import_log(*words, "--site", "tracker.yaml")
    phasor = imported_fields().phasor_sensor
    np.testing.assert_allclose(phasor, (seen + (noise.real if pulsed else noise)), atol=1e-15)
    report = figures("fix", "log", "--site", "tracker.yaml", output="out")
    assert report["residual_rms_median"] < 1.3
    assert_fixed(place, 1e-3, np.zeros(3))


def assert_fixed(place: Array, tolerance: float, lever: Array) -> None:
    """Compare the nearest of the possible places of each epoch's sensor with the true one (m)."""
    table = pyarrow.parquet.read_table(Path("out", "fixes.parquet"))
    poses = np.stack([table[f"position_{axis}"].to_numpy() for axis in "xyz"], axis=1)
    epoch = np.unique(table["time_ns"].to_numpy(), return_inverse=True)[1]
    turn = Rotation.from_quat(np.stack([table[f"q{a}"].to_numpy() for a in "xyzw"], axis=1))
    error = np.linalg.norm(poses + turn.apply(lever) - place[epoch], axis=1)
    nearest = np.full(len(place), np.inf)
    np.minimum.at(nearest, epoch, error)
    assert np.median(nearest) < tolerance


@pytest.mark.slow
def test_tables_by_rows_name_beacon_or_slot_and_axis() -> None:
    site = tracker_site(np.random.default_rng(43), gain=0.0, tilt=0.0, centre=0.0)
    beacon = replace(site.beacons[0], slots=Slots(0.005, 4, 0.0))
    save_site(replace(site, beacons=(beacon,)), Path("tracker.yaml"))
    rng = np.random.default_rng(44)
    values = rng.standard_normal((10, 3, 3)) + 1j * rng.standard_normal((10, 3, 3))
    lines = {"slot": ["t_s,slot,axis,re_nT,im_nT,sigma_nT"], "beacon": []}
    lines["beacon"] = [
        "t_s;beacon;tone;re_x;re_y;re_z;im_x;im_y;im_z;sigma",
        "s;;;" + "nT;" * 6 + "nT",
    ]
    for k, t in enumerate(0.02 * np.arange(10)):
        for coil in range(3):
            own = values[k, coil]
            lines["slot"] += [
                f"{t:.3f},{coil},{axis},{v.real:.9f},{v.imag:.9f},0.1"
                for axis, v in zip("xyz", own, strict=True)
            ]
            numbers = ";".join(f"{v:.9f}" for v in (*own.real, *own.imag))
            lines["beacon"].append(f"{t:.3f};T;{coil};{numbers};0.1")
        lines["slot"].append(f"{t:.3f},3,x,0.0,0.0,0.1")  # silent
    for label, rows in lines.items():
        Path(f"{label}.csv").write_text("\n".join(rows) + "\n")
        import_log("--fields", f"{label}.csv", "--site", "tracker.yaml", output=f"by_{label}")
        fields = open_log(Path(f"by_{label}")).fields
        assert fields is not None
        assert fields.channels == (("T", 0), ("T", 1), ("T", 2))
        np.testing.assert_allclose(fields.phasor_sensor, values * 1e-9, atol=1e-17)
        np.testing.assert_allclose(fields.phasor_cov[..., 0, 0], 1e-20, rtol=1e-9)


@pytest.mark.slow
def test_a_log_without_tones_has_a_site_without_beacons() -> None:
    motion = turning(times(3000, 100.0), 51)
    gyro, accel = inertial(motion, 52)
    head = [
        "t_s",
        *axes("w", "_rad_s", "xyz"),
        *axes("a", "_m_s2", "xyz"),
        *axes("B", "_uT", "xyz"),
    ]
    write(Path("all.csv"), [",".join(head)], motion.time, gyro, accel, measured(motion, 54))
    import_log("all.csv")
    ended = command("init", "--log", "log", "-o", "new.yaml")
    assert ended.returncode == 0, ended.stderr
    assert load_site(Path("new.yaml"), without=True).beacons == ()
    figures("calibrate", "magnetometer", "log", "--site", "new.yaml", output="out")


@pytest.mark.slow
def test_a_user_marks_missing_values() -> None:
    motion = turning(times(1000, 100.0), 55)
    field = measured(motion, 56)
    rows = [
        f"{t:.2f},{x:.3f},{y:.3f},{z:.3f}" for t, (x, y, z) in zip(motion.time, field, strict=True)
    ]
    rows[7], rows[9] = "0.07,--,1,2", "0.09,lost,1,2"
    Path("mag.csv").write_text("\n".join(["t_s,Bx_uT,By_uT,Bz_uT", *rows]) + "\n")
    ended = command("import", "mag.csv", "-o", "log")
    assert ended.returncode == 2
    assert "--missing=lost" in ended.stderr
    import_log("mag.csv", "--missing=lost")
    waveform = open_log(Path("log")).waveform
    assert waveform is not None
    assert len(waveform.time) == 998


@pytest.mark.slow
@pytest.mark.parametrize("gauss", [True, False])
def test_several_bags_publish_vectors(gauss: bool) -> None:
    def message(k: int) -> Any:
        values = MEASURED[k] * (1e4 if gauss else 1e6)
        kind = STORE.types["geometry_msgs/msg/Vector3Stamped"]
        return kind(header(int(STAMPS[k])), xyz("Vector3", values))

    half = N // 2
    for number, rows in enumerate((range(half), range(half, N))):
        topics = {
            "/imu/data": (IMU, imu_message),
            "/imu/mag": ("geometry_msgs/msg/Vector3Stamped", message),
            "/imu/dv": ("geometry_msgs/msg/Vector3Stamped", message),
        }
        write_ros1_bag(Path(f"run_{number}.bag"), topics, rows)
    import_log("run_0.bag", "run_1.bag")
    log = open_log(Path("log"))
    assert log.waveform is not None
    np.testing.assert_allclose(log.waveform.measured_sensor, MEASURED, rtol=1e-9)
    assert len(log.imu) == N


@pytest.mark.slow
def test_columns_of_a_euroc_folder_are_those_of_its_header() -> None:
    motion = turning(times(500, 100.0), 57)
    stamps = 1_403_636_579_000_000_000 + np.arange(500) * 10_000_000
    rates = axes("w_RS_S_", " [rad s^-1]", "xyz")
    tables = {
        "imu0": (
            [*axes("a_RS_S_", " [m s^-2]", "zyx"), *rates],
            motion.accel[:, ::-1],
            motion.gyro,
        ),
        "mag0": (axes("", " [gauss]", "zxy"), motion.field[:, [2, 0, 1]] * 1e-2),
    }
    for name, (head, *columns) in tables.items():
        folder = Path("flight", "mav0", name)
        folder.mkdir(parents=True)
        lines = [
            f"{t}," + ",".join(f"{v:.9f}" for v in row)
            for t, row in zip(stamps, np.hstack(columns), strict=True)
        ]
        (folder / "data.csv").write_text(
            "\n".join([",".join(["#timestamp [ns]", *head]), *lines]) + "\n"
        )
    import_log("flight")
    for log in (open_log(Path("log")), open_log(Path("flight"))):
        assert log.waveform is not None
        np.testing.assert_allclose(log.imu.accel_body, motion.accel, atol=1e-8)
        np.testing.assert_allclose(log.imu.gyro_body, motion.gyro, atol=1e-8)
        np.testing.assert_allclose(log.waveform.measured_sensor, motion.field * 1e-6, atol=1e-12)
