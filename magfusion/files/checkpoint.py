"""The state of a run in a file: a header that identifies the run, then plain data.

Plain data are numbers, texts, lists, mappings of them by text, and arrays; they name no type and
hold no code, so that reading them builds nothing else.  The header is 100 bytes, little-endian:
magic, version, position, key, length of the content, and the SHA-256 of all that and the content,
which is MessagePack.
"""

import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from hashlib import sha256
from math import prod
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.units import AnyArray

MAGIC = b"magfusion state\n"
VERSION = 22  # to be raised with every change of what a run keeps
MAX_CONTENT = 1 << 28  # bytes
# MessagePack reserves what a list announces before it reads it, on each of 1024 levels.
MAX_LIST = 1 << 14
DTYPES = ("<f8", "<c16", "<i8", "|b1")
_ARRAY = {"dtype", "shape", "data"}
_HEADER = struct.Struct("<16sIQ32sQ")
_DIGEST = 32
_REMEDY = "move it away, or give another path"


@dataclass(frozen=True)
class Checkpoint:
    """Where a run was."""

    key: str  # of the run (`run_key`): only a run of the same key may go on from here
    position: int  # pieces of its input that were taken in
    content: dict[str, Any]  # plain data


def run_key(*identity: object) -> str:
    """Return the SHA-256 of what two runs share that may go on from each other's checkpoints.

    `*identity`: numbers, texts, arrays, and mappings, sequences and dataclasses of them, however
    deep; of any other object only its type counts.
    """
    digest = sha256()

    def add(value: object) -> None:
        digest.update(type(value).__name__.encode() + b"\0")
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype.str}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).data if value.size else b"")
        elif is_dataclass(value):
            for field in fields(value):
                add(field.name)
                add(getattr(value, field.name))
        elif isinstance(value, Mapping):
            add(list(value.items()))
        elif isinstance(value, list | tuple):
            digest.update(f"{len(value)}".encode())
            for part in value:
                add(part)
        elif value is None or isinstance(value, bool | int | float | str):
            digest.update(repr(value).encode() + b"\0")

    add(identity)
    return digest.hexdigest()


def claim_checkpoint(path: Path) -> None:
    """See that a checkpoint may be written here: over nothing, an empty file or an earlier one.

    Raises InputError where something else is there.
    """
    if not os.path.lexists(path):
        return
    if not path.is_file():
        raise InputError(f"{path}: is no regular file; {_REMEDY}")
    start = _read(path, len(MAGIC))
    if start and start != MAGIC:
        raise InputError(f"{path}: is not a checkpoint of magfusion and is kept; {_REMEDY}")


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint; until it is whole, the former is there."""
    content = msgpack.packb(checkpoint.content, default=_plain_array)
    header = _HEADER.pack(
        MAGIC, VERSION, checkpoint.position, bytes.fromhex(checkpoint.key), len(content)
    )
    with whole_file(path) as unfinished, unfinished.open("wb") as stream:
        stream.write(header + sha256(header + content).digest() + content)
        stream.flush()
        os.fsync(stream.fileno())


def read_position(path: Path, key: str | None = None) -> int:
    """Return the position in the header of a checkpoint; 0 where there is none.

    `key`: of the reading run. Raises InputError where it is no checkpoint of this version, or of
    another run.
    """
    return _header(_read(path, _HEADER.size + _DIGEST), path, key)[0] if path.exists() else 0


def read_checkpoint(path: Path, key: str | None = None) -> Checkpoint | None:
    """Read a checkpoint; None where there is none.

    `key`: of the reading run. Raises InputError where it is damaged, of another run or another
    version, or no checkpoint at all.
    """
    if not os.path.lexists(path):
        return None
    start = _HEADER.size + _DIGEST
    whole = _read(path, start + MAX_CONTENT + 1)
    position, own_key, length = _header(whole, path, key)
    content = memoryview(whole)[start:]
    digest = sha256(whole[: _HEADER.size])
    digest.update(content)
    if len(content) != length or digest.digest() != whole[_HEADER.size : start]:
        raise InputError(f"{path}: is damaged; run without --resume, or restore the file")
    try:
        result = msgpack.unpackb(
            content,
            object_hook=_array,
            ext_hook=_no_extension,
            max_array_len=MAX_LIST,
            max_map_len=MAX_LIST,
        )
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise InputError(f"{path}: holds no plain data ({error}); run without --resume") from error
    if not isinstance(result, dict):
        raise InputError(f"{path}: holds no mapping; run without --resume")
    return Checkpoint(own_key, position, result)


def _read(path: Path, maximum: int) -> bytes:
    if not path.is_file():
        raise InputError(f"{path}: is no regular file; {_REMEDY}")
    try:
        with path.open("rb") as stream:
            return stream.read(maximum)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_REMEDY}") from error


def _header(start: bytes, path: Path, key: str | None) -> tuple[int, str, int]:
    """Return position, key and the length of the content."""
    if not start.startswith(MAGIC):
        raise InputError(
            f"{path}: is no checkpoint of magfusion; run without --resume, or {_REMEDY}"
        )
    if len(start) < _HEADER.size + _DIGEST:
        raise InputError(f"{path}: is damaged; run without --resume, or restore the file")
    _, version, position, result, length = _HEADER.unpack_from(start)
    if version != VERSION:
        raise InputError(f"{path}: is of another version of magfusion; run without --resume")
    if key is not None and result.hex() != key:
        raise InputError(
            f"{path}: is the checkpoint of another log, site or setting; repeat the command as it"
            " was, or run without --resume"
        )
    return position, result.hex(), length


def _plain_array(value: object) -> object:
    if isinstance(value, np.ndarray):
        dtype = value.dtype.newbyteorder("<").str
        if dtype not in DTYPES:
            raise TypeError(f"an array of {dtype} is no plain data")
        data = np.ascontiguousarray(value, dtype).tobytes()
        return {"dtype": dtype, "shape": list(value.shape), "data": data}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is no plain data")


def _array(result: dict[str, Any]) -> dict[str, Any] | AnyArray:
    """Return the array that a mapping describes, if it is one."""
    if result.keys() != _ARRAY:
        return result
    dtype, shape, data = result["dtype"], result["shape"], result["data"]
    if not (
        dtype in DTYPES
        and isinstance(data, bytes)
        and isinstance(shape, list)
        and len(shape) <= 8
        and all(type(size) is int and 0 <= size <= MAX_CONTENT for size in shape)
        and prod(shape) * np.dtype(dtype).itemsize == len(data)
    ):
        raise ValueError("an array whose shape does not fit its data")
    if dtype == "|b1" and data.strip(b"\0\1"):
        raise ValueError("a truth value that is neither")
    return np.frombuffer(data, dtype).reshape(shape).copy()


def _no_extension(code: int, _data: bytes) -> object:
    raise ValueError(f"an extension of type {code}")
