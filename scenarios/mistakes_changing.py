"""What happens once, in the middle of a log that begins well.

A clock jumps, a range switches, a beacon is knocked over, a mount slips, a buffer is sent twice.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import Case, Change, Mistake, beacon_waveform, of_imu, of_waveform
from scipy.spatial.transform import Rotation

from magfusion.model.site import Beacon
from magfusion.units import DEGREE, Array, BoolArray

REST = ("rest",)
MIDDLE = 20.0  # s
Modified = Callable[[Beacon], Beacon]


def _from_time(time: Array, begin: float = MIDDLE, end: float = np.inf) -> BoolArray:
    return np.asarray((time >= begin) & (time < end))


def _wave_jump(by: float) -> Change:
    return of_waveform(lambda _, time, measured: (time + by * _from_time(time), measured))


def _imu_jump(by: float) -> Change:
    return of_imu(lambda _, time, rate, force: (time + by * _from_time(time), rate, force))


def _wave_step(gain: float) -> Change:
    """Return a magnetometer whose gain changes, as where its range is switched."""
    return of_waveform(
        lambda _, time, measured: (
            time,
            measured * (1.0 + (gain - 1.0) * _from_time(time)[:, None]),
        )
    )


def _wave_gain_drifts(rate: float) -> Change:
    """Return a magnetometer whose gain drifts with temperature (1/s)."""
    return of_waveform(lambda _, time, measured: (time, measured * (1.0 + rate * time)[:, None]))


def _offset_step(step: tuple[float, float, float]) -> Change:
    return of_waveform(
        lambda _, time, measured: (time, measured + _from_time(time)[:, None] * np.array(step))
    )


def _slips(rotvec_deg: tuple[float, float, float]) -> Change:
    """Return a magnetometer that turns in its mount."""
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()

    def changed(_: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        return time, np.where(_from_time(time)[:, None], measured @ turn, measured)

    return of_waveform(changed)


def _true_wave(case: Case, name: str, alter: Modified) -> Array:
    """Return the field of one beacon that is other than it was, shape (n, 3) (T)."""
    site = case.truth.true_site
    beacons = tuple(alter(b) if b.name == name else b for b in site.beacons)
    truth = replace(case.truth, true_site=replace(site, beacons=beacons))
    return beacon_waveform(replace(case, truth=truth), name)


def _beacon_becomes(name: str, alter: Modified) -> Change:
    """Return a beacon that is another from the middle on."""

    def changed(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        other = _true_wave(case, name, alter) - beacon_waveform(case, name)
        return time, measured + _from_time(time)[:, None] * other

    return of_waveform(changed)


def _moved(step: tuple[float, float, float]) -> Modified:
    return lambda b: replace(b, position_world=b.position_world + np.array(step))


def _rotated(rotvec_deg: tuple[float, float, float]) -> Modified:
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return lambda b: replace(b, world_from_beacon=b.world_from_beacon @ turn)


def _stronger(gain: float) -> Modified:
    def replaced(beacon: Beacon) -> Beacon:
        coils = (replace(c, moment_beacon=gain * c.moment_beacon) for c in beacon.coils)
        return replace(beacon, coils=tuple(coils))

    return replaced


def _later(phase: float) -> Modified:
    """Return a beacon whose two currents lead by an angle: the axis of its turning field."""

    def replaced(beacon: Beacon) -> Beacon:
        turn = Rotation.from_rotvec([0.0, 0.0, phase]).as_matrix()
        coils = (replace(c, moment_beacon=turn @ c.moment_beacon) for c in beacon.coils)
        return replace(beacon, coils=tuple(coils))

    return replaced


def _all_stronger(gain: float) -> Change:
    """Return beacons on one supply, whose voltage steps."""

    def changed(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
        names = [beacon.name for beacon in case.site.beacons]
        total = np.sum([beacon_waveform(case, name) for name in names], axis=0)
        return time, measured + (gain - 1.0) * _from_time(time)[:, None] * total

    return of_waveform(changed)


def _gap(begin: float, end: float) -> Callable[[Array], BoolArray]:
    return lambda time: ~_from_time(time, begin, end)


def _wave_gap(kept: Callable[[Array], BoolArray]) -> Change:
    return of_waveform(lambda _, time, measured: (time[kept(time)], measured[kept(time)]))


def _imu_gap(kept: Callable[[Array], BoolArray]) -> Change:
    return of_imu(
        lambda _, time, rate, force: (time[kept(time)], rate[kept(time)], force[kept(time)])
    )


def _sent_again(time: Array, values: Array, length: float) -> Array:
    """Return values of which a buffer of a length (s) came twice, in place of what was next."""
    now = _from_time(time, MIDDLE, MIDDLE + length)
    count = int(np.sum(now))
    first = int(np.argmax(now))
    out = values.copy()
    out[first : first + count] = values[first - count : first]
    return out


def _wave_again(length: float) -> Change:
    return of_waveform(lambda _, time, measured: (time, _sent_again(time, measured, length)))


def _imu_again(length: float) -> Change:
    return of_imu(
        lambda _, time, rate, force: (
            time,
            _sent_again(time, rate, length),
            _sent_again(time, force, length),
        )
    )


def _gyro_bias_step(step: tuple[float, float, float]) -> Change:
    return of_imu(
        lambda _, time, rate, force: (
            time,
            rate + _from_time(time)[:, None] * np.array(step),
            force,
        )
    )


def _accel_bias_step(step: tuple[float, float, float]) -> Change:
    return of_imu(
        lambda _, time, rate, force: (
            time,
            rate,
            force + _from_time(time)[:, None] * np.array(step),
        )
    )


def _gyro_bias_drifts(rate: tuple[float, float, float]) -> Change:
    """Return rates whose bias drifts as the sensor warms (rad/s^2)."""
    return of_imu(lambda _, time, gyro, force: (time, gyro + time[:, None] * np.array(rate), force))


def _noise_10s(case: Case, time: Array, measured: Array) -> tuple[Array, Array]:
    """Return a motor near the magnetometer that runs for ten seconds."""
    noise = case.rng.normal(0.0, 5e-7, measured.shape)
    return time, measured + _from_time(time, 15.0, 25.0)[:, None] * noise


_GAP = ("gap", "samples_lost")
_JUMP = ("changed", "time_offset", "epoch_shift", "gap", "restarts", "imu_clock")
_STEP = (
    "changed",
    "range_switched",
    "gain_step",
    "magnetometer_matrix",
    "field_scale",
    "moment_units",
    "beacon_fault",
    "moments",
)
_FAULT = ("changed", "beacon_fault", "beacon_excluded", "field_residuals", "moments")
_PLACE = ("beacon_pose", *_FAULT)
_BIAS = ("changed", "imu_bias", "inertial_residuals")

MISTAKES = (
    Mistake("magnetometer_jumps_200ms", "midway", _wave_jump(0.2), _JUMP),
    Mistake("magnetometer_jumps_5ms", "midway", _wave_jump(0.005), _JUMP),
    Mistake("magnetometer_jumps_1ms", "midway", _wave_jump(0.001), _JUMP),
    Mistake("magnetometer_jumps_back_200ms", "midway", _wave_jump(-0.2), _JUMP),
    Mistake("imu_jumps_200ms", "midway", _imu_jump(0.2), _JUMP, REST),
    Mistake("imu_jumps_30ms", "midway", _imu_jump(0.03), _JUMP, REST),
    Mistake("imu_jumps_back_200ms", "midway", _imu_jump(-0.2), _JUMP),
    Mistake("range_switched_double", "midway", _wave_step(2.0), _STEP),
    Mistake("gain_steps_5pct", "midway", _wave_step(1.05), _STEP),
    Mistake("gain_steps_1pct", "midway", _wave_step(1.01), _STEP),
    Mistake("gain_drifts_1pct_min", "midway", _wave_gain_drifts(0.01 / 60.0), _STEP),
    Mistake("gain_drifts_5pct_min", "midway", _wave_gain_drifts(0.05 / 60.0), _STEP),
    Mistake("offset_steps_5ut", "midway", _offset_step((3e-6, -4e-6, 0.0)), harmless=True),
    Mistake("mount_slips_5deg", "midway", _slips((3.0, 3.0, 2.6)), ("mounting", *_STEP)),
    Mistake("mount_slips_1deg", "midway", _slips((0.6, 0.6, 0.5)), ("mounting", *_STEP)),
    Mistake(
        "beacon_moves_10cm", "midway", _beacon_becomes("A", _moved((0.06, -0.08, 0.0))), _PLACE
    ),
    Mistake(
        "beacon_moves_2cm", "midway", _beacon_becomes("A", _moved((0.012, -0.016, 0.0))), _PLACE
    ),
    Mistake("beacon_turns_5deg", "midway", _beacon_becomes("B", _rotated((3.0, 3.0, 2.6))), _PLACE),
    Mistake("moment_steps_10pct", "midway", _beacon_becomes("C", _stronger(1.1)), _FAULT),
    Mistake("moment_steps_2pct", "midway", _beacon_becomes("C", _stronger(1.02)), _FAULT),
    Mistake("supply_steps_5pct", "midway", _all_stronger(1.05), _STEP),
    Mistake(
        "drive_restarts_30deg",
        "midway",
        _beacon_becomes("D", _later(30.0 * DEGREE)),
        ("phase", *_FAULT),
    ),
    Mistake("magnetometer_gap_5s", "midway", _wave_gap(_gap(18.0, 23.0)), _GAP, harmless=True),
    Mistake("magnetometer_gap_1s", "midway", _wave_gap(_gap(18.0, 19.0)), _GAP, harmless=True),
    Mistake("imu_gap_1s", "midway", _imu_gap(_gap(18.0, 19.0)), _GAP, harmless=True),
    Mistake("imu_gap_5s", "midway", _imu_gap(_gap(18.0, 23.0)), _GAP, harmless=True),
    Mistake(
        "magnetometer_sent_again_1s",
        "midway",
        _wave_again(1.0),
        ("changed", "field_residuals", "field_innovations"),
    ),
    Mistake(
        "magnetometer_sent_again_200ms",
        "midway",
        _wave_again(0.2),
        ("changed", "field_residuals", "field_innovations"),
    ),
    Mistake(
        "imu_sent_again_1s",
        "midway",
        _imu_again(1.0),
        ("changed", "field_residuals", "field_innovations"),
        REST,
    ),
    Mistake("gyro_bias_steps", "midway", _gyro_bias_step((0.01, 0.0, -0.01)), _BIAS),
    Mistake("accel_bias_steps", "midway", _accel_bias_step((0.2, 0.0, 0.1)), _BIAS),
    Mistake("gyro_bias_drifts", "midway", _gyro_bias_drifts((2e-4, 0.0, -2e-4)), _BIAS),
    Mistake("motor_runs_10s", "midway", of_waveform(_noise_10s), harmless=True),
)
