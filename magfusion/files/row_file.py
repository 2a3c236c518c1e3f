"""Rows with named columns, appended to a file while a long run goes on: an Arrow IPC stream.

A run that is killed leaves whole batches, then perhaps part of one; its checkpoint has the length
of the file goes that belongs to it, and what follows is made again.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.ipc

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.units import Array

_KIND = {b"magfusion": b"rows"}  # by which an own file is known
BATCH = 4096  # additions that wait at most


@dataclass(frozen=True)
class RowPosition:
    """How far a file of rows went when a checkpoint was made.

    `size`: of the file (bytes). `sha256`: of so much of it.
    """

    rows: int
    size: int
    sha256: str


def claim_rows(path: Path) -> None:
    """See that rows may be written here: over nothing, an empty file or earlier rows.

    Raises InputError where something else is there.
    """
    if not os.path.lexists(path):
        return
    try:
        if path.is_file() and (path.stat().st_size == 0 or _schema(path).metadata == _KIND):
            return
    except (pa.ArrowException, OSError):
        pass
    raise InputError(f"{path}: holds no rows of magfusion and is kept; move the file away")


class RowFile:
    """Rows of numbers that are appended to a file.

    `columns`: name of each column and how many numbers it has in a row; one without any is left
    out. `mark`: from which to go on; None begins again. Raises InputError where the file does not
    match the mark, or, without one, is no file of rows.
    """

    def __init__(
        self, path: Path, columns: Mapping[str, int], mark: RowPosition | None = None
    ) -> None:
        self.path = path
        self.columns = {name: size for name, size in columns.items() if size}
        self._waiting: list[list[Array]] = []
        layout = [(name, pa.list_(pa.float64(), size)) for name, size in self.columns.items()]
        self._layout = pa.schema(layout, metadata=_KIND)
        if mark is None:
            claim_rows(path)
            head = self._layout.serialize().to_pybytes()
            with whole_file(path) as unfinished:
                unfinished.write_bytes(head)
            self.count, self._digest, size = 0, hashlib.sha256(head), len(head)
        else:
            self.count, self._digest, size = mark.rows, self._checked(mark), mark.size
        self._stream = path.open("r+b")
        self._stream.seek(size)

    def extend(self, rows: Mapping[str, Array]) -> None:
        """Add rows: for each column its numbers, the rows first."""
        count = len(next(iter(rows.values())))
        own = [np.reshape(rows[name], (count, size)) for name, size in self.columns.items()]
        self._waiting.append([part.astype(float) for part in own])
        self.count += count
        if len(self._waiting) == BATCH:
            self._write()

    def settle(self) -> RowPosition:
        """See that all rows are on the disk; return how far the file goes."""
        self._write()
        os.fsync(self._stream.fileno())
        return RowPosition(self.count, self._stream.tell(), self._digest.hexdigest())

    def rows(self) -> dict[str, Array]:
        """Return all rows by column, shape (rows, numbers) each."""
        self._write()
        with pa.ipc.open_stream(self.path) as reader:
            table = reader.read_all()
        # Whole and without nulls; to flatten them would import pyarrow's functions for tables.
        return {
            name: table.column(name).combine_chunks().values.to_numpy().reshape(-1, size)
            for name, size in self.columns.items()
        }

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def _write(self) -> None:
        self._stream.truncate()  # what was made after the mark
        if self._waiting:
            arrays = [
                pa.FixedSizeListArray.from_arrays(np.concatenate(column).ravel(), size)
                for column, size in zip(
                    zip(*self._waiting, strict=True), self.columns.values(), strict=True
                )
            ]
            batch = pa.record_batch(arrays, schema=self._layout).serialize().to_pybytes()
            self._digest.update(batch)
            self._stream.write(batch)
            self._waiting.clear()
        self._stream.flush()

    def _checked(self, mark: RowPosition) -> "hashlib._Hash":
        """Return the digest of the part given by the mark, after reading all of it."""
        wrong = InputError(f"{self.path}: does not match its checkpoint; run without --resume")
        digest, remaining = hashlib.sha256(), mark.size
        try:
            with self.path.open("rb") as stream:
                while remaining and (part := stream.read(min(remaining, 1 << 20))):
                    digest.update(part)
                    remaining -= len(part)
            if remaining or digest.hexdigest() != mark.sha256 or _schema(self.path) != self._layout:
                raise wrong
        except (OSError, pa.ArrowException) as error:
            raise wrong from error
        return digest


def _schema(path: Path) -> pa.Schema:
    with pa.ipc.open_stream(path) as reader:
        return reader.schema
