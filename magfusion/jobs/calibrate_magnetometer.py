"""The job that calibrates a magnetometer: a log of rotation in, a refined site out."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from magfusion.calibration.magnetometer import spread
from magfusion.calibration.turn_coverage import TurnStatus
from magfusion.errors import InputError
from magfusion.files.site import load_site, save_site
from magfusion.files.standard_streams import binary_input
from magfusion.files.stream import read_records
from magfusion.jobs.magnetometer_trust import calibrated, calibrated_field, estimates_of
from magfusion.jobs.settings import Command, LogSettings, argument, option
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.results.figures import (
    Figure,
    Figures,
    ParameterEstimate,
    calibration_record,
    determined_figures,
    heading,
)
from magfusion.results.turn_guide import terminal_guide
from magfusion.results.verdict import notes_of, trust_figures
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from magfusion.calibration.magnetometer_log import LogCalibration
    from magfusion.jobs.inputs import Job


JOB = "calibrate magnetometer"
PIPE = "-"
OF_PIPE = {"form", "offset_sigma", "live"}


@dataclass(frozen=True, kw_only=True)
class MagnetometerSettings(LogSettings):
    """Part of a log used to calibrate the magnetometer, or records on standard input."""

    log: Path = argument("Log, or - for records on standard input: then the rotation is guided")
    positions: bool = option(False, "Use only the stops of the log: twelve or more")
    form: Literal["json", "msgpack"] = option("json", "Records in the pipe", name="format")
    offset_sigma: float = option(
        0.1, "Offset sigma at which a guided rotation ends", unit="uT", least=1e-3, most=10.0
    )
    live: bool = option(False, "Show the guidance in the viewer")


def run(settings: MagnetometerSettings, output: Path, given: set[str]) -> Figures:
    """Calibrate the magnetometer; see `run_calibrate_magnetometer`."""
    is_pipe = str(settings.log) == PIPE
    unfit = given & ({"positions", "start", "end", "topics"} if is_pipe else OF_PIPE)
    if unfit:
        names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in unfit))
        source = "a log" if is_pipe else "records on standard input (-)"
        raise InputError(f"{names.replace('--form', '--format')}: only for {source}; omit it")
    if is_pipe:
        return run_guided(settings, output)
    return run_calibrate_magnetometer(settings.job(output), positions=settings.positions)


def run_guided(settings: MagnetometerSettings, output: Path) -> Figures:
    """Guide a rotation by the records on standard input, and calibrate as from a log."""
    from magfusion.jobs.magnetometer_turns import guide
    from magfusion.jobs.result_directory import claim
    from magfusion.results.recording_turns import open_turn_view

    if settings.site is None:
        raise InputError(f"{JOB} - requires the site's file; give it with --site SITE.yaml")
    claimed, site = claim(output, JOB), load_site(settings.site, without=True)
    records, limit = read_records(binary_input(), settings.form), 1e-6 * settings.offset_sigma
    history: list[TurnStatus] = []
    viewer = open_turn_view().show if settings.live else None
    with terminal_guide(sys.stderr, limit) as terminal:

        def show(status: TurnStatus) -> None:
            history.append(status)
            terminal(status)
            if viewer is not None:
                viewer(status)

        guided = guide(site, records, calibrated, limit, show, sys.stderr)
    return write_calibrated(claimed, *guided, history)


def run_calibrate_magnetometer(job: Job, *, positions: bool = False) -> Figures:
    """Calibrate the magnetometer of a log: refined site, picture and report.

    `job`: its log has the raw waveform; inertial samples add to the field's magnitude. `positions`:
    use only the stops, at least twelve, instead of the whole rotation.
    """
    from magfusion.jobs.inputs import named, read_job, require_imu
    from magfusion.jobs.result_directory import claim, refuse_failed

    claimed = claim(job.output, JOB)
    log, site = read_job(job, without=True)
    if positions:
        require_imu(job, log, "it is needed to find the stops of --positions; omit the option")
    if log.waveform is None:
        raise InputError(
            f"{job.log_path}: has only phasors, no waveform, and phasors do not contain the Earth's"
            " field; give the log with magnetometer.parquet"
        )
    with named(job.log_path):
        result, trust = calibrated(log, site, positions=positions)
    figures = write_calibrated(claimed, log, site, result, trust)
    refuse_failed(job.log_path, job.output, trust)
    return figures


def write_calibrated(
    claimed: AbstractContextManager[Path],
    log: Log,
    site: Site,
    calibration: LogCalibration,
    trust: Trust,
    turns: Sequence[TurnStatus] = (),
) -> Figures:
    """Write site, picture, report and the recording of a guided rotation; return the figures."""
    from magfusion.jobs.result_directory import found_in
    from magfusion.results.report import write_report

    declared = site.platform.magnetometer
    before = calibrated_field(calibration, declared)
    after = calibrated_field(calibration, calibration.magnetometer)
    size = float(np.linalg.norm(calibration.prior.field_world))
    estimates = estimates_of(calibration, declared)
    figures = _figures(log, calibration, estimates, before, after, trust)
    with claimed as whole:
        directory = found_in(whole, trust)
        save_site(_refined_site(site, calibration, log.name, estimates), directory / "site.yaml")
        _plot(directory / "magnetometer.png", calibration, before, after, size)
        if turns:
            from magfusion.results.recording_turns import write_turns

            write_turns(directory / "run.rrd", log.name, turns)
        write_report(whole, figures)
    return figures


def _plot(
    path: Path, calibration: LogCalibration, before: Array, after: Array, size: float
) -> None:
    from magfusion.results.plots.magnetometer import write_magnetometer_plot

    write_magnetometer_plot(path, calibration.readings.time, before, after, size)


def _refined_site(
    site: Site, calibration: LogCalibration, log_name: str, estimates: list[ParameterEstimate]
) -> Site:
    platform = replace(site.platform, magnetometer=calibration.magnetometer)
    known = site.correlation
    return replace(
        site,
        platform=platform,
        calibration=calibration_record(log_name, estimates),
        correlation=known and known.without(("magnetometer",), ["magnetometer"]),
    )


def _figures(
    log: Log,
    calibration: LogCalibration,
    estimates: list[ParameterEstimate],
    before: Array,
    after: Array,
    trust: Trust,
) -> Figures:
    graph, readings = calibration.graph, calibration.readings
    sizes = [float(np.mean(np.linalg.norm(field, axis=1))) for field in (before, after)]
    scale = "the site's Earth field" if calibration.scale_known else "the declared matrix"
    residual = float(np.sqrt(np.mean(graph.field_residual**2)))
    biases = graph.accel_bias_body, graph.gyro_bias_body
    largest = [float(np.max(np.abs(bias))) for bias in biases]
    return (
        heading(JOB, log.name)
        | trust_figures(trust)
        | Figures(
            Figure("readings", len(readings)),
            Figure("window_s", float(np.median(readings.window)), "s"),
            Figure("spread_before", spread(before)),
            Figure("spread_after", spread(after)),
            Figure("spread_unseen", calibration.spread_unseen),
            Figure("field_size_before_t", sizes[0], "T"),
            Figure("field_size_after_t", sizes[1], "T"),
            Figure("field_noise_t", calibration.field_sigma, "T"),
            Figure("scale_from", scale),
            Figure("dip_change_deg", graph.dip_change / DEGREE, "deg"),
            Figure("accel_bias_m_s2_largest", largest[0], "m/s^2", label="accel bias, largest"),
            Figure("gyro_bias_rad_s_largest", largest[1], "rad/s", label="gyro bias, largest"),
            Figure("field_residual_rms", residual),
            *estimates,
        )
        | determined_figures(estimates)
        | notes_of(trust)
    )


COMMAND = Command(
    MagnetometerSettings,
    run,
    output="magnetometer",
    example="magfusion calibrate magnetometer log -o magnetometer",
)
