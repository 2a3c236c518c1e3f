"""Demodulated phasors: one row per window and channel in files, dense arrays in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.plausible import check_field
from magfusion.files.table import TIME, Span, Table, TableLayout, read_table, write_table
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.units import Array, IntArray

_REAL = ("re_x", "re_y", "re_z")
_IMAGINARY = ("im_x", "im_y", "im_z")
_UPPER = np.triu_indices(3)
_COV = tuple(f"cov_{'xyz'[i]}{'xyz'[j]}" for i, j in zip(*_UPPER, strict=True))
SAME_TIME = 1e-7  # s; less is rounding of stamps
MIN_ROWS = 8  # fewer may be zero in a component by their pose
MIN_SERIES = 6  # components of channels; signs of so many are all positive once in 64 poses
_AMPLITUDE, _MAGNETOMETER = "amplitude", "magnetometer"
_PARTS = {axis: (f"re_{axis}", f"im_{axis}") for axis in "xyz"}
_LAYOUT = TableLayout(
    numbers=("sigma", "window"),
    integers=(TIME, "tone"),
    texts=("beacon",),
    optional=(*_PARTS.values(), (_AMPLITUDE,), _COV),
    optional_texts=(_MAGNETOMETER,),
    repeats=True,
)


def write_fields(fields: FieldSamples, path: Path, epoch_ns: int) -> None:
    """Write phasors as Parquet, one row per window and channel that is there."""
    row, channel = np.nonzero(fields.valid)
    phasor, cov = fields.phasor_sensor[row, channel], fields.phasor_cov[row, channel]
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(fields.time)[row]}
    names = pa.array([beacon for beacon, _ in fields.channels], pa.string())
    columns["beacon"] = names.take(pa.array(channel))
    columns["tone"] = np.array([tone for _, tone in fields.channels], dtype=np.int64)[channel]
    if fields.magnetometers:
        sensors = pa.array(fields.magnetometers, pa.string())
        columns[_MAGNETOMETER] = sensors.take(pa.array(channel))
    kept = [name for axis in fields.axes for name in _PARTS[axis]]
    if not fields.signed:
        columns[_AMPLITUDE] = phasor[:, "xyz".index(fields.axes)].real
        kept = []
    parts = dict(zip(_REAL, phasor.real.T, strict=True))
    parts |= dict(zip(_IMAGINARY, phasor.imag.T, strict=True))
    columns |= {name: value for name, value in parts.items() if name in kept}
    own = ["xyz".index(axis) for axis in fields.axes]
    columns["sigma"] = np.sqrt(np.trace(cov[:, own][:, :, own], axis1=1, axis2=2) / len(own))
    columns["window"] = fields.window[row]
    if fields.axes == "xyz":
        columns |= dict(zip(_COV, cov[:, *_UPPER].T, strict=True))
    write_table(columns, path)


def read_fields(path: Path, span: Span) -> FieldSamples:
    """Read and check phasors in Parquet or CSV, within a span of time.

    Channels are in the order in which the file first names them, and of several magnetometers each
    has its own; the covariance is
    ``sigma**2`` times the identity where the file does not hold one.  A receiver of fewer axes
    leaves columns out, which are NaN; one without signs gives amplitudes, here along x.
    """
    table = read_table(path, _LAYOUT, span)
    axes, signed = _measured(table, path)
    channels, magnetometers, column = _channels(table)
    time_ns, first, row = _epochs(table, magnetometers, column)
    cell = row * len(channels) + column
    repeated = np.ones(len(cell), dtype=bool)
    repeated[np.unique(cell, return_index=True)[1]] = False
    table.refuse(repeated, TIME, table.time_ns, "the channel has two rows: remove one of them")
    window = _positive(table, "window")
    differs = window != window[first][row]
    table.refuse(differs, "window", window, "write the same in all rows of one time")
    phasor = np.full((len(time_ns), len(channels), 3), np.nan, dtype=np.complex128)
    for axis in axes:
        names = _PARTS[axis] if signed else (_AMPLITUDE,)
        parts = table.numbers(names, nan=signed)
        _refuse_half(table, names, parts)
        phasor[row, column, "xyz".index(axis)] = parts[:, 0] + (1j * parts[:, 1] if signed else 0)
    nothing = ~np.any(np.isfinite(phasor[row, column]), axis=1)
    table.refuse(nothing, "beacon", column, "every component is missing; leave the row out")
    if not signed:
        result = phasor[row, column, 0].real
        table.refuse(result < 0.0, _AMPLITUDE, result, "an amplitude has no sign; write re and im")
    size = np.sqrt(np.nansum(np.abs(phasor[row, column]) ** 2, axis=1))
    check_field(size, str(path))
    cov = np.full((*phasor.shape, 3), np.nan)
    cov[row, column] = _covariance(table)
    at = table.time[first], window[first]
    result = FieldSamples(*at, channels, phasor, cov, axes=axes, signed=signed)
    return replace(result, magnetometers=magnetometers)


def refuse_unsigned(fields: FieldSamples, frequency_hz: Array, place: Path | str) -> None:
    """Refuse amplitudes of three axes that are written as parts in phase.

    Signed components of alternating fields change sign with pose and tone, and noise leaves no
    part out of phase at zero. `frequency_hz`: of each channel, 0 of a level.
    """
    alternating = np.asarray(frequency_hz) > 0.0
    if fields.axes != "xyz" or not fields.signed or len(fields) < MIN_ROWS:
        return
    phasor = fields.phasor_sensor[:, alternating].reshape(len(fields), -1)
    measured = phasor[:, np.isfinite(phasor).any(axis=0)]
    unsigned = (measured.real >= 0.0) & (measured.imag == 0.0) | np.isnan(measured)
    if measured.shape[1] >= MIN_SERIES and unsigned.all():
        raise InputError(
            f"{place}: the components of three axes are never negative and have no part out of"
            " phase, so they are amplitudes, which are for receivers of one axis; give re and im"
            " with their signs."
        )


def order_channels(fields: FieldSamples, site: Site) -> FieldSamples:
    """Arrange the channels as the site names them; those never measured are NaN.

    What several magnetometers measured is stamped, and its phases are referred, by the log's clock.
    Raises InputError where a channel, or a magnetometer, is unknown to the site, or the fields do
    not specify which of several measured them.
    """
    sensors = site.platform.magnetometers
    names = tuple(dict.fromkeys(fields.magnetometers))
    known = tuple(sensor.name for sensor in sensors)
    strange = [name for name in names if name not in known]
    # A site of one takes what is of it, and a log that names one needs no site that does.
    if strange and (len(sensors) > 1 or (len(names) > 1 and known[0] not in names)):
        raise InputError(
            f"The fields are of magnetometer {', '.join(strange)}, which the site does not know (it"
            f" has {', '.join(known)}); give the site in which the log was recorded."
        )
    if len(sensors) == 1:
        alone = fields if len(names) < 2 else fields.of_magnetometer(known[0])
        return on_log_clock(_ordered(replace(alone, magnetometers=()), site), site)
    if not names:
        raise InputError(
            f"The fields do not specify which of the site's magnetometers measured them"
            f" ({', '.join(known)}); add a column magnetometer with its name."
        )
    parts = []
    for sensor in sensors:
        one = replace(site, platform=site.platform.with_magnetometers((sensor,)))
        own = _ordered(fields.of_magnetometer(sensor.name), one)
        parts.append(on_log_clock(own, one))
    return side_by_side(parts, site)


def on_log_clock(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return the phasors of a magnetometer by the log's clock, which is not its own."""
    late = site.platform.magnetometer.clock_offset
    if not late:
        return fields
    turn = np.exp(-2j * np.pi * site.tone_frequencies_hz * late)
    return replace(
        fields, time=fields.time + late, phasor_sensor=fields.phasor_sensor * turn[:, None]
    )


def by_own_clocks(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return phasors of several magnetometers as each stamps them; `order_channels` undoes it."""
    offsets = [sensor.clock_offset for sensor in site.platform.magnetometers]
    if not any(offsets):
        return fields
    tones, parts = site.tone_frequencies_hz, []
    for sensor, late in enumerate(offsets):
        mine = site.of_sensor(sensor)
        own = fields.rows(np.any(fields.valid[:, mine], axis=1))
        phasor, cov = np.full_like(own.phasor_sensor, np.nan), np.full_like(own.phasor_cov, np.nan)
        turn = np.exp(2j * np.pi * tones * late)
        phasor[:, mine] = own.phasor_sensor[:, mine] * turn[:, None]
        cov[:, mine] = own.phasor_cov[:, mine]
        parts.append(replace(own, time=own.time - late, phasor_sensor=phasor, phasor_cov=cov))
    whole = FieldSamples.joined(parts)
    return whole.rows(np.argsort(whole.time, kind="stable"))


def side_by_side(parts: list[FieldSamples], site: Site) -> FieldSamples:
    """Return the phasors of each of a site's magnetometers as one; times as one are one epoch."""
    every = np.concatenate([part.time for part in parts])
    order = np.argsort(every, kind="stable")
    begins = np.diff(every[order], prepend=-np.inf) > SAME_TIME
    row = np.empty(len(every), dtype=np.int64)
    row[order] = np.cumsum(begins) - 1
    time, window = every[order][begins], np.zeros(np.count_nonzero(begins))
    count = len(parts[0].channels)
    phasor = np.full((len(time), len(site.channels), 3), np.nan, dtype=np.complex128)
    cov = np.full((*phasor.shape, 3), np.nan)
    start = 0
    for sensor, part in enumerate(parts):
        own, mine = row[start : start + len(part)], site.of_sensor(sensor)
        start += len(part)
        window[own] = np.maximum(window[own], part.window)
        phasor[own, mine], cov[own, mine] = part.phasor_sensor, part.phasor_cov
    sensors = [sensor.name for sensor in site.platform.magnetometers]
    return FieldSamples(
        time=time,
        window=window,
        channels=site.channels,
        phasor_sensor=phasor,
        phasor_cov=cov,
        magnetometers=tuple(name for name in sensors for _ in range(count)),
    )


def _ordered(fields: FieldSamples, site: Site) -> FieldSamples:
    unknown = [channel for channel in fields.channels if channel not in site.channels]
    if unknown:
        known = _listed(site.channels)
        raise InputError(
            f"The fields hold {_listed(unknown)}, which the site does not know (it knows {known});"
            " give the site in which the log was recorded."
        )
    present = np.array([c in fields.channels for c in site.channels], dtype=bool)
    source = [fields.channels.index(c) for c in site.channels if c in fields.channels]
    phasor = np.full((len(fields), len(site.channels), 3), np.nan, dtype=np.complex128)
    cov = np.full((*phasor.shape, 3), np.nan)
    phasor[:, present] = fields.phasor_sensor[:, source]
    cov[:, present] = fields.phasor_cov[:, source]
    return replace(fields, channels=site.channels, phasor_sensor=phasor, phasor_cov=cov)


def _measured(table: Table, path: Path) -> tuple[str, bool]:
    """Return the axes that a table has, and whether it has their signs."""
    axes = "".join(axis for axis, names in _PARTS.items() if table.has(names))
    if table.has((_AMPLITUDE,)):
        if axes or table.has(_COV):
            raise InputError(
                f"{path}: has both amplitude and re, im or a covariance; keep one of them"
            )
        return "x", False
    if not axes:
        wanted = ", ".join((*_REAL, *_IMAGINARY))
        raise InputError(f"{path}: columns {wanted} are missing; add what is missing.")
    if table.has(_COV) and axes != "xyz":
        raise InputError(f"{path}: holds a covariance of three axes, and only {axes}; leave it out")
    _refuse_blind(table, path, axes)
    return axes, True


def _refuse_half(table: Table, names: tuple[str, ...], parts: Array) -> None:
    """Refuse a component with one part of two; without both it was not measured."""
    half = np.any(np.isnan(parts), axis=1) & ~np.all(np.isnan(parts), axis=1)
    remedy = f"write both of {', '.join(names)}, or leave both out where nothing was measured"
    table.refuse(half, names[0], parts[:, 0], remedy)


def _refuse_blind(table: Table, path: Path, axes: str) -> None:
    """Refuse a component without a number, or with zeros that are none."""
    parts = np.stack([table.numbers(_PARTS[axis], nan=True) for axis in axes])
    blind = np.all((parts == 0.0) | np.isnan(parts), axis=(1, 2))
    if len(table) < MIN_ROWS or not np.any(blind) or np.all(blind):
        return
    none = [axis for axis, nothing in zip(axes, blind, strict=True) if nothing]
    names = ", ".join(f"re_{axis}, im_{axis}" for axis in none)
    raise InputError(
        f"{path}: {names} measured nothing (zero or NaN in every row); give the component, or leave"
        " its columns out and declare platform.magnetometer.axes without it: zeros would be taken"
        " for fields."
    )


def _epochs(
    table: Table, magnetometers: tuple[str, ...], column: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the time and the first row of each epoch, and the epoch of each row.

    Stamps of several magnetometers are of clocks of their own: what is of one is one epoch.
    """
    if not magnetometers:
        return np.unique(table.time_ns, return_index=True, return_inverse=True)
    sensor = np.array([magnetometers.index(name) for name in magnetometers])[column]
    pairs, first, row = np.unique(
        np.stack([table.time_ns, sensor], axis=1), axis=0, return_index=True, return_inverse=True
    )
    return pairs[:, 0], first, row.ravel()


def _channels(table: Table) -> tuple[tuple[tuple[str, int], ...], tuple[str, ...], IntArray]:
    """Return channels, the magnetometer of each, and which is that of each row."""
    names, beacon = table.texts("beacon")
    tone = table.integers("tone")
    table.refuse(tone < 0, "tone", tone, "write an integer from 0")
    several = table.has((_MAGNETOMETER,))
    sensors, sensor = table.texts(_MAGNETOMETER) if several else ([""], np.zeros_like(beacon))
    pairs, first, row = np.unique(
        np.stack([beacon, tone, sensor], axis=1), axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    channels = tuple((names[b], int(t)) for b, t, _ in pairs[order])
    magnetometers = tuple(sensors[s] for _, _, s in pairs[order]) if several else ()
    return channels, magnetometers, place[row.ravel()]


def _covariance(table: Table) -> Array:
    sigma = _positive(table, "sigma")
    if not table.has(_COV):
        return np.asarray(np.square(sigma)[:, None, None] * np.eye(3))
    cov = np.empty((len(table), 3, 3))
    upper = table.numbers(_COV)
    cov[:, *_UPPER] = upper
    cov[:, _UPPER[1], _UPPER[0]] = upper
    smallest = np.linalg.eigvalsh(cov)[:, 0]
    table.refuse(smallest <= 0.0, "cov_xx to cov_zz", smallest, "its eigenvalues must be positive")
    return cov


def _positive(table: Table, name: str) -> Array:
    value = table.numbers((name,))[:, 0]
    table.refuse(value <= 0.0, name, value, "write a positive number")
    return value


def _listed(channels: tuple[tuple[str, int], ...] | list[tuple[str, int]]) -> str:
    return ", ".join(f"beacon {name} tone {tone}" for name, tone in channels)
