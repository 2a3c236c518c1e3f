"""Initial estimates for magnetometer calibration, from the gyro's rotation.

A field that is constant in the world rotates in the sensor as the gyro measures, a hard iron does
not.  For two readings a few seconds apart this is linear in the offset, whatever its size and
however small the rotation.  Along the least observable direction, the field's magnitude gives two
solutions, mirror images of each other.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from magfusion.calibration.magnetometer import MagnetometerFit, field_from_measured
from magfusion.calibration.magnetometer_graph import (
    GraphFit,
    MagnetometerEpochs,
    MagnetometerPrior,
    fit_graph,
)
from magfusion.calibration.static_field import StaticField
from magfusion.errors import EstimationError
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Magnetometer
from magfusion.model.strapdown import attitude_from_gyro_at
from magfusion.units import Array

LAGS = (1.0, 2.0, 4.0, 8.0)  # s; over which a gyro's bias turns little
NEAR = 0.3  # of a lag, by which two readings may be nearer or farther
FARTHEST, STEPS = 4e-4, 801  # T; hard iron along the direction that is told least
DISTINCT_CHI_SQUARE, UNLIKELY = (
    16.0,
    25.0,
)  # chi square by which an offset is another one, and by which it is out
FLAT = 0.15  # of the field, by which readings leave their plane; beyond, none mistakes its sides
READING = 0.02  # of the field: how wrong turned readings are, against the prior of the offset


def starts(
    readings: StaticField,
    imu: ImuSamples,
    time_offset: float,
    known: Magnetometer,
    offset_cov: Array,
    size: float,
) -> tuple[MagnetometerFit, ...]:
    """Return one or several initial offsets, with the matrix as declared.

    `time_offset`: added to the IMU's stamps (s). `offset_cov` (3, 3): prior (T^2). `size`: of the
    field (T).
    """
    to_body = known.body_from_sensor @ np.linalg.inv(known.matrix)
    body = (readings.measured_sensor - known.offset) @ to_body.T
    attitude = attitude_from_gyro_at(imu.time + time_offset, imu.gyro_body, readings.time)
    turn = attitude.as_matrix()
    square, side = np.zeros((3, 3)), np.zeros(3)
    for lag in LAGS:
        other = np.searchsorted(readings.time, readings.time + lag)
        first = np.flatnonzero(other < len(readings))
        other = other[first]
        near = readings.time[other] - readings.time[first] < (1.0 + NEAR) * lag
        first, other = first[near], other[near]
        back = np.swapaxes(turn[other], 1, 2) @ turn[first]  # then_from_first
        by_offset = np.eye(3) - back
        moved = body[other] - np.einsum("nij,nj->ni", back, body[first])
        square += np.einsum("nji,njk->ik", by_offset, by_offset)
        side += np.einsum("nji,nj->i", by_offset, moved)
    noise = (READING * size) ** 2
    prior = np.linalg.inv(to_body @ offset_cov @ to_body.T)
    middle = np.linalg.solve(square / noise + prior, side / noise)
    least = np.linalg.eigh(square / noise + prior)[1][:, 0]
    back_to_sensor = np.linalg.inv(to_body)
    return tuple(
        MagnetometerFit(
            known.matrix, known.offset + back_to_sensor @ (middle + far * least), np.zeros((12, 12))
        )
        for far in places(body - middle, least, size)
    )


def mirrored(measured: Array, fit: MagnetometerFit) -> MagnetometerFit | None:
    """Return the fit mirrored at the readings' plane (n, 3); None where they are not flat."""
    field = field_from_measured(measured, fit.matrix, fit.offset)
    spread, axes = np.linalg.eigh(np.cov(field.T))
    size = float(np.mean(np.linalg.norm(field, axis=1)))
    if np.sqrt(max(float(spread[0]), 0.0)) > FLAT * size:
        return None
    far = float(np.mean(field @ axes[:, 0]))
    return replace(fit, offset=fit.offset + 2.0 * far * fit.matrix @ axes[:, 0])


def most_probable_fit(
    epochs: MagnetometerEpochs, prior: MagnetometerPrior, begun: tuple[MagnetometerFit, ...]
) -> GraphFit:
    """Return the most probable of the solutions reached from several starts."""
    result, failure = [], EstimationError("")
    for start in begun:
        try:
            result.append(fit_graph(epochs, prior, start))
        except EstimationError as error:
            failure = error
    if not result:
        raise failure
    return min(result, key=lambda graph: graph.chi_square)


def rival_offset(
    epochs: MagnetometerEpochs, prior: MagnetometerPrior, graph: GraphFit
) -> Array | None:
    """Return another offset (T) that explains the readings nearly as well, if there is one.

    For readings in one plane the mirror image fits equally well: the magnitude is the same.
    """
    fit = graph.fit
    mirror = mirrored(epochs.measured_sensor, fit)
    if mirror is None:
        return None
    try:
        other = fit_graph(epochs, prior, mirror)
    except EstimationError:
        return None
    off = other.fit.offset - fit.offset
    elsewhere = off @ np.linalg.solve(fit.cov[9:, 9:], off) > DISTINCT_CHI_SQUARE
    return (
        other.fit.offset if elsewhere and other.chi_square < graph.chi_square + UNLIKELY else None
    )


@contextmanager
def report_missing(missing: list[str], *, field_known: bool) -> Iterator[None]:
    """Add the missing orientations, and a remedy, to a failure."""
    try:
        yield
    except EstimationError as failure:
        lack = "".join(f", {sentence}" for sentence in missing)
        remedy = "rotate it slowly about all its axes"
        if not field_known:
            remedy += ", or give the Earth field (earth_field_t): without its magnitude, rotation"
            remedy += " about one axis does not determine the offset along that axis"
        raise EstimationError(f"{failure}{lack}; {remedy}") from failure


def places(field: Array, direction: Array, size: float) -> Array:
    """Return where along a direction a field (n, 3) has its nominal magnitude (T): one or two."""
    tried = np.linspace(-FARTHEST, FARTHEST, STEPS)
    along = field @ direction
    across = np.sum(field**2, axis=1) - along**2
    sizes = np.sqrt(np.maximum(across, 0.0) + (along - tried[:, None]) ** 2)
    cost = np.mean((sizes - size) ** 2, axis=1)
    result = tried[1:-1][(cost[1:-1] < cost[:-2]) & (cost[1:-1] <= cost[2:])]
    return result if len(result) else tried[[int(np.argmin(cost))]]
