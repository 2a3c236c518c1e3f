"""The figures of an import: rows read and left out, and how columns were interpreted."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from magfusion.files.foreign.columns import FIELDS
from magfusion.files.foreign.convert import Counts
from magfusion.files.foreign.halves import HALVES
from magfusion.files.pose_rows import QUATERNION_TOLERANCE, scaled_text
from magfusion.results.figures import Figure, Figures, Section
from magfusion.units import NANOSECOND

if TYPE_CHECKING:
    from magfusion.files.foreign.gather import GatheredStreams

FIELD_STREAMS = ("magnetometer", FIELDS)
LATE = 1e8  # s; stamps that count from 1970, or from another day


def first_stamp_of(counts: dict[str, Counts]) -> int:
    """Return the time of the first inertial sample (ns), or of another stream's."""
    first = next(counts[name] for name in ("imu", *FIELD_STREAMS, *HALVES) if name in counts)
    return first.first - first.before_ns


def import_figures(
    result: GatheredStreams,
    counts: dict[str, Counts],
    epoch_ns: int,
    is_first: bool,
    remarks: tuple[str, ...],
) -> Figures:
    """Return the numbers of read and omitted rows, and the interpreted columns."""
    figures = Figures(
        Figure("epoch_ns", epoch_ns, "ns", label="epoch" + (", first sample" * is_first))
    )
    for stream, one in counts.items():
        figures |= Figures(
            Figure(f"{stream}_rows_read", one.read, label=f"{stream}, rows read"),
            Figure(f"{stream}_rows_written", one.written, section=Section.REPORT),
            *_where_some(stream, "missing", one.missing, "missing samples, kept as NaN"),
            *_where_some(stream, "unsorted", one.unsorted, "put in order of time"),
            *(
                Figure(
                    f"{stream}_dropped_{reason.replace(' ', '_')}",
                    count,
                    label=f"{stream}, rows omitted {reason}",
                )
                for reason, count in one.left_out.items()
            ),
        )
    forms = {plan.source.place: plan.source.form for plan in result.every if plan.source.form}
    lines = [line for plan in result.every for line in plan.options()]
    shown = [f"{place}: {form}" for place, form in forms.items()]
    shown += ["interpreted as:", *(f"  --map {shlex.quote(line)}" for line in lines)]
    figures |= Figures(
        Figure("map", lines, section=Section.REPORT),
        Figure("understood", shown, section=Section.REMARKS),
    )
    notes = [*result.findings.notes, *(f"Skipped: {reason}" for reason in result.passed_over)]
    notes += filter(None, remarks)
    notes += [f"{stream}: {one.batches}" for stream, one in counts.items() if one.batches]
    notes += [
        f"{stream}: its times wrap as a counter of 16 or 32 bits does; they go on by"
        f" {one.wrapped * NANOSECOND:.6g} s."
        for stream, one in counts.items()
        if one.wrapped
    ]
    notes += [
        scaled_text(stream, one.scaled)
        for stream, one in counts.items()
        if one.scaled > QUATERNION_TOLERANCE
    ]
    begin = (first_stamp_of(counts) - epoch_ns) * NANOSECOND
    if not is_first and abs(begin) > LATE:
        notes.append(
            f"The log begins {begin:.9g} s after its epoch, to which the drive phases refer; if"
            " they refer to its first sample, import it with --epoch first."
        )
    return figures | Figures(*[Figure("notes", notes, section=Section.NOTES)] * bool(notes))


def _where_some(stream: str, key: str, count: int, words: str) -> list[Figure]:
    section = Section.SUMMARY if count else Section.REPORT
    return [Figure(f"{stream}_{key}", count, section=section, label=f"{stream}, {words}")]
