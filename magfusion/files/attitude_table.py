"""Attitudes as tables: the database that a field vector is looked up in, and what was found."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from pydantic import Field, ValidationError

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.plausible import check_field
from magfusion.files.table import TIME, Span, write_table
from magfusion.files.yaml_files import StrictModel
from magfusion.units import DEGREE, Array, BoolArray

Angles = Literal["roll", "roll-pitch"]
ANGLES: tuple[str, ...] = get_args(Angles)
MIN_ENTRIES = 12  # a plane through nine neighbours, and some to choose them from

_FORMAT = "magfusion_attitude_database"
_FIELD = ("field_x", "field_y", "field_z")
_RPY = ("roll_deg", "pitch_deg", "yaw_deg")
_LIMIT_DEG = (180.0, 90.0, 180.0)
_COLUMNS = (*_FIELD, *_RPY)


@dataclass(frozen=True, eq=False)
class AttitudeDatabase:
    """Field vectors of one place, and the attitude at which each was measured."""

    field_body: Array  # (n, 3) (T), calibrated
    rpy: Array  # (n, 3), roll, pitch, yaw (rad): ``world_from_body = Rz(yaw) Ry(pitch) Rx(roll)``
    angles: Angles  # what varies; the others have one value throughout
    source: str  # log from which it was built

    def __len__(self) -> int:
        return len(self.field_body)


class _Header(StrictModel):
    version: Literal[1]
    angles: Angles
    source: str = Field(max_length=1000)


def write_database(database: AttitudeDatabase, path: Path) -> None:
    """Write a database as one Parquet file, with its kind in the file's metadata."""
    columns = dict(zip(_FIELD, database.field_body.T, strict=True))
    columns |= dict(zip(_RPY, database.rpy.T / DEGREE, strict=True))
    header = _Header(version=1, angles=database.angles, source=database.source)
    table = pa.table(columns).replace_schema_metadata({_FORMAT: header.model_dump_json()})
    with whole_file(path) as unfinished:
        pa.parquet.write_table(table, unfinished, compression="zstd", write_page_checksum=True)


def read_database(path: Path) -> AttitudeDatabase:
    """Read and check a database.

    Raises InputError where the file is absent, is no such database or of another version, holds too
    few entries, or a number that is not finite, no angle or no field of the Earth.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give an attitude database (Parquet).")
    try:
        with pa.parquet.ParquetFile(path, page_checksum_verification=True) as file:
            metadata_json = (file.schema_arrow.metadata or {}).get(_FORMAT.encode())
            header = _header(metadata_json, path)
            _check_columns(file.schema_arrow, path)
            table = file.read(columns=list(_COLUMNS))
    except (pa.ArrowException, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: cannot be read as Parquet ({reason}); build it again."
        ) from error
    if len(table) < MIN_ENTRIES:
        raise InputError(
            f"{path}: holds {len(table)} entries; build it from a log with at least"
            f" {MIN_ENTRIES} different attitudes."
        )
    values = {name: _numbers(table, name, path) for name in _COLUMNS}
    for name, limit in zip(_RPY, _LIMIT_DEG, strict=True):
        far = np.abs(values[name]) > limit * (1.0 + 1e-9)
        _refuse(far, path, name, values[name], f"an angle of at most {limit:g} degrees")
    field_body = np.stack([values[name] for name in _FIELD], axis=1)
    check_field(np.linalg.norm(field_body, axis=1), str(path))
    rpy = np.stack([values[name] for name in _RPY], axis=1) * DEGREE
    return AttitudeDatabase(field_body, rpy, header.angles, header.source)


def write_attitudes(
    path: Path,
    epoch_ns: int,
    time: Array,
    rpy: Array,
    sigma: Array,
    residual: Array,
    determined: BoolArray,
) -> None:
    """Write the attitudes that each epoch's field allows, as Parquet, the usual one first.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    rpy : ndarray, shape (n, hypotheses, 3)
        (rad); NaN where there is no such hypothesis.
    sigma : ndarray, shape (n, hypotheses, 3)
        (rad); zero for an angle that was given.
    residual : ndarray, shape (n, hypotheses)
        Distance of the measured field from the matched one (T).
    determined : bool ndarray, shape (n, hypotheses)
    """
    epoch, rank = np.nonzero(np.isfinite(rpy[..., 0]))
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[epoch]), "hypothesis": rank}
    columns |= dict(zip(_RPY, rpy[epoch, rank].T / DEGREE, strict=True))
    names = (name.replace("_deg", "_sigma_deg") for name in _RPY)
    columns |= dict(zip(names, sigma[epoch, rank].T / DEGREE, strict=True))
    columns |= {"residual_t": residual[epoch, rank], "determined": determined[epoch, rank]}
    write_table(columns, path)


def _header(metadata_json: bytes | None, path: Path) -> _Header:
    if metadata_json is None:
        raise InputError(
            f"{path}: is no attitude database; build one by magfusion calibrate attitude-database."
        )
    try:
        return _Header.model_validate_json(metadata_json)
    except ValidationError:
        raise InputError(
            f"{path}: is an attitude database of another version; build it again by magfusion"
            " calibrate attitude-database."
        ) from None


def _check_columns(schema: pa.Schema, path: Path) -> None:
    for name in _COLUMNS:
        if schema.names.count(name) != 1:
            raise InputError(f"{path}: column {name} is missing or repeated; build the file again.")
        if not pa.types.is_floating(schema.field(name).type):
            result = schema.field(name).type
            raise InputError(f"{path}: column {name} holds {result}; build the file again.")


def _numbers(table: pa.Table, name: str, path: Path) -> Array:
    value = np.asarray(table[name].to_numpy(), dtype=np.float64)
    _refuse(~np.isfinite(value), path, name, value, "a finite number")
    return value


def _refuse(bad: BoolArray, path: Path, name: str, value: Array, wanted: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{path}: column {name}, row {row} (counted from 0): found {value[row]};"
            f" write {wanted}."
        )
