"""Streams and units recognised from column names, and units that make values plausible."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magfusion.files.foreign.columns import EULER, QUATERNION, STREAMS, TIME, Term
from magfusion.files.foreign.source import SourceColumn
from magfusion.files.foreign.units import (
    ISO,
    UNITS,
    Dimension,
    Raw,
    SourceUnit,
    parse_unit,
    stamp_numbers,
)
from magfusion.units import STANDARD_GRAVITY, Array

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
# Of each stream, whose columns may have no names of their own.
_VECTORS = {
    "imu": ("gyro", "accel"),
    "gyro": ("gyro",),
    "accel": ("accel",),
    "magnetometer": ("field",),
}
_TYPICAL = {Dimension.FORCE: STANDARD_GRAVITY, Dimension.FIELD: 5e-5}  # SI
FAST = 8.0  # rad/s; a body that turns so fast on the mean is more likely measured in degrees
FAR = 500.0  # m
NORMALISED = 0.15  # about one, of a field divided by its size: no gauss, the Earth has .7
LEAST_RISING = 0.99  # of the steps of a clock
LEAST_COUNTED = 0.9  # of the steps of an index
_RATES_HZ = (5.0, 30_000.0)
_DATES_S = (9.5e8, 4.1e9)  # s since 1970: from 2000 to 2100


@dataclass(frozen=True)
class Named:
    """A column recognised by its name.

    Parameters
    ----------
    unit : SourceUnit, optional
        Given by the name, or the file.
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


def likely_unit(dimension: Dimension, values: Array) -> SourceUnit:
    """Return the unit in which the sizes of vectors, shape (n,), would be plausible."""
    known = np.abs(values[np.isfinite(values)])
    size = float(np.median(known)) if len(known) else 0.0
    if dimension is Dimension.FIELD and abs(size - 1.0) < NORMALISED:
        return SourceUnit("uT", dimension, "50")  # of the local field, which no table gives
    if dimension in _TYPICAL and size > 0.0:
        typical = _TYPICAL[dimension]
        names = {name: abs(np.log(size * si / typical)) for name, si in UNITS[dimension].items()}
        return SourceUnit(min(names, key=lambda name: names[name]), dimension)
    if dimension is Dimension.RATE:
        return SourceUnit("deg/s" if np.sqrt(np.mean(known**2)) > FAST else "rad/s", dimension)
    if dimension is Dimension.LENGTH:
        return SourceUnit("mm" if size > FAR else "m", dimension)
    return SourceUnit(next(iter(UNITS[dimension])), dimension)


def likely_time_unit(raw: Raw, usual: str = "s") -> SourceUnit:
    """Return the unit in which stamps would have a plausible rate, or else be a date of today.

    Parameters
    ----------
    usual : str
        The unit that is preferred among several plausible ones.
    """
    values = stamp_numbers(raw)
    if not len(values):
        return SourceUnit(ISO, Dimension.TIME)
    steps = np.diff(values)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    largest = float(np.max(np.abs(values), initial=0.0))

    def doubts(name: str) -> tuple[bool, bool, bool]:
        size = UNITS[Dimension.TIME][name]
        sampled = step > 0.0 and _RATES_HZ[0] <= 1.0 / (step * size) <= _RATES_HZ[1]
        return not sampled, not _DATES_S[0] <= largest * size <= _DATES_S[1], name != usual

    return SourceUnit(min(("s", "ms", "us", "ns"), key=doubts), Dimension.TIME)


def by_place(
    stream: str, columns: Sequence[SourceColumn], samples: Sequence[Array], dates: Sequence[bool]
) -> dict[str, tuple[int, SourceUnit]]:
    """Return what columns of unknown names may be, by their units, places and sizes.

    Parameters
    ----------
    samples : sequence of ndarray
        The first values of each column; none where they are no numbers.
    dates : sequence of bool
        Whether a column holds dates.
    """
    result = _first_clock(samples, dates)
    clocks = [place for place, _ in result.values()]
    open_terms = [
        k
        for k in range(len(columns))
        if k not in clocks and len(samples[k]) and not _is_index(samples[k])
    ]
    dimensions = {stem: STREAMS[stream][f"{stem}_x"] for stem in _VECTORS.get(stream, ())}
    for stem in list(dimensions):
        triple = _by_unit(columns, open_terms, dimensions[stem])
        if triple:
            result |= _along_axes(stem, triple)
            open_terms = [k for k in open_terms if k not in dict(triple)]
            del dimensions[stem]
    for stem, triple in _by_size(samples, open_terms, dimensions).items():
        result |= _along_axes(stem, triple)
    return result


def _first_clock(
    samples: Sequence[Array], dates: Sequence[bool]
) -> dict[str, tuple[int, SourceUnit]]:
    """Return the first column that holds dates, or that rises as stamps do."""
    for place, (values, dated) in enumerate(zip(samples, dates, strict=True)):
        if dated:
            return {TIME: (place, SourceUnit(ISO, Dimension.TIME))}
        if len(values) > 1 and _is_clock(values) and not _is_index(values):
            return {TIME: (place, likely_time_unit(values))}
    return {}


def _along_axes(
    stem: str, triple: list[tuple[int, SourceUnit]]
) -> dict[str, tuple[int, SourceUnit]]:
    return {f"{stem}_{axis}": one for axis, one in zip("xyz", triple, strict=True)}


def _by_unit(
    columns: Sequence[SourceColumn], open_terms: list[int], dimension: Dimension
) -> list[tuple[int, SourceUnit]]:
    """Return the three columns whose units are of a dimension; none where there are not three."""
    units = ((k, _unit_in(columns[k], dimension)) for k in open_terms)
    tagged = [(k, unit) for k, unit in units if unit is not None]
    return tagged if len(tagged) == 3 else []


def _by_size(
    samples: Sequence[Array], open_terms: list[int], dimensions: dict[str, Dimension]
) -> dict[str, list[tuple[int, SourceUnit]]]:
    """Return, three columns after the other, vectors with the units that their sizes suggest."""
    triples = [open_terms[k : k + 3] for k in range(0, len(open_terms) - len(open_terms) % 3, 3)]
    if not dimensions or len(triples) < len(dimensions):
        return {}
    sizes = [_sizes([samples[k] for k in triple]) for triple in triples]
    order = list(range(len(dimensions)))
    if tuple(dimensions) == _VECTORS["imu"] and len(triples) == 2:
        # Gravity keeps its size while a body moves.
        steady = min(order, key=lambda k: float(np.std(sizes[k]) / np.mean(sizes[k])))
        order = [1 - steady, steady]
    return {
        stem: [(place, likely_unit(dimension, sizes[k])) for place in triples[k]]
        for (stem, dimension), k in zip(dimensions.items(), order, strict=True)
    }


def _unit_in(column: SourceColumn, dimension: Dimension) -> SourceUnit | None:
    """Return the unit of a dimension that a column of unknown name has."""
    units = (parse_unit(text, dimension) for _, text in readings(column) if text)
    return next((unit for unit in units if unit is not None), None)


def _is_clock(values: Array) -> bool:
    steps = np.diff(values)
    return bool(np.mean(steps > 0.0) > LEAST_RISING and np.all(np.isfinite(values)))


def _is_index(values: Array) -> bool:
    """Return whether values count rows: integers that rise by one, but where rows are lost."""
    return len(values) > 1 and float(np.mean(np.diff(values) == 1.0)) > LEAST_COUNTED


def _sizes(columns: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.sum(np.square(columns), axis=0)) + np.finfo(float).tiny)
