"""Line charts as SVG for pages: a few milliseconds each, with real text, without a library."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from magfusion.units import Array, IntArray

MAX_POINTS = 1200  # of a line; more than a chart has pixels
_LEFT_MARGIN, _RIGHT, _TOP, _BOTTOM = 62.0, 10.0, 26.0, 38.0  # pixels around the axes
_MIN_POSITIVE = 1e-300


class ChartLine(NamedTuple):
    """Points (n,) joined to a line, or dots; NaN interrupts it.  ``colour`` is a class of CSS."""

    x: Array
    y: Array
    label: str = ""
    colour: str = "estimate"
    dots: bool = False


class ChartBand(NamedTuple):
    """The area between two lines (n,)."""

    x: Array
    low: Array
    high: Array
    label: str = ""


class ChartMark(NamedTuple):
    """A named point."""

    x: float
    y: float
    label: str
    colour: str = "beacon"


@dataclass(frozen=True, eq=False)
class Chart:
    """Content of a chart."""

    title: str
    x_label: str
    y_label: str
    lines: tuple[ChartLine, ...]
    bands: tuple[ChartBand, ...] = ()
    marks: tuple[ChartMark, ...] = ()
    equal: bool = False  # whether both axes have one scale, as in a plan
    log: bool = False  # whether the upright axis is logarithmic
    # limits of the upright axis; values beyond are drawn at the edge
    y_limits: tuple[float, float] | None = None
    width: float = 440.0
    height: float = 230.0


class _Axes(NamedTuple):
    """The area of values: limits, and pixels per unit."""

    low: tuple[float, float]
    high: tuple[float, float]
    size: tuple[float, float]

    def x(self, value: Array | float) -> Array:
        along = (np.asarray(value) - self.low[0]) / (self.high[0] - self.low[0])
        return np.asarray(_LEFT_MARGIN + self.size[0] * along)

    def y(self, value: Array | float) -> Array:
        along = (np.asarray(value) - self.low[1]) / (self.high[1] - self.low[1])
        return np.asarray(_TOP + self.size[1] * (1.0 - np.clip(along, 0.0, 1.0)))


def svg(chart: Chart) -> str:
    """Return a chart as an HTML element; all its text is escaped."""
    if chart.log:
        chart = _logarithmic(chart)
    axes = _axes(chart)
    right, bottom = _LEFT_MARGIN + axes.size[0], _TOP + axes.size[1]
    height = bottom + _BOTTOM
    parts = [
        f'<svg viewBox="0 0 {chart.width:.0f} {height:.0f}" width="{chart.width:.0f}"'
        f' height="{height:.0f}" role="img" aria-label="{escape(chart.title)}">',
        _text(_LEFT_MARGIN, 15.0, chart.title, "title"),
        *_grid(chart, axes),
        *(_band(band, axes) for band in chart.bands),
        *(_line(line, axes) for line in chart.lines),
        *(_mark(mark, axes) for mark in chart.marks),
        f'<path class="frame" d="M{_LEFT_MARGIN},{_TOP}V{bottom:.1f}H{right:.1f}"/>',
        _text(0.5 * (_LEFT_MARGIN + right), height - 6.0, chart.x_label, "middle"),
        f'<text class="middle" transform="translate(12,{0.5 * (_TOP + bottom):.1f}) rotate(-90)">'
        f"{escape(chart.y_label)}</text>",
        "</svg>",
        _legend(chart),
    ]
    return f"<figure>{''.join(parts)}</figure>"


def ticks(low: float, high: float, maximum: int = 6) -> list[float]:
    """Return round numbers between two values."""
    raw = (high - low) / maximum
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1.0, 2.0, 5.0, 10.0) if power * m >= raw * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def thinned(y: Array) -> IntArray:
    """Return the rows of a line to draw: the minimum and maximum of each stretch."""
    n = len(y)
    if n <= MAX_POINTS:
        return np.arange(n)
    edges = np.linspace(0, n, MAX_POINTS // 2 + 1).astype(np.int64)
    chosen = {0, n - 1}
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        piece = y[begin:end]
        if np.isfinite(piece).all():
            chosen |= {begin + int(np.argmin(piece)), begin + int(np.argmax(piece))}
        else:  # what interrupts the line must not be lost
            chosen |= {begin, begin + int(np.argmax(~np.isfinite(piece)))}
    return np.array(sorted(chosen))


def _logarithmic(chart: Chart) -> Chart:
    def selected(y: Array) -> Array:
        return np.log10(np.where(y > 0.0, np.maximum(y, _MIN_POSITIVE), np.nan))

    lines = tuple(line._replace(y=selected(line.y)) for line in chart.lines)
    bands = tuple(b._replace(low=selected(b.low), high=selected(b.high)) for b in chart.bands)
    return Chart(**{**vars(chart), "lines": lines, "bands": bands})


def _extent(values: Iterable[Array | float], least: float) -> tuple[float, float]:
    known = [v[np.isfinite(v)] for v in map(np.atleast_1d, values)]
    whole = np.concatenate([*known, np.empty(0)])
    if not len(whole):
        return 0.0, 1.0
    low, high = float(whole.min()), float(whole.max())
    room = max(0.5 * (least - (high - low)), 0.04 * (high - low))
    return low - room, high + room


def _axes(chart: Chart) -> _Axes:
    lines, marks = chart.lines, chart.marks
    every_x: list[Array | float] = [*(p.x for p in lines), *(m.x for m in marks)]
    every_x += [b.x for b in chart.bands]
    every_y: list[Array | float] = [*(p.y for p in lines), *(m.y for m in marks)]
    every_y += [side for b in chart.bands for side in (b.low, b.high)]
    largest = max((abs(e) for e in _extent(every_y, 0.0)), default=1.0)
    least = 1.0 if chart.log else 1e-9 * max(largest, 1e-6)
    (x0, x1), (y0, y1) = _extent(every_x, 1e-9), _extent(every_y, least)
    if chart.y_limits is not None:
        y0, y1 = chart.y_limits
    width, height = chart.width - _LEFT_MARGIN - _RIGHT, chart.height - _TOP - _BOTTOM
    if chart.equal:
        x_span, y_span = max(x1 - x0, 1e-3), max(y1 - y0, 1e-3)
        height = min(max(width * y_span / x_span, 120.0), 1.2 * width)
        scale = min(width / x_span, height / y_span)
        x_more, y_more = 0.5 * (width / scale - x_span), 0.5 * (height / scale - y_span)
        x0, x1, y0, y1 = x0 - x_more, x1 + x_more, y0 - y_more, y1 + y_more
    return _Axes((x0, y0), (x1, y1), (width, height))


def _grid(chart: Chart, axes: _Axes) -> list[str]:
    right, bottom = _LEFT_MARGIN + axes.size[0], _TOP + axes.size[1]
    out = []
    for value in ticks(axes.low[0], axes.high[0]):
        x = float(axes.x(value))
        out.append(f'<path class="grid" d="M{x:.1f},{_TOP}V{bottom:.1f}"/>')
        out.append(_text(x, bottom + 14.0, _number(value), "middle"))
    low, high = axes.low[1], axes.high[1]
    upright = _decades(low, high) if chart.log else ticks(low, high, 5)
    for value in upright:
        y = float(axes.y(value))
        words = _number(10.0**value if chart.log else value)
        out.append(f'<path class="grid" d="M{_LEFT_MARGIN},{y:.1f}H{right:.1f}"/>')
        out.append(_text(_LEFT_MARGIN - 5.0, y + 4.0, words, "end"))
    return out


def _decades(low: float, high: float) -> list[float]:
    """Return logarithms of round numbers."""
    steps = (1.0, 2.0, 5.0) if high - low < 2.5 else (1.0,)
    every = max(1, round((high - low) / 6.0))
    powers = range(math.floor(low), math.ceil(high) + 1, every)
    result = [power + math.log10(step) for power in powers for step in steps]
    return [value for value in result if low <= value <= high]


def _points(x: Array, y: Array) -> list[str]:
    return [f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]


def _line(line: ChartLine, axes: _Axes) -> str:
    rows = thinned(line.y)
    x, y = axes.x(line.x[rows]), axes.y(line.y[rows])
    broken = np.flatnonzero(~np.isfinite(y))
    pieces = [
        _points(px[np.isfinite(py)], py[np.isfinite(py)])
        for px, py in zip(np.split(x, broken), np.split(y, broken), strict=True)
    ]
    if line.dots:
        path = "".join(f"M{point}h0" for piece in pieces for point in piece)
        return f'<path class="dots {line.colour}" d="{path}"/>'
    path = "".join("M" + "L".join(piece) for piece in pieces if piece)
    return f'<path class="line {line.colour}" d="{path}"/>'


def _band(band: ChartBand, axes: _Axes) -> str:
    rows = thinned(band.high - band.low)
    known = np.isfinite(band.low[rows]) & np.isfinite(band.high[rows])
    rows = rows[known]
    if not len(rows):
        return ""
    x = axes.x(band.x[rows])
    there = _points(x, axes.y(band.high[rows]))
    back = _points(x[::-1], axes.y(band.low[rows][::-1]))
    return f'<path class="band" d="M{"L".join([*there, *back])}Z"/>'


def _mark(mark: ChartMark, axes: _Axes) -> str:
    x, y = float(axes.x(mark.x)), float(axes.y(mark.y))
    shape = f'<circle class="mark {mark.colour}" cx="{x:.1f}" cy="{y:.1f}" r="4"/>'
    return shape + _text(x + 6.0, y - 5.0, mark.label, "name")


def _legend(chart: Chart) -> str:
    shown = [(band.label, "band") for band in chart.bands]
    shown += [(line.label, line.colour) for line in chart.lines]
    entries = [
        f'<span><i class="{colour}"></i>{escape(label)}</span>' for label, colour in shown if label
    ]
    return f"<figcaption>{''.join(entries)}</figcaption>" if entries else ""


def _text(x: float, y: float, words: str, kind: str) -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}">{escape(words)}</text>'


def _number(value: float) -> str:
    return f"{0.0 if abs(value) < 1e-12 else value:.6g}"
