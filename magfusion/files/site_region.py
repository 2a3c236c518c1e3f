"""Where the magnetometer may be, as a site's file has it."""

import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator, model_validator

from magfusion.files.site_values import MAX_DISTANCE, a_direction, array, refusal, refusal_at
from magfusion.files.yaml_files import StrictModel
from magfusion.model.region import HalfSpace, Region
from magfusion.units import Array


class HalfSpaceEntry(StrictModel):
    """`magfusion.model.region.HalfSpace`."""

    normal: Annotated[Array, array(3), AfterValidator(a_direction)]
    through_m: Annotated[Array, array(3, largest=MAX_DISTANCE, unit="m")] = Field(
        default_factory=lambda: np.zeros(3)
    )


def _corners(value: object) -> Array:
    """Read lower and upper corner; a number may be null where there is no limit."""
    if isinstance(value, list) and len(value) == 2 and all(isinstance(v, list) for v in value):
        filled = [
            [sign * math.inf if v is None else v for v in corner]
            for sign, corner in zip((-1.0, 1.0), value, strict=True)
        ]
        if all(len(c) == 3 and all(_is_number(v) for v in c) for c in filled):
            box = np.array(filled, dtype=float)
            if np.all(box[0] < box[1]) and np.any(np.isfinite(box)):
                return box
    raise refusal(
        "give two lists of 3 numbers in m, the lower corner and then the upper, null for no limit"
    )


def _is_number(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and (math.isinf(value) or abs(value) <= MAX_DISTANCE)
    )


class RegionEntry(StrictModel):
    """`magfusion.model.region.Region`."""

    box_m: Annotated[Array, PlainValidator(_corners)] | None = None
    half_space: HalfSpaceEntry | None = None

    @model_validator(mode="after")
    def _check_not_empty(self) -> Self:
        if self.box_m is None and self.half_space is None:
            raise refusal_at((), {}, "give box_m or half_space, or remove region")
        return self

    def region(self) -> Region:
        """Return the region of the entry."""
        half = self.half_space
        side = None if half is None else HalfSpace(half.normal, half.through_m)
        return Region(self.box_m, side)


def region_entry(region: Region | None) -> dict[str, Any]:
    """Return the entry of a region under its key; nothing where there is none."""
    if region is None:
        return {}
    entry: dict[str, Any] = {}
    if region.box_world is not None:
        entry["box_m"] = [
            [float(v) if np.isfinite(v) else None for v in corner] for corner in region.box_world
        ]
    if region.half_space is not None:
        entry["half_space"] = {
            "normal": region.half_space.normal_world.tolist(),
            "through_m": region.half_space.through_world.tolist(),
        }
    return {"region": entry}
