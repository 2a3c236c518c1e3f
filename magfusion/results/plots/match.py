"""Attitudes estimated from the field as a picture, and the database used for them."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from magfusion.files.attitude_table import AttitudeDatabase
from magfusion.papers.p001_magnetometer.matching import Matches, wrap
from magfusion.units import DEGREE, NANOTESLA, Array

_NAMES = ("roll", "pitch", "yaw")


def write_match_plot(
    path: Path, time: Array, matches: Matches, result: tuple[int, ...], true_rpy: Array | None
) -> None:
    """Write a PNG of the estimated angles over time, and of their errors where a truth is known.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    matches : Matches
        Shapes (n, hypotheses, ...).
    result : tuple of int
        Which of roll, pitch and yaw are estimated, not given.
    true_rpy : ndarray, shape (n, 3), optional
        (rad); NaN where unknown.
    """
    columns = 1 if true_rpy is None else 2
    figure = Figure(figsize=(6.5 * columns, 1.0 + 2.5 * len(result)), layout="constrained")
    panels = figure.subplots(len(result), columns, squeeze=False, sharex=True)
    certain = matches.determined[:, 0]
    for row, k in zip(panels, result, strict=True):
        angle = matches.rpy[..., k] / DEGREE
        if matches.ambiguous.any():
            row[0].plot(time, angle[:, 1], ".", ms=2, color="0.75", label="other solution")
        if not certain.all():
            row[0].plot(
                time[~certain], angle[~certain, 0], "x", color="red", label="not determined"
            )
        row[0].plot(time[certain], angle[certain, 0], ".", ms=3, label="found")
        row[0].set(ylabel=f"{_NAMES[k]} (deg)")
        if true_rpy is not None:
            row[0].plot(time, true_rpy[:, k] / DEGREE, "-", lw=0.6, color="black", label="truth")
            error = wrap(matches.rpy[:, 0, k] - true_rpy[:, k]) / DEGREE
            bound = 3.0 * matches.sigma[:, 0, k] / DEGREE
            row[1].fill_between(time[certain], -bound[certain], bound[certain], color="0.85", lw=0)
            row[1].plot(time[certain], error[certain], ".", ms=3)
            row[1].set(ylabel=f"error of {_NAMES[k]} (deg); grey: 3 sigma")
        row[0].legend(loc="upper right", fontsize="small")
    for axes in panels[-1]:
        axes.set(xlabel="time (s)")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def write_database_plot(path: Path, database: AttitudeDatabase, residual: Array) -> None:
    """Write a PNG of the attitudes in a database, and of the residuals of a uniform field.

    `residual` (n, 3): of each entry (T).
    """
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    size = np.linalg.norm(residual, axis=1) / NANOTESLA
    roll, pitch, yaw = database.rpy.T / DEGREE
    if database.angles == "roll":
        axes.plot(roll, size, ".", ms=4)
        axes.set(ylabel="distance from a uniform field (nT)")
        axes.set(title=f"{len(database)} entries at pitch {pitch[0]:.1f}, yaw {yaw[0]:.1f} deg")
    else:
        points = axes.scatter(roll, pitch, c=size, s=5)
        figure.colorbar(points, label="distance from a uniform field (nT)")
        axes.set(ylabel="pitch (deg)", title=f"{len(database)} entries at yaw {yaw[0]:.1f} deg")
    axes.set(xlabel="roll (deg)", xlim=(-180.0, 180.0))
    figure.savefig(path, dpi=110, metadata={"Software": None})
