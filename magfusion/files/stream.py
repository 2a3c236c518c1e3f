"""The lines of a pipe: records in JSON lines or MessagePack, each with its place."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, BinaryIO, Literal

import msgpack
from pydantic import ValidationError

from magfusion.errors import InputError
from magfusion.files.records import Record
from magfusion.files.yaml_files import sentence

Format = Literal["json", "msgpack"]
_CHUNK = 1 << 16  # bytes
MAX_RECORD = 1 << 24  # bytes; minutes of samples
# MessagePack reserves what a list announces before it reads it.
MAX_LIST = 1 << 17


@dataclass(frozen=True, eq=False)
class NumberedRecord:
    """A record with its place in the stream, or the sentence with the reason why it is none.

    `source`, `unit`: what is read, and what ``number`` counts.
    """

    number: int
    record: Record | None
    refusal: str = ""
    source: str = "standard input"
    unit: str = "line"

    def located(self, reason: object) -> str:
        """Return a sentence on it with its place."""
        return f"{self.source}, {self.unit} {self.number}: {reason}"


def read_records(stream: BinaryIO, form: Format) -> Iterator[NumberedRecord]:
    """Yield the records of a stream as they come; blank lines are passed over.

    Raises InputError where MessagePack is none, or a record of it too large: it is unknown where
    the next begins.
    """
    return _json_records(stream) if form == "json" else _msgpack_records(stream)


def _json_records(stream: BinaryIO) -> Iterator[NumberedRecord]:
    number = 0
    while line := stream.readline(MAX_RECORD + 1):
        number += 1
        if len(line) > MAX_RECORD:
            while line and not line.endswith(b"\n"):
                line = stream.readline(_CHUNK)
            yield NumberedRecord(number, None, _TOO_LARGE)
        elif line.strip():
            yield checked_record(number, partial(Record.model_validate_json, line))


_TOO_LARGE = f"is larger than {MAX_RECORD >> 20} MiB; write fewer samples in a record."


def _msgpack_records(stream: BinaryIO) -> Iterator[NumberedRecord]:
    number, fed, whole = 0, 0, 0  # records; bytes received, and those of whole records
    unpacker = msgpack.Unpacker(
        max_buffer_size=MAX_RECORD + _CHUNK,
        max_str_len=MAX_RECORD,
        max_bin_len=MAX_RECORD,
        max_array_len=MAX_LIST,
        max_map_len=MAX_LIST,
    )
    # As much as has come: read() would wait for all of a chunk.
    while chunk := stream.read1(_CHUNK):  # type: ignore[attr-defined]
        try:
            unpacker.feed(chunk)
            fed += len(chunk)
            for content in unpacker:
                number, whole = number + 1, unpacker.tell()
                read = partial(Record.model_validate, content)
                yield replace(checked_record(number, read), unit="record")
        except msgpack.BufferFull as error:
            raise InputError(f"{_RECORD} {number + 1}: {_TOO_LARGE}") from error
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
            reason = str(error) or type(error).__name__
            raise InputError(
                f"{_RECORD} {number + 1}: is no MessagePack ({reason}); write whole records"
            ) from error
    if fed > whole:
        raise InputError(
            f"{_RECORD} {number + 1}: breaks off after {fed - whole} bytes; write whole records"
        )


_RECORD = "standard input, record"


def checked_record(number: int, read: Callable[[], Record]) -> NumberedRecord:
    """Return a record with its number, or the reason why it is none."""
    try:
        return NumberedRecord(number, read())
    except ValidationError as error:
        return NumberedRecord(number, None, sentence(error, Record, "record"))


def json_line(content: dict[str, Any]) -> bytes:
    """Return plain values as one line of JSON."""
    return json.dumps(content, allow_nan=False).encode() + b"\n"
