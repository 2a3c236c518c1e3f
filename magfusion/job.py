"""What a job reads, and where it may write."""

import json
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from magfusion.errors import InputError
from magfusion.receiver.slots import has_schedule, schedule
from magfusion.receiver.windows import LockinSettings, channel_frequencies_hz
from magfusion.records.atomic import refuse_in_the_way, whole_directory
from magfusion.records.fields import order_channels
from magfusion.records.open import open_log
from magfusion.records.rosbag import Topics
from magfusion.records.samples import Log
from magfusion.records.trajectory_table import read_trajectory
from magfusion.records.tum import read_tum
from magfusion.site import Site
from magfusion.site_file import load_site
from magfusion.trajectory import Trajectory


@dataclass(frozen=True)
class Job:
    """What every job on a log needs.

    Parameters
    ----------
    log_path : Path
    site_path : Path, optional
        None takes ``site.yaml`` in the log's directory.
    output : Path
        Directory of the results; an earlier result there is replaced.
    lockin : LockinSettings, optional
    start, end : float, optional
        Part of the log to use, seconds since its epoch.
    topics : Topics, optional
        Of a bag that has several of one type.
    """

    log_path: Path
    site_path: Path | None
    output: Path
    lockin: LockinSettings | None = None
    start: float | None = None
    end: float | None = None
    topics: Topics | None = None


_SITE = {"site.yaml", "site_field_map.parquet", "site_correlation.parquet"}
_RESULT = {"trajectory.tum", "trajectory.parquet", *_SITE, "run.rrd", "report.json"}
_TABLES = {"imu.parquet", "magnetometer.parquet", "fields.parquet", "truth.parquet"}
_TRUE_SITE = {f"true_{name}" for name in _SITE}
_LOG = {"log.yaml", *_SITE, *_TRUE_SITE, "report.json", *_TABLES}
UNFINISHED_DRIFT = "unfinished"
# What stands in the directory while these jobs run.
_UNFINISHED = {"navigate": {"checkpoint.bin", "checkpoint.rows"}, "drift": {UNFINISHED_DRIFT}}
_WRITTEN = {
    "smooth": _RESULT | {"fixes.parquet"},
    "fix": _RESULT | {"fixes.parquet"},
    "navigate": _RESULT | {"lagged.parquet"} | _UNFINISHED["navigate"],
    "drift": {"drift.png", "stability.png", "run.rrd", "report.json"} | _UNFINISHED["drift"],
    "simulate": _LOG,
    "demodulate": _LOG,
    "survey": {"survey.parquet", "survey.png", "report.json"},
    "calibrate log": _SITE | {"calibration.png", "report.json"},
    "calibrate beacon": _SITE | {"beacon.png", "report.json"},
    "calibrate antenna": _SITE | {"antenna.png", "report.json"},
    "calibrate fieldmap": _SITE | {"field_map.png", "report.json"},
    "calibrate magnetometer": _SITE | {"magnetometer.png", "report.json"},
    "calibrate attitude-database": {"attitudes.parquet", "attitudes.png", "report.json"},
    "match": {"attitude.parquet", "attitude.png", "report.json"},
    "coverage": {"coverage.parquet", "coverage.png", "run.rrd", "report.json"},
}


def _may_be_replaced(path: Path, kinds: tuple[str, ...]) -> bool:
    """Tell whether a directory holds nothing but an earlier result of these jobs."""
    found = {entry.name for entry in path.iterdir()}
    # A checkpoint that was being written when its run was killed.
    found = {name for name in found if not re.fullmatch(r"\.checkpoint\.bin\.\d+", name)}
    if any(found <= _UNFINISHED.get(kind, set()) for kind in kinds):
        return True
    try:
        report = json.loads((path / "report.json").read_text(encoding="utf-8"))
        job = report["job"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return job in kinds and found <= _WRITTEN[job]


def claim(output: Path, *kinds: str) -> AbstractContextManager[Path]:
    """Return a context whose directory becomes ``output`` only if nothing fails.

    What is in the way is refused at once, before the work is done.

    Raises
    ------
    InputError
        Where ``output`` holds anything but an earlier result of these jobs.
    """

    def replaces(path: Path) -> bool:
        return _may_be_replaced(path, kinds)

    refuse_in_the_way(output.resolve(), replaces)
    return whole_directory(output, replaces)


@contextmanager
def named(place: Path | str) -> Iterator[None]:
    """Name the file in the refusals of what knows only its content."""
    try:
        yield
    except InputError as error:
        if str(place) in str(error):
            raise
        raise InputError(f"{place}: {error}") from error


def read_job(job: Job, *, unknown: bool = False) -> tuple[Log, Site]:
    """Read the log and the site of a job, and see that they belong together.

    Parameters
    ----------
    job : Job
    unknown : bool
        Whether the job can do with beacons that were never surveyed.

    Raises
    ------
    InputError
        For anything in either file that a user must mend.
    """
    if job.site_path is None and not (job.log_path / "site.yaml").is_file():
        # A log that is not there is the nearer cause.
        _open(job)
        raise InputError(
            f"{job.log_path}: holds no site.yaml; name the site's file with --site SITE.yaml"
        )
    site_path = job.log_path / "site.yaml" if job.site_path is None else job.site_path
    site = load_site(site_path, unknown=unknown)
    log = _open(job)
    if log.waveform is not None:
        with named(site_path):
            if has_schedule(site):
                schedule(site)
            else:
                channel_frequencies_hz(site)
    if log.fields is not None:
        with named(job.log_path):
            log = replace(log, fields=order_channels(log.fields, site))
    return log, site


def _open(job: Job) -> Log:
    log = open_log(job.log_path, job.start, job.end, job.topics)
    if log.waveform is None and log.fields is None:
        raise InputError(
            f"{job.log_path}: holds no magnetometer samples in the part to use; record the"
            " magnetometer beside the inertial sensor"
        )
    return log


def read_estimate(path: Path, epoch_ns: int = 0) -> Trajectory:
    """Read a trajectory from a result's directory, a TUM file, or a table (Parquet, CSV).

    Raises
    ------
    InputError
        Where there is none.
    """
    if path.is_dir():
        if not (path / "trajectory.parquet").is_file():
            raise InputError(f"{path}: holds no trajectory.parquet; give the result of a job")
        return read_trajectory(path / "trajectory.parquet", epoch_ns)
    if path.suffix in (".parquet", ".csv"):
        return read_trajectory(path, epoch_ns)
    return read_tum(path, epoch_ns)
