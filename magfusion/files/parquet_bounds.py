"""Bounds on rows in memory of a Parquet file: a small one may have billions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.errors import InputError

MAX_ROWS = 10_000_000  # nine hours at 300 Hz; what is made of them takes 2 GiB
MAX_BYTES = 1 << 30  # of a CSV, and of what a group of rows unfolds to
BATCH = 1 << 17  # rows decoded at once


def refuse_unfolding(
    file: pa.parquet.ParquetFile, names: list[str], groups: Sequence[Any], path: Path
) -> None:
    """Refuse columns of lists and the like, and what a little file unfolds to beyond the memory."""
    for name in names:
        result = file.schema_arrow.field(name).type
        if pa.types.is_nested(result):
            raise InputError(f"{path}: column {name} holds {result}; write numbers or text.")
    for group in groups:
        size = sum(
            group.column(k).total_uncompressed_size
            for k in range(group.num_columns)
            if group.column(k).path_in_schema in names
        )
        if size > MAX_BYTES:
            raise InputError(
                f"{path}: {group.num_rows} rows unfold to {size >> 20} MiB; write groups of at most"
                f" {MAX_BYTES >> 20} MiB."
            )


def read_batches(
    file: pa.parquet.ParquetFile,
    names: list[str],
    groups: range,
    bounds_ns: tuple[int, int],
    path: Path,
    skipped: int,
) -> tuple[pa.Table, int]:
    """Return the rows of a span of a file with more rows than are kept in memory.

    `skipped`: rows of the file before these groups. Raises InputError where the span has too many
    rows, too. Returns also in which row of the file the table begins.
    """
    begin, end = bounds_ns
    kept: list[pa.RecordBatch] = []
    count, first, row = 0, skipped, skipped
    for batch in file.iter_batches(BATCH, row_groups=list(groups), columns=names):
        time_ns = batch.column(names.index("time_ns")).fill_null(0).to_numpy(zero_copy_only=False)
        inside = np.flatnonzero((time_ns >= begin) & (time_ns < end))
        if len(inside):
            if not kept:
                first = row + int(inside[0])
            kept.append(batch.slice(inside[0], inside[-1] + 1 - inside[0]))
            count += len(kept[-1])
        if count > MAX_ROWS:
            raise InputError(
                f"{path}: holds more than {MAX_ROWS} rows in the part to use; use a shorter one,"
                " by --start and --end."
            )
        row += len(batch)
    schema = pa.schema([file.schema_arrow.field(name) for name in names])
    return pa.Table.from_batches(kept, schema=schema), first
