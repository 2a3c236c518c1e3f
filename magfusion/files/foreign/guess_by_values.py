"""What columns may be, and in which units, judged by their values."""

from collections.abc import Sequence

import numpy as np

from magfusion.files.foreign.columns import STREAMS, TIME
from magfusion.files.foreign.guess import readings
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
MIN_RISING_SHARE = 0.99  # of the steps of a clock
MIN_COUNTED_SHARE = 0.9  # of the steps of an index
_RATES_HZ = (5.0, 30_000.0)
_DATES_S = (9.5e8, 4.1e9)  # s since 1970: from 2000 to 2100


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

    `usual`: the unit that is preferred among several plausible ones.
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

    `samples`: the first values of each column; none where they are no numbers. `dates`: whether a
    column holds dates.
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
    return bool(np.mean(steps > 0.0) > MIN_RISING_SHARE and np.all(np.isfinite(values)))


def _is_index(values: Array) -> bool:
    """Return whether values count rows: integers that rise by one, but where rows are lost."""
    return len(values) > 1 and float(np.mean(np.diff(values) == 1.0)) > MIN_COUNTED_SHARE


def _sizes(columns: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.sum(np.square(columns), axis=0)) + np.finfo(float).tiny)
