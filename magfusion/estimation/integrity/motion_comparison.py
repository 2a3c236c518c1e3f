"""Motion from fields against motion from the IMU, as two linear regressions.

Fixes give the rotation from one epoch to a later one and, by second differences, the acceleration;
gyro and accelerometer measure the same in their own axes, units and time.  The relation is linear
in the axes of either, in biases, lever arm and gravity, so that a fault in any is tested by a small
least-squares problem.  Survey errors are included: they distort a path as much as a wrong axis, and
would be mistaken for one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from magfusion.estimation.data_checks.field_rotation import convolved
from magfusion.estimation.integrity.field_snapshots import OF_SURVEY
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.survey_error import whitened
from magfusion.model.field import skew
from magfusion.model.noise import measurement_cov, whitening
from magfusion.model.parameters import (
    SENSOR_POSITION,
    SENSOR_ROTATION,
    Calibration,
    choose_blocks,
    linearize_channels,
    placed,
)
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.model.strapdown import attitude_at, attitude_from_gyro
from magfusion.units import Array, BoolArray, IntArray

TURN_SPAN = 0.4  # s, over which rotations are compared
CURVE_SPAN = 0.6  # s, of each half of a second difference
GRID = 0.01  # s, of the specific force
EVEN = 0.25  # of a span, largest deviation of an epoch from it
WIDEST = 1.5  # times a span, up to which it is a multiple of the epochs' interval
LOCAL_ROTATION = 3e-3  # rad, error of fixes besides noise
LOCAL_POSITION = 1e-3  # m
LOCAL_TILT = 2e-3  # rad
MOUNTED = (SENSOR_ROTATION, SENSOR_POSITION)  # which are estimated separately

SHARED = {"gyro": slice(0, 3), "accel": slice(3, 6), "tilt": slice(6, 8)}
SHARED |= {"mounting": slice(8, 11), "lever": slice(11, 14)}
WIDTH = 14
WIDE = {"gyro": 10.0, "accel": 100.0, "tilt": 1.0, "mounting": 3.0, "lever": 10.0}


@dataclass(frozen=True, eq=False)
class Compared:
    """Rotations and accelerations from fixes, and the same from the IMU."""

    # rotation, gyro_turned: (m, 3), rotation vectors (rad) over spans (s), in body axes
    rotation: Array
    gyro_turned: Array
    span: Array  # (m,)
    turn_sigma: Array  # (m,) (rad)
    curve_world: Array  # (n, 3), accelerations of the body (m/s^2)
    # (n, 3, 3, 3), ``force[:, i, j, k]``: weighted mean of ``world_from_body[i, j]`` times axis k
    # of the specific force, so that the axes may be exchanged afterwards (m/s^2)
    force: Array
    predicted_velocity: Array  # (n, 3, 3), weighted mean of ``world_from_body``
    bent: Array  # (n, 3, 3), second difference of ``world_from_body`` (1/s^2)
    curve_sigma: Array  # (n,) (m/s^2)
    gravity: float  # (m/s^2)
    prior: Array  # (14,), sigmas of `SHARED`
    # turned_by_survey, curve_by_survey: (m, 3, k), (n, 3, k), effect of one sigma of each survey
    # error on the first of each
    turned_by_survey: Array
    curve_by_survey: Array

    @property
    def freedom(self) -> float:
        """Number of residuals."""
        return float(self.rotation.size + self.curve_world.size)

    def explained(
        self,
        gyro_axes: Array,
        accel_axes: Array,
        parameters: str | None = None,
        gravity: float = 1.0,
        lever: Array | None = None,
    ) -> tuple[float, Array]:
        """Return chi square and the shared parameters for assumed axes.

        Parameters
        ----------
        gyro_axes, accel_axes : ndarray, shape (3, 3)
            From a reading to body axes and SI units.
        parameters : str, optional
            Which of `SHARED` has no prior.
        gravity : float
            Share of gravity that the specific force contains.
        lever : ndarray, shape (3,), optional
            By which the declared lever arm is too long (m).
        """
        by_gyro = self.gyro_turned @ gyro_axes.T
        turns = np.zeros((len(by_gyro), 3, WIDTH))
        turns[..., SHARED["gyro"]] = -self.span[:, None, None] * np.eye(3)
        turns[..., SHARED["mounting"]] = -skew(by_gyro)
        turn_error = self.rotation - by_gyro
        force = np.einsum("nijk,jk->ni", self.force, accel_axes)
        curves = np.zeros((len(force), 3, WIDTH))
        curves[..., SHARED["accel"]] = -self.predicted_velocity
        curves[..., SHARED["tilt"]] = (
            -self.gravity * gravity * skew(np.array([0.0, 0.0, 1.0]))[:, :2]
        )
        body_force = np.einsum("nijl,kl->nijk", self.force, accel_axes)
        for axis in range(3):
            rotated = np.einsum("nijk,jk->ni", body_force, skew(np.eye(3)[axis]))
            curves[..., SHARED["mounting"].start + axis] = rotated
        curves[..., SHARED["lever"]] = -self.bent
        turns = np.concatenate([turns, self.turned_by_survey], axis=2)
        curves = np.concatenate([curves, self.curve_by_survey], axis=2)
        up = np.array([0.0, 0.0, gravity * self.gravity])
        curve_error = self.curve_world + up - force
        if lever is not None:
            curve_error = curve_error + self.bent @ lever
        rows = np.concatenate(
            [
                (turns / self.turn_sigma[:, None, None]).reshape(-1, turns.shape[2]),
                (curves / self.curve_sigma[:, None, None]).reshape(-1, turns.shape[2]),
            ]
        )
        error = np.concatenate(
            [
                (turn_error / self.turn_sigma[:, None]).ravel(),
                (curve_error / self.curve_sigma[:, None]).ravel(),
            ]
        )
        prior = np.concatenate([self.prior, np.ones(self.curve_by_survey.shape[2])])
        if parameters is not None:
            prior[SHARED[parameters]] = WIDE[parameters]
        information = rows.T @ rows + np.diag(1.0 / prior**2)
        result = np.linalg.solve(information, rows.T @ error)
        residual = error - rows @ result
        return float(residual @ residual + np.sum((result / prior) ** 2)), result[:WIDTH]


@dataclass(frozen=True, eq=False)
class Surveyed:
    """Fixes, and the effect of survey errors on all of them."""

    fixes: Fixes  # of all epochs, with the site's mounting and lever arm
    # (n, 6, k), rotation (rad) and translation (m) in body axes, of one sigma each
    by_survey: Array
    window: float  # over which a fix averages the position (s)


def surveyed(samples: FieldSamples, calibration: Calibration) -> Surveyed:
    """Return the fixes of all epochs, each independent, and the effect of survey errors."""
    site, fixes = calibration.site, fix_epochs(samples, calibration, survey_error=False)
    at, place = fixes.world_from_body[:, 0], fixes.position_world[:, 0]
    blocks = choose_blocks(site, OF_SURVEY)
    blocks = placed(block for block in blocks if block.parameter not in MOUNTED)
    _, by_pose, by_blocks = linearize_channels(calibration, blocks, samples.time, at, place)
    weights = whitening(measurement_cov(site, samples, survey_error=False), samples.there)
    by_sigma = by_blocks @ prior_sqrt_covariance(site, blocks)
    result = np.linalg.pinv(whitened(weights, by_pose)) @ whitened(weights, by_sigma)
    window = float(np.median(samples.window))
    return Surveyed(fixes, np.where(np.isfinite(result), result, 0.0), window)


def compared(known: Surveyed, imu: ImuSamples, site: Site, late: float = 0.0) -> Compared | None:
    """Return the data to compare; None if the log is too short.

    `late`: delay of the inertial stamps beyond the declared offset (s).
    """
    fixes, time = known.fixes, known.fixes.time
    stamps = imu.time + site.platform.imu.time_offset - late
    turn, place, cov = (
        fixes.world_from_body[:, 0],
        fixes.position_world[:, 0],
        fixes.pose_cov[:, 0],
    )
    certain = fixes.determined[:, 0] & (fixes.probability[:, 0] > 0.99)
    turn_span, curve_span = _of_epochs(time, TURN_SPAN), _of_epochs(time, CURVE_SPAN)
    certain &= (time > stamps[0] + curve_span) & (time < stamps[-1] - curve_span)
    rotation_sigma = np.sqrt(np.einsum("nii->n", cov[:, :3, :3]) / 3.0)
    place_sigma = np.sqrt(np.einsum("nii->n", cov[:, 3:, 3:]) / 3.0)
    i, j = _pairs(time, certain, turn_span)
    before, at, after = _triples(time, certain, curve_span)
    if len(i) < 8 or len(at) < 8:
        return None
    relative = np.swapaxes(turn[i], 1, 2) @ turn[j]
    attitude = attitude_from_gyro(stamps, imu.gyro_body)
    by_gyro = attitude_at(attitude, stamps, imu.gyro_body, time)
    half = 0.5 * (time[after] - time[before])[:, None]
    force, propagated = _forces(known, stamps, imu, time[at], curve_span)
    rotated = Rotation.from_matrix(relative).as_rotvec()
    by_turn, by_place = known.by_survey[:, :3], turn @ known.by_survey[:, 3:]
    tilted = turn @ by_turn
    mean_tilt = 0.25 * (tilted[before] + 2.0 * tilted[at] + tilted[after])
    upright = skew(np.array([0.0, 0.0, site.gravity]))
    bent_by_survey = by_place[after] - 2.0 * by_place[at] + by_place[before]
    return Compared(
        rotation=rotated,
        gyro_turned=(by_gyro[i].inv() * by_gyro[j]).as_rotvec(),
        span=time[j] - time[i],
        turn_sigma=np.sqrt(rotation_sigma[i] ** 2 + rotation_sigma[j] ** 2 + LOCAL_ROTATION**2),
        curve_world=(place[after] - 2.0 * place[at] + place[before]) / half**2,
        force=force,
        predicted_velocity=propagated,
        bent=(turn[after] - 2.0 * turn[at] + turn[before]) / half[..., None] ** 2,
        curve_sigma=np.sqrt(6.0 * (place_sigma[at] ** 2 + LOCAL_POSITION**2)) / half[:, 0] ** 2,
        gravity=site.gravity,
        prior=_prior(site),
        turned_by_survey=_of_turns(rotated, by_turn[j] - np.swapaxes(relative, 1, 2) @ by_turn[i]),
        curve_by_survey=bent_by_survey / half[..., None] ** 2 + upright @ mean_tilt,
    )


def _of_turns(rotated: Array, last: Array) -> Array:
    """Return the second-order effect on rotation vectors (m, 3) of rotations after them."""
    around = skew(rotated)
    return np.asarray(last + 0.5 * around @ last + around @ (around @ last) / 12.0)


def _prior(site: Site) -> Array:
    imu, sigma = site.platform.imu, site.platform.magnetometer.sigma
    return np.concatenate(
        [
            np.full(3, imu.gyro_bias_sigma),
            np.full(3, imu.accel_bias_sigma),
            np.full(2, LOCAL_TILT),
            np.maximum(sigma.rotation_sensor, LOCAL_TILT),
            np.maximum(sigma.position_body, 2e-3),
        ]
    )


def _of_epochs(time: Array, span: float) -> float:
    """Return the multiple of the epochs' interval that is nearest to a span (s)."""
    interval = float(np.median(np.diff(time))) if len(time) > 1 else span
    nearest = max(1.0, np.round(span / interval)) * interval
    return nearest if nearest < WIDEST * span else span


def _pairs(time: Array, certain: BoolArray, span: float) -> tuple[IntArray, IntArray]:
    """Return pairs of epochs a span apart, in sequence."""
    out: list[tuple[int, int]] = []
    first = 0
    while first < len(time) - 1:
        last = int(np.argmin(np.abs(time - time[first] - span)))
        if last > first and abs(time[last] - time[first] - span) < EVEN * span:
            if certain[first] and certain[last]:
                out.append((first, last))
            first = last
        else:
            first += 1
    pairs = np.array(out, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _triples(time: Array, certain: BoolArray, span: float) -> tuple[IntArray, IntArray, IntArray]:
    """Return epochs with others a span before and after them, evenly spaced."""
    out: list[tuple[int, int, int]] = []
    at = 0
    while at < len(time):
        before = int(np.argmin(np.abs(time - time[at] + span)))
        after = int(np.argmin(np.abs(time - time[at] - span)))
        even = abs(time[after] + time[before] - 2.0 * time[at]) < 0.02 * span
        whole = abs(time[after] - time[before] - 2.0 * span) < EVEN * span
        if even and whole and certain[before] and certain[at] and certain[after]:
            out.append((before, at, after))
            at = max(at + 1, int(np.searchsorted(time, time[at] + 0.5 * span)))
        else:
            at += 1
    triples = np.array(out, dtype=np.int64).reshape(-1, 3)
    return triples[:, 0], triples[:, 1], triples[:, 2]


def _forces(
    known: Surveyed, stamps: Array, imu: ImuSamples, wanted: Array, span: float
) -> tuple[Array, Array]:
    """Return the specific force in world axes, weighted as by a second difference.

    The second difference of positions over a span is the mean acceleration under a triangle of
    twice the span, averaged over the window of a fix.
    """
    fixes, time = known.fixes, known.fixes.time
    grid = np.linspace(time[0], time[-1], round((time[-1] - time[0]) / GRID) + 1)
    turns = Slerp(time, Rotation.from_matrix(fixes.world_from_body[:, 0]))(grid).as_matrix()
    force = np.stack([np.interp(grid, stamps, axis) for axis in imu.accel_body.T], axis=1)
    count = round(span / GRID)
    weight = np.concatenate([np.arange(1, count + 1), np.arange(count - 1, 0, -1)]) / count**2
    box = max(1, round(known.window / GRID))
    weight = np.convolve(weight, np.full(box, 1.0 / box))
    outer = turns[:, :, :, None] * force[:, None, None, :]
    both = np.concatenate([outer.reshape(len(grid), 27), turns.reshape(len(grid), 9)], axis=1)
    mean = convolved(both, weight, mode="same")
    rows = np.clip(np.round((wanted - grid[0]) / GRID).astype(np.int64), 0, len(grid) - 1)
    return mean[rows, :27].reshape(-1, 3, 3, 3), mean[rows, 27:].reshape(-1, 3, 3)
