"""Prediction of only the beacons of a site with sensed fields, sample by sample."""

from dataclasses import dataclass

import numpy as np

from magfusion.model.detection_range import are_many, largest_fields, phasor_sigma
from magfusion.model.noise import sensor_positions
from magfusion.model.parameters import Calibration, beacons_of, of_beacons, with_undetected
from magfusion.model.trajectory import Trajectory

AT_ONCE = 1 << 14  # samples that are predicted at once: intermediate results fit the cache
AMONG_MANY = 1 << 11  # the same where the selection of beacons changes with the position
MIN_SIGMAS = 0.3  # sigmas of a phasor; a beacon always below it is not predicted
SEEN_EVERY = 64  # samples; in fewer no beacon comes much nearer


@dataclass(frozen=True, eq=False)
class ActiveBeacons:
    """The beacons that are predicted."""

    calibration: Calibration  # of all beacons, detected or not
    # minimum field of a predicted beacon (T); None where all are predicted
    least: float | None = None

    @staticmethod
    def of(calibration: Calibration, window: float) -> "ActiveBeacons":
        """Return the beacons of a site for windows of a length (s)."""
        every = with_undetected(calibration)
        if not are_many(every.site) or any(b.unknown for b in every.site.beacons):
            return ActiveBeacons(calibration)
        return ActiveBeacons(every, MIN_SIGMAS * phasor_sigma(every.site, window))

    @property
    def at_once(self) -> int:
        """Number of samples predicted at once."""
        return AT_ONCE if self.least is None else AMONG_MANY

    def along(self, motion: Trajectory) -> Calibration:
        """Return the calibration of the beacons sensed along a motion."""
        if self.least is None:
            return self.calibration
        site, few = self.calibration.site, len(motion) <= SEEN_EVERY
        some = slice(None, None, 1 if few else SEEN_EVERY)
        place = sensor_positions(site, motion.rows(some))[:, 0]
        largest = np.max(largest_fields(site, place), axis=0)
        beacons = beacons_of(site, largest > self.least)
        return of_beacons(self.calibration, beacons if len(beacons) else np.arange(1))
