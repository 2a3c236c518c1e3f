"""Check distances between beacons and marks, measured by tape: CSV or Parquet."""

from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.plain_table import column, numbers, read_whole
from magfusion.model.check_distance import CheckDistance

FROM, TO, MEASURED = "from", "to", "measured_m"


def read_distances(path: Path, names: frozenset[str], sigma: float) -> tuple[CheckDistance, ...]:
    """Read check distances.

    Parameters
    ----------
    names : frozenset of str
        Beacons and marks of the site.
    sigma : float
        Of a distance (m).

    Raises
    ------
    InputError
    """
    table = read_whole(path, "table of check distances")
    ends = [[str(v) for v in column(table, one, path).to_pylist()] for one in (FROM, TO)]
    measured = numbers(table, MEASURED, path)
    result = []
    for row, (begin, end, value) in enumerate(zip(*ends, measured.tolist(), strict=True), 1):
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
