"""Motion prior in place of an IMU.

White acceleration, and a rate that walks by white angular acceleration, equal an inertial sensor
with particular noise.  It measures zeros, its accelerometer noise is the acceleration, and its
gyro bias, a random walk, is the negative rate of the platform.  The estimators process such samples
as any others, in batch, window and filter, with the same factors.
"""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.one_axis import axis_of
from magfusion.model.platform_motion import HeldModel, ImuModel, MotionPrior, Replaced
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site

STEPS = 4  # least samples between two epochs: rate noise within a step is neglected
MAX_STEP = 0.02  # s
# Negligible noise that keeps factors regular: rad/s/sqrt(Hz), m/s^2 and the latter per root s.
MIN_GYRO, MIN_ACCEL = 1e-4, 1e-4
EXAMPLE = "{accel_density_m_s2_rthz: 2, angular_accel_density_rad_s2_rthz: 3}"


def on_motion_prior(site: Site) -> Site:
    """Return a site whose motion prior replaces IMU, gravity and rest detection.

    A site without a motion prior gets that of a hand.
    """
    if not site.platform.inertial:
        return site
    prior = site.platform.motion_prior or MotionPrior()
    imu = ImuModel(
        gyro_noise=MIN_GYRO,
        accel_noise=prior.accel_density,
        gyro_bias_walk=prior.angular_accel_density,
        accel_bias_walk=MIN_ACCEL,
        gyro_bias_sigma=prior.rate_sigma,
        accel_bias_sigma=MIN_ACCEL,
        time_offset_sigma=0.0,
        clock_rate_sigma=0.0,
    )
    axis = _unobservable_axis(site)
    if axis is not None:
        imu = HeldModel(**vars(imu), held_axis=axis)
    platform, motion = site.platform, site.platform.motion
    never = replace(motion, rest_gyro=0.0, rest_accel=0.0)  # zeros must not be detected as rest
    replaced = Replaced(platform.imu, motion, site.gravity)
    return replace(
        site, gravity=0.0, platform=replace(platform, imu=imu, motion=never, replaced=replaced)
    )


def _unobservable_axis(site: Site) -> tuple[float, float, float] | None:
    """Return the axis of the coil with unobservable roll; None if there are more axes."""
    platform = site.platform
    if platform.further or len(platform.magnetometer.axes) != 1:
        return None
    x, y, z = axis_of(platform.magnetometer).tolist()
    return x, y, z


def as_declared(site: Site) -> Site:
    """Return a site with the replaced parts restored, and the estimated densities."""
    platform, replaced = site.platform, site.platform.replaced
    if replaced is None:
        return site
    prior = platform.motion_prior
    if prior is not None:
        result = platform.imu.accel_noise, platform.imu.gyro_bias_walk
        prior = MotionPrior(*result, prior.rate_sigma)
    return replace(
        site,
        gravity=replaced.gravity,
        platform=replace(
            platform, imu=replaced.imu, motion=replaced.motion, motion_prior=prior, replaced=None
        ),
    )


def without_imu(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log without inertial samples, and its site, prepared for the estimators.

    Samples of zeros cover the log, for the accelerometer of `on_motion_prior`.
    """
    times = [
        s.time
        for s in (log.waveform, log.fields, *log.waveforms.values())
        if s is not None and len(s)
    ]
    first, last = min(float(t[0]) for t in times), max(float(t[-1]) for t in times)
    step, length = MAX_STEP, 0.0
    if log.fields is not None and len(log.fields) > 1:
        step = min(step, float(np.median(np.diff(log.fields.time))) / STEPS)
        length = float(np.max(log.fields.window))
    time = np.arange(first - length - step, last + length + 2.0 * step, step)
    zero = np.zeros((len(time), 3))
    samples = ImuSamples(time, zero, zero.copy())
    return replace(log, imu=samples, inertial=False), on_motion_prior(site)


def logged(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log and its site as the estimators use them.

    As `without_imu` if the log has no inertial samples; otherwise these are corrected by the
    declared `ImuIntrinsics`.  The magnetometer's stamps are corrected by the declared rate and
    offset of its clock.  A corrected log can be corrected again, by the same or another site.
    """
    log = _on_clock(log, *site.platform.log_clock)
    if site.platform.magnetometer.ac_coupled and log.waveform is not None:
        log = replace(log, waveform=replace(log.waveform, ac_coupled=True))
    if not len(log.imu):
        return without_imu(log, site)
    recorded = log.imu if log.recorded_imu is None else log.recorded_imu
    if site.platform.imu_intrinsics is None or not log.inertial:
        return replace(log, imu=recorded, recorded_imu=None), site
    samples = site.platform.corrected_imu(recorded.gyro_body, recorded.accel_body)
    return replace(log, imu=ImuSamples(recorded.time, *samples), recorded_imu=recorded), site


def as_recorded(log: Log) -> Log:
    """Return a log with its samples and stamps as recorded."""
    log = _on_clock(log, 0.0, 0.0)
    recorded = log.imu if log.recorded_imu is None else log.recorded_imu
    return replace(log, imu=recorded, recorded_imu=None)


def _on_clock(log: Log, rate: float, offset: float) -> Log:
    """Return a log whose magnetometer's stamps are corrected by a rate and an offset (s)."""
    wave = log.waveform
    if wave is None or (rate, offset) == (log.clock_rate, log.clock_offset):
        return log
    time = (wave.time - log.clock_offset) * ((1.0 + rate) / (1.0 + log.clock_rate)) + offset
    marks = None if wave.marks is None else wave.marks.on_clock(wave.time, time)
    wave = replace(wave, time=time, marks=marks)
    return replace(log, waveform=wave, clock_rate=rate, clock_offset=offset)


def require_motion_prior(site: Site) -> None:
    """Reject a site without a motion prior."""
    if not site.platform.inertial and site.platform.motion_prior is None:
        raise InputError(
            "has no inertial samples (imu.parquet), and its site has no platform.motion_prior;"
            " record the IMU, or declare the motion of the platform, e.g. that of a hand:"
            f" motion_prior: {EXAMPLE}"
        )
