"""Iron or magnets on the body: uncompensated hard and soft iron in the static field.

The gyroscope rotates a static field from one span to the next by T.  A calibration error, matrix
``1 + E`` and offset ``o``, leaves the residual ``u' - T u = (E T - T E) b + (1 - T) o``, linear in
both.  Distortion by a room's iron depends on position instead and does not fit this model; without
rotation nothing is observable.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.field_rotation import CORRELATED
from magfusion.estimation.data_checks.still_means import StillMeans
from magfusion.files.site_changes import changed_keys
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

IRON_SPAN = 0.5  # s; short enough for little rotation
USUAL_MATRIX, USUAL_OFFSET = 0.1, 1.0  # relative to the field's size; of iron, one sigma
MIN_STEPS = 20
MIN_ROTATION = 0.1  # rad/s, rms
USUAL_BIAS = 0.02  # rad/s; of the gyroscope, one sigma
LIMIT = 8.5  # sigma of twelve numbers, 6 of one
USUAL_MOUNTING = 0.1  # rad
MIN_SHARE = 0.01  # of the field's size, from which iron is reported
EXPLAINED = 0.8  # share of the residual
EXACT = 1e-6  # sigma of a matrix that is declared to be exact
AS_WELL = 2.0  # ratio of what remains by a magnet to that by any iron, up to which it is a magnet
# What a turn of the mounting does to matrix and offset, by its three components.
_MOUNTING = np.zeros((12, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _MOUNTING[3 * _i + _j, _k], _MOUNTING[3 * _j + _i, _k] = -1.0, 1.0


class BodyIron(NamedTuple):
    """Body-fixed iron: the static field that is measured is ``(1 + matrix) field + offset``."""

    matrix_body: Array  # (3, 3); its antisymmetric part is a turn of the mounting
    offset_body: Array  # (3,) (T)
    cov: Array  # (12, 12), of the matrix, row by row, and the offset over the field's size
    explained: float  # share of the residuals from one span to the next
    size: float  # of the field (T)

    @property
    def symmetric_body(self) -> Array:
        """Return the soft iron, (3, 3): the matrix without a turn of the mounting."""
        return 0.5 * (self.matrix_body + self.matrix_body.T)

    def compensated_in(self, site: Site, *, soft: bool = True) -> Site:
        """Return the site with its magnetometer calibrated; without `soft`, only its offset."""
        sensor = site.platform.magnetometer
        sensor_from_body = sensor.body_from_sensor.T
        offset = sensor.offset + sensor.matrix @ sensor_from_body @ self.offset_body
        matrix, within = sensor.matrix, sensor_from_body @ self.symmetric_body
        if soft:
            matrix = matrix @ (np.eye(3) + within @ sensor.body_from_sensor)
        first, *others = site.platform.magnetometers
        calibrated = replace(first, offset=offset, matrix=matrix)
        platform = site.platform.with_magnetometers((calibrated, *others))
        return replace(site, platform=platform)


def fitted_iron(means: StillMeans, matrix_sigma: float = USUAL_MATRIX) -> BodyIron | None:
    """Return the iron that explains the static field; None without enough rotation.

    `means`: over spans of `IRON_SPAN`, by the declared calibration of the magnetometer.
    `matrix_sigma`: of the soft iron.
    """
    if len(means) < MIN_STEPS or not np.all(np.isfinite(means.field_body)):
        return None
    size = float(np.median(np.linalg.norm(means.field_body, axis=1)))
    following = np.diff(means.time) < 1.5 * IRON_SPAN
    field = means.field_body / size
    attitude = means.still_from_body
    turn = np.swapaxes(attitude[1:], 1, 2) @ attitude[:-1]
    turn, before, after = turn[following], field[:-1][following], field[1:][following]
    if len(turn) < MIN_STEPS:
        return None
    angle = np.arccos(np.clip(0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
    if not np.sqrt(np.mean(angle**2)) > MIN_ROTATION * IRON_SPAN:
        return None
    residual = after - np.einsum("nij,nj->ni", turn, before)
    result, cov, explained = _fitted(turn, before, residual, matrix_sigma)
    return BodyIron(result[:9].reshape(3, 3), size * result[9:], cov, explained, size)


def fitted_magnet(means: StillMeans, site: Site) -> BodyIron | None:
    """Return the same with a matrix that is known as well as declared: a magnet alone."""
    known = float(np.max(site.platform.magnetometer.sigma.matrix))
    return fitted_iron(means, max(known, EXACT))


def iron_on_body(means: StillMeans, site: Site) -> Iterator[Finding]:
    """Yield the body-fixed iron that the declared calibration does not account for.

    `means`: over spans of `IRON_SPAN`.
    """
    iron = fitted_iron(means)
    if iron is None:
        return
    soft, hard = iron.symmetric_body, iron.offset_body / iron.size
    result, sensor = np.append(iron.matrix_body, hard), site.platform.magnetometer.sigma
    sigma = np.repeat([np.max(sensor.matrix), np.max(sensor.offset) / iron.size], [9, 3])
    # A mounting error is not iron.
    allowed = iron.cov + np.diag(sigma**2) + USUAL_MOUNTING**2 * _MOUNTING @ _MOUNTING.T
    weight = float(np.sqrt(result @ np.linalg.solve(allowed, result)))
    share = max(float(np.max(np.abs(soft))), float(np.linalg.norm(hard)))
    if not (weight > LIMIT and iron.explained > EXPLAINED and share > MIN_SHARE):
        return
    of_matrix, of_offset = float(np.sqrt(np.mean(soft**2))), float(np.linalg.norm(iron.offset_body))
    yield Finding(
        "body_iron",
        "magnetometer: the static field changes with attitude: uncalibrated iron or a magnet is on"
        f" the body ({weight:.0f} sigma; offset {1e6 * of_offset:.2g} uT, matrix"
        f" {100.0 * of_matrix:.2g} %). Calibrate it with magfusion calibrate magnetometer, or"
        " declare platform.magnetometer.sigma as matrix:"
        f" {max(of_matrix, 1e-3):.2g}, offset_t: {max(of_offset, 1e-8):.2g}.",
        Verdict.DOUBTFUL,
        150.0 + min(weight, 100.0),
        remedy=changed_keys(site, calibrated(means, site)),
    )


def calibrated(means: StillMeans, site: Site) -> Site:
    """Return the site with the offset that explains the static field, and a matrix where it must.

    `means`: as of `fitted_iron`; the field rotates enough.
    """
    magnet, iron = fitted_magnet(means, site), fitted_iron(means)
    if magnet is None or iron is None:
        return site
    suffices = 1.0 - magnet.explained < AS_WELL * (1.0 - iron.explained)
    return magnet.compensated_in(site, soft=False) if suffices else iron.compensated_in(site)


def _fitted(
    turn: Array, before: Array, residual: Array, matrix_sigma: float
) -> tuple[Array, Array, float]:
    """Return matrix (9, row by row) and offset (3), their covariance, and the explained share.

    `turn` (n, 3, 3). `before`, `residual` (n, 3): fields in units of their size.
    """
    rotated = np.einsum("nij,nj->ni", turn, before)
    eye = np.eye(3)
    # (E T b)_i depends on row i of E; (T E b)_i on column i of T and row i of E.
    by_matrix = np.einsum("ki,nj->nkij", eye, rotated) - np.einsum("nki,nj->nkij", turn, before)
    by_offset = eye - turn
    by_bias = -IRON_SPAN * np.cross(rotated[:, :, None], eye, axisa=1, axisb=0, axisc=1)
    parts = [by_matrix.reshape(-1, 3, 9), by_offset, by_bias]
    design = np.concatenate(parts, axis=2).reshape(-1, 15)
    right = residual.ravel()
    prior = np.repeat([matrix_sigma, USUAL_OFFSET, USUAL_BIAS], [9, 3, 3]) ** -2.0
    noise = 1e-4
    result, inverse = np.zeros(15), np.zeros((15, 15))
    for _ in range(3):
        information = design.T @ design / noise**2 / CORRELATED + np.diag(prior)
        inverse = np.linalg.inv(information)
        result = inverse @ (design.T @ right / noise**2 / CORRELATED)
        noise = max(float(np.sqrt(np.mean((right - design @ result) ** 2))), 1e-6)
    # The part that the gyroscope bias explains is not iron.
    right = right - design[:, 12:] @ result[12:]
    after = float(np.sum((right - design[:, :12] @ result[:12]) ** 2))
    explained = 1.0 - after / max(float(np.sum(right**2)), 1e-30)
    return np.asarray(result[:12]), np.asarray(inverse[:12, :12]), explained
