"""What of a calibration does not stay as it is, and how fast it may go."""

from dataclasses import dataclass

import numpy as np

from magfusion.parameters import Block, Calibration
from magfusion.units import Array

HOUR = 3600.0  # s
# Standard deviation that a parameter gains in an hour.  What warms up or drifts does so in hours:
# log-moments by a thousandth, the phase and frequency of a free oscillator by a degree and
# 0.01 ppm, a magnetometer's offset by 20 nT.  Where the platform goes in that time the Earth field
# is another, by 3 degrees and a microtesla.  What is screwed down stays.
PER_HOUR = {
    "log_moment": 1e-3,
    "phase": 0.02,  # rad
    "drift": 1e-8,
    "offset": 0.02,  # microtesla
    "declination": 0.05,  # rad
    "strength": 1.0,  # microtesla
}


@dataclass(frozen=True, eq=False)
class Walk:
    """Random walk of a calibration.

    Parameters
    ----------
    blocks : tuple of Block
    variance : ndarray, shape (dimension,)
        Gained in a second.
    """

    blocks: tuple[Block, ...]
    variance: Array

    def cov(self, calibration: Calibration, time: float, elapsed: float) -> Array:
        """Return the covariance gained in a while, shape (dimension, dimension).

        Parameters
        ----------
        calibration : Calibration
        time : float
            At its end (s).
        elapsed : float
            (s)
        """
        gained = np.diag(self.variance * elapsed)
        phases = {b.owner: b.columns for b in self.blocks if b.kind == "phase"}
        since = time - calibration.reference_time
        for block in self.blocks:
            if block.kind != "drift" or block.owner not in phases:
                continue
            column, rows = block.columns.start, phases[block.owner]
            beacon = next(b for b in calibration.site.beacons if b.name == block.owner)
            # A frequency that changes now has not turned the phase of all the time before: the
            # phase at the reference time goes back by what the new frequency would have made.
            back = -2.0 * np.pi * beacon.tone_frequencies_hz * since
            share = gained[column, column]
            gained[rows, rows] += share * np.outer(back, back)
            gained[rows, column] = gained[column, rows] = share * back
        return gained


def calibration_walk(blocks: tuple[Block, ...], held: int = 0) -> Walk:
    """Return how a calibration walks.

    Parameters
    ----------
    blocks : tuple of Block
    held : int
        Parameters at the end that are only considered: they stay.
    """
    parts = [np.full(len(b.sigma), PER_HOUR.get(b.kind, 0.0) ** 2 / HOUR) for b in blocks]
    variance = np.concatenate(parts) if parts else np.zeros(0)
    variance[len(variance) - held :] = 0.0
    return Walk(blocks, variance)
