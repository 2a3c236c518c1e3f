"""Standard input and output of the process, which a caller may close or leave at any time."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TextIO

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

    Raises InputError where it is closed.
    """
    if sys.stdin is None:
        raise InputError("standard input: is closed; pipe the records into it")
    return sys.stdin.buffer


def binary_output() -> BinaryIO:
    """Return standard output.

    Raises InputError where it is closed.
    """
    if sys.stdout is None:
        raise InputError("standard output: is closed; lead it into a file or a pipe")
    return sys.stdout.buffer


def write_message(messages: TextIO, text: str) -> None:
    """Write a line about the run, which goes on if that is impossible, as on a full disk."""
    with suppress(OSError):
        messages.write(f"magfusion: {text}\n")


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
