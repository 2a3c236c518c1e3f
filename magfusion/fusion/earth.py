"""How much the Earth field counts as a measurement.

Indoors the field's direction is disturbed, by iron that no model knows.  Three things keep that
from the attitude.  The disturbance lasts as long as the platform is near the iron, so that all of
`AMBIENT_TIME` counts as one measurement of `AMBIENT_SHARE`.  Where the field's size is not what is
declared, its direction is not either: what it deviates by is added to the covariance.  And what the
motion contradicts has no say: a loss that lets go (Geman and McClure), since a pull that falls only
with the distance (Cauchy) bends the heading by a degree where the field is turned by fifteen; in
the online estimators the same weight at the prediction.
"""

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X

from magfusion.errors import InputError
from magfusion.fusion.factors import FieldMeasurements, robust_weight
from magfusion.records.samples import SteadyFields
from magfusion.site import Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray
from magfusion.weights import paired_whitening

EARTH_LOSS = "geman-mcclure"
DISTURBED = 0.25  # weight below which the field is told to be disturbed
AMBIENT_SHARE = 0.005  # of the field's size: usual disturbance of each component, one sigma
AMBIENT_TIME = 2.0  # s; over which it stays the same
DEVIATION_SPAN = 5.0  # s; over which the deviation of the field's size is averaged
LEAST_HORIZONTAL = 1e-6  # T; less tells no heading
ANYWHERE, ANY_ROTATION = 100.0, 10.0  # m, rad; of a platform that no beacon ever held
SPEED_SIGMA, SPEED_TIME = 1.0, 2.0  # m/s, s; a platform that no beacon holds stays where it is


def check_earth(site: Site) -> None:
    """Refuse a site that has no use of the Earth field.

    Raises
    ------
    InputError
    """
    field, gravity = site.earth_field_world, site.gravity
    if field is None:
        raise InputError(
            "the site has no Earth field to measure against; give earth_field_t or a location in"
            " its world, or leave --earth out"
        )
    if np.hypot(field[0], field[1]) < LEAST_HORIZONTAL or not gravity > 0.0:
        raise InputError(
            f"the site's Earth field has only {1e6 * np.hypot(field[0], field[1]):.2g} uT across"
            " the vertical, too little to tell a heading; leave --earth out"
        )


def earth_cov(site: Site, steady: SteadyFields) -> Array:
    """Return the covariance of each steady field, shape (n, 3, 3), measured axes (T^2)."""
    assert site.earth_field_world is not None
    sensor = site.platform.magnetometer
    size = float(np.linalg.norm(site.earth_field_world))
    field = (steady.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    deviation = (np.linalg.norm(field, axis=1) - size) ** 2
    ambient = (AMBIENT_SHARE * size) ** 2 + _moving_mean(steady.time, deviation)
    return np.asarray(steady.cov + ambient[:, None, None] * np.eye(3))


def _moving_mean(time: Array, value: Array) -> Array:
    lo = np.searchsorted(time, time - DEVIATION_SPAN / 2)
    hi = np.searchsorted(time, time + DEVIATION_SPAN / 2, side="right")
    total = np.concatenate([[0.0], np.cumsum(value)])
    return np.asarray((total[hi] - total[lo]) / (hi - lo))


def with_earth(
    measurements: FieldMeasurements, steady: SteadyFields, cov: Array, step: float
) -> FieldMeasurements:
    """Return measurements with the Earth field as their last row.

    Parameters
    ----------
    measurements : FieldMeasurements
        Of the same epochs.
    steady : SteadyFields
        A row that is NaN is missing.
    cov : ndarray, shape (n, 3, 3)
        (T^2)
    step : float
        Between epochs (s).
    """
    repeats = max(1.0, AMBIENT_TIME / step)
    valid = np.asarray(np.isfinite(steady.measured_sensor).all(axis=1))
    root = paired_whitening(repeats * cov[:, None], valid[:, None])
    root[..., 3:, :] = 0.0
    field = np.nan_to_num(steady.measured_sensor)
    row = np.concatenate([field, np.zeros_like(field)], axis=1)[:, None]
    # Windows are symmetric, and a ramp is fitted beside the constant: it knows no time offset.
    still = np.zeros_like(row)
    return replace(
        measurements,
        measured=np.concatenate([measurements.measured, row], axis=1),
        root=np.concatenate([measurements.root, root], axis=1),
        by_time_offset=np.concatenate([measurements.by_time_offset, still], axis=1),
        earth_repeats=repeats,
    )


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
    return np.asarray(weight < DISTURBED)


def hold(
    graph: gtsam.NonlinearFactorGraph, states: Trajectory, held: BoolArray, step: float
) -> None:
    """Keep what no beacon holds from floating off: the speed, and if need be one position.

    Parameters
    ----------
    graph : gtsam.NonlinearFactorGraph
        Takes the factors.
    states : Trajectory
        Where the platform is thought to be.
    held : bool ndarray, shape (n,)
        Whether a beacon is heard.
    step : float
        Between epochs (s).
    """
    slow = gtsam.noiseModel.Isotropic.Sigma(3, speed_sigma(step))
    for i in np.flatnonzero(~held):
        graph.addPriorVector(V(int(i)), np.zeros(3), slow)
    if not np.any(held):
        wide = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ANY_ROTATION, ANYWHERE], 3))
        pose = gtsam.Pose3(gtsam.Rot3(states.world_from_body[0]), states.position_world[0])
        graph.add(gtsam.PriorFactorPose3(X(0), pose, wide))


def speed_sigma(step: float) -> float:
    """Return the sigma of no velocity at an epoch that no beacon holds (m/s)."""
    return SPEED_SIGMA * float(np.sqrt(max(1.0, SPEED_TIME / step)))
