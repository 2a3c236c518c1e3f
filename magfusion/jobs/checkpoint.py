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
from magfusion.files.row_file import Mark
from magfusion.jobs.inputs import named
from magfusion.model.site import Site

Beside = TypeVar("Beside")


@dataclass(frozen=True)
class Kept:
    """State of a run along a log apart from its navigator: number of rows, and its time (s)."""

    rows: Mark | None = None
    elapsed: float = 0.0


@dataclass(frozen=True, eq=False)
class Begun(Generic[Beside]):
    """A navigator, the position of its run, and the other state of its checkpoint."""

    navigator: Navigator
    position: int
    beside: Beside


def begin(
    place: Path | None,
    key: str,
    site: Site,
    settings: NavigatorSettings,
    beside: Beside,
    *,
    resume: bool,
) -> Begun[Beside]:
    """Return the navigator of a checkpoint, or a new one where there is none.

    Parameters
    ----------
    place : Path, optional
        Of the checkpoint; None for no checkpoint.
    key : str
        Of the run.
    `beside` : object
        Other state of a new run; that in the checkpoint has the same type.
    resume : bool
        If false, the run starts from the beginning, and an existing checkpoint is overwritten.

    Raises
    ------
    InputError
        Where the checkpoint is damaged or of another run, or the place is not a checkpoint.
    """
    found = read_checkpoint(place, key) if place is not None and resume else None
    if place is None or found is None:
        if place is not None:
            claim_checkpoint(place)
        return Begun(Navigator(site, settings), 0, beside)
    from magfusion.estimation.online.restored import restored

    with named(place):
        beside = from_plain(type(beside), found.content.get("beside"), "beside")
        navigator = restored(site, settings, found.content.get("navigator"))
    return Begun(navigator, found.position, beside)


def save(navigator: Navigator, position: int, beside: object, place: Path, key: str) -> None:
    """Write a checkpoint of a navigator, with the other state of the run."""
    content = {"navigator": navigator.checkpoint(), "beside": to_plain(beside)}
    write_checkpoint(Checkpoint(key, position, content), place)
