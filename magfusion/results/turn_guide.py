"""Guidance of a rotation on the terminal: a sphere of dots, what is next, and how certain it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

import numpy as np

from magfusion.calibration.turn_coverage import DIRECTIONS, TurnStatus
from magfusion.files.standard_streams import write_message

LINE_INTERVAL = 2.0  # s of the stream; of lines where there is no terminal
_WIDE, _HIGH = 9, 4  # half axes of a hemisphere (characters)


def guide_line(status: TurnStatus, limit: float) -> str:
    """Return the guidance in a line.

    `limit`: offset sigma that is required (T).
    """
    following = f"next: {status.target}; " if status.target else "all orientations visited; "
    if status.offset_sigma is None or status.matrix_sigma is None:
        certain = "no estimate yet"
    else:
        certain = (
            f"offset sigma {1e6 * status.offset_sigma:.2g} uT ({1e6 * limit:.2g} required),"
            f" matrix {1e6 * status.matrix_sigma:.2g} uT"
        )
    visited = f"{np.sum(status.visited)} of {len(status.visited)} directions; "
    return f"{status.time:.0f} s: {following}{visited}{certain}"


def sphere_of_dots(status: TurnStatus) -> list[str]:
    """Return two hemispheres, +z and -z towards the reader: o is missing, @ the current one."""
    grid = [[" "] * (4 * _WIDE + 8) for _ in range(2 * _HIGH + 1)]
    marked = None if status.now is None else int(np.argmax(DIRECTIONS @ status.now))
    for k, (x, y, z) in enumerate(DIRECTIONS):
        sign = "@" if k == marked else "\N{BLACK CIRCLE}" if status.visited[k] else "o"
        for side, towards in enumerate((1.0, -1.0)):
            if z * towards >= 0.0:
                column = _WIDE + 1 + side * (2 * _WIDE + 4) + round(towards * x * _WIDE)
                grid[_HIGH - round(y * _HIGH)][column] = sign
    names = f"{'sensor +z':^{2 * _WIDE + 2}}  {'sensor -z':^{2 * _WIDE + 2}}"
    return [names, *("".join(row).rstrip() for row in grid)]


@contextmanager
def terminal_guide(messages: TextIO, limit: float) -> Iterator[Callable[[TurnStatus], None]]:
    """Yield what shows a status: redrawn on a terminal, else in a line every two seconds."""
    if messages.isatty():
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        with Live(console=Console(file=messages), auto_refresh=False, transient=True) as live:

            def redraw(status: TurnStatus) -> None:
                lines = [*sphere_of_dots(status), guide_line(status, limit)]
                live.update(Text("\n".join([*lines, *filter(None, [status.reason])])), refresh=True)

            yield redraw
        return
    due = LINE_INTERVAL

    def write(status: TurnStatus) -> None:
        nonlocal due
        if status.time >= due:
            write_message(messages, guide_line(status, limit))
            messages.flush()
            due = status.time - status.time % LINE_INTERVAL + LINE_INTERVAL

    yield write
