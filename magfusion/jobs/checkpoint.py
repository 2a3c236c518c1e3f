"""A navigator resumed from a checkpoint, with other state of the job."""

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.checkpoint import (
    Checkpoint,
    claim_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from magfusion.files.plain_data import from_plain, to_plain
from magfusion.files.row_file import RowPosition
from magfusion.jobs.inputs import named
from magfusion.model.site import Site

Extra = TypeVar("Extra")


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

    Parameters
    ----------
    place : Path, optional
        Of the checkpoint; None for no checkpoint.
    key : str
        Of the run.
    `extra` : object
        Other state of a new run; that in the checkpoint has the same type.
    resume : bool
        If false, the run starts from the beginning, and an existing checkpoint is overwritten.

    Raises
    ------
    InputError
        Where the checkpoint is damaged or of another run, or the place is not a checkpoint.
    """
    result = read_checkpoint(place, key) if place is not None and resume else None
    if place is None or result is None:
        if place is not None:
            claim_checkpoint(place)
        return ResumedRun(Navigator(site, settings), 0, extra)
    from magfusion.estimation.online.restored import restored

    with named(place):
        extra = from_plain(type(extra), result.content.get("beside"), "beside")
        navigator = restored(site, settings, result.content.get("navigator"))
    return ResumedRun(navigator, result.position, extra)


def save(navigator: Navigator, position: int, extra: object, place: Path, key: str) -> None:
    """Write a checkpoint of a navigator, with the other state of the run."""
    content = {"navigator": navigator.checkpoint(), "beside": to_plain(extra)}
    write_checkpoint(Checkpoint(key, position, content), place)
