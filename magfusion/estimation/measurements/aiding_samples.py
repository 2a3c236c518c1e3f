"""Samples of a site's aiding sensors as measurements."""

from collections.abc import Mapping

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.graph.preintegration import inertial_at
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.measurements.body_velocity import BodyVelocity
from magfusion.estimation.measurements.heading import Heading
from magfusion.estimation.measurements.height import Height
from magfusion.estimation.measurements.point_position import PointPosition
from magfusion.estimation.measurements.point_range import PointRange
from magfusion.estimation.measurements.relative_pose import RelativePose, relative_pose
from magfusion.model.aiding import (
    MAX_INTERVAL,
    AidingSamples,
    AidingSensor,
    Quantity,
    check_marks,
    sensor_named,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray

MEASUREMENTS: dict[Quantity, type[AidingMeasurement]] = {
    "velocity": BodyVelocity,
    "range": PointRange,
    "position": PointPosition,
    "mark": PointPosition,
    "height": Height,
    "pressure": Height,
    "heading": Heading,
    "relative_pose": RelativePose,
}


def aiding_measurement(
    sensor: AidingSensor, samples: AidingSamples, robust: str | None = None
) -> AidingMeasurement:
    """Return samples of a sensor as a measurement, one row each.

    Raises InputError if a mark is none of the site's.
    """
    if sensor.quantity == "relative_pose":
        return relative_pose(sensor, samples, robust)
    own = _on_marks(sensor, samples) if sensor.quantity == "mark" else samples.value
    value = sensor.in_si(own)
    missing = np.isnan(value)
    speed = np.sqrt(np.nansum(value**2, axis=1))
    noise = np.hypot(sensor.sigma, sensor.relative_sigma * speed)
    unmeasured = np.inf if sensor.constraint_sigma is None else sensor.constraint_sigma
    return MEASUREMENTS[sensor.quantity](
        epoch=np.arange(len(samples)),
        sensor=sensor.name,
        robust=robust,
        value=np.where(missing, 0.0, value),
        sigma=np.where(missing, unmeasured, noise[:, None]),
        time_offset=np.full(len(samples), float(sensor.time_offset)),
        inertial_body=np.zeros((len(samples), 6)),
    )


def measured_time(sensor: AidingSensor, samples: AidingSamples) -> Array:
    """Return when samples were measured, on the log's clock (s)."""
    return samples.time + float(sensor.time_offset)


def thinned(sensor: AidingSensor, samples: AidingSamples, last: float) -> AidingSamples:
    """Return the samples that are used: the first of each period of the sensor's rate.

    `last`: time of the last one before them (s), or minus infinity.
    """
    period = np.floor(samples.time * sensor.rate_hz * (1.0 + 1e-9))
    before = np.floor(last * sensor.rate_hz * (1.0 + 1e-9))
    return samples.rows(np.diff(period, prepend=before) > 0.0)


def aiding_measurements(
    aiding: Mapping[str, AidingSamples],
    site: Site,
    imu: ImuSamples,
    span: tuple[float, float],
    robust: str | None,
) -> tuple[tuple[Array, AidingMeasurement], ...]:
    """Return the samples of a log as measurements, with the times of their rows (s).

    `imu`: its stamps on the log's clock. `span`: first and last time of the states (s); samples
    outside are left out. Raises InputError if no interval of a relative pose can be used.
    """
    out = []
    for name, every in aiding.items():
        sensor = sensor_named(site.aiding, name, every.quantity)
        samples = thinned(sensor, every, -np.inf)
        time = measured_time(sensor, samples)
        inside = (time >= span[0]) & (time <= span[1])
        samples, time = samples.rows(inside), time[inside]
        if len(time) and sensor.quantity == "relative_pose":
            there = _has_inertial(sensor, samples, time, site, imu)
            samples, time = samples.rows(there), time[there]
        if len(time):
            measurement = aiding_measurement(sensor, samples, robust)
            out.append((time, measurement.with_inertial(inertial_at(imu, 0.0, time))))
    return tuple(out)


def _has_inertial(
    sensor: AidingSensor, samples: AidingSamples, time: Array, site: Site, imu: ImuSamples
) -> BoolArray:
    """Return which intervals have all their inertial samples; refuse a log without any."""
    whole = relative_pose(sensor, samples).over_interval(
        imu, 0.0, time, np.zeros((len(time), 6)), site
    )
    there = np.isfinite(whole.sigma[:, 0])
    if not there.any():
        raise InputError(
            f"{sensor.name}: none of its {len(time)} intervals has at most {MAX_INTERVAL:g} s"
            " and all its inertial samples; give poses relative to a nearer keyframe"
        )
    return np.asarray(there)


def _on_marks(sensor: AidingSensor, samples: AidingSamples) -> Array:
    check_marks(sensor, samples)
    return np.array([sensor.marks_world[mark] for mark in samples.marks]).reshape(-1, 3)
