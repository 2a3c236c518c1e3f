"""When a start is tried of a lone tracker whose side nobody told, before enough has come for any.

Its motion tells the side within a second or two, against which a mirrored start is hopeless. What
is less clear waits as long as all other starts do.
"""

from magfusion.estimation.batch.likeliest import AMBIGUOUS_CHI_SQUARE, DECIDED
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.slots import has_schedule

TRIES = 3  # in the time that other starts take; after one second attitudes erred by three sigmas


def first_try(site: Site, start_duration: float) -> float:
    """Return after how much data a start is tried first (s)."""
    if has_schedule(site) and _is_mirrored(site):
        return start_duration / TRIES
    return start_duration


def next_try(tried: float, start_duration: float) -> float:
    """Return after how much data it is tried again that failed early (s)."""
    return min(tried + start_duration / TRIES, start_duration)


def is_clear(start: OnlineStart | NoStart) -> bool:
    """Return whether an early start is beyond doubt: its rival needed no other look."""
    return (
        isinstance(start, OnlineStart)
        and start.rival_chi_square is not None
        and start.rival_chi_square > DECIDED * AMBIGUOUS_CHI_SQUARE
        and start.trust.verdict is Verdict.TRUSTWORTHY
    )


def open_start(start: OnlineStart) -> NoStart:
    """Return why a start is not taken whose mirror explains the data nearly as well."""
    text = (
        "The data so far leave open on which side of the source the receiver is."
        " Turn and move it, or give a hemisphere or a region."
    )
    said = Finding("ambiguous", text, Verdict.DOUBTFUL)
    return NoStart(text, Trust((said, *start.trust.reasons)))


def _is_mirrored(site: Site) -> bool:
    """Return whether the fields are the same on the other side of the source."""
    known = site.region is not None or any(b.hemisphere_beacon is not None for b in site.beacons)
    return len(site.beacons) == 1 and not known
