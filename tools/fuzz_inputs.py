"""Small inputs of every kind that a command reads, written by the package and its libraries."""

import io
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat, wavfile

from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.files.log import write_log
from magfusion.files.readings_table import DEGC, write_readings
from magfusion.files.site import save_site
from magfusion.files.survey import write_survey
from magfusion.files.tum import write_tum
from magfusion.jobs.replay import run_replay
from magfusion.jobs.survey import make_survey
from magfusion.model.field_map import COMPONENTS, FieldMap
from magfusion.model.samples import Log
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

EPOCH_NS = 1_700_000_000_000_000_000
DURATION = 14.0  # s; a first state needs about eight
KEPT = 12.0  # s, in a checkpoint
ESTIMATORS = ("ekf", "smoother")
MESSAGES = 40  # of each topic in a bag
HALL = {
    "magfusion_hall": 1,
    "hall": {"polygon_m": [[0, 0], [6, 0], [6, 5], [0, 5]], "height_m": [0, 3]},
    "mount": {"surfaces": ["walls"], "walls": [0, 2], "height_m": [1, 2]},
    "forbidden": [{"polygon_m": [[2, -0.1], [3, -0.1], [3, 0.1]], "height_m": [0, 2]}],
    "use": {"height_m": [0.5, 2], "margin_m": 0.5},
}
MOTION = {
    "accel_density_m_s2_rthz": 1.0,
    "angular_accel_density_rad_s2_rthz": 1.0,
    "rate_sigma_rad_s": 1.0,
}
STREAMS = {  # of each the keys of its records and their columns
    "imu": {
        "gyro": ("gyro_x", "gyro_y", "gyro_z"),
        "accel": ("accel_x", "accel_y", "accel_z"),
    },
    "magnetometer": {"field": ("field_x", "field_y", "field_z")},
}
WELLS = {"distance_m": 8.0, "apart_m": 4.0, "reach_m": 2.0, "speed_m_s": 0.5}
ROTOR = {"moment_a_m2": 300.0, "length_m": 0.3, "axis": [0, 0, 1], "zero": [1, 0, 0]}
BIT = {"name": "bit", "unknown": "pose", "frequency_hz": 3.0, "synchronised": True, "rotor": ROTOR}
MAP = {
    "map": {
        "imu.gyro": "gyro_x,gyro_y,gyro_z[rad/s]",
        "imu.accel": "accel_x,accel_y,accel_z[m/s^2]",
    }
}


def example_inputs(place: Path) -> Path:
    """Write a log with its tables, and what else is read; return the directory of all."""
    site = demo_site()
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=DURATION,
        rests=Rests(2.0, 20.0, 2.0),
        imu_rate_hz=50.0,
        magnetometer_rate_hz=100.0,
    )
    built = simulate_log(site, config, np.random.default_rng(0)).log
    log = replace(built, name="log", epoch_ns=EPOCH_NS)
    phasors = replace(log, waveform=None, fields=demodulated(log, site).fields)
    for name, one in ("log", log), ("phasors", phasors):
        write_log(one, place / name)
        save_site(site, place / name / "site.yaml")
    degc = {"A": np.array([[0.0, 9.0], [20.0, 25.0]])}
    write_readings(degc, place / "log" / "temperature.parquet", EPOCH_NS, DEGC)
    _write_surveyed(phasors, place)
    _write_foreign(place)
    _write_bags(log, place)
    well = yaml.safe_load((place / "log" / "site.yaml").read_text()) | {"beacons": [BIT]}
    yamls = {"hall": HALL, "tables/map": MAP, "wells/wells": WELLS, "wells/site": well}
    (place / "wells").mkdir()
    for name, content in yamls.items():
        (place / f"{name}.yaml").write_text(yaml.safe_dump(content))
    for estimator in ESTIMATORS:
        _write_checkpoint(phasors, place, estimator)
    return place


def _write_surveyed(log: Log, place: Path) -> None:
    """Write a survey, a site with a field map, and the truth as text."""
    site, rng = demo_site(), np.random.default_rng(1)
    assert log.fields is not None
    assert log.truth is not None
    survey, _ = make_survey(log.fields, log.truth, log, site, points="epochs", spacing=0.25)
    write_survey(survey, place / "survey.parquet")
    write_survey(survey, place / "survey.csv")
    root = rng.normal(0.0, 30.0, (5, COMPONENTS, COMPONENTS))
    points, weights = rng.uniform(1.0, 4.0, (5, 3)), rng.normal(size=(5, COMPONENTS))
    result = FieldMap(points, weights, root @ np.swapaxes(root, 1, 2), 0.9, 0.1, 0.05, 0.003)
    first, *others = site.beacons
    (place / "mapped").mkdir()
    mapped = replace(site, beacons=(replace(first, field_map=result), *others))
    save_site(mapped, place / "mapped" / "site.yaml")
    write_tum(log.truth, place / "truth.tum", EPOCH_NS)


def _write_foreign(place: Path) -> None:
    """Write the inertial table in other formats, and the log as a EuRoC folder."""
    (place / "tables").mkdir()
    for stem, folder in ("imu", "imu0"), ("magnetometer", "mag0"), ("truth", "gt"):
        table = pa.parquet.read_table(place / "log" / f"{stem}.parquet")
        euroc = (
            place
            / "euroc"
            / "mav0"
            / ("state_groundtruth_estimate0" if stem == "truth" else folder)
        )
        euroc.mkdir(parents=True)
        for path in place / "tables" / f"{stem}.csv", euroc / "data.csv":
            pa.csv.write_csv(table, path)
    columns = pa.parquet.read_table(place / "log" / "imu.parquet").to_pydict()
    values = np.array([columns[name] for name in columns if name != "time_ns"]).T
    tables = place / "tables"
    np.savez(tables / "imu.npz", **{k: np.array(v) for k, v in columns.items()})  # type: ignore[arg-type]
    np.save(tables / "imu.npy", np.column_stack([columns["time_ns"], values]))
    savemat(tables / "imu.mat", {k: np.array(v) for k, v in columns.items()})
    wavfile.write(tables / "imu.wav", 50, values.astype(np.float32))


def _write_bags(log: Log, place: Path) -> None:
    """Write bags of ROS 1 and 2."""
    for plugin in StoragePlugin:
        folder = place / f"bag_{plugin.name.lower()}"
        with Writer(folder, version=9, storage_plugin=plugin) as writer:
            _write_messages(writer, log, Stores.ROS2_HUMBLE)
    (place / "bag_ros1").mkdir()
    with Writer1(place / "bag_ros1" / "bag_ros1.bag") as writer1:
        _write_messages(writer1, log, Stores.ROS1_NOETIC)


def _write_messages(writer: Writer | Writer1, log: Log, store: Stores) -> None:
    types = get_typestore(store)
    is_ros1, none = store is Stores.ROS1_NOETIC, np.zeros(9)
    vector = types.types["geometry_msgs/msg/Vector3"]
    quaternion = types.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    assert log.waveform is not None
    for kind, samples in ("Imu", log.imu.time), ("MagneticField", log.waveform.time):
        name = f"sensor_msgs/msg/{kind}"
        connection = writer.add_connection(f"/{kind.lower()}", name, typestore=types)
        for k, time in enumerate(samples[:MESSAGES]):
            stamp = EPOCH_NS + round(1e9 * time)
            at = types.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
            head = types.types["std_msgs/msg/Header"](*[k][: int(is_ros1)], at, "base")
            if kind == "Imu":
                rate, force = vector(*log.imu.gyro_body[k]), vector(*log.imu.accel_body[k])
                message = types.types[name](head, quaternion, none, rate, none, force, none)
            else:
                message = types.types[name](head, vector(*log.waveform.measured_sensor[k]), none)
            write = types.serialize_ros1 if is_ros1 else types.serialize_cdr
            writer.write(connection, stamp, bytes(write(message, name)))


def _write_checkpoint(log: Log, place: Path, estimator: str) -> None:
    """Write the checkpoint of a pipe that has given states, and the records after it."""
    whole = io.BytesIO()
    run_replay(log, whole, "json", realtime=False)
    lines = whole.getvalue().splitlines(keepends=True)
    cut = round(len(lines) * KEPT / DURATION)
    (place / "rest.jsonl").write_bytes(b"".join(lines[cut:]))
    words = f"-m magfusion navigate - --estimator {estimator} --checkpoint {estimator}.bin"
    subprocess.run(
        [sys.executable, *words.split(), "--every", "0.1", "--site", "log/site.yaml"],
        cwd=place,
        input=b"".join(lines[:cut]),
        stdout=subprocess.DEVNULL,
        check=True,
    )
