"""A log with gaps in its inertial stream, bridged by the motion estimated from the fields.

Windows that overlap a gap are not used for a start.  Once the states next to the gap are known, the
motion through it is tracked by the magnetometer's samples.  Its windows are then used like others,
with a larger uncertainty of the motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from magfusion.estimation.batch.log_graph import PreprocessedLog, graph_of
from magfusion.estimation.data_checks.detection import masked_phasors, only, without_silence
from magfusion.estimation.demodulation.motion_compensation import noisier
from magfusion.estimation.demodulation.motion_from_field import motion_from_field
from magfusion.estimation.graph.graph import initial_estimate, read_states
from magfusion.estimation.graph.state import State
from magfusion.estimation.solve.bordered import optimise
from magfusion.model.parameters import Calibration
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.admission import INERTIAL_GAP, Windows, longest_step, silences, usual_step
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.turn import on_clock
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.estimation.demodulation.motion_from_field import FieldMotion

MAX_GAP = 120.0  # s; maximum gap that is tracked without an IMU
# One sigma of the states before a gap; the fields correct them within a few samples.
FIRST = np.repeat([0.05, 0.1, 1.0, 0.01, 0.1], 3)  # rad, m, m/s, rad/s, m/s^2


def bridge_gaps(log: PreprocessedLog) -> PreprocessedLog:
    """Return the log with windows in the gaps of its inertial stream, where fields allow.

    Unchanged where there are none. Raises EstimationError where the graph cannot be solved.
    """
    source = log.demodulation
    if log.fixes is not None or not len(source.without_turn):
        return log
    if log.declared.site.platform.magnetometer.lacking:
        return log  # fewer components than three do not determine a rotation
    graph, _ = graph_of(log, log.states, log.declared)
    result = optimise(graph, initial_estimate(log.states, log.declared)).estimate
    states, calibration = read_states(result.values, log.states.time), result.calibration
    gaps = _followed(log, states, calibration)
    if not gaps:
        return log
    begin, end = (np.array(edge) for edge in zip(*[gap[:2] for gap in gaps], strict=True))
    windows = _within(log, gaps)
    if not len(windows):
        return log
    imu = _filled(source.log.imu, calibration, gaps)
    return _with_windows(
        replace(log, silence=(begin, end)), windows, imu, states, calibration, [g[2] for g in gaps]
    )


Gap = tuple[float, float, "FieldMotion"]


def _followed(log: PreprocessedLog, states: Trajectory, calibration: Calibration) -> list[Gap]:
    """Return the gaps through which the motion was tracked, with their beginnings and ends."""
    source = log.demodulation
    receiver, waveform = source.receiver, source.log.waveform
    assert isinstance(receiver, LockinReceiver)
    assert waveform is not None
    window = receiver.settings.window
    imu = on_clock(calibration.on_log_rate(source.log.imu), calibration.time_offset)
    step = usual_step(imu.time, "imu")
    begin, end = silences(imu.time, step, 0.0)
    gaps: list[Gap] = []
    for first, last in zip(begin[:-1].tolist(), end[:-1].tolist(), strict=True):
        known = int(np.searchsorted(states.time, first - 0.5 * window)) - 1
        if known < 0 or last - first > MAX_GAP:
            continue
        start = _state(states, known, calibration)
        inside = (waveform.time > start.time) & (waveform.time < last + window)
        part = waveform.rows(inside)
        near = (imu.time > start.time - window) & (imu.time < last + 2.0 * window)
        detected = ImuSamples(imu.time[near], imu.gyro_body[near], imu.accel_body[near])
        motion = motion_from_field(start, part, detected, longest_step(step))
        if motion is not None:
            gaps.append((first, last, motion))
    return gaps


def _state(states: Trajectory, row: int, calibration: Calibration) -> State:
    rest = (states.velocity_world, states.accel_bias_body, states.gyro_bias_body)
    velocity, accel, gyro = (np.zeros(3) if v is None else v[row] for v in rest)
    pose = states.world_from_body[row], states.position_world[row]
    time = float(states.time[row])
    return State(time, *pose, velocity, accel, gyro, calibration, np.diag(FIRST**2))


def _within(log: PreprocessedLog, gaps: list[Gap]) -> Windows:
    """Return the windows without inertial samples only where the motion was tracked."""
    source = log.demodulation
    assert isinstance(source.receiver, LockinReceiver)
    windows, half = source.without_turn, source.receiver.settings.window / 2.0
    whole = np.zeros(len(windows), dtype=bool)
    for first, last, motion in gaps:
        path = motion.path.time
        inside = (windows.centre - half > path[0]) & (windows.centre + half < path[-1])
        whole |= inside & (windows.centre + half > first) & (windows.centre - half < last)
    return windows.rows(whole)


def _filled(imu: ImuSamples, calibration: Calibration, gaps: list[Gap]) -> ImuSamples:
    """Return an inertial stream with samples in its gaps, on its own clock."""
    half = 0.5 * usual_step(imu.time, "imu")
    time, gyro, accel = [imu.time], [imu.gyro_body], [imu.accel_body]
    rate, offset = calibration.clock_rate, calibration.time_offset
    for first, last, motion in gaps:
        built = motion.imu
        inside = (built.time > first + half) & (built.time < last - half)
        run = built.time[inside] - offset - calibration.imu_begin
        time.append(calibration.imu_begin + run / (1.0 + rate))
        gyro.append(built.gyro_body[inside])
        accel.append(built.accel_body[inside])
    stamps, row = np.unique(np.concatenate(time), return_index=True)
    return ImuSamples(stamps, np.concatenate(gyro)[row], np.concatenate(accel)[row])


def _with_windows(
    log: PreprocessedLog,
    windows: Windows,
    imu: ImuSamples,
    states: Trajectory,
    calibration: Calibration,
    motions: list[FieldMotion],
) -> PreprocessedLog:
    source = log.demodulation
    receiver, waveform = source.receiver, source.log.waveform
    assert isinstance(receiver, LockinReceiver)
    assert waveform is not None
    assert source.windows is not None
    known = on_clock(calibration.on_log_rate(imu), calibration.time_offset)
    fields, _ = receiver.phasors(waveform, known, windows, calibration.site)
    time = np.union1d(states.time, windows.centre)
    whole = _with_paths(states, motions, time)
    epoch = np.searchsorted(time, windows.centre)
    there = Trajectory(windows.centre, whole.world_from_body[epoch], whole.position_world[epoch])
    blind, length = np.ones(len(windows), dtype=bool), receiver.settings.window
    fields = noisier(fields, blind, there, calibration, length)
    joined = FieldSamples.joined([source.fields, fields])
    order = np.argsort(joined.time)
    added = np.concatenate([np.zeros(len(source.fields), dtype=bool), blind])[order]
    joined = joined.rows(order)
    detected, hidden = without_silence(joined).valid, masked_phasors(joined)
    detected[~added], hidden[~added] = log.samples.valid, source.masked
    samples = only(joined, detected)
    dropped = dict(source.dropped)
    dropped[INERTIAL_GAP] -= len(windows)
    demodulation = replace(
        source,
        log=replace(source.log, imu=imu),
        fields=samples,
        windows=source.windows.joined(windows),
        masked=hidden,
        blind=added,
        dropped={reason: count for reason, count in dropped.items() if count},
    )
    static = None if log.static is None else demodulation.static(calibration)
    return replace(
        log,
        demodulation=demodulation,
        samples=samples,
        static=static,
        epoch=np.searchsorted(time, samples.time),
        states=whole,
    )


def _with_paths(states: Trajectory, motions: list[FieldMotion], time: Array) -> Trajectory:
    """Return states at more times (s), those in gaps from the tracked motion."""
    old = np.searchsorted(time, states.time)
    turn, place, speed = np.tile(np.eye(3), (len(time), 1, 1)), *np.zeros((2, len(time), 3))
    for path in (motion.path for motion in motions):
        assert path.velocity_world is not None
        rows = np.flatnonzero((time >= path.time[0]) & (time <= path.time[-1]))
        attitude = Slerp(path.time, Rotation.from_matrix(path.world_from_body))
        turn[rows] = attitude(time[rows]).as_matrix()
        for out, known in ((place, path.position_world), (speed, path.velocity_world)):
            out[rows] = np.stack([np.interp(time[rows], path.time, k) for k in known.T], axis=1)
    assert states.velocity_world is not None
    assert states.gyro_bias_body is not None
    assert states.accel_bias_body is not None
    turn[old], place[old] = states.world_from_body, states.position_world
    speed[old] = states.velocity_world
    biases = [
        np.stack([np.interp(time, states.time, axis) for axis in bias.T], axis=1)
        for bias in (states.gyro_bias_body, states.accel_bias_body)
    ]
    return Trajectory(time, turn, place, speed, *biases)
