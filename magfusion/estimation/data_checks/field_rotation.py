"""Consistency of the static field's rotation with the gyroscope, independent of the beacons.

A static field changes in body axes by ``db/dt = -(M rate) x b``; M is the identity if axes, signs,
units and clocks of both instruments are as declared.  Both sides pass the same low-pass filter,
below every tone, so that the fit is linear in M and exact.  In rooms with iron and on real
instruments the identity explains 87 to 99.9 % of db/dt.
"""

from functools import cache
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from magfusion.model.field import skew
from magfusion.model.quaternion import cross
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.units import Array, BoolArray

CUTOFF = 2.0  # Hz
REACH = 1.6  # half width of the low-pass filter, in its own periods
MIN_ROTATION = 0.05  # rad/s; slower rotation is not compared
CONTRADICTED = 0.5  # explained share of db/dt below which the axes are not those declared
EXPLAINED = 0.7  # by the alternative that is reported
MAX_LAG = 3.0  # s
LAG_STEP = 0.02  # s
CORRELATED = 2.0  # consecutive rows, of filtered rates or of spans, that share one residual
_EPSILON = np.zeros((3, 3, 3))
for _i, _k, _j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _EPSILON[_i, _k, _j], _EPSILON[_i, _j, _k] = 1.0, -1.0


class FieldRotation(NamedTuple):
    """Rate of change of a field in body axes, and its prediction by the gyroscope."""

    change: Array  # (n, 3), db/dt, body axes, as a share of the field (1/s)
    by_matrix: Array  # (n, 3, 9), its derivatives by the rows of M
    rate: Array  # (n, 3), of the gyroscope, body axes (rad/s)

    @property
    def speed(self) -> float:
        """Root mean square rate at which the direction of the field changes (rad/s)."""
        return float(np.sqrt(np.mean(np.sum(self.change**2, axis=1)))) if len(self.change) else 0.0

    def explained(self, matrix: Array) -> float:
        """Return the share of the change that a matrix M (3, 3) explains; may be negative."""
        residual = self.change - self.by_matrix @ matrix.ravel()
        return float(1.0 - np.sum(residual**2) / np.sum(self.change**2))

    def explained_shifted(self, matrix: Array) -> tuple[float, Array]:
        """Return the share that M explains of a field with a constant offset, and that offset.

        The offset (3,), of a hard iron, is a share of the field: its best fit.
        """
        residual = self.change - self.by_matrix @ matrix.ravel()
        rows = skew(self.rate @ matrix.T).reshape(-1, 3)  # -(M rate) x (b - offset)
        offset, *_ = np.linalg.lstsq(rows, residual.ravel(), rcond=None)
        after = np.sum((residual.ravel() - rows @ offset) ** 2)
        return float(1.0 - after / np.sum(self.change**2)), np.asarray(offset, dtype=np.float64)

    @property
    def expected_rate(self) -> float:
        """Root mean square rate of the field's direction predicted by the gyroscope (rad/s)."""
        findings = self.by_matrix @ np.eye(3).ravel()
        return float(np.sqrt(np.mean(np.sum(findings**2, axis=1))))

    def agreement(self, matrix: Array) -> float:
        """Return the share that a matrix explains with its best positive scale."""
        findings = self.by_matrix @ matrix.ravel()
        product = float(np.sum(findings * self.change))
        power = float(np.sum(findings**2)) * float(np.sum(self.change**2))
        return product * abs(product) / max(power, 1e-30)

    def mounting(self) -> tuple[Array, float, float]:
        """Return the best small rotation (rad), its sigma, and the residual's improvement."""
        residual = self.change - self.by_matrix @ np.eye(3).ravel()
        # M = I + [turn]x
        by_turn = self.by_matrix @ np.swapaxes(_EPSILON, 1, 2).reshape(3, 9).T
        rows, right = by_turn.reshape(-1, 3), residual.ravel()
        normal = rows.T @ rows
        if np.linalg.cond(normal) > 1e6:
            return np.zeros(3), np.inf, 1.0
        turn = np.linalg.solve(normal, rows.T @ right)
        after = float(np.sum((right - rows @ turn) ** 2))
        variance = after / max(len(self.change) / CORRELATED - 3.0, 1.0)
        sigma = float(np.sqrt(variance * np.max(np.diagonal(np.linalg.inv(normal)))))
        return (
            np.asarray(turn, dtype=np.float64),
            sigma,
            float(np.sum(right**2)) / max(after, 1e-30),
        )

    @property
    def scale(self) -> float:
        """Factor by which the rates are too small, with axes as declared."""
        findings = self.by_matrix @ np.eye(3).ravel()
        return float(np.sum(findings * self.change) / max(float(np.sum(findings**2)), 1e-30))


def turning(
    imu: ImuSamples, field_time: Array, field_body: Array, lag: float = 0.0
) -> FieldRotation:
    """Compare the rotation of a field with the gyroscope's.

    `field_time` (n,) (s). `field_body` (n, 3): in body axes by the declared calibration and
    mounting, including tones (T). `lag`: added to the stamps of the inertial samples (s).
    """
    step = float(np.median(np.diff(field_time)))
    time = np.arange(field_time[0], field_time[-1] + 0.5 * step, step)
    reach = int(np.ceil(REACH / CUTOFF / step))
    if len(time) < 8 * reach:
        return FieldRotation(np.zeros((0, 3)), np.zeros((0, 3, 9)), np.zeros((0, 3)))
    field = _interpolated(time, field_time, field_body)
    rate = _interpolated(time, imu.time + lag, imu.gyro_body)
    there = _covered(time, field_time, step) & _covered(time, imu.time + lag, step)
    about = np.arange(-reach, reach + 1) * step
    low = np.sinc(2.0 * CUTOFF * about) * np.hanning(2 * reach + 3)[1:-1]
    low /= np.sum(low)
    slope = np.gradient(low, step)
    every = max(1, int(0.25 / (CUTOFF * step)))
    size = float(np.median(np.linalg.norm(field, axis=1)))

    def passed(value: Array, kernel: Array) -> Array:
        return convolved(value, kernel, mode="valid")[::every]

    change = passed((field - np.mean(field, axis=0)) / size, slope)
    both = passed((rate[:, :, None] * field[:, None, :] / size).reshape(-1, 9), low)
    by_matrix = -np.einsum("ikj,nlj->nikl", _EPSILON, both.reshape(-1, 3, 3)).reshape(-1, 3, 9)
    missing = np.concatenate([[0.0], np.cumsum(~there)])
    whole = (missing[2 * reach + 1 :] == missing[: -2 * reach - 1])[::every]
    return FieldRotation(change[whole], by_matrix[whole], passed(rate, low)[whole])


def _interpolated(time: Array, known: Array, value: Array) -> Array:
    return np.stack([np.interp(time, known, column) for column in value.T], axis=1)


def _covered(time: Array, known: Array, step: float) -> BoolArray:
    """Return at which times a stream has neighbouring samples."""
    after = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
    usual = float(np.median(np.diff(known)))
    near = known[after] - known[after - 1] < max(0.05, 4.0 * usual)
    inside = (time >= known[0] - step) & (time <= known[-1] + step)
    return np.asarray(near & inside)


@cache
def axes() -> tuple[Array, ...]:
    """Return the 48 signed axis permutations, the identity first."""
    result = [
        np.asarray(np.eye(3)[list(order)] * np.array(sign)[:, None])
        for order in permutations(range(3))
        for sign in product((1.0, -1.0), repeat=3)
    ]
    return tuple(sorted(result, key=lambda m: -float(np.trace(m))))


def field_body(log: Log, site: Site | None) -> Array:
    """Return the raw field in body axes by the declared calibration (T), shape (n, 3)."""
    assert log.waveform is not None
    measured = log.waveform.measured_sensor
    if site is None:
        return measured
    sensor = site.platform.magnetometer
    clean = (measured - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    return np.asarray(clean @ sensor.body_from_sensor.T)


def agrees(log: Log, site: Site) -> bool:
    """Return whether the body rotates, and the gyroscope explains it as declared."""
    result = rotation_in(log, site)
    return result is not None and result.explained(np.eye(3)) > CONTRADICTED


def rotation_in(log: Log, site: Site) -> FieldRotation | None:
    """Return the rotation of a log's static field; None where it is not measured or too small."""
    if log.vectors is None or len(log.imu) < 2:
        return None
    offset = site.platform.imu.time_offset
    result = turning(log.imu, log.vectors.time, field_body(log, site), offset)
    return result if len(result.change) >= 12 and result.speed > MIN_ROTATION else None


def convolved(value: Array, kernel: Array, mode: Literal["valid", "same"]) -> Array:
    """Return each column of many values convolved with a kernel.

    As `scipy.signal.fftconvolve`, whose import takes as long as all else. `value` (n, columns).
    `kernel` (m,): for 'valid', no longer than the values. `mode`: return the values where the
    kernel fits entirely, or as many as there are.
    """
    whole = len(value) + len(kernel) - 1
    size = next_fast_len(whole, real=True)
    spectrum = rfft(value, size, axis=0) * rfft(kernel, size)[:, None]
    first = len(kernel) - 1 if mode == "valid" else (len(kernel) - 1) // 2
    count = len(value) - len(kernel) + 1 if mode == "valid" else len(value)
    return np.asarray(irfft(spectrum, size, axis=0)[first : first + count])


def _products(vectors: Array) -> Array:
    """Return columns whose products sum to squares of cross products.

    By ``|a x b|^2 = |a|^2 |b|^2 - (a b)^2``: one column to add, and six to subtract.
    """
    x, y, z = vectors.T
    root = np.sqrt(2.0)
    square = x**2 + y**2 + z**2
    separate = x**2, y**2, z**2, root * x * y, root * y * z, root * z * x
    return np.stack([square, *separate], axis=1)


class Clocks:
    """Rotation of the field and rates on one grid, each by its own stamps."""

    def __init__(self, log: Log, time: Array, field: Array, offset: float) -> None:
        self.time = np.arange(time[0], time[-1], LAG_STEP)
        average = max(1, round(1.0 / (CUTOFF * LAG_STEP)))
        window = max(1, round(average * LAG_STEP / float(np.median(np.diff(time)))))
        smooth = convolved(field, np.full(window, 1.0 / window), mode="same")
        self.field = _interpolated(self.time, time, smooth)
        self.change = np.gradient(self.field, LAG_STEP, axis=0)
        rate = _interpolated(self.time, log.imu.time + offset, log.imu.gyro_body)
        self.rate = convolved(rate, np.full(average, 1.0 / average), mode="same")

    def lag(self, part: slice = slice(None)) -> tuple[float, float]:
        """Return the best time shift of the inertial stamps in a part (s), and its agreement."""
        count = int(MAX_LAG / LAG_STEP)
        field, change, rate = self.field[part], self.change[part], self.rate[part]
        if len(field) < 4 * count:
            return 0.0, -np.inf
        field, change = field[count:-count], change[count:-count]
        total = float(np.sum(change**2))
        # Of field change and field rotation rate; a later sample is read from before.
        rotated, rated = _products(field), _products(rate)
        rotated[:, 1:] *= -1.0
        pairs = [*zip(rate.T, 2.0 * cross(field.T, change.T), strict=True)]
        pairs += zip(rated.T, rotated.T, strict=True)
        residual = (
            total + np.sum([np.correlate(by, own, "valid") for by, own in pairs], axis=0)[::-1]
        )
        k = int(np.argmin(residual))
        finer = 0.0
        if 0 < k < 2 * count:
            before, here, after = residual[k - 1 : k + 2]
            finer = 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-30)
        return (k - count + float(finer)) * LAG_STEP, 1.0 - float(residual[k]) / max(total, 1e-30)

    def rate_error(self) -> float:
        """Return the relative rate error of the inertial stamps, by the lags of both halves."""
        half = len(self.time) // 2
        (first, one), (second, other) = self.lag(slice(half)), self.lag(slice(half, None))
        if min(one, other) < EXPLAINED:
            return 0.0
        return (first - second) / (half * LAG_STEP)
