"""One-line `repr` of records that contain arrays, as shown by notebooks."""

from collections.abc import Sized
from dataclasses import Field, fields
from typing import Any, ClassVar, Protocol

import numpy as np

MAX_CHARACTERS = 200  # characters; two lines of a terminal
MAX_TEXT = 40


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def short_repr(self: _Dataclass) -> str:
    """Return class and fields: arrays by their shape, objects by class and length.

    Fields that are empty or at their default are omitted.
    """
    values = [(f.name, getattr(self, f.name), f.default) for f in fields(self)]
    parts = [f"{name}={_shown(v)}" for name, v, default in values if not _absent(v, default)]
    return one_line(type(self).__name__, parts)


def one_line(name: str, parts: list[str]) -> str:
    """Return a name with facts in parentheses, truncated at `MAX_CHARACTERS`."""
    line = f"{name}({', '.join(parts)})"
    return line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 4]}...)"


def _absent(value: object, default: object) -> bool:
    if value is None or value is default:
        return True
    if isinstance(value, bool | int | float | str):
        return bool(value == default)
    return isinstance(value, Sized) and not isinstance(value, np.ndarray) and len(value) == 0


def _shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, bool | int):
        return str(value)
    if isinstance(value, str):
        text = str(value)
        return repr(text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 3]}...")
    length = f"[{len(value)}]" if isinstance(value, Sized) else ""
    return f"{type(value).__name__}{length}"
