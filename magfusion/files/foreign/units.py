"""Units as people write them, and stamps of any unit as whole nanoseconds."""

import re
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from magfusion.units import (
    DEGREE,
    NANOSECOND,
    STANDARD_GRAVITY,
    AnyArray,
    Array,
    BoolArray,
    IntArray,
)

ISO = "iso"
MAX_EXACT_NS = 1e14  # ns; a day, up to which a double resolves a hundredth of a nanosecond
NO_STAMP = np.iinfo(np.int64).min
Raw = Any  # an array of NumPy, or of Arrow


class Dimension(StrEnum):
    """What a column measures."""

    TIME = "time"
    RATE = "angular rate"
    FORCE = "specific force"
    FIELD = "field"
    LENGTH = "length"
    ANGLE = "angle"
    SPEED = "speed"
    NUMBER = "number"


UNITS: dict[Dimension, dict[str, float]] = {
    Dimension.TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    Dimension.RATE: {
        **{"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": DEGREE, "mdeg/s": 1e-3 * DEGREE},
        **{"deg/h": DEGREE / 3600.0, "rpm": np.pi / 30.0},
    },
    Dimension.FORCE: {
        **{"m/s^2": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3},
        **{"g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY, "ug": 1e-6 * STANDARD_GRAVITY},
    },
    Dimension.FIELD: {
        **{"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "pT": 1e-12},
        **{"gauss": 1e-4, "mG": 1e-7, "uG": 1e-10},
    },
    Dimension.LENGTH: {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "ft": 0.3048},
    Dimension.ANGLE: {"rad": 1.0, "mrad": 1e-3, "deg": DEGREE},
    Dimension.SPEED: {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6},
    Dimension.NUMBER: {"1": 1.0},
}
# Other spellings, when case, spaces, dots and carets are left out.
_SPELLINGS = {
    Dimension.TIME: {
        **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
        **dict.fromkeys(("msec", "millis", "millisecond", "milliseconds"), "ms"),
        **dict.fromkeys(("usec", "micros", "microsecond", "microseconds"), "us"),
        **dict.fromkeys(("nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"), "ns"),
        **dict.fromkeys(("iso8601", "utc", "datetime", "date"), ISO),
    },
    Dimension.RATE: {
        **dict.fromkeys(("rads", "radps", "rad_s", "rads-1", "radsec", "rad/sec"), "rad/s"),
        **dict.fromkeys(("dps", "degs", "degps", "deg_s", "degs-1", "deg/sec"), "deg/s"),
        **dict.fromkeys(("mdps", "mdegs"), "mdeg/s"),
    },
    Dimension.FORCE: {
        **dict.fromkeys(("m/s2", "m/s/s", "mps2", "ms2", "m_s2", "m_s_2", "ms-2"), "m/s^2"),
        **dict.fromkeys(("gee", "g0", "gs"), "g"),
    },
    Dimension.FIELD: {
        **dict.fromkeys(("tesla",), "T"),
        **dict.fromkeys(("millitesla",), "mT"),
        **dict.fromkeys(("microtesla",), "uT"),
        **dict.fromkeys(("nanotesla", "gamma"), "nT"),
        **dict.fromkeys(("g", "gs", "ga"), "gauss"),
        **dict.fromkeys(("mgauss", "milligauss"), "mG"),
        **dict.fromkeys(("ugauss", "microgauss"), "uG"),
    },
    Dimension.LENGTH: {**dict.fromkeys(("meter", "metre", "meters", "metres"), "m")},
    Dimension.ANGLE: {
        **dict.fromkeys(("radian", "radians"), "rad"),
        **dict.fromkeys(("degree", "degrees"), "deg"),
    },
    Dimension.SPEED: {**dict.fromkeys(("mps", "m_s", "ms", "ms-1", "m/sec"), "m/s")},
    Dimension.NUMBER: {"": "1", "-": "1"},
}
_ISO = r"^\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.]\d{1,9})?)?(Z|[-+]\d\d:?\d\d)?$"
_NUMBER = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
# Dates with the day or slashes first are turned to ISO; a time of day is one of the first day.
_WRITTEN = (
    (r"^(\d\d)\.(\d\d)\.(\d{4})", r"\3-\2-\1"),
    (r"^(\d{4})/(\d\d)/(\d\d)", r"\1-\2-\3"),
    (r"^(\d\d:\d\d:\d\d)", r"1970-01-01T\1"),
)
_SCALED = re.compile(r"(?P<factor>[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?)\*(?P<unit>.*)", re.I)


@dataclass(frozen=True)
class SourceUnit:
    """A unit, perhaps with a factor before it: ``0.5*nT``.

    `name`: as in `UNITS`; `ISO` for stamps that are dates. `factor`: as it was written, so that
    stamps can be scaled without rounding.
    """

    name: str
    dimension: Dimension
    factor: str = "1"

    @property
    def si(self) -> float:
        """Size in SI units."""
        return float(self.factor) * UNITS[self.dimension][self.name]

    def __str__(self) -> str:
        return self.name if self.factor == "1" else f"{self.factor}*{self.name}"


def parse_unit(text: str, dimension: Dimension) -> SourceUnit | None:
    """Return the unit that a text names, or None."""
    plain = text.strip().translate({0x00B5: "u", 0x03BC: "u", 0x00B2: "^2", 0x00B0: "deg"})
    plain = (
        plain.replace("_per_", "/")
        .replace(" ", "")
        .replace("degree", "deg")
        .replace("degs/", "deg/")
    )
    scaled = _SCALED.fullmatch(plain)
    factor, plain = (scaled["factor"], scaled["unit"]) if scaled else ("1", plain)
    if float(factor) == 0.0:
        return None
    known = UNITS[dimension]
    if plain in known:
        return SourceUnit(plain, dimension, factor)
    folded = {name.casefold(): name for name in known}
    short = plain.casefold().replace("^", "").replace("*", "").replace("·", "")
    result = folded.get(plain.casefold()) or _SPELLINGS[dimension].get(short)
    if dimension is Dimension.TIME and short == ISO:
        result = ISO
    return None if result is None else SourceUnit(result, dimension, factor)


def si_unit(dimension: Dimension) -> str:
    """Return the SI unit of a dimension."""
    return next(name for name, size in UNITS[dimension].items() if size == 1.0)


def accepted(dimension: Dimension) -> str:
    """Return the units of a dimension in words."""
    names = [*UNITS[dimension], *([ISO] if dimension is Dimension.TIME else [])]
    return f"{', '.join(names)}, or a factor before one of them, as 0.5*{next(iter(names))}"


def to_nanoseconds(raw: Raw, unit: SourceUnit) -> IntArray:
    """Return stamps as whole nanoseconds, `NO_STAMP` where there is none.

    Integers and decimal fractions are scaled without rounding on the way: a double resolves the
    seconds since 1970 to a quarter of a microsecond. Raises ValueError with the text that is no
    stamp.
    """
    if unit.name == ISO:
        return _dates(raw)
    scale = Fraction(unit.factor) * _NANOSECONDS[unit.name]
    if isinstance(raw, pa.Array | pa.ChunkedArray):
        return _decimals(raw, scale)
    values: AnyArray = np.asarray(raw)
    if values.dtype.kind in "iu":
        return _scaled_integers(values.astype(np.int64), scale)
    return _scaled_floats(values.astype(np.float64), scale)


_NANOSECONDS = {
    "s": Fraction(10**9),
    "ms": Fraction(10**6),
    "us": Fraction(10**3),
    "ns": Fraction(1),
    "min": Fraction(60 * 10**9),
    "h": Fraction(3600 * 10**9),
}


def resolution_ns(raw: Raw, unit: SourceUnit) -> float:
    """Return to what stamps are written (ns): the last decimal, or the spacing of their doubles."""
    if unit.name == ISO:
        return 1.0
    size = unit.si / NANOSECOND
    if isinstance(raw, pa.Array | pa.ChunkedArray):
        text = pc.utf8_trim_whitespace(raw.drop_null().cast(pa.string()))
        decimals = pc.extract_regex(text, r"^[-+]?\d*(?P<rest>[.,]?\d*)$")
        if not decimals.null_count:
            length = pc.max(pc.utf8_length(pc.struct_field(decimals, "rest"))).as_py() or 0
            return float(size * 10.0 ** -max(length - 1, 0))
        raw = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
    values: AnyArray = np.asarray(raw)
    if values.dtype.kind in "iu":
        return size
    return float(size * np.spacing(np.nanmax(np.abs(values), initial=0.0)))


def _scaled_integers(values: IntArray, scale: Fraction) -> IntArray:
    maximum = float(np.max(np.abs(values.astype(np.float64)), initial=0.0))
    if maximum * scale.numerator < 2.0**62:
        return np.asarray((values * scale.numerator + scale.denominator // 2) // scale.denominator)
    scaled = values.astype(np.float64) * float(scale)
    far = ~(np.abs(scaled) < 2.0**62)
    return np.where(far, NO_STAMP, _rounded(np.where(far, 0.0, scaled)))


def _scaled_floats(values: Array, scale: Fraction) -> IntArray:
    whole = np.floor(values)
    present = np.isfinite(values)
    integers = np.where(present & (np.abs(whole) < 2.0**62), whole, 0.0).astype(np.int64)
    far = ~(np.abs(values) * float(scale) < 2.0**62)
    rest = np.where(present, values - whole, 0.0)
    if scale.denominator != 1:
        return np.where(far, NO_STAMP, _rounded(np.where(far, 0.0, values) * float(scale)))
    exact = _scaled_integers(np.where(far, 0, integers), scale)
    return np.where(far, NO_STAMP, exact + _rounded(rest * float(scale)))


def _rounded(values: Array) -> IntArray:
    return np.rint(values).astype(np.int64)


def _decimals(raw: pa.Array, scale: Fraction) -> IntArray:
    """Return decimal texts as stamps, their fractions apart where a double is too coarse."""
    text = pc.utf8_trim_whitespace(raw)
    text = pc.if_else(_missing(text), pa.scalar(None, pa.string()), text)
    text = pc.replace_substring(text, ",", ".")
    try:
        values = pc.cast(text, pa.float64())
    except pa.ArrowInvalid:
        good = pc.match_substring_regex(text, _NUMBER)
        bad = pc.filter(text, pc.invert(pc.fill_null(good, True)))
        raise ValueError(bad[0].as_py() if len(bad) else "what is no number") from None
    numbers = values.to_numpy(zero_copy_only=False)
    present: BoolArray = np.isfinite(numbers)
    if float(np.max(np.abs(numbers[present]), initial=0.0)) * float(scale) < MAX_EXACT_NS:
        return _scaled_floats(numbers, scale)
    parts = pc.extract_regex(text, r"^(?P<whole>[-+]?\d+)(?P<rest>\.\d*)?$")
    if parts.null_count > text.null_count:  # in exponents, or as .5
        return _scaled_floats(numbers, scale)
    whole = (
        pc.cast(pc.struct_field(parts, "whole"), pa.int64())
        .fill_null(0)
        .to_numpy(zero_copy_only=False)
    )
    rest = pc.binary_join_element_wise("0", pc.struct_field(parts, "rest"), "")
    rest = pc.cast(rest, pa.float64()).fill_null(0.0).to_numpy(zero_copy_only=False)
    sign = np.where(np.signbit(numbers), -1, 1)
    stamps = _scaled_integers(whole, scale)
    known = present & (stamps != NO_STAMP)
    return np.where(known, stamps + sign * _rounded(rest * float(scale)), NO_STAMP)


def _dates(raw: Raw) -> IntArray:
    if not isinstance(raw, pa.Array | pa.ChunkedArray):
        dates: AnyArray = np.asarray(raw)
        if not np.issubdtype(dates.dtype, np.datetime64):
            raise ValueError(str(dates[0]) if len(dates) else "a number")
        ticks = dates.astype("datetime64[ns]").astype(np.int64)
        return np.where(np.isnat(dates), NO_STAMP, ticks)
    if pa.types.is_timestamp(raw.type):
        return _of_timestamps(pc.cast(raw, pa.timestamp("ns", raw.type.tz), safe=False))
    text = pc.utf8_trim_whitespace(raw)
    text = pc.if_else(_missing(text), pa.scalar(None, pa.string()), text)
    text = pc.replace_substring(text, ",", ".")
    written = text
    for pattern, plain in _WRITTEN:
        text = pc.replace_substring_regex(text, pattern, plain)
    for zone in (None, "UTC"):
        try:
            return _of_timestamps(pc.cast(text, pa.timestamp("ns", zone)))
        except pa.ArrowInvalid:
            continue
    bad = pc.filter(written, pc.invert(pc.fill_null(pc.match_substring_regex(text, _ISO), True)))
    raise ValueError(bad[0].as_py() if len(bad) else "dates of several kinds")


def _of_timestamps(stamps: pa.Array) -> IntArray:
    return np.asarray(
        pc.cast(stamps, pa.int64()).fill_null(NO_STAMP).to_numpy(zero_copy_only=False)
    )


MISSING = (
    *("", "nan", "NaN", "NAN", "na", "NA", "N/A", "n/a"),
    *("null", "NULL", "None", "none", "-", "--", "---"),
)


def _missing(text: pa.Array) -> pa.Array:
    return pc.is_in(text, value_set=pa.array(MISSING))


def stamp_numbers(raw: Raw) -> Array:
    """Return the stamps that are finite numbers, in their own unit; none of dates."""
    if is_date(raw):
        return np.zeros(0)
    if isinstance(raw, pa.Array | pa.ChunkedArray):
        text = pc.utf8_trim_whitespace(pc.cast(raw, pa.string()))
        text = pc.replace_substring(text.drop_null(), ",", ".")
        raw = pc.cast(text.filter(pc.match_substring_regex(text, _NUMBER)), pa.float64())
    values = np.asarray(raw, dtype=np.float64)
    return values[np.isfinite(values)]


def is_date(raw: Raw) -> bool:
    """Return whether stamps are dates."""
    if isinstance(raw, pa.Array | pa.ChunkedArray) and not pa.types.is_string(raw.type):
        return bool(pa.types.is_timestamp(raw.type))
    if not isinstance(raw, pa.Array | pa.ChunkedArray):
        return np.issubdtype(np.asarray(raw).dtype, np.datetime64)
    known = raw.drop_null()
    dated = r"\s*(\d{4}[-/]\d\d[-/]\d\d[T ]|\d\d\.\d\d\.\d{4} |\d\d:\d\d:\d\d)"
    return len(known) > 0 and re.match(dated, known[0].as_py()) is not None
