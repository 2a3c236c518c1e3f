"""Earth field as a measurement, and its weight.

Indoors the field's direction is disturbed by unmodelled iron.  Three measures protect the attitude.
The disturbance lasts as long as the platform is near the iron, so that all of `AMBIENT_TIME` counts
as one measurement of `AMBIENT_SHARE`.  If the field's magnitude is not as declared, neither is its
direction: the deviation is added to the covariance.  A field that contradicts the motion is
rejected by a redescending loss (Geman and McClure).  A weight that only decreases with distance
(Cauchy) would bend the heading by a degree where the field is rotated by fifteen.  The online
estimators apply the same weight at the prediction.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.graph.measurement import (
    Loss,
    Measurement,
    Rows,
    calibration_rows,
    group_distances,
    robust_weight,
)
from magfusion.estimation.graph.state import State, States, states_of
from magfusion.estimation.measurements.pose_fix import PoseFix
from magfusion.estimation.measurements.zero_velocity import zero_velocity
from magfusion.model.field import observe_earth
from magfusion.model.noise import whitening
from magfusion.model.parameters import Block, Calibration, StaticView
from magfusion.model.physics.earth import AMBIENT_SHARE
from magfusion.model.samples import StaticFields
from magfusion.model.site import MotionModel, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

EARTH_LOSS = "geman-mcclure"
DISTURBED = 0.25  # weight below which the field is reported as disturbed
GATE = 16.3  # chi square of three components, one in a thousand
AMBIENT_TIME = 2.0  # s; over which it is constant
DEVIATION_SPAN = 5.0  # s; over which the deviation of the field's magnitude is averaged
MIN_HORIZONTAL = 1e-6  # T; less gives no heading
ANYWHERE, ANY_ROTATION = 100.0, 10.0  # m, rad; of a platform that never detected a beacon
SPEED_TIME = 2.0  # s; in which the speed counts once if no beacon is detected


@dataclass(frozen=True, eq=False)
class EarthField(Measurement):
    """Static field in the magnetometer, one group of three.

    Windows are symmetric, and a ramp is fitted with the constant: the time offset has an effect
    only by the rotation of the states.
    """

    time: Array  # (n,) (s)
    measured: Array  # (n, 3) (T)
    sqrt_information: Array  # (n, 3, 3), whitening; zero where missing
    rate_body: Array  # (n, 3), angular rate, for the time offset (rad/s)
    repeats: float  # number of consecutive epochs that count as one measurement
    applied_offset: Array  # (n,), IMU time offset used to cut the inertial data (s)
    robust: bool = True  # whether a field that contradicts the motion is rejected

    @property
    def loss(self) -> Loss | None:
        """Redescending loss that rejects a disturbed field."""
        return Loss(EARTH_LOSS, self.repeats) if self.robust else None

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate."""
        site = calibration.site
        assert site.earth_field_world is not None
        lag = calibration.imu_offset(self.time) - self.applied_offset
        turn = Rotation.from_rotvec(-lag[:, None] * self.rate_body).as_matrix()
        seen = observe_earth(
            site.platform.magnetometer, states.world_from_body @ turn, site.earth_field_world
        )
        error = self.sqrt_information @ (seen.measured_sensor - self.measured)[..., None]
        by_pose = np.zeros((len(error), 1, 3, 6))
        by_pose[:, 0, :, :3] = self.sqrt_information @ seen.platform_rotation
        by_calibration = calibration_rows((len(error), 1, 3), blocks)
        view = StaticView(calibration, seen, self.rate_body, self.time)
        for block in blocks:
            part = block.parameter.static_jacobian(view)
            if part is not None:
                by_calibration[:, 0, :, block.columns] = self.sqrt_information @ part
        return Rows(error[:, None, :, 0], by_pose, by_calibration=by_calibration)


def earth_measurement(
    site: Site,
    static: StaticFields,
    epoch: IntArray,
    rate_body: Array,
    applied_offset: Array,
    step: float,
) -> EarthField:
    """Return static fields as a measurement.

    Parameters
    ----------
    static : StaticFields
        NaN where missing.
    epoch : int ndarray, shape (n,)
        Indices of their states.
    rate_body : ndarray, shape (n, 3)
        Without the gyro's bias (rad/s).
    applied_offset : ndarray, shape (n,)
        IMU time offset used to cut the inertial data (s).
    step : float
        Time between epochs (s).
    """
    repeats = max(1.0, AMBIENT_TIME / step)
    there = np.isfinite(static.measured_sensor)
    sqrt_information = whitening(repeats * earth_cov(site, static), there)
    measured = np.nan_to_num(static.measured_sensor)
    return EarthField(
        epoch, static.time, measured, sqrt_information, rate_body, repeats, applied_offset
    )


def check_earth(site: Site) -> None:
    """Reject a site that cannot use the Earth field."""
    field, gravity = site.earth_field_world, site.gravity
    if site.platform.further:
        raise InputError(
            "--earth uses a single magnetometer; leave it out, or give a site with one"
        )
    if site.platform.magnetometer.ac_coupled:
        raise InputError(
            "--earth uses the static field, but the magnetometer is ac_coupled; omit it"
        )
    if field is None:
        raise InputError(
            "the site has no Earth field to measure against; give earth_field_t or a location in"
            " its world, or leave --earth out"
        )
    if np.hypot(field[0], field[1]) < MIN_HORIZONTAL or not gravity > 0.0:
        raise InputError(
            f"the site's Earth field has only {1e6 * np.hypot(field[0], field[1]):.2g} uT in the"
            " horizontal plane, too little to determine a heading; leave --earth out"
        )


def earth_cov(site: Site, static: StaticFields) -> Array:
    """Return the covariance of each static field, shape (n, 3, 3), measured axes (T^2)."""
    assert site.earth_field_world is not None
    sensor = site.platform.magnetometer
    size = float(np.linalg.norm(site.earth_field_world))
    field = (static.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    deviation = (np.linalg.norm(field, axis=1) - size) ** 2
    if len(sensor.axes) < 3:  # the magnitude is unknown
        deviation = np.zeros(len(static))
    ambient = (AMBIENT_SHARE * size) ** 2 + _moving_mean(static.time, deviation)
    return static.cov + ambient[:, None, None] * np.eye(3)


def _moving_mean(time: Array, value: Array) -> Array:
    lo = np.searchsorted(time, time - DEVIATION_SPAN / 2)
    hi = np.searchsorted(time, time + DEVIATION_SPAN / 2, side="right")
    total = np.concatenate([[0.0], np.cumsum(value)])
    return (total[hi] - total[lo]) / (hi - lo)


def disturbed(residual: Array, repeats: float) -> BoolArray:
    """Return at which epochs the motion contradicts the Earth field.

    `residual` (n, 3): whitened. `repeats`: number of epochs that count as one measurement.
    """
    weight, _ = robust_weight(repeats * np.sum(residual**2, axis=1), EARTH_LOSS, components=3)
    return weight < DISTURBED


def unobserved_constraints(
    states: Trajectory, epoch: IntArray, detected: BoolArray, step: float, motion: MotionModel
) -> list[Measurement]:
    """Constrain what no beacon determines: the speed, and if necessary one position.

    Parameters
    ----------
    states : Trajectory
        Approximate states.
    epoch : int ndarray, shape (n,)
        Of the fields.
    detected : bool ndarray, shape (n,)
        Whether a beacon was detected at each.
    step : float
        Time between epochs (s).
    """
    free_parameters = epoch[~detected]
    out: list[Measurement] = []
    if len(free_parameters):
        out.append(zero_velocity(free_parameters, speed_sigma(step, motion)))
    if not np.any(detected):
        weight = np.diag(1.0 / np.repeat([ANY_ROTATION, ANYWHERE], 3))
        first = slice(0, 1)
        attitude, position = states.world_from_body[first], states.position_world[first]
        out.append(PoseFix(np.zeros(1, dtype=np.int64), attitude, position, weight[None]))
    return out


def speed_sigma(step: float, motion: MotionModel) -> float:
    """Return the sigma of the zero velocity at an epoch without any beacon (m/s)."""
    return motion.speed_sigma * float(np.sqrt(max(1.0, SPEED_TIME / step)))


class EarthWeight:
    """Weight of the Earth field at a prediction, epoch by epoch.

    `blocks`: calibration parameters in the state's tangent.
    """

    refused_at: float

    def __init__(self, blocks: tuple[Block, ...]) -> None:
        self.blocks = blocks
        self.refused_at = -np.inf  # s

    def weighed(self, measurement: EarthField, state: State) -> tuple[EarthField, bool]:
        """Return the weighted measurement of an epoch, and whether the field is disturbed.

        `state`: prediction. The weight decreases to zero with the distance from it, and remains
        zero for a while, as an accepted disturbance would pull the state.
        """
        whole = replace(
            measurement,
            sqrt_information=np.sqrt(measurement.repeats) * measurement.sqrt_information,
        )
        rows = whole.linearize(states_of([state]), state.calibration, self.blocks)
        distance = group_distances(rows, state.cov)[0]
        weight = float(robust_weight(distance, EARTH_LOSS, components=3)[0][0])
        if distance[0] > GATE:
            self.refused_at = state.time
        if state.time - self.refused_at < AMBIENT_TIME:
            weight = 0.0
        weighed = np.sqrt(weight) * measurement.sqrt_information
        selected = replace(measurement, sqrt_information=weighed, repeats=1.0, robust=False)
        return selected, weight < DISTURBED
