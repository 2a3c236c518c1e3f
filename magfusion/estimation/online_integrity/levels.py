"""Protection levels computed on demand, for many states at once.

Computing one takes a good part of the time of an update, and few users read it.
"""

from collections.abc import Iterable
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.separation import Separation, protection_levels
from magfusion.model.trust import Risk
from magfusion.units import Array

Found = tuple[float | None, float | None]
_PARTS = tuple(part.name for part in fields(Separation))


class Asked(NamedTuple):
    """Arguments from which the levels of a state are computed.

    Parameters
    ----------
    separation : Separation
        Of one epoch.
    slack : float
        As of `magfusion.estimation.posterior.separation.protection_levels`, as are
    risk : Risk
    prior : ndarray, shape (1, beacons)
    factor : float
        Inflation of the levels by other monitors.
    more : tuple of float
        Additional margin (m, deg).
    """

    separation: Separation
    slack: float
    risk: Risk
    prior: Array
    factor: float
    more: tuple[float, float]


class Levels:
    """The protection levels of a state.

    Parameters
    ----------
    found : tuple of float, optional
        Position (m) and attitude (deg); None for a level that does not exist.
    asked : Asked, optional
        Arguments of levels that are not computed yet.
    """

    def __init__(self, found: Found | None = None, asked: Asked | None = None) -> None:
        self._found, self._asked = found, asked

    @property
    def found(self) -> Found:
        """Position (m) and attitude (deg); None where a level does not exist."""
        if self._found is None:
            find([self])
        return self._found or (None, None)

    @property
    def asked(self) -> Asked | None:
        """Arguments of the computation; None once it is done."""
        return self._asked

    def take(self, found: Found) -> None:
        """Store computed levels."""
        self._found, self._asked = found, None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Levels) and self.found == other.found

    def __hash__(self) -> int:
        return hash(self.found)

    def __repr__(self) -> str:
        return f"Levels({self.found})"


def find(levels: Iterable[Levels]) -> None:
    """Compute missing levels together; each result is as computed separately."""
    waiting: dict[tuple[float, Risk, int], list[tuple[Levels, Asked]]] = {}
    for one in levels:
        asked = one.asked
        if asked is not None:
            key = asked.slack, asked.risk, asked.prior.shape[1]
            waiting.setdefault(key, []).append((one, asked))
    for (slack, risk, _), group in waiting.items():
        parts = [asked.separation for _, asked in group]
        whole = parts[0]
        if len(parts) > 1:
            each = [np.concatenate([getattr(part, name) for part in parts]) for name in _PARTS]
            whole = Separation(*each)
        prior = np.concatenate([asked.prior for _, asked in group])
        both = np.stack(protection_levels(whole, risk, slack, prior), axis=1)
        for (one, asked), values in zip(group, both.tolist(), strict=True):
            position_m, degrees = (
                asked.factor * value + more if np.isfinite(value) else None
                for value, more in zip(values, asked.more, strict=True)
            )
            one.take((position_m, degrees))
