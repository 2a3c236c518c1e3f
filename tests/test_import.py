"""Tables of any names, units and formats become the log that they were made of."""

import json
import wave
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from example_bag import (
    ACCEL,
    FIELD,
    GYRO,
    IMU,
    MEASURED,
    ODOMETRY,
    POSITION,
    ROTATION,
    SENSORS,
    STAMPS,
    STORE,
    VELOCITY_BODY,
    N,
    field_message,
    header,
    imu_message,
    odometry_message,
    write_bag,
    write_ros1_bag,
    xyz,
)
from rosbags.rosbag2 import StoragePlugin
from scipy.io import savemat

from magfusion.files.open import open_log
from magfusion.jobs.import_log import ImportSettings, run_import
from magfusion.model.samples import Log
from magfusion.results.figures import Figures
from magfusion.units import DEGREE, STANDARD_GRAVITY

QUATERNION = ROTATION.as_quat(scalar_first=True)
MS = (STAMPS - STAMPS[0]) / 1e6
DPS, IN_G, IN_NT = GYRO / DEGREE, ACCEL / STANDARD_GRAVITY, MEASURED * 1e9
IMU_MAP = ("imu.time=t[ms]", "imu.gyro=gx,gy,gz[deg/s]", "imu.accel=ax,ay,az[g]")
FIELD_MAP = ("magnetometer.time=t[ms]", "magnetometer.field=bx,by,bz[nT]")
TRUTH_MAP = ("truth.time=t[ms]", "truth.position=x,y,z[mm]", "truth.quaternion=q0,q1,q2,q3[wxyz]")


def table(path: Path, names: str, *columns: np.ndarray, delimiter: str = ",") -> Path:
    rows = np.column_stack(columns)
    lines = [delimiter.join(repr(float(v)) for v in row) for row in rows]
    path.write_text("\n".join([names, *lines]) + "\n")
    return path


@pytest.fixture(autouse=True)
def _unchecked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the check, which has its own tests, but where it is what is tested."""
    if "check" not in request.node.name:
        monkeypatch.setattr("magfusion.jobs.import_log.run_check", lambda _: Figures())


@pytest.fixture
def tables(tmp_path: Path) -> dict[str, Path]:
    """Return the tables of a recording, in units of their own."""
    return {
        "imu": table(tmp_path / "i.csv", "t,gx,gy,gz,ax,ay,az", MS, DPS, IN_G),
        "magnetometer": table(tmp_path / "m.csv", "t,bx,by,bz", MS, IN_NT),
        "truth": table(tmp_path / "g.csv", "t,x,y,z,q0,q1,q2,q3", MS, 1e3 * POSITION, QUATERNION),
    }


def imported(
    output: Path, *sources: Path, maps: tuple[str, ...] = (), **options: object
) -> tuple[Log, Figures]:
    settings = ImportSettings(sources=tuple(map(str, sources)), map=maps, **options)  # type: ignore[arg-type]
    figures = run_import(settings, output)
    return open_log(output), figures


def assert_same(log: Log, truth: bool = True, begin: float = 0.0) -> None:
    """Compare with what was written, to the last digits."""
    np.testing.assert_allclose(log.imu.time - begin, MS * 1e-3, rtol=0, atol=2e-9)
    np.testing.assert_allclose(log.imu.gyro_body, GYRO, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(log.imu.accel_body, ACCEL, rtol=1e-12, atol=1e-14)
    assert log.waveform is not None
    np.testing.assert_allclose(log.waveform.measured_sensor, MEASURED, rtol=1e-12, atol=1e-20)
    assert (log.truth is not None) == truth
    if log.truth is not None:
        np.testing.assert_allclose(log.truth.position_world, POSITION, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(log.truth.world_from_body, ROTATION.as_matrix(), atol=1e-12)


# Formats --------------------------------------------------------------------------------------


def test_tables_of_other_names_and_units_are_checked_and_the_log_they_were_made_of(
    tables: dict[str, Path], tmp_path: Path
) -> None:
    log, figures = imported(tmp_path / "log", maps=(*IMU_MAP, *FIELD_MAP, *TRUTH_MAP), **tables)
    assert_same(log)
    assert log.epoch_ns == 0
    assert {p.name for p in (tmp_path / "log").iterdir()} == {
        *("log.yaml", "report.html", "report.json"),
        *(f"{stream}.parquet" for stream in tables),
    }
    assert json.loads((tmp_path / "log" / "report.json").read_text()) == dict(figures)
    assert figures["job"] == "import"
    assert figures["verdict"] in ("trustworthy", "doubtful", "failed")
    assert figures["imu_rows_read"] == figures["imu_rows_written"] == N


def test_a_file_of_maps_says_the_same(tables: dict[str, Path], tmp_path: Path) -> None:
    lines = [f"{stream}: {path.name}" for stream, path in tables.items()]
    lines += ["epoch: first", "map:"]
    for entry in (*IMU_MAP, *FIELD_MAP, *TRUTH_MAP):
        key, _, value = entry.partition("=")
        lines.append(f"  {key}: '{value}'")
    (tmp_path / "map.yaml").write_text("\n".join(lines))
    log, _ = imported(tmp_path / "log", map_file=tmp_path / "map.yaml")
    assert_same(log)
    rotated = "imu.gyro=-gx,gy,gz[deg/s]"  # what is typed has the last word
    log, _ = imported(tmp_path / "log", map_file=tmp_path / "map.yaml", maps=(rotated,))
    np.testing.assert_allclose(log.imu.gyro_body, GYRO * [-1, 1, 1], rtol=1e-12, atol=1e-15)


def _npz(path: Path) -> tuple[Path, tuple[str, ...]]:
    np.savez(path / "all.npz", t=MS, gyro=DPS, accel=IN_G, field=IN_NT)
    return path / "all.npz", ("imu.gyro=gyro[deg/s]", "imu.accel=accel[g]")


def _hdf5(path: Path) -> tuple[Path, tuple[str, ...]]:
    with h5py.File(path / "all.h5", "w") as file:
        for name, values in (("t", MS), ("gyro", DPS), ("accel", IN_G), ("field", IN_NT)):
            file.create_dataset(f"run/{name}", data=values, chunks=True)
    return path / "all.h5", ("imu.gyro=run/gyro[deg/s]", "imu.accel=run/accel[g]")


def _matlab(path: Path) -> tuple[Path, tuple[str, ...]]:
    content = {"t": MS[:, np.newaxis], "gyro": DPS, "accel": IN_G, "field": IN_NT}
    savemat(path / "all.mat", {"run": content})
    return path / "all.mat", ("imu.gyro=run.gyro[deg/s]", "imu.accel=run.accel[g]")


def _matlab_7_3(path: Path) -> tuple[Path, tuple[str, ...]]:
    with h5py.File(path / "all.mat", "w", userblock_size=512) as file:
        for name, values in (("t", MS[:, None]), ("gyro", DPS), ("accel", IN_G), ("field", IN_NT)):
            file.create_dataset(f"run/{name}", data=values.T)  # column after column
    with (path / "all.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    return path / "all.mat", ("imu.gyro=run.gyro[deg/s]", "imu.accel=run.accel[g]")


def _parquet(path: Path) -> tuple[Path, tuple[str, ...]]:
    names = {
        f"{n}{a}": v[:, k]
        for n, v in (("g", DPS), ("a", IN_G), ("b", IN_NT))
        for k, a in enumerate("xyz")
    }
    pa.parquet.write_table(pa.table({"t": MS} | names), path / "all.parquet")
    return path / "all.parquet", (*IMU_MAP, *FIELD_MAP)


@pytest.mark.parametrize("write", [_npz, _hdf5, _matlab, _matlab_7_3, _parquet])
def test_one_file_of_arrays_holds_all_streams(
    tmp_path: Path, write: Callable[[Path], tuple[Path, tuple[str, ...]]]
) -> None:
    path, maps = write(tmp_path)
    if len(maps) == 2:
        lead = maps[0].partition("=")[2].partition("gyro")[0]
        maps += (f"magnetometer.field={lead}field[nT]",)
        maps += tuple(f"{stream}.time={lead}t[ms]" for stream in ("imu", "magnetometer"))
    log, _ = imported(tmp_path / "log", imu=path, magnetometer=path, maps=maps)
    assert_same(log, truth=False)


def test_arrays_without_names_are_mapped_by_number(tmp_path: Path) -> None:
    np.save(tmp_path / "imu.npy", np.column_stack([DPS, IN_G]))
    full_scale = 60e3  # nT
    counts = np.rint(IN_NT / full_scale * 2**15).astype("<i2")
    with wave.open(str(tmp_path / "mag.wav"), "wb") as stream:
        stream.setnchannels(3)
        stream.setsampwidth(2)
        stream.setframerate(200)
        stream.writeframes(counts.tobytes())
    maps = ("imu.gyro=0,1,2[deg/s]", "imu.accel=3,4,5[g]", "magnetometer.field=0,1,2[60*uT]")
    log, _ = imported(
        tmp_path / "log",
        maps=maps,
        imu=tmp_path / "imu.npy",
        magnetometer=tmp_path / "mag.wav",
        rate_hz=("imu=200",),
    )
    np.testing.assert_allclose(log.imu.gyro_body, GYRO, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(log.imu.time, np.arange(N) / 200.0, rtol=0, atol=1e-9)
    assert log.waveform is not None
    np.testing.assert_allclose(log.waveform.time, log.imu.time, rtol=0, atol=1e-9)
    exact = counts / 2**15 * full_scale * 1e-9
    np.testing.assert_allclose(log.waveform.measured_sensor, exact, rtol=1e-12, atol=1e-20)


def test_names_that_say_their_unit_need_no_map(tmp_path: Path) -> None:
    table(
        tmp_path / "everything.txt",
        "timestamp [ms]\tGyrX (deg/s)\tGyrY (deg/s)\tGyrZ (deg/s)\tacc_x_g\tacc_y_g\tacc_z_g"
        "\tBx_nT\tBy_nT\tBz_nT",
        *(MS, DPS, IN_G, IN_NT),
        delimiter="\t",
    )
    rows = np.column_stack([MS * 1e-3, POSITION, ROTATION.as_quat()])
    np.savetxt(tmp_path / "gt.tum", rows, fmt="%.17g")
    log, _ = imported(tmp_path / "log", tmp_path / "everything.txt", tmp_path / "gt.tum")
    assert_same(log)


# Bags and EuRoC -------------------------------------------------------------------------------


def _transforms(k: int) -> object:
    types = STORE.types
    built = []
    for parent, child, position in (("map", "imu", POSITION[k]), ("imu", "mag", np.zeros(3))):
        stamped = types["geometry_msgs/msg/TransformStamped"](
            types["std_msgs/msg/Header"](header(int(STAMPS[k])).stamp, parent),
            child,
            types["geometry_msgs/msg/Transform"](
                xyz("Vector3", position), xyz("Quaternion", ROTATION[k].as_quat())
            ),
        )
        built.append(stamped)
    return types["tf2_msgs/msg/TFMessage"](built)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_is_imported_with_transforms_as_truth(tmp_path: Path, plugin: StoragePlugin) -> None:
    topics = SENSORS | {"/tf": ("tf2_msgs/msg/TFMessage", _transforms)}
    bag = write_bag(tmp_path / "run", topics, plugin)
    log, figures = imported(tmp_path / "log", bag, maps=("truth=/tf:map->imu",))
    assert_same(log)
    assert log.epoch_ns == figures["epoch_ns"] == STAMPS[0]
    log, _ = imported(tmp_path / "log", bag, epoch="/imu/mag")
    assert_same(log, truth=False)
    log, _ = imported(tmp_path / "log", bag, epoch=str(STAMPS[0] - 10**9))
    assert_same(log, truth=False, begin=1.0)


def test_a_bag_that_publishes_microtesla_and_odometry(tmp_path: Path) -> None:
    def in_microtesla(k: int) -> object:
        message = field_message(k)
        message.magnetic_field = xyz("Vector3", MEASURED[k] * 1e6)
        return message

    topics = {
        "/imu": (IMU, imu_message),
        "/mag": (FIELD, in_microtesla),
        "/odom": (ODOMETRY, odometry_message),
    }
    log, _ = imported(
        tmp_path / "log", write_bag(tmp_path / "run", topics), maps=("magnetometer=/mag[uT]",)
    )
    assert_same(log)
    assert log.truth is not None
    assert log.truth.velocity_world is not None
    moved = ROTATION.apply(VELOCITY_BODY)
    np.testing.assert_allclose(log.truth.velocity_world, moved, rtol=1e-12, atol=1e-14)


def test_a_bag_of_ros_1_is_read_and_imported(tmp_path: Path) -> None:
    write_ros1_bag(tmp_path / "run.bag", SENSORS)
    assert_same(open_log(tmp_path / "run.bag"), truth=False)
    log, _ = imported(tmp_path / "log", tmp_path / "run.bag")
    assert_same(log, truth=False)


@pytest.mark.parametrize("folder", ["mag0", "magnetometer", "mag", "compass0"])
def test_a_euroc_folder_has_a_magnetometer_of_any_name(tmp_path: Path, folder: str) -> None:
    streams = tmp_path / "flight" / "mav0"
    for name in ("imu0", folder, "state_groundtruth_estimate0", "cam0"):
        (streams / name).mkdir(parents=True)
    stamps = [str(t) for t in STAMPS]

    def write(name: str, head: str, values: np.ndarray) -> None:
        lines = [
            ",".join([t, *map(repr, map(float, v))]) for t, v in zip(stamps, values, strict=True)
        ]
        (streams / name / "data.csv").write_text("\n".join([head, *lines]) + "\n")

    head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    write(
        "imu0",
        head + "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]",
        np.hstack([GYRO, ACCEL]),
    )
    write(folder, "#timestamp [ns],x [gauss],y [gauss],z [gauss]", MEASURED * 1e4)
    write(
        "state_groundtruth_estimate0", "#timestamp,x,y,z,w,x,y,z", np.hstack([POSITION, QUATERNION])
    )
    log, _ = imported(tmp_path / "log", tmp_path / "flight")
    assert_same(log)
    assert log.epoch_ns == STAMPS[0]
    write(folder, "#timestamp [ns],x,y,z", MEASURED)
    assert_same(open_log(tmp_path / "flight"))
