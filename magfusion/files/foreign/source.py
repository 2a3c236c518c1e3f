"""A table of any format: named columns, read in parts."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field

from magfusion.files.foreign.units import Raw
from magfusion.units import IntArray

ROWS = 1 << 17  # of a part


@dataclass(frozen=True)
class SourceColumn:
    """A column of a table.

    `name`: as written in the file; its place, counted from 0, where it has none. `unit`: that the
    file names outside of the name: in a row of units, or as an attribute.
    """

    name: str
    unit: str = ""


@dataclass(frozen=True, eq=False)
class RowBlock:
    """Some rows: the requested columns, in that order.

    `rows` (n,): places of the rows in the table, counted from 0 at the first row of data.
    `left_out`: rows that could not be read, by the reason, since the part before.
    """

    columns: list[Raw]
    rows: IntArray
    left_out: dict[str, int] = field(default_factory=dict)


Read = Callable[[Sequence[int], Collection[int]], Iterator[RowBlock]]


@dataclass(frozen=True, eq=False)
class Source:
    """A table."""

    place: str  # what a refusal calls it
    columns: tuple[SourceColumn, ...]
    # takes the places of the columns to read and, of these, the ones that hold stamps and are given
    # as they are written; yields `RowBlock`
    read: Read
    rate_hz: float | None = None  # that the format itself declares
    lengths: tuple[int, ...] = ()  # rows of each column where they may differ, else empty
    form: str = ""  # how the table was understood, for the report
    count: int = 0  # rows, if the format gives their number; else 0
