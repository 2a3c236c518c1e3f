"""Joint covariance of the windows of a range: noise, depths, and errors of the field model.

Errors of the model are correlated along the magnet's path, where neighbouring places have similar
errors; one covariance covers all windows.  A depth error shifts a window along the field's slope.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from magfusion.estimation.ranging.ranging_data import RangingWindows
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray

# Of the field gathered by a casing: joints, couplings and uneven steel make no infinite tube.
GATHERED_ERROR = 0.01


@dataclass(frozen=True, eq=False)
class WindowPrediction:
    """Predicted phasors of windows, and their slope along the magnet's path."""

    # phasor, slope: (n, tones, 3) (T), and (T/m)
    phasor: ComplexArray
    slope: ComplexArray
    # (n, tones), share of the field in proportion to the strength of a casing's poles
    gathered: Array


def real_and_imaginary(phasor: ComplexArray) -> Array:
    """Return real and imaginary parts, shape (..., 6)."""
    return np.concatenate([phasor.real, phasor.imag], axis=-1)


def window_weight(site: Site, windows: RangingWindows) -> Array:
    """Return the inverse roots of each phasor's own noise, shape (n, tones, 3, 3)."""
    fields = windows.fields
    power = (_model_error(site) * windows.seen) ** 2 / 6.0
    cov = fields.phasor_cov + power[..., None, None] * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(cov))
    return np.where(fields.valid[..., None, None], root, 0.0)


def whitening(site: Site, windows: RangingWindows, course: WindowPrediction | None = None) -> Array:
    """Return the inverse root of the covariance of all parts of all windows.

    `course`: linearisation point; by default the slope is bounded by the measurements, equal in all
    axes. Returns (m, m): ``m`` is windows by tones by `real_and_imaginary`.
    """
    fields, valid = windows.fields, windows.fields.valid
    n, tones = valid.shape
    cov = np.zeros((n, tones, 6, n, tones, 6))
    at, size = np.arange(n), windows.seen / np.sqrt(2.0)
    if course is not None:
        size = np.linalg.norm(course.phasor, axis=-1) / np.sqrt(2.0)
    shared = _model_error_correlation(site, windows)
    for t in range(tones):
        residual = _model_error(site) * size[:, t]
        if course is not None:
            residual = np.hypot(residual, GATHERED_ERROR * course.gathered[:, t] * size[:, t])
        error = shared * np.outer(residual, residual) / 3.0
        for part in range(6):
            cov[:, t, part, :, t, part] = error
        for own in (slice(0, 3), slice(3, 6)):
            cov[at, t, own, at, t, own] += fields.phasor_cov[:, t]
        if course is None or not windows.angle_known:
            # |B| falls as the distance cubed: its slope is at most 3 |B| / r.
            slope = 3.0 * size[:, t] / windows.reach[t]
            if course is not None:
                slope = np.linalg.norm(course.slope[:, t], axis=-1) / np.sqrt(2.0)
            power = (windows.depth_sigma * slope) ** 2 / 3.0
            cov[at, t, :, at, t, :] += power[:, None, None] * np.eye(6)
    if course is not None and windows.angle_known:
        shift = windows.depth_sigma * real_and_imaginary(
            course.slope
        )  # one depth affects all tones
        cov[at, :, :, at] += shift[:, :, :, None, None] * shift[:, None, None]
    silent = np.repeat(~valid.ravel(), 6)
    whole = cov.reshape(n * tones * 6, -1)
    whole[silent], whole[:, silent] = 0.0, 0.0
    whole[silent, silent] = 1.0  # their rows are empty
    root = np.linalg.cholesky(whole)
    return np.asarray(solve_triangular(root, np.eye(len(root)), lower=True))


def _model_error(site: Site) -> float:
    own = site.beacons[0].model_error
    return site.model_error if own is None else own


def _model_error_correlation(site: Site, windows: RangingWindows) -> Array:
    """Return the correlation of the model's errors between windows (n, n).

    Windows with unknown phases are independent, with a larger error each, equivalent to one
    common error over the correlation length.
    """
    places = np.stack([windows.magnet[:, 1], windows.sensor], axis=1)
    distance = np.linalg.norm(places[:, None] - places, axis=-1)
    if not windows.angle_known:
        step = float(np.median(np.abs(np.diff(places[:, 0])))) if len(places) > 1 else 0.0
        return max(1.0, site.model_error_length / max(step, 1e-3)) * np.eye(len(places))
    if not site.model_error_length:
        return np.eye(len(places))
    return np.asarray(np.exp(-distance / site.model_error_length))
