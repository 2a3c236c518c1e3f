"""Tables that hold several sensors one below the other: the rows of one of them."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from magfusion.files.foreign.source import RowBlock, Source
from magfusion.files.foreign.units import Raw
from magfusion.units import BoolArray


def rows_where(source: Source, place: int, value: str) -> Source:
    """Return a table of the rows that have a value in a column.

    `place`: of the column. `value`: as it is written in the file.
    """

    def read(wanted: Sequence[int], texts: Collection[int]) -> Iterator[RowBlock]:
        places = sorted({*wanted, place})
        for part in source.read(places, {*texts, place}):
            columns = dict(zip(places, part.columns, strict=True))
            own = _equal(columns[place], value)
            kept: list[Raw] = [_own_rows(columns[k], own) for k in wanted]
            yield replace(part, columns=kept, rows=part.rows[own])

    name = source.columns[place].name
    return replace(source, place=f"{source.place}, rows with {value} in {name}", read=read)


def _equal(raw: Raw, value: str) -> BoolArray:
    if isinstance(raw, pa.Array | pa.ChunkedArray):
        text = pc.utf8_trim_whitespace(raw.cast(pa.string()))
        same = pc.fill_null(pc.equal(text, value), False)
        return np.asarray(same.to_numpy(zero_copy_only=False), dtype=bool)
    result = np.asarray(raw)
    if result.dtype.kind not in "biuf":
        return np.asarray(result.astype(str) == value)
    try:
        return np.asarray(result == float(value))
    except ValueError:
        return np.zeros(len(result), dtype=bool)


def _own_rows(raw: Raw, own: BoolArray) -> Raw:
    return raw.filter(pa.array(own)) if isinstance(raw, pa.Array | pa.ChunkedArray) else raw[own]
