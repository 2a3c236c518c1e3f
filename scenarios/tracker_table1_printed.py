"""Table 1 of paper 000 as printed, and its pictures with what `tracker_table1` measures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness import between_deg, blank_figure, rms, save_picture

from magfusion.papers.p000_tracker.equations import attitude_from_angles
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from tracker_table1 import Row

# Yaw, pitch, roll (deg): target, antenna not calibrated, antenna calibrated.
TABLE = np.array(
    [
        [[0, 0, 0], [0.21, 0.23, 0.33], [0.02, 0.05, 0.06]],
        [[0, 30, 0], [0.21, 30.42, 0.33], [0.02, 30.06, 0.06]],
        [[0, 60, 0], [0.22, 61.13, 0.32], [0.03, 60.23, 0.05]],
        [[0, 90, 0], [0.22, 91.71, 0.32], [0.03, 90.36, 0.05]],
        [[30, 0, 0], [30.41, 0.31, 0.23], [30.06, 0.03, 0.03]],
        [[60, 0, 0], [60.63, 0.31, 0.23], [60.10, 0.04, 0.02]],
        [[90, 0, 0], [91.92, 0.31, 0.23], [90.25, 0.06, 0.03]],
        [[0, 0, 30], [0.21, 0.23, 29.24], [0.21, 0.23, 30.01]],
        [[0, 0, 60], [0.22, 0.24, 59.43], [0.21, 0.23, 60.03]],
        [[0, 0, 90], [0.25, 0.27, 89.89], [0.21, 0.23, 90.04]],
        [[10, 20, 30], [10.26, 20.34, 29.54], [10.06, 20.04, 30.03]],
        [[20, 40, 60], [20.34, 40.44, 59.61], [20.09, 40.08, 60.06]],
        [[30, 60, 90], [30.44, 61.05, 89.86], [30.13, 60.18, 90.07]],
    ]
)
ROW_AT_THE_POLE = 3
DRAWN = {  # level: name, marker and colour
    "U": ("not calibrated", "o", "tab:red"),
    "P2": ("the paper's procedure, corrected", "s", "tab:purple"),
    "J": ("all coils and their sizes, forty poses", "^", "tab:blue"),
}


def printed_turns() -> tuple[Array, Array]:
    """Return the printed errors before and after, angles of the rotation (deg), each (13,)."""
    attitudes = attitude_from_angles(TABLE * DEGREE)
    before, after = (between_deg(attitudes[:, k], attitudes[:, 0]) for k in (1, 2))
    return before, after


def printed_ratios() -> dict[str, tuple[float, float, float]]:
    """Return uncalibrated error, calibrated error and ratio of the printed table (deg)."""
    before, after = np.abs(TABLE[:, 1] - TABLE[:, 0]), np.abs(TABLE[:, 2] - TABLE[:, 0])
    turns = printed_turns()
    rows = np.arange(len(TABLE)) != ROW_AT_THE_POLE
    figures = {
        "mean of 39 angles": (float(np.mean(before)), float(np.mean(after))),
        "RMS of 39 angles": (rms(before), rms(after)),
        "largest": (float(np.max(before)), float(np.max(after))),
        "RMS without the pole": (rms(before[rows]), rms(after[rows])),
        "geodesic RMS": (rms(turns[0]), rms(turns[1])),
    }
    return {name: (*pair, pair[0] / pair[1]) for name, pair in figures.items()}


def report_printed() -> str:
    """Return the ratios of the printed table."""
    lines = ["Paper 000, Table 1, as printed (deg)"]
    for name, (before, after, ratio) in printed_ratios().items():
        lines.append(f" {name:24}{before:7.3f} ->{after:7.3f}   x{ratio:.2f}")
    return "\n".join(lines)


def draw(path: Path, tables: Mapping[str, Sequence["Row"]]) -> None:
    """Write a PNG of the attitude errors of every level, with the printed ones."""
    figure = blank_figure(5.0 * len(tables), 4.0)
    before, after, _ = printed_ratios()["geodesic RMS"]
    panels = figure.subplots(1, len(tables), squeeze=False, sharey=True)[0]
    for axes, (title, rows) in zip(panels, tables.items(), strict=True):
        middle = [row.attitude_deg for row in rows]
        spread = [[row.attitude_deg - row.low_deg for row in rows]]
        spread += [[row.high_deg - row.attitude_deg for row in rows]]
        axes.bar([row.level for row in rows], middle, yerr=spread, color="0.7", capsize=3)
        axes.axhline(before, color="tab:red", linestyle=":", label="Table 1, before")
        axes.axhline(after, color="tab:blue", linestyle=":", label="Table 1, after")
        axes.set(title=title, yscale="log")
    panels[0].set_ylabel("attitude error, RMS (deg)")
    panels[0].legend()
    save_picture(figure, path)


def draw_rows(path: Path, tables: Mapping[str, Sequence["Row"]]) -> None:
    """Write a PNG of the table's own thirteen attitudes: printed errors and those measured."""
    figure = blank_figure(5.0 * len(tables), 4.4)
    number = np.arange(1, len(TABLE) + 1)
    panels = figure.subplots(1, len(tables), squeeze=False, sharey=True)[0]
    for axes, (title, rows) in zip(panels, tables.items(), strict=True):
        for row in rows:
            if row.level in DRAWN:
                name, marker, colour = DRAWN[row.level]
                axes.plot(number, row.each_deg, marker + "-", c=colour, ms=4, lw=0.8, label=name)
        for turns, name, colour in zip(
            printed_turns(), ("not calibrated", "calibrated"), ("tab:red", "tab:blue"), strict=True
        ):
            axes.plot(number, turns, "x", c=colour, ms=8, mew=2, label=f"paper 000, {name}")
        axes.set(title=title, yscale="log", xticks=number, xlabel="row of Table 1")
        axes.grid(visible=True, axis="y", alpha=0.3)
    panels[0].set_ylabel("attitude error, angle of the rotation (deg)")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=8)
    save_picture(figure, path)
