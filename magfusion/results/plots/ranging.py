"""A driller's view of ranging: position of the magnet's well, down the hole and by depth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magfusion.units import Array

BAND = 2.0  # sigmas
_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple")
_TURN: Array = np.linspace(0.0, 2.0 * np.pi, 90)


class RangePicture(NamedTuple):
    """Position of the magnet in each window (n,), relative to the sensor."""

    # magnet_depth, sensor_depth: (n,), measured (m)
    magnet_depth: Array
    sensor_depth: Array
    place: Array  # (n, 3), ahead, to the right, and up to the high side (m)
    cov: Array  # (n, 3, 3) (m^2)


def write_range_plot(path: Path, reported: RangePicture, *, high_side: bool) -> None:
    """Write a PNG with a cross section and three curves by depth, one colour per sensor place.

    `high_side`: whether directions are from it, or from the sensor's third axis.
    """
    figure = Figure(figsize=(12.0, 8.6), layout="constrained")
    (section, across), (along, sigmas) = figure.subplots(2, 2)
    rounded = np.round(reported.sensor_depth, 2)
    for k, depth in enumerate(np.unique(rounded)):
        own = np.flatnonzero(rounded == depth)
        own = own[np.argsort(reported.magnet_depth[own])]
        colour, name = _COLOURS[k % len(_COLOURS)], f"sensor at {depth:g} m"
        x, place, cov = reported.magnet_depth[own], reported.place[own], reported.cov[own]
        distance = np.hypot(place[:, 1], place[:, 2])
        outward = place[:, 1:] / distance[:, None]
        distance_sigma = _spread(outward, cov)
        lateral_sigma = _spread(outward[:, ::-1] * [1.0, -1.0], cov)
        _section(section, place, cov, colour, name)
        _banded(across, x, distance, distance_sigma, colour, name)
        beyond = place[:, 0] - (x - reported.sensor_depth[own])
        _banded(along, x, beyond, np.sqrt(cov[:, 0, 0]), colour, name)
        for value, style, what in (
            (distance_sigma, "-", "distance"),
            (lateral_sigma, "--", "lateral, by direction"),
            (np.sqrt(cov[:, 0, 0]), ":", "along the hole"),
        ):
            sigmas.plot(x, value, style, c=colour, label=what if k == 0 else None)
    up = "high side" if high_side else "sensor's z"
    section.scatter(0.0, 0.0, s=80, marker="+", c="black", zorder=3)
    section.annotate("sensor", (0.0, 0.0), (-10, -16), textcoords="offset points")
    section.set(
        title=f"Looking down the hole (ellipse: {BAND:g} sigma, closest approach)",
        xlabel="to the right (m)",
        ylabel=f"to the {up} (m)" if high_side else f"along the {up} (m)",
    )
    section.set_aspect("equal", adjustable="datalim")
    section.margins(0.15)
    band = f"band: {BAND:g} sigma"
    across.set(title=f"Across the hole, centre to centre ({band})", ylabel="distance (m)")
    along.set(title=f"Along the hole, relative to the depths ({band})", ylabel="offset (m)")
    sigmas.set(title="Sigmas", ylabel="1 sigma (m)", ylim=(0.0, None))
    for axes in (across, along, sigmas):
        axes.set_xlabel("measured depth of the magnet (m)")
    for axes in (section, across, along, sigmas):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _spread(direction: Array, cov: Array) -> Array:
    """Return the sigma along directions (n, 2) of right and up."""
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", direction, cov[:, 1:, 1:], direction)))


def _section(axes: Axes, place: Array, cov: Array, colour: str, name: str) -> None:
    """Draw the path of the magnet, and its ellipse at the closest approach."""
    axes.plot(place[:, 1], place[:, 2], c=colour, lw=1.0, alpha=0.6)
    axes.scatter(place[-1, 1], place[-1, 2], s=30, marker="v", c=colour, alpha=0.6)
    near = int(np.argmin(np.abs(place[:, 0])))
    root = np.linalg.cholesky(cov[near, 1:, 1:] + 1e-18 * np.eye(2))
    ring = place[near, 1:] + BAND * np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1) @ root.T
    right, up = place[near, 1:]
    direction = np.rad2deg(np.arctan2(right, up)) % 360.0
    outward = place[[near], 1:] / np.hypot(right, up)
    sigma = float(_spread(outward, cov[[near]])[0])
    label = f"{name}: {np.hypot(right, up):.2f} ± {sigma:.2g} m at {direction:.1f}°"
    axes.plot(*ring.T, c=colour, lw=1.5)
    axes.plot([0.0, right], [0.0, up], "--", c=colour, lw=0.8, label=label)


def _banded(axes: Axes, x: Array, value: Array, sigma: Array, colour: str, name: str) -> None:
    axes.plot(x, value, c=colour, lw=1.0, label=name)
    axes.fill_between(x, value - BAND * sigma, value + BAND * sigma, color=colour, alpha=0.25)
