"""The job that imports recordings of any names and units: a log, with the verdict of its check."""

import shlex
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet

from magfusion.errors import InputError, InputErrors
from magfusion.files.audio import SUFFIXES, AudioEntry, describe_recording, open_audio
from magfusion.files.foreign.bag_table import first_stamp
from magfusion.files.foreign.columns import FIELDS, TABLES
from magfusion.files.foreign.convert import Counts, write_stream
from magfusion.files.foreign.gather import GatheredStreams, gather
from magfusion.files.foreign.halves import HALVES, join_halves
from magfusion.files.foreign.map_file import read_request
from magfusion.files.foreign.phasor_rows import is_signed, write_phasors
from magfusion.files.foreign.plan import Findings, ImportPlan
from magfusion.files.log_header import HEADER
from magfusion.files.site import load_site
from magfusion.files.table import TIME, write_table
from magfusion.files.yaml_files import write_yaml
from magfusion.jobs.check import CheckSettings, run_check
from magfusion.jobs.import_figures import FIELD_STREAMS, first_stamp_of, import_figures
from magfusion.jobs.settings import Command, Settings, option
from magfusion.model.progress import Report, quiet
from magfusion.results.figures import Figures, Section, heading
from magfusion.units import NANOSECOND, IntArray

FIRST = "first"


@dataclass(frozen=True, kw_only=True)
class ImportSettings(Settings):
    """Files of a recording and the streams of a log."""

    sources: tuple[str, ...] = option(
        (), "Bag, EuRoC folder, flight log, tables, or a directory of tables", positional=True
    )
    imu: Path | None = option(
        None,
        "Table of the inertial sensor",
        note="csv, tsv, txt, parquet, npy, npz, wav, mat, h5; one table may be given several times",
        metavar="FILE",
    )
    gyro: Path | None = option(
        None, "Table of the gyro, if separate from the accelerometer", metavar="FILE"
    )
    accel: Path | None = option(
        None, "Table of the accelerometer, if separate from the gyro", metavar="FILE"
    )
    magnetometer: Path | None = option(None, "Table of the magnetometer", metavar="FILE")
    truth: Path | None = option(None, "Table of true poses, or a TUM file", metavar="FILE")
    fields: Path | None = option(
        None, "Table of phasors, amplitudes or levels of coils", metavar="FILE"
    )
    map: tuple[str, ...] = option(
        (),
        "Mapping of a file's column to one of the log, with its unit",
        note="e.g. 'imu.gyro_x=-GyrY[deg/s]', 'truth.quaternion=qx,qy,qz,qw[xyzw]'; columns"
        " without names are counted from 0; of a bag e.g. imu=/imu/data, magnetometer=/mag[uT],"
        " truth=/tf:map->imu_link; of an attitude in"
        " angles truth.euler=roll,pitch,yaw[deg] (rotated by yaw, then pitch, then roll)",
        metavar="TABLE.COLUMN=NAME[UNIT]",
    )
    map_file: Path | None = option(
        None,
        "YAML file with map: {TABLE.COLUMN: NAME[UNIT]}, imu, offset, rows, ...",
        metavar="FILE",
    )
    rate_hz: tuple[str, ...] = option(
        (),
        "Rate of a table without times, from its first row at 0 s or at SECONDS",
        metavar="TABLE=HZ[@SECONDS]",
    )
    offset: tuple[str, ...] = option(
        (), "Offset added to the times of a table from another clock", metavar="TABLE=SECONDS"
    )
    rows: tuple[str, ...] = option(
        (),
        "Rows of one sensor, in a table of several sensors one below the other",
        note="e.g. 'gyro=sensor:gyroscope', the file given by --gyro, --accel, --magnetometer",
        metavar="TABLE=COLUMN:VALUE",
    )
    delimiter: str | None = option(
        None,
        "Delimiter: a character, or comma, semicolon, tab, pipe, space",
        note="default: detected",
    )
    missing: tuple[str, ...] = option(
        (),
        "Marker of missing values, as --missing=-999",
        note="besides nan, NA, null, none, -, -- and empty cells",
        metavar="TEXT",
    )
    sigma: str | None = option(
        None, "Sigma of phasors whose table has none, as 0.5*nT", metavar="NUMBER*UNIT"
    )
    channels: str | None = option(
        None,
        "Channels of a recording that the log refers to: x, y, z, sync, or - for others",
        note="WAV, FLAC; in volts, magfusion[audio]; sync has pulses at whole seconds",
        metavar="NAME,...",
    )
    full_scale: float = option(1.0, "Voltage of a full-scale sample of the recording, V")
    epoch: str | None = option(
        None,
        "Zero of the log clock, to which drive phases refer: a stamp in ns, first (the first"
        " inertial sample), or a bag's topic (its first message)",
        note="default: 0 of the file's own clock, of bags, EuRoC folders and flight logs first",
        metavar="NS|TOPIC|first",
    )
    site: Path | None = option(None, "Site file to check the log against")

    def __post_init__(self) -> None:
        if not 0.0 < self.full_scale <= 1e6:
            raise InputError(f"--full-scale {self.full_scale:g}: give volts, above 0")

    @property
    def recording(self) -> Path | None:
        """The recording that the log refers to."""
        if self.channels is None:
            return None
        given = [Path(s) for s in self.sources if Path(s).suffix.lower() in SUFFIXES]
        if len(given) != 1 or self.magnetometer is not None:
            raise InputError("--channels: give one recording, e.g. walk.flac, as magnetometer")
        return given[0]


def run_import(settings: ImportSettings, output: Path, report: Report = quiet) -> Figures:
    """Import a recording: a log in ``output``, and the findings of its check."""
    from magfusion.jobs.result_directory import claim
    from magfusion.results.report import write_report

    claimed, declared = claim(output, "import"), Findings()
    recording = settings.recording
    if settings.site is not None and not settings.site.is_file():
        declared.problems.append(
            f"{settings.site}: there is no such file; give the path of a site."
        )
    files = {stream: getattr(settings, stream) for stream in TABLES}
    if not settings.sources and not any(files.values()) and settings.map_file is None:
        raise InputError(
            "no recording given; give a bag, a folder or tables, or --imu FILE --magnetometer FILE"
        )
    wanted = read_request(
        files,
        settings.map,
        settings.rate_hz,
        settings.offset,
        settings.rows,
        settings.delimiter,
        settings.missing,
        settings.sigma,
        settings.epoch,
        settings.map_file,
        declared,
    )
    site = None
    if settings.site is not None and settings.site.is_file():
        site = load_site(settings.site, unknown=True, without=True, several=True)
    audio: AudioEntry | None = None
    remarks: tuple[str, ...] = ()
    if recording is not None:
        begin_ns = wanted.shifts_ns.pop("magnetometer", 0)
        audio, remarks = describe_recording(
            recording, settings.channels or "", settings.full_scale, begin_ns, site
        )
        wanted = replace(wanted, recorded=True)
    others = [Path(source) for source in settings.sources if Path(source) != recording]
    result = gather(others, wanted, declared, site)
    epoch = _epoch(wanted.epoch, result)
    _refuse(declared)
    with claimed as directory:
        counts: dict[str, Counts] = {}
        for stream, plan in result.plans.items():
            release_gain = partial(_report_stream, report, stream, plan)
            release_gain(0)
            try:
                shared = sum(p.source is plan.source for p in result.plans.values()) > 1
                path = directory / f"{stream}.parquet"
                counts[stream] = write_stream(plan, path, shared, release_gain)
            except InputError as error:
                declared.problems.append(str(error))
        if result.phasors is not None:
            counts[FIELDS] = write_phasors(result.phasors, directory / f"{FIELDS}.parquet")
        if recording is not None and audio is not None:
            counts["magnetometer"] = _recorded(recording, audio)
        note = "" if declared.problems else _with_imu(directory, counts)
        _refuse_apart(counts, declared)
        _refuse(declared)
        if epoch == FIRST and "imu" in counts:
            _count_burst(directory / "imu.parquet", counts["imu"])
        epoch_ns = first_stamp_of(counts) if epoch == FIRST else int(epoch)
        _write_header(directory, output, result, epoch_ns, audio)
        report("checking", 0, 1)
        figures = _checked(directory, output, result, settings.site)
        figures = heading("import", output.resolve().name) | figures
        figures |= import_figures(result, counts, epoch_ns, epoch == FIRST, (note, *remarks))
        write_report(directory, figures)
    return figures


def _on_even_clock(path: Path) -> bool:
    """Replace stamps of bursts by those of the samples, between which a half is interpolated."""
    table = pyarrow.parquet.read_table(path)
    even = _even_stamps(table[TIME].to_numpy())
    if even is None:
        return False
    write_table({name: table[name] for name in table.column_names} | {TIME: even}, path)
    return True


def _even_stamps(stamps: IntArray) -> IntArray | None:
    """Return stamps of a uniform clock (ns), or None if these scatter little about it."""
    from magfusion.receiver.sampling_clock import sampling_clock

    clock = sampling_clock((stamps - stamps[0]) * NANOSECOND)
    if clock is None:
        return None
    return np.asarray(stamps[0] + np.rint(clock.time / NANOSECOND).astype(np.int64))


def _count_burst(path: Path, counts: Counts) -> None:
    """Add the time from the first sample of a stream to its stamp, where that is of a burst."""
    with pyarrow.parquet.ParquetFile(path) as file:
        stamps = file.read_row_group(0, columns=[TIME])[TIME].to_numpy()
    even = _even_stamps(stamps)
    # Within a step, a stamp is as good as the clock.
    if even is not None and even[0] < stamps[0] - (even[1] - even[0]):
        counts.before_ns += int(stamps[0] - even[0])


def _report_stream(report: Report, stream: str, plan: ImportPlan, rows: int) -> None:
    report(f"importing {stream}", rows, max(plan.source.count, rows + 1))


def _refuse(declared: Findings) -> None:
    """Raise all problems at once, with options that resolve them."""
    problems = list(dict.fromkeys(declared.problems))
    if not problems:
        return
    if len(problems) == 1 and not declared.proposals:
        raise InputError(problems[0])
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    lines = [f"nothing was imported, for {count}:", *(f"  {one}" for one in problems)]
    if declared.guessed:
        lines += ["recognised by name and unit, and used as is:"]
        lines += [f"  --map {shlex.quote(one)}" for one in dict.fromkeys(declared.guessed)]
    if declared.proposals:
        proposals = list(dict.fromkeys(declared.proposals))
        lines += ["proposed by name and size; check it, and add it to the command:"]
        lines += [f"  --map {shlex.quote(one)} \\" for one in proposals[:-1]]
        lines += [f"  --map {shlex.quote(proposals[-1])}"]
    raise InputErrors(*lines)


def _epoch(text: str | None, result: GatheredStreams) -> str | int:
    """Return the epoch (ns), or `FIRST`."""
    if text is None:
        return FIRST if result.stamped else 0
    if text == FIRST:
        return FIRST
    try:
        return int(text)
    except ValueError:
        pass
    if not result.bags:
        result.findings.problems.append(
            f"--epoch {text!r}: write a stamp in ns, or first; a topic requires a bag."
        )
        return 0
    try:
        return first_stamp(result.bags[0], text)
    except InputError as error:
        result.findings.problems.append(str(error))
        return 0


def _refuse_apart(counts: dict[str, Counts], declared: Findings) -> None:
    """Reject streams whose times do not overlap: they are of different clocks."""
    if "imu" not in counts or not set(FIELD_STREAMS) & set(counts):
        return
    for name in set(counts) - {"imu", "gyro", "accel"}:
        one, other = counts["imu"], counts[name]
        if one.last < other.first or other.last < one.first:
            spans = [
                f"{stream} {c.first * NANOSECOND:.9g} to {c.last * NANOSECOND:.9g} s"
                for stream, c in (("imu", one), (name, other))
            ]
            declared.problems.append(
                f"the times of imu and {name} do not overlap ({', '.join(spans)}): bring them to"
                " one clock, by the unit of a time, --offset TABLE=SECONDS or --rate-hz"
                " TABLE=HZ@SECONDS."
            )


def _with_imu(directory: Path, counts: dict[str, Counts]) -> str:
    """Join the halves of an IMU, where there are two, and return a note."""
    if not set(HALVES) <= set(counts):
        return ""
    evened = [half for half in HALVES if _on_even_clock(directory / f"{half}.parquet")]
    joined = join_halves(directory, counts)
    counts["imu"], note = joined.counts, joined.note
    if evened:
        note += f" Stamps of the {' and '.join(evened)} are of bursts: an even clock is used."
    return note


def _recorded(path: Path, audio: AudioEntry) -> Counts:
    """Return the count and span of a recording's samples."""
    with open_audio(path) as recording:
        frames = recording.frames
    true = frames - 1 + sum(missing for _, missing in audio.slips)
    last = audio.begin_ns + round(true / audio.rate_hz / NANOSECOND)
    return Counts(read=frames, written=frames, first=audio.begin_ns, last=last)


def _write_header(
    directory: Path, output: Path, result: GatheredStreams, epoch_ns: int, audio: AudioEntry | None
) -> None:
    places = [plan.source.place for plan in result.every]
    places += [] if audio is None else [audio.file]
    source = "imported: " + ", ".join(dict.fromkeys(places))
    header = {"magfusion_log": 1, "name": output.resolve().name, "epoch_ns": epoch_ns}
    header |= {"source": source}
    header |= {} if audio is None else {"audio": audio.model_dump()}
    write_yaml(header, directory / HEADER)


def _checked(directory: Path, output: Path, result: GatheredStreams, site: Path | None) -> Figures:
    """Return the findings of the check of the log, with the final file names.

    A log without fields, for `allan` alone, is not checked.
    """
    if "magnetometer" not in result.plans and result.phasors is None:
        return Figures()
    if result.phasors is not None and not is_signed(directory / f"{FIELDS}.parquet"):
        site = None  # amplitudes alone are not checked against one
    try:
        figures = run_check(CheckSettings(log=directory, site=site))
    except InputError as error:
        sentence = str(error)
        halves = [plan for stream, plan in result.plans.items() if stream in ("gyro", "accel")]
        plans = result.plans | ({"imu": halves[0]} if halves else {})
        for stream, plan in plans.items():
            file = str(directory / f"{stream}.parquet")
            if file in sentence:
                # The remedy in the message of a log's reader is to change the numbers.
                place = f"{plan.source.place} as {plan.stream} by {', '.join(plan.options())}"
                fact = sentence.rpartition(";")[0].replace(file, place)
                sentence = f"{fact}; correct the units in --map."
        raise InputError(sentence.replace(str(directory), str(output))) from error
    return Figures(*(f for f in figures.all if f.section is not Section.TITLE))


COMMAND = Command(
    ImportSettings,
    run_import,
    output_required=True,
    fails=False,
    example="magfusion import --imu imu.csv --magnetometer mag.csv --map 'imu.time=t[ms]'"
    " --map 'imu.gyro=GyrX,GyrY,GyrZ[deg/s]' --map 'imu.accel=AccX,AccY,AccZ[g]' -o log",
)
