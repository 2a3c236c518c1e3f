"""File of the steel of a room to be simulated."""

from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from magfusion.files.site_values import Position, array, between, refusal
from magfusion.files.yaml_files import StrictModel, read_yaml
from magfusion.units import Array

_Thickness = Annotated[float, between(1e-4, 10.0)]
_Side = Annotated[Array, array(3, largest=1e3, unit="m")]
_RIGHT = 1e-6  # cosine of the angle between two sides, at most


class _SteelEntry(StrictModel):
    """What a piece is made of."""

    permeability: Annotated[float, between(1.0, 1e5)] = 100.0
    conductivity_s_m: Annotated[float, between(1e3, 1e8)] = 5e6


class SphereEntry(_SteelEntry):
    """A sphere."""

    centre_m: Position
    radius_m: _Thickness


class BarEntry(_SteelEntry):
    """A rod; a pipe where its wall is given."""

    start_m: Position
    end_m: Position
    radius_m: _Thickness
    wall_m: _Thickness | None = None

    @model_validator(mode="after")
    def _is_long(self) -> Self:
        if not np.linalg.norm(self.end_m - self.start_m) > 2.0 * self.radius_m:
            raise refusal("give a bar that is longer than it is thick")
        if self.wall_m is not None and self.wall_m > self.radius_m:
            raise refusal("give a wall_m of at most radius_m")
        return self


class SheetEntry(_SteelEntry):
    """A rectangle, from a corner along two sides."""

    corner_m: Position
    first_side_m: _Side
    second_side_m: _Side
    thickness_m: _Thickness

    @model_validator(mode="after")
    def _is_right(self) -> Self:
        size = float(np.linalg.norm(self.first_side_m) * np.linalg.norm(self.second_side_m))
        if size < 1e-6 or abs(float(self.first_side_m @ self.second_side_m)) > _RIGHT * size:
            raise refusal("give first_side_m and second_side_m at right angles, neither zero")
        return self


class SteelEntry(StrictModel):
    """The pieces of a room."""

    spheres: list[SphereEntry] = Field(default_factory=list)
    bars: list[BarEntry] = Field(default_factory=list)
    sheets: list[SheetEntry] = Field(default_factory=list)


def read_steel(path: Path) -> SteelEntry:
    """Read the steel of a room."""
    return read_yaml(path, SteelEntry)
