"""Readings of a rotated magnetometer before and after calibration: an ellipse and a circle."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magfusion.units import MICROTESLA, NANOTESLA, Array

_PLANES = ((0, 1), (1, 2), (2, 0))
_AXES = "xyz"
_BEFORE, _AFTER = "tab:orange", "tab:blue"
DRAWN_DEVIATION = 0.25  # of the radius; what the largest deviation is drawn as


def write_magnetometer_plot(
    path: Path, time: Array, before_sensor: Array, after_sensor: Array, field_size: float
) -> None:
    """Write a PNG: the readings in three planes, and the magnitude of their field over time.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    before_sensor, after_sensor : ndarray, shape (n, 3)
        Field with the declared and with the estimated calibration (T).
    field_size : float
        Nominal magnitude (T).
    """
    figure = Figure(figsize=(13.0, 8.5), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(1.5, 1.0))
    deviation = np.max(np.abs(np.linalg.norm(before_sensor, axis=1) - field_size))
    magnified = max(1.0, DRAWN_DEVIATION * field_size / max(float(deviation), 1e-12))
    for column, plane in enumerate(_PLANES):
        axes = figure.add_subplot(grid[0, column])
        _plane(axes, plane, magnified, field_size, before_sensor, after_sensor)
    axes = figure.add_subplot(grid[1, :])
    for field, colour, label in (
        (before_sensor, _BEFORE, "before"),
        (after_sensor, _AFTER, "after"),
    ):
        size = np.linalg.norm(field, axis=1)
        spread = np.std(size) / np.mean(size)
        axes.plot(
            time, size / NANOTESLA, ".-", ms=3, lw=0.6, c=colour, label=f"{label}: {spread:.2g}"
        )
    axes.axhline(field_size / NANOTESLA, c="0.5", lw=0.8)
    axes.set(xlabel="time (s)", ylabel="magnitude of the field (nT)")
    axes.legend(title="standard deviation over mean")
    figure.suptitle(
        "Fields of the readings with the declared and with the estimated calibration;"
        f" deviations from the circle magnified {magnified:.0f} times"
    )
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plane(
    axes: Axes,
    plane: tuple[int, int],
    magnified: float,
    field_size: float,
    before_sensor: Array,
    after_sensor: Array,
) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    radius = field_size / MICROTESLA
    axes.plot(radius * np.cos(angle), radius * np.sin(angle), c="0.5", lw=0.8)
    for field, colour in ((before_sensor, _BEFORE), (after_sensor, _AFTER)):
        size = np.linalg.norm(field, axis=1, keepdims=True)
        drawn = field / size * (field_size + magnified * (size - field_size)) / MICROTESLA
        # Points out of the plane would fill the disc.
        near = np.linalg.norm(field[:, plane] / size, axis=1) > np.cos(np.pi / 6.0)
        flat = drawn[:, plane] / np.linalg.norm(field[:, plane] / size, axis=1, keepdims=True)
        axes.plot(*flat[near].T, ".", ms=4, c=colour)
    first, second = (_AXES[i] for i in plane)
    reach = (-1.3 * radius, 1.3 * radius)
    axes.set(xlim=reach, ylim=reach, aspect="equal")
    axes.set(xlabel=f"sensor {first} (µT)", ylabel=f"sensor {second} (µT)")
