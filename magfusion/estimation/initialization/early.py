"""Early start, before a usual start has enough data.

The motion of a single tracker of unknown hemisphere determines it within a second or two, and
clearly rejects a mirrored start.  A receiver of alternating fields alone has no static field that
needs checks over turns of the body; with several beacons each epoch determines its pose.  Less
clear cases wait as long as all other starts do.
"""

import numpy as np

from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE, DECIDED
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.slots import has_schedule

LEADING = 2.0 * float(np.log(100.0))  # chi square of a rival: the odds against it are 100
SEVERAL = 3  # beacons
FIRST_SHARE = 1.0 / 3.0  # of the time of other starts; after 1 s attitudes erred by three sigmas
LATER = 1.4  # times the data of the try before: all tries cost less than three of the last


def first_try(site: Site, start_duration: float) -> float:
    """Return the duration of data before the first try of a start (s)."""
    if (has_schedule(site) and _is_mirrored(site)) or _is_alternating(site):
        return start_duration * FIRST_SHARE
    return start_duration


def next_try(tried: float, start_duration: float) -> float:
    """Return the duration of data before the next try, after an early one failed (s)."""
    later = LATER * tried
    return later if LATER * later <= start_duration else start_duration


def is_clear(start: OnlineStart | NoStart, *, several: bool = False, last: bool = False) -> bool:
    """Return whether an early start is unambiguous: its rival needed no further comparison.

    `several`: whether there are several beacons, without a rival; then all tests must be passed.
    `last`: whether it is the last early try: its start may be doubtful, its rival merely rejected.
    """
    if not isinstance(start, OnlineStart):
        return False
    passed = start.trust.verdict is Verdict.TRUSTWORTHY
    if start.rival_chi_square is None:
        return several and passed
    if last:
        return not start.ambiguous and start.trust.verdict is not Verdict.FAILED
    return passed and start.rival_chi_square > DECIDED * AMBIGUOUS_CHI_SQUARE


def is_open(start: OnlineStart) -> bool:
    """Return whether no hypothesis leads by so much that its pose is given, as doubtful."""
    rival = start.rival_chi_square
    return bool(rival is not None and rival < LEADING)


def open_start(start: OnlineStart) -> NoStart:
    """Return the reason to reject a start whose mirror explains the data nearly as well."""
    text = (
        "Hemisphere ambiguous; more data needed. Turn and move the receiver, or declare a"
        " hemisphere or a region."
    )
    findings = Finding("ambiguous", text, Verdict.DOUBTFUL)
    return NoStart(text, Trust((findings, *start.trust.reasons)))


def _is_alternating(site: Site) -> bool:
    """Return whether a receiver without a static field has several beacons."""
    return site.platform.magnetometer.ac_coupled and len(site.beacons) >= SEVERAL


def _is_mirrored(site: Site) -> bool:
    """Return whether the fields are the same on the other side of the source."""
    known = site.region is not None or any(b.hemisphere_beacon is not None for b in site.beacons)
    return len(site.beacons) == 1 and not known
