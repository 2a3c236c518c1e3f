"""What an instrument, its driver or its logger does to samples: order, steps, ranges, filters.

And what is easily confused in a site with these: rates of 1 %, a survey that is moved or turned.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import (
    Case,
    Change,
    Mistake,
    again,
    declared,
    of_beacons,
    of_imu,
    of_waveform,
)
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magfusion.model.site import Beacon
from magfusion.simulation.waveform import Mains
from magfusion.units import Array, IntArray

REST = ("rest",)
Samples = Callable[[Array], Array]


def _same(values: Array) -> Array:
    return values


def _imu(gyro: Samples = _same, accel: Samples = _same) -> Change:
    return of_imu(lambda _, time, rate, force: (time, gyro(rate), accel(force)))


def _wave(change: Samples) -> Change:
    return of_waveform(lambda _, time, measured: (time, change(measured)))


def _exchanged(case: Case, count: int, share: float = 0.01) -> IntArray:
    """Return an order in which one sample in a hundred changes place with the next."""
    order = np.arange(count)
    hit = np.flatnonzero(case.rng.random(count - 1) < share)
    hit = hit[np.diff(hit, prepend=-2) > 1]
    order[hit], order[hit + 1] = hit + 1, hit
    return order


def _twice(case: Case, count: int, share: float = 0.01) -> IntArray:
    """Return an order in which one sample in a hundred comes twice."""
    return np.sort(np.append(np.arange(count), np.flatnonzero(case.rng.random(count) < share)))


Order = Callable[[Case, int], IntArray]


def _wave_rows(order: Order, stamps: bool) -> Change:
    """Return rows in another order, with their stamps or under those that are due."""

    def changed(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        rows = order(case, len(time))
        own = time[rows] if stamps else _regular(time, len(rows))
        return own, measured[rows]

    return of_waveform(changed)


def _imu_rows(order: Order, stamps: bool) -> Change:
    def changed(case: Case, time: Array, rate: Array, force: Array) -> tuple[Array, Array, Array]:
        rows = order(case, len(time))
        own = time[rows] if stamps else _regular(time, len(rows))
        return own, rate[rows], force[rows]

    return of_imu(changed)


def _regular(time: Array, count: int) -> Array:
    return np.asarray(time[0] + np.arange(count) * (time[-1] - time[0]) / (len(time) - 1))


def _steps(step: float) -> Samples:
    return lambda values: np.round(values / step) * step


def _clipped(limit: float, *axes: int) -> Samples:
    def changed(values: Array) -> Array:
        out, chosen = values.copy(), list(axes) or slice(None)
        out[:, chosen] = np.clip(values[:, chosen], -limit, limit)
        return out

    return changed


def _wrapped(limit: float) -> Samples:
    """Return numbers that overflow: what is beyond the range comes in at its other end."""
    return lambda values: (values + limit) % (2.0 * limit) - limit


def _signs(*signs: float) -> Samples:
    return lambda values: values * np.array(signs)


def _lowpass(corner_hz: float) -> Change:
    """Return an undeclared filter of first order before the magnetometer's converter."""

    def changed(_: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        keep = np.exp(-2.0 * np.pi * corner_hz * float(np.median(np.diff(time))))
        start = keep * measured[:1]
        return time, lfilter([1.0 - keep], [1.0, -keep], measured, axis=0, zi=start)[0]

    return of_waveform(changed)


def _frequencies(factor: float) -> Change:
    return of_beacons(lambda b: replace(b, frequency_hz=factor * b.frequency_hz))


def _survey(turn_deg: tuple[float, float, float], step: tuple[float, float, float]) -> Change:
    """Return a survey in another frame: turned, then moved."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()

    def changed(beacon: Beacon) -> Beacon:
        place = turn @ beacon.position_world + np.array(step)
        return replace(
            beacon, position_world=place, world_from_beacon=turn @ beacon.world_from_beacon
        )

    return of_beacons(changed)


def _ned(case: Case) -> Case:
    """Return a survey and an Earth field in axes of which z points down."""
    turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    beacons = tuple(
        replace(
            b,
            position_world=turn @ b.position_world,
            world_from_beacon=turn @ b.world_from_beacon,
        )
        for b in case.site.beacons
    )
    assert case.site.earth_field_world is not None
    earth = turn @ case.site.earth_field_world
    return declared(case, replace(case.site, beacons=beacons, earth_field_world=earth))


def _line(frequency_hz: float, amplitude: float) -> Change:
    direction = Rotation.from_rotvec([0.3, 0.5, 0.0]).apply([0.0, 0.0, 1.0])
    return lambda case: again(case, mains=Mains(amplitude, frequency_hz, (), direction))


def _beacon_at_mains(case: Case) -> Case:
    """Return a beacon at 50 Hz next to mains of 49.98 Hz, both declared and true."""
    beacons = tuple(
        replace(b, frequency_hz=50.0) if b.name == "B" else b for b in case.site.beacons
    )
    site = replace(case.site, beacons=beacons)
    direction = Rotation.from_rotvec([0.3, 0.5, 0.0]).apply([0.0, 0.0, 1.0])
    built = again(case, site, mains=Mains(2e-8, 49.98, (), direction))
    return replace(built, site=site)


def _names_swapped(case: Case) -> Case:
    """Return a site in which two beacons are declared under each other's names: nothing else."""
    first, second, *rest = case.site.beacons
    named = (replace(second, name=first.name), replace(first, name=second.name))
    return declared(case, replace(case.site, beacons=(*named, *rest)))


_ORDER = ("out_of_order", "repeated_stamps")
_LINE = ("undeclared_line", "fitted_line", "mains", "beacon_fault", "field_residuals")
_RANGE = ("saturated", "imu_spikes")
_UNITS = ("field_units",)
_SENSOR = ("magnetometer_axes", "mounting")
_FILTER = ("low_pass", "phase", "response", "epoch_shift", "moments", "moment_units")
_FRAME = ("earth_field", "survey_axes", "gravity_sign", "imu_axes")

MISTAKES = (
    Mistake("magnetometer_rows_late", "instrument", _wave_rows(_exchanged, True), _ORDER),
    Mistake("magnetometer_values_late", "instrument", _wave_rows(_exchanged, False), harmless=True),
    Mistake("magnetometer_rows_twice", "instrument", _wave_rows(_twice, True), _ORDER),
    Mistake(
        "magnetometer_rows_inserted", "instrument", _wave_rows(_twice, False), ("sample_rate",)
    ),
    Mistake("imu_rows_late", "instrument", _imu_rows(_exchanged, True), _ORDER),
    Mistake("imu_values_late", "instrument", _imu_rows(_exchanged, False), harmless=True),
    Mistake("imu_rows_twice", "instrument", _imu_rows(_twice, True), _ORDER),
    Mistake("imu_rows_inserted", "instrument", _imu_rows(_twice, False), ("imu_clock",), REST),
    Mistake("steps_50nt", "instrument", _wave(_steps(5e-8)), ("quantised",)),
    Mistake("steps_5nt", "instrument", _wave(_steps(5e-9)), ("quantised",)),
    Mistake("imu_steps_coarse", "instrument", _imu(_steps(0.02), _steps(0.1)), ("quantised",)),
    Mistake("one_axis_saturates_40ut", "instrument", _wave(_clipped(4e-5, 2)), _RANGE),
    Mistake("saturates_20ut", "instrument", _wave(_clipped(2e-5)), _RANGE),
    Mistake("range_wraps_40ut", "instrument", _wave(_wrapped(4e-5)), _RANGE),
    Mistake("gyro_saturates", "instrument", _imu(gyro=_clipped(0.2)), _RANGE, REST),
    Mistake("accel_saturates_1g", "instrument", _imu(accel=_clipped(9.81)), _RANGE),
    Mistake("magnetometer_in_ut", "instrument", _wave(lambda m: 1e6 * m), _UNITS),
    Mistake("magnetometer_in_mt", "instrument", _wave(lambda m: 1e3 * m), _UNITS),
    Mistake("magnetometer_x_sign", "instrument", _wave(_signs(-1, 1, 1)), _SENSOR),
    Mistake(
        "accel_z_sign", "instrument", _imu(accel=_signs(1, 1, -1)), ("gravity_sign", "imu_axes")
    ),
    Mistake("accel_x_sign", "instrument", _imu(accel=_signs(-1, 1, 1)), ("imu_axes",), REST),
    Mistake("gyro_x_sign", "instrument", _imu(gyro=_signs(-1, 1, 1)), ("gyro_sign",), REST),
    Mistake(
        "imu_scale_3pct",
        "instrument",
        _imu(lambda g: 1.03 * g, lambda a: 1.03 * a),
        ("accel_scale", "gravity", "gyro_scale"),
    ),
    Mistake("lowpass_50hz", "instrument", _lowpass(50.0), _FILTER),
    Mistake("lowpass_150hz", "instrument", _lowpass(150.0), _FILTER),
    Mistake(
        "frequencies_1pct",
        "instrument",
        _frequencies(1.01),
        ("sample_rate", "beacon_clock", "undeclared_line"),
    ),
    Mistake(
        "frequencies_200ppm", "instrument", _frequencies(1.0002), ("sample_rate", "beacon_clock")
    ),
    Mistake("survey_shifted", "instrument", _survey((0, 0, 0), (1.0, -2.0, 0.5)), unknowable=True),
    Mistake("survey_turned_30deg", "instrument", _survey((0, 0, 30), (0, 0, 0)), _FRAME),
    Mistake(
        "survey_tilted_5deg",
        "instrument",
        _survey((4, -3, 0), (0, 0, 0)),
        ("survey_tilt", "gravity_direction", "beacon_pose"),
    ),
    Mistake("survey_ned", "instrument", _ned, _FRAME),
    Mistake("names_swapped", "instrument", _names_swapped, harmless=True),
    Mistake("mains_on_beacon", "instrument", _beacon_at_mains, _LINE),
    Mistake("line_100mhz_off", "instrument", _line(25.1, 2e-8), _LINE),
    Mistake("line_20mhz_off", "instrument", _line(25.02, 5e-9), _LINE),
    Mistake("line_100mhz_off_weak", "instrument", _line(25.1, 2e-9), _LINE),
)
