"""Orientation at the IMU's rate, from smooth and navigate with a site without beacons."""

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, BinaryIO, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stamps import uneven_stamps
from magfusion.estimation.graph.state import GYRO_BIAS, ROTATION
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.estimation.orientation.layout import LAG, OFFSET, Orientation
from magfusion.estimation.orientation.online import ANYWHERE, TIMING, OrientationNavigator
from magfusion.estimation.orientation.remarks import doubts, remarks
from magfusion.estimation.orientation.smoother import Oriented, oriented
from magfusion.files.records import Record
from magfusion.files.site import save_site
from magfusion.files.stream import NumberedRecord, json_line
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.inputs import Job, named, read_job, require_imu
from magfusion.jobs.record_loop import process_records
from magfusion.jobs.result_directory import claim
from magfusion.jobs.stream_samples import StreamSamples
from magfusion.model.progress import Report
from magfusion.model.samples import Log
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Trust, uniform_trust
from magfusion.model.truth_poses import truth_poses
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.page_motion import MotionPage
from magfusion.results.recording import write_recording
from magfusion.results.report import write_report
from magfusion.results.verdict import trust_figures
from magfusion.units import DEGREE, MICROTESLA, Array, Rate


def run_orientation(name: str, job: Job, rate: Rate, *, back: bool, report: Report) -> Figures:
    """Estimate the orientation of a log: trajectory, report, recording, and the estimated site.

    `rate`: without beacons there are no field epochs: states are at every inertial sample, or so
    many a second (Hz). `back`: whether later samples are used too.
    """
    claimed = claim(job.output, name)
    log, site = read_job(job, without=True, report=report)
    require_imu(job, log, "without beacons the rotation is known only from the gyroscope")
    began = time.perf_counter()
    with named(job.log_path):
        result = oriented(log, site, back=back, report=report)
    elapsed = time.perf_counter() - began
    states = _thinned(_trajectory(result, log, site), rate)
    assert site.earth_field_world is not None
    assert states.pose_cov is not None
    findings = remarks(
        result.states, result.disturbance, result.changed, site.earth_field_world / MICROTESLA
    )
    open_heading = np.array([s.cov[2, 2] for s in result.states])
    usual = result.states[int(np.argsort(open_heading)[len(open_heading) // 2])]
    findings += doubts(usual.cov[:3, :3], np.eye(3))
    trust = Trust((*log.findings, *uneven_stamps(log, site), *findings))
    figures = heading(name, log.name) | trust_figures(trust) | _figures(result, states, elapsed)
    figures |= _errors(states, log)
    by_state = uniform_trust(len(states), trust.verdict)
    refined = _refined(site, result.states[-1])
    with claimed as whole:
        write_tum(states, whole / "trajectory.tum", log.epoch_ns)
        write_trajectory(states, whole / "trajectory.parquet", log.epoch_ns, by_state)
        save_site(refined, whole / "site.yaml")
        write_recording(whole / "run.rrd", refined, states, trust=trust, states=by_state)
        write_report(whole, figures, MotionPage(refined, states, trust=by_state))
    return figures


def _trajectory(result: Oriented, log: Log, site: Site) -> Trajectory:
    """Return the states at the inertial samples; the position is unknown."""
    ends, time = result.ends, result.time
    index = np.clip(np.searchsorted(ends, time), 0, len(ends) - 1)
    noise = site.platform.imu.gyro_noise
    pose = np.empty((len(time), 6, 6))
    pose[:] = np.diag([0.0, 0.0, 0.0, *[ANYWHERE**2] * 3])
    turn = np.stack([state.cov[:3, :3] for state in result.states])[index]
    attitude = result.world_from_body
    rate = np.linalg.norm(log.imu.gyro_body[: len(time)], axis=1)
    floor = (noise**2 * 0.1 + (TIMING * rate) ** 2)[:, None, None] * np.eye(3)
    pose[:, :3, :3] = np.swapaxes(attitude, 1, 2) @ turn @ attitude + floor
    part = {
        "velocity_world": np.stack([s.velocity_world for s in result.states])[index],
        "gyro_bias_body": np.stack([s.gyro_bias for s in result.states])[index],
        "accel_bias_body": np.stack([s.accel_bias for s in result.states])[index],
    }
    return Trajectory(time, attitude, np.zeros((len(time), 3)), **part, pose_cov=pose)


def _thinned(states: Trajectory, rate: Rate) -> Trajectory:
    if isinstance(rate, str):
        return states
    wanted = np.arange(states.time[0], states.time[-1], 1.0 / rate)
    rows = np.unique(np.clip(np.searchsorted(states.time, wanted), 0, len(states) - 1))
    return states.rows(rows)


def _figures(result: Oriented, states: Trajectory, elapsed: float) -> Figures:
    last, cov = result.states[-1], states.pose_cov
    assert cov is not None
    turn = states.world_from_body @ cov[:, :3, :3] @ np.swapaxes(states.world_from_body, 1, 2)
    sigma = np.sqrt(np.diagonal(turn, axis1=1, axis2=2)) / DEGREE
    offset_sigma = np.sqrt(np.diagonal(last.cov[OFFSET, OFFSET]))
    return Figures(
        Figure("states", len(states)),
        Figure("duration_s", float(states.time[-1] - states.time[0]), "s"),
        Figure("heading_sigma_median_deg", float(np.median(sigma[:, 2])), "deg"),
        Figure("tilt_sigma_median_deg", float(np.median(np.hypot(*sigma[:, :2].T))), "deg"),
        Figure("field_changes", len(result.changed)),
        Figure("field_disturbance_max_ut", float(np.max(result.disturbance)), "uT"),
        Figure("field_lag_ms", 1e3 * last.lag, "ms"),
        Figure("field_lag_sigma_ms", 1e3 * float(np.sqrt(last.cov[LAG, LAG][0, 0])), "ms"),
        Figure("offset_ut", last.offset.tolist(), "uT", section=Section.REPORT),
        Figure("offset_sigma_ut", offset_sigma.tolist(), "uT", section=Section.REPORT),
        Figure("elapsed_s", elapsed, "s"),
    )


def _errors(states: Trajectory, log: Log) -> Figures:
    """Return the errors of heading and tilt against the truth, where the log has one."""
    if log.truth is None or len(log.truth) == 0 or not log.truth.has_attitude:
        return Figures()
    truth, exists, _ = truth_poses(log.truth, states.time)
    if not np.any(exists):
        return Figures()
    assert states.pose_cov is not None
    attitude, cov = states.world_from_body[exists], states.pose_cov[exists, :3, :3]
    off = Rotation.from_matrix(attitude @ np.swapaxes(truth.world_from_body, 1, 2))
    x, y, z, w = off.as_quat().T
    head = 2.0 * np.arctan2(z, w)
    head = (head + np.pi) % (2.0 * np.pi) - np.pi
    tilt = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
    body = Rotation.from_matrix(np.swapaxes(truth.world_from_body, 1, 2) @ attitude).as_rotvec()
    nees = np.einsum("ni,nij,nj->n", body, np.linalg.inv(cov), body)
    inside = np.abs(body) <= 3.0 * np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return Figures(
        Figure("attitude_rmse_deg", _rms(off.magnitude()) / DEGREE, "deg"),
        Figure("heading_rmse_deg", _rms(head) / DEGREE, "deg"),
        Figure("tilt_rmse_deg", _rms(tilt) / DEGREE, "deg"),
        Figure("attitude_nees_mean", float(np.mean(nees)), label="mean NEES (3 expected)"),
        Figure("attitude_inside_3_sigma", float(np.mean(inside)), label="share within 3 sigma"),
        Figure("compared_epochs", int(np.sum(exists))),
    )


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))


def _refined(site: Site, last: Orientation) -> Site:
    """Return the site with the magnetometer's final offset."""
    old: Magnetometer = site.platform.magnetometer
    turn = old.matrix @ old.body_from_sensor.T @ last.world_from_body.T
    cov = turn @ last.cov[OFFSET, OFFSET] @ turn.T
    sigma = np.sqrt(np.diagonal(cov)) * MICROTESLA
    result = replace(old, offset=last.offset * MICROTESLA, sigma=replace(old.sigma, offset=sigma))
    return replace(site, platform=replace(site.platform, magnetometer=result))


def run_orientation_stream(
    site: Site,
    records: Iterable[NumberedRecord],
    keep_going: bool,
    sink: BinaryIO,
    messages: TextIO,
) -> int:
    """Write the orientation for the records of a stream; a line of JSON per inertial sample.

    Returns the number of skipped records.
    """
    navigator = OrientationNavigator(site)
    samples = StreamSamples(site, patient=False)  # each sample has a state

    def process(record: Record) -> None:
        _process_record(navigator, record, samples)

    def write() -> None:
        for state in navigator.take():
            sink.write(json_line(_state_row(navigator, state)))
        sink.flush()

    refused = process_records(records, process, write, messages, keep_going=keep_going)
    for stream, _, *remaining in samples.end():
        _add(navigator, stream, *remaining)
    write()
    samples.report(messages)
    return refused


def _add(navigator: OrientationNavigator, stream: str, time: Array, rows: Array) -> None:
    platform = navigator.site.platform
    if len(time) and stream == "imu":
        navigator.add_imu(time, *platform.corrected_imu(rows[:, :3], rows[:, 3:]))
    elif len(time):
        navigator.add_magnetometer(platform.on_drive_clock(time), rows)


def _process_record(
    navigator: OrientationNavigator, record: Record, samples: StreamSamples
) -> None:
    if record.imu is not None:
        whole = samples.whole("imu", record.imu.time, record.imu.gyro, record.imu.accel)
        _add(navigator, "imu", *samples.tested("imu", *whole))
    if record.magnetometer is not None:
        whole = samples.whole("magnetometer", record.magnetometer.time, record.magnetometer.field)
        _add(navigator, "magnetometer", *samples.tested("magnetometer", *whole))
    if record.fields is not None:
        raise InputError("phasors of beacons that are not in the site; describe them there")


def _state_row(navigator: OrientationNavigator, state: JudgedState) -> dict[str, Any]:
    """Return a state as written; unknown values are null."""
    sigma = np.sqrt(np.diagonal(state.cov))
    quaternion = Rotation.from_matrix(state.world_from_body).as_quat(scalar_first=True)
    judgement = state.judgement
    return {
        "time": state.time,
        "started": True,
        "lost": False,
        "reset_counter": 0,
        "verdict": str(state.verdict),
        "reasons": [{"code": f.code, "text": f.text} for f in judgement.reasons],
        "remarks": [{"code": f.code, "text": f.text} for f in judgement.remarks],
        "excluded": [],
        "protection_level_m": None,
        "protection_level_deg": None,
        "ambiguous": False,
        "position": None,
        "quaternion": quaternion.tolist(),
        "velocity": None,
        "gyro_bias": state.gyro_bias_body.tolist(),
        "accel_bias": state.accel_bias_body.tolist(),
        "sigma": {
            "position": None,
            "rotation_body": sigma[ROTATION].tolist(),
            "velocity": None,
            "gyro_bias": sigma[GYRO_BIAS].tolist(),
            "accel_bias": sigma[9:12].tolist(),
        },
        "distortion": {},
        "field_disturbance_t": navigator.filter.disturbance * MICROTESLA,
    }
