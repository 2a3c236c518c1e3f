"""Tables of text, in whatever dialect, as parts of Arrow's reader."""

import codecs
import io
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from magfusion.errors import InputError
from magfusion.files.foreign.dialect import COMMENTS, SPACES, Dialect, find_dialect
from magfusion.files.foreign.source import RowBlock, Source
from magfusion.files.foreign.units import Raw

BLOCK = 1 << 22  # bytes
TORN = "not of as many cells as the others"
REPEATED = "that repeat the head"


def text_source(path: Path, delimiter: str | None = None, markers: Sequence[str] = ()) -> Source:
    """Return a table of text.

    Raises InputError where it holds no table.
    """
    dialect = find_dialect(path, delimiter, markers)

    def read(wanted: Sequence[int], texts: Collection[int]) -> Iterator[RowBlock]:
        return _read(path, dialect, wanted, texts)

    return Source(str(path), dialect.columns, read, form=str(dialect))


class _AsUtf8(io.RawIOBase):
    """A text of another encoding, or with runs of spaces, as Arrow reads it."""

    def __init__(self, stream: Any, encoding: str, squeeze: bool) -> None:
        self._stream, self._squeeze, self._rest, self._ended = stream, squeeze, b"", False
        self._decoder = codecs.getincrementaldecoder(encoding)("replace")
        self._partial_line = ""  # a line that is not whole

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self._stream.close()
        super().close()

    def readinto(self, buffer: Any) -> int:
        while not self._rest and not self._ended:
            block = self._stream.read(BLOCK)
            self._ended = not block
            text = self._partial_line + self._decoder.decode(block, final=self._ended)
            whole = len(text) if self._ended else text.rfind("\n") + 1
            text, self._partial_line = text[:whole], text[whole:]
            if self._squeeze:
                text = re.sub(r"(?m)^[ \t]+|[ \t]+(?=\r?$)", "", text)
                text = re.sub(r"[ \t]+", " ", text)
            self._rest = text.encode()
        size = min(len(buffer), len(self._rest))
        buffer[:size], self._rest = self._rest[:size], self._rest[size:]
        return size


def _opened(path: Path, dialect: Dialect) -> Any:
    stream = path.open("rb")
    stream.seek(dialect.offset)
    squeeze = dialect.delimiter == SPACES
    if dialect.encoding == "utf-8" and not squeeze:
        return stream
    return io.BufferedReader(_AsUtf8(stream, dialect.encoding, squeeze))


def _batches(
    path: Path, dialect: Dialect, types: dict[str, pa.DataType], counts: dict[str, int]
) -> Iterator[pa.RecordBatch]:
    def torn(row: Any) -> str:
        if not row.text.lstrip().startswith(COMMENTS):
            counts[TORN] = counts.get(TORN, 0) + 1
        return "skip"

    heads = _head_lines(path, dialect)
    names = [f"c{k}" for k in range(len(dialect.columns))]
    parse = pa.csv.ParseOptions(delimiter=dialect.delimiter, invalid_row_handler=torn)
    convert = pa.csv.ConvertOptions(
        column_types=types,
        include_columns=list(types),
        null_values=list(dialect.missing),
        strings_can_be_null=True,
        decimal_point=dialect.decimal,
    )
    with _opened(path, dialect) as stream:
        for content in _whole_lines(stream):
            lines = _of_arrow(_without_heads(content, heads, counts))
            read = pa.csv.ReadOptions(column_names=names, block_size=lines.size, use_threads=False)
            table = pa.csv.read_csv(pa.BufferReader(lines), read, parse, convert)
            # Without rows, too: of those that were torn the next part tells.
            yield from table.to_batches() or [pa.RecordBatch.from_pylist([], table.schema)]


def _head_lines(path: Path, dialect: Dialect) -> set[bytes]:
    """Return the lines of names above the data, as `_opened` would give them."""
    with path.open("rb") as stream:
        text = stream.read(dialect.offset).decode(dialect.encoding, "replace")
    if dialect.delimiter == SPACES:
        text = re.sub(r"[ \t]+", " ", text)
    lines = {line.strip().lstrip("\ufeff") for line in text.splitlines()}
    return {line.encode() for line in lines if re.search("[A-Za-z]", line)}


def _without_heads(content: bytes, heads: set[bytes], counts: dict[str, int]) -> bytes:
    """Return lines without repeated heads, as of files that were joined, and count these."""
    if not any(head in content for head in heads):
        return content
    lines = content.splitlines(keepends=True)
    kept = [line for line in lines if line.strip() not in heads]
    if len(kept) < len(lines):
        counts[REPEATED] = counts.get(REPEATED, 0) + len(lines) - len(kept)
    return b"".join(kept)


def _whole_lines(stream: Any) -> Iterator[bytes]:
    """Yield a text, some megabytes of whole lines at a time."""
    rest = b""
    while block := stream.read(BLOCK):
        whole = max(block.rfind(b"\n"), block.rfind(b"\r")) + 1
        if whole:
            yield rest + block[:whole]
            rest = b""
        rest += block[whole:]
    if rest:
        yield rest


def _of_arrow(content: bytes) -> pa.Buffer:
    """Return a text in memory of Arrow's own.

    Arrow reads ahead in threads.  One that holds an object of Python when the process ends, as it
    does where a table is refused, aborts it: Arrow is given nothing of Python's.
    """
    stream = pa.BufferOutputStream()
    stream.write(content)
    return stream.getvalue()


def _read(
    path: Path, dialect: Dialect, wanted: Sequence[int], texts: Collection[int]
) -> Iterator[RowBlock]:
    kinds = {f"c{k}": pa.string() if k in texts else pa.float64() for k in wanted}
    counts: dict[str, int] = {}
    row = 0
    try:
        for batch in _batches(path, dialect, kinds, counts):
            columns: list[Raw] = []
            for k in wanted:
                column = batch.column(f"c{k}")
                columns.append(column if k in texts else column.to_numpy(zero_copy_only=False))
            left_out = dict(counts)
            counts.clear()
            yield RowBlock(columns, row + np.arange(len(batch)), left_out)
            row += len(batch)
    except pa.ArrowInvalid as error:
        raise InputError(_no_number(path, dialect, wanted, str(error))) from error
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: cannot be read ({error}); write the file again.") from error


def _no_number(path: Path, dialect: Dialect, wanted: Sequence[int], reason: str) -> str:
    """Return the refusal of a cell, found by a second look at the file."""
    number = rf"^\s*[-+]?(\d+\{dialect.decimal}?\d*|\{dialect.decimal}\d+)([eE][-+]?\d+)?\s*$"
    row = 0
    try:
        for batch in _batches(path, dialect, {f"c{k}": pa.string() for k in wanted}, {}):
            for k in wanted:
                text = batch.column(f"c{k}")
                known = pc.or_(
                    pc.match_substring_regex(text, number),
                    pc.is_in(pc.utf8_trim_whitespace(text), value_set=pa.array(dialect.missing)),
                )
                bad = np.flatnonzero(~known.fill_null(True).to_numpy(zero_copy_only=False))
                if len(bad):
                    cell = text[int(bad[0])].as_py()
                    return (
                        f"{path}: column {dialect.columns[k].name}, row {row + int(bad[0])} of the"
                        f" data (counted from 0): found {cell!r}; write a number, or nan where"
                        f" there is none (or give --missing={cell})."
                    )
            row += len(batch)
    except pa.ArrowException as error:
        reason = str(error)
    return f"{path}: cannot be read ({' '.join(reason.split())[:200]}); write the file again."
