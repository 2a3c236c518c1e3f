"""Gyro and accelerometer of two tables, sampled each at its own times, become one stream."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.foreign.convert import Counts
from magfusion.files.table import ROWS_PER_GROUP, TIME
from magfusion.units import NANOSECOND, Array, IntArray

HALVES = ("gyro", "accel")
UNCOVERED = "outside of the other half's table"
MIN_RATE_RATIO = 0.9  # of a rate; where both are alike, the gyro's samples are kept
MAX_STEPS = 3.5  # of the slower half, between which it is interpolated; farther is missing


@dataclass(frozen=True)
class Joined:
    """The stream that two halves make.

    `note`: which half was interpolated; empty where both have the same stamps.
    """

    counts: Counts
    note: str


def join_halves(directory: Path, counts: dict[str, Counts]) -> Joined:
    """Write ``imu.parquet`` from ``gyro.parquet`` and ``accel.parquet``, and remove these.

    The samples are those of the faster half; the slower one is interpolated linearly, which keeps
    its response at frequencies that it resolves. Raises InputError where they have no moment in
    common.
    """
    gyro_leads = _rate(counts["gyro"]) > MIN_RATE_RATIO * _rate(counts["accel"])
    fast, slow = HALVES if gyro_leads else HALVES[::-1]
    paths = {half: directory / f"{half}.parquet" for half in HALVES}
    begin, end = _in_common(counts)
    names = [f"{half}_{axis}" for half in HALVES for axis in "xyz"]
    schema = pa.schema([(TIME, pa.int64()), *((name, pa.float64()) for name in names)])
    built = Counts(read=counts[fast].read)
    reach = round(MAX_STEPS * 1e9 / _rate(counts[slow]))  # ns
    exact = True
    options = {"compression": "zstd", "write_page_checksum": True}
    with pa.parquet.ParquetWriter(directory / "imu.parquet", schema, **options) as writer:
        for stamps, own in _parts(paths[fast], fast):
            inside = (stamps >= begin) & (stamps <= end)
            built.leave_out(UNCOVERED, int(np.sum(~inside)))
            stamps, own = stamps[inside], own[inside]
            if not len(stamps):
                continue
            other, same = _interpolated_half(paths[slow], slow, stamps, reach)
            exact &= same
            halves = {fast: own, slow: other}
            values = np.concatenate([halves[half] for half in HALVES], axis=1)
            built.missing += int(np.sum(np.isnan(values).any(axis=1)))
            built.written += len(stamps)
            built.first = min(built.first, int(stamps[0]))
            built.last = max(built.last, int(stamps[-1]))
            columns = dict(zip(schema.names, [stamps, *values.T], strict=True))
            writer.write_table(pa.table(columns), row_group_size=ROWS_PER_GROUP)
    for path in paths.values():
        path.unlink()
    note = (
        f"The {slow} was interpolated linearly to the times of the {fast}: they are of two tables,"
        " and sampled apart."
    )
    return Joined(built, "" if exact else note)


def _in_common(counts: dict[str, Counts]) -> tuple[int, int]:
    """Return from when to when both halves have samples (ns)."""
    begin = max(counts[half].first for half in HALVES)
    end = min(counts[half].last for half in HALVES)
    if begin > end:
        spans = (
            f"{h} {counts[h].first * NANOSECOND:.9g} to {counts[h].last * NANOSECOND:.9g} s"
            for h in HALVES
        )
        raise InputError(
            f"the times of gyro and accel have no moment in common ({', '.join(spans)}): bring them"
            " to one clock, by the unit of a time or --offset TABLE=SECONDS."
        )
    return begin, end


def _rate(counts: Counts) -> float:
    """Return the mean rate of a table (Hz)."""
    span = (counts.last - counts.first) * NANOSECOND
    return (counts.written - 1) / span if span > 0.0 else np.inf


def _parts(path: Path, half: str) -> Iterator[tuple[IntArray, Array]]:
    file = pa.parquet.ParquetFile(path, pre_buffer=False)
    for group in range(file.num_row_groups):
        yield _arrays(file.read_row_group(group), half)


def _arrays(table: pa.Table, half: str) -> tuple[IntArray, Array]:
    values = np.stack([table[f"{half}_{axis}"].to_numpy() for axis in "xyz"], axis=1)
    return table[TIME].to_numpy(), values


def _interpolated_half(path: Path, half: str, stamps: IntArray, reach: int) -> tuple[Array, bool]:
    """Return a half at other stamps, and whether all of them are its own."""
    low, high = int(stamps[0]) - reach, int(stamps[-1]) + reach
    near = (pc.field(TIME) >= low) & (pc.field(TIME) <= high)
    known, values = _arrays(pa.parquet.read_table(path, filters=near), half)
    whole = np.isfinite(values).all(axis=1)
    known, values = known[whole], values[whole]
    if not len(known):
        return np.full((len(stamps), 3), np.nan), False
    after = np.clip(np.searchsorted(known, stamps), 0, len(known) - 1)
    same = known[after] == stamps
    before = np.where(same, after, np.maximum(after - 1, 0))
    # Differences of stamps first: doubles do not hold them since 1970.
    result = np.stack(
        [np.interp((stamps - low).astype(float), (known - low).astype(float), v) for v in values.T],
        axis=1,
    )
    outside = (known[after] < stamps) | (known[before] > stamps)
    result[outside | (known[after] - known[before] > reach)] = np.nan
    return result, bool(np.all(same))
