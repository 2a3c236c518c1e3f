"""The loop of a job over records that arrive while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TextIO

from magfusion.errors import InputError
from magfusion.files.standard_streams import write_message

if TYPE_CHECKING:
    from magfusion.files.records import Record
    from magfusion.files.stream import NumberedRecord


def process_records(
    records: Iterable[NumberedRecord],
    process: Callable[[Record], None],
    write: Callable[[], None],
    messages: TextIO,
    *,
    keep_going: bool,
) -> int:
    """Process each record, and write what follows from it; return how many are skipped.

    Raises InputError where a record is invalid and ``keep_going`` is not set.
    """
    refused = 0
    for numbered in records:
        try:
            if numbered.record is None:
                raise InputError(numbered.refusal)
            process(numbered.record)
        except InputError as error:
            sentence = numbered.located(error)
            if not keep_going:
                raise InputError(sentence) from error
            refused += 1
            write_message(messages, f"{sentence} (skipped)")
            continue
        write()
    return refused
