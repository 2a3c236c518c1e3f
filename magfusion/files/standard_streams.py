"""Standard input and output of the process, which a caller may close or leave at any time."""

import atexit
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from magfusion.errors import InputError


def occupy_closed() -> None:
    """Lead standard streams that the caller closed nowhere, lest a file of ours take their place.

    ``sys.stdin`` and ``sys.stdout`` stay None then.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115 - as long as the process


def binary_input() -> BinaryIO:
    """Return standard input.

    Raises
    ------
    InputError
        Where it is closed.
    """
    if sys.stdin is None:
        raise InputError("standard input: is closed; pipe the records into it")
    return sys.stdin.buffer


def binary_output() -> BinaryIO:
    """Return standard output.

    Raises
    ------
    InputError
        Where it is closed.
    """
    if sys.stdout is None:
        raise InputError("standard output: is closed; lead it into a file or a pipe")
    return sys.stdout.buffer


@contextmanager
def until_closed() -> Iterator[None]:
    """End in peace where the reader of the output has gone."""
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        # Python would complain once more when it flushes at its end.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def quick_exit() -> list[int]:
    """End the process, once it is done, without freeing its objects one by one (as mypy does).

    Freeing them is a thirtieth of a short run.  Threads are waited for, and functions that are
    registered with `atexit` after this call run before; those registered earlier do not run.

    Returns
    -------
    list of int
        Into which the exit status is to be put.  As long as it is empty, and where the output
        cannot be written, the process ends as usual.
    """
    status: list[int] = []

    def end() -> None:
        if not status:
            return
        try:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
        except (OSError, ValueError):
            return
        os._exit(status[0])

    atexit.register(end)
    return status
