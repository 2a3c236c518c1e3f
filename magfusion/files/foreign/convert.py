"""A mapped table becomes a table of a log, part by part, and everything left out is counted."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.clock_steps import clock_set_back
from magfusion.files.foreign.columns import EULER, OPTIONAL_COLUMNS, QUATERNION, TIME, Term
from magfusion.files.foreign.plan import ImportPlan
from magfusion.files.foreign.source import RowBlock
from magfusion.files.foreign.units import NO_STAMP, Raw, to_nanoseconds
from magfusion.files.lost_rows import (
    MAX_DUPLICATED,
    MAX_MISSING,
    LostRows,
    coarse_text,
    copied_rows,
)
from magfusion.files.plausible import MIN_STEP
from magfusion.files.pose_rows import MAX_LENGTH_ERROR, MAX_UNNORMALIZED_SHARE, PoseRows
from magfusion.files.row_stamps import batches_text, separate_stamps
from magfusion.files.stray_stamps import (
    EDGE_S,
    MAX_GAP,
    MAX_STRAY_ROWS,
    MAX_STRAY_SHARE,
    counted_back,
    misplaced_rows,
    stray_rows,
)
from magfusion.files.table import MAX_NUMBER, MAX_TIME_NS, ROWS_PER_GROUP
from magfusion.files.table import TIME as TIME_NS
from magfusion.model.counters import lost_by_wrapping
from magfusion.units import NANOSECOND, AnyArray, Array, BoolArray, IntArray

STEPS = {  # s
    **dict.fromkeys(("imu", "gyro", "accel"), (MIN_STEP, 0.5)),
    "magnetometer": (1e-6, 0.5),
}
OTHER_CLOCK = 0.3  # of a truth's rows, that may be stamped by another clock
# Reasons why rows are left out.
STRAY, COPIES = "with a stray time", "that are copies of others"


@dataclass
class Counts:
    """What became of the rows of a table."""

    read: int = 0
    written: int = 0
    missing: int = 0  # rows written with NaN: samples that were not taken
    unsorted: int = 0  # rows that were before one above, and were put in their place
    # whether many rows have the stamp of the row above: they are judged when all are read
    batched: bool = False
    # whether the first row is far from the second: it may be stray, as the last may be
    paused: bool = False
    last_step: int = 0  # between the last two rows (ns)
    # stamps (ns) and numbers of rows that are before the row above
    backward: list[IntArray] = field(default_factory=list)
    # largest deviation of a quaternion's length from one, that was scaled to one
    scaled: float = 0.0
    # what became of samples of which several have one stamp; empty where none did
    batches: str = ""
    # rows that were not written, by the reason
    left_out: dict[str, int] = field(default_factory=dict)
    left_out_first: int = 0  # stray rows before the first
    before_ns: int = 0  # from the first sample, whose stamp may be stray, to the first one written
    # first, last: stamps (ns)
    first: int = MAX_TIME_NS
    last: int = -MAX_TIME_NS
    previous: int = 0  # stamp of the last row that was written (ns)
    # newest, wrapped: stamp of the last row that was read, and what its counter lost by wrapping
    # until then (ns)
    newest: int = -MAX_TIME_NS
    wrapped: int = 0

    def leave_out(self, reason: str, count: int) -> None:
        """Count rows that are not written."""
        if count:
            self.left_out[reason] = self.left_out.get(reason, 0) + count


def write_stream(
    plan: ImportPlan, path: Path, shared: bool = False, report: Callable[[int], None] | None = None
) -> Counts:
    """Write the table of a stream as Parquet, sorted by time.

    `shared`: whether the table holds other streams, too: rows without any number of this one are
    theirs. `report`: called after each part with the number of rows read. Raises InputError naming
    file, column and row, where the table is no recording of one clock.
    """
    counts = Counts()
    mapped = [name for name in plan.terms if name != TIME]
    names = list(dict.fromkeys(one for name in mapped for one in _written(name)))
    schema = pa.schema([(TIME_NS, pa.int64()), *((name, pa.float64()) for name in names)])
    options = {"compression": "zstd", "write_page_checksum": True}
    with pa.parquet.ParquetWriter(path, schema, **options) as writer:
        for part, stamps, values in converted_rows(plan, names):
            for reason, count in part.left_out.items():
                counts.leave_out(reason, count)
            rows = part.rows
            if shared:
                own = ~np.isnan(values).all(axis=1)
                counts.read += int(np.sum(~own))
                counts.leave_out("that are of other streams", int(np.sum(~own)))
                stamps, values, rows = stamps[own], values[own], rows[own]
            stamps, values = _kept(plan, names, stamps, values, rows, counts)
            columns = [stamps, *values.T]
            writer.write_table(
                pa.table(dict(zip(schema.names, columns, strict=True))),
                row_group_size=ROWS_PER_GROUP,
            )
            if report is not None:
                report(counts.read)
    paused = counts.paused or counts.last_step * NANOSECOND > EDGE_S
    if counts.backward or counts.batched or paused:
        _order(path, counts, plan)
    if counts.written and counts.left_out_first:
        stamps = pa.parquet.read_table(path, columns=[TIME_NS])[TIME_NS].to_numpy()
        counts.before_ns = counts.first - counted_back(stamps, counts.left_out_first)
    _check(plan, counts)
    return counts


def converted_rows(
    plan: ImportPlan, names: Sequence[str]
) -> Iterator[tuple[RowBlock, IntArray, Array]]:
    """Yield a table in parts: as read, its stamps (ns, `NO_STAMP` if absent), values (n, names)."""
    places = sorted({term.place for terms in plan.terms.values() for term in terms})
    texts = {term.place for term in plan.terms.get(TIME, ())}
    for part in plan.source.read(places, texts):
        raw = dict(zip(places, part.columns, strict=True))
        yield part, stamps_of(plan, raw, part), _values(plan, raw, names)


def stamps_of(plan: ImportPlan, raw: dict[int, Raw], part: RowBlock) -> IntArray:
    """Return the times of some rows (ns), `NO_STAMP` if absent.

    Raises InputError where a text is no time.
    """
    if plan.rate is not None:
        start = plan.shift_ns + round((plan.rate.start_s or 0) * 10**9)
        step = float(10**9 / plan.rate.hz)
        return start + np.rint(part.rows * step).astype(np.int64)
    total = np.zeros(len(part.rows), dtype=np.int64)
    absent = np.zeros(len(part.rows), dtype=bool)
    for term in plan.terms[TIME]:
        try:
            stamps = to_nanoseconds(raw[term.place], term.unit)
        except ValueError as result:
            name = plan.source.columns[term.place].name
            raise InputError(
                f"{plan.source.place}: column {name}: found {str(result)!r}, which is no time in"
                f" {term.unit}; name another unit by --map '{plan.stream}.time={name}[unit]'"
                " (iso for dates as 2024-05-01T12:00:00.5)."
            ) from None
        absent |= stamps == NO_STAMP
        total += np.where(absent, 0, int(term.sign) * stamps)
    return np.where(absent, NO_STAMP, total + plan.shift_ns)


def _written(name: str) -> tuple[str, ...]:
    """Return the columns of a log that a mapped one becomes."""
    return QUATERNION if name in EULER else (name,)


def _values(plan: ImportPlan, raw: dict[int, Raw], names: Sequence[str]) -> Array:
    result = {
        name: _si(raw[terms[0].place], terms[0])
        for name, terms in plan.terms.items()
        if name != TIME
    }
    if EULER[0] in result:
        angles = np.stack([result.pop(name) for name in reversed(EULER)], axis=1)
        known = np.isfinite(angles).all(axis=1)
        rotated = np.full((len(angles), 4), np.nan)
        rotated[known] = Rotation.from_euler("ZYX", angles[known]).as_quat(scalar_first=True)
        result |= dict(zip(QUATERNION, rotated.T, strict=True))
    values = np.stack([result[name] for name in names], axis=1)
    values[~(np.abs(values) < MAX_NUMBER)] = np.nan
    return values


def _si(raw: Raw, term: Term) -> AnyArray:
    if isinstance(raw, pa.Array | pa.ChunkedArray):
        raw = raw.cast(pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(raw, dtype=np.float64) * (term.sign * term.unit.si)


def _kept(
    plan: ImportPlan,
    names: list[str],
    stamps: IntArray,
    values: Array,
    rows: IntArray,
    counts: Counts,
) -> tuple[IntArray, Array]:
    """Return the rows to write, and count the others."""
    counts.read += len(stamps)
    keep: BoolArray = stamps != NO_STAMP
    counts.leave_out("without a time", int(np.sum(~keep)))
    needed = [name not in OPTIONAL_COLUMNS.get(plan.stream, {}) for name in names]
    missing: BoolArray = np.asarray(np.isnan(values[:, needed]).any(axis=1))
    if plan.stream == "truth":
        # A truth has no use for rows that hold no pose; a stream of samples knows that one is lost.
        keep[keep] = _with_poses(names, needed, values, keep, counts)
    stamps = _unwrapped(stamps, keep, counts)
    keep[keep] = ~_strays(plan.stream, stamps[keep], counts)
    stamps, values, rows, missing = stamps[keep], values[keep], rows[keep], missing[keep]
    if not len(stamps):
        return stamps, values
    _refuse_jumps(plan, stamps, rows, counts)
    before = counts.previous if counts.written else int(stamps[0]) - 1
    twice: BoolArray = np.diff(stamps, prepend=before) == 0
    counts.batched |= not counts.written and bool(np.mean(twice) > MAX_DUPLICATED)
    if not counts.batched:
        copies = copied_rows(stamps, values)
        counts.leave_out(COPIES, int(np.sum(copies)))
        counts.leave_out("with the stamp of another", int(np.sum(twice & ~copies)))
        stamps, values, missing = stamps[~twice], values[~twice], missing[~twice]
        rows = rows[~twice]
    # Rows out of order are judged, and doubles among them found, when all are read.
    steps = np.diff(stamps, prepend=before)
    if len(steps):
        counts.last_step = int(steps[-1])
        counts.paused |= not counts.written and bool(np.any(steps[1:2] * NANOSECOND > EDGE_S))
    if np.any(steps < 0):
        counts.backward.append(np.stack([stamps, rows])[:, steps < 0])
    counts.missing += int(np.sum(missing))
    counts.written += len(stamps)
    if len(stamps):
        counts.previous = int(stamps[-1])
        counts.first = min(counts.first, int(stamps.min()))
        counts.last = max(counts.last, int(stamps.max()))
    return stamps, values


def _with_poses(
    names: list[str], needed: list[bool], values: Array, rows: BoolArray, counts: Counts
) -> BoolArray:
    """Return which of some rows have a pose; scale their quaternions to unit length."""
    places = [names.index(q) for q in QUATERNION] if QUATERNION[0] in names else []
    own = values[rows]
    poses = PoseRows.of(own[:, needed], own[:, places] if places else None)
    for reason, count in poses.left_out.items():
        counts.leave_out(reason, count)
    if poses.quaternion is not None:
        values[np.flatnonzero(rows)[:, None], places] = poses.quaternion
    counts.scaled = max(counts.scaled, poses.scaled)
    return poses.kept


def _unwrapped(stamps: IntArray, rows: BoolArray, counts: Counts) -> IntArray:
    """Return stamps (ns) that go on where a counter wraps; some rows have none."""
    if not rows.any():
        return stamps
    seconds: Array = np.asarray(stamps[rows] * NANOSECOND)
    last = (counts.newest - counts.wrapped) * NANOSECOND
    before = -np.inf if counts.newest == -MAX_TIME_NS else last
    missing = lost_by_wrapping(seconds, before, counts.wrapped * NANOSECOND) / NANOSECOND
    result = stamps.copy()
    result[rows] += np.rint(missing).astype(np.int64)
    counts.newest, counts.wrapped = int(result[rows][-1]), round(missing[-1])
    return result


def _strays(stream: str, stamps: IntArray, counts: Counts) -> BoolArray:
    """Return which rows have a stamp far from all others, and count them."""
    if not len(stamps):
        return np.zeros(0, dtype=bool)
    last = counts.last if counts.written else None
    stray = stray_rows(stamps, counts.written, last, *_accepted(stream, len(stamps)))
    counts.leave_out(STRAY, int(np.sum(stray)))
    if not counts.written:
        counts.left_out_first += int(np.argmin(np.append(stray, False)))
    return stray


def _accepted(stream: str, count: int) -> tuple[float, int]:
    """Return share and number of rows that may be stray."""
    return (OTHER_CLOCK, count) if stream == "truth" else (MAX_STRAY_SHARE, MAX_STRAY_ROWS)


def _refuse_jumps(plan: ImportPlan, stamps: IntArray, rows: IntArray, counts: Counts) -> None:
    before = counts.last if counts.written else int(stamps[0])
    steps = np.diff(stamps.astype(np.float64), prepend=float(before)) * NANOSECOND
    far = np.abs(stamps) > MAX_TIME_NS
    for bad, what in (
        (far, "is beyond any clock: another unit of time is probably meant"),
        (
            steps > MAX_GAP,
            "is {size:.6g} s after the row above: the clock jumped; correct the times, or import"
            " the parts one by one",
        ),
    ):
        if bad.any():
            k = int(np.argmax(bad))
            raise InputError(
                f"{plan.source.place}: {plan.stream}.time, row {rows[k]} of the data (counted from"
                f" 0): {stamps[k] * NANOSECOND:.9g} s {what.format(size=abs(steps[k]))}."
            )


def _order(path: Path, counts: Counts, plan: ImportPlan) -> None:
    """Sort the rows by time, leave out stray ones and copies, and spread those of batches.

    Raises InputError where the clock was set back.
    """
    table = pa.parquet.read_table(path)
    optional = OPTIONAL_COLUMNS.get(plan.stream, {})
    measured = [name for name in table.column_names[1:] if name not in optional]
    values = np.stack([table[name].to_numpy() for name in measured], axis=1)
    stamps = table[TIME_NS].to_numpy()
    kept = np.flatnonzero(~misplaced_rows(stamps, *_accepted(plan.stream, len(stamps))))
    counts.leave_out(STRAY, len(stamps) - len(kept))
    counts.left_out_first += int(kept[0])
    _refuse_step(plan, stamps[kept], values[kept], counts)
    counts.unsorted = int(np.sum(stamps[kept] < np.maximum.accumulate(stamps[kept])))
    kept = kept[np.argsort(stamps[kept], kind="stable")]
    table, stamps, values = table.take(kept), stamps[kept], values[kept]
    copies, twice, *_ = LostRows.of(stamps, values)
    separate = separate_stamps(stamps, values)
    if separate is not None:
        counts.batches = batches_text(stamps)
        stamps = separate
        table = table.set_column(0, TIME_NS, pa.array(separate))
    else:
        counts.leave_out(COPIES, int(np.sum(copies)))
        counts.leave_out("with the stamp of another", int(np.sum(twice)))
        once = ~(copies | twice)
        table, stamps, values = table.filter(pa.array(once)), stamps[once], values[once]
    counts.first, counts.last, counts.written = int(stamps[0]), int(stamps[-1]), len(stamps)
    counts.missing = int(np.sum(np.isnan(values).any(axis=1)))
    pa.parquet.write_table(
        table, path, compression="zstd", row_group_size=ROWS_PER_GROUP, write_page_checksum=True
    )


def _refuse_step(plan: ImportPlan, stamps: IntArray, values: Array, counts: Counts) -> None:
    """Refuse rows, in the order of the file, of a clock that was set back."""
    step = clock_set_back(stamps, values)
    if step is None:
        return
    backward = np.concatenate(counts.backward, axis=1)
    rows = backward[1][backward[0] == step.stamp_ns]
    row = f", row {rows[-1]} of the data (counted from 0)" if len(rows) else ""
    raise InputError(
        f"{plan.source.place}: {plan.stream}.time{row}: {step.stamp_ns * NANOSECOND:.13g} s goes"
        f" back by {step.size_s:.6g} s: the clock was set back or a counter wrapped around; correct"
        " the times, or import the parts one by one."
    )


def _check(plan: ImportPlan, counts: Counts) -> None:
    place, stream = plan.source.place, plan.stream
    if not counts.written:
        reasons = ", ".join(f"{n} {reason}" for reason, n in counts.left_out.items())
        result = f"none of {counts.read} rows can be used ({reasons})" if counts.read else "no rows"
        remedy = "record it again, or map other columns"
        if plan.rate is None and counts.left_out.get("without a time", 0) == counts.read > 0:
            unit = plan.terms[TIME][0].unit
            remedy = (
                f"the times are empty, or beyond any clock in {unit}: give their unit by --map"
                f" '{stream}.time=NAME[ns]'"
            )
        raise InputError(f"{place}: {result} for {stream}; {remedy}.")
    off = counts.left_out.get("with a quaternion not of unit length", 0)
    if off > MAX_UNNORMALIZED_SHARE * (counts.written + off):
        raise InputError(
            f"{place}: {off} of {counts.read} quaternions are more than"
            f" {100.0 * MAX_LENGTH_ERROR:.0f} % off unit length: map other columns, or scale them"
            " if they are rotations."
        )
    twice = counts.left_out.get("with the stamp of another", 0)
    if twice > MAX_DUPLICATED * (counts.written + twice):
        raise InputError(coarse_text(place, stream, twice, counts.read))
    step = (counts.last - counts.first) * NANOSECOND / max(1, counts.written - 1)
    least, maximum = STEPS.get(stream, (0.0, np.inf))
    if counts.written > 1 and not least <= step <= maximum:
        kind = "slow" if step > maximum else "fast"
        raise InputError(
            f"{place}: the rows of {stream} are {step:.3g} s apart (mean), which is too {kind} for"
            f" such a sensor: {stream}.time is probably in another unit; write it by --map"
            f" '{stream}.time=NAME[unit]'."
        )
    if counts.missing > MAX_MISSING * counts.written:
        raise InputError(
            f"{place}: {counts.missing} of {counts.written} rows lack a number of {stream}: map"
            " other columns, or leave out rows that are of another sensor."
        )
