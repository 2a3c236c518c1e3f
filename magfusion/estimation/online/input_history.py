"""The newest input of a navigator, which another one can process again."""

from collections import deque
from operator import methodcaller
from typing import Any

import numpy as np

from magfusion.units import Array

KEPT = 12.0  # s; two durations of a start


class InputHistory:
    """Input of the last `KEPT` seconds, as it was given."""

    def __init__(self) -> None:
        self._calls: deque[tuple[float, methodcaller]] = deque()
        self._newest = -np.inf

    def add(self, time: Array | float, method: str, *given: Any) -> None:
        """Add input that was given to a method of the navigator, with its times (s)."""
        own = [np.array(value) if isinstance(value, np.ndarray) else value for value in given]
        newest = float(np.max(time, initial=-np.inf))
        self._newest = max(self._newest, newest)
        self._calls.append((newest, methodcaller(method, *own)))
        while self._calls[0][0] < self._newest - KEPT:
            self._calls.popleft()

    @property
    def newest(self) -> float:
        """Newest time (s)."""
        return self._newest

    @property
    def span(self) -> float:
        """Duration (s)."""
        return self._newest - self._calls[0][0] if self._calls else 0.0

    def replay(self, navigator: object) -> None:
        """Give the input to another navigator."""
        for _, call in self._calls:
            call(navigator)
