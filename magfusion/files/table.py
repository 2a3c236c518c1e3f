"""One table of a log, Parquet or CSV: the requested columns, checked, within a span of time."""

import csv
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.clock_steps import clock_set_back
from magfusion.files.parquet_bounds import MAX_BYTES, MAX_ROWS, read_batches, refuse_unfolding
from magfusion.files.plain_table import refuse_damaged_text
from magfusion.files.stray_stamps import MAX_GAP, all_strays
from magfusion.units import NANOSECOND, AnyArray, Array, IntArray

TIME = "time_ns"
ROWS_PER_GROUP = 1 << 17  # a slice reads whole groups
# Larger than any clock's reading, and far enough from the ends of int64 to subtract.
MAX_TIME_NS = 1 << 62
TWICE = "the time of the row above: remove one of the two"  # of a refused row
MAX_NUMBER = 1e100  # whose square is still finite


@dataclass(frozen=True)
class Span:
    """A part of a log: start <= time < end, in seconds since the log's epoch.

    `epoch_ns`: the log clock's zero. `start`, `end`: (s); None leaves that side open.
    """

    epoch_ns: int
    start: float | None = None
    end: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("start", self.start), ("end", self.end)):
            if value is not None and not np.isfinite(value):
                raise InputError(f"{name}: found {value}; give a finite time in seconds.")
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise InputError(f"start: found {self.start} s, which is not before end {self.end} s.")

    @property
    def bounds_ns(self) -> tuple[int, int]:
        """First time within and first time beyond, as stamps."""
        return self._stamp(self.start, -MAX_TIME_NS), self._stamp(self.end, MAX_TIME_NS)

    def seconds(self, time_ns: IntArray) -> Array:
        """Return stamps as seconds since the epoch."""
        # Subtracted as integers: a double resolves today's date to a quarter of a microsecond.
        return np.asarray((time_ns - self.epoch_ns) * NANOSECOND)

    def stamps(self, time: Array) -> IntArray:
        """Return seconds since the epoch as stamps."""
        return np.rint(time / NANOSECOND).astype(np.int64) + self.epoch_ns

    def __str__(self) -> str:
        start = "the start" if self.start is None else f"{self.start} s"
        return f"from {start} to {'the end' if self.end is None else f'{self.end} s'}"

    def _stamp(self, time: float | None, default: int) -> int:
        if time is None:
            return default
        maximum = MAX_TIME_NS * NANOSECOND
        stamp = self.epoch_ns + round(max(-maximum, min(time, maximum)) / NANOSECOND)
        return max(-MAX_TIME_NS, min(stamp, MAX_TIME_NS))


class TableLayout(NamedTuple):
    """Columns of a table."""

    # numbers, integers, texts: columns that must be there
    numbers: tuple[str, ...]
    integers: tuple[str, ...] = (TIME,)
    texts: tuple[str, ...] = ()
    # groups of columns with numbers: each whole or absent
    optional: tuple[tuple[str, ...], ...] = ()
    repeats: bool = False  # whether several rows may have the same time
    some: tuple[str, ...] = ()  # columns with numbers, of which one at least must be there
    optional_texts: tuple[str, ...] = ()  # columns of text that may be there
    # whether single rows with stamps far from all others are left out, and not refused
    strays: bool = False

    def _wanted(self, result: Sequence[str]) -> list[str]:
        """Return the columns to read, where the optional ones are as found."""
        groups = [g for g in self.optional if set(g) & set(result)]
        texts = [*self.texts, *filter(result.__contains__, self.optional_texts)]
        some = [*filter(result.__contains__, self.some)] or self.some
        names = (*self.integers, *texts, *self.numbers, *itertools.chain(*groups), *some)
        return [*dict.fromkeys(names)]

    def chosen(self, result: Sequence[str], path: Path) -> list[str]:
        """Return the columns to read of those found; refuse a table that lacks one."""
        wanted = self._wanted(result)
        missing = [name for name in wanted if name not in result]
        if missing:
            pairs = ((other, name) for name in missing for other in result if _is_like(other, name))
            renamed = next((f"rename {other} to {name}, or " for other, name in pairs), "")
            raise InputError(
                f"{path}: {_listed(missing)} missing (found {', '.join(result)});"
                f" {renamed}add what is missing."
            )
        repeated = [name for name in wanted if list(result).count(name) > 1]
        if repeated:
            raise InputError(f"{path}: {_listed(repeated)} repeated; keep one of each.")
        return wanted

    def csv_type(self, name: str) -> pa.DataType:
        """Return the type that a CSV's text must have."""
        if name in self.integers:
            return pa.int64()
        return pa.string() if name in (*self.texts, *self.optional_texts) else pa.float64()


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a table within a span, not yet checked but for its times."""

    path: Path
    data: pa.Table
    time_ns: IntArray  # (n,), sorted; strictly increasing unless the layout lets them repeat
    time: Array  # (n,), the same in seconds since the log's epoch
    first_row: int  # row of the file, counted from 0, with which the span begins
    # rows of the file that were left out, and their stamps (ns)
    stray: tuple[tuple[int, int], ...] = ()

    def __len__(self) -> int:
        return len(self.time_ns)

    def has(self, names: Iterable[str]) -> bool:
        """Return whether the table holds these columns."""
        return set(names) <= set(self.data.column_names)

    def numbers(self, names: Sequence[str], *, nan: bool = False) -> Array:
        """Return columns side by side, shape (n, names); refuse what is not a finite number.

        `nan`: whether a number may be missing: NaN, infinite or null in the table, NaN of what is
        returned.
        """
        values = np.empty((len(self), len(names)))
        for k, name in enumerate(names):
            column = self.data[name] if nan else self._present(name)
            if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
                raise InputError(f"{self.path}: column {name} holds {column.type}; write numbers.")
            values[:, k] = column.to_numpy()
            bad = ~(np.abs(values[:, k]) < MAX_NUMBER)
            if nan:
                values[bad, k] = np.nan
            else:
                self.refuse(bad, name, values[:, k], "write a finite number")
        return values

    def integers(self, name: str) -> IntArray:
        """Return a column of integers."""
        column = self._present(name)
        return _integers(column, name, self.path)

    def texts(self, name: str) -> tuple[list[str], IntArray]:
        """Return the distinct texts of a column as they first appear, and each row's index."""
        column = self._present(name)
        try:
            encoded = column.cast(pa.string()).combine_chunks().dictionary_encode()
        except pa.ArrowException:
            encoded = None
        if encoded is None or pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
            raise InputError(f"{self.path}: column {name} holds {column.type}; write text.")
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        return encoded.dictionary.to_pylist(), encoded.indices.to_numpy().astype(np.int64)

    def refuse(self, bad: AnyArray, name: str, result: AnyArray, remedy: str) -> None:
        """Raise an InputError that names the first bad row, if there is one."""
        if bad.any():
            k = int(np.argmax(bad))
            row = self.first_row + k
            for left_out, _ in self.stray:
                row += left_out <= row
            raise InputError(
                f"{self.path}: column {name}, row {row} (counted from 0):"
                f" found {result[k]}; {remedy}."
            )

    def _present(self, name: str) -> pa.ChunkedArray:
        column = self.data[name]
        if column.null_count:
            absent = column.is_null().to_numpy()
            self.refuse(absent, name, np.full(len(self), "no value"), "write one")
        return column


def find_table(directory: Path, stem: str) -> Path | None:
    """Return the path of a table that is Parquet or CSV, or None where there is neither."""
    paths = [p for s in (".parquet", ".csv") if (p := directory / f"{stem}{s}").exists()]
    if len(paths) > 1:
        raise InputError(f"{directory}: holds {stem}.parquet and {stem}.csv; keep one of them.")
    return paths[0] if paths else None


def read_table(
    path: Path, layout: TableLayout, span: Span, content: pa.Table | None = None
) -> Table:
    """Read the columns of a layout and the rows of a span.

    A Parquet file is mapped, and only the row groups that the span needs are decoded. `content`:
    what the file holds, where another reader has read it. Raises InputError where the file is
    absent, no such table, empty, lacks a column, or its times are no integers or not sorted.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a table.")
    try:
        if content is not None:
            data, first_row = content.select(layout.chosen(content.column_names, path)), 0
        elif path.suffix == ".csv":
            data, first_row = _read_csv(path, layout), 0
        else:
            data, first_row = _read_parquet(path, layout, span)
        refuse_damaged_text(data)
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        integers = "write whole numbers, of time_ns nanoseconds"
        remedy = integers if "int64" in reason else "write the file again"
        raise InputError(f"{path}: cannot be read ({reason}); {remedy}.") from error
    whole = Table(path, data, np.empty(len(data), dtype=np.int64), np.empty(len(data)), first_row)
    time_ns = whole.integers(TIME)
    if layout.strays and (stray := all_strays(time_ns)).any():
        rows = first_row + np.flatnonzero(stray)
        left_out = tuple(zip(rows.tolist(), time_ns[stray].tolist(), strict=True))
        whole = replace(whole, data=data.filter(pa.array(~stray)), stray=left_out)
        time_ns = time_ns[~stray]
    check_times(whole, time_ns, layout, span)
    begin, end = np.searchsorted(time_ns, span.bounds_ns)
    inside = whole.data.slice(begin, end - begin)
    within = time_ns[begin:end]
    begin_row = first_row + int(begin)
    table = Table(path, inside, within, span.seconds(within), begin_row, whole.stray)
    refuse_jump(table, None)
    return table


def refuse_jump(table: Table, before: int | None) -> None:
    """Refuse a row that is more than an hour after the row above.

    `before`: time of the row above the first (ns).
    """
    first = table.time_ns[:1] if before is None else before
    jumped = np.diff(table.time_ns, prepend=first) * NANOSECOND > MAX_GAP
    remedy = (
        "more than an hour after the row above: the clock jumped; correct the times, or use one"
        " side by --start and --end"
    )
    table.refuse(jumped, TIME, table.time_ns, remedy)


def write_table(columns: dict[str, object], path: Path) -> None:
    """Write columns as one Parquet file with zstd compression."""
    with whole_file(path) as unfinished:
        pa.parquet.write_table(
            pa.table(columns),
            unfinished,
            compression="zstd",
            row_group_size=ROWS_PER_GROUP,
            write_page_checksum=True,
        )


def _read_parquet(path: Path, layout: TableLayout, span: Span) -> tuple[pa.Table, int]:
    options = {"memory_map": True, "page_checksum_verification": True, "pre_buffer": False}
    with pa.parquet.ParquetFile(path, **options) as file:
        _refuse_empty(file.metadata.num_rows, path)
        names = layout.chosen(file.schema_arrow.names, path)
        _integer_type(file.schema_arrow.field(TIME).type, TIME, path)
        groups = _groups_within(file, span)
        if not groups:
            return file.schema_arrow.empty_table().select(names), 0
        own = [file.metadata.row_group(g) for g in groups]
        skipped = sum(file.metadata.row_group(g).num_rows for g in range(groups[0]))
        refuse_unfolding(file, names, own, path)
        count = sum(group.num_rows for group in own)
        if count <= MAX_ROWS:
            many = count > ROWS_PER_GROUP  # fewer are read sooner than threads are woken
            return file.read_row_groups(list(groups), columns=names, use_threads=many), skipped
        return read_batches(file, names, groups, span.bounds_ns, path, skipped)


def _groups_within(file: pa.parquet.ParquetFile, span: Span) -> range:
    """Return the row groups that may hold rows of the span; consecutive, as times are sorted."""
    begin, end = span.bounds_ns
    column = file.schema_arrow.names.index(TIME)
    within = []
    for g in range(file.num_row_groups):
        known = file.metadata.row_group(g).column(column).statistics
        if known is None or not known.has_min_max or (known.max >= begin and known.min < end):
            within.append(g)
    return range(within[0], within[-1] + 1) if within else range(0)


def _read_csv(path: Path, layout: TableLayout) -> pa.Table:
    if path.stat().st_size > MAX_BYTES:
        raise InputError(
            f"{path}: is larger than {MAX_BYTES >> 20} MiB; write it as Parquet, of which a part"
            " can be read."
        )
    with path.open(newline="", encoding="utf-8-sig") as stream:
        header = next(csv.reader(stream), [])
    result = [name.strip() for name in header]
    names = layout.chosen(result, path)
    data = pa.csv.read_csv(
        path,
        read_options=pa.csv.ReadOptions(column_names=result, skip_rows=1),
        convert_options=pa.csv.ConvertOptions(
            include_columns=names, column_types={name: layout.csv_type(name) for name in names}
        ),
    )
    _refuse_empty(data.num_rows, path)
    return data


def check_times(whole: Table, time_ns: IntArray, layout: TableLayout, span: Span) -> None:
    """Refuse times that are no nanoseconds, or not sorted."""
    far = np.abs(time_ns) > MAX_TIME_NS
    whole.refuse(far, TIME, time_ns, "write nanoseconds")
    step = np.diff(time_ns, prepend=time_ns[:1] - 1)
    back = clock_set_back(time_ns, np.arange(float(len(time_ns)))[:, None])
    if back is not None:
        remedy = f"the clock was set back by {back.size_s:.4g} s: make a log of each part"
        whole.refuse(np.arange(len(time_ns)) == back.row, TIME, time_ns, remedy)
    whole.refuse(step < 0, TIME, time_ns, "which is before the row above: sort the rows by time")
    if not layout.repeats:
        whole.refuse(step == 0, TIME, time_ns, TWICE)
    seconds = span.seconds(time_ns)
    merged = (np.diff(seconds, prepend=-np.inf) == 0.0) & (step > 0)
    remedy = (
        "too far from epoch_ns to distinguish it from the row above: set epoch_ns near the times,"
        " or write nanoseconds"
    )
    whole.refuse(merged, TIME, time_ns, remedy)


def _integers(column: pa.ChunkedArray, name: str, path: Path) -> IntArray:
    _integer_type(column.type, name, path)
    return np.asarray(column.to_numpy(), dtype=np.int64)


def _integer_type(result: pa.DataType, name: str, path: Path) -> None:
    if not pa.types.is_integer(result):
        raise InputError(f"{path}: column {name} holds {result}; write integers (int64).")


def _refuse_empty(rows: int, path: Path) -> None:
    if rows == 0:
        raise InputError(f"{path}: holds no rows; record at least one, or remove the file.")


def _is_like(column: str, wanted: str) -> bool:
    """Return whether a column is a wanted one with or without a unit: ``range_m``, ``heading``."""
    return column.startswith(f"{wanted}_") or wanted.startswith(f"{column}_")


def _listed(names: Sequence[str]) -> str:
    plural = len(names) > 1
    return f"column{'s' if plural else ''} {', '.join(names)} {'are' if plural else 'is'}"
