"""Two free compasses that know of no beacon: gravity and the steady field.

Both are averaged over seconds in axes that the gyroscope keeps still, which motion changes little:
on real and on fast motion the size of gravity is right to 0.1 m/s^2, that of the field to half a
percent, and the angle between them to a degree or two.  So units, gravity's absence, signs, a
quarter turn of one instrument, or iron on the body show in the first seconds, without any beacon.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.turning import agrees, axes, field_body
from magfusion.model.platform_motion import A_HAND
from magfusion.model.quaternion import inverse, matrices, turned
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.strapdown import turn_from_gyro
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

SPAN = 4.0  # s; over which specific force and field are averaged
FULL = 0.8  # of a span's samples that must be there
LIMIT = 6.0  # sigma
FORCE_LIMIT = 5.0  # sigma of the accelerometer's bias
MISSING = 0.35  # of gravity; less of it is no gravity
UNIT = 0.06  # relative; as near gravity in another unit must be
STEADY = 0.15  # relative scatter of what is gravity in another unit
NEAR = 1.0  # s; as near in time a pose must be
LEVEL_FIELD = 0.05  # of the field's size across the vertical; with less it has no heading
TILT = 0.05  # rad; of the mean vertical where motion is fast
CLEAR = 0.5  # cosine; beyond which a vertical points up or down
UNITS_OF_FORCE = (
    ("g", 1.0 / STANDARD_GRAVITY),
    ("mg", 1e3 / STANDARD_GRAVITY),
    ("cm/s^2 (Gal)", 1e2),
    ("mm/s^2", 1e3),
)


@dataclass(frozen=True, eq=False)
class StillMeans:
    """Specific force and field, averaged over spans in axes that stand still.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Middle of each span, on the log's clock (s).
    force_body, field_body : ndarray, shape (n, 3)
        In the body's axes at that time (m/s^2, T); the field is NaN where there is none.
    still_from_body : ndarray, shape (n, 3, 3)
        Attitude at that time, by the gyroscope from the log's first sample on.
    """

    time: Array
    force_body: Array
    field_body: Array
    still_from_body: Array

    def __len__(self) -> int:
        return len(self.time)

    @property
    def angle(self) -> Array:
        """Between vertical and field (rad), shape (n,)."""
        return _angle(self.force_body, self.field_body)


def still_means(log: Log, site: Site | None, span: float = SPAN) -> StillMeans:
    """Average specific force and field over spans of a log (s)."""
    imu = log.imu
    offset = 0.0 if site is None else site.platform.imu.time_offset
    time = imu.time + offset
    nothing = StillMeans(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    if len(time) < 2 or not log.inertial:
        return nothing
    still_from_body = turn_from_gyro(imu.time, imu.gyro_body)
    force = turned(still_from_body, imu.accel_body.T).T
    field = np.full_like(force, np.nan)
    if log.vectors is not None:
        known = field_body(log, site)
        body = [np.interp(time, log.vectors.time, c) for c in known.T]
        field = turned(still_from_body, np.stack(body)).T
    number = np.floor((time - time[0]) / span).astype(np.int64)
    count = np.bincount(number)
    full = count > FULL * span / float(np.median(np.diff(time)))
    if not np.any(full):
        return nothing
    middle = time[0] + span * (np.flatnonzero(full) + 0.5)
    nearest = np.clip(np.searchsorted(time, middle), 0, len(time) - 1)
    still_from_body = still_from_body[:, nearest]

    def mean(value: Array) -> Array:
        total = np.stack([np.bincount(number, column) for column in value.T], axis=1)
        return turned(inverse(still_from_body), (total[full] / count[full, None]).T).T

    return StillMeans(time[nearest], mean(force), mean(field), matrices(still_from_body))


def _angle(a: Array, b: Array) -> Array:
    size = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    cosine = np.sum(a * b, axis=-1) / np.maximum(size, 1e-30)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def wrong_compasses(
    log: Log,
    site: Site | None,
    poses: Trajectory | None = None,
    estimated: Trajectory | None = None,
) -> Iterator[Finding]:
    """Yield what gravity and the steady field say against the accelerometer and the site.

    The axes are kept still by the gyroscope, which must be right.

    Parameters
    ----------
    poses : Trajectory, optional
        By the beacons: they tell whether vertical or field is wrong, where both disagree.
    estimated : Trajectory, optional
        By an estimator that used gravity too: of a reversed vertical they tell whose it is.
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
    """Yield that it is the gyroscope by which a specific force of gravity's size keeps no way."""
    gravity = STANDARD_GRAVITY if site is None else site.gravity
    body = float(np.median(np.linalg.norm(log.imu.accel_body, axis=1)))
    still = float(np.median(np.linalg.norm(means.force_body, axis=1)))
    if still > MISSING * gravity or abs(body / gravity - 1.0) > UNIT:
        return
    said = (
        f"gyroscope: the specific force has the size of gravity ({body:.3g} m/s^2) and no direction"
        f" in the axes that the gyroscope keeps still (mean {still:.3g} m/s^2)"
    )
    slower = replace(log, imu=replace(log.imu, gyro_body=DEGREE * log.imu.gyro_body))
    mended = still_means(slower, site).force_body
    if float(np.median(np.linalg.norm(mended, axis=1))) > (1.0 - UNIT) * body:
        yield Finding(
            "gyro_units", f"{said}: it is in deg/s. Multiply it by pi/180.", Verdict.FAILED, 2e3
        )
        return
    yield Finding(
        "gyro_sign",
        f"{said}: the gyroscope's signs, axes or unit are wrong. Turn it about each axis by a right"
        " angle and compare.",
        Verdict.FAILED,
        2e3,
    )


def wrong_force(means: StillMeans, site: Site | None) -> Iterator[Finding]:
    """Yield what the mean specific force says: its unit, whether gravity is there, and its size."""
    gravity = STANDARD_GRAVITY if site is None else site.gravity
    sizes = np.linalg.norm(means.force_body, axis=1)
    size, scatter = float(np.median(sizes)), float(np.std(sizes))
    said = (
        f"accelerometer: the mean specific force in axes that stand still is {size:.3g} m/s^2 where"
        f" gravity is {gravity:.4g}"
    )
    for unit, factor in UNITS_OF_FORCE:
        if abs(size / (factor * gravity) - 1.0) < UNIT and scatter < STEADY * size:
            yield Finding(
                "accel_units",
                f"{said}: it is in {unit}. Multiply it by {1.0 / factor:.6g}.",
                Verdict.FAILED,
                2e3,
            )
            return
    if size < MISSING * gravity:
        yield Finding(
            "gravity_missing",
            f"{said}: gravity has been removed from it, as some drivers do ('linear acceleration'),"
            " or the platform falls freely. Record the raw specific force.",
            Verdict.FAILED,
            2e3,
        )
        return
    bias = 0.1 if site is None else site.platform.imu.accel_bias_sigma
    motion = A_HAND if site is None else site.platform.motion
    # What the velocity gains within a span is no gravity; few spans tell little of it.
    usual = np.sqrt(2.0 / 3.0) * motion.speed_sigma / SPAN
    sigma = np.hypot(bias, np.hypot(scatter, usual / np.sqrt(len(sizes))) / np.sqrt(len(sizes)))
    if abs(size - gravity) > max(FORCE_LIMIT * sigma, 0.02 * gravity):
        yield Finding(
            "accel_scale",
            f"{said}, {abs(size - gravity) / sigma:.1f} sigma of its declared bias off: its scale"
            " or a bias is wrong, or world.gravity_m_s2 is. Calibrate it in six positions.",
            Verdict.DOUBTFUL,
            abs(size - gravity) / sigma,
        )


def wrong_size(means: StillMeans, site: Site) -> Iterator[Finding]:
    """Yield a steady field whose size is not the Earth's, as declared with its sigmas."""
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
    if not off > max(LIMIT * sigma, 0.1 * declared):
        return
    factor = size / declared
    unit = next(
        (u for u, f in (("gauss", 1e4), ("uT", 1e6), ("nT", 1e9)) if 0.5 < factor / f < 2.0), None
    )
    inverse = next((u for u, f in (("gauss", 1e4), ("uT", 1e6)) if 0.5 < 1 / factor / f < 2), None)
    if unit is not None:
        code, cause = "field_units", f"it is in {unit}, or the Earth field is not. Give tesla"
    elif inverse is not None:
        code, cause = "earth_field", f"earth_field_t is in {inverse}. Give tesla"
    else:
        code = "earth_field"
        cause = (
            "iron or a magnet is on the body or near by all along, or earth_field_t is not of this"
            " place. Calibrate the magnetometer where it is mounted"
        )
    yield Finding(
        code,
        f"magnetometer: the steady field is {1e6 * size:.3g} uT (median) and declared as"
        f" {1e6 * declared:.3g} uT, {off / sigma:.1f} sigma off: {cause}.",
        Verdict.DOUBTFUL,
        min(off / sigma, 1e3),
    )


def wrong_dip(
    means: StillMeans, site: Site, *, mounted: bool = False, upright: bool | None = None
) -> Iterator[Finding]:
    """Yield an angle between vertical and field that is not the Earth's, as declared.

    Parameters
    ----------
    mounted : bool
        Whether gyroscope and field agree, so that the mounting is as declared.
    upright : bool, optional
        Whether the accelerometer's vertical points up by the poses; None where that is not known.
    """
    assert site.earth_field_world is not None
    declared = float(_angle(np.array([0.0, 0.0, 1.0]), site.earth_field_world))
    angle, sigma = float(np.median(means.angle)), _dip_sigma(means, site)
    if not abs(angle - declared) > LIMIT * sigma:
        return
    said = (
        f"the steady field is {angle / DEGREE:.0f} deg from the accelerometer's vertical where the"
        f" declared Earth field is {declared / DEGREE:.0f} deg from it"
        f" ({abs(angle - declared) / sigma:.0f} sigma)"
    )
    if abs(np.pi - angle - declared) < LIMIT * sigma:
        code, cause = _reversed(means, mounted=mounted, upright=upright)
    else:
        cause = (
            "the mounting of magnetometer or inertial sensor is not as declared or axes of one are"
            " permuted, iron disturbs the field, or earth_field_t is of another place"
        )
        code = "mounting"
    yield Finding(code, f"{said}: {cause}.", Verdict.DOUBTFUL, abs(angle - declared) / sigma)


def _upright(means: StillMeans, poses: Trajectory) -> bool | None:
    """Tell whether the accelerometer's vertical points up by the poses, where it does either."""
    here = _at(means, poses)
    if here is None:
        return None
    up = float(np.median(here.up[:, 2] / np.linalg.norm(here.up, axis=1)))
    return up > 0.0 if abs(up) > CLEAR else None


def _reversed(means: StillMeans, *, mounted: bool, upright: bool | None) -> tuple[str, str]:
    """Return code and cause of a vertical that points the other way."""
    level = float(np.median(means.force_body[:, 2])) > 0.7 * STANDARD_GRAVITY
    of_sign = "the accelerometer's sign is reversed (at rest, level, it has +g on z)"
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
    """Return how well the angle between vertical and field is known beforehand (rad)."""
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
    """Specific force and field by the attitudes of poses, world axes, shape (n, 3)."""

    up: Array
    field: Array
    force_body: Array
    up_body: Array


def _at(means: StillMeans, poses: Trajectory) -> _InWorld | None:
    if len(poses) == 0:
        return None
    after = np.clip(np.searchsorted(poses.time, means.time), 0, len(poses) - 1)
    before = np.maximum(after - 1, 0)
    closer = means.time - poses.time[before] < poses.time[after] - means.time
    nearest = np.where(closer, before, after)
    near = np.abs(poses.time[nearest] - means.time) < NEAR
    if not np.any(near):
        return None
    attitude = poses.world_from_body[nearest[near]]
    return _InWorld(
        _turned(attitude, means.force_body[near]),
        _turned(attitude, means.field_body[near]),
        means.force_body[near],
        attitude[:, 2],
    )


def _turned(attitude: Array, vector_body: Array) -> Array:
    return np.asarray((attitude @ vector_body[..., None])[..., 0])


def _tilted(here: _InWorld, site: Site) -> Iterator[Finding]:
    """Yield an accelerometer's vertical that is not that of the poses."""
    tilt = float(np.median(_angle(here.up, np.array([0.0, 0.0, 1.0]))))
    sigma = float(np.hypot(site.platform.imu.accel_bias_sigma / site.gravity, TILT))
    if not tilt > LIMIT * sigma:
        return
    reversed_ = _is_reversed(here)
    cause = (
        "the accelerometer's sign is reversed (at rest, level, it has +g on z)"
        if reversed_
        else "magnetometer or inertial sensor is not mounted as declared, axes of one are permuted,"
        " or the beacons' attitudes are others"
    )
    yield Finding(
        "gravity_sign" if reversed_ else "mounting",
        f"the accelerometer's vertical is {tilt / DEGREE:.0f} deg off the vertical of the poses by"
        f" the beacons: {cause}.",
        Verdict.FAILED,
        500.0 + tilt / sigma,
    )


def _is_reversed(here: _InWorld) -> bool:
    """Tell whether a reversed sign explains the vertical better than any turn by quarters."""
    force = here.force_body / np.linalg.norm(here.force_body, axis=1, keepdims=True)
    best = min(axes(), key=lambda one: float(np.sum((here.up_body @ one.T - force) ** 2)))
    return bool(np.array_equal(best, -np.eye(3)))


def wrong_field(here: _InWorld, site: Site) -> Iterator[Finding]:
    """Yield a steady field that points elsewhere than declared, by poses with a right vertical."""
    earth = site.earth_field_world
    assert earth is not None
    field = np.median(here.field / np.linalg.norm(here.field, axis=1, keepdims=True), axis=0)
    size = float(np.linalg.norm(earth))
    across = float(np.hypot(earth[0], earth[1])) / size
    dip = float(_angle(field, np.array([0.0, 0.0, 1.0])))
    off_dip = dip - float(_angle(earth, np.array([0.0, 0.0, 1.0])))
    sensor = site.platform.magnetometer
    known = float(np.max(sensor.sigma.matrix)) + float(np.max(sensor.sigma.offset)) / size
    sigma = float(np.hypot(np.hypot(site.earth.strength_sigma, known), TILT))
    heading = float(np.arctan2(field[1], field[0]) - np.arctan2(earth[1], earth[0]))
    heading = (heading + np.pi) % (2.0 * np.pi) - np.pi
    of_heading = float(np.hypot(site.earth.declination_sigma, sigma / max(across, 1e-3)))
    said = f"the steady field, by the poses, is {dip / DEGREE:.0f} deg from the vertical"
    if abs(off_dip) > LIMIT * sigma:
        yield Finding(
            "earth_field",
            f"{said} and earth_field_t {(dip - off_dip) / DEGREE:.0f} deg, where gravity agrees"
            " with the poses: earth_field_t is of another place or hemisphere (its z is up), or"
            " iron turns the field.",
            Verdict.DOUBTFUL,
            abs(off_dip) / sigma,
        )
    elif abs(heading) > LIMIT * of_heading and across > LEVEL_FIELD:
        yield Finding(
            "earth_field",
            f"the steady field, by the poses, points {heading / DEGREE:+.0f} deg from where"
            " earth_field_t does: it is not in the axes of the beacons' survey, or iron turns it.",
            Verdict.DOUBTFUL,
            abs(heading) / of_heading,
        )
