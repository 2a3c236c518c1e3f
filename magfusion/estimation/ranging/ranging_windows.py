"""Windows of a log of a passing magnet: phasors by its angle, depths, and the high side."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.ranging.ranging_data import WITHIN, RangingWindows
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.receiver.rotor import demodulate_rotor
from magfusion.receiver.rotor_phase import followed_angle
from magfusion.units import Array

SENSOR = "magnetometer"  # as a part of the table of depths
UPRIGHT = 0.05  # of gravity across the hole; below, it has no high side
MIN_WINDOWS = 8
PAUSE = 2.0  # s; without samples, after which angle tracking restarts


@dataclass(frozen=True, eq=False)
class DepthErrors:
    """Errors of depths."""

    sigma: float = 0.01  # of the depth of a window (m)
    scale_sigma: float = 1e-3  # of all, relative: stretch of the string


@dataclass(frozen=True, eq=False)
class RangingLog:
    """Ranging data of a log."""

    windows: RangingWindows
    speed_hz: Array  # (n,), rotation rate of the magnet in each window
    # whether gravity determines it; otherwise directions are from the sensor's own third axis
    high_side: bool
    inclination: float | None  # of the sensor's hole from the vertical, downwards (rad)
    dropped: int  # windows that could not be demodulated


def the_rotor(site: Site) -> Beacon:
    """Return the only beacon of a site for ranging.

    Raises InputError where there is another beacon, or the only one is no magnet on a shaft.
    """
    if len(site.beacons) != 1 or site.beacons[0].rotor is None:
        raise InputError("beacons: ranging needs exactly one beacon with rotor; declare it")
    return site.beacons[0]


def ranging_log(
    log: Log, site: Site, window: float, mains_hz: float = 50.0, errors: DepthErrors = DepthErrors()
) -> RangingLog:
    """Return the windows of a log.

    Raises InputError where it lacks the waveform or the depths of the magnet, an angle names
    another beacon, the magnet cannot be distinguished from noise, or too few windows can be
    demodulated.
    """
    beacon = the_rotor(site)
    if log.waveform is None:
        raise InputError("has no magnetometer.parquet; ranging needs the raw waveform")
    known = None if log.depths is None else log.depths.readings.get(beacon.name)
    if log.depths is None or known is None:
        raise InputError(
            f"depth.parquet: has no rows of {beacon.name}; give the measured depth of the magnet"
            " (time_ns, part, depth_m)"
        )
    angle, measured = _angle(log, beacon)
    result = demodulate_rotor(log.waveform, angle, beacon, site, window, mains_hz)
    fields = result.fields
    inside = (fields.time - 0.5 * window >= known[0, 0] - 1.0) & (
        fields.time + 0.5 * window <= known[0, -1] + 1.0
    )
    fields, speed = fields.rows(inside), result.speed_hz[inside]
    if len(fields) < MIN_WINDOWS:
        raise InputError(
            f"only {len(fields)} windows of {window:g} s have samples, depths and a rotating"
            f" magnet, but ranging needs {MIN_WINDOWS}; record a longer pass, or use a shorter"
            " --window"
        )
    at = fields.time[:, None] + window * WITHIN
    magnet, sensor = log.depths.at(beacon.name, at), log.depths.at(SENSOR, fields.time)
    assert magnet is not None
    if sensor is None:
        sensor = np.zeros(len(fields))
    magnet_from, sensor_from = float(np.median(magnet)), float(sensor[0])
    roll, inclination = _high_side(log, site, fields.time, window)
    return RangingLog(
        windows=RangingWindows(
            fields=fields,
            angle_known=measured,
            magnet=magnet - magnet_from,
            sensor=sensor - sensor_from,
            roll=np.zeros(len(fields)) if roll is None else roll,
            magnet_from=magnet_from,
            sensor_from=sensor_from,
            depth_sigma=errors.sigma,
            depth_scale_sigma=errors.scale_sigma,
        ),
        speed_hz=speed,
        high_side=roll is not None,
        inclination=inclination,
        dropped=result.dropped,
    )


def _angle(log: Log, beacon: Beacon) -> tuple[Array, bool]:
    """Return the angle of the shaft at each sample (rad), and whether it was measured."""
    waveform, rotation, rotor = log.waveform, log.rotation, beacon.rotor
    assert waveform is not None
    assert rotor is not None
    if rotation is None:
        return _followed(log, beacon), False
    if beacon.name not in rotation.angle:
        names = ", ".join(f"rotor_{name}" for name in rotation.angle)
        raise InputError(f"{names}: the site's rotor is {beacon.name}; rename the column to match")
    whole = np.unwrap(rotation.angle[beacon.name])
    angle = np.interp(waveform.time, rotation.time, whole, np.nan, np.nan)
    step = float(np.median(np.diff(waveform.time)))
    before = np.searchsorted(rotation.time, waveform.time, side="right") - 1
    near = np.minimum(before + 1, len(rotation.time) - 1)
    angle[rotation.time[near] - rotation.time[np.maximum(before, 0)] > 5.0 * step] = np.nan
    return angle, True


def _followed(log: Log, beacon: Beacon) -> Array:
    waveform, rotor = log.waveform, beacon.rotor
    assert waveform is not None
    assert rotor is not None
    cuts = np.flatnonzero(np.diff(waveform.time) > PAUSE) + 1
    parts = []
    for rows in np.split(np.arange(len(waveform)), cuts):
        own = replace(
            waveform, time=waveform.time[rows], measured_sensor=waveform.measured_sensor[rows]
        )
        parts.append(followed_angle(own, beacon.frequency_hz, rotor))
    return np.concatenate(parts)


def _high_side(
    log: Log, site: Site, time: Array, window: float
) -> tuple[Array | None, float | None]:
    """Return the roll from the high side at windows, and the inclination of the hole (rad)."""
    if not log.inertial or len(log.imu) == 0:
        return None, None
    stamps = log.imu.time + site.platform.imu.time_offset
    begin = np.searchsorted(stamps, time - 0.5 * window)
    end = np.searchsorted(stamps, time + 0.5 * window)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(log.imu.accel_body, axis=0)])
    mean = (total[end] - total[begin]) / np.maximum(end - begin, 1)[:, None]
    if np.any(end == begin):
        nearest = np.clip(np.searchsorted(stamps, time), 0, len(stamps) - 1)
        mean = np.where((end == begin)[:, None], log.imu.accel_body[nearest], mean)
    across = np.hypot(mean[:, 1], mean[:, 2])
    along = float(np.median(mean[:, 0]))
    inclination = float(np.arctan2(np.median(across), -along))  # force points up
    if np.min(across) < UPRIGHT * site.gravity:
        return None, inclination
    return np.arctan2(mean[:, 1], mean[:, 2]), inclination
