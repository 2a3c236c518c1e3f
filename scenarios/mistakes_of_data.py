"""Mistakes in what the instruments wrote: axes, signs, units, stamps, and false samples."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import Case, Change, Mistake, of_imu, of_waveform
from scipy.spatial.transform import Rotation

from magfusion.model.trajectory import Trajectory
from magfusion.units import DEGREE, Array

REST = ("rest",)
Samples = Callable[[Array], Array]


def _same(values: Array) -> Array:
    return values


def _imu(gyro: Samples = _same, accel: Samples = _same) -> Change:
    return of_imu(lambda _, time, rate, force: (time, gyro(rate), accel(force)))


def _imu_time(change: Samples) -> Change:
    return of_imu(lambda _, time, rate, force: (change(time), rate, force))


def _wave(change: Samples) -> Change:
    return of_waveform(lambda _, time, measured: (time, change(measured)))


def _signs(*signs: float) -> Samples:
    return lambda values: values * np.array(signs)


def _rotated(rotvec_deg: tuple[float, float, float]) -> Samples:
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return lambda values: values @ turn.T


def _both(change: Samples) -> Change:
    return _imu(change, change)


def _without_gravity(case: Case, time: Array, rate: Array, force: Array) -> tuple[Array, ...]:
    """Return the acceleration from which a smart sensor has removed gravity."""
    attitude = case.truth.motion.world_from_body(time)
    return time, rate, force - attitude.inv().apply([0.0, 0.0, case.site.gravity])


def _frozen(axis: int | slice, begin: float, end: float) -> Change:
    """Return both triads frozen at the last value, from one time to another (s)."""

    def changed(_: Case, time: Array, rate: Array, force: Array) -> tuple[Array, Array, Array]:
        fixed = (time >= begin) & (time < end)
        first = int(np.argmax(fixed))
        rate, force = rate.copy(), force.copy()
        for values in (rate, force):
            values[fixed, axis] = values[first, axis]
        return time, rate, force

    return of_imu(changed)


def _stuck(axis: int, at: float) -> Samples:
    def changed(values: Array) -> Array:
        out = values.copy()
        out[:, axis] = at
        return out

    return changed


def _spikes(case: Case, time: Array, rate: Array, force: Array) -> tuple[Array, Array, Array]:
    """Return one sample in a thousand false by 100 sigma."""
    hit = case.rng.random(len(time)) < 1e-3
    model, sign = case.site.platform.imu, case.rng.choice([-1.0, 1.0], (2, len(time), 3))
    size = 100.0 * np.sqrt(case.config.imu_rate_hz) * hit[:, None]
    return (
        time,
        rate + sign[0] * model.gyro_noise * size,
        force + sign[1] * model.accel_noise * size,
    )


def _repeated_samples(every: int) -> Samples:
    return lambda values: values[np.arange(len(values)) // every * every]


def _saturated(measured: Array) -> Array:
    """Return an instrument whose range ends at nine tenths of its largest reading."""
    limit = 0.9 * float(np.abs(measured).max())
    return np.clip(measured, -limit, limit)


def _body_iron(measured: Array) -> Array:
    """Return the readings near undeclared iron on the body: matrix 5 %, offset 5 uT."""
    iron = np.eye(3) + 0.05 * np.array([[0.6, 0.8, -0.3], [0.8, -1.0, 0.5], [-0.3, 0.5, 0.9]])
    return measured @ iron.T + np.array([3e-6, -4e-6, 1e-6])


def _shifted(case: Case, by: float) -> Case:
    """Return a log whose epoch is off, so that all its stamps are, but no drive."""
    log, wave, truth = case.log, case.waveform, case.log.truth
    assert truth is not None
    moved: Trajectory = replace(truth, time=truth.time + by)
    return replace(
        case,
        log=replace(
            log,
            imu=replace(log.imu, time=log.imu.time + by),
            waveform=replace(wave, time=wave.time + by),
            truth=moved,
        ),
    )


def _magnetometer_late(by: float) -> Change:
    return of_waveform(lambda _, time, measured: (time + by, measured))


def _magnetometer_clock(rate: float) -> Change:
    return of_waveform(lambda _, time, measured: (time * (1.0 + rate), measured))


def _is_lost(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
    kept = case.rng.random(len(time)) > 0.05
    return time[kept], measured[kept]


_AXES = ("imu_axes", "mounting")
_GRAVITY = ("gravity_sign", "imu_axes")
_SENSOR = ("magnetometer_axes", "mounting")
_TIME = ("time_offset",)

MISTAKES = (
    Mistake("gyro_sign", "data", _imu(gyro=lambda g: -g), ("gyro_sign",), REST),
    Mistake("gyro_z_sign", "data", _imu(gyro=_signs(1, 1, -1)), ("gyro_sign",), REST),
    Mistake("gyro_deg_s", "data", _imu(gyro=lambda g: g / DEGREE), ("gyro_units",)),
    Mistake(
        "gyro_mrad_s", "data", _imu(gyro=lambda g: 1e-3 * g), ("gyro_units", "stuck_axis"), REST
    ),
    Mistake("gyro_scale_2pct", "data", _imu(gyro=lambda g: 1.02 * g), ("gyro_scale",), REST),
    Mistake(
        "gyro_bias", "data", _imu(gyro=lambda g: g + np.array([0.0, 0.05, 0.0])), ("imu_bias",)
    ),
    Mistake(
        "accel_bias", "data", _imu(accel=lambda a: a + np.array([0.0, 0.5, 0.0])), ("imu_bias",)
    ),
    Mistake("accel_sign", "data", _imu(accel=lambda a: -a), _GRAVITY),
    Mistake("accel_in_g", "data", _imu(accel=lambda a: a / 9.81), ("accel_units",)),
    Mistake("accel_y_in_g", "data", _imu(accel=lambda a: a / [1, 9.81, 1]), ("accel_units",)),
    Mistake("accel_in_mg", "data", _imu(accel=lambda a: a / 9.81e-3), ("accel_units",)),
    Mistake("accel_scale_3pct", "data", _imu(accel=lambda a: 1.03 * a), ("accel_scale", "gravity")),
    Mistake("gravity_removed", "data", of_imu(_without_gravity), ("gravity_missing",)),
    Mistake("imu_z90", "data", _both(_rotated((0.0, 0.0, 90.0))), _AXES, REST),
    Mistake("imu_z180", "data", _both(_rotated((0.0, 0.0, 180.0))), _AXES, REST),
    Mistake("imu_upside_down", "data", _both(_rotated((180.0, 0.0, 0.0))), _AXES),
    Mistake("imu_y-90", "data", _both(_rotated((0.0, -90.0, 0.0))), _AXES),
    Mistake("imu_permuted", "data", _both(lambda v: v[:, [1, 2, 0]]), _AXES),
    Mistake("imu_xy_swapped", "data", _both(lambda v: v[:, [1, 0, 2]]), _AXES, REST),
    Mistake("imu_ned", "data", _both(_signs(1, -1, -1)), _AXES),
    Mistake("gyro_only_permuted", "data", _imu(gyro=lambda g: g[:, [1, 2, 0]]), _AXES, REST),
    Mistake("accel_only_z90", "data", _imu(accel=_rotated((0.0, 0.0, 90.0))), _AXES),
    Mistake(
        "gyro_x_stuck",
        "data",
        _imu(gyro=_stuck(0, 0.0)),
        ("stuck_axis", "frozen_imu", "frozen_magnetometer"),
    ),
    Mistake(
        "accel_y_stuck",
        "data",
        _imu(accel=_stuck(1, 0.0)),
        ("stuck_axis", "frozen_imu", "frozen_magnetometer"),
    ),
    Mistake(
        "imu_frozen_10s", "data", _frozen(slice(None), 15.0, 25.0), ("frozen_imu", "stuck_axis")
    ),
    Mistake("imu_spikes", "data", of_imu(_spikes), ("imu_spikes",)),
    Mistake("imu_held_4", "data", _both(_repeated_samples(4)), ("repeated_samples",)),
    Mistake("imu_1s_late", "data", _imu_time(lambda t: t + 1.0), _TIME, REST),
    Mistake("imu_100ms_late", "data", _imu_time(lambda t: t + 0.1), _TIME, REST),
    Mistake("imu_clock_1pct", "data", _imu_time(lambda t: 1.01 * t), ("imu_clock",), REST),
    Mistake("imu_clock_1000ppm", "data", _imu_time(lambda t: 1.001 * t), ("imu_clock",), REST),
    Mistake("epoch_12ms", "data", lambda case: _shifted(case, 0.012), ("epoch_shift",)),
    Mistake("epoch_3ms", "data", lambda case: _shifted(case, 0.003), ("epoch_shift",)),
    Mistake("epoch_-110ms", "data", lambda case: _shifted(case, -0.110), ("epoch_shift",)),
    Mistake("magnetometer_50ms_late", "data", _magnetometer_late(0.05), ("epoch_shift", *_TIME)),
    Mistake("magnetometer_clock_1pct", "data", _magnetometer_clock(0.01), ("sample_rate",)),
    Mistake("magnetometer_clock_1000ppm", "data", _magnetometer_clock(1e-3), ("sample_rate",)),
    Mistake("magnetometer_clock_20ppm", "data", _magnetometer_clock(2e-5), ("sample_rate",)),
    Mistake("magnetometer_permuted", "data", _wave(lambda m: m[:, [1, 2, 0]]), _SENSOR),
    Mistake("magnetometer_xy_swapped", "data", _wave(lambda m: m[:, [1, 0, 2]]), _SENSOR),
    Mistake("magnetometer_z_sign", "data", _wave(_signs(1, 1, -1)), _SENSOR),
    Mistake("magnetometer_ned", "data", _wave(_signs(1, -1, -1)), _SENSOR),
    Mistake(
        "magnetometer_z_stuck",
        "data",
        _wave(_stuck(2, 1e-5)),
        ("stuck_axis", "frozen_imu", "frozen_magnetometer"),
    ),
    Mistake("magnetometer_in_nt", "data", _wave(lambda m: 1e9 * m), ("field_units",)),
    Mistake("magnetometer_in_gauss", "data", _wave(lambda m: 1e4 * m), ("field_units",)),
    Mistake("magnetometer_saturated", "data", _wave(_saturated), ("saturated",)),
    Mistake("magnetometer_held_2", "data", _wave(_repeated_samples(2)), ("repeated_samples",)),
    Mistake("samples_lost_5pct", "data", of_waveform(_is_lost), harmless=True),
    Mistake(
        "body_iron",
        "data",
        _wave(_body_iron),
        ("magnetometer_matrix", "magnetometer_offset", "body_iron"),
    ),
    Mistake(
        "magnet_on_body",
        "data",
        _wave(lambda m: m + np.array([2e-5, 0.0, -1e-5])),
        ("magnetometer_matrix", "magnetometer_offset", "body_iron"),
        harmless=True,
    ),
)
