"""Online exclusion of magnetometers whose phasors the motion contradicts repeatedly."""

import numpy as np

from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import BoolArray

MEMORY = 0.95  # of the running share of rejected phasors, per epoch of its own
MAJORITY_SHARE, MINORITY_SHARE = (
    0.5,
    0.2,
)  # shares of rejections: of a faulty one, and of another that is right
MIN_EPOCHS = 20  # epochs of its own, before one is assessed


class MagnetometerWatch:
    """Tracks the share of each magnetometer's phasors that the state does not explain.

    `share`: by magnetometer. `epochs`: number of epochs with any of its phasors. `excluded`: those
    that the first state excludes.
    """

    share: dict[str, float]
    epochs: dict[str, int]
    excluded: list[str]
    _findings: list[Finding]

    def __init__(self, site: Site) -> None:
        sensors = site.platform.magnetometers
        several = len(sensors) > 1
        self._names = tuple(sensor.name for sensor in sensors) if several else ()
        self._sensor = site.sensor
        self.share, self.epochs = {}, {}
        self.excluded, self._findings = [], []

    def begin(self, excluded: tuple[str, ...], findings: tuple[Finding, ...]) -> None:
        """Exclude those that the first state excludes, and keep the findings on them."""
        self.excluded, self._findings = list(excluded), list(findings)

    @property
    def false(self) -> tuple[str, ...]:
        """Excluded ones: mostly rejected, while another seldom is."""
        requested = [name for name in self._names if self.epochs.get(name, 0) >= MIN_EPOCHS]
        right = [name for name in requested if self.share[name] < MINORITY_SHARE]
        late = [name for name in requested if right and self.share[name] > MAJORITY_SHARE]
        return tuple(dict.fromkeys([*self.excluded, *late]))

    def update(self, refused: BoolArray, valid: BoolArray) -> BoolArray:
        """Process the channels that a state does not explain; return the excluded ones.

        Returns (channels,): all channels of faulty magnetometers.
        """
        out = np.zeros(len(valid), dtype=bool)
        for k, name in enumerate(self._names):
            own = valid & (self._sensor == k)
            if np.any(own):
                now = float(np.mean(refused[own]))
                before = self.share.get(name, now)
                self.share[name] = MEMORY * before + (1.0 - MEMORY) * now
                self.epochs[name] = self.epochs.get(name, 0) + 1
        for name in self.false:
            out |= self._sensor == self._names.index(name)
        return out

    def findings(self) -> tuple[Finding, ...]:
        """Return the findings on excluded magnetometers."""
        late = [name for name in self.false if name not in self.excluded]
        return *self._findings, *(
            Finding(
                "magnetometer_excluded",
                f"Magnetometer {name} contradicts the others: {100.0 * self.share[name]:.0f} % of"
                " its phasors are inconsistent with the motion, of another hardly any. It is not"
                " used. Check its body_from_sensor, matrix, response and clock_offset_s.",
            )
            for name in late
        )
