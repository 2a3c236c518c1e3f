"""Check distances between beacons and marks, measured by tape: CSV or Parquet."""

from pathlib import Path

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.plain_table import column, read_whole
from magfusion.model.check_distance import CheckDistance
from magfusion.units import Array

FROM, TO, MEASURED = "from", "to", "measured_m"


def read_distances(path: Path, names: frozenset[str], sigma: float) -> tuple[CheckDistance, ...]:
    """Read check distances; rows without a measurement are not used.

    `names`: beacons and marks of the site. `sigma`: of a distance (m).
    """
    table = read_whole(path, "table of check distances")
    ends = [[str(v) for v in column(table, one, path).to_pylist()] for one in (FROM, TO)]
    measured = _measured(table, path)
    result = []
    for row, (begin, end, value) in enumerate(zip(*ends, measured.tolist(), strict=True), 1):
        if np.isnan(value):
            continue
        for name in (begin, end):
            if name not in names:
                raise InputError(
                    f"{path}: row {row}: the site has no beacon or mark {name!r}; it has"
                    f" {', '.join(sorted(names))}"
                )
        if begin == end or not value > 0.0:
            raise InputError(
                f"{path}: row {row}: give two different names, and a distance above 0 m"
            )
        result.append(CheckDistance(begin, end, value, sigma))
    return tuple(result)


def _measured(table: pa.Table, path: Path) -> Array:
    """Return the measured distances (m), NaN where there is none yet."""
    values = column(table, MEASURED, path)
    try:
        return np.asarray(values.cast(pa.float64()).to_numpy(), dtype=np.float64)
    except pa.ArrowException:
        raise InputError(
            f"{path}: column {MEASURED} holds {values.type}; write numbers, or nothing where a"
            " distance is not measured"
        ) from None
