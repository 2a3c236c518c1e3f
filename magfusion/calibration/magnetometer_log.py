"""Magnetometer calibration from a log of slow rotation by hand, or of static orientations."""

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.ndimage import uniform_filter1d

from magfusion.calibration.ellipsoid import fit_ellipsoid_gravity
from magfusion.calibration.magnetometer import (
    MagnetometerFit,
    field_from_measured,
    missing_orientations,
    prior_cov,
    refined,
    spread,
)
from magfusion.calibration.magnetometer_graph import (
    GraphFit,
    MagnetometerEpochs,
    MagnetometerPrior,
    fit_graph,
)
from magfusion.calibration.magnetometer_start import (
    most_probable_fit,
    report_missing,
    rival_offset,
    starts,
)
from magfusion.calibration.sphere_fit import FIRST_SIGMA, sphere_fits
from magfusion.calibration.static_field import MAX_WINDOW, StaticField, average, static_field
from magfusion.calibration.stops import distinct, find_stops
from magfusion.errors import EstimationError, InputError
from magfusion.model.field import skew
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trajectory import interpolated
from magfusion.units import DEGREE, Array

POSITIONS = 12
MIN_EPOCHS = 20  # of slow turning
ONE_AXIS = 1.5 * DEGREE  # RMS; a field that wanders less in its second direction saw no turning
KNOWN_DIP = 3.0 * DEGREE  # sigma; what steel in a building does to a reference field
UNKNOWN_DIP = 1.0  # rad
WIDE_SIZE = 3.0  # sigma of the logarithm of the field's size, where nobody declared it
ACCEL_FLOOR = 0.03  # m/s^2; scale errors of MEMS accelerometers
GYRO_SCALE = 0.001  # relative; errors of scale and axes of a calibrated MEMS gyro
SHAKEN = 5  # epochs over which disturbed specific force is looked for
# Of the sigma by which motion disturbs the vertical: a hand tilts in step with its acceleration,
# so that many shaken epochs are no more informative than a few.
IN_STEP = 4.0
FIELD_SCALES = (0.05, 20.0)  # by which the first guess of an undeclared field's size may be wrong
LINEARITY = 2e-5  # of the field; a reading is no better than this, however long the window
MAX_ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class LogCalibration:
    """A calibration from a log, and the data it is based on."""

    magnetometer: Magnetometer  # as calibrated
    graph: GraphFit
    prior: MagnetometerPrior
    readings: StaticField  # readings used in the graph
    field_sigma: float  # estimated noise of a reading (T)
    missing: list[str]  # descriptions of missing orientations
    scale_known: bool  # whether the site's Earth field set the scale; else the declared matrix did
    # standard deviation over mean of the field's magnitude in each half of the log with the
    # calibration of the other half; None where a half is too short
    spread_unseen: float | None
    # whether the declared shape and offset fit the other half as well, and were kept
    shape_kept: bool
    # (3,), another offset (T), far from the estimate, that explains the readings nearly as well
    rival: Array | None = None


def calibrate_log(
    waveform: Waveform, imu: ImuSamples, site: Site, *, at_stops: bool = False
) -> LogCalibration:
    """Calibrate the magnetometer of a rotated platform.

    `waveform`: beacons may transmit; their tones average out. `site`: its sigmas of the
    magnetometer are the prior, its Earth field sets the scale. `at_stops`: use only the stops, of
    which twelve are needed, with each axis up and down among them. Raises InputError where the
    platform is rotated too little, or has too few stops for ``at_stops``; EstimationError where the
    graph has no solution.
    """
    known = site.platform.magnetometer
    readings = _readings(waveform, imu, site, known, at_stops)
    up_sensor = readings.accel_body @ known.body_from_sensor
    missing = missing_orientations(up_sensor)
    _refuse_one_axis(readings, known, site.earth_field_world, missing)
    prior = _prior(site, readings)
    turns = _turns(imu, site, readings.time)
    begun = _starts(readings, imu, site, up_sensor, prior, missing)
    if site.earth_field_world is None:
        seen = _field_seen(readings, known, begun[0].matrix, begun[0].offset)
        prior = replace(prior, field_world=seen)
    sigma = FIRST_SIGMA * float(np.linalg.norm(prior.field_world))
    for _ in range(MAX_ITERATIONS):
        epochs = MagnetometerEpochs(
            measured_sensor=readings.measured_sensor,
            field_sigma=sigma,
            accel_body=readings.accel_body,
            accel_sigma=_accel_sigma(readings, site, at_stops),
            turns=turns,
        )
        with report_missing(missing, field_known=site.earth_field_world is not None):
            graph = most_probable_fit(epochs, prior, begun)
            start = graph.fit
            if site.earth_field_world is None:
                prior = _sized(prior, graph)
        result = replace(known, matrix=start.matrix, offset=start.offset)
        readings = _readings(waveform, imu, site, result, at_stops)
        sigma = _field_sigma(readings, result, prior)
        begun = (start,)
    rival = rival_offset(epochs, prior, graph)
    if at_stops:
        _refuse_few_stops(distinct(graph.world_from_body), missing)
    unseen = None if at_stops else _spread_unseen(epochs, prior, graph.fit)
    kept = unseen is not None and _no_better(unseen, readings, known, site.earth_field_world)
    if kept:
        graph = replace(graph, fit=_turned_only(known, graph.fit, prior))
    return LogCalibration(
        magnetometer=refined(known, graph.fit),
        graph=graph,
        prior=prior,
        readings=readings,
        field_sigma=sigma,
        missing=missing,
        scale_known=site.earth_field_world is not None,
        spread_unseen=unseen,
        shape_kept=kept,
        rival=rival,
    )


def _readings(
    waveform: Waveform, imu: ImuSamples, site: Site, known: Magnetometer, at_stops: bool
) -> StaticField:
    if not at_stops:
        readings = static_field(waveform, imu, site, magnetometer=known)
        if len(readings) < MIN_EPOCHS:
            raise InputError(
                f"magnetometer: the log gives {len(readings)} readings; {MIN_EPOCHS} are"
                " required; rotate the sensor slowly for a minute"
            )
        return readings
    stops = find_stops(imu, site.platform.motion)
    if len(stops) == 0:
        raise InputError(
            "imu: no stationary interval was found; keep the sensor at rest for three seconds in"
            " each of the twelve positions, or omit --positions"
        )
    if len(stops) < POSITIONS:
        raise InputError(
            f"imu: {len(stops)} stops were found and {POSITIONS} are required; keep the sensor at"
            " rest for three seconds in each position, or omit --positions"
        )
    offset = site.platform.imu.time_offset
    window = np.minimum(stops.length, MAX_WINDOW)
    return average(waveform, imu, offset, known, stops.centre + offset, window)


def _refuse_one_axis(
    readings: StaticField, known: Magnetometer, field_world: Array | None, missing: list[str]
) -> None:
    field = field_from_measured(readings.measured_sensor, known.matrix, known.offset)
    # Not the directions of the readings: an unknown hard iron hides their rotation.
    size = np.linalg.norm(field if field_world is None else field_world, axis=-1)
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(field.T)), 0.0)) / np.median(size)
    if spreads[1] < ONE_AXIS:
        raise InputError(
            "magnetometer: too few orientations to calibrate on: "
            + (", ".join(missing) or "the field stays along one line in the sensor")
            + "; rotate it slowly about all its axes"
        )


def _refuse_few_stops(result: int, missing: list[str]) -> None:
    if missing or result < POSITIONS:
        raise InputError(
            f"imu: the stops have {result} different orientations and {POSITIONS} are required"
            + "".join(f"; {sentence}" for sentence in missing)
            + "; stop with each axis up and down, at two headings each"
        )


def _prior(site: Site, readings: StaticField) -> MagnetometerPrior:
    known, imu = site.platform.magnetometer, site.platform.imu
    field, dip_sigma, size_sigma = site.earth_field_world, KNOWN_DIP, 0.0
    if field is None:
        field = _field_seen(readings, known, known.matrix, known.offset)
        dip_sigma, size_sigma = UNKNOWN_DIP, WIDE_SIZE
    return MagnetometerPrior(
        body_from_sensor=known.body_from_sensor,
        matrix=known.matrix,
        offset=known.offset,
        cov=prior_cov(known),
        field_world=field,
        dip_sigma=dip_sigma,
        gravity=site.gravity,
        accel_bias_sigma=imu.accel_bias_sigma,
        gyro_bias_sigma=imu.gyro_bias_sigma,
        size_sigma=size_sigma,
    )


def _field_seen(readings: StaticField, known: Magnetometer, matrix: Array, offset: Array) -> Array:
    """Return the Earth field (T) in a world frame whose north is defined by the field."""
    field_body = field_from_measured(readings.measured_sensor, matrix, offset)
    field_body = field_body @ known.body_from_sensor.T
    size = float(np.median(np.linalg.norm(field_body, axis=1)))
    up = readings.accel_body / np.linalg.norm(readings.accel_body, axis=1, keepdims=True)
    vertical = float(np.clip(np.median(np.sum(up * field_body, axis=1)) / size, -0.99, 0.99))
    return size * np.array([0.0, np.sqrt(1.0 - vertical**2), vertical])


def _starts(
    readings: StaticField,
    imu: ImuSamples,
    site: Site,
    up_sensor: Array,
    prior: MagnetometerPrior,
    missing: list[str],
) -> tuple[MagnetometerFit, ...]:
    """Return initial estimates: from the ellipsoid where readings surround it.

    Else from the magnitude of the field, and from the gyro.
    """
    known, size = site.platform.magnetometer, float(np.linalg.norm(prior.field_world))
    if not missing:
        with suppress(EstimationError):
            return (fit_ellipsoid_gravity(readings.measured_sensor, up_sensor, size),)
    by_size: list[MagnetometerFit] = []
    with suppress(EstimationError):
        by_size = sphere_fits(readings, known, prior)
    lag = site.platform.imu.time_offset
    return (*by_size, *starts(readings, imu, lag, known, prior.cov[9:, 9:], size))


def _accel_sigma(readings: StaticField, site: Site, is_stationary: bool) -> Array:
    """Return the noise of the specific force, motion included."""
    imu = site.platform.imu
    variance = 1.5 * imu.accel_noise**2 / readings.window + ACCEL_FLOOR**2
    if not is_stationary:
        excess = np.linalg.norm(readings.accel_body, axis=1) - site.gravity
        variance += IN_STEP**2 * uniform_filter1d(excess**2, SHAKEN, mode="nearest")
    return np.sqrt(variance)


def _field_sigma(readings: StaticField, result: Magnetometer, prior: MagnetometerPrior) -> float:
    """Return the noise of a reading from the field's magnitude, which is attitude-independent."""
    field = field_from_measured(readings.measured_sensor, result.matrix, result.offset)
    size = np.linalg.norm(prior.field_world)
    residual = np.linalg.norm(field, axis=1) - size
    scatter = np.sqrt(np.sum(residual**2) / max(len(residual) - 9, 1))
    return float(max(scatter, LINEARITY * size))


def _turns(
    imu: ImuSamples, site: Site, epoch: Array
) -> tuple[gtsam.PreintegratedAhrsMeasurements | None, ...]:
    """Return the gyro's rotation over each interval; None where its stream has a gap."""
    time = imu.time + site.platform.imu.time_offset
    usual = float(np.median(np.diff(time)))
    grid = np.union1d(time[(time > epoch[0]) & (time < epoch[-1])], epoch)
    rate = interpolated(grid, time, imu.gyro_body)
    mean, step = 0.5 * (rate[:-1] + rate[1:]), np.diff(grid)
    silent = time[:-1][np.diff(time) > 5.0 * usual]
    first = np.searchsorted(grid, epoch)
    out: list[gtsam.PreintegratedAhrsMeasurements | None] = []
    for begin, end in pairwise(first):
        if np.any((silent > grid[begin] - usual) & (silent < grid[end])):
            out.append(None)
            continue
        part = slice(begin, end)
        angle = float(np.sum(np.linalg.norm(mean[part], axis=1) * step[part]))
        whole = float(grid[end] - grid[begin])
        # A common error of all rotations, modelled as independent errors that do not average out.
        systematic = GYRO_SCALE**2 * len(epoch) * angle**2
        density = site.platform.imu.gyro_noise**2 + systematic / whole
        parameters = gtsam.PreintegrationParams.MakeSharedU(site.gravity)
        parameters.setGyroscopeCovariance(density * np.eye(3))
        turn = gtsam.PreintegratedAhrsMeasurements(parameters, np.zeros(3))
        for omega, dt in zip(mean[part], step[part], strict=True):
            turn.integrateMeasurement(omega, dt)
        out.append(turn)
    return tuple(out)


def _sized(prior: MagnetometerPrior, graph: GraphFit) -> MagnetometerPrior:
    """Return the prior with the estimated magnitude of the field.

    The initial magnitude is as wrong as the declared offset.
    """
    if not FIELD_SCALES[0] < graph.size_ratio < FIELD_SCALES[1]:
        raise EstimationError(
            f"the estimated magnitude of the field is {graph.size_ratio:.3g} times that of the"
            " readings; declare the offset of the magnetometer, or the Earth field (earth_field_t)"
        )
    return replace(prior, field_world=graph.size_ratio * prior.field_world)


def _spread_unseen(
    epochs: MagnetometerEpochs, prior: MagnetometerPrior, start: MagnetometerFit
) -> float | None:
    """Return the spread of the field in each half with the calibration of the other half."""
    half, n = len(epochs) // 2, len(epochs)
    fields = []
    for own, other in ((slice(half), slice(half, n)), (slice(half, n), slice(half))):
        try:
            fit = fit_graph(_part(epochs, own), prior, start).fit
        except EstimationError:
            return None
        fields.append(field_from_measured(epochs.measured_sensor[other], fit.matrix, fit.offset))
    return spread(np.concatenate(fields))


def _part(epochs: MagnetometerEpochs, part: slice) -> MagnetometerEpochs:
    assert epochs.accel_body is not None
    assert epochs.accel_sigma is not None
    begin, end, _ = part.indices(len(epochs))
    return replace(
        epochs,
        measured_sensor=epochs.measured_sensor[part],
        accel_body=epochs.accel_body[part],
        accel_sigma=epochs.accel_sigma[part],
        turns=epochs.turns[begin : end - 1],
    )


def _no_better(
    unseen: float, readings: StaticField, known: Magnetometer, field_world: Array | None
) -> bool:
    """Return whether the spread is not significantly below that of the declared calibration.

    A large hard iron makes a large field, relative to which any scatter is small: the declared
    calibration must also give the correct magnitude.
    """
    declared = field_from_measured(readings.measured_sensor, known.matrix, known.offset)
    sizes = np.linalg.norm(declared, axis=1)
    size = np.mean(sizes) if field_world is None else np.linalg.norm(field_world)
    residual = float(np.sqrt(np.mean((sizes - size) ** 2)) / size)
    return unseen > residual * (1.0 - float(np.sqrt(0.5 / len(readings))))


def _turned_only(
    known: Magnetometer, fit: MagnetometerFit, prior: MagnetometerPrior
) -> MagnetometerFit:
    """Return the declared shape and offset and their covariance, with the estimated rotation."""
    residual, _, right = np.linalg.svd(np.linalg.inv(known.matrix) @ fit.matrix)
    turn = np.stack([(known.matrix @ skew(axis)).ravel() for axis in np.eye(3)], axis=1)
    rotation = np.zeros((12, 12))
    rotation[:9, :9] = turn @ np.linalg.pinv(turn)
    shape = np.eye(12) - rotation
    cov = rotation @ fit.cov @ rotation.T + shape @ prior.cov @ shape.T
    return MagnetometerFit(known.matrix @ residual @ right, known.offset, cov)
