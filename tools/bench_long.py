"""Processor time and memory of long logs, compared with reading everything at once.

A walk among the demo's beacons is simulated with both instruments at 500 Hz and recorded as MCAP,
as ROS 2 records it: half a gigabyte in half an hour.  Of its first minutes, as many as requested,
each command reports its processor time, that a sample of the IMU took beyond start-up (the time of
the same command on the first ten seconds), and the largest memory that it used.  The last column
is by how many MiB it grew with each minute since the length before.

- ``reading all`` makes an object of each message and lists of numbers, as an importer does that
  knows no better.
- ``pipe`` is the filter that is given the same raw samples one after the other; of what writes them
  nothing is counted.
- ``replay`` runs on a log that lasts an hour a minute: rest at 100 Hz, written as Parquet.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

RATE_HZ = 500.0
LONG_RATE_HZ = 100.0
BEGINNING = 1.0 / 6.0  # minutes; of which the time is taken for start-up
GOAL_MINUTES, GOAL_S, GOAL_MIB = 30.0, 90.0, 1000.0
PROGRAM = (sys.executable, "-m", "magfusion")
ITSELF = (sys.executable, __file__)


class Usage(NamedTuple):
    """What a command took: processor time (s) and largest memory (MiB)."""

    seconds: float
    mib: float


def used(command: tuple[str, ...]) -> Usage:
    """Run a command to its end; return what it took."""
    with tempfile.TemporaryFile() as findings, Path(os.devnull).open("wb") as nothing:
        process = subprocess.Popen(command, stdout=nothing, stderr=findings)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            findings.seek(0)
            raise SystemExit(f"{' '.join(command)}: {findings.read().decode()[-2000:]}")
    return Usage(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0)


# What follows up to `commands` runs in processes of its own: memory that this one held would be
# counted as that of every command.


def simulate(room: Path, minutes: list[float]) -> None:
    """Record the first minutes of a walk as bags, and write its site."""
    import numpy as np

    from magfusion.files.site import save_site
    from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
    from magfusion.simulation.log import SimulationConfig, simulate_log

    site, config = (
        demo_site(),
        SimulationConfig(
            DEMO_BOX_WORLD,
            duration=60.0 * max(minutes),
            imu_rate_hz=RATE_HZ,
            magnetometer_rate_hz=RATE_HZ,
        ),
    )
    log = simulate_log(site, config, np.random.default_rng(0)).log
    save_site(site, room / "site.yaml")
    for length in minutes:
        record(log, 60.0 * length, room / bag_of(length))


def bag_of(minutes: float) -> str:
    """Return the name of the bag of so many minutes."""
    return f"bag_{60.0 * minutes:.0f}"


def record(log: Any, end: float, path: Path) -> None:
    """Write the part of a log before a time (s) as MCAP."""
    import numpy as np
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    head: list[Any] = [("cdr", "V4"), ("second", "<i4"), ("nanosecond", "<u4"), ("size", "<u4")]
    head += [("frame", "S5"), ("", "V7")]
    numbers = {"sensor_msgs/msg/Imu": 37, "sensor_msgs/msg/MagneticField": 12}
    columns = {
        "sensor_msgs/msg/Imu": (
            log.imu.time,
            {13: log.imu.gyro_body, 25: log.imu.accel_body},
        ),
        "sensor_msgs/msg/MagneticField": (log.waveform.time, {0: log.waveform.measured_sensor}),
    }
    store, due = get_typestore(Stores.ROS2_HUMBLE), []
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for number, (msgtype, (times, parts)) in enumerate(columns.items()):
            count = int(np.searchsorted(times, end))
            stamps = np.rint(times[:count] * 1e9).astype(np.int64) + log.epoch_ns
            rows = np.zeros(count, dtype=[*head, ("number", "<f8", numbers[msgtype])])
            rows["cdr"], rows["size"], rows["frame"] = np.void(b"\0\1\0\0"), 5, b"base"
            rows["second"], rows["nanosecond"] = np.divmod(stamps, 10**9)
            for first, values in parts.items():
                rows["number"][:, first : first + 3] = values[:count]
            topic = writer.add_connection(f"/sensor{number}", msgtype, typestore=store)
            due.append((topic, stamps.tolist(), rows.tobytes(), rows.itemsize))
        order = np.argsort(np.concatenate([stamps for _, stamps, _, _ in due]), kind="stable")
        for k in order.tolist():
            own, k = (due[0], k) if k < len(due[0][1]) else (due[1], k - len(due[0][1]))
            topic, stamps, raw, size = own
            writer.write(topic, stamps[k], raw[k * size : (k + 1) * size])


def rest(path: Path, hours: float) -> None:
    """Write a log at rest, a minute at a time."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet

    path.mkdir()
    (path / "log.yaml").write_text("magfusion_log: 1\nname: rest\nepoch_ns: 0\nsource: bench\n")
    rng, piece = np.random.default_rng(0), round(60.0 * LONG_RATE_HZ)
    for name, means, noise in (
        (
            "imu",
            {f"{k}_{a}": 9.81 * (k + a == "accelz") for k in ("gyro", "accel") for a in "xyz"},
            1e-2,
        ),
        ("magnetometer", {f"field_{a}": 4e-5 for a in "xyz"}, 1e-9),
    ):
        types = [("time_ns", pa.int64()), *((column, pa.float64()) for column in means)]
        with pa.parquet.ParquetWriter(path / f"{name}.parquet", pa.schema(types)) as writer:
            for minute in range(round(60.0 * hours)):
                number = minute * piece + np.arange(piece)
                columns: dict[str, Any] = {"time_ns": number * round(1e9 / LONG_RATE_HZ)}
                for column, mean in means.items():
                    columns[column] = mean + noise * rng.standard_normal(piece)
                writer.write_table(pa.table(columns))


def read_all(path: Path) -> None:
    """Read a bag as an importer does that knows no better."""
    import numpy as np
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    result: dict[str, list[list[float]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            row = [stamp.sec + 1e-9 * stamp.nanosec]
            for name in ("angular_velocity", "linear_acceleration", "magnetic_field"):
                vector = getattr(message, name, None)
                row += [] if vector is None else [vector.x, vector.y, vector.z]
            result.setdefault(connection.topic, []).append(row)
    print({topic: np.array(rows).shape for topic, rows in result.items()})


def piped(path: str, site: str) -> None:
    """Become the filter that reads what a replay of a log writes."""
    replay = subprocess.Popen(
        (*PROGRAM, "replay", path, "--format", "msgpack"), stdout=subprocess.PIPE
    )
    assert replay.stdout is not None
    os.dup2(replay.stdout.fileno(), 0)
    options = ("--site", site, "--format", "msgpack", "--estimator", "ekf")
    os.execv(sys.executable, (*PROGRAM, "navigate", "-", *options))


def commands(room: Path, minutes: float) -> dict[str, tuple[str, ...]]:
    """Return the commands on a length of the walk."""
    bag, out = room / bag_of(minutes), f"{bag_of(minutes)}_"
    site = ("--site", str(room / "site.yaml"))

    def job(*command: str) -> tuple[str, ...]:
        return (*PROGRAM, *command, str(bag), "-o", str(room / (out + command[-1])))

    return {
        "reading all": (*ITSELF, "--read-all", str(bag)),
        "import": job("import"),
        "smooth": (*job("smooth"), *site),
        "ekf": (*job("navigate"), *site, "--estimator", "ekf"),
        "fixed lag": (*job("navigate"), *site),
        "pipe": (*ITSELF, "--piped", str(bag), site[1]),
        "replay": (
            *PROGRAM,
            "replay",
            str(room / f"rest_{60.0 * minutes:.0f}"),
            "--format",
            "msgpack",
        ),
    }


def reported(
    name: str, minutes: float, result: Usage, start: Usage, before: tuple[float, Usage]
) -> str:
    """Return a line of the table."""
    rate_hz = 60.0 * LONG_RATE_HZ if name == "replay" else RATE_HZ
    samples = 60.0 * rate_hz * (minutes - BEGINNING)
    grown = (result.mib - before[1].mib) / (minutes - before[0])
    goal = ""
    if name == "smooth" and minutes == GOAL_MINUTES:
        goal = f"   goal: {GOAL_S:.0f} s, {GOAL_MIB:.0f} MiB"
    each = 1e6 * (result.seconds - start.seconds) / samples
    line = f"{name:<12}{minutes:6.4g}{result.seconds:9.1f} s{each:9.1f}"
    return f"{line}{result.mib:7.0f}{grown:9.1f}{goal}"


def main() -> None:
    """Print the table and one JSON line; exit with 1 where the goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--minutes", type=float, nargs="+", default=[1.0, 3.0], help="3 10 30 in full"
    )
    names = ["reading all", "import", "smooth", "ekf", "fixed lag", "pipe", "replay"]
    parser.add_argument("--only", choices=names, action="append", help="of the commands")
    parser.add_argument("--room", type=Path, help="directory to keep the logs in; else a new one")
    parser.add_argument("--simulate", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--rest", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--read-all", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--piped", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.simulate is not None:
        simulate(options.simulate, options.minutes)
    elif options.rest is not None:
        rest(options.rest, options.minutes[0])
    elif options.piped is not None:
        piped(*options.piped)
    elif options.read_all is not None:
        read_all(options.read_all)
    else:
        with tempfile.TemporaryDirectory() as new:
            room, minutes = options.room or Path(new), sorted(options.minutes)
            figures, missed = measure(room, minutes, options.only or names)
        print(json.dumps(figures))
        raise SystemExit(1 if missed else 0)


def measure(
    room: Path, minutes: list[float], names: list[str]
) -> tuple[list[dict[str, Any]], bool]:
    """Make the logs that are not there, run the commands and print what they took.

    Returns the figures, and whether a goal was missed.
    """
    lengths, missed, figures = [BEGINNING, *minutes], False, []
    lacking = [str(m) for m in lengths if not (room / bag_of(m)).exists()]
    if lacking and set(names) != {"replay"}:
        used((*ITSELF, "--simulate", str(room), "--minutes", *lacking))
    for length in lengths if "replay" in names else ():
        path = room / f"rest_{60.0 * length:.0f}"
        if not path.exists():
            used((*ITSELF, "--rest", str(path), "--minutes", str(length)))
    print("command    minutes  processor  us/sample   MiB  MiB/min")
    for name in names:
        began = time.time()
        start = used(commands(room, BEGINNING)[name])
        before = BEGINNING, start
        for length in minutes:
            result = used(commands(room, length)[name])
            print(reported(name, length, result, start, before), flush=True)
            figures.append({"command": name, "minutes": length, **result._asdict()})
            goal = name == "smooth" and length == GOAL_MINUTES
            missed |= goal and (result.seconds > GOAL_S or result.mib > GOAL_MIB)
            before = length, result
        figures[-1]["wall_s"] = time.time() - began
    return figures, missed


if __name__ == "__main__":
    main()
