"""Check distances between surveyed points."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckDistance:
    """Distance between two beacons, or a beacon and a mark, measured by tape.

    Parameters
    ----------
    begin, end : str
        Names.
    distance, sigma : float
        (m)
    """

    begin: str
    end: str
    distance: float
    sigma: float
