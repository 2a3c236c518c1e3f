"""Protection levels that are found when somebody asks for them, those of many states at once.

To find one takes as long as a good part of an update does, and few who follow a state read it.
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
    """What the levels of a state are found of.

    Parameters
    ----------
    separation : Separation
        Of one epoch.
    slack : float
        As of `magfusion.estimation.posterior.separation.protection_levels`, as are
    risk : Risk
    prior : ndarray, shape (1, beacons)
    factor : float
        By which the levels are larger than separation knows of.
    more : tuple of float
        By which they are larger beside that (m, deg).
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
        Position (m) and attitude (deg), None for one that there is not.
    asked : Asked, optional
        Of those that are not found yet.
    """

    def __init__(self, found: Found | None = None, asked: Asked | None = None) -> None:
        self._found, self._asked = found, asked

    @property
    def found(self) -> Found:
        """Position (m) and attitude (deg); None where there is none."""
        if self._found is None:
            find([self])
        return self._found or (None, None)

    @property
    def asked(self) -> Asked | None:
        """What they are to be found of; None where they are found."""
        return self._asked

    def take(self, found: Found) -> None:
        """Take what was found."""
        self._found, self._asked = found, None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Levels) and self.found == other.found

    def __hash__(self) -> int:
        return hash(self.found)

    def __repr__(self) -> str:
        return f"Levels({self.found})"


def find(levels: Iterable[Levels]) -> None:
    """Find levels that are not found yet; each is what it would be alone."""
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
