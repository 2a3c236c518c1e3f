"""A navigator resumed from a checkpoint, with other state of the job."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TextIO, TypeVar

import numpy as np

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.files.checkpoint import (
    Checkpoint,
    claim_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from magfusion.files.plain_data import from_plain, to_plain
from magfusion.files.row_file import RowPosition
from magfusion.files.standard_streams import write_message
from magfusion.jobs.inputs import named
from magfusion.model.site import Site

Extra = TypeVar("Extra")
REPORT_INTERVAL = 60.0  # s; that a checkpoint cannot be written


@dataclass(frozen=True)
class RunProgress:
    """State of a run along a log apart from its navigator: number of rows, and its time (s)."""

    rows: RowPosition | None = None
    elapsed: float = 0.0


@dataclass(frozen=True, eq=False)
class ResumedRun(Generic[Extra]):
    """A navigator, the position of its run, and the other state of its checkpoint."""

    navigator: Navigator
    position: int
    extra: Extra


def begin(
    place: Path | None,
    key: str,
    site: Site,
    settings: NavigatorSettings,
    extra: Extra,
    *,
    resume: bool,
) -> ResumedRun[Extra]:
    """Return the navigator of a checkpoint, or a new one where there is none.

    Raises InputError where the checkpoint is damaged or of another run, or the place is not a
    checkpoint.

    Parameters
    ----------
    place : Path, optional
        Of the checkpoint; None for no checkpoint.
    key : str
        Of the run.
    extra : object
        Other state of a new run; that in the checkpoint has the same type.
    resume : bool
        If false, the run starts from the beginning, and an existing checkpoint is overwritten.
    """
    result = read_checkpoint(place, key) if place is not None and resume else None
    if place is None or result is None:
        if place is not None:
            claim_checkpoint(place)
        return ResumedRun(Navigator(site, settings), 0, extra)

    with named(place):
        extra = from_plain(type(extra), result.content.get("beside"), "beside")
        navigator = restored(site, settings, result.content.get("navigator"))
    return ResumedRun(navigator, result.position, extra)


class CheckpointWriter:
    """Writes the checkpoints of a run; a failure is reported, and the run goes on."""

    def __init__(self, place: Path, key: str, messages: TextIO) -> None:
        self._place, self._key, self._messages = place, key, messages
        self._reported_at = -np.inf

    def save(self, navigator: Navigator, position: int, extra: object) -> None:
        """Write a checkpoint of a navigator, with the other state of the run."""
        content = {"navigator": navigator.checkpoint(), "beside": to_plain(extra)}
        try:
            write_checkpoint(Checkpoint(self._key, position, content), self._place)
        except OSError as error:
            now = time.monotonic()
            if now >= self._reported_at + REPORT_INTERVAL:
                self._reported_at = now
                write_message(
                    self._messages,
                    f"{self._place}: the checkpoint cannot be written"
                    f" ({error.strerror or error}); navigation goes on, and tries again",
                )
