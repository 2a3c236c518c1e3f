"""Tables of phasors, amplitudes or levels of coils: which columns they are, in rows or by coil."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from magfusion.files.foreign.columns import (
    FIELDS,
    TIME,
    ColumnMapping,
    Term,
    Undecided,
    place_of,
    term_of,
)
from magfusion.files.foreign.guess import named_columns, readings
from magfusion.files.foreign.guess_by_values import likely_time_unit
from magfusion.files.foreign.plan import Findings, Rate, first_values, shown
from magfusion.files.foreign.source import Source, SourceColumn
from magfusion.files.foreign.units import UNITS, Dimension, SourceUnit, parse_unit
from magfusion.model.site import Site
from magfusion.model.time_division import Slots

AMBIENT = "ambient"  # levels without a drive, which are subtracted
AXES = "xyz"
VALUES = (*(f"re_{axis}" for axis in AXES), *(f"im_{axis}" for axis in AXES))
# Columns of a table with a row for each coil, or for each of its axes, and other names of them.
_NAMES: dict[str, tuple[str, ...]] = {
    "beacon": ("beacon", "anchor", "transmitter", "source"),
    "slot": ("slot", "coil", "mux"),
    "tone": ("tone",),
    "axis": ("axis", "component"),
    "re": ("re", "real", "inphase"),
    "im": ("im", "imag", "imaginary", "quadrature"),
    "value": ("value", "amplitude", "amp", "level", "magnitude"),
    "sigma": ("sigma", "std", "stddev"),
    "window": ("window",),
    **{name: (name.replace("_", ""),) for name in VALUES},
}
LABELS = ("beacon", "slot", "tone", "axis")
_NUMBERS = (1, 2, 3, 6)  # of columns of a coil: amplitude; re, im; three levels; re, then im
_COMPONENT = re.compile(r"(:[0-2])?(\.re|\.im)?$|[_ ]?[xyz]$", re.I)
LIKELY_FIELD = 3e-8  # T; of a coil, to which the proposed unit is the nearest
AMBIENT_FIELD = 5e-5  # T; of levels that contain the Earth's
LIKELY_UNITS = ("T", "uT", "nT", "pT")


@dataclass(frozen=True, eq=False)
class PhasorPlan:
    """How a table becomes the fields of a log."""

    source: Source
    # columns of rows, as in `_NAMES`; of a table by coil the time alone
    terms: dict[str, tuple[Term, ...]]
    # columns of each (beacon, tone), or of `AMBIENT`; empty where each row is of one coil
    coils: dict[tuple[str, int] | str, tuple[Term, ...]]
    rate: Rate | None = None
    shift_ns: int = 0
    frame: int = 0  # rows of one cycle of slots, where the table has one column; otherwise 0
    sigma: float | None = None  # where the table has none (T)
    site: Site | None = None
    stream: str = FIELDS

    def options(self) -> list[str]:
        """Return the map as options."""
        rows = [f"{FIELDS}.{name}={shown(self.source, own)}" for name, own in self.terms.items()]
        return rows + [_coil_option(self.source, coil, own) for coil, own in self.coils.items()]


@dataclass(frozen=True, eq=False)
class _Request:
    """What is known of a table of phasors besides its columns."""

    entries: Sequence[ColumnMapping]
    rate: Rate | None
    sigma: float | None
    site: Site | None
    problems: list[str] = field(default_factory=list)


def plan_phasors(
    source: Source,
    entries: Sequence[ColumnMapping],
    rate: Rate | None,
    sigma: float | None,
    site: Site | None,
    declared: Findings,
) -> PhasorPlan | None:
    """Return how a table becomes fields, or None with the reasons in ``declared``."""
    request = _Request(entries, rate, sigma, site)
    rows = [entry for entry in entries if entry.column in {TIME, *_NAMES}]
    terms = _row_terms(source, rows, request, declared)
    coils: dict[tuple[str, int] | str, tuple[Term, ...]] = {}
    for entry in entries:
        if entry not in rows:
            coil = _coil(entry.column)
            coils |= {coil: _resolved(source, entry, request, declared)}
    labelled = {"beacon", "slot"} & set(terms)
    frame = 0
    if not labelled and not coils and not request.problems:
        frame = _coils_by_site(source, terms, request, declared)
    if labelled and not {"re", "re_x", "re_y", "re_z", "value"} & set(terms):
        request.problems.append(
            "no column of values is found; name it by --map 'fields.re=NAME[T]'"
        )
    if TIME not in terms and rate is None:
        request.problems.append("no time is found; map fields.time, or give --rate-hz fields=HZ")
    if "sigma" not in terms and sigma is None:
        request.problems.append("no column of sigma is found; map it, or give --sigma as 0.5*nT")
    if "slot" in terms and site is None:
        request.problems.append("slots are those of a site; give --site")
    declared.problems += [f"{source.place}: {one}." for one in request.problems]
    if request.problems:
        return None
    return PhasorPlan(source, terms, coils, rate, 0, frame, sigma, site)


def _coil(name: str) -> tuple[str, int] | str:
    beacon, _, tone = name.rpartition(".")
    if beacon and tone.isdigit():
        return beacon, int(tone)
    return name if name == AMBIENT else (name, 0)


def _coil_option(source: Source, coil: tuple[str, int] | str, terms: Sequence[Term]) -> str:
    name = coil if isinstance(coil, str) else f"{coil[0]}.{coil[1]}"
    names = ",".join(source.columns[term.place].name for term in terms)
    return f"{FIELDS}.{name}={names}[{terms[0].unit}]"


def _row_terms(
    source: Source, entries: Sequence[ColumnMapping], request: _Request, declared: Findings
) -> dict[str, tuple[Term, ...]]:
    """Return the columns that are mapped or named as those of a table by rows."""
    given = {entry.column: entry for entry in entries}
    terms: dict[str, tuple[Term, ...]] = {}
    for target, names in {TIME: (), **_NAMES}.items():
        if target in given:
            terms[target] = _resolved(source, given[target], request, declared)
            continue
        if target == TIME:
            known = named_columns(source.columns, "magnetometer")[TIME]
            matching = [] if request.rate is not None else [one.place for one in known]
        else:
            matching = [k for k, c in enumerate(source.columns) if _is_named(c, names)]
        if len(matching) == 1:
            unit = "" if target in LABELS else _unit_in_name(source.columns[matching[0]], target)
            entry = ColumnMapping(FIELDS, target, f"{source.columns[matching[0]].name}{unit}")
            terms[target] = _resolved(source, entry, request, declared)
    return {target: own for target, own in terms.items() if own}


def _is_named(column: SourceColumn, names: Sequence[str]) -> bool:
    """Return whether a column is called by one of some names, perhaps with its unit."""
    bare = [re.sub(r"[^a-z]", "", name.casefold()) for name, _ in readings(column)]
    return any(name in names for name in bare)


def _unit_in_name(column: SourceColumn, target: str) -> str:
    """Return the unit at the end of a name, in brackets; empty where the name has none."""
    known = [unit for _, unit in readings(column) if parse_unit(unit, _dimension(target))]
    bracketed = column.unit or not known or column.name.endswith(("]", ")"))
    return "" if bracketed else f"[{known[0]}]"


def _dimension(target: str) -> Dimension:
    if target in LABELS:
        return Dimension.NUMBER
    return Dimension.TIME if target in (TIME, "window") else Dimension.FIELD


def _resolved(
    source: Source, entry: ColumnMapping, request: _Request, declared: Findings
) -> tuple[Term, ...]:
    """Return the columns that an entry means; none where it is open, which is reported."""
    dimension = _dimension(entry.column)
    parts = re.fullmatch(r"(?P<names>.*?)\s*(?P<unit>\[[^\[\]]*[^\[\]\d][^\[\]]*\])?", entry.value)
    assert parts is not None
    names = _component_names(parts["names"], source.columns)
    terms, unknown = [], []
    for name in names:
        try:
            text = name + (parts["unit"] or "")
            terms.append(term_of(text, source.columns, dimension, entry))
        except Undecided as reason:
            if reason.place is None or "is no unit" in str(reason):
                request.problems.append(f"--map '{entry}': {reason}")
                return ()
            unknown.append(reason.place)
    if unknown:
        named = ", ".join(source.columns[place].name for place in unknown)
        request.problems.append(f"the unit of {named} is not given, for fields.{entry.column}")
        unit = _likely_unit(source, unknown, dimension)
        declared.proposals.append(f"{FIELDS}.{entry.column}={','.join(names)}[{unit}]")
        return ()
    if entry.column not in {TIME, *_NAMES} and len(terms) not in _NUMBERS:
        request.problems.append(
            f"--map '{entry}': found {len(terms)} columns; name one of an amplitude, two of a"
            " phasor (re, im), three of a level, or six of a phasor (re of x, y, z, then im)"
        )
    return tuple(terms)


def _component_names(text: str, columns: Sequence[SourceColumn]) -> list[str]:
    """Return names as listed, or the components of the array that a name means."""
    names = [name.strip() for name in text.split(",")]
    known = {column.name for column in columns}
    if len(names) > 1 or place_of(names[0], columns) is not None:
        return names
    (name,) = names
    vector = [f"{name}:{k}" for k in range(3)]
    complex_vector = [f"{one}{part}" for part in (".re", ".im") for one in vector]
    for parts in (vector, [f"{name}.re", f"{name}.im"], complex_vector):
        if set(parts) <= known:
            return parts
    return names


def _likely_unit(
    source: Source, columns: Sequence[int], dimension: Dimension, typical: float = LIKELY_FIELD
) -> SourceUnit:
    raw = first_values(source, columns[0], dimension is Dimension.TIME)
    if dimension is Dimension.TIME:
        return likely_time_unit(raw)
    size = float(np.nanmedian(np.abs(np.asarray(raw, dtype=np.float64)))) if len(raw) else 0.0
    units = UNITS[Dimension.FIELD]
    likely = min(
        LIKELY_UNITS, key=lambda name: abs(np.log(max(size, 1e-30) * units[name] / typical))
    )
    return SourceUnit(likely, Dimension.FIELD)


def coils_in_order(site: Site) -> list[tuple[str, int] | None]:
    """Return the channels of a site as they follow each other, None of a silent slot."""
    slots = {
        slot: (beacon.name, tone)
        for beacon in site.beacons
        for tone, (_, slot) in enumerate(beacon.tones)
        if slot is not None
    }
    if not slots:
        return list(site.channels)
    known = next(beacon.slots for beacon in site.beacons if beacon.slots is not None)
    count = known.count if isinstance(known, Slots) else 1 + max(slots)
    return [slots.get(slot) for slot in range(count)]


def _coils_by_site(
    source: Source, terms: dict[str, tuple[Term, ...]], request: _Request, declared: Findings
) -> int:
    """Propose the columns of each coil of the site, or return how many rows are one cycle."""
    own = {term.place for name, those in terms.items() if name != "value" for term in those}
    open_columns = [k for k in range(len(source.columns)) if k not in own]
    if request.site is None or not request.site.beacons:
        names = ", ".join(column.name for column in source.columns[:30])
        request.problems.append(
            f"no column of a beacon or slot is found (found {names}); map it, or the columns of"
            " each coil by --map 'fields.BEACON.TONE=NAME[nT]', or give --site with its beacons"
        )
        return 0
    if len(open_columns) == 1:
        name = source.columns[open_columns[0]].name
        if "value" not in terms:
            request.problems.append(f"the unit of column {name} is not given, for fields.value")
            unit = _likely_unit(source, open_columns, Dimension.FIELD)
            declared.proposals.append(f"{FIELDS}.value={name}[{unit}]")
        return len(coils_in_order(request.site))
    _propose_coils(source, open_columns, request.site, declared)
    request.problems.append("no columns are mapped to the coils of the site")
    return 0


def _propose_coils(source: Source, places: Sequence[int], site: Site, declared: Findings) -> None:
    """Propose columns, or groups of them, one coil after the other; a last one is the ambient."""
    coils: list[tuple[str, int] | str] = [*site.channels, AMBIENT]
    groups: dict[str, list[str]] = {}
    for k in places:
        name = source.columns[k].name
        groups.setdefault(_COMPONENT.sub("", name), []).append(name)
    counts = len(coils) - 1, len(coils)
    if len(groups) not in counts:
        groups = {source.columns[k].name: [source.columns[k].name] for k in places}
    if len(groups) not in counts:
        return
    typical = AMBIENT_FIELD if len(groups) == len(coils) else LIKELY_FIELD
    unit = _likely_unit(source, places, Dimension.FIELD, typical)
    for coil, names in zip(coils, groups.values(), strict=False):
        ordered = sorted(names, key=lambda name: name.endswith(".im"))
        name = coil if isinstance(coil, str) else f"{coil[0]}.{coil[1]}"
        declared.proposals.append(f"{FIELDS}.{name}={','.join(ordered)}[{unit}]")
