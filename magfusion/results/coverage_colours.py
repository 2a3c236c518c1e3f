"""The colours of a coverage, the same in its picture and in its recording."""

import numpy as np

from magfusion.results.coverage import Coverage
from magfusion.units import Array, IntArray

# From the most accurate to the least; light to dark for colour-blind readers.
COLOURS = {
    "yellow": (250, 225, 50),
    "light green": (150, 215, 70),
    "green": (45, 175, 110),
    "teal": (30, 135, 155),
    "blue": (65, 85, 190),
    "violet": (120, 35, 140),
}


def bounds(coverage: Coverage) -> Array:
    """Return the bounds between the colours in equal ratios (m), shape (colours - 1,)."""
    return bounds_of(coverage.position_sigma[coverage.determined])


def bounds_of(known: Array) -> Array:
    """Return the bounds between the colours of lengths that are finite (m)."""
    low, high = np.quantile(known, [0.05, 0.95]) if len(known) else (0.01, 1.0)
    return np.geomspace(low, max(high, 1.1 * low), len(COLOURS) - 1)


def colour_of(coverage: Coverage) -> IntArray:
    """Return the index of each point's colour, shape (n,); meaningless where not determined."""
    return np.digitize(coverage.position_sigma, bounds(coverage))


def length(metres: float) -> str:
    """Return a sigma as printed."""
    return f"{1e3 * metres:.3g} mm" if metres < 1.0 else f"{metres:.3g} m"
