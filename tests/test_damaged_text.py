"""Names in tables that are not UTF-8, as after a bit error, are refused in one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from online_log import online_log
from test_field_map_file import _map

from magfusion.errors import InputError
from magfusion.files.field_map import read_field_maps, write_field_maps
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.readings_table import DEGC, PART, read_temperatures, write_readings
from magfusion.files.survey import read_survey
from magfusion.model.samples import Log


def _damage(path: Path, name: str) -> None:
    """Set the bytes of a text column's first value."""
    table = pa.parquet.read_table(path)
    texts = [b"\xff\xfe", *(text.encode() for text in table[name].to_pylist()[1:])]
    offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
    buffers = [None, pa.py_buffer(offsets.tobytes()), pa.py_buffer(b"".join(texts))]
    column = pa.Array.from_buffers(pa.string(), len(texts), buffers)
    pa.parquet.write_table(table.set_column(table.column_names.index(name), name, column), path)


def _field_map(place: Path) -> tuple[Path, str, Callable[[], object]]:
    path = place / "map.parquet"
    write_field_maps({"A": _map(1, 5)}, path)
    return path, "beacon", lambda: read_field_maps(path)


def _fields(place: Path) -> tuple[Path, str, Callable[[], object]]:
    walk = online_log(3, 4.0)
    write_log(Log("walk", 0, "test", walk.imu, None, walk.fields), place / "log")
    return place / "log" / "fields.parquet", "beacon", lambda: open_log(place / "log")


def _temperatures(place: Path) -> tuple[Path, str, Callable[[], object]]:
    path = place / "temperature.parquet"
    write_readings({"A": np.array([[0.0, 1.0], [20.0, 21.0]])}, path, 0, DEGC)
    return path, PART, lambda: read_temperatures(path, 0)


@pytest.mark.parametrize("write", [_field_map, _fields, _temperatures])
def test_a_damaged_name_is_refused(
    write: Callable[[Path], tuple[Path, str, Callable[[], object]]], tmp_path: Path
) -> None:
    path, name, read = write(tmp_path)
    read()
    _damage(path, name)
    with pytest.raises(InputError, match=r"(?i)utf-?8") as refused:
        read()
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_damaged_head_of_a_csv_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    path.write_bytes(b"\xd4point,position_x\n1,2.0\n")
    with pytest.raises(InputError, match=r"survey\.csv: is no readable survey .*write it again"):
        read_survey(path)


@pytest.mark.parametrize("weight", [1e300, 1e15])
def test_a_map_far_from_its_model_is_refused(weight: float, tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    result = _map(1, 5)
    result.weights[2, 0] = weight
    write_field_maps({"A": result}, path)
    with pytest.raises(InputError, match=r"the map of A deviates .*; learn it again"):
        read_field_maps(path)
