"""Inputs of a job."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.magnetometers import without_silent
from magfusion.estimation.demodulation.beacon_selection import select_detected
from magfusion.estimation.demodulation.drive_reference import turning_currents, with_drives
from magfusion.estimation.demodulation.separate_demodulation import demodulated_apart, of_site
from magfusion.estimation.demodulation.temperature_compensation import at_reference
from magfusion.estimation.measurements.signs import along_axis
from magfusion.files.bag_topics import Topics
from magfusion.files.drive_columns import column_names
from magfusion.files.fields import order_channels
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.files.table import TIME
from magfusion.files.trajectory_table import read_trajectory
from magfusion.files.tum import read_tum
from magfusion.jobs.receiver_axes import check_axes
from magfusion.jobs.region_option import ANYWHERE, Where
from magfusion.jobs.rotor_inputs import check_rotors, is_for_ranging
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.model.without_imu import logged
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.windows import LockinSettings


@dataclass(frozen=True)
class Job:
    """Inputs of every job on a log."""

    log_path: Path
    site_path: Path | None  # by default ``site.yaml`` in the log's directory
    output: Path  # directory of the results; an earlier result there is moved to the next free name
    # start, end: part of the log to use, seconds since its epoch
    start: float | None = None
    end: float | None = None
    topics: Topics | None = None  # of a bag with several of one type
    where: Where = ANYWHERE  # constraint on the magnetometer's position, in addition to the site's

    @property
    def declared_path(self) -> Path:
        """File of the site."""
        return self.log_path / "site.yaml" if self.site_path is None else self.site_path


NOT_USED = Finding(
    "reference_unused",
    "The reference sensor is not used: it reduces noise at rest only, with demodulate, fix, smooth"
    " or navigate with --at-rest.",
    Verdict.TRUSTWORTHY,
)


@contextmanager
def named(place: Path | str) -> Iterator[None]:
    """Add the file name to errors raised from its content alone."""
    try:
        yield
    except InputError as error:
        if re.search(rf"(?<!\w){re.escape(str(place))}(?!\w)", str(error)):
            raise
        raise InputError(f"{place}: {error}") from error


def topics_option(text: str | None) -> Topics | None:
    """Parse ``role=name,...``."""
    if text is None:
        return None
    roles = [part.strip().partition("=") for part in text.split(",")]
    known = [field.name for field in fields(Topics)]
    if any(role not in known or not name for role, _, name in roles):
        raise InputError(
            f"--topics {text!r}: write role=name, separated by commas, with a role of"
            f" {', '.join(known)}"
        )
    return Topics(**{role: name for role, _, name in roles})


def read_site(
    job: Job, *, unknown: bool = False, without: bool = False, several: bool = False
) -> Site:
    """Read the site of a job.

    `unknown`: whether the job accepts beacons that were never surveyed. `without`: whether it
    accepts a site without beacons. `several`: whether it accepts several magnetometers.
    """
    if job.site_path is None and not job.declared_path.is_file():
        # A missing log is the more direct cause.
        _open(job)
        raise InputError(
            f"{job.log_path}: has no site.yaml; give the site's file with --site SITE.yaml"
        )
    site = load_site(job.declared_path, unknown=unknown, without=without, several=several)
    return job.where.bounded(site)


def read_job(
    job: Job,
    *,
    unknown: bool = False,
    without: bool = False,
    fewer: bool = False,
    amplitudes: bool = False,
    reference: bool = False,
    rotor: bool = False,
    separately: bool = False,
    several: bool = False,
    raw: bool = False,
    reread: bool = False,
    lockin: LockinSettings | None = None,
    select_beacons: bool = True,
    report: Report = quiet,
) -> tuple[Log, Site]:
    """Read the log and the site of a job, and check their consistency.

    Raises InputError for invalid content of either file.

    Parameters
    ----------
    unknown : bool
        Whether the job accepts beacons that were never surveyed.
    without : bool
        Whether it accepts a site without beacons.
    fewer : bool
        Whether it accepts a receiver of fewer than three axes.
    amplitudes : bool
        Whether it accepts unsigned amplitudes.
    reference : bool
        Whether it uses a reference sensor; if not, that is reported.
    rotor : bool
        Whether it handles the angle of a rotor and a casing itself.
    separately : bool
        Whether each epoch may have a separate phase.
    several : bool
        Whether it accepts several magnetometers.
    raw : bool
        Whether it demodulates the samples of several itself.
    reread : bool
        Whether it demodulates them again, once the motion is known.
    lockin : LockinSettings, optional
        Demodulation settings for the samples of several magnetometers.
    select_beacons : bool
        Whether only the beacons detected in a window are used, of many.
    """
    site = read_site(job, unknown=unknown, without=without, several=several)
    log = _as_known(job, _open(job, report, site), site)
    check_axes(job.declared_path, job.log_path, log, site, fewer=fewer, amplitudes=amplitudes)
    if not rotor:
        check_rotors(job.declared_path, job.log_path, log, site, separately=separately)
    log, site = logged(log, site)
    _require_described(job, log, site)
    with named(job.log_path):
        log = clean_log(log, site)
    if log.waveforms and not raw:
        with named(job.log_path):
            result = demodulated_apart(log, site, lockin, repeated=reread)
        findings = (*log.findings, *result.findings)
        log, site = without_silent(replace(result.log, findings=findings), site)
    elif log.fields is not None:
        with named(job.log_path):
            log = replace(log, fields=along_axis(order_channels(log.fields, site), site))
        log, site = without_silent(log, site)
    with named(job.log_path):
        if not rotor:
            log = turning_currents(log, site)
        log, site = with_drives(log, site)
    if log.reference is not None and not reference:
        log = replace(log, reference=None, findings=(*log.findings, NOT_USED))
    log, site = at_reference(log, site)
    if not select_beacons:
        return log, site
    with named(job.log_path):
        return select_detected(log, site)


def _require_described(job: Job, log: Log, site: Site) -> None:
    """Reject inertial samples of a site without an IMU, and tones too close for any receiver."""
    if log.inertial and site.platform.imu == NO_IMU:
        raise InputError(
            f"{job.declared_path}: platform.imu: is missing, but {job.log_path} has inertial"
            " samples; describe the sensor, or remove its samples"
        )
    if log.waveform is not None and site.beacons:
        with named(job.declared_path):
            receiver_of(site).check()


def _as_known(job: Job, log: Log, site: Site) -> Log:
    """Return a log with the samples of the magnetometers that the site has."""
    with named(job.log_path):
        log = of_site(log, site)
    if not site.platform.further:
        return log
    if log.fields is None and not log.waveforms:
        raise InputError(
            f"{job.log_path}: the samples do not specify which of the site's magnetometers took"
            " them; add a column magnetometer with its name to magnetometer.parquet"
        )
    return replace(log, waveform=None, fields=None if log.waveforms else log.fields)


def require_imu(job: Job, log: Log, what: str) -> None:
    """Raise an error for a log without inertial samples."""
    if not log.inertial:
        raise InputError(
            f"{job.log_path}: has no imu.parquet or imu.csv, and {what}; record the inertial sensor"
            " with the magnetometer"
        )


def read_recording(job: Job, report: Report = quiet) -> tuple[Log, Site | None]:
    """Read a log, and its site if there is one: a log alone can be checked too."""
    if job.site_path is not None or job.declared_path.is_file():
        site = load_site(job.declared_path, unknown=True, without=True, several=True)
        if site.beacons or site.platform.further:
            log, site = read_job(
                job,
                unknown=True,
                without=True,
                fewer=True,
                rotor=is_for_ranging(site),
                separately=True,
                several=True,
                raw=True,
                report=report,
            )
            if site.platform.further and not log.waveforms:
                raise InputError(
                    f"{job.log_path}: has only phasors of several magnetometers, but check requires"
                    " the samples; give the log with magnetometer.parquet"
                )
            return log, site
        with named(job.log_path):
            return clean_log(_open(job, report, site), site), site
    return open_log(job.log_path, job.start, job.end, job.topics, report), None


def _open(job: Job, report: Report = quiet, site: Site | None = None) -> Log:
    log = open_log(job.log_path, job.start, job.end, job.topics, report, site)
    if log.waveform is None and log.fields is None and not log.waveforms:
        raise InputError(
            f"{job.log_path}: has no magnetometer samples in the selected part; record the"
            " magnetometer with the inertial sensor"
        )
    return log


def read_estimate(path: Path, epoch_ns: int = 0) -> Trajectory:
    """Read a trajectory from a result's directory, a TUM file, or a table (Parquet, CSV).

    Raises InputError where there is none, or it has positions or attitudes alone.
    """
    return whole_poses(read_any_poses(path, epoch_ns), path)


def whole_poses(poses: Trajectory, path: Path) -> Trajectory:
    """Return poses, e.g. a log's truth, that have positions and attitudes.

    Raises InputError where one of them is unknown.
    """
    if not poses.has_poses:
        alone = "positions" if poses.has_position else "attitudes"
        raise InputError(f"{path}: has {alone} alone, but whole poses are needed; give both")
    return poses


def known_poses(log: Log, place: Path, trajectory: Path | None) -> tuple[Trajectory, Log]:
    """Return the poses of a trajectory for a log, or those of its truth, and the log.

    The log's findings include what was left out of the trajectory. Raises InputError where there
    are no poses, or positions or attitudes alone.
    """
    if trajectory is None and log.truth is None:
        raise InputError(
            f"{place}: has no truth for the poses; give a smoothed result with --trajectory"
        )
    if trajectory is None:
        assert log.truth is not None
        return whole_poses(log.truth, place), log
    findings: list[Finding] = []
    poses = whole_poses(read_any_poses(trajectory, log.epoch_ns, findings), trajectory)
    return poses, replace(log, findings=(*log.findings, *findings))


def read_any_poses(
    path: Path, epoch_ns: int = 0, findings: list[Finding] | None = None
) -> Trajectory:
    """Read a trajectory as `read_estimate`, which may have positions or attitudes alone.

    `findings`: receives the number of rows without a pose, which are left out; without it they are
    refused.
    """
    if path.is_dir():
        if not (path / "trajectory.parquet").is_file():
            raise InputError(f"{path}: has no trajectory.parquet; give the result of a job")
        return read_trajectory(path / "trajectory.parquet", epoch_ns)
    if path.suffix in (".parquet", ".csv"):
        names = column_names(path)
        if names and TIME not in names:
            from magfusion.files.foreign.euroc import read_euroc_poses  # slow, and seldom needed

            return read_euroc_poses(path, epoch_ns, findings)
        return read_trajectory(path, epoch_ns, findings=findings)
    return read_tum(path, epoch_ns, findings)
