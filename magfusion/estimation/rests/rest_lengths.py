"""Maximum lengths of the pieces of a rest, and of a rest that makes one epoch."""

import numpy as np

from magfusion.model.site import Site
from magfusion.receiver.integration import MIN_LENGTHS
from magfusion.receiver.windows import LockinSettings, sent_frequencies_hz
from magfusion.units import HOUR

MAX_PIECE = 8.0  # s
PIECE_TURNS = 8.0  # of the closest tones against each other, in a piece
UNKNOWN_TURN = 0.2  # of a tone, that an unknown clock may make in a piece that is searched
MAX_WALK = 0.1  # rad; of a phase against its mean, in a rest that is one epoch


def piece_length(
    site: Site, usual: LockinSettings, lockin: LockinSettings | None, duration: float
) -> float | None:
    """Return the length of pieces for a rest (s); None where it is too short for any."""
    maximum = duration / MIN_LENGTHS
    if lockin is not None and lockin.window != usual.window:
        return lockin.window if lockin.window <= maximum else None
    lines = np.sort(np.append(sent_frequencies_hz(site), 0.0))
    spacing = float(np.min(np.diff(lines)))
    wanted = min(max(PIECE_TURNS / spacing, usual.window), MAX_PIECE)
    for beacon in site.beacons:
        if not beacon.synchronised:
            highest = float(np.max(beacon.tone_frequencies_hz))
            wanted = min(wanted, UNKNOWN_TURN / (site.relative_clock.drift_largest * highest))
    length = min(max(wanted, usual.window), maximum)
    return length if length >= usual.window else None


def coherent(site: Site) -> float:
    """Return the longest rest that may be one epoch (s), by the stability of phases and clocks."""
    duration = 1000.0 * HOUR
    while walk(site, float(np.max(sent_frequencies_hz(site))), duration) > MAX_WALK**2:
        duration *= 0.9
    return duration


def walk(site: Site, frequency_hz: float, duration: float) -> float:
    """Return the variance of a phase's mean over a rest about its value in the middle (rad^2).

    Includes a random walk of phase and one of frequency.
    """
    clock = site.clock
    phase = clock.phase_walk**2 / HOUR * duration / 12.0
    drift = (2.0 * np.pi * frequency_hz * clock.drift_walk) ** 2 / HOUR * duration**3 / 320.0
    return float(phase + drift + clock.log_moment_walk**2 / HOUR * duration / 12.0)
