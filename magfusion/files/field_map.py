"""Field maps as one Parquet file: a row for each beacon and surveyed point."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.plain_table import refuse_damaged_text
from magfusion.model.field_map import COMPONENTS, FieldMap
from magfusion.units import Array

MAX_DEVIATION = 3.0  # logarithm of the gain, or rad; a factor of 20 or half a turn
_POSITION = ("position_x", "position_y", "position_z")
_WEIGHTS = tuple(f"weight_{i}" for i in range(COMPONENTS))
_UPPER = tuple(zip(*np.triu_indices(COMPONENTS), strict=True))
_INFORMATION = tuple(f"information_{i}{j}" for i, j in _UPPER)
_PROCESS = ("length_scale", "gain_sigma", "rotation_sigma", "residual")  # m, 1, rad, 1
_NUMBERS = (*_POSITION, *_WEIGHTS, *_INFORMATION, *_PROCESS)


def write_field_maps(maps: dict[str, FieldMap], path: Path) -> None:
    """Write the maps of beacons by name."""
    parts = [_columns(name, result) for name, result in maps.items()]
    table = pa.table({k: np.concatenate([p[k] for p in parts]) for k in ("beacon", *_NUMBERS)})
    with whole_file(path) as unfinished:
        pa.parquet.write_table(table, unfinished)


def _columns(name: str, result: FieldMap) -> dict[str, Array]:
    count = len(result.points_world)
    columns = {"beacon": np.full(count, name, dtype=object)}
    columns |= dict(zip(_POSITION, result.points_world.T, strict=True))
    columns |= dict(zip(_WEIGHTS, result.weights.T, strict=True))
    upper = result.information[:, *np.triu_indices(COMPONENTS)]
    columns |= dict(zip(_INFORMATION, upper.T, strict=True))
    return columns | {k: np.full(count, getattr(result, k)) for k in _PROCESS}


def _table(path: Path) -> pa.Table:
    """Return the table of a file that has the columns of field maps."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such field map; learn it by calibrate fieldmap.")
    try:
        table = pa.parquet.read_table(path)
        refuse_damaged_text(table)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is no field map ({reason}); learn it again.") from error
    missing = [k for k in ("beacon", *_NUMBERS) if k not in table.column_names]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; learn the field map again.")
    return table


def read_field_maps(path: Path) -> dict[str, FieldMap]:
    """Read the maps of beacons by name.

    Raises InputError where the file is missing or unreadable, lacks a column, or holds what no map
    holds.
    """
    table = _table(path)
    try:
        number = {k: np.asarray(table[k].to_numpy(), dtype=np.float64) for k in _NUMBERS}
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: a column holds no numbers; learn the field map again."
        ) from error
    for k, value in number.items():
        if not np.all(np.isfinite(value)) or (k in _PROCESS and not np.all(value > 0.0)):
            raise InputError(f"{path}: column {k} holds what no map does; learn it again.")
    beacon = np.array([str(name) for name in table["beacon"].to_pylist()], dtype=object)
    if len(beacon) == 0:
        raise InputError(f"{path}: holds no rows; learn the field map again.")
    names = list(dict.fromkeys(beacon))
    maps = {name: _map({k: v[beacon == name] for k, v in number.items()}) for name in names}
    for name, result in maps.items():
        with np.errstate(over="ignore", invalid="ignore"):
            largest = float(np.max(np.abs(result.mean(result.points_world)[0])))
        if not largest <= MAX_DEVIATION:
            raise InputError(
                f"{path}: the map of {name} deviates from the model by {largest:.3g} (logarithm of"
                " the gain, or rad); learn it again."
            )
    return maps


def _map(number: dict[str, Array]) -> FieldMap:
    count = len(number["residual"])
    information = np.empty((count, COMPONENTS, COMPONENTS))
    for name, (i, j) in zip(_INFORMATION, _UPPER, strict=True):
        information[:, i, j] = information[:, j, i] = number[name]
    return FieldMap(
        points_world=np.stack([number[k] for k in _POSITION], axis=1),
        weights=np.stack([number[k] for k in _WEIGHTS], axis=1),
        information=information,
        **{k: float(number[k][0]) for k in _PROCESS},
    )
