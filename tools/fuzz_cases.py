"""Cases for `fuzz`: an input, mutations that know its structure, and the command that reads it."""

import base64
import copy
import json
import math
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import yaml
from hypothesis import strategies as st

from magfusion.files.site import save_site
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.simulation.demo_site import demo_site

Case = dict[str, Any]  # plain data, so that it can be kept

EPOCH_NS = 1_700_000_000_000_000_000
SAMPLES = 120
HOSTILE = [
    0, 1, -1, 2, 0.5, 1e-300, -1e-300, 1e300, -1e300, 1e308, 1e9, -1e9, 1e6, 1e-9, 1e-6, 1e3, 1e15,
    math.pi, 2**31, 2**63, -(2**63), "NaN", "inf", "-inf", None, True, "", "x", "A", [], {},
    [0, 0, 0], [1e300, 0, 0], [[1, 0, 0]] * 3, "1e5", "2020-02-30",
]  # fmt: skip
WORDS = {"NaN": math.nan, "inf": math.inf, "-inf": -math.inf}
NUMBERS = [v for v in HOSTILE if isinstance(v, int | float) and not isinstance(v, bool)]
TABLES = {
    "imu": ("time_ns", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"),
    "magnetometer": ("time_ns", "field_x", "field_y", "field_z"),
}
_SITE = ("navigate - --site SITE", "demodulate LOG -o OUT", "coverage SITE -o OUT --spacing 3")
COMMANDS = ("replay LOG", "demodulate LOG -o OUT", "check LOG -o OUT")


def example_inputs(place: Path) -> Path:
    """Write a site, a short log, and a checkpoint of a pipe; return their directory."""
    import io

    log = place / "log"
    log.mkdir(parents=True)
    site = demo_site()
    save_site(site, log / "site.yaml")
    header = {"magfusion_log": 1, "name": "log", "epoch_ns": EPOCH_NS, "source": "fuzz"}
    (log / "log.yaml").write_text(yaml.safe_dump(header))
    rng = np.random.default_rng(0)
    for stem, names in TABLES.items():
        values = {name: 0.01 * rng.normal(size=SAMPLES) for name in names[1:]}
        if stem == "imu":
            values["accel_z"] += 9.81
        else:
            values = {name: 1e-5 + 1e-6 * v for name, v in values.items()}
        time_ns = EPOCH_NS + 5_000_000 * np.arange(SAMPLES)
        pa.parquet.write_table(pa.table({"time_ns": time_ns} | values), log / f"{stem}.parquet")
    settings = StreamSettings(checkpoint=place / "state.bin", every=0.1)
    given = b"".join(json.dumps(r).encode() + b"\n" for r in records())
    run_stream(log / "site.yaml", settings, io.BytesIO(given), io.BytesIO(), io.StringIO())
    return place


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


# What is drawn --------------------------------------------------------------------------------

_place = st.lists(st.integers(0, 40), min_size=1, max_size=7)
_change = st.fixed_dictionaries(
    {
        "place": _place,
        "how": st.sampled_from(["set", "remove", "rename", "repeat"]),
        "value": st.sampled_from(HOSTILE) | st.floats(allow_nan=False, allow_infinity=False),
    }
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
        "column": st.integers(0, 6),
        "how": st.sampled_from(
            ["set", "all", "scale", "drop", "type", "twice", "jump", "nan", "shuffle", "cut"]
        ),
        "row": st.integers(0, SAMPLES - 1),
        "count": st.integers(1, SAMPLES),
        "value": st.sampled_from(NUMBERS) | st.floats(allow_nan=False, allow_infinity=False),
    }
)
_OPTIONS = (
    "--start", "--end", "--window", "--step", "--mains-hz", "--lag", "--delay", "--every", "--risk",
    "--fault-prior", "--spacing", "--height", "--box", "--duration", "--seed", "--iron",
    "--estimate",
    "--topics", "--robust", "--format", "--hours", "--worlds", "--site", "-o", "--trajectory",
)  # fmt: skip
_OF = (
    "smooth LOG -o OUT", "fix LOG -o OUT", "navigate LOG -o OUT", "replay LOG", "check LOG -o OUT",
    "demodulate LOG -o OUT", "coverage SITE -o OUT", "simulate -o OUT --duration 1",
    "survey LOG -o OUT", "match LOG -o OUT", "drift -o OUT --hours 0.01", "evaluate LOG LOG",
    "calibrate log LOG -o OUT", "calibrate magnetometer LOG -o OUT", "view LOG", "frobnicate",
)  # fmt: skip
_option = st.tuples(
    st.sampled_from(_OPTIONS),
    st.sampled_from([*map(str, NUMBERS), "nan", "inf", "-inf", "", "x", "0,1,0,1,0,1", "LOG", "/"])
    | st.lists(st.sampled_from([*map(str, NUMBERS[:14]), "nan"]), min_size=2, max_size=6).map(
        ",".join
    )
    | st.text(max_size=8).filter(lambda t: "\0" not in t and t.isprintable()),
)
_few = {"min_size": 1, "max_size": 3}


def strategy() -> st.SearchStrategy[Case]:
    """Return what draws cases, the cheap kinds most often."""

    def kind(name: str, **parts: st.SearchStrategy[Any]) -> st.SearchStrategy[Case]:
        return st.fixed_dictionaries({"kind": st.just(name), **parts})

    form = st.sampled_from(["json", "msgpack"])
    going = st.booleans()
    return st.one_of(
        kind("site", changes=st.lists(_change, **_few), command=st.sampled_from(_SITE)),
        kind("site", changes=st.lists(_change, **_few), command=st.just(_SITE[0])),
        kind("site_bytes", changes=st.lists(_bytes, **_few), command=st.just(_SITE[0])),
        kind("header", changes=st.lists(_change, **_few)),
        kind(
            "table",
            stem=st.sampled_from(sorted(TABLES)),
            changes=st.lists(_column, **_few),
            csv=st.booleans(),
            command=st.sampled_from(COMMANDS),
        ),
        kind(
            "table_bytes",
            stem=st.sampled_from(sorted(TABLES)),
            changes=st.lists(_bytes, **_few),
            command=st.just(COMMANDS[0]),
        ),
        kind("stream", changes=st.lists(_change, **_few), form=form, keep_going=going),
        kind("stream", changes=st.lists(_change, **_few), form=form, keep_going=going),
        kind("stream_bytes", changes=st.lists(_bytes, **_few), form=form, keep_going=going),
        kind("checkpoint", changes=st.lists(_bytes, **_few)),
        kind("bag", changes=st.lists(_bytes, **_few), suffix=st.sampled_from([".mcap", ".db3"])),
        kind("options", command=st.sampled_from(_OF), options=st.lists(_option, **_few)),
    )


# What is made of it ---------------------------------------------------------------------------


def apply(  # noqa: C901 - one line a kind
    case: Case, inputs: Path, place: Path
) -> tuple[list[str], bytes]:
    """Write the input of a case into a directory; return the command's words and its input."""
    log = place / "log"
    log.mkdir()
    for path in (inputs / "log").iterdir():
        (log / path.name).write_bytes(path.read_bytes())
    site, words, given = log / "site.yaml", case.get("command", COMMANDS[0]), b""
    match case["kind"]:
        case "site":
            content = yaml.safe_load(site.read_text())
            for change in case["changes"]:
                _mutate(content, change)
            site.write_text(yaml.safe_dump(content))
        case "site_bytes":
            site.write_bytes(_corrupted(site.read_bytes(), case["changes"]))
        case "header":
            content = yaml.safe_load((log / "log.yaml").read_text())
            for change in case["changes"]:
                _mutate(content, change)
            (log / "log.yaml").write_text(yaml.safe_dump(content))
        case "table":
            _table(log, case)
        case "table_bytes":
            path = log / f"{case['stem']}.parquet"
            path.write_bytes(_corrupted(path.read_bytes(), case["changes"]))
        case "stream" | "stream_bytes":
            words, given = _stream(case)
        case "checkpoint":
            state = place / "state.bin"
            state.write_bytes(_corrupted((inputs / "state.bin").read_bytes(), case["changes"]))
            words = f"navigate - --site SITE --resume --checkpoint {state}"
        case "bag":
            bag = place / f"bag{case['suffix']}"
            start = b"\x89MCAP0\r\n" if case["suffix"] == ".mcap" else b"SQLite format 3\0"
            bag.write_bytes(_corrupted(start + bytes(200) + start, case["changes"]))
            words = f"replay {bag}"
    names = {"LOG": str(log), "SITE": str(site), "OUT": str(place / "out")}
    command = [names.get(word, word) for word in words.split()]
    for option, value in case.get("options", []):
        # Written only where a case is told to write.
        command += [] if option == "-o" and value == "/" else [option, names.get(value, value)]
    return command, given


def _mutate(content: Any, change: dict[str, Any]) -> None:
    """Change one value, deep in nested lists and mappings, at the place that numbers lead to."""
    for depth, number in enumerate(change["place"]):
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        if not keys:
            return
        key = keys[number % len(keys)]
        inner = content[key]
        if depth == len(change["place"]) - 1 or not isinstance(inner, dict | list) or not inner:
            _change_at(content, key, change)
            return
        content = inner


def _change_at(content: Any, key: Any, change: dict[str, Any]) -> None:
    value = change["value"]
    value = WORDS.get(value, value) if isinstance(value, str) else copy.deepcopy(value)
    match change["how"]:
        case "set":
            content[key] = value
        case "remove":
            del content[key]
        case "rename" if isinstance(content, dict):
            content[str(value)] = content.pop(key)
        case "repeat" if isinstance(content, list):
            content.extend(copy.deepcopy(content[key]) for _ in range(5))


def _corrupted(content: bytes, changes: list[dict[str, Any]]) -> bytes:
    for change in changes:
        at, value = int(change["at"] * len(content)), base64.b64decode(change["value"])
        match change["how"]:
            case "cut":
                content = content[:at]
            case "flip":
                content = content[:at] + value + content[at + len(value) :]
            case "insert":
                content = content[:at] + value + content[at:]
            case "double":
                content = content[:at] + content
    return content


def _table(log: Path, case: Case) -> None:
    path = log / f"{case['stem']}.parquet"
    columns = pa.parquet.read_table(path).to_pydict()
    for change in case["changes"]:
        _change_column(columns, change)
    try:
        table = pa.table(columns)
    except (pa.ArrowException, OverflowError, ValueError, TypeError):
        return
    if case["csv"]:
        path.unlink()
        pa.csv.write_csv(table, path.with_suffix(".csv"))
    else:
        pa.parquet.write_table(table, path)


def _change_column(  # noqa: C901 - one line a way
    columns: dict[str, Any], change: dict[str, Any]
) -> None:
    names = list(columns)
    if not names:
        return
    name, row, value = names[change["column"] % len(names)], change["row"], change["value"]
    column, rows = columns[name], slice(row, row + change["count"])
    whole = name == "time_ns"
    number = int(value) if whole and abs(value) < 2**63 else value
    match change["how"]:
        case "set" if row < len(column):
            column[row] = number
        case "all":
            column[:] = [number] * len(column)
        case "scale" if not whole and all(isinstance(v, float) for v in column):
            column[:] = [v * value for v in column]
        case "drop":
            del columns[name]
        case "type":
            column[:] = [str(v) for v in column]
        case "twice":
            for other in columns.values():
                other.extend(other[rows])
        case "jump" if whole and abs(value) < 2**40 and all(isinstance(v, int) for v in column):
            column[row:] = [v + int(value * 1e6) for v in column[row:]]
        case "nan" if not whole:
            column[rows] = [math.nan] * len(column[rows])
        case "shuffle":
            column.reverse()
        case "cut":
            for other in columns.values():
                del other[rows]


def _stream(case: Case) -> tuple[str, bytes]:
    words = f"navigate - --site SITE --format {case['form']}"
    words += " --keep-going" if case["keep_going"] else ""
    content: list[Any] = records()
    if case["kind"] == "stream":
        for change in case["changes"]:
            _mutate(content, change)
    write = _json if case["form"] == "json" else _msgpack
    given = b"".join(map(write, content))
    return words, given if case["kind"] == "stream" else _corrupted(given, case["changes"])


def _json(record: Any) -> bytes:
    return json.dumps(record).encode() + b"\n"


def _msgpack(record: Any) -> bytes:
    try:
        return msgpack.packb(record)
    except (OverflowError, ValueError):
        return b"\xc1"
