"""The Earth field as a measurement, and how much it counts.

Indoors the field's direction is disturbed, by iron that no model knows.  Three things keep that
from the attitude.  The disturbance lasts as long as the platform is near the iron, so that all of
`AMBIENT_TIME` counts as one measurement of `AMBIENT_SHARE`.  Where the field's size is not what is
declared, its direction is not either: what it deviates by is added to the covariance.  And what the
motion contradicts has no say: a loss that lets go (Geman and McClure), since a pull that falls only
with the distance (Cauchy) bends the heading by a degree where the field is turned by fifteen; in
the online estimators the same weight at the prediction.
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
from magfusion.model.parameters import Block, Calibration, SteadyView
from magfusion.model.physics.earth import AMBIENT_SHARE
from magfusion.model.samples import SteadyFields
from magfusion.model.site import MotionModel, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

EARTH_LOSS = "geman-mcclure"
DISTURBED = 0.25  # weight below which the field is reported as disturbed
GATE = 16.3  # chi square of three components, one in a thousand
AMBIENT_TIME = 2.0  # s; over which it stays the same
DEVIATION_SPAN = 5.0  # s; over which the deviation of the field's size is averaged
LEAST_HORIZONTAL = 1e-6  # T; less gives no heading
ANYWHERE, ANY_ROTATION = 100.0, 10.0  # m, rad; of a platform that never detected a beacon
SPEED_TIME = 2.0  # s; so long a speed counts once where no beacon is detected


@dataclass(frozen=True, eq=False)
class EarthField(Measurement):
    """The steady field in the magnetometer, one group of three.

    Windows are symmetric, and a ramp is fitted beside the constant: it knows no time offset but by
    the turn of the states.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    measured : ndarray, shape (n, 3)
        (T)
    sqrt_information : ndarray, shape (n, 3, 3)
        Whitening; zero where missing.
    rate_body : ndarray, shape (n, 3)
        Angular rate, for the time offset (rad/s).
    repeats : float
        How many epochs in a row count as one measurement.
    applied_offset : ndarray, shape (n,)
        IMU time offset with which the inertial data were cut (s).
    robust : bool
        Whether what the motion contradicts has no say.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    rate_body: Array
    repeats: float
    applied_offset: Array
    robust: bool = True

    @property
    def loss(self) -> Loss | None:
        """Loss that lets go of a disturbed field."""
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
        view = SteadyView(calibration, seen, self.rate_body, self.time)
        for block in blocks:
            part = block.parameter.steady_jacobian(view)
            if part is not None:
                by_calibration[:, 0, :, block.columns] = self.sqrt_information @ part
        return Rows(error[:, None, :, 0], by_pose, by_calibration=by_calibration)


def earth_measurement(
    site: Site,
    steady: SteadyFields,
    epoch: IntArray,
    rate_body: Array,
    applied_offset: Array,
    step: float,
) -> EarthField:
    """Return steady fields as a measurement.

    Parameters
    ----------
    steady : SteadyFields
        What is NaN is missing.
    epoch : int ndarray, shape (n,)
        States that they belong to.
    rate_body : ndarray, shape (n, 3)
        Without the gyro's bias (rad/s).
    applied_offset : ndarray, shape (n,)
        IMU time offset with which the inertial data were cut (s).
    step : float
        Between epochs (s).
    """
    repeats = max(1.0, AMBIENT_TIME / step)
    there = np.isfinite(steady.measured_sensor)
    sqrt_information = whitening(repeats * earth_cov(site, steady), there)
    measured = np.nan_to_num(steady.measured_sensor)
    return EarthField(
        epoch, steady.time, measured, sqrt_information, rate_body, repeats, applied_offset
    )


def check_earth(site: Site) -> None:
    """Refuse a site that has no use of the Earth field.

    Raises
    ------
    InputError
    """
    field, gravity = site.earth_field_world, site.gravity
    if site.platform.further:
        raise InputError(
            "--earth measures by one magnetometer; leave it out, or give a site of the one"
        )
    if field is None:
        raise InputError(
            "the site has no Earth field to measure against; give earth_field_t or a location in"
            " its world, or leave --earth out"
        )
    if np.hypot(field[0], field[1]) < LEAST_HORIZONTAL or not gravity > 0.0:
        raise InputError(
            f"the site's Earth field has only {1e6 * np.hypot(field[0], field[1]):.2g} uT across"
            " the vertical, too little to determine a heading; leave --earth out"
        )


def earth_cov(site: Site, steady: SteadyFields) -> Array:
    """Return the covariance of each steady field, shape (n, 3, 3), measured axes (T^2)."""
    assert site.earth_field_world is not None
    sensor = site.platform.magnetometer
    size = float(np.linalg.norm(site.earth_field_world))
    field = (steady.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    deviation = (np.linalg.norm(field, axis=1) - size) ** 2
    if len(sensor.axes) < 3:  # of a component the size tells nothing
        deviation = np.zeros(len(steady))
    ambient = (AMBIENT_SHARE * size) ** 2 + _moving_mean(steady.time, deviation)
    return steady.cov + ambient[:, None, None] * np.eye(3)


def _moving_mean(time: Array, value: Array) -> Array:
    lo = np.searchsorted(time, time - DEVIATION_SPAN / 2)
    hi = np.searchsorted(time, time + DEVIATION_SPAN / 2, side="right")
    total = np.concatenate([[0.0], np.cumsum(value)])
    return (total[hi] - total[lo]) / (hi - lo)


def disturbed(residual: Array, repeats: float) -> BoolArray:
    """Tell at which epochs the motion contradicts the Earth field.

    Parameters
    ----------
    residual : ndarray, shape (n, 3)
        Whitened.
    repeats : float
        How many epochs count as one measurement.
    """
    weight, _ = robust_weight(repeats * np.sum(residual**2, axis=1), EARTH_LOSS, components=3)
    return weight < DISTURBED


def unheld(
    states: Trajectory, epoch: IntArray, detected: BoolArray, step: float, motion: MotionModel
) -> list[Measurement]:
    """Bound what no beacon determines: the speed, and if need be one position.

    Parameters
    ----------
    states : Trajectory
        Where the platform is thought to be.
    epoch : int ndarray, shape (n,)
        Of the fields.
    detected : bool ndarray, shape (n,)
        Whether a beacon was detected then.
    step : float
        Between epochs (s).
    """
    free = epoch[~detected]
    out: list[Measurement] = []
    if len(free):
        out.append(zero_velocity(free, speed_sigma(step, motion)))
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
    """How much the Earth field counts at a prediction, epoch by epoch.

    Parameters
    ----------
    blocks : tuple of Block
        Calibration parameters in the state's tangent.
    """

    refused_at: float

    def __init__(self, blocks: tuple[Block, ...]) -> None:
        self.blocks = blocks
        self.refused_at = -np.inf  # s

    def weighed(self, measurement: EarthField, state: State) -> tuple[EarthField, bool]:
        """Return an epoch's measurement as it counts, and whether the field is disturbed.

        Parameters
        ----------
        state : State
            As predicted: the farther from it, the less the field counts, and at last nothing; nor
            for a while after, since what lets go for an epoch would be followed where it leads.
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
        taken = replace(measurement, sqrt_information=weighed, repeats=1.0, robust=False)
        return taken, weight < DISTURBED
