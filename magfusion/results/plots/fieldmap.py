"""A field map as a picture: gain and rotation of each beacon's field, and where it is known."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from magfusion.calibration.fieldmap import MapFit
from magfusion.model.site import Beacon
from magfusion.units import Array

_GRID = 60


def write_plot(path: Path, fit: MapFit) -> None:
    """Write a PNG: a column for each beacon; gain above, rotation below, at the survey's height."""
    beacons = fit.site.beacons
    figure = Figure(figsize=(1.5 + 4.2 * len(beacons), 8.5), layout="constrained")
    panels = figure.subplots(2, len(beacons), squeeze=False, sharex=True, sharey=True)
    sheets = [_sheet(beacon) for beacon in beacons]
    maximum = max(float(np.max(np.abs(s.gain))) for s in sheets) or 1.0
    largest = max(float(np.max(s.turn_deg)) for s in sheets) or 1.0
    for column, (beacon, sheet) in enumerate(zip(beacons, sheets, strict=True)):
        upper, lower = panels[:, column]
        shown = (
            (upper, sheet.gain, {"cmap": "RdBu_r", "vmin": -maximum, "vmax": maximum}),
            (lower, sheet.turn_deg, {"cmap": "viridis", "vmin": 0.0, "vmax": largest}),
        )
        for axes, values, scale in shown:
            mesh = axes.pcolormesh(sheet.x, sheet.y, values, shading="nearest", **scale)
            axes.contourf(
                sheet.x, sheet.y, sheet.unknown, [1.0, np.inf], hatches=["//"], colors="none"
            )
            axes.plot(*sheet.points.T, ".", color="black", markersize=2.0)
            axes.plot(*beacon.position_world[:2], "^", color="black", markersize=9)
            axes.set(aspect="equal")
            if column == len(beacons) - 1:
                label = "stronger than modelled by (%)" if axes is upper else "rotated by (deg)"
                figure.colorbar(mesh, ax=axes, label=label)
        lower.set_xlabel("x (m)")
        without, remaining = (100.0 * e[beacon.name] for e in (fit.error_without, fit.error_with))
        upper.set_title(
            f"beacon {beacon.name}\nmodel error {without:.2g} %, with the map {remaining:.2g} %"
        )
    for axes in panels[:, 0]:
        axes.set_ylabel("y (m)")
    figure.suptitle(
        f"Field relative to its model, at a height of {sheets[0].height:.2f} m\n"
        "dots: survey points (any height); triangle: the beacon; hatched: unknown, sigma"
        " above the deviation at the dots; errors: rms at left-out points"
    )
    figure.savefig(path, dpi=100, metadata={"Software": None})


class _Sheet(NamedTuple):
    """The map of one beacon at the median height of its survey."""

    points: Array  # (m, 2), m
    x: Array
    y: Array
    gain: Array  # percent
    turn_deg: Array
    unknown: Array  # sigma of the gain, relative to what the gain is at the points
    height: float  # m


def _sheet(beacon: Beacon) -> _Sheet:
    result = beacon.field_map
    assert result is not None
    points = result.points_world
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.5 * result.length_scale
    x, y = (np.linspace(low[i] - margin, high[i] + margin, _GRID) for i in (0, 1))
    height = float(np.median(points[:, 2]))
    mesh = np.meshgrid(x, y, [height], indexing="xy")
    spots = np.stack(mesh, axis=-1).reshape(-1, 3)
    value, _ = result.mean(spots)
    learnt = np.sqrt(np.mean(result.mean(points)[0][:, 0] ** 2))
    remaining = np.sqrt(result.variance(spots)[:, 0]) / max(float(learnt), result.residual)
    square = (_GRID, _GRID)
    return _Sheet(
        points=points[:, :2],
        x=x,
        y=y,
        gain=100.0 * np.expm1(value[:, 0]).reshape(square),
        turn_deg=np.rad2deg(np.linalg.norm(value[:, 1:], axis=1)).reshape(square),
        unknown=remaining.reshape(square),
        height=height,
    )
