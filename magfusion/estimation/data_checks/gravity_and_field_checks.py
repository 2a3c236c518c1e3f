"""Checks of gravity and the static field, independent of the beacons.

Both are averaged over seconds in gyro-stabilized axes, which suppresses motion: on real and on
fast motion the size of gravity is right to 0.1 m/s^2, that of the field to half a percent, and the
angle between them to a degree or two.  Wrong units, missing gravity, wrong signs, an instrument
rotated by 90 deg, or iron on the body therefore show within the first seconds.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.field_rotation import agrees, axes
from magfusion.estimation.data_checks.statistics import DETECTION_SIGMAS
from magfusion.estimation.data_checks.still_means import (
    SPAN,
    StillMeans,
    angle_between,
    still_means,
)
from magfusion.model.platform_motion import A_HAND
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

FORCE_LIMIT = 5.0  # sigma of the accelerometer's bias
MISSING = 0.35  # of gravity; less of it is no gravity
UNIT = 0.06  # relative; as near gravity in another unit must be
STEADY = 0.15  # relative scatter of what is gravity in another unit
NEAR = 1.0  # s; largest time difference of a pose
LEVEL_FIELD = 0.05  # least horizontal share of the field that gives a heading
TILT = 0.05  # rad; of the mean vertical where motion is fast
CLEAR = 0.5  # cosine; beyond which a vertical points up or down
UNITS_OF_FORCE = (
    ("g", 1.0 / STANDARD_GRAVITY),
    ("mg", 1e3 / STANDARD_GRAVITY),
    ("cm/s^2 (Gal)", 1e2),
    ("mm/s^2", 1e3),
)


def gravity_and_field_findings(
    log: Log,
    site: Site | None,
    poses: Trajectory | None = None,
    estimated: Trajectory | None = None,
) -> Iterator[Finding]:
    """Yield inconsistencies of gravity and static field with the accelerometer and the site.

    The gyroscope, which stabilizes the axes, must be correct. `poses`: by the beacons: they decide
    which of vertical and field is wrong. `estimated`: by an estimator that also used gravity;
    decides the cause of a reversed vertical.
    """
    means = still_means(log, site)
    if len(means) == 0:
        return
    of_force = list(_turned_by_gyroscope(log, means, site)) or list(wrong_force(means, site))
    yield from of_force
    failed = any(finding.verdict is Verdict.FAILED for finding in of_force)
    if site is None or failed:
        return
    here = None if poses is None else _at(means, poses)
    tilted = list(_tilted(here, site)) if here is not None else []
    yield from tilted
    if site.earth_field_world is None or log.vectors is None:
        return
    yield from wrong_size(means, site)
    if here is None:
        upright = None if estimated is None else _upright(means, estimated)
        yield from wrong_dip(means, site, mounted=agrees(log, site), upright=upright)
    elif not tilted:
        yield from wrong_field(here, site)


def _turned_by_gyroscope(log: Log, means: StillMeans, site: Site | None) -> Iterator[Finding]:
    """Yield a gyroscope fault: gravity has its size but no constant direction in its axes."""
    gravity = STANDARD_GRAVITY if site is None else site.gravity
    body = float(np.median(np.linalg.norm(log.imu.accel_body, axis=1)))
    still = float(np.median(np.linalg.norm(means.force_body, axis=1)))
    if still > MISSING * gravity or abs(body / gravity - 1.0) > UNIT:
        return
    findings = (
        f"gyroscope: the specific force has the size of gravity ({body:.3g} m/s^2) but no constant"
        f" direction in gyro-stabilized axes (mean {still:.3g} m/s^2)"
    )
    slower = replace(log, imu=replace(log.imu, gyro_body=DEGREE * log.imu.gyro_body))
    cleaned = still_means(slower, site).force_body
    if float(np.median(np.linalg.norm(cleaned, axis=1))) > (1.0 - UNIT) * body:
        yield Finding(
            "gyro_units", f"{findings}: it is in deg/s. Multiply it by pi/180.", Verdict.FAILED, 2e3
        )
        return
    yield Finding(
        "gyro_sign",
        f"{findings}: the gyroscope's signs, axes or unit are wrong. Rotate it by 90 deg about each"
        " axis and compare.",
        Verdict.FAILED,
        2e3,
    )


def _other_unit(force_body: Array, gravity: float) -> str:
    """Return in which unit all axes are, or one, and the remedy; empty if in none."""
    every = {"it": np.ones(3)} | dict(zip(("its x", "its y", "its z"), np.eye(3), strict=True))
    for unit, factor in UNITS_OF_FORCE:
        for which, chosen in every.items():
            converted = np.linalg.norm(force_body * np.where(chosen, 1.0 / factor, 1.0), axis=1)
            mean = float(np.median(converted))
            if abs(mean / gravity - 1.0) < UNIT and np.std(converted) < STEADY * mean:
                return f"{which} is in {unit}. Multiply it by {1.0 / factor:.6g}"
    return ""


def wrong_force(means: StillMeans, site: Site | None) -> Iterator[Finding]:
    """Yield errors of the mean specific force: its unit, missing gravity, or its size."""
    gravity = STANDARD_GRAVITY if site is None else site.gravity
    sizes = np.linalg.norm(means.force_body, axis=1)
    size, scatter = float(np.median(sizes)), float(np.std(sizes))
    findings = (
        f"accelerometer: the mean specific force in gyro-stabilized axes is {size:.3g} m/s^2,"
        f" gravity is {gravity:.4g}"
    )
    unit = _other_unit(means.force_body, gravity) if abs(size / gravity - 1.0) > UNIT else ""
    if unit:
        yield Finding("accel_units", f"{findings}: {unit}.", Verdict.FAILED, 2e3)
        return
    if size < MISSING * gravity:
        yield Finding(
            "gravity_missing",
            f"{findings}: a driver has removed gravity ('linear acceleration'), or the platform"
            " is in free fall. Record the raw specific force.",
            Verdict.FAILED,
            2e3,
        )
        return
    bias = 0.1 if site is None else site.platform.imu.accel_bias_sigma
    motion = A_HAND if site is None else site.platform.motion
    # The change of velocity within a span adds to gravity; few spans determine it poorly.
    usual = np.sqrt(2.0 / 3.0) * motion.speed_sigma / SPAN
    sigma = np.hypot(bias, np.hypot(scatter, usual / np.sqrt(len(sizes))) / np.sqrt(len(sizes)))
    if abs(size - gravity) > max(FORCE_LIMIT * sigma, 0.02 * gravity):
        yield Finding(
            "accel_scale",
            f"{findings}, off by {abs(size - gravity) / sigma:.1f} sigma of the declared bias: its"
            " scale, a bias, or world.gravity_m_s2 is wrong. Calibrate it in six positions.",
            Verdict.DOUBTFUL,
            abs(size - gravity) / sigma,
        )


def wrong_size(means: StillMeans, site: Site) -> Iterator[Finding]:
    """Yield a static field whose size differs from the declared Earth field."""
    assert site.earth_field_world is not None
    declared = float(np.linalg.norm(site.earth_field_world))
    sizes = np.linalg.norm(means.field_body, axis=1)
    size, sensor = float(np.median(sizes)), site.platform.magnetometer
    sigma = float(
        np.hypot(
            declared * np.hypot(site.earth.strength_sigma, np.max(sensor.sigma.matrix)),
            np.max(sensor.sigma.offset),
        )
    )
    off = abs(size - declared)
    if not off > max(DETECTION_SIGMAS * sigma, 0.1 * declared):
        return
    factor = size / declared
    unit = next(
        (u for u, f in (("gauss", 1e4), ("uT", 1e6), ("nT", 1e9)) if 0.5 < factor / f < 2.0), None
    )
    inverse = next((u for u, f in (("gauss", 1e4), ("uT", 1e6)) if 0.5 < 1 / factor / f < 2), None)
    if unit is not None:
        code, cause = "field_units", f"it is in {unit}, or earth_field_t is not in T. Use tesla"
    elif inverse is not None:
        code, cause = "earth_field", f"earth_field_t is in {inverse}. Use tesla"
    else:
        code = "earth_field"
        cause = (
            "iron or a magnet is on or near the body all along, or earth_field_t is of another"
            " place. Calibrate the magnetometer where it is mounted"
        )
    yield Finding(
        code,
        f"magnetometer: the static field is {1e6 * size:.3g} uT (median), declared"
        f" {1e6 * declared:.3g} uT, {off / sigma:.1f} sigma off: {cause}.",
        Verdict.DOUBTFUL,
        min(off / sigma, 1e3),
    )


def wrong_dip(
    means: StillMeans, site: Site, *, mounted: bool = False, upright: bool | None = None
) -> Iterator[Finding]:
    """Yield an angle between vertical and field that differs from the declared Earth field's.

    `mounted`: whether gyroscope and field agree, so that the mounting is as declared. `upright`:
    whether the poses have the accelerometer's vertical pointing up; None where unknown.
    """
    assert site.earth_field_world is not None
    declared = float(angle_between(np.array([0.0, 0.0, 1.0]), site.earth_field_world))
    angle, sigma = float(np.median(means.angle)), _dip_sigma(means, site)
    if not abs(angle - declared) > DETECTION_SIGMAS * sigma:
        return
    findings = (
        f"the angle between static field and accelerometer's vertical is {angle / DEGREE:.0f} deg,"
        f" of the declared Earth field {declared / DEGREE:.0f} deg"
        f" ({abs(angle - declared) / sigma:.0f} sigma)"
    )
    if abs(np.pi - angle - declared) < DETECTION_SIGMAS * sigma:
        code, cause = _reversed(means, mounted=mounted, upright=upright)
    else:
        cause = (
            "the mounting of magnetometer or inertial sensor differs from the declared one, axes"
            " are permuted, iron disturbs the field, or earth_field_t is of another place"
        )
        code = "mounting"
    yield Finding(code, f"{findings}: {cause}.", Verdict.DOUBTFUL, abs(angle - declared) / sigma)


def _upright(means: StillMeans, poses: Trajectory) -> bool | None:
    """Return whether the poses have the accelerometer's vertical up; None where neither way."""
    here = _at(means, poses)
    if here is None:
        return None
    up = float(np.median(here.up[:, 2] / np.linalg.norm(here.up, axis=1)))
    return up > 0.0 if abs(up) > CLEAR else None


def _reversed(means: StillMeans, *, mounted: bool, upright: bool | None) -> tuple[str, str]:
    """Return code and cause of a reversed vertical."""
    level = float(np.median(means.force_body[:, 2])) > 0.7 * STANDARD_GRAVITY
    of_sign = "the accelerometer's sign is reversed (level and stationary it reads +g on z)"
    of_earth = "earth_field_t is of the other hemisphere (its z is up)"
    of_mounting = "magnetometer or inertial sensor is mounted upside down"
    if upright:
        return "earth_field", of_earth
    if level and mounted and upright is None:
        return "earth_field", f"{of_earth}, or {of_sign}"
    if level and upright is None:
        return "mounting", f"{of_mounting}, or {of_earth}"
    return "gravity_sign", f"{of_sign}, or {of_earth}{'' if mounted else f', or {of_mounting}'}"


def _dip_sigma(means: StillMeans, site: Site) -> float:
    """Return the prior sigma of the angle between vertical and field (rad)."""
    sensor, imu = site.platform.magnetometer, site.platform.imu
    assert site.earth_field_world is not None
    field = float(np.linalg.norm(site.earth_field_world))
    parts = [
        site.earth.strength_sigma,
        float(np.max(sensor.sigma.matrix)),
        float(np.max(sensor.sigma.offset)) / field,
        float(np.max(sensor.sigma.rotation_sensor)),
        imu.accel_bias_sigma / site.gravity,
        float(np.std(means.angle)) / np.sqrt(len(means)),
    ]
    return float(np.sqrt(np.sum(np.square(parts))))


class _InWorld(NamedTuple):
    """Specific force and field, rotated to world axes by the attitudes of poses, shape (n, 3)."""

    up: Array
    field: Array
    force_body: Array
    up_body: Array


def _at(means: StillMeans, poses: Trajectory) -> _InWorld | None:
    spans, _, attitude = means.near(poses, NEAR)
    if not len(spans):
        return None
    return _InWorld(
        _rotated(attitude, means.force_body[spans]),
        _rotated(attitude, means.field_body[spans]),
        means.force_body[spans],
        attitude[:, 2],
    )


def _rotated(attitude: Array, vector_body: Array) -> Array:
    return np.asarray((attitude @ vector_body[..., None])[..., 0])


def _tilted(here: _InWorld, site: Site) -> Iterator[Finding]:
    """Yield an accelerometer's vertical that differs from that of the poses."""
    tilt = float(np.median(angle_between(here.up, np.array([0.0, 0.0, 1.0]))))
    sigma = float(np.hypot(site.platform.imu.accel_bias_sigma / site.gravity, TILT))
    if not tilt > DETECTION_SIGMAS * sigma:
        return
    reversed_ = _is_reversed(here)
    cause = (
        "the accelerometer's sign is reversed (level and stationary it reads +g on z)"
        if reversed_
        else "the mounting of magnetometer or inertial sensor differs from the declared one, axes"
        " are permuted, or the declared attitudes of beacons are wrong"
    )
    yield Finding(
        "gravity_sign" if reversed_ else "mounting",
        f"the accelerometer's vertical is {tilt / DEGREE:.0f} deg off the vertical of the beacon"
        f" poses: {cause}.",
        Verdict.FAILED,
        500.0 + tilt / sigma,
    )


def _is_reversed(here: _InWorld) -> bool:
    """Return whether a reversed sign fits the vertical better than any 90 deg rotation."""
    force = here.force_body / np.linalg.norm(here.force_body, axis=1, keepdims=True)
    best = min(axes(), key=lambda one: float(np.sum((here.up_body @ one.T - force) ** 2)))
    return bool(np.array_equal(best, -np.eye(3)))


def wrong_field(here: _InWorld, site: Site) -> Iterator[Finding]:
    """Yield a static field that points elsewhere than declared, by poses of correct vertical."""
    earth = site.earth_field_world
    assert earth is not None
    field = np.median(here.field / np.linalg.norm(here.field, axis=1, keepdims=True), axis=0)
    size = float(np.linalg.norm(earth))
    across = float(np.hypot(earth[0], earth[1])) / size
    dip = float(angle_between(field, np.array([0.0, 0.0, 1.0])))
    off_dip = dip - float(angle_between(earth, np.array([0.0, 0.0, 1.0])))
    sensor = site.platform.magnetometer
    known = float(np.max(sensor.sigma.matrix)) + float(np.max(sensor.sigma.offset)) / size
    sigma = float(np.hypot(np.hypot(site.earth.strength_sigma, known), TILT))
    heading = float(np.arctan2(field[1], field[0]) - np.arctan2(earth[1], earth[0]))
    heading = (heading + np.pi) % (2.0 * np.pi) - np.pi
    of_heading = float(np.hypot(site.earth.declination_sigma, sigma / max(across, 1e-3)))
    findings = (
        f"the static field at the estimated poses is {dip / DEGREE:.0f} deg from the vertical"
    )
    if abs(off_dip) > DETECTION_SIGMAS * sigma:
        yield Finding(
            "earth_field",
            f"{findings}, earth_field_t {(dip - off_dip) / DEGREE:.0f} deg; gravity agrees with the"
            " poses: earth_field_t is of another place or hemisphere (its z is up), or iron"
            " distorts the field.",
            Verdict.DOUBTFUL,
            abs(off_dip) / sigma,
        )
    elif abs(heading) > DETECTION_SIGMAS * of_heading and across > LEVEL_FIELD:
        yield Finding(
            "earth_field",
            "the heading of the static field at the estimated poses differs from earth_field_t by"
            f" {heading / DEGREE:+.0f} deg: earth_field_t is not in the axes of the beacons'"
            " survey, or iron distorts the field.",
            Verdict.DOUBTFUL,
            abs(heading) / of_heading,
        )
