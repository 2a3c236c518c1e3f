"""Settings of a log whose receiver is known to be on one side of a beacon, or in a room."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magfusion.jobs.region_option import Where
from magfusion.jobs.settings import LogSettings, option

if TYPE_CHECKING:
    from magfusion.jobs.inputs import Job


@dataclass(frozen=True, kw_only=True)
class RegionSettings(LogSettings):
    """A log whose receiver is known to be on one side of a beacon, or in a room."""

    hemisphere: tuple[str, ...] = option(
        (),
        "The magnetometer is on this side of a beacon, in its axes: +x, -z, or three numbers;"
        " with the beacon's name if there are several; repeatable",
        metavar="[BEACON=]DIRECTION",
    )
    region: str | None = option(
        None,
        "The magnetometer is inside",
        unit="m",
        metavar="XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX",
        note="inf for no limit",
    )

    @property
    def where(self) -> Where:
        """Return both in the form of the jobs."""
        return Where(self.hemisphere, self.region)

    def job(self, output: Path) -> Job:
        """Return inputs and output of a job on a log."""
        return dataclasses.replace(super().job(output), where=self.where)
