"""From files to the plans of a log's streams, with all problems reported together."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.bag_reader import is_ros1
from magfusion.files.bag_topics import is_bag, refuse_bag_folders
from magfusion.files.foreign.arrays import ARRAYS, array_source
from magfusion.files.foreign.bag_table import plan_bag
from magfusion.files.foreign.columns import FIELDS, STREAMS, Undecided, place_of, terms_by_place
from magfusion.files.foreign.euroc import euroc_tables, euroc_terms, is_euroc
from magfusion.files.foreign.flight import FLIGHTS, plan_flight
from magfusion.files.foreign.guess import streams_of
from magfusion.files.foreign.halves import HALVES
from magfusion.files.foreign.map_file import ImportRequest
from magfusion.files.foreign.phasors import PhasorPlan, plan_phasors
from magfusion.files.foreign.plan import Findings, ImportPlan, first_values, plan_stream
from magfusion.files.foreign.rows import rows_where
from magfusion.files.foreign.source import Source
from magfusion.files.foreign.text import text_source
from magfusion.files.foreign.units import stamp_numbers
from magfusion.files.log_header import has_header
from magfusion.files.tum import tum_time_unit
from magfusion.model.site import Site

TEXTS = (".csv", ".tsv", ".txt", ".tum", ".dat", ".asc")
_TUM = ("time", "position_x", "position_y", "position_z", "qx", "qy", "qz", "qw")
INERTIAL = {"imu", *HALVES}


@dataclass(eq=False)
class GatheredStreams:
    """Streams of one recording."""

    findings: Findings
    plans: dict[str, ImportPlan] = field(default_factory=dict)
    bags: list[Sequence[Path]] = field(default_factory=list)  # of each recording
    # whether the formats have their own convention of an epoch: the first inertial sample
    stamped: bool = False
    opened: dict[Path, Source] = field(default_factory=dict)
    # files in the folder that are no tables, and why
    passed_over: list[str] = field(default_factory=list)
    phasors: PhasorPlan | None = None

    @property
    def every(self) -> tuple[ImportPlan | PhasorPlan, ...]:
        """Plans of all tables."""
        return (*self.plans.values(), *([] if self.phasors is None else [self.phasors]))

    def add(self, plan: ImportPlan | None) -> None:
        """Add a stream, of which there may be one."""
        if plan is not None and plan.stream in self.plans:
            places = f"{self.plans[plan.stream].source.place} and {plan.source.place}"
            self.findings.problems.append(
                f"{places} both hold the {plan.stream}; name one by --{plan.stream} FILE."
            )
        elif plan is not None:
            self.plans[plan.stream] = plan


def gather(
    paths: Sequence[Path], wanted: ImportRequest, declared: Findings, site: Site | None = None
) -> GatheredStreams:
    """Return how files become the streams of a log; ``declared`` has the problems."""
    result = GatheredStreams(declared)
    attempted = set(wanted.files) | ({"magnetometer"} if wanted.recorded else set())
    for stream, path in wanted.files.items():
        source = _opened(path, wanted, result)
        if source is not None and stream == FIELDS:
            result.phasors = _phasors(source, wanted, site, declared)
        elif source is not None:
            result.add(_table(stream, path, source, wanted, declared))
    for recording in _recordings(paths):
        try:
            attempted |= _add(recording, wanted, result)
        except InputError as error:
            declared.problems.append(str(error))
            attempted |= set(STREAMS)
    attempted |= _halves(result, attempted, set(wanted.files))
    _report_absent(result, attempted)
    _refuse_unused(result, wanted)
    declared.problems += (
        result.passed_over if declared.problems else []
    )  # what is lacking may be there
    for stream, plan in result.plans.items():
        result.plans[stream] = replace(plan, shift_ns=wanted.shifts_ns.get(stream, 0))
    for stream in wanted.entries:
        if stream not in attempted:
            declared.problems.append(
                f"--map '{wanted.entries[stream][0]}': no file is given for {stream}; give"
                f" --{stream} FILE."
            )
    return result


def _report_absent(result: GatheredStreams, attempted: set[str]) -> None:
    """Note which sensors no table is given of."""
    if not {"magnetometer", FIELDS} & attempted:
        if not result.plans.keys() - {"truth"} and not result.findings.problems:
            result.findings.problems.append("No table of a sensor is given; give one.")
        result.passed_over.append(
            "the magnetometer, of which no table is given (--magnetometer FILE): only allan takes a"
            " log without it"
        )
    elif "magnetometer" in result.plans and not INERTIAL & (
        set(result.plans) | (attempted if result.findings.problems else set())
    ):
        result.passed_over.append(
            "the imu, of which no table is given (--imu FILE): the log has no inertial samples"
        )


def _phasors(
    source: Source, wanted: ImportRequest, site: Site | None, declared: Findings
) -> PhasorPlan | None:
    entries, rate = wanted.entries.get(FIELDS, ()), wanted.rates.get(FIELDS)
    plan = plan_phasors(source, entries, rate, wanted.sigma, site, declared)
    return plan and replace(plan, shift_ns=wanted.shifts_ns.get(FIELDS, 0))


def _refuse_unused(result: GatheredStreams, wanted: ImportRequest) -> None:
    """Refuse options of tables that are not read: a clock that is not moved would pass silently."""
    if result.findings.problems:
        return
    known = {*result.plans, *([] if result.phasors is None else [FIELDS])}
    for option, streams in (("offset", wanted.shifts_ns), ("rows", wanted.rows)):
        for stream in streams:
            of_format = option == "rows" and result.stamped and stream not in wanted.files
            if stream in known and not of_format:
                continue
            read = ", ".join(result.plans)
            result.findings.problems.append(
                f"--{option} {stream}: no table of {stream} is read (there are {read}); name one"
                f" of these, or give --{stream} FILE."
            )


def _halves(result: GatheredStreams, attempted: set[str], named: set[str]) -> set[str]:
    """Return whether gyro and accelerometer of two tables make the inertial stream."""
    halves = {"gyro", "accel"}
    if "imu" in attempted:
        for stream in halves & set(result.plans):
            if stream in named and "imu" in named:
                result.findings.problems.append(
                    f"--imu and --{stream} are given; leave out one of them."
                )
            elif stream in named:
                place = (
                    result.plans["imu"].source.place if "imu" in result.plans else "another table"
                )
                result.findings.problems.append(
                    f"--{stream} is given, and {place} holds a whole imu; leave out one of them."
                )
            del result.plans[stream]
        return set()
    for stream in halves - attempted if halves & attempted else ():
        result.passed_over.append(
            f"the {stream}, of which no table is given (--{stream} FILE): of the other half alone"
            " allan measures the noise"
        )
    return {"imu"} if halves & attempted else set()


def _recordings(paths: Sequence[Path]) -> list[list[Path]]:
    """Return positional sources, the bags of ROS 1 and those of ROS 2 each as one recording."""
    result = [[path] for path in paths if not _is_bag(path)]
    for ros1 in (True, False):
        bags = [path for path in paths if _is_bag(path) and is_ros1(path) is ros1]
        result += [bags] if bags else []
    return result


def _is_bag(path: Path) -> bool:
    return path.exists() and not is_euroc(path) and is_bag(path)


def _add(recording: Sequence[Path], wanted: ImportRequest, result: GatheredStreams) -> set[str]:
    """Add a positional source; return the streams that were looked for in it."""
    path = recording[0]
    if not path.exists():
        raise InputError(f"{path}: there is no such file or directory; give the path of a source.")
    if path.is_dir() and has_header(path):
        raise InputError(f"{path}: is a log of magfusion already; nothing is to import.")
    if _is_bag(path):
        return _add_bag(recording, wanted, result)
    if path.is_dir() and is_euroc(path):
        return _add_euroc(path, wanted, result)
    if path.suffix.lower() in FLIGHTS and path.is_file():
        return _add_flight(path, wanted, result)
    files = _tables_in(path) if path.is_dir() else [path]
    if not files:
        refuse_bag_folders(path)
        raise InputError(
            f"{path}: holds no table ({', '.join((*TEXTS, *ARRAYS))}), no bag and no folder mav0;"
            " give the path of a source."
        )
    return {stream for file in files for stream in _add_table(file, wanted, result, path.is_dir())}


def _add_bag(bags: Sequence[Path], wanted: ImportRequest, result: GatheredStreams) -> set[str]:
    result.bags.append(bags)
    result.passed_over += [
        f"{table}: is a table in the folder of a bag; name its stream, as by --truth FILE."
        for bag in bags
        if bag.is_dir()
        for table in _tables_in(bag)
        if table not in wanted.files.values()
    ]
    result.stamped = True
    entries = {s: e for s, e in wanted.entries.items() if s not in wanted.files}
    plans = plan_bag(bags, entries, wanted.rates, tuple(wanted.files), result.findings)
    for plan in plans:
        result.add(plan)
    none = {"magnetometer"} if plans and not result.findings.problems else set()
    return set(STREAMS) - none | {plan.stream for plan in plans}


def _add_flight(path: Path, wanted: ImportRequest, result: GatheredStreams) -> set[str]:
    result.stamped = True
    entries = {s: e for s, e in wanted.entries.items() if s not in wanted.files}
    for plan in plan_flight(path, entries, wanted.rates, tuple(wanted.files), result.findings):
        result.add(plan)
    return set(STREAMS)


def _add_table(
    file: Path, wanted: ImportRequest, result: GatheredStreams, among_others: bool
) -> set[str]:
    before = len(result.findings.problems)
    source = _opened(file, wanted, result)
    if source is None and among_others:
        result.passed_over += result.findings.problems[before:]
        del result.findings.problems[before:]
        return set()
    if source is None:
        return set(STREAMS)
    streams = {"truth"} if file.suffix.lower() == ".tum" else streams_of(source.columns, file.stem)
    for stream in sorted(streams - set(wanted.files)):
        result.add(_table(stream, file, source, wanted, result.findings))
    if streams or among_others:
        return streams
    names = ", ".join(column.name for column in source.columns[:30])
    result.findings.problems.append(
        f"{file}: its columns are not recognised (found {names}); select the stream of the table by"
        " --imu, --magnetometer or --truth."
    )
    return set(STREAMS)


def _tables_in(directory: Path) -> list[Path]:
    return sorted(
        path
        for path in directory.iterdir()
        if path.is_file() and path.suffix.lower() in (*TEXTS, *ARRAYS)
    )


def _opened(path: Path, wanted: ImportRequest, result: GatheredStreams) -> Source | None:
    if path in result.opened:
        return result.opened[path]
    try:
        if not path.is_file():
            what = "is a directory" if path.is_dir() else "there is no such file"
            raise InputError(f"{path}: {what}; give the path of a table.")
        if path.suffix.lower() in ARRAYS:
            source = array_source(path)
        else:
            source = text_source(path, wanted.delimiter, wanted.missing)
    except InputError as error:
        result.findings.problems.append(str(error))
        return None
    result.opened[path] = source
    return source


def _table(
    stream: str, path: Path, source: Source, wanted: ImportRequest, declared: Findings
) -> ImportPlan | None:
    if stream in wanted.rows:
        column, value = wanted.rows[stream]
        try:
            place = place_of(column, source.columns)
        except Undecided as reason:
            declared.problems.append(f"{source.place}: --rows {stream}={column}:{value}: {reason}.")
            return None
        if place is None:
            names = ", ".join(one.name for one in source.columns[:30])
            declared.problems.append(
                f"{source.place}: --rows {stream}={column}:{value}: there is no column {column}"
                f" (found {names})."
            )
            return None
        source = rows_where(source, place, value)
    usual = None
    if path.suffix.lower() == ".tum" and stream == "truth":
        columns = {name: STREAMS[stream][name] for name in _TUM}
        largest = np.max(np.abs(stamp_numbers(first_values(source, 0, True))), initial=0.0)
        usual = terms_by_place(columns, source.columns, tum_time_unit(float(largest)))
    entries, rate = wanted.entries.get(stream, ()), wanted.rates.get(stream)
    return plan_stream(stream, source, entries, rate, declared, usual)


def _add_euroc(path: Path, wanted: ImportRequest, result: GatheredStreams) -> set[str]:
    streams: set[str] = set()
    result.stamped = True
    for stream, table in euroc_tables(path).items():
        streams.add(stream)
        if stream in wanted.files or (source := _opened(table, wanted, result)) is None:
            continue
        usual = euroc_terms(stream, source)
        entries, rate = wanted.entries.get(stream, ()), wanted.rates.get(stream)
        result.add(plan_stream(stream, source, entries, rate, result.findings, usual))
    if "magnetometer" not in streams | set(wanted.files):
        folders = ", ".join(sorted(entry.name for entry in (path / "mav0").iterdir()))
        result.passed_over.append(
            f"{path}: mav0 holds no folder of a magnetometer (found {folders}); call it mag0, or"
            " give --magnetometer FILE."
        )
    return streams | {"imu"}
