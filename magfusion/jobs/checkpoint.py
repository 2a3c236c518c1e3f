"""What a long run needs to go on after it was killed: a small file, and the rows made so far."""

import os
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files import whole_file
from magfusion.units import Array

CHECKPOINT, ROWS = "checkpoint.bin", "checkpoint.rows"


@dataclass(frozen=True)
class Checkpoint:
    """Where a run was.

    Parameters
    ----------
    key : str
        Of the run: its input and its settings.
    position : int
        Pieces or records that were taken in.
    rows : int
        Of the file of rows; what follows them was made since, and is made again.
    navigator : bytes
    elapsed : float
        (s)
    """

    key: str
    position: int
    rows: int
    navigator: bytes
    elapsed: float = 0.0


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint; until it is whole, the former is there."""
    with whole_file(path) as unfinished, unfinished.open("wb") as stream:
        pickle.dump(checkpoint, stream)
        stream.flush()
        os.fsync(stream.fileno())


def read_checkpoint(path: Path, key: str) -> Checkpoint | None:
    """Read a checkpoint; None where there is none.  Only open those that you have written.

    Raises
    ------
    InputError
        Where it is of another run.
    """
    if not path.is_file():
        return None
    try:
        found = pickle.loads(path.read_bytes())
    except (pickle.UnpicklingError, AttributeError, EOFError, ImportError, IndexError) as error:
        raise InputError(f"{path}: is no checkpoint ({error}); run without --resume") from error
    if not isinstance(found, Checkpoint) or found.key != key:
        raise InputError(
            f"{path}: is the checkpoint of another log, site or setting; repeat the command as it"
            " was, or run without --resume"
        )
    return found


class RowFile:
    """Rows of numbers, appended to a file.

    Parameters
    ----------
    path : Path
    width : int
        Numbers in a row.
    rows : int
        Kept of what the file holds.

    Raises
    ------
    InputError
        Where it holds fewer.
    """

    def __init__(self, path: Path, width: int, rows: int = 0) -> None:
        self.path, self.width = path, width
        path.touch()
        size = rows * width * np.dtype(float).itemsize
        if path.stat().st_size < size:
            raise InputError(f"{path}: is shorter than its checkpoint says; run without --resume")
        self._stream = path.open("r+b")
        self._stream.truncate(size)
        self._stream.seek(size)

    def append(self, row: Array) -> None:
        """Add a row."""
        assert row.shape == (self.width,)
        self._stream.write(np.asarray(row, dtype=float).tobytes())

    def settle(self) -> int:
        """See that all rows are on the disk, and return how many they are."""
        self._stream.flush()
        os.fsync(self._stream.fileno())
        return self._stream.tell() // (self.width * np.dtype(float).itemsize)

    def rows(self) -> Array:
        """Return all rows, shape (n, width)."""
        self._stream.flush()
        return np.fromfile(self.path).reshape(-1, self.width)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
