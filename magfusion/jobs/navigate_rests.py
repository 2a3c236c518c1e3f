"""Navigation of rests as they last: along a log, or from records on standard input."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TextIO

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.files.named_records import with_waveform
from magfusion.files.records import Record
from magfusion.files.site import load_site, save_site
from magfusion.files.standard_streams import binary_output, until_closed
from magfusion.files.stream import NumberedRecord, json_line
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.record_loop import process_records
from magfusion.jobs.record_source import live_records
from magfusion.jobs.stream_samples import StreamSamples
from magfusion.model.progress import Report, quiet
from magfusion.model.quaternion import of_matrices
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk, Trust, uniform_trust
from magfusion.receiver.windows import LockinSettings
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.estimation.rests.rest_stream import RestNavigator, RestState
    from magfusion.jobs.inputs import Job

PIECE = 1.0  # s; of a log that is replayed
# Options of `navigate` that it uses.
READERS = {
    *("site", "log", "output", "start", "end", "topics", "as_json", "form", "keep_going"),
    *("at_rest", "false_alarm", "window", "step", "mains_hz", "risk", "fault_prior"),
    *("hemisphere", "region"),
}


@dataclass(frozen=True)
class How:
    """Settings of rest integration: as `magfusion.estimation.rests.rest_stream.RestNavigator`."""

    lockin: LockinSettings | None
    false_alarm: float
    risk: Risk

    def navigator(self, site: Site) -> RestNavigator:
        """Return an estimator."""
        from magfusion.estimation.rests.rest_stream import RestNavigator

        return RestNavigator(site, self.lockin, self.false_alarm, self.risk)


def run_at_rest(
    settings: NavigateSettings, output: Path, given: set[str], report: Report
) -> Figures | None:
    """Estimate the position of a stationary platform during its rest."""
    refuse_other(given)
    pipe = settings.is_live
    job = settings.job(Path() if pipe else output)
    how = How(settings.lockin(job), settings.false_alarm, settings.risks)
    if not pipe:
        return run_rests(job, how, report)
    site = settings.where.bounded(load_site(settings.live_site(given)))
    with until_closed():
        records = live_records(settings, site, sys.stderr)
        run_rests_stream(site, how, records, settings.keep_going, binary_output(), sys.stderr)
    return None


def refuse_other(given: set[str]) -> None:
    """Reject options of `navigate` that do not apply."""
    other = sorted(given - READERS)
    if other:
        raise InputError(
            f"--{other[0].replace('_', '-')} is for navigation in motion, --at-rest for a"
            " stationary platform; omit one of the two"
        )


def replayed(log: Log, navigator: RestNavigator, report: Report = quiet) -> list[RestState]:
    """Return the states of a log as a navigator receives it in real time."""
    wave, imu, other = log.waveform, log.imu, log.reference
    assert wave is not None
    edges = np.arange(wave.time[0], wave.time[-1] + PIECE, PIECE) + PIECE
    first = np.zeros(3, dtype=int)
    states: list[RestState] = []
    streams = [wave.time, imu.time, np.empty(0) if other is None else other.time]
    for k, edge in enumerate(edges):
        last = np.array([int(np.searchsorted(stream, edge)) for stream in streams])
        own = [slice(int(a), int(b)) for a, b in zip(first, last, strict=True)]
        if log.inertial:
            navigator.add_imu(imu.time[own[1]], imu.gyro_body[own[1]], imu.accel_body[own[1]])
        if other is not None:
            navigator.add_reference(other.time[own[2]], other.measured_sensor[own[2]])
        navigator.add_magnetometer(wave.time[own[0]], wave.measured_sensor[own[0]])
        states += navigator.take()
        first = last
        if k % 100 == 0:
            report("integrating", k, len(edges))
    navigator.end()
    return states + navigator.take()


def run_rests(job: Job, how: How, report: Report = quiet) -> Figures:
    """Navigate the rests of a log: a pose after every stretch of a rest, with the data so far."""
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.result_directory import claim, refuse_failed

    claimed = claim(job.output, "navigate")
    log, site = read_job(job, reference=True, select_beacons=False, report=report)
    if log.waveform is None:
        raise InputError(
            f"{job.log_path}: has no magnetometer.parquet to integrate at rest; give the raw log"
        )
    began = time.perf_counter()
    with named(job.log_path):
        navigator = how.navigator(site)
        states = replayed(log, navigator, report)
    reported = [one for one in states if one.fixes is not None]
    if not reported:
        text = "the platform is nowhere at rest for long enough"
        if any(one.standing for one in states):
            text = states[-1 if states[-1].standing else -2].trust.ordered[0].text
        raise EstimationError(f"{job.log_path}: {text}")
    newest = _newest_of_rests(states)
    trust = Trust(tuple(recorded(log, site, BRIDGED_CODES)))
    for one in newest:
        trust |= one.trust
    elapsed = Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    with claimed as whole:
        figures = _written(whole, log, site, reported, trust) | _rest_figures(newest) | elapsed
        from magfusion.results.report import write_report

        write_report(whole, figures)
    refuse_failed(job.log_path, job.output, trust)
    return figures


def _newest_of_rests(states: list[RestState]) -> list[RestState]:
    """Return the last state of each rest in which a beacon is detected."""
    out: list[RestState] = []
    fixed: RestState | None = None
    for one in states:
        if one.fixes is not None:
            fixed = one
        if not one.standing and fixed is not None:
            out.append(fixed)
            fixed = None
    return out if fixed is None else [*out, fixed]


def _written(whole: Path, log: Log, site: Site, reported: list[RestState], trust: Trust) -> Figures:
    """Write the poses, and return their figures."""
    from magfusion.jobs.result_directory import found_in
    from magfusion.results.recording import write_recording
    from magfusion.results.report import compared_with_truth

    fixes = [one.fixes.fixes for one in reported if one.fixes is not None]
    best = Trajectory(
        time=np.array([one.time for one in reported]),
        world_from_body=np.concatenate([f.world_from_body[:, 0] for f in fixes]),
        position_world=np.concatenate([f.position_world[:, 0] for f in fixes]),
        pose_cov=np.concatenate([f.pose_cov[:, 0] for f in fixes]),
    )
    directory, states = found_in(whole, trust), uniform_trust(len(best), trust.verdict)
    errors, compared = compared_with_truth(best, log)
    write_tum(best, directory / "trajectory.tum", log.epoch_ns)
    write_trajectory(best, directory / "trajectory.parquet", log.epoch_ns, states)
    save_site(site, directory / "site.yaml")
    recording = directory / "run.rrd"
    write_recording(
        recording, site, best, truth=log.truth, errors=errors, trust=trust, states=states
    )
    return heading("navigate", log.name) | trust_figures(trust) | compared


def _rest_figures(newest: list[RestState]) -> Figures:
    """Return the final figures of each rest."""
    sigma = [
        float(np.sqrt(np.trace(one.fixes.fixes.pose_cov[0, 0, 3:, 3:])))
        for one in newest
        if one.fixes is not None
    ]
    gain = np.concatenate([one.gain for one in newest])
    used = gain[np.isfinite(gain)]
    figures = [
        Figure("rests", len(newest)),
        Figure("rest_s", float(sum(one.duration for one in newest)), "s", label="time at rest"),
        Figure("position_sigma_m", float(np.median(sigma)), "m", label="position sigma, median"),
    ]
    if len(used):
        value = float(np.median(used))
        figures.append(Figure("reference_gain", value, label="reference's gain, median"))
    return Figures(*figures)


def run_rests_stream(
    site: Site,
    how: How,
    records: Iterable[NumberedRecord],
    keep_going: bool,
    sink: BinaryIO,
    messages: TextIO,
) -> int:
    """Navigate rests from the records of a stream; one line of JSON for each state.

    Returns the number of skipped records.
    """
    navigator, samples = how.navigator(site), StreamSamples(site)

    def process(record: Record) -> None:
        _process_record(navigator, with_waveform(record, site), samples)

    def write() -> None:
        for state in navigator.take():
            sink.write(json_line(rest_content(state)))
        sink.flush()

    refused = process_records(records, process, write, messages, keep_going=keep_going)
    for stream, _, *remaining in samples.end():
        _add(navigator, stream, *remaining)
    navigator.end()
    write()
    samples.report(messages)
    return refused


def _add(navigator: RestNavigator, stream: str, time: Array, rows: Array) -> None:
    platform = navigator.site.platform
    if stream == "imu":
        navigator.add_imu(time, *platform.corrected_imu(rows[:, :3], rows[:, 3:]))
    else:
        navigator.add_magnetometer(platform.on_drive_clock(time), rows)


def _process_record(navigator: RestNavigator, record: Record, samples: StreamSamples) -> None:
    if record.imu is not None:
        whole = samples.whole("imu", record.imu.time, record.imu.gyro, record.imu.accel)
        _add(navigator, "imu", *samples.tested("imu", *whole))
    if record.reference is not None:
        own = record.reference
        navigator.add_reference(*samples.whole("reference", own.time, own.field))
    if record.magnetometer is not None:
        whole = samples.whole("magnetometer", record.magnetometer.time, record.magnetometer.field)
        _add(navigator, "magnetometer", *samples.tested("magnetometer", *whole))
    if record.fields is not None:
        raise InputError("--at-rest integrates samples of the magnetometer; omit fields")


def rest_content(state: RestState) -> dict[str, Any]:
    """Return a state of a rest as written; unknown values are null."""
    from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE

    trust, names = state.trust, () if state.samples is None else state.samples.channels
    detected = zip(names, state.detected.tolist(), strict=False)
    gain = zip(names, state.gain.tolist(), strict=False)
    reported: dict[str, Any] = {
        "time": state.time,
        "started": state.fixes is not None,
        "lost": False,
        "standing": state.standing,
        "rest_s": state.duration,
        "reset_counter": 0,
        "verdict": str(trust.verdict) if state.standing else None,
        "reasons": [{"code": f.code, "text": f.text} for f in trust.reasons],
        "remarks": [{"code": f.code, "text": f.text} for f in trust.remarks],
        "heard": list(dict.fromkeys(name for (name, _), one in detected if one)),
        "reference_gain": {f"{b}_{t}": g for (b, t), g in gain if np.isfinite(g)},
        "position": None,
    }
    if state.fixes is None:
        return reported
    fixes, levels = state.fixes.fixes, state.fixes.states
    rival = fixes.cost[0, 1] - fixes.cost[0, 0] if fixes.cost.shape[1] > 1 else np.inf
    cov, rotation = fixes.pose_cov[0, 0], fixes.world_from_body[0, 0]
    known = bool(fixes.determined[0, 0])
    reported |= {
        "excluded": list(levels.excluded[0]),
        "protection_level_m": _finite(levels.protection_level_m[0]),
        "protection_level_deg": _finite(levels.protection_level_deg[0]),
        "ambiguous": bool(rival < AMBIGUOUS_CHI_SQUARE),
        "lost": str(trust.verdict) == "failed",
        "velocity": [0.0, 0.0, 0.0],
    }
    if not known or reported["lost"]:
        return reported
    world = rotation @ cov[3:, 3:] @ rotation.T
    return reported | {
        "position": fixes.position_world[0, 0].tolist(),
        "quaternion": of_matrices(rotation[None])[:, 0].tolist(),
        "sigma": {
            "position": np.sqrt(np.diagonal(world)).tolist(),
            "rotation_body": np.sqrt(np.diagonal(cov[:3, :3])).tolist(),
        },
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
