"""The static part of a magnetometer's waveform during rotation by hand: one reading an epoch.

The beacons' tones and the mains average out over a tapered window of several of their periods.
The window is long relative to the motion, so that each sample is first rotated into the axes of
the window's centre, by the gyro and the current calibration.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Magnetometer, Site
from magfusion.model.strapdown import attitude_at, attitude_from_gyro
from magfusion.units import Array, BoolArray

PERIODS = 8.0  # of the lowest tone in a window; its taper leaves 6e-4 of it, less of the others
MIN_WINDOW = 0.2  # s; ten periods of the mains
MAX_WINDOW = 2.0  # s; over which a gyro's bias turns less than it matters
GAP = 3.5  # a gap is this many times what intervals are up to; two lost samples are none
UP_TO = 95.0  # percent of the intervals, so that stamps of a host make no gaps
MIN_GYROLESS_WINDOW, MIN_WINDOW_SAMPLES = 0.05, 5.0  # s, samples; of a window without a gyro
MIN_TURN_CHANGE = 0.05  # of all that the field changes by
MAX_MISSING_WINDOW = 0.5  # that may pass without a sample, however long intervals are


@dataclass(frozen=True, eq=False)
class StaticField:
    """Readings averaged over windows."""

    time: Array  # (n,), centre of each window, on the log's clock (s)
    window: Array  # (n,), length of each (s)
    measured_sensor: Array  # (n, 3), reading at the centre (T)
    accel_body: Array  # (n, 3), mean specific force in the axes of the centre (m/s^2)

    def __len__(self) -> int:
        return len(self.time)


def window_length(site: Site) -> float:
    """Return the length of a window (s) over which the tones of a site average out.

    Raises InputError where a tone is too low for that.
    """
    lowest = min((float(np.min(b.tone_frequencies_hz)) for b in site.beacons), default=np.inf)
    length = max(MIN_WINDOW, PERIODS / lowest)
    if length > MAX_WINDOW:
        raise InputError(
            f"a tone at {lowest:g} Hz is too low to average out while the sensor rotates; switch"
            f" that beacon off, or use tones above {PERIODS / MAX_WINDOW:g} Hz"
        )
    return length


def static_field(
    waveform: Waveform, imu: ImuSamples, site: Site, *, magnetometer: Magnetometer | None = None
) -> StaticField:
    """Average a waveform over consecutive windows.

    `magnetometer`: the current calibration; by default the site's. Raises InputError where no
    window lies in both streams without a gap.
    """
    length = window_length(site)
    offset = site.platform.imu.time_offset
    begin = max(waveform.time[0], imu.time[0] + offset)
    end = min(waveform.time[-1], imu.time[-1] + offset)
    centre = np.arange(begin + 0.5 * length, end - 0.5 * length, length)
    window = np.full(len(centre), length)
    known = site.platform.magnetometer if magnetometer is None else magnetometer
    return average(waveform, imu, offset, known, centre, window)


def static_alone(waveform: Waveform, site: Site) -> StaticField:
    """Average a waveform without a gyro, over windows that are as short as possible.

    Windows in which the field rotates by more than `MIN_TURN_CHANGE` are omitted: their mean is too
    small. Raises InputError where no window remains.
    """
    time = waveform.time
    usual = float(np.median(np.diff(time)))
    length = (
        window_length(site)
        if site.beacons
        else max(MIN_GYROLESS_WINDOW, MIN_WINDOW_SAMPLES * usual)
    )
    centre = np.arange(time[0] + 0.5 * length, time[-1] - 0.5 * length, length)
    window = np.full(len(centre), length)
    whole = _whole(time, centre, window)
    if np.sum(whole) < 2:
        raise InputError(
            "magnetometer: no stretch without a gap is long enough; record at least a minute of"
            " slow rotation"
        )
    centre, window = centre[whole], window[whole]
    mean = _tapered_means(time, waveform.measured_sensor, centre, window)
    rate = np.linalg.norm(np.gradient(mean, centre, axis=0), axis=1)
    far = float(np.linalg.norm(np.ptp(mean, axis=0)))
    slow = rate * length < MIN_TURN_CHANGE * far
    centre, window, mean = centre[slow], window[slow], mean[slow]
    return StaticField(centre, window, mean, np.zeros_like(mean))


def average(
    waveform: Waveform,
    imu: ImuSamples,
    time_offset: float,
    magnetometer: Magnetometer,
    centre: Array,
    window: Array,
) -> StaticField:
    """Average waveform and specific force over given windows, without those that have a gap.

    `time_offset`: added to the IMU's stamps (s). `magnetometer`: calibration for the rotation of
    the samples. `centre`, `window` (n,) (s). Raises InputError where no window remains.
    """
    imu_time = imu.time + time_offset
    whole = _whole(waveform.time, centre, window) & _whole(imu_time, centre, window)
    if not np.any(whole):
        raise InputError(
            "magnetometer: no stretch without a gap is long enough for the beacons' tones to"
            " average out; record at least a minute of slow rotation"
        )
    centre, window = centre[whole], window[whole]
    attitude = attitude_from_gyro(imu_time, imu.gyro_body)
    at_samples = attitude_at(attitude, imu_time, imu.gyro_body, waveform.time)
    at_centre = attitude_at(attitude, imu_time, imu.gyro_body, centre)
    body_from_measured = magnetometer.body_from_sensor @ np.linalg.inv(magnetometer.matrix)
    centred = (waveform.measured_sensor - magnetometer.offset) @ body_from_measured.T
    field = _turned_means(waveform.time, centred, at_samples, at_centre, centre, window)
    accel = _turned_means(imu_time, imu.accel_body, attitude, at_centre, centre, window)
    measured = field @ np.linalg.inv(body_from_measured).T + magnetometer.offset
    return StaticField(centre, window, measured, accel)


def _turned_means(
    time: Array, body: Array, attitude: Rotation, at_centre: Rotation, centre: Array, window: Array
) -> Array:
    means = _tapered_means(time, attitude.apply(body), centre, window)
    return at_centre.inv().apply(means)


def _whole(time: Array, centre: Array, window: Array) -> BoolArray:
    """Return which windows have no gap in a stream."""
    step = np.diff(time)
    usual = max(float(np.median(step)), float(np.percentile(step, UP_TO)))
    longest = min(GAP * usual, MAX_MISSING_WINDOW * float(np.min(window)))
    gaps = np.flatnonzero(step > longest)
    first, last = centre - 0.5 * window, centre + 0.5 * window
    inside = (first > time[0] - usual) & (last < time[-1] + usual)
    met = np.searchsorted(time[gaps], last) > np.searchsorted(time[gaps + 1], first)
    return inside & ~met


def _tapered_means(time: Array, vector: Array, centre: Array, window: Array) -> Array:
    """Return means under a raised cosine, shape (n, 3)."""
    out = np.empty((len(centre), 3))
    first = np.searchsorted(time, centre - 0.5 * window)
    last = np.searchsorted(time, centre + 0.5 * window, side="right")
    for i, (begin, end) in enumerate(zip(first, last, strict=True)):
        part = slice(begin, end)
        weight = 1.0 + np.cos(2.0 * np.pi * (time[part] - centre[i]) / window[i])
        out[i] = weight @ vector[part] / np.sum(weight)
    return out
