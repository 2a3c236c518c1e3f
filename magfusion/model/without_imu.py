"""A motion prior in the place of an IMU.

White acceleration, and a rate that walks by white angular acceleration, are what an inertial sensor
of a particular kind would tell: it measures nothing but zeros where nothing pulls, with so much
noise of its accelerometer, and its gyro's bias, which walks, is the rate of the platform reversed.
The estimators take such samples as any others, in batch, window and filter, with the same factors.
"""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.one_axis import axis_of
from magfusion.model.platform_motion import HeldModel, ImuModel, MotionPrior, Replaced
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site

STEPS = 4  # samples at least between two epochs: within a step the noise of the rate is none
LONGEST_STEP = 0.02  # s
# What a factor needs to be regular, and nobody notices: rad/s/sqrt(Hz), m/s^2 and that per root s.
LEAST_GYRO, LEAST_ACCEL = 1e-4, 1e-4
EXAMPLE = "{accel_density_m_s2_rthz: 2, angular_accel_density_rad_s2_rthz: 3}"


def on_motion_prior(site: Site) -> Site:
    """Return a site whose motion prior has taken the place of IMU, gravity and rest.

    That of a hand where the site declares none.
    """
    if not site.platform.inertial:
        return site
    prior = site.platform.motion_prior or MotionPrior()
    imu = ImuModel(
        gyro_noise=LEAST_GYRO,
        accel_noise=prior.accel_density,
        gyro_bias_walk=prior.angular_accel_density,
        accel_bias_walk=LEAST_ACCEL,
        gyro_bias_sigma=prior.rate_sigma,
        accel_bias_sigma=LEAST_ACCEL,
        time_offset_sigma=0.0,
        clock_rate_sigma=0.0,
    )
    axis = _held(site)
    if axis is not None:
        imu = HeldModel(**vars(imu), held_axis=axis)
    platform, motion = site.platform, site.platform.motion
    never = replace(motion, rest_gyro=0.0, rest_accel=0.0)  # zeros must not pass for rest
    replaced = Replaced(platform.imu, motion, site.gravity)
    return replace(
        site,
        gravity=0.0,
        platform=replace(platform, imu=imu, motion=never, replaced=replaced),
    )


def _held(site: Site) -> tuple[float, float, float] | None:
    """Return the coil about which nothing tells a turn; None where there are more axes."""
    platform = site.platform
    if platform.further or len(platform.magnetometer.axes) != 1:
        return None
    x, y, z = axis_of(platform.magnetometer).tolist()
    return x, y, z


def as_declared(site: Site) -> Site:
    """Return a site with what its motion prior had replaced, and the densities that were found."""
    platform, replaced = site.platform, site.platform.replaced
    if replaced is None:
        return site
    prior = platform.motion_prior
    if prior is not None:
        found = platform.imu.accel_noise, platform.imu.gyro_bias_walk
        prior = MotionPrior(*found, prior.rate_sigma)
    return replace(
        site,
        gravity=replaced.gravity,
        platform=replace(
            platform,
            imu=replaced.imu,
            motion=replaced.motion,
            motion_prior=prior,
            replaced=None,
        ),
    )


def without_imu(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log that has no inertial samples, and its site, as the estimators take them.

    Samples of zeros cover the log: the accelerometer of `on_motion_prior` measures no more.
    """
    times = [
        s.time
        for s in (log.waveform, log.fields, *log.waveforms.values())
        if s is not None and len(s)
    ]
    first, last = min(float(t[0]) for t in times), max(float(t[-1]) for t in times)
    step, length = LONGEST_STEP, 0.0
    if log.fields is not None and len(log.fields) > 1:
        step = min(step, float(np.median(np.diff(log.fields.time))) / STEPS)
        length = float(np.max(log.fields.window))
    time = np.arange(first - length - step, last + length + 2.0 * step, step)
    zero = np.zeros((len(time), 3))
    samples = ImuSamples(time, zero, zero.copy())
    return replace(log, imu=samples, inertial=False), on_motion_prior(site)


def logged(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log and its site as they are, or as `without_imu` where it has no samples."""
    return (log, site) if len(log.imu) else without_imu(log, site)


def require_motion_prior(site: Site) -> None:
    """Refuse a site that says too little of the motion that no IMU measures.

    Raises
    ------
    InputError
    """
    if not site.platform.inertial and site.platform.motion_prior is None:
        raise InputError(
            "holds no inertial samples (imu.parquet), and its site no platform.motion_prior to"
            " smooth by; record the IMU, or declare how the platform moves:"
            f" motion_prior: {EXAMPLE} is a hand's"
        )
