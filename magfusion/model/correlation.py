"""Correlations between the errors of calibrated parameters.

A log determines the relative positions of beacons far better than their absolute positions: each
sigma is then centimetres, and their differences are known to a millimetre.  Sigmas alone lose that.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.units import Array


class Component(NamedTuple):
    """One number of a calibration, e.g. the first of beacon A's position."""

    group: str
    owner: str
    kind: str
    component: int


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation coefficients of the errors behind a site's sigmas."""

    parameters: tuple[Component, ...]  # all others are independent
    coefficients: Array  # (n, n), with unit diagonal

    def kept(self, wanted: Callable[[Component], bool]) -> "Correlation | None":
        """Return the part between some parameters; None if it is empty."""
        rows = [i for i, parameter in enumerate(self.parameters) if wanted(parameter)]
        if not rows:
            return None
        names = tuple(self.parameters[i] for i in rows)
        return Correlation(names, self.coefficients[np.ix_(rows, rows)])

    def without(self, groups: tuple[str, ...], owners: Iterable[str]) -> "Correlation | None":
        """Return the part without re-estimated groups of some owners."""
        elapsed = set(owners)
        return self.kept(lambda p: p.group not in groups or p.owner not in elapsed)

    def among(self, parameters: list[Component]) -> Array:
        """Return the coefficients between given parameters, zero for unknown ones, (k, k)."""
        index = {parameter: i for i, parameter in enumerate(self.parameters)}
        mine = [j for j, parameter in enumerate(parameters) if parameter in index]
        others = [index[parameters[j]] for j in mine]
        out = np.eye(len(parameters))
        out[np.ix_(mine, mine)] = self.coefficients[np.ix_(others, others)]
        return out


def joined(parts: list[Correlation | None]) -> Correlation | None:
    """Join correlations that are mutually independent."""
    some = [part for part in parts if part is not None]
    if not some:
        return None
    parameters = [parameter for part in some for parameter in part.parameters]
    out = np.eye(len(parameters))
    start = 0
    for part in some:
        rows = slice(start, start + len(part.parameters))
        out[rows, rows] = part.coefficients
        start = rows.stop
    return Correlation(tuple(parameters), out)
