"""The graph of a whole log at an estimate: the inertial stream, and all measurements."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.batch.chain import Start
from magfusion.estimation.data_checks.detection import (
    DETECTION_CHI_SQUARE_ONLINE,
    above_noise,
    only,
)
from magfusion.estimation.demodulation.close_log import looked_at, without_silent
from magfusion.estimation.demodulation.demodulation import Demodulation
from magfusion.estimation.demodulation.motion_compensation import MotionCompensated
from magfusion.estimation.graph.drift_segments import segments_of
from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate
from magfusion.estimation.graph.imu_decimation import preintegrate_stream
from magfusion.estimation.graph.inertial import Link, Preintegrated, inertial_graph, links_between
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.preintegration import low_passed_rate_at
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.measurements.earth import earth_measurement, unobserved_constraints
from magfusion.estimation.measurements.fixed_roll import held_roll
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.model_error import epochs_sharing_error
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.measurements.pose_fix import pose_fixes
from magfusion.estimation.measurements.relative_pose import RelativePose
from magfusion.estimation.measurements.signs import with_signs
from magfusion.estimation.measurements.zero_rate import zero_rate
from magfusion.estimation.measurements.zero_velocity import zero_velocity
from magfusion.estimation.posterior.noise_tuning import Tuned, tune
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.one_axis import roll_is_open
from magfusion.model.parameters import Block, Calibration, corrected_imu, dimension, placed
from magfusion.model.samples import FieldSamples, ImuSamples, StaticFields
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class PreprocessedLog:
    """A log with an initial estimate."""

    demodulation: Demodulation
    samples: FieldSamples  # of the fields, before the motion is known
    static: StaticFields | None  # of the same epochs, where the Earth field is measured
    epoch: IntArray  # (n,), state index of each field epoch
    fixes: Fixes | None  # where they enter the graph instead of the phasors
    start: Start
    states: Trajectory  # initial estimate at all epochs
    declared: Calibration
    # blocks, considered: estimated and considered calibration parameters; with fixes the survey's
    # part is added at the end
    blocks: tuple[Block, ...]
    considered: tuple[Block, ...]
    loss: str | None  # of the fields: 'huber', 'cauchy' or None
    # further measurements, with the times of their rows (s)
    others: tuple[tuple[Array, Measurement], ...]
    # rival_chi_square, rival: as of `Smoothed`
    rival_chi_square: float | None = None
    rival: Trajectory | None = None
    # beginnings and ends of gaps in the inertial stream, filled by the motion from the fields (s)
    silence: tuple[Array, Array] | None = None
    user: UserFactors | None = None  # factors of a user's

    @property
    def imu(self) -> ImuSamples:
        """Inertial stream with its gaps filled."""
        return self.demodulation.log.imu

    def at_fields(self, states: Trajectory) -> Trajectory:
        """Return the states at the field epochs."""
        return states.rows(self.epoch)

    def measured_at(self, measurements: tuple[Measurement, ...]) -> IntArray:
        """Return the states at which fields were measured, in long windows or short ones."""
        short = [m.epoch for m in measurements if isinstance(m, JointPhasors)]
        return np.unique(np.concatenate([self.epoch, *short])) if short else self.epoch

    def compensated(self, calibration: Calibration, states: Trajectory) -> MotionCompensated:
        """Return motion-compensated phasors, by the stream that a calibration corrects.

        Includes those of beacons that the motion masked. `states`: at all epochs.
        """
        log = self.demodulation.log
        imu = calibration.on_log_rate(corrected_imu(calibration, self.blocks, self.imu))
        known = replace(self.demodulation, log=log if imu is log.imu else replace(log, imu=imu))
        path = None if known.close is None else states
        wave = known.compensated(calibration, self.at_fields(states), path)
        detected, hidden = self.samples.valid, self.demodulation.masked
        if hidden is not None and np.any(hidden):
            detected = detected | hidden & above_noise(wave.fields, DETECTION_CHI_SQUARE_ONLINE)
        return replace(wave, fields=only(wave.fields, detected))

    def with_signs(
        self, calibration: Calibration, states: Trajectory, *, first: bool
    ) -> MotionCompensated:
        """Return amplitudes with the signs predicted by states, as motion-compensated phasors."""
        here = self.at_fields(states)
        return MotionCompensated.of_slots(with_signs(self.samples, here, calibration, first=first))

    def rests(self, standing: BoolArray) -> Measurement:
        """Return the zero velocities of some epochs."""
        motion = self.declared.site.platform.motion
        return zero_velocity(np.flatnonzero(standing), motion.rest_speed_sigma)

    def zero_rates(
        self, standing: BoolArray, time: Array, calibration: Calibration
    ) -> list[Measurement]:
        """Return the gyro readings at the epochs of whole rests (s), if any."""
        chosen = np.flatnonzero(standing & self.samples.is_stationary(time))
        if not len(chosen) or not self.declared.site.platform.inertial:
            return []
        offset = calibration.imu_offset(time[chosen])
        noise = self.declared.site.platform.imu.gyro_noise
        within = self.samples.rest_about(time[chosen])
        result = zero_rate(chosen, time[chosen], within, self.imu, offset, noise)
        return [] if result is None else [result]


def graph_of(
    log: PreprocessedLog,
    states: Trajectory,
    calibration: Calibration,
    wave: MotionCompensated | None = None,
    standing: BoolArray | None = None,
    *,
    roughly: bool = False,
) -> tuple[Graph, int]:
    """Return the graph at an estimate, and the number of bridged intervals.

    `wave`: phasors compensated by an estimate; by default those of the log. `standing` (states,):
    where the platform is known to be at rest. `roughly`: whether another graph will follow, and
    this one does not determine the final noise: the sigmas of the inertial factors may then be a
    tenth off.
    """
    links, gap_bridged = _links(log, states, calibration, roughly=roughly)
    measurements = [_at_states(log, *other, states, calibration) for other in log.others]
    if roll_is_open(log.declared.site):
        measurements.append(held_roll(log.declared.site, states))
    if standing is not None and np.any(standing):
        measurements.append(log.rests(standing))
        measurements += log.zero_rates(standing, states.time, calibration)
    if log.fixes is not None:
        measurements.append(_fixes(log, log.fixes))
    else:
        measurements += _fields(log, states, calibration, wave, standing)
        measurements = _with_short(log, states, calibration, wave, standing, measurements)
    native = inertial_graph([link.measurement for link in links], log.declared.site.platform)
    acting = links if links[0].by_calibration is not None else ()
    segments = segments_of(states.time, log.declared, log.blocks)
    graph = Graph(
        native,
        tuple(measurements),
        log.declared,
        log.blocks,
        len(states),
        acting,
        segments,
        user=None if log.user is None else log.user.among(states.time),
    )
    return graph, gap_bridged


def _links(
    log: PreprocessedLog, states: Trajectory, calibration: Calibration, *, roughly: bool
) -> tuple[tuple[Link, ...], int]:
    """Return the inertial stream between the states, and the number of bridged intervals.

    Its derivatives are by the estimated parameters, then by the considered ones.
    """
    site, applied = log.declared.site, calibration
    accel, gyro = states.accel_bias_body, states.gyro_bias_body
    assert accel is not None
    assert gyro is not None
    blocks, gap_bridged = (*log.blocks, *placed(log.considered, dimension(log.blocks))), []

    def preintegrated(calibration: Calibration) -> list[Preintegrated]:
        imu = applied.on_log_rate(corrected_imu(calibration, blocks, log.imu))
        offset, model, gravity = applied.time_offset, site.platform.imu, site.gravity
        result, gaps = preintegrate_stream(
            imu, offset, states.time, model, gravity, accel, gyro, log.silence, roughly=roughly
        )
        gap_bridged.append(int(np.sum(gaps)))
        return result

    links = links_between(
        preintegrated, calibration, blocks, lambda _: initial_estimate(states, calibration).values
    )
    return tuple(links), gap_bridged[0]


def _at_states(
    log: PreprocessedLog,
    time: Array,
    measurement: Measurement,
    states: Trajectory,
    calibration: Calibration,
) -> Measurement:
    """Return a measurement at the states of its times (s)."""
    epoch = np.searchsorted(states.time, time)[measurement.epoch]
    if isinstance(measurement, RelativePose):
        assert states.accel_bias_body is not None
        assert states.gyro_bias_body is not None
        imu = calibration.on_log_rate(corrected_imu(calibration, log.blocks, log.imu))
        bias = np.hstack([states.accel_bias_body, states.gyro_bias_body])[epoch]
        offset, site, end = calibration.time_offset, log.declared.site, states.time[epoch]
        measurement = measurement.over_interval(imu, offset, end, bias, site)
    return replace(measurement, epoch=epoch)


def _fixes(log: PreprocessedLog, fixes: Fixes) -> Measurement:
    """Return the fixes of the start as pose measurements."""
    cov = fixes.pose_cov[np.arange(len(fixes)), log.start.chosen] * overlap(log.samples)
    return replace(pose_fixes(replace(log.start.states, pose_cov=cov), log.loss), epoch=log.epoch)


def _fields(
    log: PreprocessedLog,
    states: Trajectory,
    calibration: Calibration,
    wave: MotionCompensated | None,
    standing: BoolArray | None,
) -> list[Measurement]:
    """Return the phasors, and the Earth field where measured."""
    samples = log.samples if wave is None else wave.fields
    here, site = log.at_fields(states), calibration.site
    if not samples.signed:
        samples = with_signs(samples, here, calibration, every=wave is None)
    assert here.gyro_bias_body is not None
    imu = calibration.on_log_rate(corrected_imu(calibration, log.blocks, log.imu))
    rate_body = low_passed_rate_at(imu, calibration.time_offset, samples.time)
    rate_body -= here.gyro_bias_body
    offset = calibration.imu_offset(samples.time)
    by_offset = None if wave is None else wave.by_time_offset
    phasors = field_phasors(
        site,
        samples,
        log.epoch,
        here,
        rate_body,
        offset,
        overlap(samples),
        by_offset,
        standing=None if standing is None else standing[log.epoch],
        others=False,  # its modes are considered
    )
    out: list[Measurement] = [replace(phasors, robust=log.loss)]
    if log.static is not None:
        static, step = log.static if wave is None else wave.static, _step(samples)
        out.append(earth_measurement(site, static, log.epoch, rate_body, offset, step))
        detected = np.any(samples.valid, axis=1)
        out += unobserved_constraints(
            states, log.epoch, detected, step, log.declared.site.platform.motion
        )
    return out


def _with_short(
    log: PreprocessedLog,
    states: Trajectory,
    calibration: Calibration,
    wave: MotionCompensated | None,
    standing: BoolArray | None,
    measurements: list[Measurement],
) -> list[Measurement]:
    """Return measurements with those of short windows, where tones are closely spaced."""
    close = log.demodulation.close
    if close is None or wave is None or wave.unexplained_sensor is None:
        return measurements
    assert wave.wanted is not None
    imu = calibration.on_log_rate(corrected_imu(calibration, log.blocks, log.imu))
    remaining, nodes = wave.unexplained_sensor, wave.wanted
    joint = close.measured(remaining, nodes, states, calibration, imu, standing)
    joint = without_silent(joint, wave.fields, log.at_fields(states), calibration)
    length = float(np.median(wave.fields.window))
    out = [looked_at(m, joint, length) if isinstance(m, FieldPhasors) else m for m in measurements]
    return [*out, replace(joint, robust=log.loss)]


def overlap(samples: FieldSamples) -> float:
    """Return the number of windows that contain each sample, whose information counts once."""
    if samples.magnetometers:
        names = dict.fromkeys(samples.magnetometers)
        each = [samples.of_magnetometer(name) for name in names]
        return max((overlap(own) for own in each if len(own) > 1), default=1.0)
    if samples.of_rests:
        return 1.0
    return max(1.0, float(np.median(samples.window)) / _step(samples))


def _step(samples: FieldSamples) -> float:
    return float(np.median(np.diff(samples.time)))


def noise_of(
    log: PreprocessedLog,
    graph: Graph,
    estimate: GraphEstimate,
    states: Trajectory,
    wave: MotionCompensated | None,
    declared: Site,
) -> tuple[Tuned, ...]:
    """Return the noise of a log from its solved graph and phasors; see `tune`."""
    samples, here = log.samples if wave is None else wave.fields, log.at_fields(states)
    shared = epochs_sharing_error(here.position_world, declared.model_error_length)
    blind = log.demodulation.blind
    windows, fixed = overlap(samples), log.considered
    return tune(graph, estimate, samples, here, declared, windows, shared, blind, fixed)
