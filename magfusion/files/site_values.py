"""Single values of a site's file: types, bounds, and errors of others."""

import datetime
import math
import sys
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from magfusion.units import Array

# What no installation reaches and any value written in nT by mistake exceeds.
MAX_EARTH_FIELD = 1e-3  # T
MAX_OFFSET = 1e-2  # T
MAX_NOISE_DENSITY = 1e-4  # T/sqrt(Hz)

MAX_DISTANCE = 1e6  # m
MAX_ANGLE = 1e4  # degrees; a few turns do no harm
LOWEST_FREQUENCY, HIGHEST_FREQUENCY = 1e-2, 1e6  # Hz
MAX_MOMENT, MIN_MOMENT = 1e9, 1e-9  # A m^2
MAX_CONDUCTIVITY, MIN_CONDUCTIVITY = 1e3, 1e-9  # S/m; the sea has 5, dry rock 1e-6
MAX_LOG_MOMENT = 10.0  # a factor of 22,000
FORMULA = ("=", "+", "-", "@")  # how a spreadsheet's formula begins
MIN_SIGMA = 1e-15  # in any unit; what is known better is known, which is zero
MIN_SCALE, MAX_SCALE = 1e-3, 1e3  # of a magnetometer matrix
MAX_CONDITION = 1e6  # of a magnetometer matrix that can be undone to any use


def refusal(remedy: str) -> PydanticCustomError:
    """Return what a validator raises: only the remedy, as place and value are known."""
    return PydanticCustomError("site", "{remedy}", {"remedy": remedy})


def refusal_at(key: tuple[str | int, ...], result: object, remedy: str) -> ValidationError:
    """Return the refusal of a value that a validator of its mapping found."""
    detail = InitErrorDetails(type=refusal(remedy), loc=key, input=result)
    return ValidationError.from_exception_data("site", [detail])


def _fits(value: object, shape: tuple[int, ...]) -> bool:
    if isinstance(value, list):
        same_length = bool(shape) and len(value) == shape[0]
        return same_length and all(_fits(v, shape[1:]) for v in value)
    if shape or isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max


_LISTS = {(2,): "a list of 2 numbers", (3,): "a list of 3 numbers", (3, 3): "3 lists of 3 numbers"}


def array(*shape: int, largest: float = math.inf, unit: str = "") -> PlainValidator:
    """Return a reader of finite numbers in nested lists of a shape, none larger in size."""

    def read(value: object) -> Array:
        if not _fits(value, shape):
            raise refusal(f"give {_LISTS[shape]}, all finite")
        array = np.array(value, dtype=float)
        if np.max(np.abs(array)) > largest:
            raise refusal(f"give {_LISTS[shape]}, in size at most {largest:g} {unit}".rstrip())
        return array

    return PlainValidator(read)


def sigma_array(*shape: int, largest: float) -> PlainValidator:
    """Return a reader of one standard deviation for all, or one for each of a shape."""

    def read(value: object) -> Array:
        return np.broadcast_to(_spread(value, shape, _LISTS[shape], largest), shape).copy()

    return PlainValidator(read)


def coil_sigma(value: object) -> Array:
    """Read one standard deviation for all coils, or one a coil."""
    coils = len(value) if isinstance(value, list) else 1
    return _spread(value, (coils,), "a list of one per coil", MAX_LOG_MOMENT)


def _spread(value: object, shape: tuple[int, ...], lists: str, largest: float) -> Array:
    if _fits(value, ()) or _fits(value, shape):
        array = np.array(value, dtype=float)
        known = array == 0.0
        if np.all(known | ((array >= MIN_SIGMA) & (array <= largest))):
            return array
    raise refusal(
        f"give one number or {lists}, finite and not negative, at most {largest:g}; 0 for what is"
        " known"
    )


def a_conductivity(value: float) -> float:
    """Refuse a conductivity that neither ground nor water has."""
    if value != 0.0 and not MIN_CONDUCTIVITY <= value <= MAX_CONDUCTIVITY:
        raise refusal(f"give it in S/m, from {MIN_CONDUCTIVITY:g} to {MAX_CONDUCTIVITY:g}, or 0")
    return value


def a_moment(value: Array) -> Array:
    """Refuse a moment that no coil has."""
    if not value.any():
        raise refusal("give the peak moment in A m^2, not zero; remove a coil that is not driven")
    if not MIN_MOMENT <= math.hypot(*value) <= MAX_MOMENT:
        raise refusal(f"give the peak moment in A m^2, from {MIN_MOMENT:g} to {MAX_MOMENT:g}")
    return value


def a_direction(value: Array) -> Array:
    """Refuse what points nowhere."""
    if not 1e-6 <= math.hypot(*value) <= 1e6:
        raise refusal("give the direction of the coil's axis, of any length near one")
    return value


def not_singular(value: Array) -> Array:
    """Refuse a matrix that cannot be undone."""
    if not np.linalg.cond(value) <= MAX_CONDITION:
        raise refusal("give a matrix that can be inverted")
    if not np.linalg.norm(value, 2) >= MIN_SCALE:
        raise refusal("give a matrix of tesla by tesla, near the identity")
    return value


def tesla(largest: float, unit: str = "T") -> AfterValidator:
    """Return a check that a value is not in nanotesla by mistake."""

    def check(value: Any) -> Any:
        if math.hypot(*np.ravel(value)) > largest:
            raise refusal(f"give it in {unit}, not n{unit} (at most {largest:g} {unit})")
        return value

    return AfterValidator(check)


def plain_name(value: str) -> str:
    """Refuse a name that a terminal or a spreadsheet takes for a command."""
    if not value.isprintable():
        raise refusal("write it with printable characters")
    if value[:1] in FORMULA:
        raise refusal("begin it with a letter or a digit; a spreadsheet takes it for a formula")
    return value


def at_least_one(what: str) -> AfterValidator:
    """Return a check that a list is not empty."""

    def check(value: list[Any]) -> list[Any]:
        if not value:
            raise refusal(f"describe at least one {what}")
        return value

    return AfterValidator(check)


def first_version(value: int) -> int:
    """Refuse another version of the format."""
    if value != 1:
        raise refusal("write 1, the version of the format that this magfusion reads")
    return value


def iso_date(value: object) -> str:
    """Read a date."""
    try:
        return datetime.date.fromisoformat(str(value)).isoformat()
    except ValueError:
        raise refusal("give a date as YYYY-MM-DD") from None


def between(least: float, maximum: float) -> AfterValidator:
    """Return a check of bounds, themselves allowed."""

    def check(value: float) -> float:
        if not least <= value <= maximum:
            raise refusal(f"it should lie between {least:g} and {maximum:g}")
        return value

    return AfterValidator(check)


def zeros() -> Array:
    """Return what an absent vector is."""
    return np.zeros(3)


AboveZero = Annotated[float, Field(gt=0.0)]
FromZero = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[AboveZero, between(1e-12, 1e6)]
NotNegative = Annotated[FromZero, between(0.0, 1e6)]
Position = Annotated[Array, array(3, largest=MAX_DISTANCE, unit="m")]
Angles = Annotated[Array, array(3, largest=MAX_ANGLE, unit="degrees")]
PositionSigma = Annotated[Array, sigma_array(3, largest=1e4)]
RotationSigma = Annotated[Array, sigma_array(3, largest=360.0)]
