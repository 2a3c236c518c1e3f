"""Next stops of the sensor, as a picture: the stops in plan, and the remaining sigmas."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial.transform import Rotation

from magfusion.model.hall import Hall
from magfusion.model.site import Site
from magfusion.results.design.motion import MotionPlan

LISTED = 24  # parameters, worst first
_AXES = (("x", "tab:red"), ("y", "tab:green"), ("z", "tab:blue"))


def write_motion_plot(path: Path, site: Site, hall: Hall, result: MotionPlan) -> None:
    """Write a PNG of stops, numbered, with the axes of the body at each, and of the sigmas."""
    figure = Figure(figsize=(15.0, 7.5), layout="constrained")
    plan, bars = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    _draw_plan(plan, site, hall, result)
    _draw_sigmas(bars, result)
    figure.suptitle("Next stops of the platform, and the parameters they determine")
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _draw_plan(axes: Axes, site: Site, hall: Hall, result: MotionPlan) -> None:
    axes.add_patch(Polygon(hall.room.polygon, fill=False, edgecolor="0.6", linewidth=1.2))
    for beacon in site.beacons:
        x, y, z = beacon.position_world
        axes.scatter(x, y, s=60, marker="^", c="red", edgecolors="white", zorder=3)
        axes.annotate(
            f"{beacon.name} ({z:.3g} m)",
            (x, y),
            (0, 8),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    places = np.vstack([hall.room.polygon, *(b.position_world[:2] for b in site.beacons)])
    reach = 0.06 * float(np.max(np.ptp(places, axis=0)))
    middle = float(np.mean(hall.room.box_world[:, 0]))
    groups: dict[tuple[float, float], list[int]] = {}
    for number, stop in enumerate(result.stops):
        x, y, _ = stop.position_world.tolist()
        groups.setdefault((x, y), []).append(number)
    for (x, y), numbers in groups.items():
        lines = []
        for k, number in enumerate(numbers):
            stop = result.stops[number]
            turn = Rotation.from_euler("xyz", stop.rpy_deg, degrees=True).as_matrix()
            if k == 0:
                for column, (_, colour) in enumerate(_AXES):
                    way = reach * turn[:2, column]
                    if np.linalg.norm(way) > 1e-6:
                        axes.annotate(
                            "",
                            (x + way[0], y + way[1]),
                            (x, y),
                            arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.6},
                        )
            roll, pitch, yaw = stop.rpy_deg
            lines.append(
                f"{number + 1}: z {stop.position_world[2]:.3g} m, {roll:g}/{pitch:g}/{yaw:g}°"
            )
        axes.plot(x, y, "o", color="black", markersize=4)
        axes.annotate(
            "\n".join(lines),
            (x, y),
            (6, -6) if x < middle else (-6, -6),
            textcoords="offset points",
            va="top",
            ha="left" if x < middle else "right",
            fontsize=8,
            bbox={
                "facecolor": "white",
                "alpha": 0.75,
                "linewidth": 0,
                "boxstyle": "round,pad=0.15",
            },
        )
    low, high = places.min(axis=0) - 2.0 * reach, places.max(axis=0) + 2.0 * reach
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title(
        "stops in their order: height, roll/pitch/yaw; arrows: the body's x (red), y (green),\n"
        "z (blue) at the first stop there; triangles: beacons",
        fontsize=9,
    )


def _draw_sigmas(axes: Axes, result: MotionPlan) -> None:
    parameters = result.parameters
    start = parameters.excess(np.ones(len(result.ratio)))
    order = np.argsort(-np.where(parameters.requested, start, -1.0), kind="stable")
    order = order[parameters.requested[order]][:LISTED]
    rows = np.arange(len(order))
    axes.barh(rows, np.ones(len(order)), color="0.8", label="before")
    axes.barh(rows, result.ratio[order], height=0.55, color="tab:blue", label="after these stops")
    limit = parameters.limit[order]
    axes.plot(limit, rows, "|", color="tab:orange", markersize=9, label="after all possible stops")
    labels = [
        f"{parameters.names[k][0]}   {parameters.sized(k, 1.0)} → {parameters.sized(k, r)}"
        for k, r in zip(order.tolist(), result.ratio[order].tolist(), strict=True)
    ]
    axes.set_yticks(rows, labels, fontsize=7)
    axes.set(xlabel="sigma over the site's", xlim=(0.0, 1.05), ylim=(len(order) - 0.5, -0.5))
    axes.set_title("largest effect on the fields first", fontsize=9)
    axes.legend(loc="lower right", fontsize=8)
