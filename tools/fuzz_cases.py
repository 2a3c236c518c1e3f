"""Cases for `fuzz`: an input, mutations that know its structure, and the command that reads it."""

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import msgpack
import pyarrow.parquet
import yaml
from fuzz_changes import (
    HOSTILE,
    NUMBERS,
    change_column,
    change_state,
    change_table,
    change_yaml,
    corrupted,
    mutate,
)
from fuzz_inputs import EPOCH_NS, ESTIMATORS, MOTION, STREAMS
from hypothesis import strategies as st

Case = dict[str, Any]  # plain data, so that it can be kept

ROWS = 1400  # of the longest table
PIECE = 50  # rows of a stream in a record
FIELD = "--magnetometer tables/magnetometer.csv --map magnetometer.field=field_x,field_y,field_z[T]"
PIPE = "navigate - --site log/site.yaml"
READ = {  # commands by the input that is changed
    "log/site.yaml": (PIPE, "demodulate log -o OUT", "coverage log/site.yaml -o OUT --spacing 3"),
    "log/log.yaml": ("replay log",),
    "log/imu.parquet": ("replay log", "demodulate log -o OUT"),
    "log/magnetometer.parquet": ("replay log", "demodulate log -o OUT"),
    "log/temperature.parquet": ("replay log",),
    "log/truth.parquet": ("evaluate truth.tum log",),
    "phasors/fields.parquet": ("replay phasors",),
    "mapped/site_field_map.parquet": ("navigate - --site mapped/site.yaml",),
    "mapped/site.yaml": ("navigate - --site mapped/site.yaml",),
    "survey.parquet": ("calibrate beacon survey.parquet --site log/site.yaml -o OUT",),
    "survey.csv": ("calibrate beacon survey.csv --site log/site.yaml -o OUT",),
    "truth.tum": ("evaluate truth.tum log",),
    "wells/wells.yaml": (
        "simulate --site wells/site.yaml --wells wells/wells.yaml --duration 1 -o OUT",
    ),
    "wells/site.yaml": ("simulate --site wells/site.yaml --duration 1 -o OUT",),
    "tables/map.yaml": (f"import --imu tables/imu.csv {FIELD} --map-file tables/map.yaml -o OUT",),
    **{
        f"tables/imu.{kind}": (
            f"import --imu tables/imu.{kind} {FIELD} --map-file tables/map.yaml -o OUT",
        )
        for kind in ("csv", "npz", "mat")
    },
    "tables/imu.npy": (
        f"import --imu tables/imu.npy {FIELD} --map imu.time=0[ns] --map imu.gyro=1,2,3[rad/s]"
        " --map imu.accel=4,5,6[m/s^2] -o OUT",
    ),
    "tables/imu.wav": (
        f"import --imu tables/imu.wav {FIELD} --map imu.gyro=0,1,2[rad/s]"
        " --map imu.accel=3,4,5[m/s^2] -o OUT",
    ),
    "euroc/mav0/imu0/data.csv": ("replay euroc", "import euroc -o OUT"),
    "euroc/mav0/mag0/data.csv": ("replay euroc",),
    "euroc/mav0/state_groundtruth_estimate0/data.csv": ("replay euroc", "import euroc -o OUT"),
    "bag_mcap/bag_mcap.mcap": ("replay bag_mcap", "replay bag_mcap/bag_mcap.mcap"),
    "bag_sqlite3/bag_sqlite3.db3": ("replay bag_sqlite3", "replay bag_sqlite3/bag_sqlite3.db3"),
    "bag_ros1/bag_ros1.bag": ("replay bag_ros1/bag_ros1.bag",),
    "bag_mcap/metadata.yaml": ("replay bag_mcap",),
    "ekf.bin": (f"{PIPE} --resume --checkpoint ekf.bin --estimator ekf",),
    "smoother.bin": (f"{PIPE} --resume --checkpoint smoother.bin",),
}
# Jobs of seconds, each with the table that is most of what it reads.
JOBS = {
    "log/imu.parquet": (
        "navigate log -o OUT --estimator ekf", "navigate log -o OUT --rate imu",
        "smooth log -o OUT", "calibrate log log -o OUT", "allan log -o OUT", "check log -o OUT",
    ),
    "log/magnetometer.parquet": (
        "navigate log -o OUT", "fix log -o OUT", "check log -o OUT", "calibrate log log -o OUT",
        "calibrate magnetometer log -o OUT",
    ),
    "phasors/fields.parquet": (
        "navigate phasors -o OUT --estimator ekf", "smooth phasors -o OUT", "fix phasors -o OUT",
        "check phasors -o OUT",        "survey phasors --points epochs -o OUT",
    ),
    "log/truth.parquet": ("check log -o OUT", "survey log --points epochs -o OUT"),
    "survey.parquet": ("calibrate fieldmap survey.parquet --site log/site.yaml -o OUT",),
    "hall.yaml": (
        "design log/site.yaml --hall hall.yaml --beacons 1 --spacing 3 --grid 3 --starts 1"
        " --random 2 -o OUT",
    ),
    "mapped/site_field_map.parquet": ("fix phasors --site mapped/site.yaml -o OUT",),
    "log/site.yaml": ("smooth phasors --site log/site.yaml -o OUT",),
}  # fmt: skip
YAML = tuple(name for name in READ if name.endswith(".yaml"))
COLUMNS = tuple(name for name in READ if name.endswith((".parquet", ".csv")))


# What is drawn --------------------------------------------------------------------------------

_place = st.lists(st.integers(0, 40), min_size=1, max_size=7)
_value = st.sampled_from(HOSTILE) | st.floats(allow_nan=False, allow_infinity=False)
_change = st.fixed_dictionaries(
    {
        "place": _place,
        "how": st.sampled_from(["set", "remove", "rename", "repeat"]),
        "value": _value,
    }
)
_deep = st.tuples(_change, st.lists(st.integers(0, 40), min_size=8, max_size=8)).map(
    lambda pair: pair[0] | {"place": pair[1]}
)
_bytes = st.fixed_dictionaries(
    {
        "how": st.sampled_from(["cut", "flip", "insert", "double"]),
        "at": st.floats(0.0, 1.0),
        "value": st.binary(min_size=1, max_size=12).map(lambda b: base64.b64encode(b).decode()),
    }
)
_column = st.fixed_dictionaries(
    {
        "column": st.integers(0, 30),
        "how": st.sampled_from(
            ["set", "add", "all", "scale", "drop", "type", "text", "twice", "jump", "nan",
             "shuffle", "cut"]
        ),
        "row": st.integers(0, ROWS - 1),
        "count": st.integers(1, ROWS),
        "value": st.sampled_from(NUMBERS) | st.floats(allow_nan=False, allow_infinity=False),
    }
)  # fmt: skip
_OPTIONS = (
    "--start", "--end", "--window", "--step", "--mains-hz", "--lag", "--delay", "--every", "--risk",
    "--fault-prior", "--spacing", "--height", "--box", "--duration", "--seed", "--iron",
    "--estimate",
    "--topics", "--robust", "--format", "--hours", "--worlds", "--site", "-o", "--trajectory",
)  # fmt: skip
_OF = (
    "smooth log -o OUT", "fix log -o OUT", "navigate log -o OUT", "replay log", "check log -o OUT",
    "demodulate log -o OUT", "coverage log/site.yaml -o OUT", "simulate -o OUT --duration 1",
    "survey log -o OUT", "match log -o OUT", "drift -o OUT --hours 0.01", "evaluate log log",
    "calibrate log log -o OUT", "calibrate magnetometer log -o OUT", "view log", "frobnicate",
)  # fmt: skip
_option = st.tuples(
    st.sampled_from(_OPTIONS),
    st.sampled_from([*map(str, NUMBERS), "nan", "inf", "-inf", "", "x", "0,1,0,1,0,1", "log", "/"])
    | st.lists(st.sampled_from([*map(str, NUMBERS[:14]), "nan"]), min_size=2, max_size=6).map(
        ",".join
    )
    | st.text(max_size=8).filter(lambda t: "\0" not in t and t.isprintable()),
)


def _few(change: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(change, min_size=1, max_size=3)


def strategy() -> st.SearchStrategy[Case]:
    """Return what draws cases, the cheap kinds most often."""

    def kind(name: str, **parts: st.SearchStrategy[Any]) -> st.SearchStrategy[Case]:
        return st.fixed_dictionaries({"kind": st.just(name), **parts})

    def read(
        name: str, change: st.SearchStrategy[Any], files: Any = READ, jobs: Any = READ
    ) -> st.SearchStrategy[Case]:
        return st.sampled_from([(file, word) for file in files for word in jobs[file]]).flatmap(
            lambda pair: kind(
                name,
                file=st.just(pair[0]),
                command=st.just(pair[1]),
                changes=_few(change),
            )
        )

    pipe = {"form": st.sampled_from(["json", "msgpack"]), "keep_going": st.booleans()}
    records, corrupted = _few(_change), _few(_bytes)
    samples = kind(
        "samples",
        stream=st.sampled_from(sorted(STREAMS)),
        changes=_few(_column),
        estimator=st.sampled_from(ESTIMATORS),
        inertial=st.booleans(),
        **pipe,
    )
    job = read("columns", _column, [name for name in JOBS if name.endswith(".parquet")], JOBS)
    slow = st.one_of(
        samples, samples, job, read("yaml", _change, ["log/site.yaml", "hall.yaml"], JOBS)
    )
    cheap = st.one_of(
        read("yaml", _change, YAML),
        kind("yaml", file=st.just("log/site.yaml"), changes=records, command=st.just(PIPE)),
        read("columns", _column, COLUMNS),
        read("bytes", _bytes),
        kind("stream", changes=records, **pipe),
        kind("stream", changes=records, **pipe),
        kind("stream_bytes", changes=corrupted, **pipe),
        kind("state", changes=_few(_deep), estimator=st.sampled_from(ESTIMATORS)),
        kind("options", command=st.sampled_from(_OF), options=_few(_option)),
    )
    return st.integers(0, 39).flatmap(lambda k: cheap if k else slow)


# What is made of it ---------------------------------------------------------------------------


def apply(case: Case, inputs: Path, place: Path) -> tuple[list[str], bytes]:
    """Write the input of a case into a directory; return the command's words and its input."""
    words = case.get("command", PIPE)
    if case["kind"] in ("stream", "stream_bytes", "samples"):
        words += f" --format {case['form']}" + (" --keep-going" if case["keep_going"] else "")
    if case["kind"] == "samples":
        words += f" --estimator {case['estimator']}"
    if case["kind"] == "state":
        words = READ[f"{case['estimator']}.bin"][0]
    for top in {part.split("/")[0] for part in words.split()} & {p.name for p in inputs.iterdir()}:
        source, target = inputs / top, place / top
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)
    given = _given(case, inputs, place)
    command = [str(place / "out") if word == "OUT" else word for word in words.split()]
    for option, value in case.get("options", []):
        # Written only where a case is told to write.
        command += [] if option == "-o" and value == "/" else [option, value]
    return command, given


def _given(case: Case, inputs: Path, place: Path) -> bytes:
    """Change the input of a case; return what is on standard input."""
    match case["kind"]:
        case "yaml":
            change_yaml(place / case["file"], case["changes"])
        case "bytes":
            path = place / case["file"]
            path.write_bytes(corrupted(path.read_bytes(), case["changes"]))
        case "columns":
            change_table(place / case["file"], case["changes"])
        case "state":
            change_state(place / f"{case['estimator']}.bin", case["changes"])
            return (inputs / "rest.jsonl").read_bytes()
        case "stream" | "stream_bytes":
            return _stream(case)
        case "samples":
            if not case["inertial"]:
                _without_imu(place / "log" / "site.yaml")
            return _samples(case, inputs)
    return b""


def _without_imu(path: Path) -> None:
    """Declare a motion in place of the IMU."""
    content = yaml.safe_load(path.read_text())
    del content["platform"]["imu"]
    content["platform"]["motion_prior"] = MOTION
    path.write_text(yaml.safe_dump(content))


def records() -> list[dict[str, Any]]:
    """Return records of half a second of rest."""
    out: list[dict[str, Any]] = []
    for k in range(10):
        time = [0.05 * k + 0.005 * i for i in range(10)]
        still = [[0.001 * (i % 3), 0.0, 0.0] for i in range(10)]
        force = [[0.0, 0.01 * (i % 2), 9.81] for i in range(10)]
        field = [[1e-6, 1.9e-5 + 1e-8 * (i % 5), -4.5e-5] for i in range(10)]
        out.append({"imu": {"time": time, "gyro": still, "accel": force}})
        out.append({"magnetometer": {"time": time, "field": field}})
    vector = [[1e-7, 0.0, 0.0], [0.0, 1e-7, 0.0]]
    fields = {"time": 0.3, "window": 0.4, "sigma": 1e-9, "phasors": {"A": [vector]}}
    return [*out, {"fields": fields}]


def _stream(case: Case) -> bytes:
    content: list[Any] = records()
    if case["kind"] == "stream":
        for change in case["changes"]:
            mutate(content, change)
    given = _written(content, case["form"])
    return given if case["kind"] == "stream" else corrupted(given, case["changes"])


def _samples(case: Case, inputs: Path) -> bytes:
    """Return a walk in records, of which the columns of one stream are changed."""
    pieces: list[tuple[float, dict[str, Any]]] = []
    for stream, parts in STREAMS.items():
        columns = pyarrow.parquet.read_table(inputs / "log" / f"{stream}.parquet").to_pydict()
        if stream == case["stream"]:
            for change in case["changes"]:
                if change["how"] not in ("drop", "type", "text"):
                    change_column(columns, change)
        count = len(columns["time_ns"])
        for k in range(0, count, PIECE):
            rows = slice(k, k + PIECE)
            time = [1e-9 * (t - EPOCH_NS) for t in columns["time_ns"][rows]]
            axes = {
                part: [
                    list(row) for row in zip(*(columns[name][rows] for name in names), strict=True)
                ]
                for part, names in parts.items()
            }
            pieces.append((k / count, {stream: {"time": time, **axes}}))
    if not case["inertial"]:
        pieces = [piece for piece in pieces if "imu" not in piece[1]]
    pieces.sort(key=lambda piece: piece[0])
    return _written([record for _, record in pieces], case["form"])


def _written(content: list[Any], form: str) -> bytes:
    return b"".join(map(_json if form == "json" else _msgpack, content))


def _json(record: Any) -> bytes:
    return json.dumps(record).encode() + b"\n"


def _msgpack(record: Any) -> bytes:
    try:
        return msgpack.packb(record)
    except (OverflowError, ValueError):
        return b"\xc1"
