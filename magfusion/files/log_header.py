"""The header of a log, ``log.yaml``, and which directories are logs."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from magfusion.files.audio import AudioEntry
from magfusion.files.drive_columns import column_names
from magfusion.files.table import MAX_TIME_NS, TIME, Span, TableLayout, find_table, read_table
from magfusion.files.yaml_files import StrictModel, read_yaml

HEADER = "log.yaml"
_KEYS = {"magnetometer": ("field_x", "field_y", "field_z"), "fields": ("beacon",)}
_TIMES = TableLayout(numbers=(), repeats=True, strays=True)


class LogHeader(StrictModel):
    """What ``log.yaml`` holds."""

    magfusion_log: Literal[1]
    name: str
    epoch_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)
    source: str
    audio: AudioEntry | None = None


def has_header(path: Path) -> bool:
    """Return whether a directory has the header of a magfusion log."""
    return (path / HEADER).is_file()


def is_log(path: Path) -> bool:
    """Return whether a directory has the header of a log, or its tables of the field."""
    return has_header(path) or _field_table(path) is not None


def read_header(path: Path) -> LogHeader:
    """Read the header of a log.

    Without one, the directory's name is the log's, and time zero the first stamp of the field.

    Raises
    ------
    InputError
        If the header or the first table of the field cannot be read.
    """
    table = None if has_header(path) else _field_table(path)
    if table is None:
        return read_yaml(path / HEADER, LogHeader)
    first = int(read_table(table, _TIMES, Span(0)).time_ns[0])
    return LogHeader(
        magfusion_log=1, name=path.resolve().name, epoch_ns=first, source="tables without log.yaml"
    )


def _field_table(path: Path) -> Path | None:
    """Return the first table of the field that has the columns of a log."""
    if not path.is_dir():
        return None
    for stem, keys in _KEYS.items():
        table = find_table(path, stem)
        columns = [] if table is None else column_names(table)
        if TIME in columns and not set(keys).isdisjoint(columns):
            return table
    return None
