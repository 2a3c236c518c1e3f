"""Measurements of magnetic fields as factors of a user's own GTSAM graph.

Value and derivative are those of the measurement model of all estimators (`magfusion.observe`).
"""

from collections.abc import Iterable

import gtsam
import numpy as np

from magfusion.estimation.graph.gtsam_factors import CalibrationKeys as CalibrationKeys
from magfusion.estimation.graph.gtsam_factors import EpochRows, MotionKeys, group_factor
from magfusion.estimation.graph.gtsam_graph import GtsamGraph as GtsamGraph
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.noise import paired_whitening, stacked, whitening
from magfusion.model.parameters import PARAMETERS, BeaconParameter, Calibration, choose_blocks
from magfusion.units import Array, ComplexArray

ABSENT = gtsam.symbol("!", 0)  # a velocity or bias that is in no values


def calibration_keys(
    calibration: Calibration, groups: Iterable[str] | None = None
) -> CalibrationKeys:
    """Return keys for the calibration parameters that a graph estimates.

    Parameters
    ----------
    calibration : Calibration
        Mean of the prior.
    groups : iterable of str, optional
        As of `magfusion.SmootherSettings.estimate`.
    """
    blocks = choose_blocks(calibration.site, groups, parameters=PARAMETERS)
    return CalibrationKeys(calibration, blocks)


def field_factor(
    pose_key: int,
    calibration: Calibration,
    channel: tuple[str, int],
    phasor_sensor: ComplexArray,
    phasor_cov: Array,
    *,
    time: float | None = None,
    keys: CalibrationKeys | None = None,
    loss: str | None = "cauchy",
) -> gtsam.NoiseModelFactor:
    """Return the field of a beacon at one epoch as a factor on the pose of the body.

    Parameters
    ----------
    pose_key : int
        Of a ``gtsam.Pose3``, world from body.
    calibration : Calibration
        From `magfusion.initial_calibration`; with ``keys`` theirs.
    channel : (str, int)
        Beacon and tone.
    phasor_sensor : complex ndarray, shape (3,)
        (T)
    phasor_cov : ndarray, shape (3, 3)
        Of the real part, and equally of the imaginary part (T^2); with that of the site's model.
    time : float, optional
        For drive clocks that drift (s); the calibration's reference by default.
    keys : CalibrationKeys, optional
        Calibration parameters that the graph estimates.
    loss : {None, 'huber', 'cauchy'}
        Robust loss of the six components together.

    Raises
    ------
    ValueError
        If the site has no such channel.
    """
    channels = calibration.site.channels
    if channel not in channels:
        raise ValueError(f"channel must be one of {channels}; got {channel}")
    k, shape = channels.index(channel), (1, len(channels))
    measured, root = np.zeros((*shape, 6)), np.zeros((*shape, 6, 6))
    measured[0, k] = stacked(phasor_sensor)
    root[0, k] = paired_whitening(phasor_cov, np.isfinite(phasor_sensor))
    measurement = FieldPhasors(
        epoch=np.zeros(1, dtype=np.int64),
        time=np.array([calibration.reference_time if time is None else time]),
        measured=measured,
        sqrt_information=root,
        rate_body=np.zeros((1, 3)),
        by_time_offset=np.zeros((*shape, 6)),
        applied_offset=np.zeros(1),
        moving=np.zeros(1, dtype=bool),
        robust=loss,
    )
    keys = CalibrationKeys(calibration, ()) if keys is None else keys
    return _factor(measurement, keys, pose_key, k, channel[0], 6)


def earth_field_factor(
    pose_key: int,
    calibration: Calibration,
    measured_sensor: Array,
    cov: Array,
    *,
    keys: CalibrationKeys | None = None,
    robust: bool = True,
) -> gtsam.NoiseModelFactor:
    """Return the Earth's field at one epoch as a factor on the pose of the body.

    Parameters
    ----------
    pose_key : int
        Of a ``gtsam.Pose3``, world from body.
    calibration : Calibration
        Of a site with an Earth field.
    measured_sensor : ndarray, shape (3,)
        (T)
    cov : ndarray, shape (3, 3)
        (T^2)
    keys : CalibrationKeys, optional
        Calibration parameters that the graph estimates.
    robust : bool
        Whether a field that contradicts the motion is rejected (Geman and McClure).

    Raises
    ------
    ValueError
        If the site has no Earth field.
    """
    if calibration.site.earth_field_world is None:
        raise ValueError("the site must have an Earth field")
    measurement = EarthField(
        epoch=np.zeros(1, dtype=np.int64),
        time=np.array([calibration.reference_time]),
        measured=np.asarray(measured_sensor)[None],
        sqrt_information=whitening(cov, np.ones((), dtype=bool))[None],
        rate_body=np.zeros((1, 3)),
        repeats=1.0,
        applied_offset=np.zeros(1),
        robust=robust,
    )
    keys = CalibrationKeys(calibration, ()) if keys is None else keys
    return _factor(measurement, keys, pose_key, 0, None, 3)


def zero_velocity_factor(velocity_key: int, sigma: float) -> gtsam.PriorFactorVector:
    """Return rest at one epoch, as GTSAM's own prior of a velocity (m/s)."""
    return gtsam.PriorFactorVector(
        velocity_key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    )


def _factor(
    measurement: Measurement,
    keys: CalibrationKeys,
    pose_key: int,
    group: int,
    beacon: str | None,
    components: int,
) -> gtsam.NoiseModelFactor:
    """Return a factor on a pose, and on the parameters of one beacon and of no beacon."""
    own = [
        key
        for (key, _), block in zip(keys.parts, keys.blocks, strict=True)
        if not isinstance(block.parameter, BeaconParameter) or block.owner == beacon
    ]
    shared = EpochRows(measurement, keys, MotionKeys(pose_key, ABSENT, ABSENT))
    return group_factor(shared, group, [pose_key, *own], components)
