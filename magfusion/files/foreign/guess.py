"""Streams and units recognised from column names, and units that make values plausible."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from magfusion.files.foreign.columns import EULER, QUATERNION, STREAMS, TIME, Term
from magfusion.files.foreign.source import SourceColumn
from magfusion.files.foreign.units import Dimension, SourceUnit, parse_unit

# Names without their axis; the short ones only where nothing else is in the name.
_STEMS = {
    "gyro": ("gyroscope", "gyro", "gyr", "omega", "angularvelocity", "angvel", "angularrate"),
    "accel": ("accelerometer", "acceleration", "accelero", "accel", "acc", "specificforce"),
    "field": ("magnetometer", "magneticfield", "magfield", "bfield", "magneto", "mag", "field"),
    "position": ("position", "translation", "pos", "prsr"),
    "velocity": ("linearvelocity", "velocity", "vel", "vrsr"),
    "q": ("quaternion", "quat", "orientation", "rotation", "qrs", "qwb", "qwxyz"),
}
_MORE = {
    "gyro": ("rotationrate", "rotrate", "wrss", "turnrate"),
    "accel": ("linearacceleration", "arss"),
    "field": ("magneticfluxdensity", "fluxdensity"),
}
_SHORT = {
    "gyro": ("w", "g"),
    "accel": ("a",),
    "field": ("b", "m", "h"),
    "position": ("p", "t"),
    "velocity": ("v",),
    "q": ("q",),
}
_TIMES = (
    "time",
    "timestamp",
    "timestamps",
    "stamp",
    "epoch",
    "timefine",
    "clock",
    "elapsed",
    "datetime",
)
_SHORT_TIMES = ("t", "ts", "utc", "sec", "seconds", "date", "zeit", "temps", "tiempo", "tempo")
# Of messages of ROS written as text, whose stamps are in two columns.
_WHOLE = re.compile(r".*stamp\W*(secs?|seconds)$", re.I)
_REST = re.compile(r".*stamp\W*(nsecs?|nanosecs?|nanoseconds)$", re.I)
# Of receivers of GPS.
_WEEK = re.compile(r"(gps\W*)?week( ?(number|no))?$", re.I)
_OF_WEEK = re.compile(
    r"(gps\W*)?(tow|seconds? of week|week ?seconds?)\W*(s|sec|seconds)?\W*$", re.I
)
_NUMBERED = re.compile(r"(?P<stem>.*?)[\[(:_.]*(?P<place>[0-4])[\])]*")
_NOT_MEASURED = re.compile(r"bias|cov|std|sigma|var(?!io)|temp|offset|status|uncal|error")
_OF_STREAM = {
    "imu": re.compile(r"imu|gyr|acc|inertial"),
    "magnetometer": re.compile(r"mag|field|fgm|flux"),
    "truth": re.compile(r"truth|gt|ref|mocap|vicon|opti|pose|odom"),
}
# What columns are that are called x, y and z alone.
_BARE = {"gyro": "gyro", "accel": "accel", "magnetometer": "field", "truth": "position"}
_OF_FILE = {
    "gyro": re.compile(r"gyr|angular"),
    "accel": re.compile(r"acc"),
    "magnetometer": re.compile(r"mag"),
}


@dataclass(frozen=True)
class Named:
    """A column recognised by its name.

    `unit`: given by the name, or the file.
    """

    place: int
    target: str
    unit: SourceUnit | None


def named_columns(columns: Sequence[SourceColumn], stream: str) -> dict[str, list[Named]]:
    """Return for each column of a stream those of a file whose names match it."""
    result: dict[str, list[Named]] = {target: [] for target in STREAMS[stream]}
    for place, column in enumerate(columns):
        if (one := _named(place, column, stream)) is not None:
            result[one.target].append(one)
    return {target: _nearest(named, columns, stream) for target, named in result.items()}


def numbered_quaternion(columns: Sequence[SourceColumn]) -> tuple[str, ...]:
    """Return the four columns of a quaternion that numbers name: their order is not known."""
    known = {}
    for column in columns:
        numbered = _NUMBERED.fullmatch(column.name.strip())
        stem = re.sub(r"[^a-z]", "", numbered["stem"].casefold()) if numbered else ""
        if numbered and stem.endswith((*_STEMS["q"], *_SHORT["q"])):
            known[int(numbered["place"])] = column.name
    first = min(known, default=0)
    places = range(first, first + 4)
    return tuple(known[k] for k in places) if set(places) <= set(known) else ()


def two_column_stamp(columns: Sequence[SourceColumn]) -> tuple[Term, ...]:
    """Return stamps that are in two columns: seconds and nanoseconds, or weeks and seconds."""
    second, rest = SourceUnit("s", Dimension.TIME), SourceUnit("ns", Dimension.TIME)
    week = SourceUnit("s", Dimension.TIME, "604800")
    for pair in (((_WHOLE, second), (_REST, rest)), ((_WEEK, week), (_OF_WEEK, second))):
        places = [
            [k for k, column in enumerate(columns) if pattern.match(column.name)]
            for pattern, _ in pair
        ]
        if [len(own) for own in places] == [1, 1]:
            return tuple(Term(own[0], unit) for own, (_, unit) in zip(places, pair, strict=True))
    return ()


def _named(place: int, column: SourceColumn, stream: str) -> Named | None:
    if _NOT_MEASURED.search(column.name.casefold()) or _of_unknown_order(column, stream):
        return None
    for name, text in readings(column):
        target = _target(name, stream)
        if target is None:
            continue
        dimension = STREAMS[stream][target]
        unit = parse_unit(text, dimension) if text or dimension is Dimension.NUMBER else None
        if unit is not None or not text:
            return Named(place, target, unit)
    bare = readings(column)[0][0]
    target = _target(bare, stream)
    return None if target is None else Named(place, target, None)


def _of_unknown_order(column: SourceColumn, stream: str) -> bool:
    numbered = _NUMBERED.fullmatch(column.name.strip()) is not None
    return numbered and any(_target(name, stream) in QUATERNION for name, _ in readings(column))


def readings(column: SourceColumn) -> list[tuple[str, str]]:
    """Return the ways to separate a name from its unit, the most certain first."""
    indexed = re.fullmatch(r"(.*)(?:\[([012])\]|:([012]))", column.name)
    if indexed is not None:
        axis = "xyz"[int(indexed[2] or indexed[3])]
        parts = readings(SourceColumn(indexed[1], column.unit))
        return [(f"{name}_{axis}", unit) for name, unit in parts]
    name = column.name
    tag = re.fullmatch(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*", name)
    if column.unit:
        return [(tag[1] if tag else name, column.unit)]
    if tag:
        return [(tag[1], tag[2])]
    words = re.split(r"[_ ]+", name)
    cut = [
        ("_".join(words[:-count]), "_".join(words[-count:]))
        for count in (3, 2, 1)
        if len(words) > count
    ]
    return [*cut, (name, "")]


def _target(name: str, stream: str) -> str | None:
    norm = re.sub(r"[^a-z0-9]", "", name.casefold())
    norm = re.sub(r"(buffer|buf|data|raw)(?=[wxyz]$)", "", norm)
    if norm in _SHORT_TIMES or norm.endswith(_TIMES):
        return TIME
    for angle in EULER:
        if angle in STREAMS[stream] and norm.endswith(angle):
            return angle
    for stem in _SHORT:
        axes = "wxyz" if stem == "q" else "xyz"
        for axis in axes:
            target = f"q{axis}" if stem == "q" else f"{stem}_{axis}"
            if target in STREAMS[stream] and _is(norm, stem, axis, stream):
                return target
    return None


def _is(norm: str, stem: str, axis: str, stream: str) -> bool:
    if norm in [f"{short}{axis}" for short in _SHORT[stem]]:
        return True
    if stem == _BARE.get(stream) and norm == axis:
        return True
    long = (*_STEMS[stem], *_MORE.get(stem, ()))
    return norm.endswith(tuple(f"{one}{axis}" for one in long)) or (
        norm in [f"{axis}{one}" for one in long]
    )


def _nearest(named: list[Named], columns: Sequence[SourceColumn], stream: str) -> list[Named]:
    """Return those of several whose names give their stream."""
    if len(named) < 2:
        return named
    own = "imu" if stream in ("gyro", "accel") else stream
    others = [pattern for name, pattern in _OF_STREAM.items() if name != own]

    def score(one: Named) -> int:
        name = columns[one.place].name.casefold()
        half = stream != own and _OF_FILE[stream].search(name) is not None
        return half + bool(_OF_STREAM[own].search(name)) - any(p.search(name) for p in others)

    best = max(map(score, named))
    return [one for one in named if score(one) == best]


def streams_of(columns: Sequence[SourceColumn], file_stem: str) -> set[str]:
    """Return the streams that the names of a file and of its columns make whole."""
    result = set()
    declared = {name for name, text in _OF_FILE.items() if text.search(file_stem.casefold())}
    for stream, needed in (
        ("imu", ("gyro_x", "accel_x")),
        ("gyro", ("gyro_x",)),
        ("accel", ("accel_x",)),
        ("magnetometer", ("field_x",)),
        ("truth", ("position_x", "qw")),
        ("truth", ("position_x", "roll")),
    ):
        named = named_columns(columns, stream)
        if all(
            any(_is_certain(n, columns, stream, declared) for n in named[one]) for one in needed
        ):
            result.add(stream)
    if "imu" in result and not _have_own_times(columns):
        return result - {"gyro", "accel"}
    return result - {"imu"}


def _have_own_times(columns: Sequence[SourceColumn]) -> bool:
    """Return whether gyro and accelerometer have a time each."""
    times = [named_columns(columns, half)[TIME] for half in ("gyro", "accel")]
    return all(len(own) == 1 for own in times) and times[0][0].place != times[1][0].place


def _is_certain(
    named: Named, columns: Sequence[SourceColumn], stream: str, declared: set[str]
) -> bool:
    """Return whether a column is of a stream; for an x alone its file or its unit decides."""
    bare, _ = readings(columns[named.place])[0]
    if stream == "truth" or bare.strip().casefold() != "x":
        return True
    return stream in declared if declared else named.unit is not None
