"""Check distances between surveyed points."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckDistance:
    """Distance between two beacons, or a beacon and a mark, measured by tape."""

    # begin, end: names
    begin: str
    end: str
    distance: float  # (m)
    sigma: float  # (m)
