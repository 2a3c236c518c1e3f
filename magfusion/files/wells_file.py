"""File of two wells to be simulated."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from magfusion.files.site_values import between
from magfusion.files.yaml_files import StrictModel, read_yaml

_Length = Annotated[float, Field(gt=0.0), between(1e-2, 1e3)]
_Angle = Annotated[float, between(-360.0, 360.0)]
Separation = Annotated[float, between(-60.0, 60.0)]


class WellsEntry(StrictModel):
    """Two wells, a sensor at rest in one and a magnet that passes in the other.

    All but the depths' sigma is true; the sensor's well leads down by its inclination from the
    vertical.
    """

    distance_m: _Length = 25.0
    high_side_deg: _Angle = 60.0
    inclination_deg: Annotated[float, between(0.0, 120.0)] = 89.0
    leads_right_deg: Separation = 2.0
    leads_up_deg: Separation = -1.0
    apart_m: Annotated[float, between(0.0, 1e3)] = 15.0
    reach_m: _Length = 30.0
    speed_m_s: Annotated[float, between(1e-3, 10.0)] = 0.1
    depth_m: Annotated[float, between(-1e4, 1e4)] = 1000.0
    depth_sigma_m: Annotated[float, between(0.0, 10.0)] = 0.04
    depth_scale_sigma: Annotated[float, between(0.0, 0.1)] = 1e-3


def read_wells(path: Path | None) -> WellsEntry:
    """Read two wells; without a file as usual."""
    return WellsEntry() if path is None else read_yaml(path, WellsEntry)
