"""What `fuzz` changes in an input whose structure it knows, and in bytes of any."""

import base64
import contextlib
import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import yaml

from magfusion.files.checkpoint import Checkpoint, read_checkpoint, write_checkpoint

HOSTILE = [
    0, 1, -1, 2, 0.5, 1e-300, -1e-300, 1e300, -1e300, 1e308, 1e9, -1e9, 1e6, 1e-9, 1e-6, 1e3, 1e15,
    1e12, -1e19,
    math.pi, 2**31, 2**63, -(2**63), "NaN", "inf", "-inf", None, True, "", "x", "A", [], {},
    [0, 0, 0], [1e300, 0, 0], [[1, 0, 0]] * 3, "1e5", "2020-02-30", "x" * 70_000,
]  # fmt: skip
WORDS = {"NaN": math.nan, "inf": math.inf, "-inf": -math.inf}
NUMBERS = [v for v in HOSTILE if isinstance(v, int | float) and not isinstance(v, bool)]


def change_yaml(path: Path, changes: list[dict[str, Any]]) -> None:
    """Change values of a YAML file."""
    content = yaml.safe_load(path.read_text())
    for change in changes:
        mutate(content, change)
    path.write_text(yaml.safe_dump(content))


def change_state(path: Path, changes: list[dict[str, Any]]) -> None:
    """Change the content of a checkpoint, and sign it again."""
    whole = read_checkpoint(path)
    assert whole is not None
    content = whole.content
    for change in changes:
        mutate(content, change)
    try:
        write_checkpoint(Checkpoint(whole.key, whole.position, content), path)
    except (TypeError, ValueError, OverflowError):
        return  # no checkpoint holds that


def mutate(content: Any, change: dict[str, Any]) -> None:
    """Change one value, deep in nested lists and mappings, at the place that numbers lead to."""
    for depth, number in enumerate(change["place"]):
        if isinstance(content, np.ndarray):
            _change_array(content, number, change["value"])
            return
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        if not keys:
            return
        key = keys[number % len(keys)]
        inner = content[key]
        collection = isinstance(inner, dict | list | np.ndarray) and len(inner)
        if depth == len(change["place"]) - 1 or not collection:
            _change_at(content, key, change)
            return
        content = inner


def _change_array(content: np.ndarray, number: int, value: Any) -> None:
    """Change a number of an array, where it holds such numbers."""
    flat = content.reshape(-1)
    with np.errstate(all="ignore"), contextlib.suppress(TypeError, ValueError, OverflowError):
        flat[number % len(flat)] = WORDS.get(value, value) if isinstance(value, str) else value


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


def corrupted(content: bytes, changes: list[dict[str, Any]]) -> bytes:
    """Return content of which bytes are changed."""
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


def change_table(path: Path, changes: list[dict[str, Any]]) -> None:
    """Change columns of a table, where it then can be written."""
    is_csv = path.suffix == ".csv"
    read = pa.csv.read_csv if is_csv else pa.parquet.read_table
    columns = read(path).to_pydict()
    for change in changes:
        change_column(columns, change)
    try:
        table = pa.table(columns)
        (pa.csv.write_csv if is_csv else pa.parquet.write_table)(table, path)
    except (pa.ArrowException, OverflowError, ValueError, TypeError):
        return


def change_column(columns: dict[str, Any], change: dict[str, Any]) -> None:
    """Change the columns of a table, as lists, in place."""
    names = list(columns)
    if not names:
        return
    name, row = names[change["column"] % len(names)], change["row"]
    rows = slice(row, row + change["count"])
    if change["how"] in ("drop", "twice", "cut"):
        _change_table(columns, change["how"], name, rows)
    else:
        _change_values(columns[name], change, rows, whole=name == "time_ns")


def _change_table(columns: dict[str, Any], how: str, name: str, rows: slice) -> None:
    if how == "drop":
        del columns[name]
        return
    for column in columns.values():
        if how == "twice":
            column.extend(column[rows])
        else:
            del column[rows]


def _change_values(column: list[Any], change: dict[str, Any], rows: slice, *, whole: bool) -> None:
    """Change the values of a column; one of times holds whole numbers."""
    row, value = rows.start, change["value"]
    number = int(value) if whole and abs(value) < 2**63 else value
    is_number = all(isinstance(v, int | float) for v in column)
    match change["how"]:
        case "set" if row < len(column):
            column[row] = number
        case "add" if is_number:
            column[rows] = [v + number for v in column[rows]]
        case "all":
            column[:] = [number] * len(column)
        case "scale" if not whole and all(isinstance(v, float) for v in column):
            column[:] = [v * value for v in column]
        case "type":
            column[:] = [str(v) for v in column]
        case "text" if row < len(column):
            hostile = HOSTILE[change["count"] % len(HOSTILE)]
            column[:] = [str(hostile if k == row else v) for k, v in enumerate(column)]
        case "jump" if whole and abs(value) < 2**40 and is_number:
            column[row:] = [v + int(value * 1e6) for v in column[row:]]
        case "nan" if not whole:
            column[rows] = [math.nan] * len(column[rows])
        case "shuffle":
            column.reverse()
