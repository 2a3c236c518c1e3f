"""The order in which states are eliminated."""

import gtsam
from gtsam.symbol_shorthand import B, V, X


def nested_dissection(epochs: int, last: int | None) -> gtsam.Ordering:
    """Return halves before the epoch between them, calibration last.

    GTSAM's own orderings, and plain time order, are quadratic in the number of epochs once a
    calibration variable touches all of them.

    Parameters
    ----------
    epochs : int
    last : int, optional
        Key of the calibration.
    """
    ordering = gtsam.Ordering()
    stack = [(0, epochs, False)]
    while stack:
        low, high, split = stack.pop()
        middle = (low + high) // 2
        if split or high - low == 1:
            for key in (X(middle), V(middle), B(middle)):
                ordering.push_back(key)
        elif high > low:
            stack += [(low, high, True), (middle + 1, high, False), (low, middle, False)]
    if last is not None:
        ordering.push_back(last)
    return ordering
