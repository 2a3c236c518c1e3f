"""A table of phasors, amplitudes or levels becomes the fields of a log."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.fields import refuse_unsigned, write_fields
from magfusion.files.foreign.columns import TIME
from magfusion.files.foreign.convert import Counts, stamps_of
from magfusion.files.foreign.phasors import (
    AMBIENT,
    AXES,
    LABELS,
    VALUES,
    PhasorPlan,
    coils_in_order,
)
from magfusion.files.foreign.plan import ImportPlan
from magfusion.files.foreign.source import RowBlock
from magfusion.files.foreign.units import NO_STAMP, Raw
from magfusion.model.samples import FieldSamples
from magfusion.units import NANOSECOND, Array, ComplexArray, IntArray

Channel = tuple[str, int]


class _Measured:
    """Rows of a table: stamps (n,) (ns), channels (n,), phasors (n, 3) (T), sigma and window (n,).

    Components that a row lacks are NaN; amplitudes without sign are along x.
    """

    def __init__(self, count: int, signed: bool, axes: str) -> None:
        self.stamps: IntArray = np.zeros(count, dtype=np.int64)
        self.channel: IntArray = np.zeros(count, dtype=np.int64)
        self.channels: list[Channel] = []
        self.phasor: ComplexArray = np.full((count, 3), np.nan, dtype=np.complex128)
        self.sigma, self.window = np.full(count, np.nan), np.full(count, np.nan)
        self.signed, self.axes = signed, axes


def write_phasors(plan: PhasorPlan, path: Path) -> Counts:
    """Write the fields of a table as Parquet, sorted by time.

    Raises InputError where the table holds no phasor, or names coils that the site does not have.
    """
    stamps, columns = _columns(plan)
    counts = Counts(read=len(stamps))
    result = _by_coil(plan, stamps, columns) if plan.coils else _by_row(plan, stamps, columns)
    known = (result.stamps != NO_STAMP) & np.isfinite(result.phasor).any(axis=1)
    counts.leave_out("without a time or a value", int(np.sum(~known)))
    if not known.any():
        raise InputError(f"{plan.source.place}: holds no phasor; map other columns.")
    time_ns, row = np.unique(result.stamps[known], return_inverse=True)
    phasor = np.full((len(time_ns), len(result.channels), 3), np.nan, dtype=np.complex128)
    sigma = np.full(phasor.shape[:2], np.nan)
    cell = row, result.channel[known]
    twice = np.ones(len(row), dtype=bool)
    axis = np.argmax(np.isfinite(result.phasor[known]), axis=1)  # of several rows of one coil
    twice[np.unique(np.stack([*cell, axis]), axis=1, return_index=True)[1]] = False
    counts.leave_out("with the stamp of another", int(np.sum(twice)))
    for component in range(3):
        values = result.phasor[known][:, component]
        own = np.isfinite(values) & ~twice
        phasor[row[own], cell[1][own], component] = values[own]
    sigma[cell] = result.sigma[known]
    window = _windows(result.window[known], row, time_ns)
    cov = np.square(sigma)[..., None, None] * np.eye(3)
    seconds = (time_ns - time_ns[0]) * NANOSECOND
    channels = tuple(result.channels)
    samples = FieldSamples(
        *(seconds, window, channels, phasor, cov), axes=result.axes, signed=result.signed
    )
    refuse_unsigned(samples, _frequencies(plan, channels), plan.source.place)
    write_fields(samples, path, int(time_ns[0]))
    counts.first, counts.last = int(time_ns[0]), int(time_ns[-1])
    counts.written = int(np.sum(np.isfinite(phasor).any(axis=2)))
    return counts


def _frequencies(plan: PhasorPlan, channels: tuple[Channel, ...]) -> Array:
    """Return the frequency of each channel (Hz): 0 of levels, 1 of tones that no site gives."""
    levels = AMBIENT in plan.coils or "slot" in plan.terms or plan.frame > 0
    if plan.site is None:
        return np.full(len(channels), 0.0 if levels else 1.0)
    return plan.site.frequencies_of(channels)


def is_signed(path: Path) -> bool:
    """Return whether a table of fields holds phasors, and not amplitudes alone."""
    return "amplitude" not in pa.parquet.read_schema(path).names


def _columns(plan: PhasorPlan) -> tuple[IntArray, dict[int, Raw]]:
    """Return stamps (ns) and the values of the columns that are used, by their places."""
    timed = {name: terms for name, terms in plan.terms.items() if name == TIME}
    places = sorted(
        {t.place for terms in (*plan.terms.values(), *plan.coils.values()) for t in terms}
    )
    texts = {t.place for name in (TIME, *LABELS) for t in plan.terms.get(name, ())}
    table = ImportPlan(plan.stream, plan.source, timed, plan.rate, plan.shift_ns)
    parts: list[tuple[IntArray, list[Raw]]] = []
    for part in plan.source.read(places, texts):
        rows = part.rows // plan.frame if plan.frame else part.rows
        raw = dict(zip(places, part.columns, strict=True))
        parts.append((stamps_of(table, raw, RowBlock(part.columns, rows)), part.columns))
    if not parts:
        raise InputError(f"{plan.source.place}: holds no rows; record it again.")
    columns = {
        place: np.concatenate([np.asarray(own[k]) for _, own in parts])
        for k, place in enumerate(places)
    }
    return np.concatenate([stamps for stamps, _ in parts]), columns


def _numbers(plan: PhasorPlan, columns: dict[int, Raw], name: str) -> Array | None:
    return _measured(plan, columns, name) if name in plan.terms else None


def _measured(plan: PhasorPlan, columns: dict[int, Raw], name: str) -> Array:
    (term,) = plan.terms[name]
    return np.asarray(columns[term.place], dtype=np.float64) * (term.sign * term.unit.si)


def _windows(window: Array, row: IntArray, time_ns: IntArray) -> Array:
    """Return the length of each window; of a table without it, the step between two."""
    result = np.full(len(time_ns), np.nan)
    result[row] = window
    if np.isfinite(result).all():
        return result
    step = float(np.median(np.diff(time_ns))) * NANOSECOND if len(time_ns) > 1 else 1.0
    return np.where(np.isfinite(result), result, step)


def _one_axis(plan: PhasorPlan) -> str:
    axes = "" if plan.site is None else plan.site.platform.magnetometer.axes
    if len(axes) != 1:
        raise InputError(
            f"{plan.source.place}: phasors of one component do not name its axis; map fields.axis,"
            " or give --site with platform.magnetometer.axes."
        )
    return axes


def _by_coil(plan: PhasorPlan, stamps: IntArray, columns: dict[int, Raw]) -> _Measured:
    """Return the phasors of a table with columns for each coil."""
    values = {}
    for coil, terms in plan.coils.items():
        own = [np.asarray(columns[t.place], np.float64) * (t.sign * t.unit.si) for t in terms]
        half = len(own) // 2
        if len(own) in (2, 6):
            own = [re + 1j * im for re, im in zip(own[:half], own[half:], strict=True)]
        values[coil] = np.stack(own, axis=1)
    ambient = values.pop(AMBIENT, None)
    widths = {value.shape[1] for value in values.values()}
    real = not any(np.iscomplexobj(value) for value in values.values())
    signed = not (real and widths == {1} and ambient is None)
    axes = AXES if widths == {3} else _one_axis(plan) if signed else "x"
    own_axes = [AXES.index(axis) for axis in axes]
    result = _Measured(len(values) * len(stamps), signed, axes)
    result.channels = [coil for coil in values if not isinstance(coil, str)]
    for k, value in enumerate(values.values()):
        rows = slice(k * len(stamps), (k + 1) * len(stamps))
        level = value if ambient is None else value - ambient
        result.phasor[rows, own_axes] = level
        result.stamps[rows], result.channel[rows] = stamps, k
        result.sigma[rows] = _sigma(plan, columns)
        window = _numbers(plan, columns, "window")
        result.window[rows] = np.nan if window is None else window
    return result


def _sigma(plan: PhasorPlan, columns: dict[int, Raw]) -> Array:
    own = _numbers(plan, columns, "sigma")
    return np.array(plan.sigma) if own is None else own


def _by_row(plan: PhasorPlan, stamps: IntArray, columns: dict[int, Raw]) -> _Measured:
    """Return the phasors of a table with a row for each coil, or for each of its axes."""
    vector = [name for name in VALUES if name in plan.terms]
    level, re, im = (_numbers(plan, columns, name) for name in ("value", "re", "im"))
    axis = _axes(plan, columns)
    signed = bool(vector) or level is None or axis is not None or bool(np.nanmin(level) < 0.0)
    axes = AXES if vector or axis is not None else _one_axis(plan) if signed else "x"
    if axis is not None:
        axes = "".join(one for k, one in enumerate(AXES) if k in axis)
    result = _Measured(len(stamps), signed, axes)
    result.stamps, (result.channels, result.channel) = stamps, _channels(plan, columns)
    for name in vector:
        part = 1.0 if name.startswith("re") else 1j
        former = np.nan_to_num(result.phasor[:, AXES.index(name[-1])])
        result.phasor[:, AXES.index(name[-1])] = former + part * _measured(plan, columns, name)
    if not vector:
        value = level if re is None else re + 1j * (0.0 if im is None else im)
        own = np.full(len(stamps), AXES.index(axes[0])) if axis is None else axis
        result.phasor[np.arange(len(stamps)), own] = value
    result.sigma[:] = _sigma(plan, columns)
    window = _numbers(plan, columns, "window")
    result.window[:] = np.nan if window is None else window
    silent = result.channel < 0
    result.phasor[silent] = np.nan
    result.channel[silent] = 0
    return result


def _axes(plan: PhasorPlan, columns: dict[int, Raw]) -> IntArray | None:
    if "axis" not in plan.terms:
        return None
    texts = np.asarray(columns[plan.terms["axis"][0].place]).astype(str)
    names = {name: k for k, name in enumerate(AXES)} | {str(k): k for k in range(3)}
    result = np.array([names.get(text.strip().lower(), -1) for text in texts])
    if np.any(result < 0):
        raise InputError(
            f"{plan.source.place}: found axis {texts[np.argmax(result < 0)]!r}; write x, y or z (or"
            " 0 to 2)."
        )
    return result


def _channels(plan: PhasorPlan, columns: dict[int, Raw]) -> tuple[list[Channel], IntArray]:
    """Return the channels, and that of each row; -1 of a silent slot."""
    tone = _numbers(plan, columns, "tone")
    label = next((name for name in ("beacon", "slot") if name in plan.terms), None)
    if label == "beacon":
        names = np.asarray(columns[plan.terms["beacon"][0].place]).astype(str)
        tones = np.zeros(len(names)) if tone is None else tone
        pairs = [(name.strip(), int(t)) for name, t in zip(names, tones, strict=True)]
        channels = list(dict.fromkeys(pairs))
        places = {channel: k for k, channel in enumerate(channels)}
        return channels, np.array([places[pair] for pair in pairs])
    assert plan.site is not None
    order = coils_in_order(plan.site)
    if label == "slot":
        slots = _measured(plan, columns, "slot").astype(np.int64)
    else:
        slots = np.arange(len(next(iter(columns.values())))) % plan.frame
    beyond = ~((slots >= -1) & (slots < len(order)))
    if np.any(beyond):
        raise InputError(
            f"{plan.source.place}: found slot {slots[np.argmax(beyond)]}; the site has slots 0 to"
            f" {len(order) - 1}."
        )
    channels = [channel for channel in order if channel is not None]
    place = [-1 if channel is None else channels.index(channel) for channel in (*order, None)]
    return channels, np.array(place)[slots]
