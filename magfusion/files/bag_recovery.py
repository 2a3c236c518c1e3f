"""Bags that a recorder did not finish: a copy with all that is whole, for the library to read.

What SQLite has in its log is merged by SQLite.  An MCAP file is closed after its last whole record,
as ``mcap recover`` does, and the messages of ROS 1 get an index, as by ``rosbag reindex``.
"""

import io
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

import pyarrow as pa
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

_BLOCK = 1 << 16  # bytes of a cut chunk that are decompressed at once
_MCAP = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # of MCAP: kind, length
_FOOTER, _CHUNK, _DATA_END = 0x02, 0x06, 0x0F
_CHUNK_HEAD = 28  # bytes before the name of the compression
_ROS1 = b"#ROSBAG V2.0\n"
_OF_MESSAGE, _OF_CHUNK, _OF_CONNECTION = b"\x02", b"\x05", b"\x07"


class Recovered(NamedTuple):
    """What the library is to read in place of a bag's file.

    Parameters
    ----------
    whole : bool
        Whether nothing was lost.
    directory : TemporaryDirectory, optional
        Of a copy: removed with this.
    """

    path: Path
    whole: bool
    directory: TemporaryDirectory[str] | None


def recovered(path: Path) -> Recovered | None:
    """Return a readable copy of a file that was not finished; None of any other."""
    if _is_unfinished(path):
        stat = path.stat()
        return _recovered(path, stat.st_size, stat.st_mtime_ns)
    return None


def _sidecars(path: Path) -> list[Path]:
    """Return the files in which SQLite has what is not in the database yet, or is to leave it."""
    names = (path.with_name(f"{path.name}{end}") for end in ("-wal", "-journal"))
    return [one for one in names if one.is_file() and one.stat().st_size]


def _is_unfinished(path: Path) -> bool:
    if path.suffix == ".db3":
        return bool(_sidecars(path))
    with path.open("rb") as file:
        if path.suffix == ".mcap":
            begins = file.read(len(_MCAP)) == _MCAP
            file.seek(max(0, path.stat().st_size - len(_MCAP)))
            return begins and file.read() != _MCAP
        return file.read(len(_ROS1)) == _ROS1 and not _is_indexed(file)


def _is_indexed(file: BinaryIO) -> bool:
    """Return whether the index at the end of a bag of ROS 1 is whole; its head is read next."""
    head, _ = next(_ros1_records(file), ({}, b""))
    at, *counts = (
        int.from_bytes(head.get(name, b""), "little")
        for name in (b"index_pos", b"conn_count", b"chunk_count")
    )
    file.seek(at)
    return at > 0 and sum(1 for _ in _ros1_records(file)) == sum(counts)


@lru_cache
def _recovered(path: Path, _size: int, _modified: int) -> Recovered:
    directory = TemporaryDirectory(prefix="magfusion-bag-")
    copy = Path(directory.name) / path.name.removesuffix(".active")
    if path.suffix == ".db3":
        for file in (path, *_sidecars(path)):
            shutil.copyfile(file, copy.with_name(file.name))
        with sqlite3.connect(copy) as database:
            database.execute("PRAGMA journal_mode=DELETE")
        database.close()
        return Recovered(copy, True, directory)
    (_close_mcap if path.suffix == ".mcap" else _index_ros1)(path, copy)
    return Recovered(copy, False, directory)


def _decompressed(data: bytes, compression: str) -> bytes:
    """Return what a cut chunk gives, up to where it ends."""
    if compression in {"", "none"}:
        return data
    out = io.BytesIO()
    try:
        stream = pa.CompressedInputStream(pa.BufferReader(data), compression)
        while block := stream.read(_BLOCK):
            out.write(block)
    except (OSError, pa.ArrowException):
        pass
    return out.getvalue()


def _close_mcap(path: Path, copy: Path) -> None:
    """Write the whole records of a file, and an end without an index."""
    shutil.copyfile(path, copy)
    with copy.open("r+b") as file:
        end = _end_of_records(file, len(_MCAP), path.stat().st_size)
        file.seek(end)
        cut = file.read()
        file.seek(end)
        file.truncate()
        if cut[:1] == bytes([_CHUNK]):
            file.write(_records_of_chunk(cut[_RECORD.size :]))
        file.write(_RECORD.pack(_DATA_END, 4) + bytes(4))
        file.write(_RECORD.pack(_FOOTER, 20) + bytes(20) + _MCAP)


def _end_of_records(file: BinaryIO, end: int, size: int) -> int:
    """Return where the last whole record of an MCAP file ends, before its index."""
    while True:
        file.seek(end)
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size or head[0] in (_DATA_END, _FOOTER):
            return end
        after = end + _RECORD.size + int(_RECORD.unpack(head)[1])
        if after > size:
            return end
        end = after


def _records_of_chunk(body: bytes) -> bytes:
    """Return the whole records of a chunk that is cut: outside of a chunk they mean the same."""
    if len(body) < _CHUNK_HEAD + 4:
        return b""
    length = int.from_bytes(body[_CHUNK_HEAD : _CHUNK_HEAD + 4], "little")
    begin = _CHUNK_HEAD + 4 + length
    data = _decompressed(body[begin + 8 :], body[begin - length : begin].decode())
    return data[: _end_of_records(io.BytesIO(data), 0, len(data))]


def _index_ros1(path: Path, copy: Path) -> None:
    """Write the whole messages of a bag of ROS 1, with an index."""
    connections: dict[tuple[str, ...], Connection] = {}
    with path.open("rb") as source, Writer(copy) as writer:
        source.seek(len(_ROS1))
        numbered: dict[bytes, Connection] = {}
        for head, body in _ros1_messages(source):
            if head[b"op"] == _OF_MESSAGE:
                seconds, fraction = struct.unpack("<LL", head[b"time"])
                stamp = seconds * 1_000_000_000 + fraction
                writer.write(numbered[head[b"conn"]], stamp, body)
                continue
            known = {name.decode(): value.decode() for name, value in _fields(body).items()}
            package, _, name = known["type"].partition("/")
            own = head[b"topic"].decode(), f"{package}/msg/{name}", known["message_definition"]
            if own not in connections:
                topic, msgtype, definition = own
                connections[own] = writer.add_connection(
                    topic, msgtype, msgdef=definition, md5sum=known["md5sum"]
                )
            numbered[head[b"conn"]] = connections[own]


def _ros1_messages(source: BinaryIO) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield the connections and messages of a bag, whether in chunks or not."""
    for head, body in _ros1_records(source):
        kind = head.get(b"op")
        if kind == _OF_CHUNK:
            data = _decompressed(body, head[b"compression"].decode())
            yield from _ros1_messages(io.BytesIO(data))
        elif kind in (_OF_MESSAGE, _OF_CONNECTION):
            yield head, body


def _ros1_records(source: BinaryIO) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield the fields and the data of each record; of a chunk that is cut what there is."""
    while True:
        head = _sized(source)
        if head is None or len(size := source.read(4)) < 4:
            return
        fields, length = _fields(head), int.from_bytes(size, "little")
        body = source.read(length)
        if len(body) == length or fields.get(b"op") == _OF_CHUNK:
            yield fields, body
        if len(body) < length:
            return


def _sized(source: BinaryIO) -> bytes | None:
    """Return bytes with their number before them; None where there are fewer."""
    size = source.read(4)
    length = int.from_bytes(size, "little")
    data = source.read(length) if len(size) == 4 else b""
    return data if len(size) == 4 and len(data) == length else None


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header of ROS 1, by their names."""
    fields, source = {}, io.BytesIO(data)
    while (field := _sized(source)) is not None:
        name, _, value = field.partition(b"=")
        fields[name] = value
    return fields
