"""Calibrations as plain data: their differences from the declared one."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from magfusion.files.plain_data import Rules, to_plain
from magfusion.model.parameters import Block, Calibration


def calibration_rules(declared: Calibration, blocks: tuple[Block, ...]) -> Rules:
    """Return the serialisation rules of calibrations, as differences from the declared one."""
    names = {block.name for block in blocks}
    return Rules(
        {Calibration: lambda result: _changes(declared, result)},
        {Calibration: lambda data: _changed(declared, data, names)},
    )


def _parts(value: Any) -> dict[str, Any] | None:
    """Return the components of a calibration's value by name; None of a single value."""
    if is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, tuple):
        return {str(k): part for k, part in enumerate(value)}
    return dict(value) if isinstance(value, Mapping) else None


def _changes(before: Any, after: Any) -> Any:
    """Return the differences as nested mappings of the values themselves."""
    old, new = _parts(before), _parts(after)
    if old is None or new is None:
        return to_plain(after)
    return {k: _changes(old.get(k), v) for k, v in new.items() if not _same(old.get(k), v)}


def _same(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if _parts(one) is not None and _parts(other) is not None:
        return not _changes(one, other)
    return type(one) is type(other) and bool(one == other)


def _changed(before: Any, data: Any, names: set[str]) -> Any:
    """Return ``before`` with the differences of `_changes`, checked for type and shape.

    `names`: of values that may be added to a mapping.
    """
    wrong = "has a value that does not match the type or shape of the site's value"
    old = _parts(before)
    if old is None:
        require(np.asarray(data).dtype == np.float64 and np.all(np.isfinite(data)), wrong)
        require(before is None or type(before) is type(data), wrong)
        require(before is None or np.shape(before) == np.shape(data), wrong)
        return data
    known = old.keys() | (names if isinstance(before, Mapping) else set())
    require(isinstance(data, dict) and data.keys() <= known, wrong)
    changed = {name: _changed(old.get(name), value, names) for name, value in data.items()}
    if isinstance(before, tuple):
        return tuple({**old, **changed}.values())
    return {**old, **changed} if isinstance(before, Mapping) else replace(before, **changed)


def require(right: bool | np.bool_, wrong: str) -> None:
    """Raise ValueError with a message where a condition does not hold."""
    if not right:
        raise ValueError(wrong)
