"""Initial layout of a recording: the views side by side, their axes, and the verdict above."""

import math
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.results.recording_plots import TIMELINE
from magfusion.results.shapes import Scale
from magfusion.units import Array

_DECADES_SHOWN = 6.0  # of the steps that are labelled: more would stand too close for a label
_LETTERS = 190  # to a line of the banner
_LINE, _HEADING, _WINDOW = 16.0, 106.0, 930.0  # heights in a usual window

Part = rrb.Container | rrb.View


def readable_range(*shown: Array, zero: bool = False) -> tuple[float, float] | None:
    """Return a range in which the viewer labels at least two values.

    It labels powers of ten and their multiples, and of these only sufficiently spaced ones: in a
    low plot over +-4, only zero. `shown`: the drawn values, which may be NaN. `zero`: whether zero
    is in the range. Returns None for no value or a single one.
    """
    values = np.concatenate([np.ravel(one) for one in shown]) if shown else np.empty(0)
    values = values[np.isfinite(values)]
    if zero:
        values = np.append(values, 0.0)
    if len(values) == 0 or np.ptp(values) == 0.0:
        return None
    low, high = float(values.min()), float(values.max())
    step = 10.0 ** math.ceil(math.log10((high - low) / _DECADES_SHOWN))
    first, last = math.ceil(low / step), math.floor(high / step)
    if first >= last:  # one label or none: on to the next ones
        first, last = math.floor(low / step), math.ceil(high / step)
    margin = 0.06 * (max(high, last * step) - min(low, first * step))
    return min(low, first * step) - margin, max(high, last * step) + margin


def about_zero(*shown: Array) -> tuple[float, float] | None:
    """Return a readable range symmetric about zero."""
    return readable_range(*shown, *(-np.asarray(one) for one in shown))


def span_of(time: Array) -> rr.TimeRange:
    """Return the whole span of a series, for the horizontal axis."""
    first, last = (rr.TimeInt(seconds=float(time[i])) for i in (0, -1))
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(first), end=rr.TimeRangeBoundary.absolute(last)
    )


def plot(
    origin: str,
    name: str,
    span: rr.TimeRange | None,
    values: tuple[float, float] | None = None,
    *,
    legend: bool = True,
) -> rrb.TimeSeriesView:
    """Return a plot of the series below an entity.

    `name`: title, the quantity with its unit. `span`: of the horizontal axis. `values`: of the
    vertical axis, from `readable_range`; by default set by the viewer.
    """
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=None if span is None else rrb.TimeAxis(view_range=span),
        axis_y=None if values is None else rrb.ScalarAxis(range=values),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def eye_on(scale: Scale) -> rrb.EyeControls3D:
    """Return a view of the whole scene from above its corner."""
    ahead = scale.centre_world + scale.size * np.array([-0.05, -0.08, 0.0])  # what is near is large
    return rrb.EyeControls3D(
        position=ahead + scale.size * np.array([-0.34, -0.55, 0.74]),
        look_target=ahead,
        eye_up=(0.0, 0.0, 1.0),
    )


def layout(
    *parts: Part,
    shares: tuple[int, ...] = (1, 1),
    banner: tuple[str, str] | None = None,
    play: Literal["paused", "following"] = "paused",
) -> rrb.Blueprint:
    """Return a layout of parts side by side, with the viewer's own panels collapsed.

    `banner`: entity of the text above them, and this text, which determines its height. `play`:
    whether the time is paused, or follows the data.
    """
    body: rrb.Container = rrb.Horizontal(*parts, column_shares=list(shares))
    if banner is not None:
        entity, text = banner
        lines = sum(math.ceil(len(line) / _LETTERS) for line in text.splitlines()[1:])
        height = min(_HEADING + _LINE * lines, 0.3 * _WINDOW)
        view = rrb.TextDocumentView(origin=entity, name="Verdict")
        body = rrb.Vertical(view, body, row_shares=[height, _WINDOW - height])
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state=play),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )
