"""Columns of a log's streams, and how a user maps them: ``imu.gyro_x=-GyrY[deg/s]``."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from magfusion.errors import InputError
from magfusion.files.foreign.source import SourceColumn
from magfusion.files.foreign.units import Dimension, SourceUnit, accepted, parse_unit, si_unit

TIME = "time"
_AXES = "xyz"


def _vector(stem: str, dimension: Dimension) -> dict[str, Dimension]:
    return {f"{stem}_{axis}": dimension for axis in _AXES}


QUATERNION = ("qw", "qx", "qy", "qz")
EULER = ("roll", "pitch", "yaw")
VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
STREAMS: dict[str, dict[str, Dimension]] = {
    "imu": {
        TIME: Dimension.TIME,
        **_vector("gyro", Dimension.RATE),
        **_vector("accel", Dimension.FORCE),
    },
    # Of an inertial sensor whose two halves are in two tables.
    "gyro": {TIME: Dimension.TIME, **_vector("gyro", Dimension.RATE)},
    "accel": {TIME: Dimension.TIME, **_vector("accel", Dimension.FORCE)},
    "magnetometer": {TIME: Dimension.TIME, **_vector("field", Dimension.FIELD)},
    "truth": {
        TIME: Dimension.TIME,
        **_vector("position", Dimension.LENGTH),
        **dict.fromkeys(QUATERNION, Dimension.NUMBER),
        **dict.fromkeys(EULER, Dimension.ANGLE),
        **_vector("velocity", Dimension.SPEED),
    },
}
FIELDS = "fields"  # of phasors, whose columns depend on the coils
TABLES = (*STREAMS, FIELDS)
OPTIONAL = frozenset(VELOCITY)
# What is taken only where it is said, and may be missing in any row.
OPTIONAL_COLUMNS: dict[str, dict[str, Dimension]] = {"magnetometer": {"slot": Dimension.NUMBER}}
# What stands for several columns.
GROUPS = {
    **{stem: tuple(f"{stem}_{a}" for a in _AXES) for stem in ("gyro", "accel", "field")},
    **{stem: tuple(f"{stem}_{a}" for a in _AXES) for stem in ("position", "velocity")},
    "quaternion": QUATERNION,
    "euler": EULER,
}
ORDERS = {"wxyz": (0, 1, 2, 3), "xyzw": (3, 0, 1, 2)}  # where w, x, y and z stand


@dataclass(frozen=True)
class ColumnMapping:
    """One ``STREAM.COLUMN=NAME[unit]``, or ``STREAM=TOPIC`` with an empty column.

    `value`: what is behind the equals sign.
    """

    stream: str
    column: str
    value: str

    def __str__(self) -> str:
        column = f".{self.column}" if self.column else ""
        return f"{self.stream}{column}={self.value}"


@dataclass(frozen=True)
class Term:
    """A column of the file with sign and unit.

    `place`: of the column in the file.
    """

    place: int
    unit: SourceUnit
    sign: float = 1.0


class Undecided(ValueError):
    """Why an entry cannot be resolved, and possible replacements.

    `place`: the column that is meant, where only its unit is open. `sign`: of it.
    """

    def __init__(self, reason: str, place: int | None = None, sign: float = 1.0) -> None:
        super().__init__(reason)
        self.place, self.sign = place, sign


def parse_entry(text: str) -> list[ColumnMapping]:
    """Read one option; an entry for several columns becomes several entries.

    Raises InputError where it is none, or names an unknown stream or column.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    stream, _, column = name.partition(".")
    if not equals or not value or not name:
        raise InputError(
            f"--map {text!r}: write TABLE.COLUMN=NAME[unit], as 'imu.gyro_x=GyrX[deg/s]', or"
            " TABLE=TOPIC"
        )
    if stream == FIELDS and column:
        return [ColumnMapping(stream, column, value)]
    if stream not in STREAMS:
        raise InputError(f"--map {text!r}: {stream} is no table; write one of {', '.join(STREAMS)}")
    if not column or column in STREAMS[stream] or column in OPTIONAL_COLUMNS.get(stream, {}):
        return [ColumnMapping(stream, column, value)]
    if column not in GROUPS or GROUPS[column][0] not in STREAMS[stream]:
        known = [*STREAMS[stream]]
        known += [group for group, names in GROUPS.items() if names[0] in known]
        raise InputError(
            f"--map {text!r}: {column} is no column of {stream}; write one of {', '.join(known)}"
        )
    return _split(stream, column, value, text)


def _split(stream: str, group: str, value: str, text: str) -> list[ColumnMapping]:
    result = re.fullmatch(r"(?P<names>.*?)\s*(?P<unit>\[[^\[\]]*\])?", value)
    assert result is not None
    unit, targets = result["unit"] or "", GROUPS[group]
    names = [name.strip() for name in result["names"].split(",")]
    order: Sequence[int] = range(len(targets))
    if group == "quaternion":
        if unit.strip("[]") not in ORDERS:
            raise InputError(
                f"--map {text!r}: give the order of the quaternion, as"
                f" '{stream}.quaternion={result['names']}[wxyz]' or [xyzw]"
            )
        order, unit = ORDERS[unit.strip("[]")], "[1]"
    if len(names) == 1:
        names = [f"{names[0]}:{k}" for k in range(len(targets))]
    if len(names) != len(targets):
        raise InputError(
            f"--map {text!r}: {group} takes {len(targets)} names, or that of one array; found"
            f" {len(names)}"
        )
    return [
        ColumnMapping(stream, target, f"{names[k]}{unit}")
        for target, k in zip(targets, order, strict=True)
    ]


def dimension_of(stream: str, column: str) -> Dimension:
    """Return what a column of a stream is."""
    return (STREAMS[stream] | OPTIONAL_COLUMNS.get(stream, {}))[column]


def resolve(entry: ColumnMapping, columns: Sequence[SourceColumn]) -> tuple[Term, ...]:
    """Return the columns of the file that an entry means; stamps may be a sum of several.

    Raises Undecided with the reason, for a column that is not there or a unit that is not given.
    """
    dimension = dimension_of(entry.stream, entry.column)
    parts = [entry.value]
    if dimension is Dimension.TIME and place_of(entry.value, columns) is None:
        parts = re.split(r"(?<=\])\s*\+\s*", entry.value)
    return tuple(term_of(part.strip(), columns, dimension, entry) for part in parts)


def term_of(
    text: str, columns: Sequence[SourceColumn], dimension: Dimension, entry: ColumnMapping
) -> Term:
    """Return the column, sign and unit that a text means."""
    for sign, lead in ((1.0, ""), (1.0, "+"), (-1.0, "-")):
        if not text.startswith(lead):
            continue
        bare = text[len(lead) :].strip()
        place = place_of(bare, columns)
        if place is not None:
            return Term(place, _own_unit(columns[place], place, dimension, sign), sign)
        tagged = re.fullmatch(r"(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]", bare)
        place = None if tagged is None else place_of(tagged["name"], columns)
        if tagged is not None and place is not None:
            unit = parse_unit(tagged["unit"], dimension)
            if unit is None:
                raise Undecided(
                    f"{tagged['unit']!r} is no unit of {dimension}; write one of"
                    f" {accepted(dimension)}",
                    *(place, sign),
                )
            return Term(place, unit, sign)
    raise Undecided(_not_there(text, columns, entry))


def place_of(name: str, columns: Sequence[SourceColumn]) -> int | None:
    """Return the place of the column that a name means, or None.

    Raises Undecided where several columns have it.
    """
    exact = [k for k, column in enumerate(columns) if column.name == name]
    bare = [k for k, c in enumerate(columns) if _loose(c.name) == _loose(name)]
    untagged = [k for k, c in enumerate(columns) if _loose(_untagged(c.name)) == _loose(name)]
    for result in (exact, bare, untagged):
        if len(result) > 1:
            places = ", ".join(map(str, result))
            raise Undecided(
                f"column {name} is there {len(result)} times; name it by its place (counted from"
                f" 0), one of #{places.replace(', ', ', #')}"
            )
        if result:
            return result[0]
    number = re.fullmatch(r"#?(\d+)", name)
    if number and int(number[1]) < len(columns):
        return int(number[1])
    return None


def terms_by_place(
    names: Mapping[str, Dimension], columns: Sequence[SourceColumn], time_unit: str
) -> dict[str, tuple[Term, ...]]:
    """Return columns that a format knows by their places, in the header's units or else in SI."""
    terms: dict[str, tuple[Term, ...]] = {}
    for place, ((name, dimension), column) in enumerate(zip(names.items(), columns, strict=False)):
        tag = column.name.partition("[")[2].rstrip("] ")
        unit = parse_unit(tag, dimension) if tag else None
        usual = time_unit if dimension is Dimension.TIME else si_unit(dimension)
        terms[name] = (Term(place, unit or SourceUnit(usual, dimension)),)
    return terms


def _loose(name: str) -> str:
    return re.sub(r"\s", "", name).strip("/").casefold()


def _untagged(name: str) -> str:
    return re.sub(r"\s*[\[(][^\[\]()]*[\])]\s*$", "", name)


def _own_unit(column: SourceColumn, place: int, dimension: Dimension, sign: float) -> SourceUnit:
    """Return the unit that the file names; a number has none."""
    tag = re.search(r"[\[(]([^\[\]()]*[^\[\]()\d][^\[\]()]*)[\])]\s*$", column.name)
    declared = column.unit or (tag[1] if tag else "")
    unit = parse_unit(declared, dimension) if declared or dimension is Dimension.NUMBER else None
    if unit is None and dimension is Dimension.NUMBER:
        unit = parse_unit("1", dimension)
    if unit is None:
        declared = f" ({declared!r} is none)" if declared else ""
        raise Undecided(f"the unit of column {column.name} is not given{declared}", place, sign)
    return unit


def _not_there(text: str, columns: Sequence[SourceColumn], entry: ColumnMapping) -> str:
    names = [column.name for column in columns]
    bare = re.sub(r"\s*\[[^\[\]]*\]$", "", text).lstrip("+-")
    near = get_close_matches(bare, names, 1, 0.6)
    hint = f"; is it {near[0]}?" if near else ""
    shown = ", ".join(names[:30]) + (", ..." if len(names) > 30 else "")
    return f"there is no column {bare} for {entry.column} (found {shown}){hint}"
