"""A hall in plan with its beacons: outline, places, axes, and names that do not overlap."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from matplotlib.text import Annotation

from magfusion.model.hall import Hall
from magfusion.model.site import Beacon
from magfusion.results.design.pattern import pattern_axis
from magfusion.units import Array

REACH = 0.035  # of the hall's longer side; half the length of an axis
LONG = 0.5  # width over length, below which slices are below each other
MARGIN = 0.14  # of it, around the hall
STAR = 8.0  # points; radius of the marker of one more beacon
BOX = {"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.8, "linewidth": 0}


def slices(size: Array, rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with axes for horizontal slices of a hall, by row and column.

    `size` (2,): of the hall in plan (m); slices of a long one are below each other.
    """
    shape = float(size[1] / size[0])
    is_long = shape < LONG
    across = 1 if is_long else columns
    down = rows * columns if is_long else rows
    width = 8.6 if is_long else 8.6 / columns  # text is readable on a page of 700 px
    tall = float(np.clip(0.85 * width * shape, 1.3, 8.0)) + 0.9
    figure = Figure(figsize=(1.5 + width * across, 1.3 + tall * down), layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(down, across, squeeze=False).ravel().tolist()
    return figure, [every[columns * k : columns * (k + 1)] for k in range(rows)]


def add_legend(figure: Figure, every: Sequence[Axes], unknown: str, blank: str = "") -> None:
    """Add one legend for all axes.

    `unknown`: meaning of grey. `blank`: meaning of white in a hall, if any.
    """
    entries: dict[str, Artist] = {}
    for axes in every:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    entries[unknown] = Patch(facecolor="0.75")
    if blank:
        entries[blank] = Patch(facecolor="white", edgecolor="0.5")
    legend = figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside lower center",
        ncols=5 if len(entries) < 5 else 3,
        fontsize=9,
        frameon=False,
    )
    for shown in legend.legend_handles:  # a white cross would not be seen
        if shown is not None and getattr(shown, "get_marker", str)() == "x":
            shown.set(markeredgecolor="black")


def draw_hall(axes: Axes, hall: Hall) -> None:
    """Draw the outline of a hall and its forbidden places, with equal scales."""
    axes.add_patch(
        Polygon(hall.room.polygon, fill=False, edgecolor="black", linewidth=1.5, zorder=2)
    )
    for number, prism in enumerate(hall.mounts.forbidden):
        axes.add_patch(
            Polygon(
                prism.polygon,
                fill=False,
                edgecolor="0.4",
                hatch="//",
                linewidth=0.8,
                zorder=2,
                label="no beacons here" if number == 0 else None,
            )
        )
    low, high = hall.room.box_world[:, :2]
    margin = MARGIN * float(np.max(high - low))
    axes.set(
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
        xlabel="x (m)",
        ylabel="y (m)",
        aspect="equal",
    )


def clip_to_hall(axes: Axes, hall: Hall) -> None:
    """Clip all maps of some axes to the outline of the hall."""
    outline = Polygon(hall.room.polygon, transform=axes.transData)
    for mesh in axes.collections:
        mesh.set_clip_path(outline)


def draw_beacons(
    axes: Axes, beacons: Sequence[Beacon], size: float, marked: Beacon | None = None
) -> None:
    """Draw places and axes of beacons, and their names with heights.

    `size`: longer side of the hall (m). `marked`: one of them, at the best place of one more.
    """
    if not beacons:
        return
    places = np.array([b.position_world[:2] for b in beacons])
    reach, shown = REACH * size, False
    for beacon in beacons:
        axis = pattern_axis(beacon)
        if axis is None:
            continue
        x, y, _ = beacon.position_world
        way = reach * (beacon.world_from_beacon @ axis)[:2]
        label = None if shown else "axis in plan (none: vertical)"
        shown = True
        axes.plot(
            [x - way[0], x + way[0]],
            [y - way[1], y + way[1]],
            color="red",
            linewidth=1.5,
            clip_on=False,
            label=label,
        )
    axes.scatter(
        places[:, 0],
        places[:, 1],
        s=45,
        marker="^",
        c="red",
        edgecolors="white",
        zorder=3,
        clip_on=False,
        label="beacon (height)",
    )
    if marked is not None:
        axes.scatter(
            float(marked.position_world[0]),
            float(marked.position_world[1]),
            s=220,
            marker="*",
            c="red",
            edgecolors="white",
            zorder=4,
            clip_on=False,
            label="best place of one more",
        )
    middle = 0.5 * (np.min(places, axis=0) + np.max(places, axis=0))
    texts = [f"{b.name} ({b.position_world[2]:.3g} m)" for b in beacons]
    star = places[:0] if marked is None else marked.position_world[None, :2]
    draw_labels(axes, places, texts, middle, star)


def draw_labels(
    axes: Axes, places: Array, texts: Sequence[str], middle: Array, stars: Array
) -> None:
    """Write a text at each place, towards the outside, moved until none is on another.

    `stars` (k, 2): places of large markers, on which no text is written (m).
    """
    figure = axes.figure
    figure.canvas.draw()  # lays out the axes, so that the sizes of texts are known
    radius = STAR * figure.dpi / 72.0
    used: list[Array] = [
        np.stack([at - radius, at + radius]) for at in axes.transData.transform(stars)
    ]
    frame = axes.get_window_extent().get_points()
    for place, text in zip(places, texts, strict=True):
        outwards = 1 if place[1] >= middle[1] else -1
        offsets = [
            (38 * sideways, way * (9 + 11 * step))
            for way in (outwards, -outwards)
            for step in range(8)
            for sideways in (0, 1, -1)
        ]
        chosen: tuple[tuple[int, int], Array] | None = None
        for offset in offsets:
            note = _label(axes, place, text, offset, leader=False)
            box = note.get_window_extent().get_points()
            note.remove()
            if any(_overlap(box, other) for other in used):
                continue
            inside = np.all((box > frame[0]) & (box < frame[1]))
            if inside or chosen is None:
                chosen = offset, box
            if inside:
                break
        if chosen is not None:
            offset, box = chosen
            _label(axes, place, text, offset, leader=offset != (0, 9 * outwards))
            used.append(box)


def _overlap(one: Array, other: Array) -> bool:
    """Return whether two boxes, each of a lower and an upper corner, have points in common."""
    return bool(np.all(one[0] <= other[1]) and np.all(other[0] <= one[1]))


def _label(
    axes: Axes, place: Array, text: str, offset: tuple[int, int], leader: bool
) -> Annotation:
    """Write a text at an offset (points) from a place, with a line to it on request."""
    return axes.annotate(
        text,
        (place[0], place[1]),
        xytext=offset,
        textcoords="offset points",
        ha="center",
        va="bottom" if offset[1] > 0 else "top",
        fontsize=8,
        bbox=BOX,
        annotation_clip=False,
        arrowprops={"arrowstyle": "-", "color": "0.4", "linewidth": 0.6} if leader else None,
    )
