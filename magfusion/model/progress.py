"""Progress reports of long computations."""

from collections.abc import Callable

Report = Callable[[str, int, int], None]  # stage, steps done, steps in all


def quiet(_stage: str, _done: int, _total: int) -> None:
    """Report nothing."""
