"""Temperatures and currents that a navigator receives, on which the model of its site depends."""

from dataclasses import replace

from magfusion.estimation.demodulation.drive_reference import drive_findings
from magfusion.model.drive import DriveSamples, DriveShares
from magfusion.model.site import Site
from magfusion.model.temperature import Temperatures
from magfusion.model.trust import Finding
from magfusion.receiver.drive import DriveReceiver


class SiteReadings:
    """A copy of a site's readings: no other navigator shares the future ones."""

    temperatures: Temperatures
    _drives: DriveShares
    _currents: DriveReceiver

    def __init__(self, site: Site) -> None:
        known, drives = site.temperatures, site.drives
        self.temperatures = Temperatures(None if known is None else known.readings)
        self._drives = DriveShares(None if drives is None else drives.readings)
        self._currents = DriveReceiver(self.on(site), self._drives)

    def on(self, site: Site) -> Site:
        """Return a site with these readings."""
        return replace(site, temperatures=self.temperatures, drives=self._drives)

    def add_currents(self, samples: DriveSamples, site: Site) -> tuple[Finding, ...]:
        """Add currents of coils; return the findings on all so far."""
        self._currents.push(samples)
        self._drives.discard_old()
        return tuple(drive_findings(self._currents, site))
