"""Requests of an import: tables, maps of columns, rates; by options or a small YAML file."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from pydantic import Field

from magfusion.errors import InputError
from magfusion.files.foreign.columns import TABLES, ColumnMapping, parse_entry
from magfusion.files.foreign.plan import Findings, Rate
from magfusion.files.foreign.units import Dimension, parse_unit
from magfusion.files.yaml_files import StrictModel, read_yaml

MAX_SHIFT = 10**10  # s


class MapFile(StrictModel):
    """What the file of ``--map-file`` may hold, by the names of the options."""

    imu: str | None = None
    gyro: str | None = None
    accel: str | None = None
    magnetometer: str | None = None
    truth: str | None = None
    fields: str | None = None
    sigma: str | None = None
    delimiter: str | None = None
    missing: list[str] = Field(default_factory=list)
    epoch: str | int | None = None
    rate_hz: dict[str, float | int | str] = Field(default_factory=dict)
    offset: dict[str, float | int | str] = Field(default_factory=dict)
    rows: dict[str, str] = Field(default_factory=dict)
    map: dict[str, str | int] = Field(default_factory=dict)


@dataclass(frozen=True)
class ImportRequest:
    """Request of an import."""

    files: dict[str, Path]  # of streams that are named
    entries: dict[str, list[ColumnMapping]]  # by stream
    rates: dict[str, Rate] = field(default_factory=dict)
    delimiter: str | None = None
    epoch: str | None = None
    shifts_ns: dict[str, int] = field(default_factory=dict)  # added to the times of a stream
    # column, and the value that rows of the stream have in it
    rows: dict[str, tuple[str, str]] = field(default_factory=dict)
    missing: tuple[str, ...] = ()  # markers of missing values
    sigma: float | None = None  # of phasors whose table has none (T)
    recorded: bool = False  # whether the magnetometer is a recording, which is no table


def read_request(
    files: Mapping[str, Path | None],
    maps: Sequence[str],
    rates: Sequence[str],
    offsets: Sequence[str],
    rows: Sequence[str],
    delimiter: str | None,
    missing: Sequence[str],
    sigma: str | None,
    epoch: str | None,
    map_file: Path | None,
    declared: Findings,
) -> ImportRequest:
    """Return the requests of the options, and those of a file.

    Raises InputError where the file is none.
    """
    model = MapFile(**{}) if map_file is None else read_yaml(map_file, MapFile)
    root = Path() if map_file is None else map_file.parent
    named = {stream: path for stream, path in files.items() if path is not None}
    for stream in TABLES:
        name = getattr(model, stream)
        if name is not None and stream not in named:
            named[stream] = root / name
    entries = _by_stream((_as_options(model.map), maps), declared)
    return ImportRequest(
        named,
        entries,
        _rates([*_as_options(model.rate_hz), *rates], declared),
        model.delimiter if delimiter is None else delimiter,
        epoch if epoch is not None or model.epoch is None else str(model.epoch),
        _shifts([*_as_options(model.offset), *offsets], declared),
        _rows([*_as_options(model.rows), *rows], declared),
        (*model.missing, *missing),
        _sigma(model.sigma if sigma is None else sigma, declared),
    )


def _as_options(entries: Mapping[str, object]) -> list[str]:
    """Return entries of a file as the command line has them."""
    return [f"{name}={value}" for name, value in entries.items()]


def _by_stream(
    sources: Iterable[Sequence[str]], declared: Findings
) -> dict[str, list[ColumnMapping]]:
    """Return the columns of each stream, by the last source that gives them."""
    entries: dict[str, dict[str, ColumnMapping]] = defaultdict(dict)
    for lines in sources:
        seen: set[tuple[str, str]] = set()
        for entry in _entries(lines, declared):
            if (entry.stream, entry.column) in seen:
                declared.problems.append(f"--map {entry.stream}.{entry.column} is given twice.")
            seen.add((entry.stream, entry.column))
            entries[entry.stream][entry.column] = entry
    return {stream: list(those.values()) for stream, those in entries.items()}


def _entries(lines: Sequence[str], declared: Findings) -> list[ColumnMapping]:
    result = []
    for line in lines:
        try:
            result += parse_entry(line)
        except InputError as error:
            declared.problems.append(f"{error}.")
    return result


def _rates(lines: Sequence[str], declared: Findings) -> dict[str, Rate]:
    result = {}
    for line in lines:
        stream, _, value = (part.strip() for part in line.partition("="))
        number, _, start = value.partition("@")
        try:
            rate = Rate(Fraction(number), Fraction(start) if start else None)
        except (ValueError, ZeroDivisionError):
            rate = None
        if stream not in TABLES or rate is None or rate.hz <= 0:
            declared.problems.append(
                f"--rate-hz {line!r}: write TABLE=HZ with a table of {', '.join(TABLES)}, or"
                " TABLE=HZ@SECONDS where its first row is later than the log's zero."
            )
        else:
            result[stream] = rate
    return result


def _sigma(text: str | None, declared: Findings) -> float | None:
    unit = None if text is None else parse_unit(text, Dimension.FIELD)
    if text is None or (unit is not None and unit.si > 0.0):
        return None if unit is None else unit.si
    declared.problems.append(f"--sigma {text!r}: write a number and its unit, as 0.5*nT.")
    return None


def _shifts(lines: Sequence[str], declared: Findings) -> dict[str, int]:
    result = {}
    for line in lines:
        stream, _, value = (part.strip() for part in line.partition("="))
        try:
            seconds = Fraction(value)
        except (ValueError, ZeroDivisionError):
            seconds = None
        if stream not in TABLES or seconds is None or abs(seconds) > MAX_SHIFT:
            declared.problems.append(
                f"--offset {line!r}: write TABLE=SECONDS with a table of {', '.join(TABLES)};"
                " the seconds are added to its times."
            )
        else:
            result[stream] = round(seconds * 10**9)
    return result


def _rows(lines: Sequence[str], declared: Findings) -> dict[str, tuple[str, str]]:
    result = {}
    for line in lines:
        stream, _, value = (part.strip() for part in line.partition("="))
        column, _, wanted = (part.strip() for part in value.rpartition(":"))
        if stream not in TABLES or not column or not wanted:
            declared.problems.append(
                f"--rows {line!r}: write TABLE=COLUMN:VALUE with a table of {', '.join(TABLES)},"
                " as 'gyro=sensor:gyroscope'."
            )
        else:
            result[stream] = (column, wanted)
    return result
