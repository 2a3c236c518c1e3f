"""What people get wrong of the inertial sensor and of how the magnetometer is mounted on it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.corrected_site import (
    turned_survey,
    with_gravity,
    with_imu,
    with_intrinsics,
    with_magnetometer,
)
from magfusion.estimation.integrity.explanation import CLEARLY, Explanation
from magfusion.estimation.integrity.fault_candidates import MAX_SIZE
from magfusion.estimation.integrity.motion_comparison import SHARED, Compared, Surveyed, compared
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.files.site_plain import rpy_deg
from magfusion.model.parameters.inertial import ACCEL_BIAS, GYRO_BIAS
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

GYRO_UNITS = {
    "in degrees per second": DEGREE,
    "in milliradians per second": 1e-3,
    "in units a thousand times as large": 1e3,
    "in radians per second, and were converted from degrees": 1.0 / DEGREE,
    "in revolutions per minute": 2.0 * np.pi / 60.0,
}
ACCEL_UNITS = {
    "in g": STANDARD_GRAVITY,
    "in mg": 1e-3 * STANDARD_GRAVITY,
    "in cm/s^2": 1e-2,
    "in mm/s^2": 1e-3,
}
MAX_DELAY = 3.0  # s
MAX_DRIFT = 0.1  # s, that two streams drift apart; a window is a few tenths long
PARTS = 4  # of a log, in each of which a delay is sought
DOUBT_SIGMAS = 3.0  # sigmas of a declared time offset
EYE = np.eye(3)
OF_AXES = "Check the order and the signs of the IMU's axes, and body_from_sensor."


def motion_causes(known: Compared, site: Site) -> Iterator[Explanation]:
    """Yield what a mistake in axes, signs, units, mounting or lever arm would explain."""
    before, _ = known.explained(EYE, EYE)

    def tried(
        code: str,
        cause: str,
        remedy: str,
        gyro_axes: Array,
        accel_axes: Array,
        gravity: float = 1.0,
    ) -> Explanation:
        after, _ = known.explained(gyro_axes, accel_axes, gravity=gravity)
        inverse = [np.asarray(np.linalg.inv(axes), dtype=float) for axes in (gyro_axes, accel_axes)]
        corrected = with_intrinsics(site, *inverse) if gravity else with_gravity(site, 0.0)
        return Explanation(code, cause, remedy, before, after, known.freedom, site=corrected)

    yield from _rotated_axes(known, before, site)
    yield from _axes(tried)
    imu = "Check gyro_x/y/z and accel_x/y/z: right-handed axes, rad/s, m/s^2, +g on z at rest."
    for words, unit in ACCEL_UNITS.items():
        yield tried("accel_units", f"the specific forces are {words}", imu, EYE, unit * EYE)
        for axis, one in zip("xyz", EYE, strict=True):
            cause = f"the specific force on {axis} is {words}"
            yield tried("accel_units", cause, imu, EYE, np.diag(np.where(one, unit, 1.0)))
    yield tried(
        "gravity_missing",
        "gravity was removed from the specific force",
        "Record the specific force as the sensor measures it: +g on z at rest, level.",
        EYE,
        EYE,
        gravity=0.0,
    )
    yield _upside_down(known, before, site)
    yield _scaled(known, before, site)
    yield from _accel_scaled(known, before, site)
    yield from _released(known, before, site)


def _rotated_axes(known: Compared, before: float, site: Site) -> Iterator[Explanation]:
    """Yield what quarter turns of the magnetometer in its mounting, or of the IMU, would explain.

    Both rotate together; but the lever arm, declared in the IMU's axes, turns with the IMU alone.
    """
    lever = site.platform.magnetometer.position_body
    for axes in signed_permutations():
        if np.linalg.det(axes) < 0 or np.allclose(axes, EYE):
            continue
        by = f"by {Rotation.from_matrix(axes).magnitude() / DEGREE:.0f} degrees"
        right = axes.T @ site.platform.magnetometer.body_from_sensor
        mounted = Explanation(
            "mounting",
            "the magnetometer's axes are turned in the IMU's against those that its mounting"
            f" declares, {by}",
            _mounting_remedy(site, axes),
            before,
            known.explained(axes, axes, lever=lever - axes @ lever)[0],
            known.freedom,
            site=with_magnetometer(site, body_from_sensor=right),
        )
        rotated = Explanation(
            "mounting",
            f"the IMU's axes are turned against those that the mounting declares, {by}: x, y, z"
            f" are {_named(axes)}",
            OF_AXES,
            before,
            known.explained(axes, axes)[0],
            known.freedom,
            site=with_intrinsics(site, axes.T, axes.T),
        )
        yield replace(mounted, rival=rotated)
        yield replace(rotated, rival=mounted)


def with_quarter_turn(known: Compared, site: Site) -> Site | None:
    """Return a site with its magnetometer's axes turned as the motion requires, by its matrix.

    None where no signed permutation explains the motion clearly better than the others.
    """
    sensor = site.platform.magnetometer
    lever, mounting = sensor.position_body, sensor.body_from_sensor
    turns = [axes for axes in signed_permutations() if np.linalg.det(axes) > 0.0]
    costs = [known.explained(axes, axes, lever=lever - axes @ lever)[0] for axes in turns]
    first, second = np.argsort(costs)[:2]
    if costs[second] < CLEARLY * costs[first]:
        return None
    turn = mounting.T @ turns[first] @ mounting
    return with_magnetometer(site, matrix=sensor.matrix @ turn)


def _released(known: Compared, before: float, site: Site) -> Iterator[Explanation]:
    """Yield what a lever arm, a mounting or a bias beyond its prior would explain."""
    after, estimate = known.explained(EYE, EYE, parameters="lever")
    lever = site.platform.magnetometer.position_body - estimate[SHARED["lever"]]
    yield Explanation(
        "lever_arm",
        f"the lever arm is ({_listed(lever)}) m",
        "Measure platform.magnetometer.body_from_sensor.position_m: the magnetometer's place in"
        " the IMU's axes.",
        before,
        after,
        known.freedom,
        3,
        site=with_magnetometer(site, position_body=lever),
    )
    turn, axes = Rotation.identity(), EYE
    for _ in range(4):
        after, estimate = known.explained(axes, axes, parameters="mounting")
        turn = Rotation.from_rotvec(estimate[SHARED["mounting"]]) * turn
        axes = turn.as_matrix()
    yield Explanation(
        "mounting",
        f"the IMU's axes are turned by {turn.magnitude() / DEGREE:.3g} degrees against those that"
        f" the mounting declares, about ({_listed(_axis(turn))}) of the body",
        _mounting_remedy(site, axes),
        before,
        after,
        known.freedom,
        3,
        site=with_magnetometer(
            site, body_from_sensor=axes.T @ site.platform.magnetometer.body_from_sensor
        ),
    )
    for sensor, unit, bias in (("gyro", "rad/s", GYRO_BIAS), ("accel", "m/s^2", ACCEL_BIAS)):
        after, estimate = known.explained(EYE, EYE, parameters=sensor)
        if np.max(np.abs(estimate[SHARED[sensor]])) > MAX_SIZE[bias]:
            continue
        yield Explanation(
            "imu_bias",
            f"the bias of the {'gyro' if sensor == 'gyro' else 'accelerometer'} is"
            f" ({_listed(estimate[SHARED[sensor]])}) {unit}, beyond its declared sigma",
            f"Calibrate it, or declare a larger {sensor}_bias_sigma.",
            before,
            after,
            known.freedom,
            3,
        )


def _upside_down(known: Compared, before: float, site: Site) -> Explanation:
    """Return what a survey in axes north, east, down would explain."""
    after, _ = known.explained(EYE, EYE, gravity=-1.0)
    turn, earth = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), None
    if site.earth_field_world is not None:
        earth = turn @ site.earth_field_world
    return Explanation(
        "survey_axes",
        "the survey's axes are north, east, down",
        "Give all vectors of world in axes east, north, up, the beacons' attitudes, too.",
        before,
        after,
        known.freedom,
        site=replace(turned_survey(site, turn), earth_field_world=earth),
    )


def _mounting_remedy(site: Site, axes: Array) -> str:
    angles = np.round(rpy_deg(axes.T @ site.platform.magnetometer.body_from_sensor), 3) + 0.0
    return (
        "Check the axes of IMU and magnetometer; body_from_sensor would be rpy_deg"
        f" [{', '.join(f'{angle:.3g}' for angle in angles)}]."
    )


def _axis(turn: Rotation) -> Array:
    vector = turn.as_rotvec()
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _listed(values: Array) -> str:
    return ", ".join(f"{value:.3g}" for value in np.round(values, 6) + 0.0)


def _scaled(known: Compared, before: float, site: Site) -> Explanation:
    trials = np.linspace(0.8, 1.25, 46)
    costs = [known.explained(scale * EYE, EYE)[0] for scale in trials]
    best = int(np.argmin(costs))
    return Explanation(
        "gyro_scale",
        f"the angular rates are {1.0 / trials[best]:.3g} times the true ones",
        "Calibrate the gyro's scale.",
        before,
        costs[best],
        known.freedom,
        1,
        site=with_intrinsics(site, gyro=EYE / trials[best]),
    )


def _accel_scaled(known: Compared, before: float, site: Site) -> Iterator[Explanation]:
    trials = np.linspace(0.9, 1.1, 41)
    costs = [known.explained(EYE, scale * EYE)[0] for scale in trials]
    best = int(np.argmin(costs))
    yield Explanation(
        "accel_scale",
        f"the specific forces are {1.0 / trials[best]:.3g} times what the declared gravity gives",
        "Check world.gravity_m_s2, and the scale of the accelerometer.",
        before,
        costs[best],
        known.freedom,
        1,
        site=with_intrinsics(site, accel=EYE / trials[best]),
    )


def _axes(tried: Callable[[str, str, str, Array, Array], Explanation]) -> Iterator[Explanation]:
    for axes in signed_permutations():
        words = _named(axes)
        if np.allclose(axes, EYE):
            continue
        if np.linalg.det(axes) < 0:
            yield tried("imu_axes", f"x, y, z of the IMU are {words}", OF_AXES, axes, axes)
        flips = np.allclose(np.abs(axes), EYE)
        gyro = "gyro_sign" if flips and np.linalg.det(axes) < 0 else "imu_axes"
        yield tried(gyro, f"x, y, z of the gyro are {words}", OF_AXES, axes, EYE)
        accel = "gravity_sign" if np.allclose(axes, -EYE) else "imu_axes"
        cause = f"x, y, z of the accelerometer are {words}"
        if accel == "gravity_sign":
            cause = "the specific force has the wrong sign (-g on z at rest)"
        yield tried(accel, cause, OF_AXES, EYE, axes)


def signed_permutations() -> Iterator[Array]:
    """Yield all 48 orders and signs of three axes, as matrices."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield np.diag(signs) @ EYE[list(order)]


def _named(axes: Array) -> str:
    """Return which of the true axes each column of the file is."""
    names = []
    for column in axes.T:
        k = int(np.argmax(np.abs(column)))
        names.append(("-" if column[k] < 0 else "") + "xyz"[k])
    return ", ".join(names)


def gyro_unit_causes(
    known: Surveyed, imu: ImuSamples, site: Site, before: float, freedom: float
) -> Iterator[Explanation]:
    """Yield what another unit of the angular rates would explain."""
    for words, unit in GYRO_UNITS.items():
        converted = ImuSamples(imu.time, unit * imu.gyro_body, imu.accel_body)
        tried = compared(known, converted, site)
        if tried is not None:
            yield Explanation(
                "gyro_units",
                f"the angular rates are {words}",
                "Give gyro_x/y/z in rad/s.",
                before,
                tried.explained(EYE, EYE)[0],
                freedom,
                site=with_intrinsics(site, gyro=EYE / unit),
            )


def timing_causes(
    known: Surveyed, imu: ImuSamples, site: Site, before: float, freedom: float
) -> Iterator[Explanation]:
    """Yield what another time, or another rate, of the inertial stamps would explain."""
    whole = compared(known, imu, site)
    if whole is None or not np.any(
        np.std(whole.gyro_turned, axis=0) > 3.0 * np.median(whole.turn_sigma)
    ):
        return  # what does not turn tells no time
    fixes = known.fixes
    edges = np.linspace(0, len(fixes), PARTS + 1).astype(np.int64).tolist()
    late = [_delay(fixes, imu, site, slice(*part)) for part in pairwise(edges)]
    measured = [(at, value) for at, value in late if np.isfinite(value)]
    if len(measured) < 2:
        return
    at, value = np.array(measured).T
    middle = float(np.median(value))
    steady = compared(known, imu, site, late=middle)
    offset = np.inf
    if steady is not None:
        after, _ = steady.explained(EYE, EYE)
        offset = after
    # What every estimator finds, as its sigma says that it may be, is no mistake.
    if steady is not None and abs(middle) > DOUBT_SIGMAS * site.platform.imu.time_offset_sigma:
        yield Explanation(
            "time_offset",
            f"the inertial stamps are {middle:.3g} s late against the magnetometer's",
            "Correct the stamps, or declare platform.imu.time_offset_s.",
            before,
            offset * freedom / steady.freedom,
            freedom,
            1,
            site=with_imu(site, time_offset=site.platform.imu.time_offset - middle),
        )
    if len(measured) < 3:
        return
    rate, start = np.polyfit(at, value, 1)
    if abs(rate) < 1e-4:
        return
    stamps = (imu.time - start) / (1.0 + rate)
    again = compared(known, ImuSamples(stamps, imu.gyro_body, imu.accel_body), site)
    if again is not None:
        after, _ = again.explained(EYE, EYE)
        if after > 0.7 * offset:
            return  # a delay says as much
        yield Explanation(
            "imu_clock",
            f"the inertial stamps run {1e6 * rate:.4g} ppm fast against the magnetometer's",
            "Check the sample rate with which the stamps were made.",
            before,
            after * freedom / again.freedom,
            freedom,
            2,
            site=_on_clock(site, imu.time, rate, start),
        )


def _on_clock(site: Site, stamps: Array, rate: float, start: float) -> Site | None:
    """Return a site whose inertial stamps are late by ``start + rate * t``; None where too much.

    Of the streams, only the constant part of a declared offset is corrected.
    """
    if abs(rate) * (stamps[-1] - stamps[0]) > MAX_DRIFT:
        return None
    clock = site.platform.imu
    late = (start + rate * (stamps[0] + clock.time_offset)) / (1.0 + rate)
    return with_imu(
        site,
        time_offset=clock.time_offset - late,
        clock_rate=(1.0 + clock.clock_rate) / (1.0 + rate) - 1.0,
    )


def _delay(fixes: Fixes, imu: ImuSamples, site: Site, part: slice) -> tuple[float, float]:
    """Return the middle of a part of the log, and what its inertial stamps are late by (s).

    The sizes of the turns are compared, which hang on no axis.
    """
    time = fixes.time[part]
    rate = np.linalg.norm(imu.gyro_body, axis=1)
    stamps = imu.time + site.platform.imu.time_offset
    total = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(stamps))])
    turn = fixes.world_from_body[part, 0]
    angle = Rotation.from_matrix(np.swapaxes(turn[:-1], 1, 2) @ turn[1:]).magnitude()
    trial = np.arange(-MAX_DELAY, MAX_DELAY, 0.01)
    edges = np.interp(time[:, None] + trial, stamps, total)
    seen = np.diff(edges, axis=0)
    cost = np.sum((seen - angle[:, None]) ** 2, axis=0)
    best = int(np.argmin(cost))
    usual = float(np.median(cost))
    if not 0 < best < len(trial) - 1 or cost[best] > 0.5 * usual:
        return float(np.mean(time)), np.nan
    before_it, at, right = cost[best - 1 : best + 2]
    fine = 0.5 * (before_it - right) / (before_it - 2.0 * at + right)
    return float(np.mean(time)), float(trial[best] + 0.01 * fine)
