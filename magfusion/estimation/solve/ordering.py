"""The order in which states are eliminated."""

from collections.abc import Sequence

import gtsam
from gtsam.symbol_shorthand import B, V, X


def nested_dissection(
    epochs: int, last: int | None, segments: Sequence[tuple[int, int]] = (), own: Sequence[int] = ()
) -> gtsam.Ordering:
    """Return an elimination order of halves before their separators, the calibration last.

    GTSAM's own orderings, and plain time order, are quadratic in the number of epochs once a
    calibration variable touches all of them. `last`: key of the calibration. `segments`: first
    epoch and key of segments that have their own variable; it comes after them, except where it is
    the last. `own`: keys that factors of a user's add: before the calibration.
    """
    ordering = gtsam.Ordering()
    begins = [begin for begin, _ in segments] or [0]
    ends = [*begins[1:], epochs]
    stack = [(0, len(begins), False)]
    while stack:
        low, high, split = stack.pop()
        middle = (low + high) // 2
        if split or high - low == 1:
            _dissect(ordering, begins[middle], ends[middle])
            if segments and segments[middle][1] != last:
                ordering.push_back(segments[middle][1])
        elif high > low:
            stack += [(low, high, True), (middle + 1, high, False), (low, middle, False)]
    for key in own:
        ordering.push_back(key)
    if last is not None:
        ordering.push_back(last)
    return ordering


def _dissect(ordering: gtsam.Ordering, begin: int, end: int) -> None:
    stack = [(begin, end, False)]
    while stack:
        low, high, split = stack.pop()
        middle = (low + high) // 2
        if split or high - low == 1:
            for key in (X(middle), V(middle), B(middle)):
                ordering.push_back(key)
        elif high > low:
            stack += [(low, high, True), (middle + 1, high, False), (low, middle, False)]
