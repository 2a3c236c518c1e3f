"""Which columns of a table make a stream: as mapped by the user, or unambiguous by their names."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from magfusion.errors import InputError
from magfusion.files.foreign.columns import (
    EULER,
    GROUPS,
    OPTIONAL,
    OPTIONAL_COLUMNS,
    QUATERNION,
    STREAMS,
    TIME,
    ColumnMapping,
    Term,
    Undecided,
    dimension_of,
    resolve,
)
from magfusion.files.foreign.guess import (
    Named,
    named_columns,
    numbered_quaternion,
    two_column_stamp,
)
from magfusion.files.foreign.guess_by_values import by_place, likely_time_unit, likely_unit
from magfusion.files.foreign.source import Source
from magfusion.files.foreign.units import ISO, Dimension, Raw, SourceUnit, is_date
from magfusion.units import Array

Terms = dict[str, tuple[Term, ...]]


@dataclass(frozen=True)
class Rate:
    """Stamps of a table that has none."""

    hz: Fraction
    # of the first row; by default 0, and of a bag the stamp of the first message
    start_s: Fraction | None = None


@dataclass(frozen=True, eq=False)
class ImportPlan:
    """How a table becomes a stream.

    `shift_ns`: added to its times.
    """

    stream: str
    source: Source
    terms: Terms
    rate: Rate | None = None
    shift_ns: int = 0

    def options(self) -> list[str]:
        """Return the map as options, in the order of the stream's columns."""
        return as_options(self.stream, self.source, self.terms)


@dataclass(eq=False)
class Findings:
    """Problems of an import: sentences, and options that would resolve them; and notes on it."""

    problems: list[str] = field(default_factory=list)
    proposals: list[str] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def shown(source: Source, terms: Sequence[Term]) -> str:
    """Return terms as they are written in a map."""
    parts = []
    for term in terms:
        name = source.columns[term.place].name
        known = term.unit.dimension is Dimension.NUMBER or _is_unit_declared(name, str(term.unit))
        unit = "" if known else f"[{term.unit}]"
        parts.append(f"{'-' if term.sign < 0.0 else ''}{name}{unit}")
    return "+".join(parts)


def _is_unit_declared(name: str, unit: str) -> bool:
    return name.endswith((f"[{unit}]", f"({unit})"))


def as_options(stream: str, source: Source, terms: Terms) -> list[str]:
    """Return terms as options, the components of a vector in one where that is equivalent."""
    options, done = [], set[str]()
    for target, own in terms.items():
        if target in done:
            continue
        group = next((g for g, names in GROUPS.items() if target == names[0]), "")
        together = _as_vector(group, source, terms) if group else None
        if together is None:
            options.append(f"{stream}.{target}={shown(source, own)}")
        else:
            done |= set(GROUPS[group])
            options.append(f"{stream}.{group}={together}")
    return options


def _as_vector(group: str, source: Source, terms: Terms) -> str | None:
    """Return the components of a vector in one option's value, where that is equivalent."""
    every = [terms[name][0] for name in GROUPS[group] if name in terms]
    names = [source.columns[term.place].name for term in every]
    shared = len({term.unit for term in every}) == 1 and "," not in "".join(names)
    if len(every) < len(GROUPS[group]) or not shared:
        return None
    tag = "wxyz" if group == "quaternion" else str(every[0].unit)
    signed = [("-" if t.sign < 0.0 else "") + n for t, n in zip(every, names, strict=True)]
    return ",".join(signed) + (
        "" if all(_is_unit_declared(name, tag) for name in names) else f"[{tag}]"
    )


def plan_stream(
    stream: str,
    source: Source,
    entries: Sequence[ColumnMapping],
    rate: Rate | None,
    declared: Findings,
    usual: Mapping[str, tuple[Term, ...]] | None = None,
) -> ImportPlan | None:
    """Return how a table becomes a stream, or None with the reasons in ``declared``.

    `entries`: the user's mapping of this stream. `usual`: columns that the format itself defines.
    """
    own = _Planning(stream, source, declared, rate)
    given = {entry.column: entry for entry in entries}
    named = named_columns(source.columns, stream)
    velocity = any(name in given for name in OPTIONAL)
    known = {*given, *(usual or {}), *(name for name, own in named.items() if own)}
    absent = _absent_axes(stream, source, known, declared)
    without = (*_other_rotation(given, named), *absent)
    for target in STREAMS[stream]:
        if target in without:
            continue
        if target in given:
            own.declare(given[target])
        elif usual is not None:
            own.terms |= {target: usual[target]} if target in usual else {}
        elif target != TIME or rate is None:
            own.guess(target, named[target], target in OPTIONAL and not velocity)
    for target in OPTIONAL_COLUMNS.get(stream, {}):
        if target in given:
            own.declare(given[target])
    return own.plan(velocity)


def _other_rotation(
    given: Mapping[str, ColumnMapping], named: Mapping[str, Sequence[Named]]
) -> tuple[str, ...]:
    """Return the columns of the form of an attitude, quaternion or angles, that is not used."""
    declared = {name for names in (given, named) for name in names if name in given or named[name]}
    if any(name in given for name in EULER):
        return QUATERNION
    angles = declared.issuperset(EULER) and declared.isdisjoint(QUATERNION)
    return QUATERNION if angles else EULER


def _absent_axes(
    stream: str, source: Source, known: set[str], declared: Findings
) -> tuple[str, ...]:
    """Return the columns that a truth of one part, or a magnetometer of fewer axes, lacks."""
    if stream == "magnetometer" and not known.isdisjoint(GROUPS["field"]):
        return tuple(name for name in GROUPS["field"] if name not in known)
    if stream != "truth":
        return ()
    known = known | (set(QUATERNION) if numbered_quaternion(source.columns) else set())
    alone, absent = _absent_part(known)
    if absent:
        declared.notes.append(f"{source.place}: the truth has {alone} alone.")
    return absent


def _absent_part(known: set[str]) -> tuple[str, tuple[str, ...]]:
    """Return which part a truth has alone, and the columns of the other."""
    attitude, position = (*QUATERNION, *EULER), GROUPS["position"]
    if known.isdisjoint(attitude) and not known.isdisjoint(position):
        return "positions", attitude
    if known.isdisjoint(position) and not known.isdisjoint(attitude):
        return "attitudes", position
    return "", ()


class _Planning:
    """One stream while its columns are looked for."""

    def __init__(self, stream: str, source: Source, declared: Findings, rate: Rate | None) -> None:
        self.stream, self.source, self.declared, self.rate = stream, source, declared, rate
        self.terms: Terms = {}
        self.open: dict[str, tuple[int, float, str]] = {}
        self.several: dict[str, Named] = {}
        self.absent: list[str] = []
        self.guessed: list[str] = []
        self.failed = False

    def problem(self, text: str) -> None:
        self.failed = True
        self.declared.problems.append(f"{self.source.place}: {text}.")

    def declare(self, entry: ColumnMapping) -> None:
        if entry.column == TIME and self.rate is not None:
            self.problem(f"{self.stream}.time and --rate-hz {self.stream} are given; keep one")
            return
        try:
            self.terms[entry.column] = resolve(entry, self.source.columns)
        except Undecided as reason:
            if reason.place is None or "is no unit" in str(reason):
                self.problem(f"--map '{entry}': {reason}")
            if reason.place is not None:
                declared = "" if "is no unit" in str(reason) else "is not given"
                self.open[entry.column] = (reason.place, reason.sign, declared)

    def guess(self, target: str, named: Sequence[Named], optional: bool) -> None:
        if target == TIME and (separated := two_column_stamp(self.source.columns)):
            self.terms[target] = separated
            self.guessed.append(target)
            return
        if not named:
            if target == TIME and self.source.rate_hz is not None:
                self.rate = Rate(Fraction(self.source.rate_hz))
            elif not optional:
                self.absent.append(target)
            return
        if len(named) > 1:
            if not optional:
                self._report_several(target, named)
            return
        (one,) = named
        unit = one.unit
        if unit is None and target == TIME and is_date(first_values(self.source, one.place, True)):
            unit = SourceUnit(ISO, Dimension.TIME)
        if unit is not None:
            self.terms[target] = (Term(one.place, unit),)
            self.guessed.append(target)
        elif not optional:
            self.open[target] = (one.place, 1.0, "is not given")

    def plan(self, velocity: bool) -> ImportPlan | None:
        self._report_absent()
        self._report_open()
        self._propose_first()
        parts = [name for name in OPTIONAL if name in self.terms]
        if len(parts) not in (0, len(OPTIONAL)):
            if velocity:
                self.problem("a velocity takes velocity_x, velocity_y and velocity_z; map all")
            for name in parts:
                del self.terms[name]
        self._check_lengths()
        known = (*STREAMS[self.stream], *OPTIONAL_COLUMNS.get(self.stream, {}))
        ordered = {t: self.terms[t] for t in known if t in self.terms}
        plan = ImportPlan(self.stream, self.source, ordered, self.rate)
        certain = {target: self.terms[target] for target in self.guessed if target in self.terms}
        self.declared.guessed += as_options(self.stream, self.source, certain)
        return None if self.failed else plan

    def _report_absent(self) -> None:
        if not self.absent:
            return
        names = ", ".join(column.name for column in self.source.columns[:30])
        what = f"no column is found for {', '.join(f'{self.stream}.{t}' for t in self.absent)}"
        remedy = f"name it by --map '{self.stream}.{self.absent[0]}=NAME[unit]'"
        self._propose_by_place()
        numbered = numbered_quaternion(self.source.columns)
        if numbered and set(self.absent) & set(QUATERNION):
            four = ",".join(numbered)
            remedy = (
                f"give the order of the quaternion by --map '{self.stream}.quaternion={four}[wxyz]'"
                " or [xyzw]"
            )
            self.declared.proposals.append(f"{self.stream}.quaternion={four}[wxyz]")
        if TIME in self.absent:
            remedy += f", or give --rate-hz {self.stream}=HZ"
        self.problem(f"{what} (found {names}); {remedy}")

    def _report_several(self, target: str, named: Sequence[Named]) -> None:
        """Report that several columns match one."""
        names = " and ".join(self.source.columns[n.place].name for n in named)
        self.problem(f"columns {names} may both be {self.stream}.{target}; name one")
        self.several[target] = named[0]

    def _propose_first(self) -> None:
        """Propose the first of several columns, with one unit for the axes of a sensor."""
        terms: Terms = {}
        for target, first in self.several.items():
            known = None if first.unit is None else Term(first.place, first.unit)
            terms[target] = (known or self._likely(target, first.place, 1.0),)
        self.declared.proposals += as_options(self.stream, self.source, terms)

    def _propose_by_place(self) -> None:
        """Propose what columns that nothing is known of may be, by their sizes."""
        used = {term.place for terms in self.terms.values() for term in terms}
        used |= {place for place, _, _ in self.open.values()}
        open_terms = [k for k in range(len(self.source.columns)) if k not in used]
        columns = [self.source.columns[k] for k in open_terms]
        samples = [_numbers(self.source, k) for k in open_terms]
        dates = [is_date(first_values(self.source, k, True)) for k in open_terms]
        terms: Terms = {
            target: (Term(open_terms[place], unit),)
            for target, (place, unit) in by_place(self.stream, columns, samples, dates).items()
            if target in self.absent
        }
        self.declared.proposals += as_options(self.stream, self.source, terms)

    def _report_open(self) -> None:
        groups: dict[str, list[str]] = defaultdict(list)
        for target, (_, _, declared) in self.open.items():
            if declared:
                groups[target.rpartition("_")[0] or target].append(target)
        for stem, targets in groups.items():
            names = [self.source.columns[self.open[t][0]].name for t in targets]
            lead = "columns" if len(names) > 1 else "column"
            size = _size(self.source, [self.open[t][0] for t in targets])
            size = size[np.isfinite(size)]
            sized = f" (median size {np.median(size):.4g})" if len(size) and stem != TIME else ""
            named = f"the unit of {lead} {', '.join(names)}"
            self.problem(f"{named} is not given, for {self.stream}.{stem}{sized}")
        terms: Terms = {t: (self._likely(t, p, sign),) for t, (p, sign, _) in self.open.items()}
        self.declared.proposals += as_options(self.stream, self.source, terms)

    def _likely(self, target: str, place: int, sign: float) -> Term:
        dimension = dimension_of(self.stream, target)
        stem = target.rpartition("_")[0]
        targets = [t for t in STREAMS[self.stream] if t.rpartition("_")[0] == stem]
        places = [self.open[t][0] for t in targets if t in self.open]
        places += [self.several[t].place for t in targets if t in self.several]
        declared = [term.unit for t in targets for term in self.terms.get(t, ())]
        declared += [n.unit for t, n in self.several.items() if t in targets and n.unit]
        if stem and declared:
            unit = declared[0]
        elif dimension is Dimension.TIME:
            unit = likely_time_unit(first_values(self.source, place, True))
        else:
            unit = likely_unit(dimension, _size(self.source, places or [place]))
        return Term(place, unit, sign)

    def _check_lengths(self) -> None:
        lengths = self.source.lengths
        result = {
            lengths[term.place]: self.source.columns[term.place].name
            for terms in self.terms.values()
            for term in terms
            if lengths
        }
        if len(result) > 1:
            rows = ", ".join(f"{name} has {count} rows" for count, name in result.items())
            self.problem(f"columns of {self.stream} are not of one length: {rows}; map others")


def first_values(source: Source, place: int, as_written: bool) -> Raw:
    """Return the first values of a column; none where they cannot be read."""
    try:
        part = next(source.read([place], {place} if as_written else ()), None)
    except InputError:
        part = None
    return np.zeros(0) if part is None else part.columns[0]


def _numbers(source: Source, place: int) -> Array:
    """Return the first values of a column, none where they are no numbers."""
    try:
        return np.asarray(first_values(source, place, False), dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)


def _size(source: Source, places: Sequence[int]) -> Array:
    """Return lengths of the vectors that columns make."""
    samples = [_numbers(source, place) for place in places]
    if len({len(sample) for sample in samples}) != 1:
        return np.zeros(0)
    return np.asarray(np.sqrt(np.sum(np.square(samples), axis=0)))
