"""Early start of a single tracker of unknown hemisphere, before a usual start has enough data.

Its motion determines the hemisphere within a second or two, and clearly rejects a mirrored start.
Less clear cases wait as long as all other starts do.
"""

from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE, DECIDED
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.slots import has_schedule

TRIES = 3  # in the time of other starts; after one second attitudes erred by three sigmas


def first_try(site: Site, start_duration: float) -> float:
    """Return the duration of data before the first try of a start (s)."""
    if has_schedule(site) and _is_mirrored(site):
        return start_duration / TRIES
    return start_duration


def next_try(tried: float, start_duration: float) -> float:
    """Return the duration of data before the next try, after an early one failed (s)."""
    return min(tried + start_duration / TRIES, start_duration)


def is_clear(start: OnlineStart | NoStart) -> bool:
    """Return whether an early start is unambiguous: its rival needed no further comparison."""
    return (
        isinstance(start, OnlineStart)
        and start.rival_chi_square is not None
        and start.rival_chi_square > DECIDED * AMBIGUOUS_CHI_SQUARE
        and start.trust.verdict is Verdict.TRUSTWORTHY
    )


def open_start(start: OnlineStart) -> NoStart:
    """Return the reason to reject a start whose mirror explains the data nearly as well."""
    text = (
        "Hemisphere ambiguous; more data needed. Turn and move the receiver, or declare a"
        " hemisphere or a region."
    )
    findings = Finding("ambiguous", text, Verdict.DOUBTFUL)
    return NoStart(text, Trust((findings, *start.trust.reasons)))


def _is_mirrored(site: Site) -> bool:
    """Return whether the fields are the same on the other side of the source."""
    known = site.region is not None or any(b.hemisphere_beacon is not None for b in site.beacons)
    return len(site.beacons) == 1 and not known
