"""Objects as plain data and back: what a checkpoint holds, checked against the types of the fields.

The types come from the annotations of the calling code, never from the data, so that data can
build nothing but what was requested.  Plain data are as in `magfusion.files.checkpoint`.
"""

import types
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from magfusion.errors import InputError

Kind = TypeVar("Kind")
MAX_NUMBER = 1e100  # its square is a number, too
_TOO_LARGE = f"is beyond {MAX_NUMBER:g}"


@dataclass(frozen=True)
class Rules:
    """Rules for some types in addition to their annotations."""

    # by type, of which the own may be derived, how its plain data are made of it
    writers: Mapping[type, Callable[[Any], Any]] = field(default_factory=dict)
    # by type, how it is made of its plain data; a `ValueError` has the reason
    readers: Mapping[type, Callable[[Any], Any]] = field(default_factory=dict)
    # by type, what is to be seen when one was made; a `ValueError` has the reason
    checks: Mapping[type, Callable[[Any], None]] = field(default_factory=dict)

    def writer(self, kind: type) -> Callable[[Any], Any] | None:
        """Return how a type is written, or the nearest that it is derived of."""
        return next((self.writers[own] for own in kind.__mro__ if own in self.writers), None)


def to_plain(value: object, rules: Rules | None = None) -> Any:
    """Return plain data of dataclasses, running parts, arrays, numbers and collections of them.

    Of a running part, any other object, the attributes are its state that its class annotates.
    """
    writer = None if rules is None else rules.writer(type(value))
    if writer is not None:
        return writer(value)
    if value is None or isinstance(value, bool | int | float | str | np.ndarray):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return [[to_plain(part, rules) for part in pair] for pair in value.items()]
    if isinstance(value, list | tuple | deque):
        return [to_plain(part, rules) for part in value]
    names = _names(type(value))
    if not names:
        raise TypeError(f"{type(value).__name__} does not give its state")
    return {name: to_plain(getattr(value, name), rules) for name in names}


def from_plain(kind: type[Kind], data: Any, place: str, rules: Rules | None = None) -> Kind:
    """Return the value of plain data.

    `kind`: as annotated: a dataclass, an array, a number, or a collection of them. `place`: where
    in the state the data are, for refusals. Raises InputError where the data are of another type,
    or break a rule.
    """
    return _Reader(rules or Rules()).value(kind, data, place)


def resume(part: object, data: Any, place: str, rules: Rules | None = None) -> None:
    """Give a running part, as it was made, the state that plain data hold.

    Raises InputError where the data are of another type, or break a rule.
    """
    _Reader(rules or Rules()).value(type(part), data, place, part)


def _names(kind: type) -> list[str]:
    return [f.name for f in fields(kind)] if is_dataclass(kind) else list(get_type_hints(kind))


def _refusal(place: str, what: object) -> InputError:
    return InputError(f"{place} {what}; run without --resume")


_SCALARS = (float, int, str, bool, type(None))


def _as_it_is(kind: Any, data: Any) -> Any:
    """Return plain data of a type that needs no reader: an array, a choice, a scalar."""
    if get_origin(kind) is np.ndarray:
        dtype = np.dtype(get_args(get_args(kind)[1])[0])
        if not isinstance(data, np.ndarray) or data.dtype != dtype:
            raise ValueError(f"is no array of {dtype}")
        if np.issubdtype(dtype, np.inexact) and np.any(
            np.abs(data[np.isfinite(data)]) > MAX_NUMBER
        ):
            raise ValueError(_TOO_LARGE)
        return data
    if get_origin(kind) is Literal:
        if type(data) not in (str, int) or data not in get_args(kind):
            raise ValueError(f"is none of {get_args(kind)}")
        return data
    if type(data) is not kind and not (kind is float and type(data) is int):
        raise ValueError(f"is no {kind.__name__}")
    if kind is float and MAX_NUMBER < abs(data) < np.inf:
        raise ValueError(_TOO_LARGE)
    return None if data is None else kind(data)


class _Reader:
    def __init__(self, rules: Rules) -> None:
        self._rules = rules

    def value(self, kind: Any, data: Any, place: str, like: object = None) -> Any:
        """Return the value; ``like`` is the value that it replaces."""
        origin, inner = get_origin(kind), get_args(kind)
        if origin in (Union, types.UnionType):
            (one,) = (part for part in inner if part is not type(None))
            return None if data is None else self.value(one, data, place, like)
        if origin in (list, deque, tuple, dict, Counter, Mapping):
            return self._collection(origin, inner, data, place, like)
        try:
            result = self._constructed(kind, data, place, like)
            if kind in self._rules.checks:
                self._rules.checks[kind](result)
        except InputError:  # a part of it has said where and what
            raise
        except (ValueError, IndexError, RuntimeError) as error:
            raise _refusal(place, str(error).strip().split("\n")[0]) from error
        return result

    def resumed(self, part: object, data: Any, place: str) -> object:
        """Return a running part with the state that data hold."""
        for name, value in self._attributes(type(part), data, place, part).items():
            setattr(part, name, value)
        return part

    def _constructed(self, kind: Any, data: Any, place: str, like: object) -> Any:
        if kind in self._rules.readers:
            return self._rules.readers[kind](data)
        if isinstance(kind, type) and is_dataclass(kind):
            return kind(**self._attributes(kind, data, place, None))
        if get_origin(kind) in (np.ndarray, Literal) or kind in _SCALARS:
            return _as_it_is(kind, data)
        if not isinstance(like, kind):
            raise ValueError("is there, but not in a run of these settings")
        return self.resumed(like, data, place)

    def _collection(
        self, origin: Any, inner: tuple[Any, ...], data: Any, place: str, like: object
    ) -> Any:
        if not isinstance(data, list):
            raise _refusal(place, "is no list")
        kinds = inner[:1] * len(data)
        if origin is tuple and inner[1:] != (...,):
            kinds = inner
        elif origin not in (list, deque, tuple):
            kinds = (types.GenericAlias(tuple, (*inner, int)[:2]),) * len(data)
        if len(data) != len(kinds):
            raise _refusal(place, f"has {len(data)} parts, not {len(kinds)}")
        # Running parts take their state in their place.
        parts = like if isinstance(like, list) and len(like) == len(data) else [None] * len(data)
        result = [
            self.value(kind, part, f"{place}[{k}]", own)
            for k, (kind, part, own) in enumerate(zip(kinds, data, parts, strict=True))
        ]
        if origin is deque:
            return deque(result, like.maxlen if isinstance(like, deque) else None)
        if origin in (list, tuple):
            return origin(result)
        return Counter(dict(result)) if origin is Counter else dict(result)

    def _attributes(self, kind: type, data: Any, place: str, like: object) -> dict[str, Any]:
        names, hints = _names(kind), get_type_hints(kind)
        if not isinstance(data, dict) or data.keys() != set(names):
            raise _refusal(place, f"does not hold {', '.join(names)}")
        return {
            name: self.value(hints[name], data[name], f"{place}.{name}", getattr(like, name, None))
            for name in names
        }
