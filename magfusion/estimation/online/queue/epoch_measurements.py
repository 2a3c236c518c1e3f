"""The measurements of one epoch of a running estimate."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.preintegration import RATE_SPAN, inertial_at
from magfusion.estimation.graph.state import VELOCITY, State, as_trajectory
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.measurements.earth import EarthField, earth_measurement
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.model_error import epochs_sharing_error_at
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.measurements.relative_pose import RelativePose
from magfusion.estimation.measurements.zero_velocity import REACH, may_stand, quiet_before
from magfusion.estimation.online.queue.inertial_stream import InertialStream
from magfusion.model.parameters import Block, corrected_imu
from magfusion.model.samples import FieldSamples, StaticFields
from magfusion.model.site import Site
from magfusion.units import ComplexArray


@dataclass(frozen=True, eq=False)
class EpochMeasurements:
    """Measurements of one epoch."""

    # without undetected beacons; as predicted where tones are only measured jointly
    samples: FieldSamples
    phasors: FieldPhasors | JointPhasors  # the phasors as a measurement
    earth: EarthField | None  # the static field as a measurement, if it is one
    static: StaticFields | None  # the measured static field, where there is a waveform
    repeats: float  # number of epochs that contain each sample of overlapping windows

    @property
    def is_sequential(self) -> bool:
        """Whether each phasor was measured separately."""
        return isinstance(self.phasors, FieldPhasors)

    @property
    def detected(self) -> tuple[str, ...]:
        """Detected beacons."""
        channels = zip(self.samples.channels, self.samples.valid[0], strict=True)
        return tuple(dict.fromkeys(name for (name, _), valid in channels if valid))


def measurements_of_fields(
    predicted: State,
    samples: FieldSamples,
    static: StaticFields | None,
    imu: InertialStream,
    step: float,
    repeats: float,
    by_time_offset: ComplexArray | None,
    *,
    earth: bool,
    standing: bool,
) -> EpochMeasurements:
    """Return the fields of one epoch as measurements at a prediction.

    Parameters
    ----------
    step : float
        Since fields were last measured (s).
    repeats : float
        Number of epochs that contain each sample of overlapping windows.
    by_time_offset : complex ndarray, optional
        Derivative of the phasors by the IMU's time offset, as of `field_phasors`.
    earth : bool
        Whether a static field is a measurement.
    standing : bool
        Whether the platform is known to be stationary.
    """
    now, offset = np.zeros(1, dtype=np.int64), np.full(1, imu.offset)
    rate_body = (imu.rate_body(predicted.time) - predicted.gyro_bias_body)[None]
    site = predicted.calibration.site
    phasors = field_phasors(
        site,
        samples,
        now,
        as_trajectory([predicted]),
        rate_body,
        offset,
        repeats,
        by_time_offset,
        epochs_sharing_error_at(predicted, step),
        np.array([standing]),
    )
    field = None
    if earth and static is not None:
        field = earth_measurement(site, static, now, rate_body, offset, step)
    return EpochMeasurements(samples, phasors, field, static, repeats)


def with_inertial(
    measurement: Measurement,
    state: State,
    site: Site,
    blocks: tuple[Block, ...],
    imu: InertialStream,
) -> Measurement:
    """Return a measurement with the inertial samples that it needs at a predicted state."""
    if not isinstance(measurement, AidingMeasurement):
        return measurement
    time, offset = state.time, imu.offset
    stamp = time - offset
    if isinstance(measurement, RelativePose):
        begin = stamp - float(measurement.interval[0])
        samples = imu.measured(begin - RATE_SPAN, stamp + RATE_SPAN)
        samples = corrected_imu(state.calibration, blocks, samples)
        bias = np.hstack([state.accel_bias_body, state.gyro_bias_body])[None]
        measurement = measurement.over_interval(
            samples, offset, np.array([time]), bias, site, imu.usual
        )
    samples = imu.measured(stamp - RATE_SPAN, stamp + RATE_SPAN)
    if not len(samples):
        return measurement
    return measurement.with_inertial(inertial_at(samples, offset, np.array([time])))


def is_stationary(state: State, imu: InertialStream) -> bool:
    """Return whether the platform is stationary, as far as is known."""
    stamp = state.time - imu.offset
    motion = state.calibration.site.platform.motion
    if not may_stand(state.velocity_world, state.cov[VELOCITY, VELOCITY], motion):
        return False
    samples = imu.measured(stamp - motion.rest_span - REACH, stamp + REACH)
    return bool(quiet_before(samples, np.array([stamp]), motion)[0])
