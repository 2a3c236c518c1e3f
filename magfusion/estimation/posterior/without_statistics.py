"""filterpy's filters without scipy.stats, whose import is a third of a second of every start.

filterpy imports two distributions for its book-keeping and its plots; the arithmetic of a filter
asks neither.  While filterpy is imported something stands in for them that fetches the real ones
when they are asked for.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

STATISTICS = "scipy.stats"
DISTRIBUTIONS = ("norm", "multivariate_normal")


class _Later:
    """A distribution that is imported when somebody asks it, but for a trial by who imports it."""

    def __init__(self, name: str) -> None:
        self._name, self._tried = name, True

    def end_trial(self) -> None:
        self._tried = False

    def _real(self) -> Any:
        return getattr(import_module(STATISTICS), self._name)

    def __getattr__(self, attribute: str) -> Any:
        if self._tried:  # filterpy asks whether an argument is known, which it is in any SciPy now
            return lambda *_args, **_keywords: 0.0
        return getattr(self._real(), attribute)

    def __call__(self, *args: Any, **keywords: Any) -> Any:
        return self._real()(*args, **keywords)


@contextmanager
def without_statistics() -> Iterator[None]:
    """Let distributions be fetched later by what is imported meanwhile, if they were not yet."""
    if STATISTICS in sys.modules:
        yield
        return
    standing_in = ModuleType(STATISTICS)
    later = {name: _Later(name) for name in DISTRIBUTIONS}
    vars(standing_in).update(later)
    sys.modules[STATISTICS] = standing_in
    try:
        yield
    finally:
        if sys.modules.get(STATISTICS) is standing_in:
            del sys.modules[STATISTICS]
        for one in later.values():
            one.end_trial()
