"""Values of a record's fields: numbers, vectors, slots and phasors as arrays, checked."""

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticCustomError

from magfusion.files.marks_table import is_slot, slots_of
from magfusion.files.table import MAX_NUMBER, MAX_TIME_NS
from magfusion.units import Array, ComplexArray, IntArray

MAX_TIME_S = 1e-9 * MAX_TIME_NS  # s


def numbers(value: object, what: str, *, missing: bool = False) -> Array:
    """Return finite numbers as an array; NumPy alone would take text and truth values too.

    `missing`: whether null and NaN are taken, for a sample that is not there.
    """
    try:
        result = np.asarray(value)
    except ValueError:
        result = np.empty(0, dtype=object)
    if missing and result.dtype.kind == "O":
        result = _with_nulls(result)
    sound = np.abs(result) < MAX_NUMBER if result.dtype.kind in "iuf" else np.zeros(1, dtype=bool)
    if missing and result.dtype.kind == "f":
        sound |= np.isnan(result)
    if not np.all(sound):
        raise PydanticCustomError("numbers", "it should be {what}, finite", {"what": what})
    return np.asarray(result, dtype=float)


def _with_nulls(result: NDArray[np.object_]) -> NDArray[np.generic]:
    """Return numbers with NaN for null; as it is where it holds anything else."""
    kinds = {type(one) for one in result.ravel()}
    return result.astype(float) if kinds <= {int, float, type(None)} and result.size else result


def times(value: object) -> Array:
    """Return times (k,) (s)."""
    result = np.atleast_1d(numbers(value, "a time in seconds, or a list of them"))
    if result.ndim != 1 or not np.all(np.abs(result) <= MAX_TIME_S):
        raise PydanticCustomError("times", "it should be a time in seconds, or a list of them")
    return result


def vectors(value: object) -> Array:
    """Return rows of three numbers (k, 3); NaN for null."""
    result = np.atleast_2d(numbers(value, "three numbers, or a list of such", missing=True))
    if result.ndim != 2 or result.shape[1] != 3:
        raise PydanticCustomError("vectors", "it should be three numbers, or a list of such")
    return result


def numbers_of_tones(value: object) -> Array:
    """Return numbers of any shape; NaN for null."""
    return numbers(value, "for each time three numbers a tone", missing=True)


def series(value: object) -> Array:
    """Return numbers (k,); NaN for null."""
    what = "a number, or a list of them"
    result = np.atleast_1d(numbers(value, what, missing=True))
    if result.ndim != 1:
        raise PydanticCustomError("series", "it should be {what}", {"what": what})
    return result


def series_or_vectors(value: object) -> Array:
    """Return numbers with one or several columns, (k, columns)."""
    nested = isinstance(value, list) and any(isinstance(row, list) for row in value)
    if not nested:
        return series(value)[:, None]
    result = numbers(value, "numbers, or rows of equally many", missing=True)
    if result.ndim != 2:
        raise PydanticCustomError("vectors", "it should be numbers, or rows of equally many")
    return result


def slots(value: object) -> IntArray:
    """Return slots with samples; null and NaN mean unknown."""
    result = series(value)
    if not np.all(is_slot(result)):
        what = "for each sample null, -1 where no coil is driven, or the number of a slot"
        raise PydanticCustomError("slots", "it should be {what}", {"what": what})
    return slots_of(result)


def tone_phasors(value: object) -> ComplexArray:
    """Return the phasors of a beacon's tones, (tones, 3); a tone that is null is missing."""
    what = "for each tone null or [[re_x, re_y, re_z], [im_x, im_y, im_z]]"
    if not isinstance(value, list):
        raise PydanticCustomError("phasor", "it should be {what}", {"what": what})
    out = np.full((len(value), 3), np.nan, dtype=complex)
    for i, tone in enumerate(value):
        if tone is None:
            continue
        result = numbers(tone, what, missing=True)
        if result.shape != (2, 3):
            raise PydanticCustomError("phasor", "it should be {what}", {"what": what})
        out[i] = result[0] + 1j * result[1]
    return out


def tone_amplitudes(value: object) -> ComplexArray:
    """Return the amplitudes of a beacon's tones, (tones, 3), in the first column."""
    result = series(value)
    if np.any(result < 0.0):
        text = "an amplitude has no sign; it should not be below zero, or be a phasor"
        raise PydanticCustomError("amplitudes", text)
    out = np.full((len(result), 3), np.nan, dtype=complex)
    out[:, 0] = result
    return out


def tone_covariances(value: object) -> Array:
    """Return covariances (tones, 3, 3) (T^2)."""
    what = "a list of symmetric, positive 3 x 3 matrices (T^2), one for each tone"
    result = numbers(value, what)
    if result.ndim != 3 or result.shape[1:] != (3, 3) or np.any(np.linalg.eigvalsh(result) <= 0.0):
        raise PydanticCustomError("covariance", "it should be {what}", {"what": what})
    return result
