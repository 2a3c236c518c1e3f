"""The correlation of a calibration as one Parquet file: a row for each parameter."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.model.correlation import Component, Correlation
from magfusion.units import Array

_NAMES = ("group", "owner", "kind", "component")
_COLUMNS = (*_NAMES, "sigma", "correlation")
ROUNDING = 1e-9  # of a coefficient, and of the diagonal's one
MIN_EIGENVALUE = 1e-14  # eigenvalue of a correlation that can be inverted


def write_correlation(correlation: Correlation, sigma: Array, path: Path) -> None:
    """Write a correlation, with the sigmas that it was found with.

    `sigma` (n,): SI.
    """
    columns = dict(zip(_NAMES, zip(*correlation.parameters, strict=True), strict=True))
    table = pa.table(
        {name: list(column) for name, column in columns.items()}
        | {"sigma": sigma, "correlation": correlation.coefficients.tolist()}
    )
    with whole_file(path) as unfinished:
        pa.parquet.write_table(table, unfinished)


def read_correlation(path: Path) -> tuple[Correlation, Array]:
    """Read a correlation and the sigmas that it was found with.

    Raises InputError where the file is missing or unreadable, lacks a column, or holds no
    correlation.
    """
    again = "write the site again by smooth or calibrate log, or take the correlation out of it."
    if not path.is_file():
        raise InputError(f"{path}: there is no such correlation; {again}")
    try:
        table = pa.parquet.read_table(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is no correlation ({reason}); {again}") from error
    missing = [name for name in _COLUMNS if name not in table.column_names]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; {again}")
    try:
        rows = zip(*(table[name].to_pylist() for name in _NAMES), strict=True)
        parameters = tuple(Component(str(g), str(o), str(k), int(c)) for g, o, k, c in rows)
        sigma = np.array(table["sigma"].to_pylist(), dtype=np.float64)
        result = np.array(table["correlation"].to_pylist(), dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: a column holds no numbers; {again}") from error
    if not _is_correlation(result, len(parameters)) or len(set(parameters)) < len(parameters):
        raise InputError(f"{path}: holds what no correlation is; {again}")
    return Correlation(parameters, 0.5 * (result + result.T)), sigma


def _is_correlation(result: Array, size: int) -> bool:
    if size == 0 or result.shape != (size, size) or not np.all(np.isfinite(result)):
        return False
    uneven = max(np.max(np.abs(result - result.T)), np.max(np.abs(np.diagonal(result) - 1.0)))
    return bool(uneven < ROUNDING and np.linalg.eigvalsh(result)[0] > MIN_EIGENVALUE)
