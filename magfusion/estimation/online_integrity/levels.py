"""Protection levels computed on demand, for many states at once.

Computing one takes a good part of the time of an update, and few users read it.
"""

from collections.abc import Iterable
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import Separation
from magfusion.model.trust import Risk
from magfusion.units import Array

ProtectionLevels = tuple[float | None, float | None]
_PARTS = tuple(part.name for part in fields(Separation))


class LevelsQuery(NamedTuple):
    """Arguments from which the levels of a state are computed."""

    separation: Separation  # of one epoch
    # as of `magfusion.estimation.posterior.protection_levels.protection_levels`, as are
    slack: float
    risk: Risk
    prior: Array  # (1, beacons)
    factor: float  # inflation of the levels by other monitors
    more: tuple[float, float]  # additional margin (m, deg)


class Levels:
    """The protection levels of a state.

    `values`: position (m) and attitude (deg); None for a level that does not exist. `query`:
    arguments of levels that are not computed yet.
    """

    def __init__(
        self, values: ProtectionLevels | None = None, query: LevelsQuery | None = None
    ) -> None:
        self._values, self._query = values, query

    @property
    def values(self) -> ProtectionLevels:
        """Position (m) and attitude (deg); None where a level does not exist."""
        if self._values is None:
            find([self])
        return self._values or (None, None)

    @property
    def query(self) -> LevelsQuery | None:
        """Arguments of the computation; None once it is done."""
        return self._query

    def take(self, result: ProtectionLevels) -> None:
        """Store computed levels."""
        self._values, self._query = result, None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Levels) and self.values == other.values

    def __hash__(self) -> int:
        return hash(self.values)

    def __repr__(self) -> str:
        return f"Levels({self.values})"


def find(levels: Iterable[Levels]) -> None:
    """Compute missing levels together; each result is as computed separately."""
    waiting: dict[tuple[float, Risk, int], list[tuple[Levels, LevelsQuery]]] = {}
    for one in levels:
        query = one.query
        if query is not None:
            key = query.slack, query.risk, query.prior.shape[1]
            waiting.setdefault(key, []).append((one, query))
    for (slack, risk, _), group in waiting.items():
        parts = [query.separation for _, query in group]
        whole = parts[0]
        if len(parts) > 1:
            each = [np.concatenate([getattr(part, name) for part in parts]) for name in _PARTS]
            whole = Separation(*each)
        prior = np.concatenate([query.prior for _, query in group])
        both = np.stack(protection_levels(whole, risk, slack, prior), axis=1)
        for (one, query), values in zip(group, both.tolist(), strict=True):
            position_m, degrees = (
                query.factor * value + more if np.isfinite(value) else None
                for value, more in zip(values, query.more, strict=True)
            )
            one.take((position_m, degrees))
