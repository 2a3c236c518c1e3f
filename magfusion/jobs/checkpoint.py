"""A navigator that goes on from a checkpoint, whatever the job keeps beside it."""

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
    """What a run along a log keeps beside its navigator: the rows made so far, and its time (s)."""

    rows: Mark | None = None
    elapsed: float = 0.0


@dataclass(frozen=True, eq=False)
class Begun(Generic[Beside]):
    """A navigator, the position of its run, and what else its checkpoint contained."""

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
    """Return a navigator as its checkpoint left it, or a new one where there is none.

    Parameters
    ----------
    place : Path, optional
        Of the checkpoint; None where none is kept.
    key : str
        Of the run.
    beside : object
        What a new run keeps beside its navigator; the checkpoint holds one of the same type.
    resume : bool
        Otherwise the run begins anew, and an earlier checkpoint will be overwritten.

    Raises
    ------
    InputError
        Where the checkpoint is damaged or another's, or something else is in its place.
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
    """Write a checkpoint of a navigator, with what the run keeps beside it."""
    content = {"navigator": navigator.checkpoint(), "beside": to_plain(beside)}
    write_checkpoint(Checkpoint(key, position, content), place)
