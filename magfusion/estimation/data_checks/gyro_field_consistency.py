"""Consistency of gyroscope and static field: axes, signs, units, clocks."""

from collections.abc import Iterator

import numpy as np

from magfusion.estimation.data_checks.field_rotation import (
    CONTRADICTED,
    EXPLAINED,
    MIN_ROTATION,
    Clocks,
    FieldRotation,
    axes,
    field_body,
    rotation_in,
    turning,
)
from magfusion.estimation.data_checks.statistics import DETECTION_SIGMAS
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, Array

NOT_AT_ALL = 5.0  # times more slowly than the gyroscope says, a field stands still
BETTER = 2.0  # times less misfit by the first explanation than by the next
MIN_LAG = 0.03  # s
LAG_LIMIT = 4.0  # sigma of the declared time offset
MIN_ANGLE = 6.0 * DEGREE
# Least deviation of the gyroscope's scale that is reported; iron on the body looks like tenths.
SCALE = 0.5
SCALE_EXPLAINED = 0.9  # of the turn by it


def turned_otherwise(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield how the gyroscope and the static field contradict each other.

    Without a site nothing is known of the mounting, so that only sign, scale and clock are judged.
    """
    if log.vectors is None or len(log.imu) < 2:
        return
    time, field = log.vectors.time, field_body(log, site)
    offset = 0.0 if site is None else site.platform.imu.time_offset
    rotation = turning(log.imu, time, field, offset)
    if len(rotation.change) < 12:
        return
    if not rotation.speed > MIN_ROTATION:
        yield from _turns_alone(log, site, rotation)
        return
    if site is None:
        # Of unknown axes the best there are.
        best = max(axes(), key=rotation.agreement)
        if rotation.agreement(best) > EXPLAINED:
            field = field @ (best if np.linalg.det(best) > 0.0 else -best)
            rotation = turning(log.imu, time, field, offset)
    scaled = rotation.explained(rotation.scale * np.eye(3))
    # Noise in the rates lets the scale seem smaller, noise in the field the inverse.
    deviation = min(abs(rotation.scale - 1.0), abs(rotation.scale / max(scaled, 1e-6) - 1.0))
    if deviation > SCALE and scaled > SCALE_EXPLAINED:
        yield _other_scale(rotation.scale, scaled)
        return
    clock = Clocks(log, time, field, offset)
    sigma = 0.01 if site is None else site.platform.imu.time_offset_sigma
    late = _other_clock(clock, rotation, max(MIN_LAG, LAG_LIMIT * sigma), offset)
    if late is not None:
        yield late
    elif rotation.explained(np.eye(3)) > CONTRADICTED:
        yield from _turned_little(rotation, site)
    else:
        left_handed = None if site is None else _left_handed(log, site, rotation)
        yield from _contradicted(rotation) if left_handed is None else (left_handed,)


def left_handed_field(log: Log, site: Site) -> Finding | None:
    """Return the axes of the magnetometer that are reversed, whatever its hard iron is."""
    rotation = rotation_in(log, site)
    return None if rotation is None else _left_handed(log, site, rotation)


def _left_handed(log: Log, site: Site, rotation: FieldRotation) -> Finding | None:
    """Return which axes of a field are reversed, by its rotation and by its angle to gravity.

    A field and its opposite rotate by the same turns: reversed axes and a mounting by half a turn
    differ in the angle between field and gravity, of which the Earth's field gives the sign.
    """
    earth = site.earth_field_world
    signs = [one for one in axes() if np.count_nonzero(np.diagonal(one)) == 3]
    turns = [one for one in signs if np.linalg.det(one) > 0.0]
    explained = {k: rotation.explained_shifted(one) for k, one in enumerate(turns)}
    best, second = sorted(explained, key=lambda k: explained[k][0])[:-3:-1]
    (share, offset), rest = explained[best], 1.0 - explained[second][0]
    if best == 0 or earth is None or share < EXPLAINED or BETTER * (1.0 - share) > rest:
        return None
    field, time = field_body(log, site), log.imu.time + site.platform.imu.time_offset
    assert log.vectors is not None
    force = [np.interp(log.vectors.time, time, axis) for axis in log.imu.accel_body.T]
    centred = field - offset * float(np.median(np.linalg.norm(field, axis=1)))
    upward = float(np.mean(np.sum(np.stack(force, axis=1) * (centred @ turns[best]), axis=1)))
    if upward * earth[2] > 0.0:  # a mounting by half a turn
        return None
    wrong = ", ".join(
        a for a, sign in zip("xyz", np.diagonal(turns[best]), strict=True) if sign > 0
    )
    return Finding(
        "magnetometer_axes",
        f"magnetometer: its axes are left-handed: {_words(rotation)}, and {_percent(share)} with"
        f" the sign of {wrong} (body axes) reversed. Correct the driver.",
        Verdict.FAILED,
        1e3,
    )


def _contradicted(rotation: FieldRotation) -> Iterator[Finding]:
    """Yield what explains a turn of the field that the gyroscope does not, as declared."""
    declared = rotation.explained(np.eye(3))
    ranked = sorted(axes(), key=rotation.explained)[::-1]
    best, explained = ranked[0], rotation.explained(ranked[0])
    if explained > EXPLAINED and BETTER * (1.0 - explained) < 1.0 - declared:
        single = BETTER * (1.0 - explained) < 1.0 - rotation.explained(ranked[1])
        yield _other_axes(rotation, best, single=single)
    elif rotation.expected_rate > MIN_ROTATION:
        yield Finding(
            "gyro_field",
            f"gyroscope: {_words(rotation)}, and no exchange of axes or sign explains more than"
            f" {_percent(max(explained, 0.0))}. An axis is dead, the clocks differ, or something"
            " magnetic moves with the platform. Compare both at a slow turn about each axis.",
            Verdict.DOUBTFUL,
            100.0,
        )


def _words(rotation: FieldRotation) -> str:
    share = _percent(rotation.explained(np.eye(3)))
    speed_deg = rotation.speed / DEGREE
    return (
        f"as declared, the gyroscope explains {share} of the turn of the static field (rms"
        f" {speed_deg:.0f} deg/s)"
    )


def _turned_little(rotation: FieldRotation, site: Site | None) -> Iterator[Finding]:
    """Yield a mounting that is off by degrees, which explains the turn far better."""
    if site is None:
        return
    turn, sigma, better = rotation.mounting()
    angle = float(np.linalg.norm(turn))
    known = float(np.max(site.platform.magnetometer.sigma.rotation_sensor))
    least = max(MIN_ANGLE, DETECTION_SIGMAS * float(np.hypot(known, sigma)))
    if better > BETTER and angle > least:
        axis = ", ".join(f"{v:+.2f}" for v in turn / angle)
        yield Finding(
            "mounting",
            f"magnetometer: its mounting differs by {angle / DEGREE:.0f} deg from body_from_sensor,"
            f" about ({axis}) in body axes: with that, the rotation of the static field differs"
            f" {better:.0f} times less from the gyroscope's. Correct rpy_deg of"
            " platform.magnetometer.body_from_sensor.",
            Verdict.DOUBTFUL,
            angle / MIN_ANGLE,
        )


def _turns_alone(log: Log, site: Site | None, rotation: FieldRotation) -> Iterator[Finding]:
    """Name a gyroscope that rotates while the field does not: a bias, or another unit."""
    mean, expected = np.mean(log.imu.gyro_body, axis=0), rotation.expected_rate
    words = (
        f"gyroscope: it measures {expected / DEGREE:.2g} deg/s (rms), and the static field does"
        " not rotate"
    )
    if not expected > max(MIN_ROTATION, NOT_AT_ALL * rotation.speed) or site is None:
        return
    imu = site.platform.imu
    rate_hz = 1.0 / float(np.median(np.diff(log.imu.time)))
    noise = float(np.median(np.abs(np.diff(log.imu.gyro_body, axis=0)))) / 0.6745 / np.sqrt(2.0)
    usual = imu.gyro_noise * np.sqrt(rate_hz / 2.0)
    bias = float(np.linalg.norm(mean))
    if usual and 0.5 < noise / usual * DEGREE < 2.0:
        yield Finding(
            "gyro_units",
            f"{words}; its noise is {noise / usual:.0f} times the declared one: it is in deg/s."
            " Multiply it by pi/180.",
            Verdict.FAILED,
            1e3,
        )
    elif bias > max(DETECTION_SIGMAS * imu.gyro_bias_sigma, 0.5 * expected):
        yield Finding(
            "imu_bias",
            f"{words}: a bias of ({', '.join(f'{v:+.3g}' for v in mean)}) rad/s,"
            f" {bias / imu.gyro_bias_sigma:.0f} sigma of the declared one. Remove it, or declare"
            " platform.imu.gyro_bias_sigma as large as it is.",
            Verdict.DOUBTFUL,
            bias / imu.gyro_bias_sigma,
        )


def _other_clock(
    clock: Clocks, rotation: FieldRotation, least: float, offset: float
) -> Finding | None:
    """Name a shift of the stamps that explains the turn far better, if it is at least so long."""
    (lag, by_lag), declared = clock.lag(), rotation.explained(np.eye(3))
    otherwise = max(rotation.explained(one) for one in axes()[1:])
    if not (
        abs(lag) > least
        and by_lag > max(EXPLAINED, otherwise)
        and BETTER * (1.0 - by_lag) < 1.0 - declared
    ):
        return None
    rate = clock.rate_error()
    if abs(rate) * clock.time[-1] > 0.5 * abs(lag) and abs(rate) > 1e-3:
        return Finding(
            "imu_clock",
            f"imu: its clock runs {100.0 * rate:+.2g} % off the magnetometer's, so that the streams"
            f" drift apart: {_words(rotation)}. Stamp both streams by one clock, or correct the"
            " sampling rate with which one was stamped.",
            Verdict.FAILED,
            1e3,
        )
    late = "late" if lag < 0.0 else "early"
    return Finding(
        "time_offset",
        f"imu: stamped {abs(lag):.2f} s too {late}: {_words(rotation)}, and {_percent(by_lag)} with"
        f" its samples shifted by {lag:+.3f} s. Stamp both streams by one clock, or declare"
        f" platform.imu.time_offset_s: {offset + lag:.3f}.",
        Verdict.FAILED,
        1e3,
    )


def _other_scale(scale: float, explained: float) -> Finding:
    cause, code = f"its scale is wrong by a factor of {1.0 / scale:.3g}", "gyro_scale"
    remedy = "Give rad/s, and check its range"
    if 0.8 < scale / DEGREE < 1.25:
        cause, remedy, code = "it is in deg/s", "Multiply it by pi/180", "gyro_units"
    elif 0.8e3 < scale < 1.25e3:
        cause, remedy, code = "it is a thousand times too small", "Give rad/s", "gyro_units"
    elif scale < 0.0:
        cause, remedy, code = "its sign is reversed", "Multiply it by -1", "gyro_sign"
    return Finding(
        code,
        f"gyroscope: {cause}: the static field rotates at {scale:.3g} of the measured rate, which"
        f" explains {_percent(explained)} of its rotation. {remedy}.",
        Verdict.FAILED,
        1e3,
    )


def _other_axes(rotation: FieldRotation, matrix: Array, *, single: bool) -> Finding:
    """Name axes that explain the turn; those of the gyroscope, or of the magnetometer."""
    words, explained = _words(rotation), rotation.explained(matrix)
    names = ", ".join(_named(row) for row in matrix)
    if np.linalg.det(matrix) < 0.0 and np.count_nonzero(np.diagonal(matrix)) == 3:
        wrong = ", ".join(a for a, sign in zip("xyz", np.diagonal(matrix), strict=True) if sign < 0)
        return Finding(
            "gyro_sign",
            f"gyroscope: the sign of {wrong} is reversed: {words}, with it reversed"
            f" {_percent(explained)}. Correct the driver.",
            Verdict.FAILED,
            1e3,
        )
    if np.linalg.det(matrix) < 0.0:
        return Finding(
            "imu_axes",
            f"gyroscope: its axes are left-handed: {words}, and with {names} as x, y, z"
            f" {_percent(explained)}. Exchange them in the driver.",
            Verdict.FAILED,
            1e3,
        )
    how = _in_words(matrix) if single else "by 90 or 180 deg"
    return Finding(
        "mounting",
        f"magnetometer and gyroscope are turned against each other {how} from what"
        f" body_from_sensor declares, or axes of one are permuted: {words}, with this"
        f" mounting {_percent(explained)}. Correct rpy_deg of"
        " platform.magnetometer.body_from_sensor, or the driver's axes.",
        Verdict.FAILED,
        1e3,
    )


def _in_words(matrix: Array) -> str:
    """Return a turn by quarters in words."""
    angle = float(np.arccos(np.clip(0.5 * (np.trace(matrix) - 1.0), -1.0, 1.0))) / DEGREE
    names = ", ".join(_named(row) for row in matrix)
    return f"by {angle:.0f} deg (x, y, z are {names})"


def _named(row: Array) -> str:
    k = int(np.argmax(np.abs(row)))
    return f"{'-' if row[k] < 0.0 else ''}{'xyz'[k]}"


def _percent(share: float) -> str:
    return f"{100.0 * max(share, 0.0):.0f} %"
