"""Bags that a recorder did not finish: a copy with all that is whole, for the library to read.

What SQLite has in its log is merged by SQLite, and of a damaged database the rows are copied that
can be read, as by its ``.recover``.  An MCAP file is closed after its last whole record, as ``mcap
recover`` does, and the messages of ROS 1 get an index, as by ``rosbag reindex``.
"""

import io
import os
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple
from zlib import crc32

import pyarrow as pa
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

_BLOCK = 1 << 16  # bytes of a cut chunk that are decompressed at once
_MCAP = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # of MCAP: kind, length
_NONE, _FOOTER, _CHUNK, _DATA_END = 0x00, 0x02, 0x06, 0x0F
# Of a chunk, before the name of the compression: times, size and checksum of the records, and the
# length of the name.
_CHUNK_HEAD = struct.Struct("<QQQII")
_MAX_ROWID = 2**63 - 1
_ROS1 = b"#ROSBAG V2.0\n"
_OF_MESSAGE, _OF_CHUNK, _OF_CONNECTION = b"\x02", b"\x05", b"\x07"


class Recovered(NamedTuple):
    """What the library is to read in place of a bag's file.

    `whole`: whether nothing was lost. `directory`: of a copy: removed with this.
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
        stat = path.stat()
        return bool(_sidecars(path)) or not _is_whole(path, stat.st_size, stat.st_mtime_ns)
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
        if not _sidecars(path):
            try:
                _copy_rows(Path(shutil.copyfile(path, copy.with_suffix(".damaged"))), copy)
            except sqlite3.DatabaseError:
                directory.cleanup()
                raise
            return Recovered(copy, False, directory)
        for file in (path, *_sidecars(path)):
            shutil.copyfile(file, copy.with_name(file.name))
        with closing(sqlite3.connect(copy)) as database:
            database.execute("PRAGMA journal_mode=DELETE")
        return Recovered(copy, True, directory)
    (_close_mcap if path.suffix == ".mcap" else _index_ros1)(path, copy)
    return Recovered(copy, False, directory)


@lru_cache
def _is_whole(path: Path, _size: int, _modified: int) -> bool:
    """Return whether no page of a database is cut or overwritten."""
    try:
        with closing(_opened(path)) as database:
            return database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",)
    except sqlite3.DatabaseError:
        return False


def _opened(path: Path) -> sqlite3.Connection:
    """Open a database for reading alone."""
    return sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True)


def _copy_rows(damaged: Path, copy: Path) -> None:
    """Write a database with the rows that can be read of a damaged one, which loses a cut page."""
    with closing(_opened(damaged)) as source:
        (page,) = source.execute("PRAGMA page_size").fetchone()
    os.truncate(damaged, damaged.stat().st_size // page * page)
    with closing(_opened(damaged)) as source, closing(sqlite3.connect(copy)) as target:
        source.execute("PRAGMA writable_schema = ON")  # of a file shorter than its header states
        schema = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
        for name, create in source.execute(schema).fetchall():
            target.execute(create)
            for row in _readable_rows(source, name):
                places = ", ".join("?" * len(row))
                target.execute(f'INSERT OR IGNORE INTO "{name}" VALUES ({places})', row)
        target.commit()
        (messages,) = target.execute("SELECT COUNT(*) FROM messages").fetchone()
        if not messages:
            raise sqlite3.DatabaseError("none of its messages is whole")


def _readable_rows(source: sqlite3.Connection, table: str) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a table; where one cannot be read, a growing number is passed over."""
    last, step = -1, 1
    while last < _MAX_ROWID:
        try:
            rows = source.execute(
                f'SELECT rowid, * FROM "{table}" WHERE rowid > ? ORDER BY rowid', (last,)
            )
            for number, *row in rows:
                if number > last:  # else of a page that is cut, and has zeros there
                    yield tuple(row)
                    last, step = number, 1
            return
        except sqlite3.DatabaseError:
            last, step = last + step, 2 * step


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
        end, further = _whole_part(file, path.stat().st_size)
        file.seek(end)
        file.truncate()
        file.write(further)
        file.write(_RECORD.pack(_DATA_END, 4) + bytes(4))
        file.write(_RECORD.pack(_FOOTER, 20) + bytes(20) + _MCAP)


def _whole_part(file: BinaryIO, size: int) -> tuple[int, bytes]:
    """Return where the last whole record before the index ends, and those in a chunk cut there."""
    end = len(_MCAP)
    for kind, begin, after in _records(file, len(_MCAP)):
        if kind == _CHUNK:
            file.seek(begin + _RECORD.size)
            body = file.read(min(after, size) - file.tell())
            records, whole = _records_of_chunk(body)
            if not whole or after > size:
                return begin, records
        if after > size or kind in (_DATA_END, _FOOTER):
            return begin, b""
        end = after
    return end, b""


def _records(file: BinaryIO, begin: int) -> Iterator[tuple[int, int, int]]:
    """Yield kind, beginning and end of each record of MCAP; the last may end beyond the file."""
    file.seek(begin)
    while len(head := file.read(_RECORD.size)) == _RECORD.size and head[0] != _NONE:
        kind, length = _RECORD.unpack(head)
        end = begin + _RECORD.size + length
        yield kind, begin, end
        begin = file.seek(min(end, sys.maxsize))  # of damaged records any length


def _records_of_chunk(body: bytes) -> tuple[bytes, bool]:
    """Return the whole records of a chunk, which mean the same outside of it; and whether all."""
    if len(body) < _CHUNK_HEAD.size:
        return b"", False
    _, _, size, checksum, length = _CHUNK_HEAD.unpack_from(body)
    begin = _CHUNK_HEAD.size + length
    data = _decompressed(body[begin + 8 :], body[_CHUNK_HEAD.size : begin].decode())
    ends = [end for _, _, end in _records(io.BytesIO(data), 0) if end <= len(data)]
    records = data[: max(ends, default=0)]
    if len(data) < size or not checksum:
        return records, len(records) == size
    whole = crc32(data) == checksum
    return records if whole else b"", whole


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
        if b"op" not in fields:  # zeros, of a file that was made longer than it was written
            return
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
